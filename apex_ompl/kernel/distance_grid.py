"""Grids of distances to surfaces and points: lower bounds of the signed distance for any number of triangles.

At the nodes near a surface the distance is exact, elsewhere it is that of a distance transform less its largest error.
Between nodes it is interpolated linearly along each axis. A distance function is 1-Lipschitz, so that interpolation
is wrong by at most sum_i w_i |x - x_i| <= sqrt(3) / 2 spacings, by which the values at the nodes are lowered.
"""

from __future__ import annotations

import hashlib
import math
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from apex_ompl.kernel.compiled.geometry.bounding_trees import BUCKET, HALF, fill_boxes, order_items
from apex_ompl.kernel.compiled.geometry.grid_building import tabulate_points, tabulate_triangles
from apex_ompl.kernel.compiled.geometry.grid_distance import SLACK
from apex_ompl.kernel.compiled.layout import Integers, Singles
from apex_ompl.types import Array
from apex_ompl.util.arrays import compact
from apex_ompl.util.boxes import bounding_box
from apex_ompl.util.forking import ProcessLock

MOST_NODES = 6_000_000
MOST_NODES_OF_POINTS = 1_000_000  # which are made anew with every image
FINEST = 0.003  # spacing [m]
PADDING = 2.5  # nodes around the box of what is tabulated
BAND = 1.5  # distance up to which nodes are examined for each triangle, in spacings
SEED = SLACK**2 + 1e-3  # the node nearest to the closest point of a surface is within the slack of it, squared
ROUNDING = 1e-6  # [m]
KEPT_NODES = 40_000_000  # of grids that are kept by content


class ItemTree(NamedTuple):
    """Sizes of a tree of boxes over points or triangles, see :mod:`apex_ompl.kernel.compiled.geometry.bounding_trees`.

    Attributes:
        levels: Levels below the root.
        number: Number of items.
        width: Numbers of each.
    """

    levels: int
    number: int
    width: int

    @classmethod
    def over(cls, items: Array) -> ItemTree:
        """Return the sizes of a tree over points or triangles, shape (N, 1 or 3, 3)."""
        count, corners = items.shape[:2]
        return cls(max(0, math.ceil(math.log2(count / BUCKET))), count, 3 * corners)

    @property
    def boxes(self) -> int:
        """Numbers of the boxes, which are before the items."""
        return 6 * ((2 << self.levels) - 1)

    @property
    def size(self) -> int:
        """Numbers of boxes and items."""
        return self.boxes + self.number * self.width

    def fill(self, items: Array, low: Array, values: Singles) -> None:
        """Write the boxes and items, given in a frame where that of the grid is at ``low`` (3,) [m], in its frame."""
        ordered, extent = values[self.boxes :].reshape(self.number, -1), float((bounding_box(items)[1] - low).max())
        keys, counts = np.empty((2, self.number), np.int64), np.empty(1 << HALF, np.int64)
        order_items(compact(items), low, extent, keys, counts, ordered)
        fill_boxes(ordered, self.levels, values[: self.boxes].reshape(-1, 6))


@dataclass(frozen=True, eq=False)
class DistanceGrid:
    """Lower bounds of a signed distance on a grid, and a tree over what it is about.

    Attributes:
        low: Place of the first node, shape (3,) [m].
        spacing: Distance of neighboring nodes [m].
        shape: Number of nodes along the axes.
        tree: Sizes of the tree.
        block: The bounds at the nodes, that hold between them too [m], then boxes and items of the tree [m].
        box: Least and largest corner of what is tabulated, shape (2, 3) [m].
        radius: Of the balls around points, 0 for a surface [m].
    """

    low: Array
    spacing: float
    shape: tuple[int, int, int]
    tree: ItemTree
    block: Singles
    box: Array
    radius: float = 0.0

    @cached_property
    def values(self) -> Singles:
        """The bounds at the nodes, shape (nx, ny, nz) [m]."""
        return self.block[: math.prod(self.shape)].reshape(self.shape)


_kept: OrderedDict[bytes, DistanceGrid] = OrderedDict()
_lock = ProcessLock()  # of these


