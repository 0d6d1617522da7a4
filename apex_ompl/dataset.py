"""The store of proven paths that the model learns from.

A data set is a folder: ``manifest.json``, and ``units/NAME.zip``, each a Zarr group in one file. A unit is written
under a temporary name and renamed when it is complete, so that whatever ends the process leaves whole units only. The
compact set is one such file with paths of many units.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import json
import os
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from apex_ompl.errors import ApexError, FileFormatError, MissingFileError
from apex_ompl.files import is_file, write_atomically
from apex_ompl.spline import Spline

Array = NDArray[np.float64]

SCHEMA = "apex-ompl/dataset/1"
MICRO = 1e-6  # states are kept in millionths of a radian, in which the suites draw them
SOURCES = ("line", "bumps", "rrtconnect", "reversed", "part")
"""Where a path comes from: the straight line, optimisation from bumps, rrtconnect and optimisation, another path
backwards, or the rest of another path from a state on it."""

SHAPES = ("box", "sphere", "cylinder", "capsule")
"""Kinds of obstacles. Sizes are edges; radius; or radius and length along z [m]."""

PROBLEM_FIELDS: dict[str, tuple[Any, tuple[int, ...]]] = {
    "seed": (np.int32, ()), "suite": (np.uint8, ()), "level": (np.uint8, ()), "held": (np.uint8, ()),
    "things": (np.uint16, ()),
}  # fmt: skip
THING_FIELDS: dict[str, tuple[Any, tuple[int, ...]]] = {
    "shape": (np.uint8, ()), "position": (np.float32, (3,)), "orientation": (np.float32, (4,)),
    "size": (np.float32, (3,)),
}  # fmt: skip
PATH_FIELDS: dict[str, tuple[Any, tuple[int, ...]]] = {
    "problem": (np.int32, ()), "start": (np.int32, (-1,)), "goal": (np.int32, (-1,)),
    "control": (np.float16, (-1, -1)), "point": (np.float32, (3,)), "clearance": (np.float32, ()),
    "length": (np.float32, ()), "source": (np.uint8, ()), "homotopy": (np.uint8, ()),
}  # fmt: skip
FIELDS = {**PROBLEM_FIELDS, **THING_FIELDS, **PATH_FIELDS}
SPLINE = ("points", "pinned", "states", "degree")


class DatasetError(ApexError):
    """A data set that cannot be read or written as asked."""


@dataclass(frozen=True, eq=False)
class Paths:
    """Proven paths, and the problems that they solve, as arrays.

    Attributes:
        arrays: Of each problem, ``suite`` and ``level`` (numbers in ``names``), ``seed``, ``held`` (a number in
            ``names``, what the hands hold), and how many ``things`` stand around. Of each thing, in the order of the
            problems, ``shape`` (a number in :data:`SHAPES`), ``position`` [m], ``orientation`` (xyzw) and ``size`` [m].
            Of each path, the number of its ``problem``, ``start`` and ``goal`` [1e-6 rad], free ``control`` points
            [rad], the obstacle ``point`` nearest to the robot at the start [m], ``clearance`` [m] and ``length``
            [rad], ``source`` (a number in :data:`SOURCES`), and ``homotopy``, which tells paths of a problem apart that
            could not be deformed into each other along straight lines.
        names: What numbers stand for: ``suite``, ``level``, ``held``.
        about: Whose paths these are: ``robot``, ``joints``, and the fields of their :class:`Spline`.
        counts: What was tried, and what came of it.
    """

    arrays: Mapping[str, NDArray[Any]]
    names: Mapping[str, tuple[str, ...]]
    about: Mapping[str, Any]
    counts: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check that the arrays belong together.

        Raises:
            DatasetError: They do not.
        """
        fault = _fault(self.arrays) or _about_fault(self.about, self.arrays)
        if fault:
            raise DatasetError(f"data set: {fault}")

    def __len__(self) -> int:
        """Return the number of paths."""
        return len(self.arrays["problem"])

    @property
    def problems(self) -> int:
        """The number of problems."""
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
        """What the control points belong to."""
        return Spline(**{key: self.about[key] for key in SPLINE})

    def control(self, which: Any = slice(None)) -> Array:
        """Return all control points of paths, shape (n, points, dof) [rad]."""
        spline = self.spline
        free = np.asarray(self.arrays["control"][which], float)
        points = np.zeros((len(free), spline.points, free.shape[2]))
        points[:, spline.inner] = free
        return spline.with_ends(points, self.start[which], self.goal[which])

    def problem_name(self, k: int) -> str:
        """Return the id of problem k, for example ``shelf/hard/12``."""
        a = self.arrays
        return f"{self.names['suite'][a['suite'][k]]}/{self.names['level'][a['level'][k]]}/{a['seed'][k]}"

    def chosen(self, problems: ArrayLike) -> Paths:
        """Return the paths of some problems, whose numbers are given."""
        wanted = np.sort(np.asarray(problems, int))
        a = self.arrays
        first = np.concatenate([[0], np.cumsum(a["things"])]).astype(int)
        things = np.concatenate([np.arange(first[k], first[k + 1]) for k in wanted] or [np.zeros(0, int)])
        place = np.full(self.problems, -1)
        place[wanted] = np.arange(len(wanted))
        kept = place[a["problem"]] >= 0
        arrays = {name: a[name][wanted] for name in PROBLEM_FIELDS}
        arrays |= {name: a[name][things] for name in THING_FIELDS}
        arrays |= {name: a[name][kept] for name in PATH_FIELDS}
        arrays["problem"] = place[a["problem"][kept]].astype(np.int32)
        return Paths(arrays, self.names, self.about)

    @classmethod
    def joined(cls, several: Iterable[Paths]) -> Paths:
        """Return all paths of several sets as one.

        Raises:
            DatasetError: There is none, or their states have not the same number of joints.
        """
        parts = list(several)
        if not parts:
            raise DatasetError("data set: no paths to join")
        names: dict[str, list[str]] = {key: [] for key in ("suite", "level", "held")}
        columns: dict[str, list[NDArray[Any]]] = {name: [] for name in FIELDS}
        if any(dict(part.about) != dict(parts[0].about) for part in parts):
            raise DatasetError("data set: its units have states of different robots or splines")
        before = 0
        for part in parts:
            for name in FIELDS:
                column = part.arrays[name]
                if name in names:
                    column = _renumbered(column, part.names[name], names[name])
                columns[name].append(column + np.int32(before) if name == "problem" else column)
            before += part.problems
        arrays = {name: np.concatenate(column) for name, column in columns.items()}
        return cls(arrays, {key: tuple(values) for key, values in names.items()}, parts[0].about)


