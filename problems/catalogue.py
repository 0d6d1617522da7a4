"""The suites and their levels, the splits of seeds, the ids of problems, and the drawing of a problem by its id.

One id gives the same problem on every machine and in every process.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from apex_ompl.errors import ApexError, ParameterError
from apex_ompl.goals.state_sampling import HandPoseSampler
from apex_ompl.problems import ID, alignment, broad, constrained, scenes
from apex_ompl.problems.broad import GRAMMARS, SUITE
from apex_ompl.problems.robot_cells import standard_cell
from apex_ompl.problems.suite_robot import MARGIN, DrawnProblem, robot
from apex_ompl.scene.problem import Problem
from apex_ompl.util.validation import check_name

SPLITS = {"train": range(800_000), "validation": range(800_000, 900_000), "test": range(900_000, 1_000_000)}

MOVING = tuple(f"moving-{size}-{speed}" for size in alignment.SIZES for speed in alignment.SPEEDS)
LEVELS: dict[str, tuple[str, ...]] = {
    **dict.fromkeys(alignment.SAMPLERS, ("free", *alignment.STATIC, *MOVING)),
    **scenes.LEVELS,
}
"""Suite of the benchmarks -> its levels."""

TRAINING = {broad.SUITE: broad.LEVELS[broad.SUITE]}
"""Suite for training only -> its levels; none of its problems is frozen."""

VALIDATION = {broad.UNSEEN: broad.LEVELS[broad.UNSEEN]}
"""Suite for validation only -> its levels; none of its problems is drawn for training."""

KNOWN = {**LEVELS, **TRAINING, **VALIDATION}
"""Every suite -> its levels without constraints."""

CONSTRAINED = constrained.LEVELS
"""Suite -> its levels with constraints; those of ``unseen`` are for validation only."""


def levels_of(suite: str) -> tuple[str, ...]:
    """Return all levels of a suite, those with constraints included."""
    return (*KNOWN[suite], *CONSTRAINED.get(suite, ()))


@dataclass(frozen=True)
class ProblemId:
    """Id of a problem of a suite.

    Attributes:
        suite: For example ``shelf``.
        level: For example ``hard``.
        seed: 0 to 999 999; the split of the problem follows from it, see ``SPLITS``.
    """

    suite: str
    level: str
    seed: int

    def __post_init__(self) -> None:
        """Check suite, level and seed.

        Raises:
            UnknownNameError: No such suite or level.
            ParameterError: The seed is not a whole number from 0 to 999 999, or not a validation seed where the suite
                is for validation alone.
        """
        check_name(self.suite, "suite", KNOWN)
        check_name(self.level, f"level of {self.suite}", levels_of(self.suite))
        is_integer = isinstance(self.seed, (int, np.integer)) and not isinstance(self.seed, bool)
        if not is_integer or not 0 <= self.seed < SPLITS["test"].stop:
            raise ParameterError("seed", self.seed, f"a whole number from 0 to {SPLITS['test'].stop - 1}")
        allowed = SPLITS["validation"]
        if self.suite in VALIDATION and self.seed not in allowed:
            wanted = f"{allowed.start} to {allowed.stop - 1}: {self.suite} is for validation only, never for training"
            raise ParameterError("seed", self.seed, wanted)

    def __str__(self) -> str:
        """Return the name of the problem, ``suite/level/seed``."""
        return f"{self.suite}/{self.level}/{self.seed}"

    @property
    def split(self) -> str:
        """The split that the seed belongs to."""
        return next(name for name, seeds in SPLITS.items() if self.seed in seeds)

    @classmethod
    def parse(cls, text: str) -> ProblemId | None:
        """Return the id that a text of the form ``suite/level/seed`` names, or None for another form.

        The seed has no leading zeros, so that a problem has a single name.

        Raises:
            UnknownNameError: No such suite or level.
            ParameterError: The seed is not a whole number from 0 to 999 999.
        """
        match = ID.fullmatch(text)
        return None if match is None else cls(match[1], match[2], int(match[3]))


SYNERGIES = (0.0, 0.4)  # interval of the synergies of empty hands
MAX_DRAWS = 300  # for one id, before it is abandoned


class SuiteError(ApexError):
    """A problem of a suite that cannot be drawn."""


def draw(problem_id: ProblemId, number: int) -> DrawnProblem | None:
    """Return draw ``number`` of a problem, or None when that draw has no start or no goal."""
    level_hash = zlib.crc32(f"{problem_id.suite}/{problem_id.level}".encode())
    rng = np.random.default_rng([level_hash, problem_id.seed, number])
    if problem_id.level in CONSTRAINED.get(problem_id.suite, ()):
        return constrained.draw(rng, problem_id.suite, problem_id.level, problem_id.seed)
    if problem_id.suite in alignment.SAMPLERS:
        return alignment.draw(rng, problem_id.suite, problem_id.level)
    if problem_id.suite == SUITE and problem_id.level in broad.SIMPLE_LEVELS:
        return broad.draw_simple(rng, problem_id.level, SYNERGIES)
    if problem_id.suite in GRAMMARS:
        return broad.draw(rng, problem_id.suite, problem_id.level)
    task = scenes.SUITES[problem_id.suite](rng, problem_id.level)
    poses = HandPoseSampler(standard_cell().tables, task.scene, MARGIN)
    start = poses.sample(rng, task.start, SYNERGIES)
    goal = None if start is None else poses.sample(rng, task.goal, SYNERGIES)
    return None if start is None or goal is None else DrawnProblem(task.scene, start, goal)


@lru_cache(maxsize=64)
def _first_drawn(problem_id: ProblemId, after: int) -> tuple[int, DrawnProblem]:
    for number in range(after + 1, MAX_DRAWS):
        drawn = draw(problem_id, number)
        if drawn is not None:
            return number, drawn
    raise SuiteError(f"problem {problem_id}: none of {MAX_DRAWS} draws has a start and a goal")


def first_drawn(problem_id: ProblemId, after: int = -1) -> tuple[int, DrawnProblem]:
    """Return number and drawn problem of the first draw after ``after`` that has a start and a goal.

    The last results are cached.

    Raises:
        SuiteError: None of the first ``MAX_DRAWS`` draws has.
    """
    return _first_drawn(problem_id, after)  # one form of the arguments, which are the key of the cache


def first_draw(problem_id: ProblemId, after: int = -1) -> tuple[int, Problem]:
    """Return the number and the problem of the first draw after ``after`` that has a start and a goal.

    Raises:
        SuiteError: None of the first ``MAX_DRAWS`` draws has.
    """
    number, drawn = first_drawn(problem_id, after)
    return number, drawn.to_problem(str(problem_id), robot())