def grid_of_triangles(corners: Array, solid: bool, at_work: Callable[[], None] = lambda: None) -> DistanceGrid:
    """Return the grid of a surface; grids of the same surface are shared.

    Args:
        corners: Corners of the triangles, shape (T, 3, 3) [m].
        solid: Whether points inside have negative distances; the surface must be watertight then.
        at_work: Called before compiled code that needs no lock of the interpreter, where the grid is not known.
    """
    corners = np.ascontiguousarray(corners, float)
    return _shared(corners.tobytes() + bytes([solid]), lambda: _of_triangles(corners, solid, at_work))


@contextmanager
def grid_of_triangles_beside(corners: Array, solid: bool) -> Iterator[None]:
    """Make the grid of a surface in a thread of its own during a block that holds the interpreter's lock.

    The thread no longer needs that lock when the block starts. Afterwards :func:`grid_of_triangles` has the grid.
    """
    at_work = threading.Event()

    def work() -> None:
        try:
            grid_of_triangles(corners, solid, at_work.set)
        finally:
            at_work.set()

    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    at_work.wait()
    try:
        yield
    finally:
        thread.join()


def grid_of_points(points: Array, radius: float) -> DistanceGrid:
    """Return the grid of balls of one radius [m] around points, shape (N, 3) [m]; grids of the same are shared."""
    points = np.ascontiguousarray(points, float)
    return _shared(points.tobytes() + np.float64(radius).tobytes(), lambda: _of_points(points, radius))


def _shared(content: bytes, make: Callable[[], DistanceGrid]) -> DistanceGrid:
    """Return the grid of some content; those that were used last are kept."""
    key = hashlib.sha256(content).digest()
    with _lock:
        if key not in _kept:
            _kept[key] = make()
        _kept.move_to_end(key)
        while len(_kept) > 1 and sum(grid.values.size for grid in _kept.values()) > KEPT_NODES:
            _kept.popitem(last=False)
        return _kept[key]


def _of_triangles(corners: Array, solid: bool, at_work: Callable[[], None]) -> DistanceGrid:
    box = bounding_box(corners)
    grid = _empty(box, corners, 0.0, MOST_NODES)
    scaled, room = (corners - grid.low) / grid.spacing, _room(grid)
    at_work()
    tabulate_triangles(scaled, solid, BAND, SEED, SLACK, grid.spacing, ROUNDING, *room)
    return grid


def _of_points(points: Array, radius: float) -> DistanceGrid:
    box = bounding_box(points) + [[-radius], [radius]]
    grid = _empty(box, points[:, None], radius, MOST_NODES_OF_POINTS)
    scaled = (points - grid.low) / grid.spacing
    tabulate_points(scaled, SEED, SLACK, grid.spacing, radius + ROUNDING, *_room(grid))
    return grid


def _empty(box: Array, items: Array, radius: float, most: int) -> DistanceGrid:
    """Return a grid over a box, shape (2, 3) [m], of at most so many nodes, whose bounds are still to be filled in."""
    low, spacing, shape = _lattice(box, most)
    tree, nodes = ItemTree.over(items), math.prod(shape)
    block = np.empty(nodes + tree.size, np.float32)
    tree.fill(items, low, block[nodes:])
    return DistanceGrid(low, spacing, shape, tree, block, box, radius)


def _room(grid: DistanceGrid) -> tuple[Singles, Singles, Array, Integers, Array]:
    """Return the arrays in which a grid is tabulated; the second has its values."""
    n = max(grid.shape)
    return np.empty(grid.shape, np.float32), grid.values, np.empty(3 * n), np.empty(n, np.int64), np.empty(n)


def _lattice(box: Array, most: int) -> tuple[Array, float, tuple[int, int, int]]:
    """Return the first node, the spacing and at most so many nodes along the axes of a box, shape (2, 3) [m]."""
    sides = box[1] - box[0]
    spacing = FINEST
    while True:
        shape = np.ceil(sides / spacing + 2.0 * PADDING).astype(int) + 1
        if math.prod(shape.tolist()) <= most:
            break
        spacing *= 1.05
    middle = box.mean(axis=0)
    nx, ny, nz = shape.tolist()
    return middle - spacing * (shape - 1) / 2.0, spacing, (nx, ny, nz)
