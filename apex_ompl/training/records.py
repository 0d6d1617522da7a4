"""Records of a data set: verified paths and the problems that they solve, as arrays, with their statistics."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from apex_ompl.errors import ApexError
from apex_ompl.model.geometry import HeldExtent
from apex_ompl.paths.spline import Spline
from apex_ompl.types import Array
from apex_ompl.util.display import counted, one_line

MICRO = 1e-6  # states are stored in whole microradians; the suites draw states of six decimals
SOURCES = ("line", "perturbation", "rrtconnect", "reversed", "part", "model")
"""Origins of a path: the straight line; optimization from random perturbations of it; rrtconnect and optimization; the
reversal of another path; a part of another path between two of its states; optimization from a model's proposal."""

PROBLEM_FIELDS: dict[str, tuple[Any, tuple[int, ...]]] = {
    "seed": (np.int32, ()), "suite": (np.uint8, ()), "level": (np.uint8, ()), "held": (np.uint32, ()),
    "things": (np.uint16, ()),
}  # fmt: skip
OBSTACLE_FIELDS: dict[str, tuple[Any, tuple[int, ...]]] = {
    "shape": (np.uint8, ()), "position": (np.float32, (3,)), "orientation": (np.float32, (4,)),
    "size": (np.float32, (3,)),
}  # fmt: skip
PATH_FIELDS: dict[str, tuple[Any, tuple[int, ...]]] = {
    "problem": (np.int32, ()), "start": (np.int32, (-1,)), "goal": (np.int32, (-1,)),
    "control": (np.float16, (-1, -1)), "point": (np.float32, (3,)), "clearance": (np.float32, ()),
    "length": (np.float32, ()), "source": (np.uint8, ()), "homotopy": (np.uint8, ()),
}  # fmt: skip
FIELDS = {**PROBLEM_FIELDS, **OBSTACLE_FIELDS, **PATH_FIELDS}
SPLINE = ("points", "pinned", "states", "degree")
DUPLICATE_CONTROL_DISTANCE = 0.1  # control points nearer than this make a duplicate [rad, max-norm]


class DatasetError(ApexError):
    """A data set cannot be read or written as asked."""


@dataclass(frozen=True, eq=False)
class Paths:
    """Verified paths, and the problems that they solve, as arrays.

    Attributes:
        arrays: For each problem, ``suite`` and ``level`` (indices into ``names``), ``seed``, ``held`` (an index into
            ``names``: the held objects), and ``things``, the number of obstacles. For each obstacle, in the order of
            the problems, ``shape`` (an index into :data:`SHAPES`), ``position`` [m], ``orientation`` (xyzw) and
            ``size`` [m]. For each path, the index of its ``problem``, ``start`` and ``goal`` [1e-6 rad], free
            ``control`` points [rad], the obstacle ``point`` nearest to the robot at the start [m], ``clearance`` [m]
            and ``length`` [rad], ``source`` (an index into :data:`SOURCES`), and ``homotopy``, the class of the path
            among those of its problem: paths of one class can be deformed into each other along straight lines.
        names: Texts that indices stand for: ``suite``, ``level``, ``held`` (JSON).
        about: Robot and spline of the paths: ``robot``, ``joints``, and the fields of their :class:`Spline`.
        counts: Statistics of the generation, by name.
    """

    arrays: Mapping[str, NDArray[Any]]
    names: Mapping[str, tuple[str, ...]]
    about: Mapping[str, Any]
    counts: Mapping[str, Any] = field(default_factory=dict)

    def __repr__(self) -> str:
        """Return the numbers of paths and problems."""
        return one_line("Paths", f"{counted(len(self), 'path')} of {counted(self.problems, 'problem')}")

    def __post_init__(self) -> None:
        """Check that the arrays fit each other.

        Raises:
            DatasetError: They do not.
        """
        fault = arrays_fault(self.arrays) or about_fault(self.about, self.arrays)
        if fault:
            raise DatasetError(f"data set: {fault}")

    def __len__(self) -> int:
        """Return the number of paths."""
        return len(self.arrays["problem"])

    @property
    def problems(self) -> int:
        """Number of problems."""
        return len(self.arrays["seed"])

    @property
    def start(self) -> Array:
        """Start of each path, shape (N, dof) [rad]."""
        return from_micro(self.arrays["start"])

    @property
    def goal(self) -> Array:
        """Goal of each path, shape (N, dof) [rad]."""
        return from_micro(self.arrays["goal"])

    @property
    def spline(self) -> Spline:
        """Spline of the control points."""
        return Spline(**{key: self.about[key] for key in SPLINE})

    def control(self, which: Any = slice(None)) -> Array:
        """Return the control points of paths, fixed ones included, shape (n, points, dof) [rad]."""
        spline = self.spline
        free = np.asarray(self.arrays["control"][which], float)
        points = np.zeros((len(free), spline.points, free.shape[2]))
        points[:, spline.inner] = free
        return spline.with_ends(points, self.start[which], self.goal[which])

    def problem_name(self, k: int) -> str:
        """Return the id of problem k, for example ``shelf/hard/12``."""
        a = self.arrays
        return f"{self.names['suite'][a['suite'][k]]}/{self.names['level'][a['level'][k]]}/{a['seed'][k]}"

    def subset(self, problems: ArrayLike) -> Paths:
        """Return the paths of some problems, given by their indices."""
        wanted = np.sort(np.asarray(problems, int))
        a = self.arrays
        first = np.concatenate([[0], np.cumsum(a["things"])]).astype(int)
        obstacles = np.concatenate([np.arange(first[k], first[k + 1]) for k in wanted] or [np.zeros(0, int)])
        new_index = np.full(self.problems, -1)
        new_index[wanted] = np.arange(len(wanted))
        kept = new_index[a["problem"]] >= 0
        arrays = {name: a[name][wanted] for name in PROBLEM_FIELDS}
        arrays |= {name: a[name][obstacles] for name in OBSTACLE_FIELDS}
        arrays |= {name: a[name][kept] for name in PATH_FIELDS}
        arrays["problem"] = new_index[a["problem"][kept]].astype(np.int32)
        return Paths(arrays, self.names, self.about)

    @classmethod
    def concatenate(cls, several: Iterable[Paths]) -> Paths:
        """Return the paths of several sets as one set.

        Raises:
            DatasetError: There is none, or they are of different robots or splines.
        """
        parts = list(several)
        if not parts:
            raise DatasetError("data set: no paths to join")
        names: dict[str, dict[str, int]] = {key: {} for key in ("suite", "level", "held")}
        columns: dict[str, list[NDArray[Any]]] = {name: [] for name in FIELDS}
        if any(dict(part.about) != dict(parts[0].about) for part in parts):
            raise DatasetError("data set: its units have states of different robots or splines")
        before = 0
        for part in parts:
            for name in FIELDS:
                column = part.arrays[name]
                if name in names:
                    column = _reindexed(column, part.names[name], names[name])
                columns[name].append(column + np.int32(before) if name == "problem" else column)
            before += part.problems
        arrays = {name: np.concatenate(column) for name, column in columns.items()}
        return cls(arrays, {key: tuple(values) for key, values in names.items()}, parts[0].about)


