"""Obstacles as flat arrays, under a tree of boxes that can be built in milliseconds and follows moved obstacles."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from apex_ompl.kernel.compiled.arrays import BOX, CAPSULE, GRID_ROW, HALF_SPACE, SPHERE, SceneArrays
from apex_ompl.kernel.compiled.geometry.grid_distance import SLACK
from apex_ompl.kernel.compiled.layout import Floats, Integers, Singles
from apex_ompl.kernel.distance_grid import DistanceGrid
from apex_ompl.kernel.products import product
from apex_ompl.kernel.tables import SceneTables

LEAF = 1  # obstacles in a leaf of the tree
ROUNDING = 1e-9  # by which boxes are larger than their solids [m]


class Primitive(NamedTuple):
    """A solid that the kernel has a shape for.

    Attributes:
        kind: BOX, SPHERE, CYLINDER, CAPSULE, HALF_SPACE or GRID.
        pose: Homogeneous transform in the world, shape (4, 4) [m]; that of a half-space is ignored.
        size: Half edges of a box; radius and half length along z; radius; or (unit normal, distance) of a half-space,
            the points x with normal . x <= distance [m]. Empty for a grid.
        grid: Distances from a surface or points in the frame of ``pose``.
        exact: Whether it is the shape of what it stands for, and not only contains it.
    """

    kind: int
    pose: Floats
    size: tuple[float, ...]
    grid: DistanceGrid | None = None
    exact: bool = True


class Solids(NamedTuple):
    """Primitives as arrays.

    Attributes:
        kind: Shape (n,).
        exact: Shape (n,).
        rotation: Shape (n, 3, 3).
        offset: Shape (n, 3) [m].
        size: Shape (n, 3) [m].
        box: Box around each, shape (n, 2, 3) [m].
        grids: Grid of each, if it has one.
    """

    kind: Integers
    exact: Integers
    rotation: Floats
    offset: Floats
    size: Floats
    box: Floats
    grids: tuple[DistanceGrid | None, ...]

    @classmethod
    def of(cls, primitives: Sequence[Primitive]) -> Solids:
        """Return primitives as arrays."""
        rotation, offset, size = np.zeros((len(primitives), 3, 3)), *np.zeros((2, len(primitives), 3))
        for k, p in enumerate(primitives):
            if p.kind == HALF_SPACE:
                rotation[k], offset[k], size[k, 0] = np.eye(3), p.size[:3], p.size[3]
            elif p.grid is not None:
                rotation[k], size[k] = p.pose[:3, :3], (p.grid.spacing, SLACK * p.grid.spacing, p.grid.radius)
                offset[k] = p.pose[:3, :3] @ p.grid.low + p.pose[:3, 3]
            else:
                rotation[k], offset[k], size[k, : len(p.size)] = p.pose[:3, :3], p.pose[:3, 3], p.size
        kind = np.array([p.kind for p in primitives], np.int64)
        boxes = boxes_around(kind, rotation, offset, size)
        for k, p in enumerate(primitives):
            if p.grid is not None:
                boxes[k] = _box_of_grid(p.grid, p.pose)
        exact = np.array([p.exact for p in primitives], np.int64)
        return cls(kind, exact, rotation, offset, size, boxes, tuple(p.grid for p in primitives))


def _box_of_grid(grid: DistanceGrid, pose: Floats) -> Floats:
    """Return the axis-aligned box around what a grid at a pose is about, shape (2, 3) [m]."""
    middle = pose[:3, :3] @ grid.box.mean(axis=0) + pose[:3, 3]
    extent = np.abs(pose[:3, :3]) @ (grid.box[1] - grid.box[0]) / 2.0 + ROUNDING
    return np.stack([middle - extent, middle + extent])


def boxes_around(kind: Integers, rotation: Floats, offset: Floats, size: Floats) -> Floats:
    """Return the axis-aligned boxes around solids, shape (n, 2, 3) [m]; those of half-spaces hold nothing."""
    along = np.abs(rotation[:, :, 2])
    radius, half = size[:, :1], size[:, 1:2]
    extents = along * half + radius * np.sqrt(np.maximum(0.0, 1.0 - along**2))  # of cylinders
    kinds = kind[:, None]
    extents = np.where(kinds == BOX, product(np.abs(rotation), size[:, :, None])[:, :, 0], extents)
    extents = np.where(kinds == SPHERE, radius, extents)
    extents = np.where(kinds == CAPSULE, along * half + radius, extents) + ROUNDING
    return np.stack([offset - extents, offset + extents], axis=1)


class _Structure(NamedTuple):
    """Shape of the tree over n solids, which depends on n alone.

    Attributes:
        skip: Next node outside of each node's subtree, nodes in depth-first order, shape (K,).
        span: First solid below each node and the one after the last, shape (K, 2).
        members: Number of solids of each leaf, 0 for inner nodes, shape (K,).
        levels: For each level but the last, the first solids of the parts that it is sorted in, and whether each part
            is sorted.
    """

    skip: Integers
    span: Integers
    members: Integers
    levels: tuple[tuple[Integers, NDArray[np.bool_]], ...]


@lru_cache(maxsize=64)
def _structure(n: int) -> _Structure:
    skip, span, count = list[int](), list[tuple[int, int]](), list[int]()
    levels: list[list[tuple[int, bool]]] = []

    def grow(first: int, last: int, depth: int) -> None:
        at, inner = len(skip), last - first > LEAF
        skip.append(0)
        span.append((first, last))
        count.append(0 if inner else last - first)
        if len(levels) <= depth:
            levels.append([])
        levels[depth].append((first, inner))
        if inner:
            middle = first + (last - first) // 2
            grow(first, middle, depth + 1)
            grow(middle, last, depth + 1)
        skip[at] = len(skip)

    if n:
        grow(0, n, 0)
    finished: list[int] = []
    parts = []
    for level in levels:
        rows = sorted([*level, *((first, False) for first in finished)])
        finished += [first for first, inner in level if not inner]
        if any(inner for _, inner in rows):
            parts.append((np.array([first for first, _ in rows]), np.array([inner for _, inner in rows])))
    spans = np.array(span, np.int64).reshape(-1, 2)
    return _Structure(np.array(skip, np.int64), spans, np.array(count, np.int64), tuple(parts))


def scene_tables(solids: Sequence[tuple[int, Primitive]]) -> SceneTables:
    """Return the arrays of obstacles, each with the number of what it stands for."""
    rows: dict[int, list[Primitive]] = {}
    for owner, one in solids:
        rows.setdefault(owner, []).append(one)
    return tables_of({owner: Solids.of(some) for owner, some in rows.items()})


def tables_of(solids: Mapping[int, Solids]) -> SceneTables:
    """Return the arrays of obstacles by their number; nothing may touch them.

    The tree of boxes is split at the median along its longest side (a standard bounding volume hierarchy).
    """
    counts = np.array([len(some.kind) for some in solids.values()], np.int64)
    owner = np.repeat(np.fromiter(solids, np.int64, len(solids)), counts)
    rank = np.concatenate([np.empty(0, np.int64), *(np.arange(n) for n in counts)])
    rows = joined(solids.values())
    closed = np.flatnonzero(rows.kind != HALF_SPACE)
    tree = _structure(len(closed))
    middle = rows.box[closed].mean(axis=1)
    order = np.arange(len(closed))
    for starts, sorts in tree.levels:
        ranked = middle[order]
        spread = np.maximum.reduceat(ranked, starts) - np.minimum.reduceat(ranked, starts)
        part = np.repeat(np.arange(len(starts)), np.diff(np.append(starts, len(order))))
        key = np.where(sorts[part], ranked[np.arange(len(order)), spread.argmax(axis=1)[part]], 0.0)
        order = order[np.lexsort((key, part))]
    chosen = np.concatenate([closed[order], np.flatnonzero(rows.kind == HALF_SPACE)])
    boxes = rows.box[chosen]
    low, high = _boxes_of(tree, boxes[: len(closed)])
    arrays = SceneArrays(
        kind=rows.kind[chosen],
        owner=owner[chosen],
        exact=rows.exact[chosen],
        tree_skip=tree.skip,
        tree_range=np.stack([np.where(tree.members, tree.span[:, 0], 0), tree.members], axis=1),
        open=np.array([len(chosen) - len(closed)], np.int64),
        allowed=np.empty((0, 2), np.int64),
        rotation=rows.rotation[chosen],
        offset=rows.offset[chosen],
        size=rows.size[chosen],
        tree_low=low,
        tree_high=high,
        **grid_columns([rows.grids[k] for k in chosen]),
    )
    return SceneTables(arrays, boxes, rank[chosen], tuple(rows.grids[k] for k in chosen))


def grid_columns(grids: Sequence[DistanceGrid | None]) -> dict[str, Any]:
    """Return the columns ``grid`` and ``values`` of a scene's arrays."""
    distinct = {id(grid): grid for grid in grids if grid is not None}
    places, end = {}, 0
    for key, grid in distinct.items():
        places[key] = (end, *grid.values.shape, end + grid.values.size, *grid.tree)
        end += len(grid.block)
    rows = [(0,) * GRID_ROW if grid is None else places[id(grid)] for grid in grids]
    return {"grid": np.array(rows, np.int64).reshape(-1, GRID_ROW), "values": _all_values(tuple(distinct.values()))}


