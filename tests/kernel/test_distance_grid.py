"""Grids of distances against brute force: they are lower bounds, and near."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from geometry_files import bumpy_sphere
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from apex_ompl.collision.shapes import mesh_geometry
from apex_ompl.collision.tables import primitives
from apex_ompl.kernel import distance_grid
from apex_ompl.kernel.compiled.arrays import GRID, SceneArrays, scene_view
from apex_ompl.kernel.compiled.compilation import entry_point
from apex_ompl.kernel.compiled.geometry.signed_distance import ball_apart, direction, distance
from apex_ompl.kernel.compiled.layout import Floats, Integers, Singles
from apex_ompl.kernel.distance_grid import (
    SLACK,
    DistanceGrid,
    grid_of_points,
    grid_of_triangles,
    grid_of_triangles_beside,
)
from apex_ompl.kernel.scene_builder import Primitive, Solids, moved, primitive, scene_tables
from apex_ompl.scene.meshes import winding_number
from apex_ompl.util.arrays import bounding_box


@entry_point
def _evaluate(si: Integers, sf: Floats, sg: Singles, points: Floats, found: Floats) -> None:
    s = scene_view(si, sf, sg)
    for k in range(len(points)):
        found[k, 3] = distance(s, 0, points[k, 0], points[k, 1], points[k, 2])
        found[k, 0], found[k, 1], found[k, 2] = direction(s, 0, points[k, 0], points[k, 1], points[k, 2])


def evaluated(grid: DistanceGrid, pose: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    tables = scene_tables([(0, Primitive(GRID, pose, (), grid))])
    found = np.empty((len(points), 4))
    _evaluate(*tables.packed, np.ascontiguousarray(points), found)
    return found[:, 3], found[:, :3]


@entry_point
def _balls_apart(si: Integers, sf: Floats, sg: Singles, balls: Floats, found: Floats) -> None:
    s = scene_view(si, sf, sg)
    for k in range(len(balls)):
        x, y, z, radius = balls[k, 0], balls[k, 1], balls[k, 2], balls[k, 3]
        found[k, 0] = ball_apart(s, 0, x, y, z, radius)
        found[k, 1] = distance(s, 0, x, y, z, radius)


def apart(grid: DistanceGrid, pose: np.ndarray, points: np.ndarray, radii: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Whether balls are proved apart, and bounds of their centers' distances that suffice for their radii."""
    tables = scene_tables([(0, Primitive(GRID, pose, (), grid))])
    found = np.empty((len(points), 2))
    _balls_apart(*tables.packed, np.column_stack([points, radii]), found)
    return found[:, 0] > 0.0, found[:, 1]


def random_pose(rng: np.random.Generator) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.random(random_state=rng).as_matrix()
    pose[:3, 3] = rng.normal(size=3)
    return pose


def surface_distance(corners: np.ndarray, points: np.ndarray) -> np.ndarray:
    """By trimesh, triangle by triangle."""
    found = np.full(len(points), np.inf)
    for corner in corners:
        nearest = trimesh.triangles.closest_point(np.tile(corner, (len(points), 1, 1)), points)
        found = np.minimum(found, np.linalg.norm(points - nearest, axis=1))
    return found


@settings(max_examples=15)
@given(seed=st.integers(0, 10**6), size=st.floats(0.02, 0.5))
def test_a_grid_of_triangles_is_a_near_lower_bound(seed: int, size: float) -> None:
    rng = np.random.default_rng(seed)
    corners = rng.uniform(-size, size, (int(rng.integers(1, 6)), 3, 3))
    pose = random_pose(rng)
    grid = grid_of_triangles(corners, solid=False)
    points = np.concatenate([rng.uniform(-1.5 * size, 1.5 * size, (20, 3)), corners.mean(axis=1) + 1e-3])
    true = surface_distance(corners, points)
    found, _ = evaluated(grid, pose, points @ pose[:3, :3].T + pose[:3, 3])
    assert (found <= true + 1e-9).all()
    inside = ((points >= grid.low) & (points <= grid.low + grid.spacing * (np.array(grid.values.shape) - 1))).all(
        axis=1
    )
    assert (true - found)[inside].max() <= 4.0 * SLACK * grid.spacing + 1e-5
    assert (found >= true / np.sqrt(2.0) - 4.0 * SLACK * grid.spacing)[~inside].all()


