"""Units of work: problems of a level that are drawn, solved and stored together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from apex_ompl.errors import ParameterError, UnknownNameError
from apex_ompl.problems import scenes
from apex_ompl.problems.broad import GRAMMARS
from apex_ompl.problems.catalogue import KNOWN, LEVELS, SPLITS, TRAINING, VALIDATION

UNIT_SIZE = 16  # problems in a unit of work


@dataclass(frozen=True)
class Unit:
    """Unit of work: problems that are solved together, and whose paths are stored as one file.

    Attributes:
        suite: A suite, ``broad`` and ``unseen`` included.
        level: One of its levels.
        number: Index of the unit among those of the level.
        size: Number of problems that are drawn.
        split: Split of the problems' seeds.
    """

    suite: str
    level: str
    number: int
    size: int = UNIT_SIZE
    split: str = "train"

    @property
    def name(self) -> str:
        """Name of the unit, for example ``shelf-hard-00012``."""
        return f"{self.suite}-{self.level}-{self.number:05d}"

    @property
    def strategy(self) -> str:
        """How its problems are solved, a key of ``apex_ompl.training.engine.STRATEGIES``."""
        if self.suite in scenes.SUITES:
            return self.level
        return "broad" if self.level in GRAMMARS.get(self.suite, ()) else "open"

    @property
    def seeds(self) -> range:
        """Seeds of its problems."""
        return SPLITS[self.split][self.number * self.size :][: self.size]


LEVEL_WEIGHTS = {
    "extreme": 0.1, "vertical": 1.2, "horizontal": 1.2, "easy": 1.0, "medium": 0.8, "hard": 0.4,
}  # fmt: skip
"""Relative number of problems drawn of a level, by level or by suite: fewer where one takes longer."""

BROAD_SHARE = 2.0 / 3.0
"""Share of the levels of ``broad``, all alike, in problems of all suites."""


def static_levels(split: str = "train") -> list[tuple[str, str]]:
    """Return suite and level of all static levels with problems of a split."""
    known = {**LEVELS, **TRAINING} if split == "train" else KNOWN
    return [(s, level) for s, levels in known.items() for level in levels if not level.startswith("moving-")]


def level_weight(suite: str, level: str, split: str = "train") -> float:
    """Return the relative number of problems drawn of a level."""
    if suite in LEVELS:
        return LEVEL_WEIGHTS[level if level in LEVEL_WEIGHTS else suite]
    others = sum(level_weight(s, v, split) for s, v in static_levels(split) if s in LEVELS)
    return others * BROAD_SHARE / (1.0 - BROAD_SHARE) / len(KNOWN[suite])


def plan_units(count: int, only: Sequence[str] = (), split: str = "train") -> list[Unit]:
    """Return units of about ``count`` problems over all static suites and levels, the levels in turn.

    Args:
        count: Number of problems to draw, about.
        only: Suites, or ``suite/level``; none means all.
        split: Split of the problems.

    Raises:
        UnknownNameError: There is no such suite or level.
        ParameterError: Training problems are asked for of a suite that is for validation only.
    """
    for name in only:
        if split == "train" and name.partition("/")[0] in VALIDATION:
            reason = f"a suite for training: {name.partition('/')[0]} is for validation only"
            raise ParameterError("SUITE[/LEVEL]", name, reason)
    known = static_levels(split)
    for name in only:
        if name not in {s for s, _ in known} | {f"{s}/{level}" for s, level in known}:
            raise UnknownNameError("static suite or level", name, [f"{s}/{level}" for s, level in known])
    chosen = [(s, v) for s, v in known if not only or s in only or f"{s}/{v}" in only]
    weights = [level_weight(s, v, split) for s, v in chosen]
    found = [
        (k / weight, index, Unit(s, v, k, split=split))
        for index, ((s, v), weight) in enumerate(zip(chosen, weights, strict=True))
        for k in range(max(1, round(count * weight / sum(weights) / UNIT_SIZE)))
        if (k + 1) * UNIT_SIZE <= len(SPLITS[split])
    ]
    return [unit for *_, unit in sorted(found, key=lambda row: row[:2])]
