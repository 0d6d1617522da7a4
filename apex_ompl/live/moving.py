"""Obstacles that move: where they are, and whether a timed path keeps clear of them.

Obstacles move at constant velocity from time 0, when the path begins.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from apex_ompl.collision import CollisionChecker
from apex_ompl.errors import ParameterError
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.scene.problem import Problem
from apex_ompl.types import Array
from apex_ompl.util.resolution import FULL_RESOLUTION
from apex_ompl.util.validation import check_states, check_times

SHORTEST = 0.01  # time of a step of a path [s]
MOST_PIECES = 1_000_000
STEP = 0.005  # that obstacles move on while one place, grown by half of it, stands for them [m]


@dataclass(frozen=True)
class TimedCheck:
    """Outcome of the check of a timed path.

    Attributes:
        ok: Whether the path is inside the limits of positions and velocities, and free.
        reason: One sentence about the first fault found, empty when there is none: limits are looked at first.
        time: By when it is met [s], or None.
    """

    ok: bool
    reason: str = ""
    time: float | None = None

    def __bool__(self) -> bool:
        """Whether the path is inside the limits and free."""
        return self.ok


def at_time(obstacle: Obstacle, time: float) -> Obstacle:
    """Return an obstacle as it stands at a time [s]."""
    if not obstacle.moving:
        return obstacle
    x, y, z = (float(v) for v in np.add(obstacle.position, np.multiply(obstacle.velocity or (0, 0, 0), time)))
    return obstacle.model_copy(update={"position": (x, y, z)})


def grown(obstacle: Obstacle, by: float) -> Obstacle:
    """Return an obstacle that holds all points within ``by`` of it [m].

    Raises:
        ParameterError: It is a mesh or a half-space.
    """
    if obstacle.box is not None:
        x, y, z = (edge + 2.0 * by for edge in obstacle.box)
        return obstacle.model_copy(update={"box": (x, y, z)})
    if obstacle.sphere is not None:
        ball = obstacle.sphere.model_copy(update={"radius": obstacle.sphere.radius + by})
        return obstacle.model_copy(update={"sphere": ball})
    for kind in ("cylinder", "capsule"):
        bar = getattr(obstacle, kind)
        if bar is not None:
            larger = bar.model_copy(update={"radius": bar.radius + by, "length": bar.length + 2.0 * by})
            return obstacle.model_copy(update={kind: larger})
    raise ParameterError("scene", obstacle.name, "moving obstacles that are boxes, spheres, cylinders or capsules")


def timed_check(
    robot: Robot,
    problem: Problem,
    path: ArrayLike,
    times: ArrayLike,
    resolution: float = FULL_RESOLUTION,
) -> TimedCheck:
    """Decide whether a path that passes its states at given times is free of obstacles, moving ones among them.

    Between states the path goes straight at an even pace. It is cut into pieces during which no obstacle moves more
    than ``STEP``; each piece is judged among obstacles grown by half of that, at the places of the middle of its time,
    so that obstacles miss nothing between samples. Along the path states are judged as in the full check.

    Args:
        robot: The robot.
        problem: Its obstacles, where they are at time 0, and its held objects count.
        path: States, shape (N, dof).
        times: When they are passed, shape (N,), from 0 on and growing [s].
        resolution: Spacing of the states judged [rad, max-norm].

    Raises:
        ParameterError: Another shape, times that do not grow from 0, or a moving obstacle that cannot be grown.
    """
    path, times = np.asarray(path, dtype=np.float64), np.asarray(times, dtype=np.float64)
    check_states(path, robot.dof, "path", least=2)
    check_times(times, len(path))
    for k, q in enumerate(path):
        if fault := robot.limit_fault(q):
            return TimedCheck(False, f"state {k}: {fault}", float(times[k]))
    speeds = np.abs(np.diff(path, axis=0)) / np.diff(times)[:, None]
    excess = speeds / robot.limits.velocity
    if excess.max() > 1.0 + 1e-9:
        worst, joint = divmod(int(excess.argmax()), robot.dof)
        name, limit = robot.joint_names[joint], robot.limits.velocity[joint]
        return TimedCheck(
            False, f"{name} at {speeds[worst, joint]:.3g}, its limit is {limit:.3g} rad/s", float(times[worst])
        )
    movers = [o for o in problem.scene if o.moving]
    fastest = max((float(np.linalg.norm(o.velocity or (0, 0, 0))) for o in movers), default=0.0)
    if fastest * times[-1] / STEP > MOST_PIECES:
        raise ParameterError("times", float(times[-1]), f"an end at which no obstacle moved {MOST_PIECES * STEP:g} m")
    pieces = max(1, int(np.ceil(fastest * times[-1] / STEP)))
    cuts = np.linspace(0.0, times[-1], pieces + 1)
    scene = [grown(o, STEP / 2.0) if o.moving else o for o in problem.scene]
    checker = CollisionChecker(robot, scene, problem.attached)
    for begin, end in zip(cuts[:-1], cuts[1:], strict=True):
        for mover in movers:
            checker.move(mover.name, at_time(mover, (begin + end) / 2.0).position)
        knots = np.concatenate([[begin], times[(times > begin) & (times < end)], [end]])
        states = np.stack([np.interp(knots, times, column) for column in path.T], axis=1)
        hit = checker.first_collision(states, resolution)
        if hit is not None:
            contacts = checker.contacts(hit.state)
            what = str(contacts[0]) if contacts else "in collision"
            return TimedCheck(False, f"between {begin:.3f} and {end:.3f} s: {what}", float(end))
    return TimedCheck(True)


def even_times(robot: Robot, path: Array, pace: float) -> Array:
    """Return times for the states of a path, shape (N,) [s], so that each step takes its slowest joint's time.

    Args:
        robot: The robot.
        path: States, shape (N, dof).
        pace: Share of the velocity limits, in (0, 1].

    Raises:
        ParameterError: ``pace`` is not.
    """
    if not 0.0 < pace <= 1.0:
        raise ParameterError("pace", pace, "a share of the velocity limits, above 0 and at most 1")
    steps = (np.abs(np.diff(path, axis=0)) / robot.limits.velocity).max(axis=1) / pace
    times: Array = np.concatenate([[0.0], np.cumsum(np.maximum(steps, SHORTEST))])
    return times