def test_signs_are_those_of_the_winding_number() -> None:
    rng = np.random.default_rng(0)
    vertices, faces = bumpy_sphere(12, 0.15, 0.3)
    corners = vertices[faces]
    grid = grid_of_triangles(corners, solid=True)
    points = rng.uniform(-0.2, 0.2, (400, 3))
    found, _ = evaluated(grid, np.eye(4), points)
    inside = np.array([abs(winding_number(p, corners)) > 0.5 for p in points])
    assert inside.sum() > 40 and (found[inside] < 0.0).all()
    true = np.where(inside, -1.0, 1.0) * surface_distance(corners, points)
    assert (found <= true + 1e-9).all() and (true - found)[inside].max() <= 5.0 * SLACK * grid.spacing
    assert (found[~inside & (true > 3.0 * SLACK * grid.spacing)] > 0.0).all()


@settings(max_examples=25)
@given(seed=st.integers(0, 10**6), count=st.integers(1, 3000), radius=st.floats(0.0005, 0.05))
def test_a_grid_of_points_is_a_near_lower_bound(seed: int, count: int, radius: float) -> None:
    rng = np.random.default_rng(seed)
    cloud = rng.normal(size=(count, 3)) * rng.uniform(0.0, 0.3, 3)
    pose, places = random_pose(rng), rng.uniform(-0.6, 0.6, (200, 3))
    places = np.concatenate([places, cloud[:50]])
    grid = grid_of_points(cloud, radius)
    true = cKDTree(cloud).query(places)[0] - radius
    found, _ = evaluated(grid, pose, places @ pose[:3, :3].T + pose[:3, 3])
    assert (found <= true + 1e-9).all()
    inside = ((places >= grid.low) & (places <= grid.low + grid.spacing * (np.array(grid.values.shape) - 1))).all(
        axis=1
    )
    assert (true - found)[inside].max() <= 4.0 * SLACK * grid.spacing + 1e-5


@settings(max_examples=25)
@given(seed=st.integers(0, 10**6), count=st.integers(1, 3000), radius=st.floats(0.0005, 0.05))
def test_balls_are_apart_from_points_as_by_brute_force(seed: int, count: int, radius: float) -> None:
    rng = np.random.default_rng(seed)
    cloud = rng.normal(size=(count, 3)) * rng.uniform(0.0, 0.3, 3)
    pose, places, radii = random_pose(rng), rng.uniform(-0.6, 0.6, (300, 3)), rng.uniform(0.005, 0.2, 300)
    true = cKDTree(cloud).query(places)[0] - radius
    radii[:150] = np.maximum(true[:150] + rng.choice([-1e-4, 1e-4], 150), 1e-3)  # at the border
    found, bounds = apart(grid_of_points(cloud, radius), pose, places @ pose[:3, :3].T + pose[:3, 3], radii)
    assert not found[true < radii].any() and found[true > radii + 1e-5].all()
    assert (bounds <= true + 1e-9).all()


@settings(max_examples=10)
@given(seed=st.integers(0, 10**6), rows=st.integers(4, 20), waves=st.floats(0.0, 0.4))
def test_balls_are_apart_from_a_solid_as_by_brute_force(seed: int, rows: int, waves: float) -> None:
    rng = np.random.default_rng(seed)
    vertices, faces = bumpy_sphere(rows, 0.15, waves)
    corners, pose = vertices[faces], random_pose(rng)
    places, radii = rng.uniform(-0.25, 0.25, (200, 3)), rng.uniform(0.01, 0.1, 200)
    inside = np.array([abs(winding_number(p, corners)) > 0.5 for p in places])
    true = np.where(inside, -1.0, 1.0) * surface_distance(corners, places)
    radii[:100] = np.maximum(true[:100] + rng.choice([-1e-4, 1e-4], 100), 1e-2)
    found, bounds = apart(grid_of_triangles(corners, solid=True), pose, places @ pose[:3, :3].T + pose[:3, 3], radii)
    assert not found[true < radii].any() and found[true > radii + 1e-5].all()
    assert (bounds <= true + 1e-9).all()


def test_a_ball_deep_inside_of_a_solid_is_not_apart_though_no_triangle_is_near() -> None:
    vertices, faces = bumpy_sphere(20, 0.3, 0.0)
    grid = grid_of_triangles(vertices[faces], solid=True)
    assert not apart(grid, np.eye(4), np.zeros((1, 3)), np.array([0.02]))[0].any()
    assert not apart(grid, np.eye(4), np.full((1, 3), np.nan), np.array([0.02]))[0].any()


