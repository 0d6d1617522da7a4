"""Candidate paths, repaired by the optimizer in order of priority."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

from numpy.typing import ArrayLike

from apex_ompl.kernel import Kernel
from apex_ompl.paths.optimizer import LAST_RESORT, Check, Optimizer
from apex_ompl.types import Array
from apex_ompl.util.display import fields_line

ROUND, ROUNDS = 4, 12  # optimizer steps in a round of repair, and rounds a candidate has at most
SOFT_ROUNDS = 2  # the last rounds, with still less weight on the speed term
ROUGH_ROUNDS = 2  # the first rounds, among primitives that approximate the obstacles
REPAIR_STIFFNESS = 0.3  # factor on the settings' stiffness in repair, where clearance matters more than length
PENALTY = 3.0  # factor on the priority of a candidate for every round spent on it
STEPS_PER_PATH = 16  # on average
CLEAR = 0.005  # clearance at the samples at which a round ends early [m]
MIN_CLEARANCE = -0.005  # at the samples, for the full check; spheres protrude from the bodies they cover [m]


@dataclass
class Candidate:
    """A path under repair.

    Attributes:
        control: Control points, shape (points, dof).
        origin: Name of its source.
        clearance_cost: Part of its cost that is due to clearance.
        clearance: Smallest clearance at the samples [m].
        damping: Damping of the next step.
        rounds: Number of rounds of repair that it had.
        exact: Whether repair is among the obstacles, and no longer among primitives that approximate them.
        fine: Whether it is sampled more densely.
        given_up: Whether it is not repaired any further.
    """

    control: Array
    origin: str
    clearance_cost: float
    clearance: float
    damping: float
    rounds: int = 0
    exact: bool = False
    fine: bool = False
    given_up: bool = False

    __repr__ = fields_line

    @property
    def priority(self) -> float:
        """Clearance cost times PENALTY for every round of repair; the candidate with the least is improved next."""
        return self.clearance_cost * PENALTY**self.rounds


class CandidatePool:
    """Candidates for a valid path among the obstacles of a kernel.

    Candidates are checked when they are added. Repair improves the one with the least priority value by a few
    optimizer steps, and checks it again as soon as it is nearly clear at its samples. A candidate that is clear at the
    samples and still invalid is sampled more densely. In the last rounds of a candidate the speed term counts less.
    Where there are primitives that approximate the obstacles, the first costs and rounds of repair are among these. A
    candidate goes on among the obstacles once it is clear there, or after ``ROUGH_ROUNDS``.

    Attributes:
        candidates: All candidates.
        steps: Number of optimizer steps taken.
    """

    def __init__(
        self, optimizer: Optimizer, kernel: Kernel, is_valid: Check,
        is_wanted: Callable[[Candidate, Array], bool] = lambda candidate, path: True, *,
        collides: Check = lambda path: False, rough: Callable[[], Kernel | None] = lambda: None,
    ) -> None:  # fmt: skip
        """Start an empty pool.

        Args:
            optimizer: Improves them.
            kernel: The robot among its obstacles.
            is_valid: Full check; called with the states of a path.
            is_wanted: Further condition on valid candidates; those that fail it are not repaired any further.
            collides: Quick test that proves a candidate invalid, for those that are not clear at their samples.
            rough: Returns the robot among primitives that approximate its obstacles, if there are any; called once,
                when there are candidates.
        """
        self._optimizer, self._kernel, self._is_valid, self._is_wanted = optimizer, kernel, is_valid, is_wanted
        self._collides, self._make_rough = collides, rough
        self._fine, self._coarse = optimizer.finer(), optimizer.coarser()
        self.candidates: list[Candidate] = []
        self.steps = 0

    @cached_property
    def _rough(self) -> Kernel | None:
        return self._make_rough()

    def add(self, control: ArrayLike, origin: str = "", stop: Callable[[], bool] = lambda: False) -> Candidate | None:
        """Add paths, control points of shape (B, points, dof), and return the first that is valid as it is.

        Raises:
            ParameterError: Control points of another shape.
        """
        improved = self._coarse.improve(self._rough or self._kernel, control, steps=0)
        numbers = zip(
            improved.control, improved.clearance_cost, improved.clearance.min(axis=1), improved.damping, strict=True
        )
        fresh = [Candidate(c.copy(), origin, float(s), float(d), float(m)) for c, s, d, m in numbers]
        self.candidates += fresh
        for candidate in sorted(fresh, key=lambda one: one.clearance_cost):
            if stop():
                break
            if self._passes(candidate):
                return candidate
        return None

    def improve(self, steps: int, stop: Callable[[], bool] = lambda: False) -> Candidate | None:
        """Improve candidates until one is valid.

        Args:
            steps: Largest total number of steps.
            stop: Called between rounds; True ends the search.

        Returns:
            The valid candidate, or None.
        """
        left, settings = steps, self._optimizer.settings
        while left > 0 and not stop():
            open_candidates = (one for one in self.candidates if one.rounds < ROUNDS and not one.given_up)
            chosen = min(open_candidates, key=lambda one: one.priority, default=None)
            if chosen is None:
                break
            soft = chosen.rounds >= ROUNDS - SOFT_ROUNDS
            optimizer = self._fine if chosen.fine else self._optimizer
            rough = None if chosen.exact else self._rough
            improved = optimizer.improve(
                rough or self._kernel, chosen.control[None], steps=ROUND, damping=chosen.damping, enough=CLEAR,
                stiffness=(LAST_RESORT if soft else REPAIR_STIFFNESS) * settings.stiffness,
            )  # fmt: skip
            chosen.control, chosen.clearance_cost = improved.control[0], float(improved.clearance_cost[0])
            chosen.clearance, chosen.damping = float(improved.clearance[0].min()), float(improved.damping[0])
            chosen.rounds += 1
            left -= ROUND
            self.steps += int(improved.steps[0])
            if chosen.clearance >= MIN_CLEARANCE and self._passes(chosen):
                return chosen
            if rough is not None:
                clear = chosen.clearance >= MIN_CLEARANCE or not improved.steps[0]
                chosen.exact = clear or chosen.rounds >= ROUGH_ROUNDS
            elif not chosen.given_up and not improved.steps[0]:  # no sample violates a margin, and yet it is invalid
                chosen.given_up, chosen.fine = chosen.fine, True
        return None

    def _passes(self, candidate: Candidate) -> bool:
        path = self._optimizer.spline.path(candidate.control)
        if candidate.clearance < MIN_CLEARANCE and self._collides(path):
            return False
        if not self._is_valid(path):
            return False
        candidate.given_up = not self._is_wanted(candidate, path)
        return not candidate.given_up


def first_valid(
    optimizer: Optimizer, kernel: Kernel, control: ArrayLike, is_valid: Check,
    stop: Callable[[], bool] = lambda: False,
) -> Array | None:  # fmt: skip
    """Return control points, shape (points, dof), of the first path that is valid after repair, or None.

    Args:
        optimizer: Improves them, by ``STEPS_PER_PATH`` steps for each path and for two more.
        kernel: The robot among its obstacles.
        control: Initial control points, shape (B, points, dof).
        is_valid: Full check; called with the states of a path.
        stop: Called between rounds; True ends the search.

    Raises:
        ParameterError: Control points of another shape.
    """
    pool = CandidatePool(optimizer, kernel, is_valid)
    found = pool.add(control, stop=stop) or pool.improve(STEPS_PER_PATH * (len(pool.candidates) + 2), stop)
    return None if found is None else found.control
