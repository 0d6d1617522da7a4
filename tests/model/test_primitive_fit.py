"""Primitives fitted to grids of distances, against the solids that the grids were made from, and against scipy."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import coal
import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage
from scipy.spatial.transform import Rotation

import apex_ompl
from apex_ompl.apex.models import make_query
from apex_ompl.collision import CollisionChecker
from apex_ompl.collision.cloud_contact import signed_distances
from apex_ompl.kernel import Primitive, scene_tables
from apex_ompl.kernel.arrays import BOX, CYLINDER, GRID, HALF_SPACE, SPHERE
from apex_ompl.kernel.compiled.geometry.grid_regions import OCCUPIED, OUTSIDE, add_up, best_box, label_regions
from apex_ompl.kernel.distance_grid import grid_of_points, grid_of_triangles
from apex_ompl.kernel.scene_builder import primitive
from apex_ompl.model.primitive_fit import FittedShapes, fitted_shapes, scene_of_primitives
from apex_ompl.problems import load
from apex_ompl.problems.suite_robot import robot
from apex_ompl.scene.bodies import Obstacle


def solid(kind: int, size: np.ndarray) -> coal.CollisionGeometry:
    return {
        BOX: lambda: coal.Box(2.0 * size),
        SPHERE: lambda: coal.Sphere(size[0]),
        CYLINDER: lambda: coal.Cylinder(size[0], 2.0 * size[1]),
    }[kind]()


def union_distance(
    solids: Iterable[tuple[coal.CollisionGeometry, np.ndarray, np.ndarray]], points: np.ndarray
) -> np.ndarray:
    """Signed distances of points to the nearest of some solids at rotations and positions, by Coal."""
    found = [signed_distances(one, (points - position) @ rotation, 9.0) for one, rotation, position in solids]
    return np.min(found, axis=0)


def solids_of(shapes: FittedShapes) -> list[tuple[coal.CollisionGeometry, np.ndarray, np.ndarray]]:
    assert np.linalg.det(shapes.rotation) == pytest.approx(1.0)
    made = [solid(int(kind), size) for kind, size in zip(shapes.kind, shapes.size, strict=True)]
    return list(zip(made, shapes.rotation, shapes.position, strict=True))


@settings(max_examples=12)
@given(seed=st.integers(0, 10**6), kind=st.sampled_from([BOX, SPHERE, CYLINDER]), points=st.booleans())
def test_a_turned_solid_is_recognized(seed: int, kind: int, points: bool) -> None:
    rng = np.random.default_rng(seed)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.random(random_state=rng).as_matrix(), rng.normal(size=3)
    size = rng.uniform([0.05, 0.08, 0.18], [0.07, 0.12, 0.3])
    if kind == BOX:
        mesh = trimesh.creation.box(2.0 * size, pose)
    elif kind == SPHERE:
        mesh = trimesh.creation.icosphere(4, size[1]).apply_transform(pose)
    else:
        mesh = trimesh.creation.cylinder(size[0], 2.0 * size[2], sections=64, transform=pose)
    if points:
        grid = grid_of_points(trimesh.sample.sample_surface(mesh, 40_000, seed=seed)[0], 0.002)
    else:
        grid = grid_of_triangles(mesh.triangles, solid=True)
    found = fitted_shapes(grid)
    assert found.kind.tolist() == [kind]
    assert found.position[0] == pytest.approx(mesh.center_mass, abs=0.006)
    wanted = {BOX: size, SPHERE: [size[1], 0.0, 0.0], CYLINDER: [size[0], size[2], 0.0]}[kind]
    assert np.sort(found.size[0]) == pytest.approx(np.sort(wanted), abs=0.006)
    near = mesh.bounds[0] - 0.1 + rng.random((200, 3)) * (np.ptp(mesh.bounds, axis=0) + 0.2)
    geometry = solid(kind, {BOX: size, SPHERE: size[1:], CYLINDER: size[[0, 2]]}[kind])
    true = union_distance([(geometry, pose[:3, :3], pose[:3, 3])], near)
    gap = union_distance(solids_of(found), near) - true
    assert np.sqrt((gap**2).mean()) < 0.006


def test_points_on_furniture_become_its_boards_and_leave_windows_open() -> None:
    boxes = [((0.3, 0.02, 0.6), (0.0, y, 0.3)) for y in (-0.3, 0.3)]  # a shelf
    boxes += [((0.3, 0.6, 0.02), (0.0, 0.0, z)) for z in (0.01, 0.3, 0.59)]
    boxes += [((0.04, 0.2, 0.6), (0.5, y, 0.3)) for y in (-0.25, 0.25)]  # a wall with a window
    boxes += [((0.04, 0.3, 0.2), (0.5, 0.0, z)) for z in (0.1, 0.5)]
    parts = [trimesh.creation.box(edges).apply_translation(place) for edges, place in boxes]
    parts.append(trimesh.creation.cylinder(0.02, 0.4, sections=48).apply_translation([0.0, 0.0, 0.9]))
    solids = [(coal.Box(np.array(edges)), np.eye(3), np.array(place)) for edges, place in boxes]
    solids.append((coal.Cylinder(0.02, 0.4), np.eye(3), np.array([0.0, 0.0, 0.9])))
    cloud = np.concatenate([trimesh.sample.sample_surface(part, int(part.area / 4e-6), seed=1)[0] for part in parts])
    found = fitted_shapes(grid_of_points(cloud, 0.002))
    assert len(found.kind) <= 12 and np.count_nonzero(found.kind == CYLINDER) == 1
    rng = np.random.default_rng(0)
    places = rng.uniform([-0.4, -0.5, -0.1], [0.7, 0.5, 1.1], (1500, 3))
    true = union_distance(solids, places)
    gap = (union_distance(solids_of(found), places) - true)[true > 0.0]
    assert np.sqrt((gap**2).mean()) < 0.004 and np.abs(gap).max() < 0.015
    assert union_distance(solids_of(found), np.array([[0.5, 0.0, 0.3]]))[0] == pytest.approx(0.1, abs=0.015)


def test_nothing_is_found_of_points_far_outside_of_each_other_but_themselves() -> None:
    found = fitted_shapes(grid_of_points(np.array([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]]), 0.01))
    assert len(found.kind) == 2
    assert np.sort(found.position[:, 0]) == pytest.approx([0.0, 1.0], abs=0.02)


def test_the_number_of_primitives_is_limited() -> None:
    rng = np.random.default_rng(0)
    found = fitted_shapes(grid_of_points(rng.uniform(size=(400, 3)), 0.02))
    assert 0 < len(found.kind) <= 48 and np.isfinite(found.size).all() and (found.size[:, 0] > 0.0).all()


def test_a_scene_of_primitives_keeps_all_but_grids() -> None:
    """Owners, places and what may touch are those of the scene; a mesh becomes what it looks like, where it stands."""
    rng = np.random.default_rng(3)
    pose, ball = np.eye(4), np.eye(4)
    pose[:3, :3], pose[:3, 3], ball[:3, 3] = Rotation.random(random_state=rng).as_matrix(), [0.4, 0.1, 0.6], [0, 0.5, 0]
    grid = grid_of_triangles(trimesh.creation.box([0.2, 0.3, 0.4]).triangles, solid=True)
    plane = Primitive(HALF_SPACE, np.eye(4), (0.0, 0.0, 1.0, -0.1))
    solids = [(4, Primitive(GRID, pose, (), grid)), (7, Primitive(SPHERE, ball, (0.1,))), (9, plane)]
    tables = scene_tables(solids)
    tables = replace(tables, arrays=tables.arrays._replace(allowed=np.array([[2, 7]], np.int64)))
    found = scene_of_primitives(tables)
    assert found is not None and scene_of_primitives(found) is None and scene_of_primitives(tables) is found
    by_owner = {int(owner): primitive(found, k) for k, owner in enumerate(found.arrays.owner)}
    assert found.arrays.allowed.tolist() == [[2, 7]] and sorted(by_owner) == [4, 7, 9]
    assert by_owner[4].kind == BOX and by_owner[7].kind == SPHERE and by_owner[9].kind == HALF_SPACE
    assert by_owner[7].pose == pytest.approx(ball) and by_owner[7].size[0] == 0.1
    near = pose[:3, 3] + rng.uniform(-0.4, 0.4, (300, 3))
    likeness = [(coal.Box(2.0 * np.array(by_owner[4].size)), by_owner[4].pose[:3, :3], by_owner[4].pose[:3, 3])]
    gap = union_distance(likeness, near) - union_distance([(coal.Box(0.2, 0.3, 0.4), pose[:3, :3], pose[:3, 3])], near)
    assert np.sqrt((gap**2).mean()) < 0.006


@settings(max_examples=30)
@given(seed=st.integers(0, 10**6), share=st.floats(0.05, 0.7))
def test_regions_are_those_of_scipy(seed: int, share: float) -> None:
    rng = np.random.default_rng(seed)
    cells = np.zeros((9, 8, 7), np.int64)
    cells[1:-1, 1:-1, 1:-1] = rng.random((7, 6, 5)) < share
    filled = ndimage.binary_fill_holes(cells)
    labels, count = ndimage.label(filled)
    assert label_regions(cells, np.empty(cells.size, np.int64)) == count
    assert np.array_equal(cells != OUTSIDE, filled)
    pairs = set(zip(labels[filled].tolist(), cells[filled].tolist(), strict=True))
    assert len(pairs) == count and (cells[filled] > OCCUPIED).all()


@settings(max_examples=30)
@given(seed=st.integers(0, 10**6))
def test_boxes_grow_inside_of_what_is_marked(seed: int) -> None:
    rng = np.random.default_rng(seed)
    marked = np.zeros((8, 7, 6), np.int64)
    for _ in range(3):
        a, b = (rng.integers(0, n, 2) for n in marked.shape[:2]), rng.integers(0, marked.shape[2], 2)
        marked[tuple(slice(min(e), max(e) + 1) for e in [*a, b])] = 1
    sums = np.zeros(tuple(n + 1 for n in marked.shape), np.int64)
    add_up(marked, sums)
    assert np.array_equal(sums[1:, 1:, 1:], marked.cumsum(0).cumsum(1).cumsum(2))
    left = marked * (rng.random(marked.shape) < 0.7)
    best = np.zeros((2, 3), np.int64)
    seeds = np.ascontiguousarray(np.argwhere(marked))
    count = best_box(sums, left, seeds, 1.0, np.empty((2, 3), np.int64), best)
    inside = tuple(slice(a, b) for a, b in best.T.tolist())
    assert marked[inside].all() and count == np.count_nonzero(left[inside])
    for axis in range(3):  # it cannot grow by another layer
        for layer in (best[0, axis] - 1, best[1, axis]):
            if 0 <= layer < marked.shape[axis]:
                wider = list(inside)
                wider[axis] = slice(layer, layer + 1)
                assert not marked[tuple(wider)].all()


@pytest.mark.parametrize("name", ["shelf/medium/800001", "posts/medium/800000"])
@pytest.mark.parametrize("kind", ["meshes", "points"])
def test_a_model_proposes_the_same_among_boxes_meshes_and_points(name: str, kind: str, tmp_path: Path) -> None:
    problem, model = load(name), apex_ompl.load_model("apex")
    scene, clouds = [], []
    for k, body in enumerate(problem.scene):
        if body.box is not None:
            mesh = trimesh.creation.box(body.box)
        else:
            assert body.cylinder is not None
            mesh = trimesh.creation.cylinder(body.cylinder.radius, body.cylinder.length, sections=64)
        if kind == "meshes":
            mesh.export(tmp_path / f"{k}.stl")
            place = {"position": body.position, "orientation": body.orientation}
            scene.append(Obstacle(name=body.name, mesh={"file": str(tmp_path / f"{k}.stl")}, **place))
        else:
            mesh.apply_transform(body.pose)
            clouds.append(trimesh.sample.sample_surface(mesh, int(mesh.area / 1e-5), seed=k)[0])
    if clouds:
        np.save(tmp_path / "cloud.npy", np.concatenate(clouds))
        scene = [Obstacle(name="cloud", points={"file": str(tmp_path / "cloud.npy"), "radius": 0.002})]
    start, goal = problem.start_state(robot().joint_names), problem.goal_states(robot().joint_names)[0]
    proposals = []
    for bodies in (problem.scene, scene, []):
        checker = CollisionChecker(robot(), bodies, problem.attached)
        query = make_query(checker, start, goal)
        generator = np.random.default_rng(0)
        proposals.append(model.propose(query, checker.kernel, 8, generator=generator).control)
    like, none = (np.sqrt(((other - proposals[0]) ** 2).mean()) for other in proposals[1:])
    assert like < 0.25 * none, "as those without obstacles are"