@given(seed=st.integers(0, 10**6), rows=st.integers(1, 50), corners=st.integers(1, 3))
def test_bounding_boxes_are_those_of_numpy(seed: int, rows: int, corners: int) -> None:
    points = np.random.default_rng(seed).normal(size=(rows, corners, 3))
    assert np.array_equal(bounding_box(points), [points.min(axis=(0, 1)), points.max(axis=(0, 1))])
    assert np.array_equal(bounding_box(points[:, 0]), [points[:, 0].min(axis=0), points[:, 0].max(axis=0)])


def test_a_grid_made_beside_is_the_one_that_is_asked_for() -> None:
    vertices, faces = bumpy_sphere(10, 0.12, 0.1)
    corners = vertices[faces]
    with grid_of_triangles_beside(corners, solid=True):
        pass
    grid = grid_of_triangles(corners, solid=True)
    with grid_of_triangles_beside(corners, solid=True):
        assert grid_of_triangles(corners, solid=True) is grid
    distance_grid._kept.clear()
    alone = grid_of_triangles(corners, solid=True)
    assert alone is not grid and np.array_equal(alone.block, grid.block)


def test_gradients_are_those_of_finite_differences() -> None:
    rng = np.random.default_rng(2)
    vertices, faces = bumpy_sphere(12, 0.15, 0.3)
    grid, pose = grid_of_triangles(vertices[faces], solid=True), random_pose(rng)
    points = rng.uniform(-0.4, 0.4, (300, 3)) @ pose[:3, :3].T + pose[:3, 3]
    _, gradients = evaluated(grid, pose, points)
    step, numeric = 1e-7, np.empty((300, 3))
    for k in range(3):
        offset = step * np.eye(3)[k]
        numeric[:, k] = evaluated(grid, pose, points + offset)[0] - evaluated(grid, pose, points - offset)[0]
    numeric /= np.linalg.norm(numeric, axis=1)[:, None]
    close = np.linalg.norm(gradients - numeric, axis=1) < 1e-3
    assert close.mean() > 0.97, "all but those at faces of cells, where the gradient jumps"
    assert np.linalg.norm(gradients, axis=1) == pytest.approx(1.0)


def test_states_that_are_not_numbers_are_never_far() -> None:
    grid = grid_of_points(np.zeros((1, 3)), 0.01)
    found, _ = evaluated(grid, np.eye(4), np.array([[np.nan, 0.0, 0.0], [np.inf, 0.0, 0.0]]))
    assert not (found > 0.0).any()


def test_scenes_share_values_and_follow_moves() -> None:
    vertices, faces = bumpy_sphere(8, 0.1, 0.2)
    grid, rng = grid_of_triangles(vertices[faces], solid=True), np.random.default_rng(0)
    assert grid_of_triangles(vertices[faces].copy(), solid=True) is grid
    other = grid_of_points(rng.normal(size=(20, 3)), 0.02)
    poses = [random_pose(rng) for _ in range(3)]
    solids = [Primitive(GRID, pose, (), one) for pose, one in zip(poses, (grid, other, grid), strict=True)]
    tables = scene_tables(list(enumerate(solids)))
    assert tables.arrays.values.size == len(grid.block) + len(other.block)
    for k, owner in enumerate(tables.arrays.owner):
        again = primitive(tables, k)
        assert again.grid is solids[owner].grid and again.pose == pytest.approx(solids[owner].pose)
    there = random_pose(rng)
    fresh = scene_tables([(0, solids[0]), (1, solids[1]), (2, solids[2]._replace(pose=there))])
    follows = moved(tables, 2, Solids.of([solids[2]._replace(pose=there)]))
    row, other_row = (list(t.arrays.owner).index(2) for t in (fresh, follows))
    for name in ("rotation", "offset", "size"):
        assert getattr(follows.arrays, name)[other_row] == pytest.approx(getattr(fresh.arrays, name)[row])
    assert follows.boxes[other_row] == pytest.approx(fresh.boxes[row])


def test_meshes_that_enclose_nothing_for_sure_are_taken_as_boxes() -> None:
    vertices, faces = bumpy_sphere(8, 0.1, 0.0)
    (closed,) = primitives(mesh_geometry(vertices, faces), np.eye(4))
    assert closed.kind == GRID and closed.grid is not None and closed.grid.values.min() < -0.05
    assert isinstance(scene_tables([(0, closed)]).arrays, SceneArrays)
