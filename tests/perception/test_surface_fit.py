"""Drawings of triangles against rays, and the end of fits of a surface."""

from __future__ import annotations

from dataclasses import replace

import coal
import numpy as np
import pinocchio as pin

from apex_ompl.kernel.perception import FitSettings, SurfaceFit, draw_triangles, fit_surface
from apex_ompl.perception.surfaces import geometry_surface

LENS = np.array([60.0, 55.0, 31.3, 22.8])
SHAPE = 48, 64
SETTINGS = FitSettings(
    noise=0.001, floor=0.001, edge=0.5, point_share=1.0, contour_share=0.1, first=0.03, last=0.03, reach=0.03, steps=8
)


def rays() -> np.ndarray:
    """Return the directions through all pixels, with z = 1, shape (height, width, 3)."""
    rows, columns = np.mgrid[: SHAPE[0], : SHAPE[1]]
    return np.stack([(columns - LENS[2]) / LENS[0], (rows - LENS[3]) / LENS[1], np.ones(SHAPE)], axis=-1)


def test_triangles_are_drawn_where_rays_meet_them() -> None:
    rng = np.random.default_rng(4)
    centers, spreads = rng.uniform((-0.5, -0.4, 0.8), (0.5, 0.4, 1.5), (60, 1, 3)), np.geomspace(0.02, 0.6, 60)
    corners = centers + spreads[:, None, None] * rng.normal(size=(60, 3, 3)) * (1.0, 1.0, 0.2)
    faces = np.arange(180).reshape(60, 3)
    depth, index = draw_triangles(corners.reshape(-1, 3), faces, LENS, *SHAPE)
    a, b, c = corners.transpose(1, 0, 2)
    towards = np.linalg.det(np.stack([a, b, c], axis=1)) < 0.0
    assert 10 < np.count_nonzero(towards) < 50
    matrix = np.stack([a, b, c], axis=-1)  # a ray is a sum of the corners with positive weights
    weights = np.linalg.solve(matrix[None, None], rays()[:, :, None, :, None])[..., 0]
    inside = (weights > 1e-9).all(axis=-1) & towards
    met = np.where(inside, 1.0 / weights.sum(axis=-1), np.inf)
    expected = met.min(axis=-1)
    np.testing.assert_array_equal(np.isfinite(depth), np.isfinite(expected))
    np.testing.assert_allclose(depth[index >= 0], expected[index >= 0], rtol=1e-9)
    np.testing.assert_array_equal(index[index >= 0], met.argmin(axis=-1)[index >= 0])
    assert np.count_nonzero(index >= 0) > 500


def fitted(settings: FitSettings, steps: int | None = None) -> tuple[SurfaceFit, np.ndarray]:
    """Return the fit to points of a box from a start 20 mm and 0.1 rad away, and the true pose."""
    surface = geometry_surface(coal.Box(0.3, 0.2, 0.25), "box", 16)
    pose = np.asarray(pin.SE3(pin.exp3(np.array([0.5, 0.7, 0.2])), np.array([0.02, -0.01, 1.0])).homogeneous)
    placed = surface.at(pose)
    depth, index = draw_triangles(placed.vertices, placed.faces, LENS, *SHAPE)
    points = (rays() * np.where(index >= 0, depth, 0.0)[..., None])[index >= 0]
    beyond = np.where(index >= 0, 0.0, 1.0)
    start = pose.copy()
    start[:3, :3] = np.asarray(pin.exp3(np.array([0.06, -0.06, 0.05]))) @ start[:3, :3]
    start[:3, 3] += 0.01, -0.012, 0.012
    found = fit_surface(
        points, beyond, LENS, surface.vertices, surface.faces, np.arange(3), 0, start, start, np.eye(6), settings,
        steps=steps,
    )  # fmt: skip
    return found, pose


def test_a_fit_of_exact_points_finds_the_pose() -> None:
    found, pose = fitted(SETTINGS)
    np.testing.assert_allclose(found.position, pose[:3, 3], atol=1e-3)
    np.testing.assert_allclose(found.rotation, pose[:3, :3], atol=5e-3)


def test_a_fit_ends_after_a_small_step() -> None:
    """Where every step is small enough, the first one is the last; where none is, all are taken."""
    one, all_steps = fitted(SETTINGS, 1)[0], fitted(SETTINGS)[0]
    early, late = (fitted(replace(SETTINGS, settled=value))[0] for value in (10.0, 0.0))
    for found, expected in ((early, one), (late, all_steps)):
        assert found.cost == expected.cost
        np.testing.assert_array_equal(found.position, expected.position)
        np.testing.assert_array_equal(found.information, expected.information)
    assert not np.array_equal(one.position, all_steps.position)
    fewer, pose = fitted(replace(SETTINGS, settled=1e-3))
    assert np.linalg.norm(fewer.position - pose[:3, 3]) < 2e-3
