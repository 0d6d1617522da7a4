"""Voxels, height fields, distance grids and meshes with or without an inside."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh
from geometry_files import bumpy_sphere
from support import ROOT, states_around_home

from apex_ompl.collision import CollisionChecker
from apex_ompl.collision.shapes import coal_geometry
from apex_ompl.errors import FileFormatError
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.scene.grids import parse_octomap, parse_surface, surface
from apex_ompl.scene.meshes import is_watertight, winding_number


def volume(corners: np.ndarray) -> float:
    a, b, c = np.moveaxis(corners, 1, 0)
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0)


def test_the_surface_of_cells_encloses_them() -> None:
    rng = np.random.default_rng(0)
    occupied = rng.random((5, 6, 7)) < 0.4
    vertices, faces = surface(occupied, 0.1, np.array([1.0, 2.0, 3.0]))
    corners = vertices[faces]
    assert volume(corners) == pytest.approx(occupied.sum() * 0.1**3) and is_watertight(corners)
    for cell in np.argwhere(np.ones_like(occupied)):
        middle = np.array([1.0, 2.0, 3.0]) + 0.1 * (cell + 0.5)
        assert (winding_number(middle, corners) > 0.5) == occupied[tuple(cell)]


def grid_obstacle(folder: Path, kind: str, **arrays: object) -> Obstacle:
    np.savez(folder / f"{kind}.npz", **arrays)  # type: ignore[arg-type]
    return Obstacle(name=kind, **{kind: {"file": str(folder / f"{kind}.npz")}})


def box_of(checker: CollisionChecker, name: str) -> np.ndarray:
    scene = checker.kernel.scene
    (row,) = np.flatnonzero(scene.arrays.owner == checker.meshes.scene[name])
    return np.asarray(scene.boxes[row])


@pytest.mark.parametrize("unknown", [-3.4028235e38, -1e20, 1e20])
def test_a_number_that_stands_for_no_height_is_no_height(tmp_path: Path, unknown: float) -> None:
    heights = np.full((4, 4), 0.5, np.float32)
    heights[1, 2] = unknown
    field = grid_obstacle(tmp_path, "voxels", heights=heights, resolution=0.05, origin=[0.4, -0.1, 0.2])
    with pytest.raises(FileFormatError, match="voxels.npz.*heights"):
        coal_geometry(field)


@pytest.mark.parametrize(("side", "origin"), [(1e300, 0.0), (1e4, 0.0), (0.1, 1e300), (0.1, -1e4)])
def test_grids_beyond_all_bounds_are_refused(tmp_path: Path, side: float, origin: float) -> None:
    cells = grid_obstacle(
        tmp_path, "voxels", occupied=np.ones((2, 2, 2), bool), resolution=side, origin=[origin, 0.0, 0.0]
    )
    with pytest.raises(FileFormatError, match="voxels.npz.*(resolution|origin)"):
        coal_geometry(cells)


def test_cells_are_seen_as_their_boxes(robot: Robot, tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    occupied = rng.random((6, 8, 6)) < 0.15
    origin, side = np.array([0.35, -0.32, 0.25]), 0.08
    cells = grid_obstacle(tmp_path, "voxels", occupied=occupied, resolution=side, origin=origin)
    boxes = [
        Obstacle(name=f"b{k}", box=(side,) * 3, position=tuple(origin + side * (cell + 0.5)))
        for k, cell in enumerate(np.argwhere(occupied))
    ]
    states = states_around_home(robot, rng, 200)
    first, second = CollisionChecker(robot, [cells]), CollisionChecker(robot, boxes)
    expected = second.are_free(states)
    assert 20 < expected.sum() < 190 and np.array_equal(first.are_free(states), expected)
    for q in states[expected][:10]:
        assert first.clearance(q) == pytest.approx(second.clearance(q), abs=2e-6)


def test_maps_of_octomap(robot: Robot) -> None:
    """The file was written by OctoMap, from 60 cells of random places and a block of 4 x 4 x 4, which it pruned."""
    file = ROOT / "tests" / "data" / "octomap.bt"
    occupied, side, origin = parse_octomap(file.read_bytes(), 10_000)
    cells = np.random.default_rng(0).integers(-6, 7, (60, 3)).tolist()
    cells += [[i, j, k] for i in range(8, 12) for j in range(8, 12) for k in range(4)]
    found = np.argwhere(occupied) + np.round(origin / side).astype(int)
    assert side == 0.05 and {tuple(c) for c in found.tolist()} == {tuple(c) for c in cells}
    body = Obstacle(name="map", voxels={"file": str(file)}, position=(0.0, 0.0, 2.0))
    assert CollisionChecker(robot, [body]).is_free(robot.home)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda data: data[:300], "cut off"),
        (lambda data: data.replace(b"id OcTree", b"id ColorOcTree"), "ColorOcTree"),
        (lambda data: data.replace(b"res 0.05", b"res -1"), "positive"),
        (lambda data: b"x" + data, "beginning"),
        (lambda _: b"# Octomap OcTree binary file\nid OcTree\nres 0.1\ndata\n\x00\x00", "no occupied cell"),
    ],
)
def test_faulty_maps_of_octomap(tmp_path: Path, change: Callable[[bytes], bytes], words: str) -> None:
    data = change((ROOT / "tests" / "data" / "octomap.bt").read_bytes())
    with pytest.raises(FileFormatError, match=words):
        parse_surface("map.bt", data)


def test_height_fields_are_full_below(robot: Robot, tmp_path: Path) -> None:
    heights = np.array([[0.1, 0.3], [0.2, 0.1]])
    field = grid_obstacle(tmp_path, "voxels", heights=heights, resolution=0.1, origin=[0.4, -0.1, 0.2])
    checker = CollisionChecker(robot, [field])
    assert box_of(checker, "voxels") == pytest.approx(np.array([[0.4, -0.1, 0.2], [0.6, 0.1, 0.5]]), abs=1e-6)


def test_distance_grids_are_full_where_the_surface_may_reach(robot: Robot, tmp_path: Path) -> None:
    side, low = 0.02, np.array([0.4, -0.1, 0.4])
    centers = low + side * (np.stack(np.meshgrid(*[np.arange(12)] * 3, indexing="ij"), axis=-1) + 0.5)
    distances = np.linalg.norm(centers - [0.52, 0.02, 0.52], axis=-1) - 0.05
    grid = grid_obstacle(tmp_path, "distance_grid", distances=distances, resolution=side, origin=low)
    ball = Obstacle(name="ball", sphere={"radius": 0.05}, position=(0.52, 0.02, 0.52))
    rng = np.random.default_rng(0)
    states = states_around_home(robot, rng, 200, spread=0.8)
    cells, exact = CollisionChecker(robot, [grid]).are_free(states), CollisionChecker(robot, [ball]).are_free(states)
    assert not (cells & ~exact).any() and cells.sum() > 0.8 * exact.sum()


@pytest.mark.parametrize(
    ("kind", "arrays", "words"),
    [
        ("voxels", {"occupied": np.ones((2, 2)), "resolution": 0.1, "origin": np.zeros(3)}, "array of 3 axes"),
        ("voxels", {"occupied": np.zeros((2, 2, 2)), "resolution": 0.1, "origin": np.zeros(3)}, "no cell that is full"),
        ("voxels", {"occupied": np.ones((2, 2, 2)), "resolution": -1.0, "origin": np.zeros(3)}, "resolution"),
        ("voxels", {"occupied": np.ones((2, 2, 2)), "resolution": 0.1, "origin": np.zeros(2)}, "origin"),
        ("voxels", {"occupied": np.full((2, 2, 2), np.nan), "resolution": 0.1, "origin": np.zeros(3)}, "not finite"),
        ("voxels", {"cells": np.ones((2, 2, 2)), "resolution": 0.1, "origin": np.zeros(3)}, "expected one array"),
        ("voxels", {"occupied": np.full((2, 2, 2), "x"), "resolution": 0.1, "origin": np.zeros(3)}, "expected numbers"),
        ("distance_grid", {"distances": np.ones((2, 2, 2))}, "npz file"),
    ],
)
def test_faulty_grids(robot: Robot, tmp_path: Path, kind: str, arrays: dict[str, object], words: str) -> None:
    with pytest.raises(FileFormatError, match=words):
        CollisionChecker(robot, [grid_obstacle(tmp_path, kind, **arrays)])


def test_too_many_cells_are_refused_before_they_are_read(robot: Robot, tmp_path: Path) -> None:
    many = np.broadcast_to(np.zeros(1, bool), (101, 1000, 1000))
    np.savez_compressed(tmp_path / "voxels.npz", occupied=many, resolution=0.01, origin=np.zeros(3))
    body = Obstacle(name="v", voxels={"file": str(tmp_path / "voxels.npz")})
    tracemalloc.start()
    with pytest.raises(FileFormatError, match="expected at most 100000000, got '101000000 cells'"):
        CollisionChecker(robot, [body])
    assert tracemalloc.get_traced_memory()[1] < 50e6
    tracemalloc.stop()


@pytest.mark.parametrize("suffix", ["stl", "obj", "ply", "glb", "dae", "off"])
def test_meshes_of_all_kinds_of_files_are_alike(robot: Robot, tmp_path: Path, suffix: str) -> None:
    vertices, faces = bumpy_sphere(8, 0.1, 0.3)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    if suffix in ("glb", "dae"):  # whose up is y, which trimesh writes without turning anything
        mesh.apply_transform(trimesh.transformations.rotation_matrix(-np.pi / 2, [1, 0, 0]))
    mesh.export(tmp_path / f"m.{suffix}")
    body = Obstacle(
        name="m", mesh={"file": str(tmp_path / f"m.{suffix}"), "scale": (1.0, 2.0, 1.0)}, position=(0.5, 0, 0.5)
    )
    checker = CollisionChecker(robot, [body])
    low, high = (vertices * [1.0, 2.0, 1.0]).min(axis=0), (vertices * [1.0, 2.0, 1.0]).max(axis=0)
    assert box_of(checker, "m") == pytest.approx(np.stack([low, high]) + [0.5, 0.0, 0.5], abs=1e-5)


def test_a_solid_with_holes_says_where_they_are(robot: Robot, tmp_path: Path) -> None:
    vertices, faces = bumpy_sphere(8, 0.1, 0.0)
    trimesh.Trimesh(vertices, faces[2:], process=False).export(tmp_path / "open.stl")
    mesh = {"file": str(tmp_path / "open.stl")}
    with pytest.raises(FileFormatError, match=r"holes?, around .*0\.09"):
        CollisionChecker(robot, [Obstacle(name="m", mesh={**mesh, "solid": True})])
    q = robot.home
    palm = tuple(robot.link_pose(q, "left_hand_palm")[:3, 3])
    around = {"scale": (5.0, 5.0, 5.0)}
    solid = CollisionChecker(robot, [Obstacle(name="m", mesh={**mesh, **around}, position=palm)])
    alone = CollisionChecker(robot, [Obstacle(name="m", mesh={**mesh, **around, "solid": False}, position=palm)])
    names = {contact.first for contact in solid.contacts(q)}
    assert "left_hand_palm" in names, "it is inside"
    assert "left_hand_palm" not in {contact.first for contact in alone.contacts(q)}, "there is no inside"


def test_a_sheet_is_a_surface(robot: Robot, tmp_path: Path) -> None:
    (tmp_path / "sheet.obj").write_text("v -1 -1 0\nv 1 -1 0\nv 1 1 0\nv -1 1 0\nf 1 2 3\nf 1 3 4\n")
    mesh = {"file": str(tmp_path / "sheet.obj"), "scale": (0.3, 0.3, 1.0)}
    with pytest.raises(FileFormatError, match="one plane"):
        CollisionChecker(robot, [Obstacle(name="s", mesh=mesh)])
    rng = np.random.default_rng(4)
    sheet = Obstacle(name="s", mesh={**mesh, "solid": False}, position=(0.5, 0.0, 0.6))
    plate = Obstacle(name="s", box=(0.6, 0.6, 1e-6), position=(0.5, 0.0, 0.6))
    states = states_around_home(robot, rng, 150, spread=0.7)
    first, second = (CollisionChecker(robot, [body]).are_free(states) for body in (sheet, plate))
    assert 10 < second.sum() < 145 and np.array_equal(first, second)
