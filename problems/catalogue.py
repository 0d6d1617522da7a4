"""The suites and their levels, the splits of seeds, and the ids of problems."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from apex_ompl.errors import ParameterError
from apex_ompl.problems import ID, alignment, broad, scenes
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
"""Every suite -> its levels."""


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
        check_name(self.level, f"level of {self.suite}", KNOWN[self.suite])
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
