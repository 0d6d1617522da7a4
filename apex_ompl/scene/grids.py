"""Voxels, height fields and distance grids from files, as surfaces of triangles.

A ``.npz`` file holds one of ``occupied`` (nx, ny, nz), the cells that are full; ``heights`` (nx, ny) [m], full from
the lowest height up to each; or ``distances`` (nx, ny, nz), signed distances at the centers of cells [m]; with
``resolution``, the side of the cells [m], and ``origin`` (3,), the outer corner of the first one [m].
A ``.bt`` file holds a map of OctoMap in its binary format (Hornung et al. 2013).
"""

from __future__ import annotations

import base64
import io
import math
from typing import IO

import numpy as np
from numpy.typing import ArrayLike, NDArray

from apex_ompl.errors import FileFormatError, ParameterError
from apex_ompl.scene.bodies import VoxelFile
from apex_ompl.scene.meshes import LARGEST
from apex_ompl.types import Array, Flags
from apex_ompl.util.files import BROKEN
from apex_ompl.util.validation import check_array, check_positive, finite_array, is_number

OCTOMAP_HEAD = b"# Octomap OcTree binary file"
OCTOMAP_DEPTH = 16  # of the tree of OctoMap: the side of the whole map is 2^16 cells
INNER, FULL = 3, 2  # what two bits say of a child: 1 is free, 0 unknown
MOST_NODES = 50_000_000
MOST_CELLS = 100_000_000
MOST_FACES = 4_000_000
KINDS = ("occupied", "heights", "distances")


def parse_octomap(content: bytes, most_cells: int) -> tuple[Flags, float, Array]:
    """Return the cells that are occupied, shape (nx, ny, nz), their side [m] and the outer corner of the first one [m].

    A node that is occupied as a whole gives all cells in it; cells that are free or unknown are empty.

    Args:
        content: Content of the file.
        most_cells: Largest number of cells of the box around the occupied ones.

    Raises:
        ValueError: The content is something else, is cut off, or has no occupied cell or too many.
    """
    if not content.startswith(OCTOMAP_HEAD):
        raise ValueError(f"no line {OCTOMAP_HEAD.decode()!r} at the beginning")
    fields, at = {}, 0
    while "data" not in fields:
        end = content.index(b"\n", at)
        name, _, value = content[at:end].decode("ascii").partition(" ")
        fields[name] = value
        at = end + 1
    if fields.get("id") != "OcTree":
        raise ValueError(f"a map of kind {fields.get('id')!r}, expected OcTree")
    side = float(fields["res"])
    if not 0.0 < side < math.inf:
        raise ValueError(f"res {side}, expected a positive number")
    leaves = np.array(_full_nodes(content, at), np.int64).reshape(-1, 4)
    if not len(leaves):
        raise ValueError("no occupied cell")
    low, high = leaves[:, :3].min(axis=0), (leaves[:, :3] + leaves[:, 3:]).max(axis=0)
    counts = [int(n) for n in high - low]
    if math.prod(counts) > most_cells:
        raise ValueError(f"{math.prod(counts)} cells, expected at most {most_cells}")
    occupied = np.zeros(counts, bool)
    for x, y, z, size in (leaves - np.append(low, 0)).tolist():
        occupied[x : x + size, y : y + size, z : z + size] = True
    return occupied, side, (low - (1 << OCTOMAP_DEPTH - 1)) * side


def _full_nodes(content: bytes, at: int) -> list[tuple[int, int, int, int]]:
    """Return least cell and number of cells along a side of each node that is occupied as a whole.

    Inner nodes stand depth first, each with two bits for each of its eight children.
    """
    found: list[tuple[int, int, int, int]] = []
    waiting = [(0, 0, 0, 1 << OCTOMAP_DEPTH)]
    while waiting:
        x, y, z, size = waiting.pop()
        if at + 2 > len(content) or at > MOST_NODES:
            raise ValueError("a map that is cut off" if at + 2 > len(content) else "too many nodes")
        bits, half = content[at] | content[at + 1] << 8, size // 2
        at += 2
        inner = []
        for child in range(8):
            what = bits >> 2 * child & 3
            place = x + half * (child & 1), y + half * (child >> 1 & 1), z + half * (child >> 2), half
            if what == FULL:
                found.append(place)
            elif what == INNER:
                if half == 1:
                    raise ValueError("a node below the smallest cells")
                inner.append(place)
        waiting += inner[::-1]
    return found


def voxels_of(occupied: ArrayLike, resolution: float, origin: ArrayLike) -> VoxelFile:
    """Return cells in memory as the ``voxels`` of an obstacle, which no file is needed for.

    Args:
        occupied: Cells that are full, those that are not 0, shape (nx, ny, nz).
        resolution: Side of a cell [m].
        origin: Outer corner of the first cell, shape (3,) [m].

    Raises:
        ParameterError: An argument has another shape, is not finite, or no cell is full.
    """
    cells, corner = np.asarray(occupied) != 0, finite_array(origin, "origin")
    if cells.ndim != 3:
        raise ParameterError("occupied", cells.shape, "an array of shape (nx, ny, nz)")
    check_array(corner, (3,), "origin")
    check_positive(resolution, "resolution", "a positive number of meters")
    if not cells.any():
        raise ParameterError("occupied", "no cell that is full", "one or more")
    content = io.BytesIO()
    np.savez_compressed(content, occupied=cells, resolution=resolution, origin=corner)
    return VoxelFile(file="memory.npz", content=base64.b64encode(content.getvalue()).decode())


