"""Distances of points and balls from a scene: against all obstacles one by one, and finite differences."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from apex_ompl.errors import ParameterError
from apex_ompl.kernel.arrays import HALF_SPACE
from apex_ompl.kernel.scene_builder import Primitive, scene_tables
from apex_ompl.kernel.scene_distances import group_clearances, nearest_points
from apex_ompl.kernel.tables import SceneTables
from apex_ompl.model.geometry import signed_distances
from apex_ompl.types import Array


def turned(rng: np.random.Generator) -> Array:
    q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    return q * np.sign(np.linalg.det(q))


def scene(count: int, seed: int = 0) -> tuple[SceneTables, list[Primitive]]:
    rng = np.random.default_rng(seed)
    solids = []
    for _ in range(count):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = turned(rng), rng.uniform(-1, 1, 3)
        solids.append(Primitive(int(rng.integers(4)), pose, tuple(rng.uniform(0.02, 0.2, 3))))
    return scene_tables(list(enumerate(solids))), solids


def brute(solids: list[Primitive], points: Array) -> Array:
    """By the formulas of the networks, obstacle by obstacle, shape (obstacles, points)."""
    rows = [(p.kind, p.pose[:3, 3], p.pose[:3, :3], np.array(p.size)) for p in solids]
    kind, position, rotation, size = (np.array(c) for c in zip(*rows, strict=True))
    found: Array = signed_distances(kind, position, rotation, size, np.broadcast_to(points, (len(rows), *points.shape)))
    return found


@pytest.mark.parametrize("count", [1, 3, 40])
def test_distances_are_those_of_the_nearest_obstacle(count: int) -> None:
    tables, solids = scene(count)
    points = np.random.default_rng(1).uniform(-1.5, 1.5, (2000, 3))
    wanted = brute(solids, points).min(axis=0)
    found, gradients = nearest_points(tables, points)
    np.testing.assert_allclose(found, wanted, atol=1e-6)
    assert count == 1 or ((found < 0).any() and (found > 0.3).any())
    np.testing.assert_allclose(np.linalg.norm(gradients, axis=1), 1.0, atol=1e-9)
    limited, slopes = nearest_points(tables, points, 0.1)
    np.testing.assert_allclose(limited, np.minimum(found, 0.1), atol=1e-12)
    assert np.array_equal(slopes, np.where(found[:, None] < 0.1, gradients, 0.0))


def test_gradients_are_those_of_finite_differences() -> None:
    tables, _ = scene(12)
    points, step = np.random.default_rng(2).uniform(-1, 1, (400, 3)), 1e-6
    _, gradients = nearest_points(tables, points)
    moved = [nearest_points(tables, points + sign * step * axis)[0] for axis in np.eye(3) for sign in (1, -1)]
    numeric = np.stack([(moved[2 * k] - moved[2 * k + 1]) / (2 * step) for k in range(3)], axis=1)
    alike = np.abs(numeric - gradients).max(axis=1) < 1e-4
    assert alike.mean() > 0.97  # but for points where the nearest feature changes


def test_obstacles_that_do_not_count_are_left_out() -> None:
    tables, solids = scene(9)
    points = np.random.default_rng(3).uniform(-1, 1, (300, 3))
    chosen = np.arange(9) % 2 == 0  # by owner; the tables have another order
    seen = chosen[tables.arrays.owner]
    wanted = brute([p for p, kept in zip(solids, chosen, strict=True) if kept], points).min(axis=0)
    np.testing.assert_allclose(nearest_points(tables, points, seen=seen)[0], wanted, atol=1e-6)
    none, slopes = nearest_points(tables, points, 0.5, np.zeros(9, bool))
    assert (none == 0.5).all() and not slopes.any()


def test_a_half_space_and_an_empty_scene() -> None:
    floor = scene_tables([(0, Primitive(HALF_SPACE, np.eye(4), (0.0, 0.0, 1.0, 0.2)))])
    found, gradients = nearest_points(floor, [[0.3, 0.1, 1.0], [0.0, 0.0, -1.0]])
    np.testing.assert_allclose(found, [0.8, -1.2])
    np.testing.assert_allclose(gradients, [[0, 0, 1], [0, 0, 1]])
    assert nearest_points(scene_tables([]), np.zeros((2, 3)), 0.4)[0].tolist() == [0.4, 0.4]
    assert nearest_points(floor, np.zeros((0, 3)))[0].shape == (0,)


def test_groups_have_the_clearance_of_their_nearest_ball() -> None:
    tables, solids = scene(25)
    rng = np.random.default_rng(4)
    centers = rng.uniform(-1, 1, (60, 5, 1, 3)) + rng.normal(0.0, 0.05, (60, 5, 3, 3))
    radii = rng.uniform(0.02, 0.06, (60, 5, 3, 1))
    middle = centers.mean(axis=2, keepdims=True)
    reach = (np.linalg.norm(centers - middle, axis=-1, keepdims=True) + radii).max(axis=2, keepdims=True)
    balls = np.concatenate([np.concatenate([middle, reach], -1), np.concatenate([centers, radii], -1)], axis=2)
    each = brute(solids, centers.reshape(-1, 3)).min(axis=0).reshape(60, 5, 3) - radii[..., 0]
    wanted = each.min(axis=(1, 2))
    assert (wanted < 0).any() and (wanted > 0.1).any()
    np.testing.assert_allclose(group_clearances(tables, balls), wanted, atol=1e-6)
    np.testing.assert_allclose(group_clearances(tables, balls, 0.08), np.minimum(wanted, 0.08), atol=1e-6)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda s: nearest_points(s, np.zeros(3)), "points"),
        (lambda s: nearest_points(s, np.zeros((1, 3)), seen=np.ones(2, bool)), "obstacles that count"),
        (lambda s: group_clearances(s, np.zeros((2, 4))), "balls"),
    ],
)
def test_other_shapes_are_refused(call: SimpleNamespace, words: str) -> None:
    with pytest.raises(ParameterError, match=words):
        call(scene(3)[0])