@lru_cache(maxsize=4)
def _all_values(grids: tuple[DistanceGrid, ...]) -> Singles:
    blocks = [grid.block for grid in grids]
    return blocks[0] if len(blocks) == 1 else np.concatenate([np.empty(0, np.float32), *blocks])


def moved(tables: SceneTables, owner: int, solids: Solids) -> SceneTables:
    """Return tables of a scene in which the solids of one obstacle have other poses.

    The tree keeps its order, and the boxes above the solids are made anew.

    Args:
        tables: The tables; they are left as they are.
        owner: Number of the obstacle.
        solids: Its solids, in the order of :func:`tables_of`.
    """
    arrays, boxes = tables.arrays, tables.boxes.copy()
    places = np.flatnonzero(arrays.owner == owner)
    mine = tables.rank[places]
    rotation, offset, size = arrays.rotation.copy(), arrays.offset.copy(), arrays.size.copy()
    rotation[places], offset[places], size[places] = solids.rotation[mine], solids.offset[mine], solids.size[mine]
    boxes[places] = solids.box[mine]
    low, high = arrays.tree_low.copy(), arrays.tree_high.copy()
    tree = _structure(len(arrays.kind) - int(arrays.open[0]))
    first, last = tree.span.T
    after = np.searchsorted(places, last)
    for k in np.flatnonzero(np.searchsorted(places, first) < after).tolist():
        some = boxes[first[k] : last[k]]
        low[k], high[k] = some[:, 0].min(axis=0), some[:, 1].max(axis=0)
    arrays = arrays._replace(rotation=rotation, offset=offset, size=size, tree_low=low, tree_high=high)
    return replace(tables, arrays=arrays, boxes=boxes)


