"""OMPL's validity checkers over the verdict, and the full check that decides what counts as a solution."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from ompl import base as ob

from apex_ompl.collision.verdict import Verdict
from apex_ompl.errors import ParameterError
from apex_ompl.resolution import FULL_RESOLUTION, SEARCH_RESOLUTION

Array = NDArray[np.float64]


class MotionCheck:
    """Judges straight motions between states at a spacing; a plain callable, without OMPL."""

    def __init__(self, verdict: Verdict, resolution: float = SEARCH_RESOLUTION) -> None:
        """Judge by ``verdict`` at a spacing of ``resolution`` [rad, max-norm]."""
        self.verdict = verdict
        self.resolution = resolution

    def __call__(self, a: ArrayLike, b: ArrayLike) -> bool:
        """Whether the motion from ``a`` to ``b`` is free, its end first; ``a`` is taken to be free."""
        return self.verdict.first_collision(np.array([a, b]), self.resolution, start=False) is None


class VerdictChecker(ob.StateValidityChecker):
    """OMPL's state validity by the verdict.

    No exception leaves it, since one would end the process inside OMPL: a fault makes states invalid and is
    kept in ``fault``.
    """

    def __init__(self, si: ob.SpaceInformation, verdict: Verdict) -> None:
        """Judge states of ``si`` by ``verdict``."""
        super().__init__(si)
        self.verdict = verdict
        self.dof = verdict.robot.dof
        self.fault: BaseException | None = None

    def isValid(self, state: Any) -> bool:  # noqa: N802 - OMPL's name
        """Whether the state is free."""
        try:
            return self.verdict.is_free(np.array(state[0 : self.dof]))
        except BaseException as error:
            self.fault = self.fault or error
            return False

    def clearance(self, state: Any) -> float:
        """Return the least distance of all checked pairs at the state [m], 0 after a fault."""
        try:
            return self.verdict.clearance(np.array(state[0 : self.dof]))
        except BaseException as error:
            self.fault = self.fault or error
            return 0.0


class VerdictMotionValidator(ob.MotionValidator):
    """OMPL's motion validity by the verdict, in bit-reversed order; no exception leaves it."""

    def __init__(self, si: ob.SpaceInformation, check: MotionCheck) -> None:
        """Judge motions of ``si`` by ``check``."""
        super().__init__(si)
        self.check: Callable[[Array, Array], bool] = check
        self.dof = check.verdict.robot.dof
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
        states: How many states were judged one by one.
    """

    ok: bool
    reason: str
    segment: int | None
    states: int

    def __bool__(self) -> bool:
        """Whether the path is a solution."""
        return self.ok


def full_check(
    verdict: Verdict,
    path: Array,
    start: Array | None = None,
    goals: Iterable[Array] = (),
    resolution: float = FULL_RESOLUTION,
) -> FullCheck:
    """Decide whether a path is a solution.

    It is when every state along it is inside the limits and free at a spacing of ``resolution``, the first
    state is ``start`` bit for bit, and the last is one of ``goals``. Stretches that the spheres prove free count as
    sampled.

    Args:
        verdict: Judges the states.
        path: States, shape (N, dof).
        start: The given start, shape (dof,), or None for any.
        goals: Goal states; none means any end.
        resolution: Spacing [rad, max-norm].

    Raises:
        ParameterError: ``path`` has not the shape (N, dof).
    """
    robot = verdict.robot
    path = np.asarray(path, dtype=float)
    if path.ndim != 2 or path.shape[1] != robot.dof or len(path) == 0:
        raise ParameterError("path", path.shape, f"an array of shape (N, {robot.dof})")
    for k, q in enumerate(path):
        fault = robot.limit_fault(q)
        if fault:
            return FullCheck(False, f"state {k}: {fault}", min(k, max(len(path) - 2, 0)), 0)
    if start is not None and not np.array_equal(path[0], start):
        return FullCheck(False, "the path does not begin at the start", 0, 0)
    ends = list(goals)
    if ends and not any(np.array_equal(path[-1], goal) for goal in ends):
        return FullCheck(False, "the path does not end at a goal", len(path) - 2, 0)
    before = verdict.tally.states
    hit = verdict.first_collision(path, resolution)
    judged = verdict.tally.states - before
    if hit is None:
        return FullCheck(True, "", None, judged)
    contacts = verdict.contacts(hit.state)
    what = str(contacts[0]) if contacts else "in collision"
    return FullCheck(False, f"between states {hit.segment} and {hit.segment + 1}: {what}", hit.segment, judged)