def held_extents(held: str) -> list[HeldExtent]:
    """Return the extents of held objects, given as JSON.

    Raises:
        DatasetError: One has none: the data were made before these were stored.
    """
    try:
        return [(str(body["link"]), np.array(body["extent"], float).reshape(2, 3)) for body in json.loads(held)]
    except (KeyError, TypeError, ValueError) as error:
        expected = "expected a link and an extent of each; make the data anew"
        raise DatasetError(f"held objects {held[:60]!r}: {expected}") from error


def to_half(control: Array, lower: Array, upper: Array) -> Array:
    """Return control points rounded to half precision, inside the limits, shape (..., dof) [rad]."""
    half = control.astype(np.float16)
    half = np.where(half.astype(float) > upper, np.nextafter(half, np.float16(-np.inf)), half)
    half = np.where(half.astype(float) < lower, np.nextafter(half, np.float16(np.inf)), half)
    return half.astype(float)


def to_micro(states: ArrayLike) -> NDArray[np.int32]:
    """Return states [rad] in whole microradians."""
    return np.rint(np.asarray(states, float) / MICRO).astype(np.int32)


def from_micro(states: NDArray[np.int32]) -> Array:
    """Return states [rad] from whole microradians: those nearest to six decimals, bit for bit."""
    return np.asarray(states, float) / 1e6


def _reindexed(indices: NDArray[Any], names: Iterable[str], known: dict[str, int]) -> NDArray[Any]:
    """Return indices into ``names`` as the numbers in ``known``, to which new names are added."""
    table = [known.setdefault(name, len(known)) for name in names]
    return np.array(table, indices.dtype)[indices] if len(indices) else indices


def arrays_fault(arrays: Mapping[str, NDArray[Any]]) -> str:
    """Return the name of the field that is faulty or does not fit the others, or an empty text."""
    if set(arrays) != set(FIELDS):
        return "fields"
    for name, (kind, shape) in FIELDS.items():
        array = arrays[name]
        fits = array.ndim == 1 + len(shape) and all(b in (-1, a) for a, b in zip(array.shape[1:], shape, strict=True))
        if array.dtype != kind or not fits:
            return name
    for names in (PROBLEM_FIELDS, OBSTACLE_FIELDS, PATH_FIELDS):
        if len({len(arrays[name]) for name in names}) > 1:
            return "lengths"
    if int(arrays["things"].sum()) != len(arrays["shape"]):
        return "things"
    if len(arrays["problem"]):
        if not 0 <= arrays["problem"].min() <= arrays["problem"].max() < len(arrays["seed"]):
            return "problem"
        if arrays["start"].shape != arrays["goal"].shape or arrays["start"].shape[1] != arrays["control"].shape[2]:
            return "control"
        if arrays["source"].max() >= len(SOURCES) or not np.isfinite(arrays["control"]).all():
            return "source or control"
    return ""


def about_fault(about: Any, arrays: Mapping[str, NDArray[Any]]) -> str:
    """Return ``about`` where robot, joints or spline do not fit the arrays, or an empty text."""
    try:
        spline, joints = Spline(**{key: about[key] for key in SPLINE}), about["joints"]
        fits = isinstance(about["robot"], str) and all(isinstance(name, str) for name in joints)
        return "" if fits and arrays["control"].shape[1:] == (spline.free, len(joints)) else "about"
    except (ApexError, KeyError, TypeError):
        return "about"


def names_fault(arrays: Mapping[str, NDArray[Any]], names: Mapping[str, tuple[str, ...]]) -> str:
    """Return the field with an index beyond its names, or an empty text."""
    return next((k for k, v in names.items() if len(arrays[k]) and arrays[k].max() >= len(v)), "")


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
    from_start = np.isin(source, [SOURCES.index(s) for s in ("perturbation", "rrtconnect", "model")])
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
