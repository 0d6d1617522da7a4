"""Centers of mass and inertias of shapes against closed forms and random points."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from apex_ompl.collision.mass import held_load, per_mass
from apex_ompl.scene.bodies import AttachedObject

BOX = np.array([0.1, 0.2, 0.06])
BOX_MOMENTS = np.diag((BOX @ BOX - BOX**2) / 12.0)


def held(**fields: object) -> AttachedObject:
    return AttachedObject(name="thing", link="left_hand_palm", **fields)  # type: ignore[arg-type]


def of_points(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    center = points.mean(axis=0)
    second = (points - center).T @ (points - center) / len(points)
    return center, np.trace(second) * np.eye(3) - second


@pytest.mark.parametrize("shape", ["sphere", "cylinder", "capsule"])
def test_round_shapes_have_the_inertia_of_random_points_inside(shape: str) -> None:
    radius, length = 0.05, 0.0 if shape == "sphere" else 0.12
    reach = np.array([radius, radius, length / 2.0 + (shape != "cylinder") * radius])
    points = np.random.default_rng(0).uniform(-reach, reach, (400_000, 3))
    over = np.maximum(np.abs(points[:, 2]) - length / 2.0, 0.0)
    points = points[np.linalg.norm(np.column_stack([points[:, :2], over]), axis=1) <= radius]
    size = {"radius": radius} if shape == "sphere" else {"radius": radius, "length": length}
    center, inertia = per_mass(held(**{shape: size}))
    np.testing.assert_allclose(inertia, of_points(points)[1], atol=1e-2 * np.trace(inertia))
    np.testing.assert_allclose(center, 0.0, atol=1e-12)


def test_a_box_has_its_closed_form() -> None:
    center, inertia = per_mass(held(box=tuple(BOX)))
    np.testing.assert_allclose(inertia, BOX_MOMENTS, atol=1e-12)
    np.testing.assert_array_equal(center, 0.0)


@pytest.mark.parametrize("flip", [False, True])
def test_a_closed_mesh_counts_as_solid(tmp_path: Path, flip: bool) -> None:
    place = np.array([0.3, -0.1, 0.2])
    mesh = trimesh.creation.box(BOX)
    mesh.apply_translation(place)
    if flip:
        mesh.invert()
    mesh.export(tmp_path / "box.stl")
    center, inertia = per_mass(held(mesh={"file": str(tmp_path / "box.stl")}))
    np.testing.assert_allclose(center, place, atol=1e-6)
    np.testing.assert_allclose(inertia, BOX_MOMENTS, atol=1e-8)


def test_a_bent_mesh_has_the_inertia_that_trimesh_finds(tmp_path: Path) -> None:
    mesh = trimesh.creation.annulus(0.02, 0.05, 0.1)
    mesh.apply_translation([0.1, 0.0, 0.02])
    mesh.export(tmp_path / "ring.stl")
    center, inertia = per_mass(held(mesh={"file": str(tmp_path / "ring.stl")}))
    np.testing.assert_allclose(center, mesh.center_mass, atol=1e-6)
    np.testing.assert_allclose(inertia, mesh.moment_inertia / mesh.volume, atol=1e-7)


def test_a_surface_has_the_inertia_of_random_points_on_it(tmp_path: Path) -> None:
    mesh = trimesh.creation.box(BOX)
    mesh.update_faces(np.arange(len(mesh.faces)) > 1)
    mesh.export(tmp_path / "open.stl")
    points = trimesh.sample.sample_surface(mesh, 200_000, seed=0)[0]
    center, inertia = per_mass(held(mesh={"file": str(tmp_path / "open.stl"), "solid": False}))
    np.testing.assert_allclose(center, of_points(points)[0], atol=5e-4)
    np.testing.assert_allclose(inertia, of_points(points)[1], atol=1e-2 * np.trace(inertia))


def test_voxels_count_by_their_cells(tmp_path: Path) -> None:
    np.savez(tmp_path / "cells.npz", occupied=np.ones((10, 20, 6), bool), resolution=0.01, origin=-BOX / 2.0)
    center, inertia = per_mass(held(voxels={"file": str(tmp_path / "cells.npz")}))
    np.testing.assert_allclose(center, 0.0, atol=1e-9)
    np.testing.assert_allclose(inertia, BOX_MOMENTS, atol=1e-9)


def test_the_load_is_in_the_frame_of_the_link() -> None:
    pose = {"position": (0.1, 0.2, 0.3), "orientation": (0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5))}  # x becomes y
    load = held_load(held(box=tuple(BOX), mass=2.0, center_of_mass=(0.01, 0.0, 0.0), **pose))
    assert load is not None and load.mass == 2.0 and load.link == "left_hand_palm"
    np.testing.assert_allclose(load.center, [0.1, 0.21, 0.3], atol=1e-12)
    np.testing.assert_allclose(load.inertia, 2.0 * BOX_MOMENTS[[1, 0, 2]][:, [1, 0, 2]], atol=1e-12)
    given = held_load(held(box=tuple(BOX), mass=2.0, inertia=(1.0, 0.1, 0.0, 2.0, 0.0, 1.5)))
    assert given is not None
    np.testing.assert_array_equal(given.inertia, [[1.0, 0.1, 0.0], [0.1, 2.0, 0.0], [0.0, 0.0, 1.5]])
    assert held_load(held(box=tuple(BOX))) is None, "without a mass"
