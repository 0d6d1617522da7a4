"""OMPL validity checkers over the collision checker, and the full check that decides what counts as a solution."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any
from weakref import ref

import numpy as np
from numpy.typing import ArrayLike
from ompl import base as ob

from apex_ompl.collision.checker import CollisionChecker
from apex_ompl.collision.path_proof import Curve, PathProof
from apex_ompl.ompl.simple_setup import RobotSpaceInformation
from apex_ompl.ompl.space import to_array, to_state, values_of
from apex_ompl.paths.path import SEARCH_RESOLUTION
from apex_ompl.timing.trajectory import ROUNDING, Trajectory
from apex_ompl.types import Array
from apex_ompl.util.display import fields_line
from apex_ompl.util.validation import check_states, number_array

if TYPE_CHECKING:
    from apex_ompl.constraints.constraint_set import ConstraintSet
    from apex_ompl.constraints.proof import ConstraintCertificate

CLEARANCE_SHARE = 0.05  # of the clearance: tolerance of the one that is reported
JUMP = 2.0  # largest distance of neighboring states of a motion on constraints, in units of that on the straight line


class MotionCheck:
    """Collision check of straight motions between states at a spacing; a plain callable, without OMPL."""

    def __init__(self, checker: CollisionChecker, resolution: float = SEARCH_RESOLUTION) -> None:
        """Check by ``checker`` at a spacing of ``resolution`` [rad, max-norm]."""
        self.checker = checker
        self.resolution = resolution

    def __call__(self, a: ArrayLike, b: ArrayLike) -> bool:
        """Whether the motion from ``a`` to ``b`` is free, its end first; ``a`` is taken to be free."""
        return self.checker.first_collision(np.array([a, b]), self.resolution, start=False) is None


class MotionProof:
    """Proof of straight motions between states; a plain callable, without OMPL."""

    def __init__(self, checker: CollisionChecker) -> None:
        """Prove by ``checker``."""
        self.checker = checker

    def __call__(self, a: ArrayLike, b: ArrayLike) -> bool:
        """Whether the motion from ``a`` to ``b`` is proved free."""
        return bool(self.checker.prove(np.array([a, b]), tolerance=0.0))


class ConstrainedMotionCheck(MotionCheck):
    """Check of motions along the projection of straight lines onto constraints; a plain callable, without OMPL."""

    def __init__(
        self, checker: CollisionChecker, constraints: ConstraintSet, resolution: float = SEARCH_RESOLUTION
    ) -> None:
        """Check by ``checker`` at states of the manifold that are about ``resolution`` apart [rad, max-norm]."""
        super().__init__(checker, resolution)
        self.constraints = constraints

    def __call__(self, a: ArrayLike, b: ArrayLike) -> bool:
        """Whether the motion from ``a`` to ``b`` stays on the manifold and is free; ``a`` is taken to be free.

        A motion to ``a`` itself is none: OMPL's interpolation returns its start where it fails, and trees would get
        that state again and again.
        """
        if np.array_equal(a, b):
            return False
        states = self.states(np.asarray(a, float), np.asarray(b, float))
        return states is not None and self.checker.first_collision(states, self.resolution, start=False) is None

    def states(self, a: Array, b: Array) -> Array | None:
        """Return states of the motion, shape (N, dof), or None where the projections do not lead from ``a`` to ``b``.

        Their neighbors are at most ``JUMP`` times as far apart as those on the straight line.
        """
        count = max(1, int(np.ceil(np.abs(b - a).max() / self.resolution)))
        states = a + np.linspace(0.0, 1.0, count + 1)[:, None] * (b - a)
        states[-1] = b
        if count > 1:
            for few in (slice(count // 2, count // 2 + 1), slice(1, count)):  # most that fail do so in the middle
                found = self.constraints.project(states[few])
                if not found.ok.all():
                    return None
            states[1:-1] = found.states
        return states if np.abs(np.diff(states, axis=0)).max() <= JUMP * np.abs(b - a).max() / count else None

    def along(self, nodes: Array) -> Array | None:
        """Return the states of the motions between nodes, shape (N, dof), or None where one is no motion."""
        pieces = [nodes[:1]]
        for a, b in zip(nodes, nodes[1:], strict=False):
            states = self.states(a, b)
            if states is None:
                return None
            pieces.append(states[1:])
        return np.concatenate(pieces)


class StateValidityChecker(ob.StateValidityChecker):
    """OMPL state validity checker over a collision checker.

    No exception leaves it, since one would end the process inside OMPL: a fault makes states invalid and is
    kept in ``fault``, without OMPL's states (see ``forget_states``).
    """

    def __init__(
        self, si: ob.SpaceInformation, checker: CollisionChecker, constraints: ConstraintSet | None = None
    ) -> None:
        """Check states of ``si`` by ``checker``, and whether they satisfy constraints."""
        super().__init__(si)
        self.checker, self.constraints = checker, constraints
        self.dof = checker.robot.dof
        self.fault: BaseException | None = None

    def isValid(self, state: Any) -> bool:  # noqa: N802 - OMPL's name
        """Whether the state is free."""
        try:
            q = to_array(state, self.dof)
            return (self.constraints is None or self.constraints.is_satisfied(q)) and self.checker.is_free(q)
        except BaseException as error:
            state = None
            self.fault = self.fault or error
            return False

    def clearance(self, state: Any) -> float:
        """Return the least distance of all checked pairs at the state [m], 0 after a fault."""
        try:
            return self.checker.clearance(to_array(state, self.dof))
        except BaseException as error:
            state = None
            self.fault = self.fault or error
            return 0.0


class MotionValidator(ob.MotionValidator):
    """OMPL motion validator by its own check, as long as its own validity checker is the one that is set.

    ``setStateValidityChecker`` of OMPL leaves the motion validator as it is. So this one asks at each motion which
    checker the space information has; another one than its own is asked for states between both ends by OMPL's own
    motion validator, at the resolution of the space.

    No exception of its own check leaves it: it makes motions invalid and is kept in ``fault``.

    Attributes:
        check: Its own check of a straight motion between two free states.
        validity_checker: The checker that it stands for.
        stop: All motions are invalid once this holds.
        fault: First exception of its own check, or None.
    """

    def __init__(
        self, si: RobotSpaceInformation, check: MotionCheck | MotionProof, validity_checker: StateValidityChecker
    ) -> None:
        """Check motions of ``si``, in place of the motion validator that it has."""
        super().__init__(si)
        self.check: Callable[[Array, Array], bool] = check
        self.validity_checker = validity_checker
        self.stop: Callable[[], bool] = lambda: False
        self.dof = check.checker.robot.dof
        self.fault: BaseException | None = None
        self._si = ref(si)  # which owns this one
        self._discrete = si.getMotionValidator()

    @property
    def decides(self) -> bool:
        """Whether its own checker is the one that is set."""
        si = self._si()
        return si is not None and si.getStateValidityChecker() is self.validity_checker

    def checkMotion(self, first: Any, second: Any) -> bool:  # noqa: N802 - OMPL's name
        """Whether the straight motion between two states is free."""
        try:
            if self.stop():
                return False
            if self.decides:
                return self.check(values_of(first, self.dof), values_of(second, self.dof))
            between = self._between(first, second) if isinstance(self.check, ConstrainedMotionCheck) else None
        except BaseException as error:
            first = second = None
            self.fault = self.fault or error
            return False
        if between is None:
            return bool(self._discrete.checkMotion(first, second))
        si = self._si()
        return si is not None and len(between) > 0 and all(si.isValid(to_state(si, q)) for q in between[::-1])

    def _between(self, first: Any, second: Any) -> Array:
        """Return the states of a motion on the manifold after the first, shape (N, dof), none where it is none."""
        assert isinstance(self.check, ConstrainedMotionCheck)
        states = self.check.states(to_array(first, self.dof), to_array(second, self.dof))
        return np.empty((0, self.dof)) if states is None else states[1:]


class _Forwarding(ob.MotionValidator):
    def __init__(
        self, made: ob.SpaceInformation, si: ob.SpaceInformation, stop: Callable[[], bool], walks: bool
    ) -> None:  # fmt: skip
        super().__init__(made)
        self._si, self._stop = si, stop
        self._walk = made.getMotionValidator() if walks else None

    def checkMotion(self, first: Any, second: Any) -> bool:  # noqa: N802 - OMPL's name
        if self._stop() or not self._si.checkMotion(first, second):
            return False
        return self._walk is None or bool(self._walk.checkMotion(first, second))


def forwarding(
    si: ob.SpaceInformation, *, stop: Callable[[], bool] = lambda: False, walks: bool = False
) -> ob.SpaceInformation:
    """Return a space information of the same space, whose checkers accept at most what those of the given one accept.

    Args:
        si: The given one; its current checkers are asked.
        stop: No motion is valid once this holds.
        walks: Whether motions are valid only where states between their ends are, too, at the space's resolution.
    """
    made = ob.SpaceInformation(si.getStateSpace())
    made.setStateValidityChecker(lambda state: bool(si.isValid(state)))
    made.setMotionValidator(_Forwarding(made, si, stop, walks))
    made.setup()
    return made


@contextmanager
def motions_until(validator: MotionValidator, stop: Callable[[], bool]) -> Iterator[None]:
    """While the block runs, let all motions be invalid once ``stop`` holds.

    OMPL checks a termination condition between iterations only, and simplifies paths by counts: without valid motions,
    both soon end.
    """
    before = validator.stop
    validator.stop = lambda: stop() or before()
    try:
        yield
    finally:
        validator.stop = before


@dataclass(frozen=True)
class FullCheck:
    """Outcome of the full check of a path.

    Attributes:
        ok: Whether the path is a solution.
        reason: One sentence about the first fault found, empty when there is none.
        segment: Index of the segment (states k and k + 1) with the fault, or None.
        proof: The proof, or None where limits or ends are at fault. Where bodies overlap its pair is the deepest one.
        timed_out: Whether the time was over before the path was proved.
        constraints: Bounds on the violation of constraints along the path, or None without constraints.
    """

    ok: bool
    reason: str
    segment: int | None
    proof: PathProof | None = None
    timed_out: bool = False
    constraints: ConstraintCertificate | None = None

    __repr__ = fields_line

    def __bool__(self) -> bool:
        """Whether the path is a solution."""
        return self.ok


def full_check(
    checker: CollisionChecker,
    path: Array | Trajectory,
    start: Array | None = None,
    goals: Iterable[Array] = (),
    *,
    deadline: float | None = None,
    constraints: ConstraintSet | None = None,
) -> FullCheck:
    """Decide whether a path or a motion is a solution.

    It is one when it stays inside the limits, starts at ``start`` and ends at one of ``goals`` bit for bit, and is
    proved free from end to end (:meth:`apex_ompl.collision.CollisionChecker.prove`), and to keep constraints
    (:mod:`apex_ompl.constraints.proof`).

    Args:
        checker: Collision checker.
        path: States joined by straight lines, shape (N, dof), or a timed motion, which is proved along its own cubic
            pieces.
        start: The given start, shape (dof,), or None for any.
        goals: Goal states; none means any end.
        deadline: Value of ``time.perf_counter`` at which to give up [s].
        constraints: Constraints along the path, or None for none.

    Raises:
        ParameterError: ``path`` has not the shape (N, dof).
    """
    robot, goals = checker.robot, list(goals)
    motion = path if isinstance(path, Trajectory) else None
    states = number_array(path, "path") if motion is None else motion.positions
    check_states(states, robot.dof, "path", least=1)
    last = max(len(states) - 2, 0)
    if motion is not None and motion.use(robot.limits)["position"] > 1.0 + ROUNDING:
        return FullCheck(False, "the motion leaves the position limits", None)
    inside = ((states >= robot.limits.lower) & (states <= robot.limits.upper)).all(axis=1)
    if motion is None and not inside.all():
        k = int(np.argmin(inside))
        return FullCheck(False, f"state {k}: {robot.limit_fault(states[k])}", min(k, last))
    if start is not None and not np.array_equal(states[0], start):
        return FullCheck(False, "the path does not begin at the start", 0)
    if goals and not any(np.array_equal(states[-1], goal) for goal in goals):
        return FullCheck(False, "the path does not end at a goal", last)
    if deadline is not None and time.perf_counter() >= deadline:
        return FullCheck(False, "not proved in time", None, timed_out=True)
    kept: ConstraintCertificate | None = None
    if constraints is not None:
        from apex_ompl.constraints.proof import prove_motion, prove_path

        kept = prove_path(constraints, states) if motion is None else prove_motion(constraints, motion)
        if not kept:
            return FullCheck(False, kept.fault, None, constraints=kept)
    curve = Curve.polyline(states)
    if motion is not None:
        curve = Curve.cubic(motion.times, states, motion.velocities, motion.accelerations)
    proof = checker.prove(curve, share=CLEARANCE_SHARE, deadline=deadline)
    if proof:
        return FullCheck(True, "", None, proof, constraints=kept)
    if proof.timed_out:
        return FullCheck(False, proof.reason, None, proof, True)
    contacts = checker.contacts(proof.state) if np.isfinite(proof.state).all() and proof.clearance <= 0.0 else []
    reason = proof.reason
    if contacts:
        deepest = contacts[0]
        reason = str(deepest)
        proof = replace(proof, clearance=-deepest.depth, pair=(deepest.first, deepest.second))
    if motion is not None:
        return FullCheck(False, f"at {proof.parameter:.3f} s: {reason}", None, proof)
    lengths = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(states, axis=0)).max(axis=1))])
    segment = min(int(np.searchsorted(lengths, proof.parameter, side="right")) - 1, last)
    return FullCheck(False, f"between states {segment} and {segment + 1}: {reason}", segment, proof)