def to_micro(states: ArrayLike) -> NDArray[np.int32]:
    """Return states [rad] in whole millionths."""
    return np.rint(np.asarray(states, float) / MICRO).astype(np.int32)


def from_micro(states: NDArray[np.int32]) -> Array:
    """Return states [rad] from whole millionths; the states nearest to six decimals, bit for bit."""
    return np.asarray(states, float) / 1e6


class Store:
    """A data set on disk."""

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        """Open a data set.

        Raises:
            MissingFileError: There is no manifest.
            FileFormatError: The manifest is damaged or of another version.
        """
        self.folder = Path(folder)
        path = self.folder / "manifest.json"
        if not is_file(path):
            raise MissingFileError(str(path), "manifest of a data set")
        try:
            self.manifest: dict[str, Any] = json.loads(path.read_text())
            found = self.manifest["schema"]
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise FileFormatError(str(path), "", type(error).__name__, "expected the manifest of a data set") from error
        if found != SCHEMA:
            raise FileFormatError(str(path), "schema", found, f"expected {SCHEMA!r}")

    @classmethod
    def create(cls, folder: str | os.PathLike[str], manifest: Mapping[str, Any], same: Iterable[str]) -> Store:
        """Make a data set, or open the one that is there to go on with it.

        Args:
            folder: Where.
            manifest: What to write down.
            same: Keys of the manifest in which a data set that is there must agree.

        Raises:
            MissingFileError: The folder cannot be written.
            FileFormatError: What is there is of another version.
            DatasetError: What is there was made otherwise.
        """
        path = Path(folder) / "manifest.json"
        try:
            (path.parent / "units").mkdir(parents=True, exist_ok=True)
            new = not path.exists()
        except (OSError, ValueError) as error:
            why = (getattr(error, "strerror", None) or str(error)).lower()
            raise MissingFileError(str(folder), "folder for a data set", why) from error
        if new:
            write_atomically(path, (json.dumps({"schema": SCHEMA, **manifest}, indent=1) + "\n").encode())
        store = cls(folder)
        for key in same:
            if store.manifest.get(key) != manifest[key]:
                raise DatasetError(
                    f"{folder}: {key} is {store.manifest.get(key)!r} there, expected {manifest[key]!r}; "
                    "take another folder, or the same options"
                )
        return store

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Keep other processes from writing, and clear away what an ended one left half-written.

        Raises:
            DatasetError: Another process writes here.
        """
        with open(self.folder / ".lock", "w") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError as error:
                raise DatasetError(f"{self.folder}: another process writes here, expected one at a time") from error
            for left in (self.folder / "units").glob(".*.part"):
                left.unlink(missing_ok=True)
            yield

    def note(self, **entries: Any) -> None:
        """Add entries to the manifest.

        Raises:
            MissingFileError: It cannot be written.
        """
        self.manifest.update(entries)
        write_atomically(self.folder / "manifest.json", (json.dumps(self.manifest, indent=1) + "\n").encode())

    def units(self) -> list[str]:
        """Return the names of the units that are complete, sorted."""
        return sorted(path.stem for path in (self.folder / "units").glob("[!.]*.zip"))

    def write(self, name: str, paths: Paths) -> None:
        """Write a unit.

        Raises:
            DatasetError: It cannot be written, for want of space for example; nothing is left of it.
        """
        save(self.folder / "units" / f"{name}.zip", paths)

    def read(self, name: str) -> Paths:
        """Read a unit.

        Raises:
            MissingFileError: There is no such unit.
            FileFormatError: It is damaged.
        """
        return load(self.folder / "units" / f"{name}.zip")

    def __iter__(self) -> Iterator[Paths]:
        """Read all units."""
        return (self.read(name) for name in self.units())


def save(path: Path, paths: Paths) -> None:
    """Write paths as one file, a Zarr group in a zip archive; under a temporary name first.

    Raises:
        DatasetError: It cannot be written.
    """
    zarr, zip_store = _zarr()
    temporary: str | None = None
    try:
        handle, temporary = tempfile.mkstemp(prefix=f".{path.stem}.", suffix=".part", dir=path.parent)
        os.close(handle)
        os.unlink(temporary)  # the store wants to make it
        with zip_store(temporary, mode="w") as store:
            head = {
                "schema": SCHEMA,
                "names": {k: list(v) for k, v in paths.names.items()},
                "about": dict(paths.about),
                "counts": dict(paths.counts),
                "digest": _digest(paths.arrays),
            }
            group = zarr.create_group(store, attributes=head)
            for name in FIELDS:
                array = np.ascontiguousarray(paths.arrays[name])
                group.create_array(name, data=array, chunks=tuple(max(1, n) for n in array.shape))
        with open(temporary, "rb") as file:
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except OSError as error:
        if temporary is not None:
            with contextlib.suppress(OSError):
                os.unlink(temporary)
        raise DatasetError(f"{path}: cannot be written, {(error.strerror or str(error)).lower()}") from error


def load(path: Path) -> Paths:
    """Read paths that :func:`save` wrote.

    Raises:
        MissingFileError: There is no such file.
        FileFormatError: It holds something else.
    """
    zarr, zip_store = _zarr()
    if not is_file(path):
        raise MissingFileError(str(path), "file of paths")
    try:
        with zip_store(path, mode="r") as store:
            group = zarr.open_group(store, mode="r")
            head: dict[str, Any] = dict(group.attrs)
            found = head["schema"]
            arrays = {name: np.asarray(group[name]) for name in FIELDS} if found == SCHEMA else {}
        if found == SCHEMA:
            names = {key: tuple(str(v) for v in head["names"][key]) for key in ("suite", "level", "held")}
            about, counts, digest = head["about"], head["counts"], head["digest"]
    except Exception as error:  # zipfile, zarr and the codecs let many kinds through
        raise FileFormatError(str(path), "", type(error).__name__, "expected paths of a data set") from error
    if found != SCHEMA:
        raise FileFormatError(str(path), "schema", found, f"expected {SCHEMA!r}")
    fault = _fault(arrays) or _names_fault(arrays, names) or _about_fault(about, arrays)
    if not fault and digest != _digest(arrays):  # a chunk that is missed reads as zeros
        fault = "digest"
    if fault:
        raise FileFormatError(str(path), fault, "values that do not fit", "expected arrays that fit each other")
    return Paths(arrays, names, about, counts)


def _digest(arrays: Mapping[str, NDArray[Any]]) -> str:
    digest = hashlib.sha256()
    for name in FIELDS:
        digest.update(np.ascontiguousarray(arrays[name]).tobytes())
    return digest.hexdigest()


def _zarr() -> tuple[Any, Any]:
    try:
        import zarr
        from zarr.storage import ZipStore
    except ImportError as error:
        expected = "expected: pip install -c constraints.txt '.[data]'"
        raise DatasetError(f"data sets need {error.name}, {expected}") from error
    return zarr, ZipStore


def _renumbered(numbers: NDArray[Any], names: Iterable[str], known: list[str]) -> NDArray[Any]:
    """Return numbers of ``names`` as numbers of ``known``, to which new names are added."""
    table = []
    for name in names:
        if name not in known:
            known.append(name)
        table.append(known.index(name))
    return np.array(table, np.uint8)[numbers] if len(numbers) else numbers


def _fault(arrays: Mapping[str, NDArray[Any]]) -> str:
    """Return what is wrong with arrays, or nothing."""
    if set(arrays) != set(FIELDS):
        return "fields"
    for name, (kind, shape) in FIELDS.items():
        array = arrays[name]
        fits = array.ndim == 1 + len(shape) and all(b in (-1, a) for a, b in zip(array.shape[1:], shape, strict=True))
        if array.dtype != kind or not fits:
            return name
    for names in (PROBLEM_FIELDS, THING_FIELDS, PATH_FIELDS):
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


def _about_fault(about: Any, arrays: Mapping[str, NDArray[Any]]) -> str:
    try:
        spline, joints = Spline(**{key: about[key] for key in SPLINE}), about["joints"]
        fits = isinstance(about["robot"], str) and all(isinstance(name, str) for name in joints)
        return "" if fits and arrays["control"].shape[1:] == (spline.free, len(joints)) else "about"
    except (ApexError, KeyError, TypeError):
        return "about"


def _names_fault(arrays: Mapping[str, NDArray[Any]], names: Mapping[str, tuple[str, ...]]) -> str:
    return next((k for k, v in names.items() if len(arrays[k]) and arrays[k].max() >= len(v)), "")
