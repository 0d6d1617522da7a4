"""Meshes that are refused, meshes that are noted, and hulls that Coal does not make."""

from __future__ import annotations

from itertools import product
from pathlib import Path

import numpy as np
import pytest
import trimesh
from geometry_files import bumpy_sphere
from hypothesis import given, settings
from hypothesis import strategies as st
from support import CUBE_OBJ

from apex_ompl.collision import CollisionChecker, exact_shapes
from apex_ompl.collision.hulls import convex_hull, farthest, hull_planes
from apex_ompl.collision.shapes import coal_geometry, mesh_geometry, mesh_note
from apex_ompl.errors import FileFormatError
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import Obstacle

FLAT = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 0\nf 1 2 3\nf 2 4 3\n"


FLIPPED = CUBE_OBJ.replace("f 1 3 2", "f 1 2 3")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (FLAT, "one plane"),
        ("v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", "one plane"),
        (CUBE_OBJ.replace("v 1 1 1", "v nan 1 1"), "not finite"),
        (CUBE_OBJ.replace("v 1 1 1", "v 1e300 1 1"), "too far"),
        (FLIPPED, "oriented against each other"),
        ("", "expected a mesh of triangles .*, got 'an empty file'"),
        ("hello\n", "expected a mesh of triangles .*, got 'hello"),
    ],
)
def test_meshes_that_bound_no_solid_are_refused(robot: Robot, tmp_path, capfd, text: str, words: str) -> None:
    """In Coal, flat and infinite ones end the process."""
    file = tmp_path / "m.obj"
    file.write_text(text)
    with pytest.raises(FileFormatError, match=words):
        CollisionChecker(robot, [Obstacle(name="m", mesh={"file": str(file)})])
    assert capfd.readouterr() == ("", "")  # Coal prints lines of its own for numbers that are not finite


@pytest.mark.parametrize("solid", [None, True, False])
@pytest.mark.parametrize("index", [-1, 4, 99_999_999])
def test_faces_without_their_vertices_are_refused(tmp_path: Path, index: int, solid: bool | None) -> None:
    corners = "0 0 0\n1 0 0\n0 1 0\n0 0 1\n"
    head = "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
    head += "element face 4\nproperty list uchar int vertex_indices\nend_header\n"
    (tmp_path / "t.ply").write_text(f"{head}{corners}3 0 2 1\n3 0 1 3\n3 1 2 3\n3 0 3 {index}\n")
    with pytest.raises(FileFormatError, match="t.ply"):
        coal_geometry(Obstacle(name="o", mesh={"file": str(tmp_path / "t.ply"), "solid": solid}))


def test_meshes_that_are_no_proper_solids_are_noted(robot: Robot, tmp_path) -> None:
    def noted(text: str) -> tuple[str, bool]:
        file = tmp_path / "m.obj"
        file.write_text(text)
        room = Obstacle(name="m", mesh={"file": str(file), "scale": (6, 6, 6)}, position=(-3.0, -3.0, -3.0))
        return mesh_note(room), CollisionChecker(robot, [room]).is_free(robot.home)

    lines = [line.split() for line in CUBE_OBJ.splitlines()]
    turned = "\n".join(" ".join(row if row[0] == "v" else [row[0], *row[:0:-1]]) for row in lines)
    assert noted(CUBE_OBJ) == ("", False)
    note, free = noted(turned)
    assert "'m' (m.obj) is inside out" in note and not free
    note, free = noted(CUBE_OBJ.replace("f 5 6 7\n", ""))
    assert "'m' (m.obj) is not closed (3 open edges)" in note and not free
    assert mesh_note(Obstacle(name="b", box=(1.0, 1.0, 1.0))) == ""


CUBE_FACES = [(0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1), (2, 3, 7), (2, 7, 6), (0, 2, 6)]
CUBE_FACES += [(0, 6, 4), (1, 5, 7), (1, 7, 3)]


@pytest.mark.parametrize(
    ("size", "solid", "words"),
    [
        ((1e-9, 1e-9, 1e-9), None, "vertices no more than 1e-09 m apart, less than 1e-06 m"),
        ((5e-7, 5e-7, 5e-7), False, "vertices no more than 5e-07 m apart, less than 1e-06 m"),
        ((0.0, 0.0, 0.0), False, "vertices no more than 0 m apart"),
        ((1.0, 1.0, 1e-7), None, "vertices that all lie in one plane"),  # Coal crashes at hulls that are thinner
        ((1.0, 1e-7, 1e-7), None, "vertices that all lie in one plane"),
        ((2e-6, 2e-6, 2e-6), None, ""),
        ((2e-6, 2e-6, 2e-6), False, ""),
        ((1.0, 1.0, 2e-6), None, ""),
        ((5000.0, 0.0, 100.0), False, ""),
    ],
)
def test_meshes_as_small_or_as_thin_as_may_be(
    robot: Robot, tmp_path: Path, size: tuple[float, float, float], solid: bool | None, words: str
) -> None:
    vertices = np.array(list(product((0.0, 1.0), repeat=3))) * size
    trimesh.Trimesh(vertices, CUBE_FACES, process=False).export(tmp_path / "t.ply", vertex_normal=False)
    obstacle = Obstacle(name="m", mesh={"file": str(tmp_path / "t.ply"), "solid": solid}, position=(3.0, 0.0, 1.0))
    if words:
        with pytest.raises(FileFormatError, match=words):
            CollisionChecker(robot, [obstacle])
        return
    checker = CollisionChecker(robot, [obstacle])
    assert checker.is_free(robot.home) and checker.clearance(robot.home) > 0.0


