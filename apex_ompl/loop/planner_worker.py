"""The planner process: answers requests for replans until the other end is closed."""

from __future__ import annotations

import math
import os
import pickle
import sys
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from apex_ompl.errors import ApexError
from apex_ompl.loop.replanning import SHARE, Work, reply_of
from apex_ompl.moving.compute_costs import ComputeBudget, WallClockBudget
from apex_ompl.moving.context import Following, RunContext
from apex_ompl.moving.dynamic_obstacles import DynamicObstacles
from apex_ompl.moving.replanner import Replanner, Request
from apex_ompl.ompl.process import quiet_ompl, seed_ompl
from apex_ompl.ompl.setup import assemble
from apex_ompl.scene.bodies import Obstacle, Sphere
from apex_ompl.timing import time_path

RADIUS, VELOCITY = 0.06, (0.02, 0.0, 0.0)  # of the obstacle in the way [m, m/s]
LONG = 1.0  # time that a rehearsed replan may take by the compute-cost table [s]


def requests(context: RunContext) -> tuple[Request, ...]:
    """Return requests of all kinds with an obstacle in the middle of the straight line to the first goal.

    The robot is at rest; is at rest and about to be touched; moves towards the obstacle; and asks for a faster motion.
    """
    start, goal, settings = context.setup.start, context.goals[0], context.settings
    standing = Following.resting(start, 0.0, context.names)
    line = Following(time_path(np.stack([start, goal]), context.limits, context.names).trajectory, 0.0, to_goal=True)
    _, places = context.kernel.joint_frames(0.5 * (start + goal)[None])
    position = tuple(places[0, -1].tolist())
    ball = Obstacle(name="rehearsal", sphere=Sphere(radius=RADIUS), position=position, velocity=VELOCITY)
    dynamic, join = DynamicObstacles([ball]), min(settings.budget, 0.5 * line.end)
    soon = join + settings.period
    cases = ((standing, math.inf), (standing, soon), (line, soon), (line, math.inf))
    return tuple(
        Request(
            k, 0.0, join, following, None, dynamic, settings.clearance_margin, (ball,), conflict, 0, conflict, dynamic
        )
        for k, (following, conflict) in enumerate(cases, 1)
    )


def rehearse(replanner: Replanner, context: RunContext) -> None:
    """Let a prepared replanner answer requests of all kinds, so that all code is loaded, and prepare it again."""
    if not len(context.goals):
        return
    for request in requests(context):
        reply_of(replanner, context, request, ComputeBudget(LONG))
    replanner.prepare(context)


def serve(connection: Connection[Any, Any]) -> None:
    """Answer requests until the other end is closed."""
    path, core, data = connection.recv()
    sys.path[:] = path
    if core is not None:
        os.sched_setaffinity(0, {core})
    work: Work = pickle.loads(data)
    try:
        with quiet_ompl():
            seed_ompl(work.seed)
            context = RunContext(assemble(work.problem, seed=work.seed), work.limits, work.stopping, work.settings)
            replanner = work.make(*work.arguments)
            replanner.prepare(context)
            if work.rehearses:
                rehearse(replanner, context)
    except ApexError as error:
        connection.send(str(error))
        return
    connection.send("")
    with quiet_ompl():
        while True:
            data = connection.recv_bytes()
            budget = WallClockBudget(SHARE * work.settings.budget, connection.poll)
            request = pickle.loads(data)
            connection.send(reply_of(replanner, context, request, budget))


def main() -> None:
    """Serve the process at the other end of the connection whose file descriptor is the argument."""
    try:
        serve(Connection(int(sys.argv[1])))
    except (EOFError, OSError, KeyboardInterrupt):
        return  # the other end is closed


if __name__ == "__main__":
    main()
