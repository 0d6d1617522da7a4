"""Paths on the way to be valid: always the most promising one is improved next."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from numpy.typing import ArrayLike

from apex_ompl.kernel import Kernel
from apex_ompl.trajopt.optimizer import LAST_RESORT, Check, Optimizer
from apex_ompl.types import Array

ROUND, ROUNDS = 4, 12  # steps between two checks of a path, and how often
SOFT_ROUNDS = 2  # the last of them are softer
IMPATIENCE = 2.0  # factor on the clearance_cost of a path for every round that was spent on it
PER_PATH = 16  # steps, in the mean
CLEAR = 0.01  # clearance at the samples at which a path is checked at once [m]
NEARLY = -0.005  # below it a path that is worked on is not checked yet; spheres reach out of what they cover [m]


@dataclass
class Candidate:
    """A path that is worked on.

    Attributes:
        control: Control points, shape (points, dof).
        origin: Where it comes from.
        clearance_cost: Its cost that is due to clearance.
        clearance: Smallest clearance at the samples [m].
        damping: Of the next step.
        rounds: How often it was worked on.
        fine: Whether more samples are looked at.
        given_up: Whether nothing more comes of it.
    """

    control: Array
    origin: str
    clearance_cost: float
    clearance: float
    damping: float
    rounds: int = 0
    fine: bool = False
    given_up: bool = False

    @property
    def hope(self) -> float:
        """What is least for the candidate to be improved next."""
        return self.clearance_cost * IMPATIENCE**self.rounds


class CandidatePool:
    """Candidates for a valid path among the obstacles of a kernel.

    All are checked as they come. Then always the candidate with the least clearance cost is improved by a few steps,
    one that was worked on before a little later than a fresh one; as soon as it is nearly clear at the samples it is
    checked again. One that is clear at them and yet not valid is looked at more closely. The last steps for a candidate
    are softer.

    Attributes:
        candidates: All that there are.
        steps: Steps that were taken.
    """

    def __init__(
        self, optimizer: Optimizer, kernel: Kernel, is_valid: Check,
        is_wanted: Callable[[Candidate, Array], bool] = lambda candidate, path: True,
    ) -> None:  # fmt: skip
        """Let ``is_valid`` decide about the states of paths.

        Args:
            optimizer: Improves them.
            kernel: The robot among its obstacles.
            is_valid: Decides; called with the states of a path.
            is_wanted: Asked about valid ones, with the states; nothing more is done for those that are not.
        """
        self._optimizer, self._kernel, self._is_valid, self._is_wanted = optimizer, kernel, is_valid, is_wanted
        self._fine = optimizer.finer()
        self.candidates: list[Candidate] = []
        self.steps = 0

    def add(self, control: ArrayLike, origin: str = "", stop: Callable[[], bool] = lambda: False) -> Candidate | None:
        """Take in paths, control points of shape (B, points, dof), and return the first that is valid as it is.

        Raises:
            ParameterError: Control points of another shape.
        """
        improved = self._optimizer.improve(self._kernel, control, steps=0)
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

    def work(self, steps: int, stop: Callable[[], bool] = lambda: False) -> Candidate | None:
        """Improve candidates until one is valid, by at most so many steps in all.

        Args:
            steps: Most steps.
            stop: Asked between rounds whether to give up.

        Returns:
            The valid one, or None.
        """
        left, settings = steps, self._optimizer.settings
        while left > 0 and not stop():
            hopeful = (one for one in self.candidates if one.rounds < ROUNDS and not one.given_up)
            chosen = min(hopeful, key=lambda one: one.hope, default=None)
            if chosen is None:
                break
            soft = chosen.rounds >= ROUNDS - SOFT_ROUNDS
            optimizer = self._fine if chosen.fine else self._optimizer
            improved = optimizer.improve(
                self._kernel, chosen.control[None], steps=ROUND, damping=chosen.damping, enough=CLEAR,
                stiffness=(LAST_RESORT if soft else 1.0) * settings.stiffness,
            )  # fmt: skip
            chosen.control, chosen.clearance_cost = improved.control[0], float(improved.clearance_cost[0])
            chosen.clearance, chosen.damping = float(improved.clearance[0].min()), float(improved.damping[0])
            chosen.rounds += 1
            left -= ROUND
            self.steps += int(improved.steps[0])
            if chosen.clearance >= NEARLY and self._passes(chosen):
                return chosen
            if not improved.steps[0]:  # nothing is short of clearance, and yet it is not valid
                chosen.given_up, chosen.fine = chosen.fine, True
        return None

    def _passes(self, candidate: Candidate) -> bool:
        path = self._optimizer.spline.path(candidate.control)
        if not self._is_valid(path):
            return False
        candidate.given_up = not self._is_wanted(candidate, path)
        return not candidate.given_up


def first_valid(
    optimizer: Optimizer, kernel: Kernel, control: ArrayLike, is_valid: Check,
    stop: Callable[[], bool] = lambda: False,
) -> Array | None:  # fmt: skip
    """Return control points, shape (points, dof), of the first of some paths that comes out valid, or None.

    Args:
        optimizer: Improves them, by ``PER_PATH`` steps for each and some more.
        kernel: The robot among its obstacles.
        control: Where to start from, shape (B, points, dof).
        is_valid: Decides; called with the states of a path.
        stop: Asked between rounds whether to give up.

    Raises:
        ParameterError: Control points of another shape.
    """
    pool = CandidatePool(optimizer, kernel, is_valid)
    found = pool.add(control, stop=stop) or pool.work(PER_PATH * (len(pool.candidates) + 2), stop)
    return None if found is None else found.control
