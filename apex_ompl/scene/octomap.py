"""Maps of OctoMap (Hornung et al. 2013) in its binary format, ``.bt``, as full cells of a grid."""

from __future__ import annotations

import math

import numpy as np

from apex_ompl.types import Array, Flags

HEAD = b"# Octomap OcTree binary file"
DEPTH = 16  # of the tree: the side of the whole map is 2^16 cells
INNER, FULL = 3, 2  # what two bits say of a child: 1 is free, 0 unknown
MOST_NODES = 50_000_000


def parse_octomap(content: bytes, most_cells: int) -> tuple[Flags, float, Array]:
    """Return the cells that are occupied, shape (nx, ny, nz), their side [m] and the outer corner of the first one [m].

    A node that is occupied as a whole gives all cells in it; cells that are free or unknown are empty.

    Args:
        content: Content of the file.
        most_cells: Largest number of cells of the box around the occupied ones.

    Raises:
        ValueError: The content is something else, is cut off, or has no occupied cell or too many.
    """
    if not content.startswith(HEAD):
        raise ValueError(f"no line {HEAD.decode()!r} at the beginning")
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
    return occupied, side, (low - (1 << DEPTH - 1)) * side


def _full_nodes(content: bytes, at: int) -> list[tuple[int, int, int, int]]:
    """Return least cell and number of cells along a side of each node that is occupied as a whole.

    Inner nodes stand depth first, each with two bits for each of its eight children.
    """
    found: list[tuple[int, int, int, int]] = []
    waiting = [(0, 0, 0, 1 << DEPTH)]
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