def parse_surface(file: str, content: bytes) -> tuple[Array, NDArray[np.int64]]:
    """Return the surface of the full cells of a file: vertices, shape (V, 3) [m], and triangles, shape (T, 3).

    Cells of a distance grid are full where the surface may reach into them: where the distance is at most half of a
    cell's diagonal.

    Args:
        file: Name of the file.
        content: Its content.

    Raises:
        FileFormatError: The file holds something else, too many cells, or none that is full.
    """
    if file.lower().endswith(".bt"):
        try:
            return surface(*parse_octomap(content, MOST_CELLS), file)
        except BROKEN as error:
            raise FileFormatError(file, "", str(error)[:80], "expected a binary map of OctoMap") from error
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as data:
            found = [name for name in KINDS if name in data]
            if len(found) != 1:
                have = ", ".join(data.files) or "nothing"
                raise FileFormatError(file, "", have, f"expected one array {' or '.join(KINDS)}")
            name = found[0]
            with data.zip.open(f"{name}.npy") as member:  # before it is read, which may take all memory
                _check_header(file, name, member)
            values, resolution, origin = data[name], data["resolution"], np.asarray(data["origin"], float)
    except BROKEN as error:
        raise FileFormatError(file, "", str(error)[:80], "expected an .npz file of NumPy") from error
    side = float(resolution) if resolution.ndim == 0 and is_number(resolution[()]) else np.nan
    if not 0.0 < side < LARGEST:
        raise FileFormatError(file, "resolution", str(resolution)[:40], f"expected meters from 0 to {LARGEST:g}")
    if origin.shape != (3,) or not (np.abs(origin) < LARGEST).all():
        raise FileFormatError(file, "origin", str(origin)[:40], f"expected three numbers of meters, below {LARGEST:g}")
    if not np.isfinite(values).all():
        raise FileFormatError(file, name, "numbers that are not finite", "expected finite ones")
    occupied = _occupied(file, name, values, side)
    if not occupied.any():
        raise FileFormatError(file, name, "no cell that is full", "expected one or more")
    return surface(occupied, side, origin, file)


def _check_header(file: str, name: str, member: IO[bytes]) -> None:
    """Check the header of an array in an archive.

    Raises:
        FileFormatError: It has another number of axes, too many cells or none, or does not hold numbers.
    """
    read = {1: np.lib.format.read_array_header_1_0, 2: np.lib.format.read_array_header_2_0}
    shape, _, dtype = read[np.lib.format.read_magic(member)[0]](member)
    axes, cells = 2 if name == "heights" else 3, math.prod(shape)
    if len(shape) != axes or not cells:
        raise FileFormatError(file, name, f"shape {shape}", f"expected an array of {axes} axes")
    if cells > MOST_CELLS:
        raise FileFormatError(file, name, f"{cells} cells", f"expected at most {MOST_CELLS}")
    if dtype.kind not in "biuf":
        raise FileFormatError(file, name, str(dtype), "expected numbers")


def _occupied(file: str, name: str, values: Array, side: float) -> Flags:
    if name == "occupied":
        return np.asarray(values != 0)
    if name == "distances":
        return np.asarray(values <= 0.5 * np.sqrt(3.0) * side)
    most = math.ceil((float(values.max()) - float(values.min())) / side - 1e-9) + 1
    if most * values.size > MOST_CELLS:  # also where a number stands for a height that is not known
        found = f"{most * values.size:.3g} cells, for heights from {values.min():.3g} to {values.max():.3g} m"
        raise FileFormatError(file, name, found, f"expected at most {MOST_CELLS}")
    levels = np.ceil((values - values.min()) / side - 1e-9).astype(np.int64) + 1
    return np.asarray(np.arange(levels.max()) < levels[:, :, None])


def surface(occupied: Flags, side: float, origin: Array, file: str = "") -> tuple[Array, NDArray[np.int64]]:
    """Return the faces of full cells towards empty ones, two triangles each, seen counter-clockwise from outside.

    Args:
        occupied: Which cells are full, shape (nx, ny, nz).
        side: Side of a cell [m].
        origin: Outer corner of the first one, shape (3,) [m].
        file: Name of the file for errors.

    Raises:
        FileFormatError: There are more than ``MOST_FACES`` faces.
    """
    padded = np.pad(occupied, 1)
    corners = []
    for axis in range(3):
        for sign in (-1, 1):
            open_face = padded & ~np.roll(padded, -sign, axis=axis)
            cells = np.argwhere(open_face) - 1
            u, v = ((axis + 1) % 3, (axis + 2) % 3) if sign > 0 else ((axis + 2) % 3, (axis + 1) % 3)
            base = cells.copy()
            base[:, axis] += sign > 0
            steps = np.zeros((4, 3), np.int64)
            steps[1, u] = steps[2, u] = steps[2, v] = steps[3, v] = 1
            corners.append(base[:, None] + steps)
    quads = np.concatenate(corners)
    if len(quads) > MOST_FACES:
        raise FileFormatError(file, "", f"{len(quads)} outer faces", f"expected at most {MOST_FACES}")
    counts = np.array(occupied.shape) + 1
    numbers, place = np.unique(np.ravel_multi_index(tuple(quads.reshape(-1, 3).T), tuple(counts)), return_inverse=True)
    vertices = np.stack(np.unravel_index(numbers, tuple(counts)), axis=1) * side + origin
    quads = place.reshape(-1, 4).astype(np.int64)
    return vertices, np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
