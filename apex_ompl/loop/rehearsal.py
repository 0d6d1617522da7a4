"""Replans made before a run by the clock on the wall, so that none of the run's own waits for code to be loaded."""

from __future__ import annotations

import math

import numpy as np

from apex_ompl.loop.replanning import answered
from apex_ompl.moving.charges import Charges
from apex_ompl.moving.dynamic_obstacles import DynamicObstacles
from apex_ompl.moving.following import Following
from apex_ompl.moving.ready import Ready
from apex_ompl.moving.request import Replanner, Request
from apex_ompl.scene.bodies import Obstacle, Sphere
from apex_ompl.timing import time_path

RADIUS, VELOCITY = 0.06, (0.02, 0.0, 0.0)  # of the obstacle in the way [m, m/s]
LONG = 1.0  # that a rehearsed replan may take by the table of costs [s]


def requests(ready: Ready) -> tuple[Request, ...]:
    """Return requests of all sorts among an obstacle in the middle of the straight line to the first goal.

    The robot stands; stands where it is about to be touched; moves towards the obstacle; and is to be made faster.
    """
    start, goal, settings = ready.setup.start, ready.goals[0], ready.settings
    standing = Following.standing(start, 0.0, ready.names)
    line = Following(time_path(np.stack([start, goal]), ready.limits, ready.names).trajectory, 0.0, to_goal=True)
    _, places = ready.kernel.joint_frames(0.5 * (start + goal)[None])
    position = tuple(places[0, -1].tolist())
    ball = Obstacle(name="rehearsal", sphere=Sphere(radius=RADIUS), position=position, velocity=VELOCITY)
    dynamic, join = DynamicObstacles([ball]), min(settings.budget, 0.5 * line.end)
    soon = join + settings.period
    cases = ((standing, math.inf), (standing, soon), (line, soon), (line, math.inf))
    return tuple(
        Request(k, 0.0, join, following, None, dynamic, settings.berth, (ball,), conflict, 0, conflict, dynamic)
        for k, (following, conflict) in enumerate(cases, 1)
    )


def rehearse(replanner: Replanner, ready: Ready) -> None:
    """Let a way of replanning that is prepared answer requests of all sorts, and prepare it anew."""
    if not len(ready.goals):
        return
    for request in requests(ready):
        answered(replanner, ready, request, Charges(LONG))
    replanner.prepare(ready)
