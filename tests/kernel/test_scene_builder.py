"""Tables of obstacles: their tree against brute force, and moved obstacles against tables made anew."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from apex_ompl.kernel.arrays import BOX, CAPSULE, CYLINDER, HALF_SPACE, SPHERE
from apex_ompl.kernel.scene_builder import LEAF, Primitive, Solids, moved, scene_tables, tables_of
from apex_ompl.kernel.tables import SceneTables


def random_pose(rng: np.random.Generator) -> np.ndarray:
    pose = np.eye(4)
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    pose[:3, :3] = turn * np.sign(np.linalg.det(turn))
    pose[:3, 3] = rng.uniform(-1.0, 1.0, 3)
    return pose


def random_solid(rng: np.random.Generator) -> Primitive:
    kind = int(rng.choice([BOX, SPHERE, CYLINDER, CAPSULE, HALF_SPACE], p=[0.4, 0.2, 0.2, 0.15, 0.05]))
    size = tuple(rng.uniform(0.01, 0.3, {BOX: 3, SPHERE: 1}.get(kind, 2)))
    if kind == HALF_SPACE:
        normal = rng.normal(size=3)
        size = (*(normal / np.linalg.norm(normal)), float(rng.uniform(-2.0, -1.0)))
    return Primitive(kind, random_pose(rng), size)


def surface(p: Primitive, rng: np.random.Generator) -> np.ndarray:
    """Points on the surface of a solid, among them those that are farthest along each axis of its frame."""
    if p.kind == BOX:
        corners = np.stack(np.meshgrid(*([-1, 1],) * 3), -1).reshape(-1, 3)
        points = corners * p.size
    else:
        around = rng.normal(size=(200, 3))
        around /= np.linalg.norm(around, axis=1)[:, None]
        if p.kind == CYLINDER:
            flat = around[:, :2] / np.linalg.norm(around[:, :2], axis=1)[:, None]
            points = np.column_stack([p.size[0] * flat, p.size[1] * np.sign(around[:, 2])])
        else:
            points = p.size[0] * around
            points[:, 2] += np.sign(around[:, 2]) * (p.size[1] if p.kind == CAPSULE else 0.0)
    return points @ p.pose[:3, :3].T + p.pose[:3, 3]


def below(tables: SceneTables, node: int) -> list[int]:
    """Solids below a node of the tree."""
    ranges = tables.arrays.tree_range[node : tables.arrays.tree_skip[node]]
    return [k for first, count in ranges for k in range(first, first + count)]


@settings(max_examples=25)
@given(count=st.integers(0, 60), seed=st.integers(0, 10**6))
def test_every_solid_stands_once_in_the_tree_inside_of_the_boxes_above_it(count: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    solids = [(k // 2, random_solid(rng)) for k in range(count)]
    tables = scene_tables(solids)
    a, closed = tables.arrays, sum(p.kind != HALF_SPACE for _, p in solids)
    assert sorted(zip(a.owner.tolist(), a.kind.tolist(), strict=True)) == sorted((o, p.kind) for o, p in solids)
    assert int(a.open[0]) == count - closed and (a.kind[closed:] == HALF_SPACE).all()
    if closed:
        assert sorted(below(tables, 0)) == list(range(closed))
    mine = {(o, p.size[0]): p for o, p in solids}
    for node in range(len(a.tree_skip)):
        members = below(tables, node)
        leaf = a.tree_range[node, 1] > 0
        assert len(members) == a.tree_range[node, 1] <= LEAF if leaf else len(members) > LEAF
        for k in members:
            points = surface(mine[int(a.owner[k]), float(a.size[k, 0])], rng)
            assert (points >= a.tree_low[node]).all() and (points <= a.tree_high[node]).all()


@settings(max_examples=25)
@given(count=st.integers(1, 40), seed=st.integers(0, 10**6))
def test_moved_obstacles_are_as_in_tables_that_hold_them_there(count: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    solids = {k: [random_solid(rng) for _ in range(int(rng.integers(1, 4)))] for k in range(count)}
    tables = before = tables_of({k: Solids.of(some) for k, some in solids.items()})
    kept = [array.copy() for array in before.arrays]
    for owner in rng.choice(count, min(count, 3), replace=False).tolist():
        solids[owner] = [p._replace(pose=random_pose(rng)) for p in solids[owner]]
        tables = moved(tables, owner, Solids.of(solids[owner]))
    a = tables.arrays
    for owner, some in solids.items():
        rows = np.flatnonzero(a.owner == owner)
        wanted = Solids.of(some)
        for k in rows:
            rank = int(tables.rank[k])
            assert a.kind[k] == wanted.kind[rank]
            for name in ("rotation", "offset", "size"):
                np.testing.assert_array_equal(getattr(a, name)[k], getattr(wanted, name)[rank])
    for node in range(len(a.tree_skip)):
        boxes = tables.boxes[below(tables, node)]
        np.testing.assert_array_equal(a.tree_low[node], boxes[:, 0].min(axis=0))
        np.testing.assert_array_equal(a.tree_high[node], boxes[:, 1].max(axis=0))
    for array, same in zip(before.arrays, kept, strict=True):
        np.testing.assert_array_equal(array, same, "the tables before are left as they were")
    np.testing.assert_array_equal(tables.packed[1][: a.rotation.size], a.rotation.ravel())


def test_tables_without_obstacles_are_empty() -> None:
    tables = scene_tables([])
    assert len(tables.arrays.kind) == len(tables.arrays.tree_skip) == 0 and tables.arrays.open.tolist() == [0]


@pytest.mark.parametrize("count", [1, LEAF, LEAF + 1, 2 * LEAF + 1])
def test_the_tree_is_balanced(count: int) -> None:
    rng = np.random.default_rng(count)
    tables = scene_tables([(k, Primitive(SPHERE, random_pose(rng), (0.1,))) for k in range(count)])
    leaves = tables.arrays.tree_range[:, 1]
    assert leaves.sum() == count and leaves.max() <= LEAF
    assert len(leaves) == 2 * int((leaves > 0).sum()) - 1
