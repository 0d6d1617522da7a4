"""OMPL's validity checkers over the verdict, and the full check that decides what counts as a solution."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from ompl import base as ob

from apex_ompl.collision.verdict import Verdict
from apex_ompl.errors import ParameterError
from apex_ompl.space import FULL_RESOLUTION, SEARCH_RESOLUTION

Array = NDArray[np.float64]


@lru_cache(maxsize=256)
def bit_reversed(n: int) -> NDArray[np.intp]:
    """Return 0..n-1 in bit-reversed order, shape (n,): each prefix is spread evenly over the range.

    A path that collides somewhere is so rejected after few states (van der Corput's sequence).
    """
    bits = max(n - 1, 1).bit_length()
    numbers = np.arange(1 << bits)
    turned = np.zeros_like(numbers)
    for k in range(bits):
        turned |= ((numbers >> k) & 1) << (bits - 1 - k)
    order = turned[turned < n].astype(np.intp)
    order.flags.writeable = False
    return order


def states_between(a: Array, b: Array, resolution: float) -> Array:
    """Return evenly spaced states strictly between two, at most ``resolution`` apart [rad, max-norm].

    Args:
        a: First state, shape (dof,).
        b: Last state, shape (dof,).
        resolution: Largest spacing, from ``a`` and to ``b`` too.

    Returns:
        States, shape (M, dof); M is 0 when ``a`` and ``b`` are close enough.
    """
    n = max(1, math.ceil(float(np.abs(b - a).max()) / resolution))
    return a + (np.arange(1, n) / n)[:, None] * (b - a)


class MotionCheck:
    """Judges straight motions between states at a spacing; a plain callable, without OMPL."""

    def __init__(self, verdict: Verdict, resolution: float = SEARCH_RESOLUTION) -> None:
        """Judge by ``verdict`` at a spacing of ``resolution`` [rad, max-norm]."""
        self.verdict = verdict
        self.resolution = resolution

    def __call__(self, a: Array, b: Array) -> bool:
        """Whether the motion from ``a`` to ``b`` is free, its end first; ``a`` is taken to be free."""
        is_free = self.verdict.is_free
        if not is_free(b):
            return False
        inner = states_between(a, b, self.resolution)
        return all(is_free(inner[k]) for k in bit_reversed(len(inner)))


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
        self.check = check
        self.dof = check.verdict.robot.dof
        self.fault: BaseException | None = None

    def checkMotion(self, first: Any, second: Any) -> bool:  # noqa: N802 - OMPL's name
        """Whether the straight motion between two states is free."""
        try:
            return self.check(np.array(first[0 : self.dof]), np.array(second[0 : self.dof]))
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
        states: How many states were judged.
    """

    ok: bool
    reason: str
    segment: int | None
    states: int

    def __bool__(self) -> bool:
        """Whether the path is a solution."""
        return self.ok


def sample_path(path: Array, resolution: float) -> tuple[Array, NDArray[np.intp]]:
    """Return states along a polyline at a spacing, and the segment of each.

    Args:
        path: States, shape (N, dof).
        resolution: Largest spacing [rad, max-norm].

    Returns:
        States, shape (M, dof), the given ones among them bit for bit, and segment indices, shape (M,).
    """
    pieces, segments = [path[:1]], [np.zeros(1, np.intp)]
    for k in range(len(path) - 1):
        inner = states_between(path[k], path[k + 1], resolution)
        pieces += [inner, path[k + 1 : k + 2]]
        segments.append(np.full(len(inner) + 1, k, np.intp))
    return np.concatenate(pieces), np.concatenate(segments)


def full_check(
    verdict: Verdict,
    path: Array,
    start: Array | None = None,
    goals: Iterable[Array] = (),
    resolution: float = FULL_RESOLUTION,
) -> FullCheck:
    """Decide whether a path is a solution.

    It is when every state along it is inside the limits and free at a spacing of ``resolution``, the first
    state is ``start`` bit for bit, and the last is one of ``goals``.

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
    states, segments = sample_path(path, resolution)
    for count, k in enumerate(bit_reversed(len(states)), start=1):
        if not verdict.is_free(states[k]):
            contacts = verdict.contacts(states[k])
            what = str(contacts[0]) if contacts else "in collision"
            segment = int(segments[k])
            return FullCheck(False, f"between states {segment} and {segment + 1}: {what}", segment, count)
    return FullCheck(True, "", None, len(states))
