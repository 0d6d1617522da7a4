"""Proof that a timed motion stays apart from obstacles that move: sphere covers first, exact shapes where they end."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from apex_ompl.collision import CollisionChecker
from apex_ompl.collision.path_proof import Curve
from apex_ompl.moving.dynamic_obstacles import DynamicObstacles, allowed_rows, prove_motion
from apex_ompl.moving.swept import inflated
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.scene.scripts import obstacle_at
from apex_ompl.timing import Trajectory
from apex_ompl.types import Array

SLICE, SHORTEST_SLICE = 0.02, 0.00125  # of time, in which exact shapes are looked at [s]
INFLATED = ("box", "sphere", "cylinder", "capsule")


@dataclass(frozen=True)
class TimedProof:
    """Outcome of a proof.

    Attributes:
        ok: Whether the motion is proved apart from the dynamic obstacles.
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
    """Proofs of motions of one robot among dynamic obstacles; a :class:`CollisionChecker` proves those among others.

    Attributes:
        dynamic: The obstacles that move.
        obstacles: Their records, where they are at time 0.
    """

    def __init__(
        self, checker: CollisionChecker, obstacles: Iterable[Obstacle], allowed: Sequence[tuple[str, str]] = (),
        *, margin: float = 0.0,
    ) -> None:  # fmt: skip
        """Prove motions of the robot of a checker, with what it holds, among obstacles that move.

        Args:
            checker: The robot; its obstacles are not looked at.
            obstacles: The obstacles that move, where they are at time 0.
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
        """Prove that a motion that begins at time 0 stays apart from the dynamic obstacles, to its end.

        Args:
            motion: The motion.
            stop: Asked between slices of time whether to give up.
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
        """Return why the robot may not stand at a state, shape (dof,), at time 0 and a moment longer, or nothing."""
        still = np.zeros((1, len(q)))
        rest = Trajectory(np.zeros(1), q[None], still, still, self._checker.robot.joint_names)
        if not prove_motion(self._checker.kernel, self.dynamic, rest, end=SHORTEST_SLICE):
            return ""
        return self._prove_slice(rest, 0.0, SHORTEST_SLICE)[0]

    def _prove_slice(self, motion: Trajectory, begin: float, longest: float) -> tuple[str, float]:
        """Prove a slice of time by exact shapes: return the fault of the shortest slice, or nothing, and its length."""
        if not all(o.shape in INFLATED for o in self.obstacles):
            return "too near to a moving obstacle for a proof by spheres", 0.0
        length = longest
        while True:
            reason = self._fault_in(motion, begin, begin + length)
            if not reason or length <= SHORTEST_SLICE:
                return reason, length
            length /= 2.0

    def _fault_in(self, motion: Trajectory, begin: float, end: float) -> str:
        """Return why what the dynamic obstacles sweep from a moment to another is in the way, or nothing."""
        exact = self._exact_among(end - begin)
        for o in self.obstacles:
            exact.move(o.name, obstacle_at(o, 0.5 * (begin + end)).position)
        inner = motion.times[(motion.times > begin) & (motion.times < end)]
        knots = np.unique(np.concatenate([[begin], inner, [min(end, max(motion.duration, begin))]]))
        curve = Curve.cubic(knots, *motion.states(knots))
        return exact.prove(curve, tolerance=0.0).reason

    def _exact_among(self, length: float) -> CollisionChecker:
        """Return a checker among the dynamic obstacles, as large as what they sweep in slices of a length [s]."""
        if length not in self._exact:
            swept = [inflated(o, self._margin + 0.5 * length * self._speeds[o.name]) for o in self.obstacles]
            pairs = [pair for pair in self._allowed if not any(map(self._checker.is_obstacle, pair))]
            self._exact[length] = CollisionChecker(self._checker.robot, swept, self._checker.held.values(), pairs)
        return self._exact[length]
