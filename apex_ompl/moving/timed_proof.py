"""Continuous collision checks in time: timed motions by spheres and exact shapes, timed paths by swept shapes.

Obstacles move from time 0 on, when the motion or the path starts, at constant velocity or by a script
(:mod:`apex_ompl.scene.scripts`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from apex_ompl.collision import CollisionChecker
from apex_ompl.collision.path_proof import Curve
from apex_ompl.errors import ParameterError
from apex_ompl.moving.dynamic_obstacles import DynamicObstacles, allowed_rows, prove_motion
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.scene.problem import Problem
from apex_ompl.scene.scripts import is_there, obstacle_at, problem_at, script_times, velocity_at
from apex_ompl.timing import Trajectory
from apex_ompl.types import Array
from apex_ompl.util.arrays import distinct
from apex_ompl.util.validation import check_states, check_times, number_array

SLICE, SHORTEST_SLICE = 0.02, 0.00125  # lengths of slices of time that are checked by exact shapes [s]
INFLATED = ("box", "sphere", "cylinder", "capsule")
SHORTEST_STEP = 0.01  # time between two states of a path [s]
MAX_INTERVALS = 1_000_000
OBSTACLE_STEP = 0.005  # largest motion of an obstacle during one time interval of the check [m]


@dataclass(frozen=True)
class TimedProof:
    """Outcome of the check of a timed motion.

    Attributes:
        ok: Whether the motion is proved clear of the dynamic obstacles.
        reason: Why not: one sentence, empty for a proved motion.
        time: First moment that is not proved [s], infinite for a proved motion.
    """

    ok: bool
    reason: str
    time: float

    def __bool__(self) -> bool:
        """Whether the motion is proved."""
        return self.ok


class TimedProver:
    """Continuous checks of motions of one robot among dynamic obstacles; static ones are a :class:`CollisionChecker`'s.

    Attributes:
        dynamic: The dynamic obstacles.
        obstacles: Their records at time 0.
    """

    def __init__(
        self, checker: CollisionChecker, obstacles: Iterable[Obstacle], allowed: Sequence[tuple[str, str]] = (),
        *, margin: float = 0.0,
    ) -> None:  # fmt: skip
        """Check motions of the robot of a checker, with its held objects, among dynamic obstacles.

        Args:
            checker: The robot; its obstacles are not checked.
            obstacles: The dynamic obstacles at time 0.
            allowed: Pairs of names of bodies that may touch.
            margin: Distance to keep from them [m].

        Raises:
            SceneError, ParameterError: As :class:`apex_ompl.moving.dynamic_obstacles.DynamicObstacles`.
        """
        self.obstacles, self._checker, self._allowed = tuple(obstacles), checker, tuple(allowed)
        names = [o.name for o in self.obstacles]
        self.dynamic = DynamicObstacles(self.obstacles, allowed_rows(checker.kernel, allowed, names))
        for name in names:
            self.dynamic.update(name, growth=(margin, 0.0))
        self._margin = margin
        speeds = [float(np.linalg.norm(o.velocity or (0.0, 0.0, 0.0))) for o in self.obstacles]
        self._speeds = dict(zip(names, speeds, strict=True))
        self._exact: dict[float, CollisionChecker] = {}  # by length of the slices

    def prove(self, motion: Trajectory, *, stop: Callable[[], bool] = lambda: False) -> TimedProof:
        """Check whether a motion that starts at time 0 stays clear of the dynamic obstacles, to its end.

        Args:
            motion: The motion.
            stop: Returns whether to give up; called between slices of time.
        """
        kernel, time, longest = self._checker.kernel, 0.0, SLICE
        while True:
            conflict = prove_motion(kernel, self.dynamic, motion, time)
            if not conflict:
                return TimedProof(True, "", math.inf)
            if stop():
                return TimedProof(False, "not proved in time", conflict.time)
            reason, length = self._prove_slice(motion, conflict.time, longest)
            if reason:
                return TimedProof(False, f"at {conflict.time:.3f} s: {reason}", conflict.time)
            time, longest = conflict.time + length, min(2.0 * length, SLICE)
            if time >= motion.duration:
                return TimedProof(True, "", math.inf)

    def fault_at_start(self, q: Array) -> str:
        """Return why the robot may not be at a state, shape (dof,), at time 0 and shortly after, or nothing."""
        still = np.zeros((1, len(q)))
        rest = Trajectory(np.zeros(1), q[None], still, still, self._checker.robot.joint_names)
        if not prove_motion(self._checker.kernel, self.dynamic, rest, end=SHORTEST_SLICE):
            return ""
        return self._prove_slice(rest, 0.0, SHORTEST_SLICE)[0]

    def _prove_slice(self, motion: Trajectory, start: float, longest: float) -> tuple[str, float]:
        """Check a slice of time by exact shapes; return the fault of the shortest slice, or nothing, and its length."""
        if not all(o.shape in INFLATED for o in self.obstacles):
            return "too near to a moving obstacle for a proof by spheres", 0.0
        length = longest
        while True:
            reason = self._fault_in(motion, start, start + length)
            if not reason or length <= SHORTEST_SLICE:
                return reason, length
            length /= 2.0

    def _fault_in(self, motion: Trajectory, start: float, end: float) -> str:
        """Return the contact with the volume that the dynamic obstacles sweep in a slice of time, or nothing."""
        exact = self._exact_among(end - start)
        for o in self.obstacles:
            exact.move(o.name, obstacle_at(o, 0.5 * (start + end)).position)
        inner = motion.times[(motion.times > start) & (motion.times < end)]
        knots = distinct(np.concatenate([[start], inner, [min(end, max(motion.duration, start))]]))
        curve = Curve.cubic(knots, *motion.states(knots))
        return exact.prove(curve, tolerance=0.0).reason

    def _exact_among(self, length: float) -> CollisionChecker:
        """Return a checker among the volumes that the dynamic obstacles sweep in slices of a length [s]."""
        if length not in self._exact:
            swept = [inflated(o, self._margin + 0.5 * length * self._speeds[o.name]) for o in self.obstacles]
            pairs = [pair for pair in self._allowed if not any(map(self._checker.is_obstacle, pair))]
            self._exact[length] = CollisionChecker(self._checker.robot, swept, self._checker.held.values(), pairs)
        return self._exact[length]


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

    Between states the path is straight and its velocity constant. Time is divided where a script has a place or an
    obstacle appears, and these pieces into intervals in which no obstacle moves more than ``OBSTACLE_STEP``. In each,
    the obstacles stand where they are in its middle, inflated by half of ``OBSTACLE_STEP``, and so contain all that
    they sweep; the path of that time is proved free of them. One that appears when the path ends is not checked.

    Args:
        robot: The robot.
        problem: The problem, with the motions of its obstacles from time 0 on, and held objects.
        path: States, shape (N, dof).
        times: Times of the states, increasing from 0, shape (N,) [s].

    Raises:
        ParameterError: Another shape, times that do not increase from 0, or a moving obstacle that cannot be inflated.
    """
    path, times = number_array(path, "path"), number_array(times, "times")
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
    dynamic, checkers = [o for o in problem.scene if o.moving], dict[frozenset[str], CollisionChecker]()
    names = {o.name for o in dynamic}
    for start, end in _intervals(dynamic, float(times[-1])):
        now = problem_at(problem, (start + end) / 2.0)
        here = frozenset(o.name for o in now.scene)
        if here not in checkers:
            scene = [inflated(o, OBSTACLE_STEP / 2.0) if o.name in names else o for o in now.scene]
            checkers[here] = CollisionChecker(robot, scene, now.attached, now.allowed)
        for obstacle in now.scene:
            if obstacle.name in names:
                checkers[here].move(obstacle.name, obstacle.position)
        knots = np.concatenate([[start], times[(times > start) & (times < end)], [end]])
        states = np.stack([np.interp(knots, times, column) for column in path.T], axis=1)
        proof = checkers[here].prove(states, tolerance=0.0)
        if not proof:
            return TimedPathCheck(False, f"between {start:.3f} and {end:.3f} s: {proof.reason}", end)
    return TimedPathCheck(True)


def _intervals(dynamic: Sequence[Obstacle], until: float) -> list[tuple[float, float]]:
    """Return starts and ends of the intervals of a check [s].

    In none of them does an obstacle change its velocity, appear, or move more than ``OBSTACLE_STEP``.

    Raises:
        ParameterError: There would be too many.
    """
    bounds = sorted({0.0, until, *(t for o in dynamic for t in script_times(o) if t < until)})
    found: list[tuple[float, float]] = []
    for start, end in pairwise(bounds):
        middle = (start + end) / 2.0
        way = (end - start) * max((_speed(o, middle) for o in dynamic if is_there(o, middle)), default=0.0)
        if way / OBSTACLE_STEP > MAX_INTERVALS - len(found):
            farthest = MAX_INTERVALS * OBSTACLE_STEP
            raise ParameterError("times", until, f"an end before an obstacle has moved {farthest:g} m")
        knots = np.linspace(start, end, max(1, int(np.ceil(way / OBSTACLE_STEP))) + 1).tolist()
        found += pairwise(knots)
    return found


def _speed(obstacle: Obstacle, time: float) -> float:
    return float(np.linalg.norm(velocity_at(obstacle, time)))


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
