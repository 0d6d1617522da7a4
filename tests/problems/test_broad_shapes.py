"""Parts of broad scenes: their algebra, and the meshes and points that are made from them."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from parts import nearest, poses, some_parts

from apex_ompl.kernel.distance_grid import grid_of_triangles
from apex_ompl.problems import broad_parts
from apex_ompl.problems.broad_parts import Composition, at
from apex_ompl.problems.broad_representation import distances, mesh, surface_points, triangles
from apex_ompl.scene.meshes import edges_of, is_watertight


def test_combinators_agree_with_closed_forms() -> None:
    parts = some_parts()
    for axis in range(3):
        once = broad_parts.mirror(parts, axis)
        assert np.array_equal(poses(broad_parts.mirror(once, axis)), poses(parts))
        points = np.random.default_rng(1).uniform(-0.6, 0.6, (200, 3))
        flipped = points * np.where(np.arange(3) == axis, -1.0, 1.0)
        np.testing.assert_allclose(distances(once, flipped), distances(parts, points), atol=1e-12)
        np.testing.assert_allclose(np.linalg.det(poses(once)[:, :3, :3]), 1.0)
    pose = broad_parts.shift(0.1, 0.2, 0.3) @ broad_parts.turn((1, 2, 3), 0.7)
    back = broad_parts.place(broad_parts.place(parts, pose), np.linalg.inv(pose))
    np.testing.assert_allclose(poses(back), poses(parts), atol=1e-12)
    np.testing.assert_allclose(
        nearest(broad_parts.scale(parts, 2.0), 2.0 * points), 2.0 * nearest(parts, points), atol=1e-12
    )
    box = broad_parts.bounds(
        broad_parts.nest(parts, low := np.array([0.1, 0.2, 0.3]), high := np.array([0.4, 0.8, 0.5]))
    )
    assert (box[0] >= low - 1e-9).all() and (box[1] <= high + 1e-9).all()
    assert np.isclose((box[1] - box[0]) / (high - low), 1.0).any()
    left = broad_parts.extents(broad_parts.without(parts, -0.2 * np.ones(3), 0.2 * np.ones(3)))
    assert 0 < len(left) < len(parts) and ((left[:, 0] >= 0.2) | (left[:, 1] <= -0.2)).any(axis=1).all()
    rings = broad_parts.circle(7, 0.5)
    np.testing.assert_allclose([np.hypot(*p[:2, 3]) for p in rings], 0.5)
    np.testing.assert_allclose(sum(p[:2, 3] for p in rings), 0.0, atol=1e-12)
    assert len(broad_parts.grid((2, 3, 4), (1, 1, 1))) == 24
    np.testing.assert_allclose(sum(p[:3, 3] for p in broad_parts.grid((2, 3, 4), (1, 2, 3))), 0.0, atol=1e-12)
    extents = broad_parts.extents(parts)
    for k, part in enumerate(parts):
        on = surface_points(part, 0.01)
        assert (on >= extents[k, 0] - 1e-9).all() and (on <= extents[k, 1] + 1e-9).all()
        np.testing.assert_allclose([on.min(axis=0), on.max(axis=0)], extents[k], atol=0.012)


def test_windows_shells_tubes_and_curves_are_where_they_are_said_to_be() -> None:
    rng = np.random.default_rng(2)
    panel = broad_parts.window(1.0, 0.8, 0.02, (-0.2, -0.1), (0.15, 0.3))
    inside = np.column_stack([np.zeros(300), rng.uniform(-0.2, 0.15, 300), rng.uniform(-0.1, 0.3, 300)])
    assert len(panel) == 4 and (nearest(panel, inside) >= -1e-9).all()
    outside = np.column_stack([np.zeros(300), rng.uniform(-0.5, 0.5, 300), rng.uniform(0.31, 0.4, 300)])
    assert (nearest(panel, outside) < 0.0).all()
    shell = broad_parts.hollow_box(0.3, 0.4, 0.5, 0.02, ("near", "top"))
    assert len(shell) == 4 and nearest(shell, np.zeros((1, 3)))[0] == pytest.approx(0.15)
    assert nearest(shell, np.array([[-0.2, 0.0, 0.0]]))[0] > 0.1 and nearest(shell, np.array([[0.16, 0.0, 0.0]]))[0] < 0
    pipe = broad_parts.tube(0.2, 0.6, 0.01, 12)
    angles = rng.uniform(0.0, 2.0 * np.pi, 200)
    around = np.column_stack([np.cos(angles), np.sin(angles), rng.uniform(-0.29, 0.29, 200)])
    assert (nearest(pipe, around * (0.199, 0.199, 1.0)) > 0.0).all()
    assert (nearest(pipe, around * (0.2085, 0.2085, 1.0)) < 0.0).all()
    through = rng.uniform(-0.3, 0.3, (5, 3))
    curve = broad_parts.smooth(through, 41)
    np.testing.assert_allclose(curve[::10], through, atol=1e-12)
    assert (nearest(broad_parts.bend(curve, 0.02), curve) <= -0.02 + 1e-9).all()
    hung = broad_parts.sagging((0, 0, 1), (1, 0, 1), 0.25, 11)
    assert hung[5, 2] == pytest.approx(0.75) and hung[0, 2] == hung[-1, 2] == 1.0
    two = Composition(panel, [at(0.1, 0.2, 0.3, (0.0, 1.0, 0.0))]).mirrored()
    assert two.places[0].fingers == (0.0, -1.0, 0.0) and two.places[0].point.tolist() == [0.1, -0.2, 0.3]


def test_meshes_and_points_agree_with_the_parts_that_they_are_made_from() -> None:
    parts = [*some_parts(9), *broad_parts.ball(0.25), *broad_parts.rod((0.0, 0.0, 0.0), (0.1, 0.2, 0.4), 0.04)]
    rng = np.random.default_rng(3)
    around = rng.uniform(-0.8, 0.8, (120, 3))
    away = around[nearest(parts, around) > 0.01]
    for is_open in (False, True):
        vertices, faces = mesh(parts, is_open=is_open)
        corners = vertices[faces]
        assert is_open or is_watertight(corners)
        assert not (is_open and not len(edges_of(vertices, faces).open))
        on = rng.dirichlet((1, 1, 1), (len(faces), 20))
        samples = np.einsum("tsk,tkd->tsd", on, corners).reshape(-1, 3)
        gaps = np.linalg.norm(away[:, None] - samples[None, ::7], axis=2).min(axis=1)
        assert (gaps > nearest(parts, away) - 1e-6).all(), "a mesh lies in its parts"
        closest = trimesh.triangles.closest_point(
            np.tile(corners, (12, 1, 1)), np.repeat(away[:12], len(faces), axis=0)
        )
        gaps = np.linalg.norm(closest.reshape(12, -1, 3) - away[:12, None], axis=2).min(axis=1)
        np.testing.assert_allclose(gaps, nearest(parts, away[:12]), atol=0.02 * 0.25)
        grid = grid_of_triangles(corners, solid=not is_open)
        assert grid.box[0] == pytest.approx(broad_parts.bounds(parts)[0], abs=0.01)
    for part in parts:
        vertices, faces = triangles(part)
        assert is_watertight(vertices[faces])
        assert np.abs(distances([part], vertices)).max() < 1e-9
        middles = vertices[faces].mean(axis=1)
        assert -0.03 * max(part.size) < distances([part], middles).min() and distances([part], middles).max() < 1e-9
        a, b, c = np.moveaxis(vertices[faces] - part.pose[:3, 3], 1, 0)
        assert np.einsum("ij,ij->", a, np.cross(b, c)) > 0.0, "outwards"
        cloud, fine = surface_points(part, 0.02), surface_points(part, 0.012)
        assert np.linalg.norm(fine[:, None] - cloud[None], axis=2).min(axis=1).max() <= 0.75 * 0.02
        assert np.abs(distances([part], cloud)).max() < 1e-9