def test_cells_that_are_too_small_are_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "v.npz", occupied=np.ones((2, 2, 2)), resolution=1e-8, origin=[0.0, 0.0, 0.0])
    with pytest.raises(FileFormatError, match=r"v\.npz: expected cells .*, got 'vertices no more than 2e-08 m apart"):
        coal_geometry(Obstacle(name="v", voxels={"file": str(tmp_path / "v.npz")}))


def test_a_mesh_with_a_hole_is_checked_by_the_winding_number(robot: Robot, tmp_path) -> None:
    file = tmp_path / "open.obj"
    file.write_text(CUBE_OBJ.replace("f 5 6 7\n", ""))
    for position, free in (((-3.0, -3.0, -3.0), False), ((20.0, 0.0, 0.0), True)):
        room = Obstacle(name="room", mesh={"file": str(file), "scale": (6, 6, 6)}, position=position)
        assert CollisionChecker(robot, [room]).is_free(robot.home) == free


def test_a_hull_of_too_many_neighbors_is_replaced_by_a_little_larger_one(robot: Robot, tmp_path) -> None:
    """Two cones of 600 triangles at one base: Coal takes no vertex of a hull with more than 255 neighbors."""
    count, file = 600, tmp_path / "cones.obj"
    turn = 2.0 * np.pi * np.arange(count) / count
    rim = np.stack([0.3 * np.cos(turn), 0.3 * np.sin(turn), 0.0 * turn], axis=1)
    vertices = np.concatenate([rim, [[0.0, 0.0, 0.2], [0.0, 0.0, -0.2]]])
    k = np.arange(count)
    up = np.stack([k, (k + 1) % count, np.full(count, count)], axis=1)
    down = np.stack([(k + 1) % count, k, np.full(count, count + 1)], axis=1)
    lines = [f"v {x} {y} {z}" for x, y, z in vertices]
    lines += [f"f {a} {b} {c}" for a, b, c in np.concatenate([up, down]) + 1]
    file.write_text("\n".join(lines) + "\n")
    obstacle = Obstacle(name="cones", mesh={"file": str(file)}, position=(0.0, 0.0, 3.0))
    shape = coal_geometry(obstacle)
    normals, offsets = hull_planes(convex_hull(shape))
    assert (vertices @ normals.T <= offsets + 1e-9).all()
    assert 1.0 <= convex_hull(shape).computeVolume() / (2.0 * np.pi * 0.3**2 * 0.2 / 3.0) < 1.02
    checker = CollisionChecker(robot, [obstacle])
    assert checker.is_free(robot.home)
    checker.move("cones", tuple(robot.link_pose(robot.home, "left_link7")[:3, 3]))
    assert not checker.is_free(robot.home)
    assert coal_geometry(obstacle) is shape  # loaded once


@settings(max_examples=25)
@given(seed=st.integers(0, 10**6), count=st.integers(1, 3000), flat=st.booleans())
def test_farthest_points_are_those_of_brute_force(seed: int, count: int, flat: bool) -> None:
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(count, 3)) * ([1.0, 1.0, 0.0] if flat else [1.0, 0.3, 0.1])
    directions = np.concatenate([rng.normal(size=(20, 3)), np.eye(3), -np.eye(3)])
    found, reach = farthest(directions, points)
    assert reach == pytest.approx((points @ directions.T).max(axis=0), abs=1e-12)
    assert np.einsum("ij,ij->i", points[found], directions) == pytest.approx(reach, abs=1e-12)


@pytest.mark.parametrize("shape", ["ball", "box", "capsule", "bumpy", "dented", "inside out"])
def test_convex_meshes_are_known_without_comparing_all_triangles_with_all_faces(
    monkeypatch: pytest.MonkeyPatch, shape: str
) -> None:
    made = {
        "box": lambda: trimesh.creation.box((0.1, 0.2, 0.3)).subdivide().subdivide().subdivide().subdivide(),
        "capsule": lambda: trimesh.creation.capsule(0.3, 0.1, count=[40, 40]),
    }
    mesh = made.get(shape, lambda: trimesh.creation.icosphere(4, 0.1))()
    vertices, faces = np.array(mesh.vertices), np.array(mesh.faces)
    if shape == "bumpy":
        vertices, faces = bumpy_sphere(35, 0.1, 0.3)
    elif shape == "dented":
        vertices[7] *= 0.98
    elif shape == "inside out":
        faces = faces[:, ::-1]
    geometry = mesh_geometry(vertices, faces)
    hull, corners = convex_hull(geometry), vertices[faces]
    normals, offsets = hull_planes(hull)
    depths = (offsets - corners.mean(axis=1) @ normals.T).min(axis=1)
    left = np.flatnonzero(~exact_shapes._on_hull(hull, corners))
    convex = shape not in ("bumpy", "dented")
    assert set(np.flatnonzero(depths > exact_shapes.CONVEX_TOLERANCE)) <= set(left)
    assert (len(left) == 0) == convex
    compared = list[int]()
    monkeypatch.setattr(exact_shapes, "hull_planes", lambda h: (compared.append(1), (normals, offsets))[1])
    found = exact_shapes._analyzed(geometry)
    assert (len(found.tree.leaf) == 0) == convex and len(compared) <= 2
    if shape == "dented":
        assert found.depth == pytest.approx(depths.max(), abs=1e-15)