def primitive(tables: SceneTables, k: int) -> Primitive:
    """Return solid ``k`` of a scene's tables."""
    arrays = tables.arrays
    kind, grid, exact = int(arrays.kind[k]), tables.grids[k], bool(arrays.exact[k])
    if kind == HALF_SPACE:
        return Primitive(kind, np.eye(4), (*arrays.offset[k].tolist(), float(arrays.size[k, 0])))
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = arrays.rotation[k], arrays.offset[k]
    if grid is not None:
        pose[:3, 3] -= pose[:3, :3] @ grid.low
        return Primitive(kind, pose, (), grid, exact)
    return Primitive(kind, pose, tuple(arrays.size[k].tolist()), exact=exact)


def joined(parts: Iterable[Solids]) -> Solids:
    """Return solids one after the other."""
    rows = list(parts) or [Solids.of(())]
    kind, exact, *floats = (np.concatenate(c) for c in zip(*(row[:-1] for row in rows), strict=True))
    rotation, offset, size, box = floats
    return Solids(kind, exact, rotation, offset, size, box, tuple(grid for row in rows for grid in row.grids))


def _boxes_of(tree: _Structure, boxes: Floats) -> tuple[Floats, Floats]:
    """Return the lowest and highest corners of a tree's boxes, each of shape (K, 3) [m]."""
    if not len(tree.skip):
        return np.empty((0, 3)), np.empty((0, 3))
    low = np.append(boxes[:, 0], np.full((1, 3), np.inf), axis=0)  # no solid is after the last
    high = np.append(boxes[:, 1], np.full((1, 3), -np.inf), axis=0)
    ends = tree.span.ravel()
    return np.minimum.reduceat(low, ends)[::2].copy(), np.maximum.reduceat(high, ends)[::2].copy()
