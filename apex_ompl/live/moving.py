"""Moving obstacles: their poses over time, and the collision check of timed paths among them.

Obstacles move at constant velocity v from time 0, when the path starts: p(t) = p(0) + v t.
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
from apex_ompl.util.validation import check_states, check_times

SHORTEST_STEP = 0.01  # time between two states of a path [s]
MAX_INTERVALS = 1_000_000
OBSTACLE_STEP = 0.005  # largest motion of an obstacle during one time interval of the check [m]


@dataclass(frozen=True)
class TimedPathCheck:
    """Outcome of the check of a timed path.

    Attributes:
        ok: Whether the path is inside the limits of positions and velocities, and collision-free.
        reason: One sentence about the first fault found, empty without one; limits are checked first.
        time: Time by which the fault occurs [s], or None.
    """

    ok: bool
    reason: str = ""
    time: float | None = None

    def __bool__(self) -> bool:
        """Whether the path is inside the limits and collision-free."""
        return self.ok


def obstacle_at(obstacle: Obstacle, time: float) -> Obstacle:
    """Return an obstacle at its position at a time [s]."""
    if not obstacle.moving:
        return obstacle
    x, y, z = (float(v) for v in np.add(obstacle.position, np.multiply(obstacle.velocity or (0, 0, 0), time)))
    return obstacle.model_copy(update={"position": (x, y, z)})


def inflated(obstacle: Obstacle, by: float) -> Obstacle:
    """Return an obstacle that contains all points within a distance ``by`` of it [m].

    Raises:
        ParameterError: The obstacle is a mesh or a half-space.
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


def check_timed_path(
    robot: Robot,
    problem: Problem,
    path: ArrayLike,
    times: ArrayLike,
) -> TimedPathCheck:
    """Check whether a timed path is inside the limits and free of collisions with still and moving obstacles.

    Between states the path is straight and its velocity constant. Time is divided into intervals in which no obstacle
    moves more than ``OBSTACLE_STEP``. In each, the obstacles stand where they are in its middle, inflated by half of
    ``OBSTACLE_STEP``, and so contain all that they sweep; the path of that time is proved free of them.

    Args:
        robot: The robot.
        problem: The problem, with obstacles where they are at time 0, and held objects.
        path: States, shape (N, dof).
        times: Times of the states, increasing from 0, shape (N,) [s].

    Raises:
        ParameterError: Another shape, times that do not increase from 0, or a moving obstacle that cannot be inflated.
    """
    path, times = np.asarray(path, dtype=np.float64), np.asarray(times, dtype=np.float64)
    check_states(path, robot.dof, "path", least=2)
    check_times(times, len(path))
    for k, q in enumerate(path):
        if fault := robot.limit_fault(q):
            return TimedPathCheck(False, f"state {k}: {fault}", float(times[k]))
    speeds = np.abs(np.diff(path, axis=0)) / np.diff(times)[:, None]
    excess = speeds / robot.limits.velocity
    if excess.max() > 1.0 + 1e-9:
        worst, joint = divmod(int(excess.argmax()), robot.dof)
        name, limit = robot.joint_names[joint], robot.limits.velocity[joint]
        return TimedPathCheck(
            False, f"{name} at {speeds[worst, joint]:.3g}, its limit is {limit:.3g} rad/s", float(times[worst])
        )
    movers = [o for o in problem.scene if o.moving]
    fastest = max((float(np.linalg.norm(o.velocity or (0, 0, 0))) for o in movers), default=0.0)
    if fastest * times[-1] / OBSTACLE_STEP > MAX_INTERVALS:
        farthest = MAX_INTERVALS * OBSTACLE_STEP
        raise ParameterError("times", float(times[-1]), f"an end before an obstacle has moved {farthest:g} m")
    intervals = max(1, int(np.ceil(fastest * times[-1] / OBSTACLE_STEP)))
    bounds = np.linspace(0.0, times[-1], intervals + 1)
    scene = [inflated(o, OBSTACLE_STEP / 2.0) if o.moving else o for o in problem.scene]
    checker = CollisionChecker(robot, scene, problem.attached, problem.allowed)
    for begin, end in zip(bounds[:-1], bounds[1:], strict=True):
        for mover in movers:
            checker.move(mover.name, obstacle_at(mover, (begin + end) / 2.0).position)
        knots = np.concatenate([[begin], times[(times > begin) & (times < end)], [end]])
        states = np.stack([np.interp(knots, times, column) for column in path.T], axis=1)
        proof = checker.prove(states, tolerance=0.0)
        if not proof:
            return TimedPathCheck(False, f"between {begin:.3f} and {end:.3f} s: {proof.reason}", float(end))
    return TimedPathCheck(True)


def constant_velocity_times(robot: Robot, path: Array, velocity_scale: float) -> Array:
    """Return times of the states of a path, shape (N,) [s], between which the velocity is constant.

    A step takes max_j |dq_j| / (velocity_scale * limit_j), and at least 0.01 s.

    Args:
        robot: The robot.
        path: States, shape (N, dof).
        velocity_scale: Share of the velocity limits, in (0, 1].

    Raises:
        ParameterError: ``velocity_scale`` is outside its range.
    """
    if not 0.0 < velocity_scale <= 1.0:
        raise ParameterError("velocity_scale", velocity_scale, "a share of the velocity limits, above 0 and at most 1")
    steps = (np.abs(np.diff(path, axis=0)) / robot.limits.velocity).max(axis=1) / velocity_scale
    times: Array = np.concatenate([[0.0], np.cumsum(np.maximum(steps, SHORTEST_STEP))])
    return times
