"""Store of verified paths on disk, from which the model is trained.

A data set is a folder with ``manifest.json`` and ``units/NAME.zip``, each a Zarr group in one file. A unit is written
under a temporary name and renamed when it is complete, so that a process that is killed leaves complete units only. The
compact set is one such file with paths of many units.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apex_ompl.errors import FileFormatError, MissingFileError
from apex_ompl.training.records import FIELDS, DatasetError, Paths, about_fault, arrays_fault, names_fault
from apex_ompl.util.display import one_line
from apex_ompl.util.files import is_file, locked, make_folder, write_atomically

SCHEMA = "apex-ompl/dataset/1"


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

    def __repr__(self) -> str:
        """Return the folder."""
        return one_line("Store", repr(str(self.folder)))

    @classmethod
    def create(cls, folder: str | os.PathLike[str], manifest: Mapping[str, Any], same: Iterable[str]) -> Store:
        """Make a data set, or open an existing one to add to it.

        Args:
            folder: Folder of the data set.
            manifest: Entries of a new manifest.
            same: Keys of the manifest in which an existing data set must agree.

        Raises:
            MissingFileError: The folder cannot be written.
            FileFormatError: The existing data set is of another version.
            DatasetError: The existing data set was made with other options.
        """
        path = Path(folder) / "manifest.json"
        make_folder(path.parent / "units", "folder for a data set")
        if not path.exists():
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
        """Keep other processes from writing, and remove incomplete files of a process that was killed.

        Raises:
            FolderInUseError: Another process writes here.
        """
        with locked(self.folder):
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

    def files(self) -> list[Path]:
        """Return the files of the units that are complete, sorted."""
        return [self.folder / "units" / f"{name}.zip" for name in self.units()]

    def write(self, name: str, paths: Paths) -> None:
        """Write a unit.

        Raises:
            DatasetError: It cannot be written, for example on a full disk; no part of it remains.
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


def save(path: str | os.PathLike[str], paths: Paths) -> None:
    """Write paths as one file, a Zarr group in a zip archive; under a temporary name first.

    Raises:
        DatasetError: It cannot be written.
    """
    zarr, zip_store = _zarr()
    path = Path(path)
    temporary: str | None = None
    try:
        handle, temporary = tempfile.mkstemp(prefix=f".{path.stem}.", suffix=".part", dir=path.parent)
        os.close(handle)
        os.unlink(temporary)  # the store creates it
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


def load(path: str | os.PathLike[str]) -> Paths:
    """Read paths that :func:`save` wrote.

    Raises:
        MissingFileError: There is no such file.
        FileFormatError: It holds something else.
    """
    zarr, zip_store = _zarr()
    path = Path(path)
    if not is_file(path):
        raise MissingFileError(str(path), "file of paths")
    try:
        with zip_store(path, mode="r") as store:
            group = zarr.open_group(store, mode="r")
            head: dict[str, Any] = dict(group.attrs)
            found = head["schema"]
            stored = {name: np.asarray(group[name]) for name in FIELDS} if found == SCHEMA else {}
        if found == SCHEMA:
            names = {key: tuple(str(v) for v in head["names"][key]) for key in ("suite", "level", "held")}
            about, counts, digest = head["about"], head["counts"], head["digest"]
    except Exception as error:  # zipfile, zarr and the codecs let many kinds through
        raise FileFormatError(str(path), "", type(error).__name__, "expected paths of a data set") from error
    if found != SCHEMA:
        raise FileFormatError(str(path), "schema", found, f"expected {SCHEMA!r}")
    arrays = {name: _widened(array, FIELDS[name][0]) for name, array in stored.items()}
    fault = arrays_fault(arrays) or names_fault(arrays, names) or about_fault(about, arrays)
    if not fault and digest != _digest(stored):  # a chunk that is missed reads as zeros
        fault = "digest"
    if fault:
        raise FileFormatError(str(path), fault, "values that do not fit", "expected arrays that fit each other")
    return Paths(arrays, names, about, counts)


def _widened(array: NDArray[Any], kind: Any) -> NDArray[Any]:
    """Return whole numbers of a narrower type as ``kind``: sets of few held objects were written with fewer bytes."""
    fits = array.dtype.kind == "u" and array.dtype != kind and np.can_cast(array.dtype, kind)
    return array.astype(kind) if fits else array


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
