"""Statistics of a data set."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apex_ompl.training.records import SOURCES, Paths
from apex_ompl.types import Array

DUPLICATE_CONTROL_DISTANCE = 0.1  # control points nearer than this make a duplicate [rad, max-norm]


@dataclass(frozen=True)
class LevelStatistics:
    """Statistics of a level, or of all levels together.

    Attributes:
        name: ``suite/level``, or ``all``.
        problems: Number of problems.
        paths: Number of paths.
        sources: Number of paths by source.
        straight: Share of the problems that the straight line solves, of which the engine keeps few.
        homotopies: Mean number of homotopy classes found of a problem that the straight line does not solve.
        several: Share of those problems with more than one class.
        duplicates: Number of paths nearly equal to an earlier one with the same ends.
        length: 5th, 50th and 95th percentile of the length [rad].
        clearance: 5th, 50th and 95th percentile of the sphere cover's clearance [m].
    """

    name: str
    problems: int
    paths: int
    sources: dict[str, int]
    straight: float
    homotopies: float
    several: float
    duplicates: int
    length: tuple[float, ...]
    clearance: tuple[float, ...]


def level_statistics(paths: Paths) -> list[LevelStatistics]:
    """Return the statistics of each level of a set, and of all levels together as the last."""
    names = np.array([paths.problem_name(k).rsplit("/", 1)[0] for k in range(paths.problems)])
    twins = duplicates(paths)
    found = [_statistics(paths, str(name), np.flatnonzero(names == name), twins) for name in sorted(set(names))]
    return [*found, _statistics(paths, "all", np.arange(paths.problems), twins)]


def _statistics(paths: Paths, name: str, problems: NDArray[np.intp], twins: NDArray[np.bool_]) -> LevelStatistics:
    """Return the statistics of some problems, given by their indices."""
    a = paths.arrays
    mine = np.isin(a["problem"], problems)
    source, owner = a["source"][mine], a["problem"][mine]
    straight = set(owner[source == SOURCES.index("line")].tolist())
    from_start = np.isin(source, [SOURCES.index(s) for s in ("bumps", "rrtconnect", "model")])
    classes = Counter(
        k for k, _ in set(zip(owner[from_start].tolist(), a["homotopy"][mine][from_start].tolist(), strict=True))
    )
    return LevelStatistics(
        name=name, problems=len(problems), paths=int(mine.sum()),
        sources={s: int((source == k).sum()) for k, s in enumerate(SOURCES)},
        straight=len(straight) / max(1, len(problems)),
        homotopies=float(np.mean(list(classes.values()))) if classes else 0.0,
        several=float(np.mean([n > 1 for n in classes.values()])) if classes else 0.0,
        duplicates=int(twins[mine].sum()), length=_percentiles(a["length"][mine]),
        clearance=_percentiles(a["clearance"][mine]),
    )  # fmt: skip


def duplicates(paths: Paths) -> NDArray[np.bool_]:
    """Return which paths have an earlier one with the same ends and nearly the same control points, shape (N,)."""
    a = paths.arrays
    groups: dict[tuple[int, bytes, bytes], list[int]] = {}
    twins = np.zeros(len(paths), bool)
    for k in range(len(paths)):
        key = int(a["problem"][k]), a["start"][k].tobytes(), a["goal"][k].tobytes()
        others = groups.setdefault(key, [])
        mine = a["control"][k].astype(float)
        twins[k] = any(
            float(np.abs(mine - a["control"][o].astype(float)).max()) < DUPLICATE_CONTROL_DISTANCE for o in others
        )
        others.append(k)
    return twins


def coverage(paths: Paths, lower: Array, upper: Array, most: int = 2000) -> Array:
    """Return the 1st, 50th and 99th percentile of the states in each joint's range, shape (3, dof) in 0..1.

    Args:
        paths: The paths.
        lower: Lower limits, shape (dof,) [rad].
        upper: Upper limits, shape (dof,) [rad].
        most: Largest number of paths looked at, evenly spread over the set.
    """
    which = np.unique(np.linspace(0, len(paths) - 1, most).astype(int))
    states = paths.spline.path(paths.control(which)).reshape(-1, len(lower))
    return np.asarray((np.percentile(states, (1, 50, 99), axis=0) - lower) / (upper - lower))


def _percentiles(values: Sequence[float] | NDArray[np.float32]) -> tuple[float, ...]:
    return tuple(float(v) for v in np.percentile(values, (5, 50, 95))) if len(values) else (float("nan"),) * 3
