"""Obstacles as flat arrays, under a tree of boxes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from apex_ompl.kernel.compiled.arrays import BOX, CAPSULE, HALF_SPACE, SPHERE, SceneArrays
from apex_ompl.kernel.compiled.layout import Floats
from apex_ompl.kernel.tables import SceneTables


class Primitive(NamedTuple):
    """A solid that the kernel has a shape for.

    Attributes:
        kind: BOX, SPHERE, CYLINDER, CAPSULE or HALF_SPACE.
        pose: Homogeneous transform in the world, shape (4, 4) [m]; that of a half-space is not looked at.
        size: Half edges of a box; radius and half length along z; radius; or (unit normal, distance) of a half-space,
            the points x with normal . x <= distance [m].
    """

    kind: int
    pose: Floats
    size: tuple[float, ...]


LEAF = 4  # obstacles in a leaf of the tree


def scene_tables(solids: Sequence[tuple[int, Primitive]]) -> SceneTables:
    """Return the arrays of obstacles, each with the number of what it stands for.

    The tree of boxes is split at the median along its longest side (a standard bounding volume hierarchy).
    """
    closed = [(o, p) for o, p in solids if p.kind != HALF_SPACE]
    open_ = [(o, p) for o, p in solids if p.kind == HALF_SPACE]
    boxes = np.array([_box(p) for _, p in closed]).reshape(-1, 2, 3)
    order: list[int] = []
    tree: list[tuple[Floats, int, int, int]] = []  # box, skip, first, count

    def grow(members: NDArray[np.intp]) -> None:
        at = len(tree)
        box = np.stack([boxes[members, 0].min(axis=0), boxes[members, 1].max(axis=0)])
        tree.append((box, 0, len(order), 0))
        if len(members) <= LEAF:
            order.extend(int(k) for k in members)
            tree[at] = (box, len(tree), len(order) - len(members), len(members))
            return
        middle = boxes[members].mean(axis=1)
        ranked = members[np.argsort(middle[:, int(np.argmax(np.ptp(middle, axis=0)))], kind="stable")]
        grow(ranked[: len(ranked) // 2])
        grow(ranked[len(ranked) // 2 :])
        tree[at] = (box, len(tree), 0, 0)

    if closed:
        grow(np.arange(len(closed)))
    chosen = [closed[k] for k in order] + open_
    rows = [_row(p) for _, p in chosen]
    bounds = np.array([node[0] for node in tree]).reshape(-1, 2, 3)
    arrays = SceneArrays(
        kind=np.array([p.kind for _, p in chosen], np.int64),
        owner=np.array([o for o, _ in chosen], np.int64),
        tree_skip=np.array([node[1] for node in tree], np.int64),
        tree_range=np.array([node[2:] for node in tree], np.int64).reshape(-1, 2),
        open=np.array([len(open_)], np.int64),
        rotation=np.array([r[0] for r in rows]).reshape(-1, 3, 3),
        offset=np.array([r[1] for r in rows]).reshape(-1, 3),
        size=np.array([r[2] for r in rows]).reshape(-1, 3),
        tree_low=np.ascontiguousarray(bounds[:, 0]),
        tree_high=np.ascontiguousarray(bounds[:, 1]),
    )
    return SceneTables(arrays)


def primitive(arrays: SceneArrays, k: int) -> Primitive:
    """Return solid ``k`` of a scene's arrays."""
    kind = int(arrays.kind[k])
    if kind == HALF_SPACE:
        return Primitive(kind, np.eye(4), (*arrays.offset[k].tolist(), float(arrays.size[k, 0])))
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = arrays.rotation[k], arrays.offset[k]
    return Primitive(kind, pose, tuple(arrays.size[k].tolist()))


def _row(p: Primitive) -> tuple[Floats, Floats, Floats]:
    if p.kind == HALF_SPACE:
        return np.eye(3), np.array(p.size[:3]), np.array([p.size[3], 0.0, 0.0])
    size = np.zeros(3)
    size[: len(p.size)] = p.size
    return p.pose[:3, :3], p.pose[:3, 3], size


def _box(p: Primitive) -> Floats:
    """Return the axis-aligned box around a solid, shape (2, 3)."""
    turn, middle, size = _row(p)
    if p.kind == BOX:
        half = np.abs(turn) @ size
    elif p.kind == SPHERE:
        half = np.full(3, size[0])
    elif p.kind == CAPSULE:
        half = np.abs(turn[:, 2]) * size[1] + size[0]
    else:
        half = np.abs(turn[:, 2]) * size[1] + size[0] * np.sqrt(np.maximum(0.0, 1.0 - turn[:, 2] ** 2))
    half = half + 1e-9  # rounding
    return np.stack([middle - half, middle + half])
