"""OMPL validity checkers over the collision checker, and the full check that decides what counts as a solution."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from ompl import base as ob

from apex_ompl.collision.checker import CollisionChecker
from apex_ompl.types import Array
from apex_ompl.util.resolution import FULL_RESOLUTION, SEARCH_RESOLUTION
from apex_ompl.util.validation import check_states


class MotionCheck:
    """Collision check of straight motions between states at a spacing; a plain callable, without OMPL."""

    def __init__(self, checker: CollisionChecker, resolution: float = SEARCH_RESOLUTION) -> None:
        """Check by ``checker`` at a spacing of ``resolution`` [rad, max-norm]."""
        self.checker = checker
        self.resolution = resolution

    def __call__(self, a: ArrayLike, b: ArrayLike) -> bool:
        """Whether the motion from ``a`` to ``b`` is free, its end first; ``a`` is taken to be free."""
        return self.checker.first_collision(np.array([a, b]), self.resolution, start=False) is None


class StateValidityChecker(ob.StateValidityChecker):
    """OMPL state validity checker over a collision checker.

    No exception leaves it, since one would end the process inside OMPL: a fault makes states invalid and is
    kept in ``fault``.
    """

    def __init__(self, si: ob.SpaceInformation, checker: CollisionChecker) -> None:
        """Check states of ``si`` by ``checker``."""
        super().__init__(si)
        self.checker = checker
        self.dof = checker.robot.dof
        self.fault: BaseException | None = None

    def isValid(self, state: Any) -> bool:  # noqa: N802 - OMPL's name
        """Whether the state is free."""
        try:
            return self.checker.is_free(np.array(state[0 : self.dof]))
        except BaseException as error:
            self.fault = self.fault or error
            return False

    def clearance(self, state: Any) -> float:
        """Return the least distance of all checked pairs at the state [m], 0 after a fault."""
        try:
            return self.checker.clearance(np.array(state[0 : self.dof]))
        except BaseException as error:
            self.fault = self.fault or error
            return 0.0


class MotionValidator(ob.MotionValidator):
    """OMPL motion validator over a collision checker, in bit-reversed order; no exception leaves it."""

    def __init__(self, si: ob.SpaceInformation, check: MotionCheck) -> None:
        """Check motions of ``si`` by ``check``."""
        super().__init__(si)
        self.check: Callable[[Array, Array], bool] = check
        self.dof = check.checker.robot.dof
        self.fault: BaseException | None = None

    def checkMotion(self, first: Any, second: Any) -> bool:  # noqa: N802 - OMPL's name
        """Whether the straight motion between two states is free."""
        try:
            return self.check(first[0 : self.dof], second[0 : self.dof])
        except BaseException as error:
            self.fault = self.fault or error
            return False


@dataclass(frozen=True)
class FullCheck:
    """Outcome of the full check of a path.

    Attributes:
        ok: Whether the path is a solution.
        reason: One sentence about the first fault found, empty when there is none.
        segment: Index of the segment (states k and k + 1) with the fault, or None.
        states: Number of states that were checked one by one.
        timed_out: Whether there was no time for the proof.
    """

    ok: bool
    reason: str
    segment: int | None
    states: int
    timed_out: bool = False

    def __bool__(self) -> bool:
        """Whether the path is a solution."""
        return self.ok


def full_check(
    checker: CollisionChecker,
    path: Array,
    start: Array | None = None,
    goals: Iterable[Array] = (),
    resolution: float = FULL_RESOLUTION,
    *,
    deadline: float | None = None,
) -> FullCheck:
    """Decide whether a path is a solution.

    It is when every state along it is inside the limits and free at a spacing of ``resolution``, the first
    state is ``start`` bit for bit, and the last is one of ``goals``. Stretches that the spheres prove free count as
    sampled.

    Args:
        checker: Collision checker.
        path: States, shape (N, dof).
        start: The given start, shape (dof,), or None for any.
        goals: Goal states; none means any end.
        resolution: Spacing [rad, max-norm].
        deadline: Value of ``time.perf_counter`` at which it gives up [s], or None.

    Raises:
        ParameterError: ``path`` has not the shape (N, dof).
    """
    robot = checker.robot
    path = np.asarray(path, dtype=float)
    check_states(path, robot.dof, "path", least=1)
    for k, q in enumerate(path):
        fault = robot.limit_fault(q)
        if fault:
            return FullCheck(False, f"state {k}: {fault}", min(k, max(len(path) - 2, 0)), 0)
    if start is not None and not np.array_equal(path[0], start):
        return FullCheck(False, "the path does not begin at the start", 0, 0)
    ends = list(goals)
    if ends and not any(np.array_equal(path[-1], goal) for goal in ends):
        return FullCheck(False, "the path does not end at a goal", len(path) - 2, 0)
    if deadline is not None and time.perf_counter() >= deadline:
        return FullCheck(False, "not proved in time", None, 0, timed_out=True)
    before = checker.check_counts.states
    hit = checker.first_collision(path, resolution)
    checked = checker.check_counts.states - before
    if hit is None:
        return FullCheck(True, "", None, checked)
    contacts = checker.contacts(hit.state)
    what = str(contacts[0]) if contacts else "in collision"
    return FullCheck(False, f"between states {hit.segment} and {hit.segment + 1}: {what}", hit.segment, checked)
