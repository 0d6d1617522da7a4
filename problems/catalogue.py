"""The suites that planners are judged on: their levels, and their problems by seed."""

from __future__ import annotations

import re
import zlib
from dataclasses import dataclass

import numpy as np

from apex_ompl.errors import ApexError, UnknownNameError
from apex_ompl.problems import alignment, broad, scenes
from apex_ompl.problems.outline import Outline
from apex_ompl.problems.reach import HandPoses, robot
from apex_ompl.scene.problem import Problem
from apex_ompl.util.validation import check_integer

SPLITS = {"train": range(800_000), "validation": range(800_000, 900_000), "test": range(900_000, 1_000_000)}
SYNERGIES = (0.0, 0.4)  # range of the hands where they hold nothing
MOST_DRAWS = 300  # scenes drawn before a seed is given up

MOVING = tuple(f"moving-{size}-{speed}" for size in alignment.SIZES for speed in alignment.SPEEDS)
LEVELS: dict[str, tuple[str, ...]] = {
    **dict.fromkeys(alignment.HOLDINGS, ("free", *alignment.STATIC, *MOVING)),
    **dict.fromkeys(scenes.SUITES, scenes.LEVELS),
}
"""Suite -> its levels."""

TRAINING = {broad.SUITE: broad.LEVELS}
"""Problems of no suite that training draws on -> their levels; none of them is frozen."""

KNOWN = {**LEVELS, **TRAINING}

ID = re.compile(r"([A-Za-z_]+)/([A-Za-z0-9_.-]+)/(0|[1-9][0-9]{0,19})")


class SuiteError(ApexError):
    """A problem of a suite that cannot be drawn."""


@dataclass(frozen=True)
class ProblemId:
    """Which problem of which suite.

    Attributes:
        suite: For example ``shelf``.
        level: For example ``hard``.
        seed: 0 to 999 999; it says to which split the problem belongs.
    """

    suite: str
    level: str
    seed: int

    def __post_init__(self) -> None:
        """Check the parts.

        Raises:
            UnknownNameError: No such suite or level.
            ParameterError: The seed is none.
        """
        if not isinstance(self.suite, str) or self.suite not in KNOWN:
            raise UnknownNameError("suite", str(self.suite), KNOWN)
        if not isinstance(self.level, str) or self.level not in KNOWN[self.suite]:
            raise UnknownNameError(f"level of {self.suite}", str(self.level), KNOWN[self.suite])
        check_integer(self.seed, "seed", 0, SPLITS["test"].stop - 1)

    def __str__(self) -> str:
        """Return the name of the problem, ``suite/level/seed``."""
        return f"{self.suite}/{self.level}/{self.seed}"

    @property
    def split(self) -> str:
        """The split that the seed belongs to."""
        return next(name for name, seeds in SPLITS.items() if self.seed in seeds)

    @classmethod
    def parse(cls, text: str) -> ProblemId | None:
        """Return what a name of the form ``suite/level/seed`` stands for, or None for names of another form.

        The seed has no leading zeros: a problem has one name.

        Raises:
            UnknownNameError: No such suite or level.
            ParameterError: The seed is none.
        """
        match = ID.fullmatch(text)
        return None if match is None else cls(match[1], match[2], int(match[3]))


def draw(which: ProblemId, number: int) -> Outline | None:
    """Return draw ``number`` of a problem, or None when that one does not work out."""
    group = zlib.crc32(f"{which.suite}/{which.level}".encode())
    rng = np.random.default_rng([group, which.seed, number])
    if which.suite in alignment.HOLDINGS:
        return alignment.draw(rng, which.suite, which.level)
    if which.suite == broad.SUITE:
        return broad.draw(rng, which.level, SYNERGIES)
    draft = scenes.SUITES[which.suite](rng, which.level)
    poses = HandPoses(draft.scene)
    start = poses.draw(rng, draft.start, SYNERGIES)
    goal = None if start is None else poses.draw(rng, draft.goal, SYNERGIES)
    return None if start is None or goal is None else Outline(draft.scene, start, goal)


def first_draw(which: ProblemId, after: int = -1) -> tuple[int, Problem]:
    """Return the first draw behind a number that works out, and its number.

    Raises:
        SuiteError: None does.
    """
    for number in range(after + 1, MOST_DRAWS):
        outline = draw(which, number)
        if outline is not None:
            return number, outline.problem(str(which), robot())
    raise SuiteError(f"problem {which}: none of {MOST_DRAWS} draws has a start and a goal")
