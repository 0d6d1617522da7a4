"""Boxes around meshes and covers made of boxes, against the winding number and random points."""

from __future__ import annotations

from pathlib import Path

import coal
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support import ROOT

from apex_ompl.collision.cover.boxes import bounding_boxes
from apex_ompl.collision.cover.cylinder import cylinder_cover
from apex_ompl.collision.cover.proof import FINEST, FINEST_SHARE, Cover, uncovered_boxes
from apex_ompl.collision.cover.rough import rough_cover
from apex_ompl.collision.cover.solids import solid_of
from apex_ompl.scene.meshes import capped, triangles, winding_number

MESHES = sorted((ROOT / "problems" / "data").glob("*.obj"))


def load(path: Path, scale: np.ndarray) -> coal.BVHModelBase:
    return coal.MeshLoader().load(str(path), scale)


def points_inside(mesh: coal.BVHModelBase, rng: np.random.Generator, count: int) -> np.ndarray:
    vertices, faces = triangles(mesh)
    corners = vertices[faces]
    drawn = rng.uniform(vertices.min(axis=0), vertices.max(axis=0), (count, 3))
    surface = (corners * rng.dirichlet(np.ones(3), len(corners))[:, :, None]).sum(axis=1)
    return np.concatenate([drawn[[abs(winding_number(p, corners)) > 0.5 for p in drawn]], vertices, surface])


def in_boxes(boxes: np.ndarray, points: np.ndarray) -> np.ndarray:
    return ((points[:, None] >= boxes[:, 0]) & (points[:, None] <= boxes[:, 1])).all(axis=2).any(axis=1)


def answered_for(cover: Cover, points: np.ndarray) -> np.ndarray:
    """Whether each point is in a leaf and in all balls above it: what a walk down the tree relies on."""
    inside = np.linalg.norm(points[:, None] - cover.centers, axis=2) <= cover.radii
    for k, parent in enumerate(cover.parents):
        if parent >= 0:
            inside[:, k] &= inside[:, parent]
    return inside[:, cover.leaves].any(axis=1)


@pytest.mark.parametrize("columns", [1, 5, 8])
@pytest.mark.parametrize("path", MESHES, ids=lambda p: p.stem)
def test_boxes_and_covers_contain_a_mesh(path: Path, columns: int) -> None:
    rng = np.random.default_rng(columns)
    mesh = load(path, rng.uniform(0.3, 3.0, 3))
    inside = points_inside(mesh, rng, 1500)
    boxes = bounding_boxes(capped(*triangles(mesh)), columns)
    assert len(inside) > 200 and in_boxes(boxes, inside).all()
    assert not in_boxes(boxes[1:], inside).all() or columns > 1  # one box less is seen
    assert answered_for(rough_cover(mesh), inside).all()


def test_cavities_are_left_open() -> None:
    mesh = load(ROOT / "problems" / "data" / "cup.obj", np.ones(3))
    vertices, faces = triangles(mesh)
    boxes = bounding_boxes(vertices[faces])
    middle = (vertices.min(axis=0) + vertices.max(axis=0)) / 2.0
    assert abs(winding_number(middle, vertices[faces])) < 0.5 and not in_boxes(boxes, middle[None]).any()
    assert np.prod(boxes[:, 1] - boxes[:, 0], axis=1).sum() < 0.6 * np.prod(np.ptp(vertices, axis=0))


@settings(max_examples=40)
@given(sides=st.tuples(*[st.floats(0.002, 0.8)] * 3), seed=st.integers(0, 1000))
def test_covers_of_boxes_contain_them(sides: tuple[float, float, float], seed: int) -> None:
    half = np.array(sides) / 2.0
    cover = rough_cover(coal.Box(*sides))
    signs = np.array(list(np.ndindex(2, 2, 2))) * 2.0 - 1.0
    drawn = np.random.default_rng(seed).uniform(-half, half, (500, 3))
    assert answered_for(cover, np.concatenate([signs * half, drawn])).all()
    assert len(cover.leaves) <= 64
    smaller = Cover(cover.centers, cover.radii - 1e-3, cover.first, cover.count)
    assert not answered_for(smaller, signs * half).all()


@settings(max_examples=60)
@given(radius=st.floats(0.002, 0.5), share=st.floats(0.02, 60.0), seed=st.integers(0, 1000))
def test_covers_of_cylinders_contain_them(radius: float, share: float, seed: int) -> None:
    half = radius * share
    cover = cylinder_cover(radius, half) if share >= 1.0 else rough_cover(coal.Cylinder(radius, 2.0 * half))
    rng = np.random.default_rng(seed)
    angle, height = rng.uniform(0.0, 2.0 * np.pi, 3000), rng.uniform(-half, half, 3000)
    away = radius * np.sqrt(rng.uniform(0.0, 1.0, 3000))
    away[:1000], height[500:1500] = radius, half * rng.choice([-1.0, 1.0], 1000)  # on the surface, and on the edges
    points = np.stack([away * np.cos(angle), away * np.sin(angle), height], axis=1)
    assert answered_for(cover, points).all()
    smaller = Cover(cover.centers, cover.radii - 0.2 * radius, cover.first, cover.count)
    assert not answered_for(smaller, points).all()


@pytest.mark.parametrize(("radius", "half"), [(0.02, 0.05), (0.03, 0.03), (0.015, 0.15)])
def test_covers_of_cylinders_are_proved_and_near(radius: float, half: float) -> None:
    cover = cylinder_cover(radius, half)
    slack = 2.0 * max(FINEST, 2.0 * half * FINEST_SHARE)  # balls that meet in a point have none
    wider = Cover(cover.centers, cover.radii + slack, cover.first, cover.count)
    assert len(uncovered_boxes(solid_of(coal.Cylinder(radius, 2.0 * half)), wider)) == 0
    leaf = cover.leaves
    across = np.linalg.norm(cover.centers[leaf, :2], axis=1) + cover.radii[leaf] - radius
    along = np.abs(cover.centers[leaf, 2]) + cover.radii[leaf] - half
    assert len(leaf) <= 48 and max(across.max(), along.max()) < 0.2 * radius + 1e-5
