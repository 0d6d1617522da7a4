"""Surfaces of parts: distances to them, triangles, and points that cover them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from apex_ompl.kernel.geometry import primitive_distances
from apex_ompl.problems.broad.shapes import BOX, CAPSULE, CYLINDER, Part, kernel_columns
from apex_ompl.types import Array

SIDES, STACKS = 24, 6  # around a round part, and from the middle to the pole of a half ball
HIDDEN = 1e-3  # depth in another part at which a triangle is left out of an open mesh [m]


def distances(parts: Sequence[Part], points: Array) -> Array:
    """Return the signed distances of points, shape (n, 3), to each part, shape (parts, n) [m]."""
    columns = zip(*kernel_columns(parts), strict=True)
    rows = [
        primitive_distances(np.ascontiguousarray((points - offset) @ rotation), int(kind), size)
        for kind, rotation, offset, size in columns
    ]
    return np.array(rows).reshape(len(parts), len(points))


def triangles(part: Part) -> tuple[Array, NDArray[np.int64]]:
    """Return the vertices, shape (V, 3) [m], and the triangles, shape (T, 3), of a part; they lie on its surface."""
    from trimesh import creation  # takes half a second

    if part.kind == BOX:
        made = creation.box(part.size)
    else:
        made = creation.revolve(_profile(part), sections=SIDES)
    return made.vertices @ part.pose[:3, :3].T + part.pose[:3, 3], np.asarray(made.faces, np.int64)


def _profile(part: Part) -> Array:
    """Return radius and height of the rings of a round part, from the lower pole to the upper, shape (n, 2) [m]."""
    radius, half = part.size[0], part.size[1] / 2.0
    if part.kind == CYLINDER:
        return np.array([[0.0, -half], [radius, -half], [radius, half], [0.0, half]])
    angles = np.linspace(0.0, np.pi / 2, STACKS + 1)
    upper = np.stack([radius * np.cos(angles), half + radius * np.sin(angles)], axis=1)
    upper[-1, 0] = 0.0
    lower = (upper * (1.0, -1.0))[::-1]
    return np.concatenate([lower, upper if part.kind == CAPSULE else upper[1:]])


def mesh(parts: Sequence[Part], *, is_open: bool) -> tuple[Array, NDArray[np.int64]]:
    """Return one mesh of parts: vertices, shape (V, 3) [m], and triangles, shape (T, 3).

    Args:
        parts: The parts.
        is_open: Whether triangles inside of other parts are left out; the union of the parts keeps its surface.
    """
    vertices, faces, count = [], [], 0
    for k, part in enumerate(parts):
        own, corners = triangles(part)
        if is_open and len(parts) > 1:
            others = [*parts[:k], *parts[k + 1 :]]
            near = [o for o in others if _reach(o) + _reach(part) > np.linalg.norm(o.pose[:3, 3] - part.pose[:3, 3])]
            if near:
                inside = distances(near, own) < -HIDDEN
                corners = corners[~inside[:, corners].all(axis=2).any(axis=0)]  # parts are convex
        vertices.append(own)
        faces.append(corners + count)
        count += len(own)
    return np.concatenate(vertices), np.concatenate(faces)


def _reach(part: Part) -> float:
    """Return the radius of a ball around a part [m]."""
    if part.kind == BOX:
        return float(np.linalg.norm(part.size)) / 2.0
    return part.size[0] + part.size[1] / 2.0


def surface_points(part: Part, spacing: float) -> Array:
    """Return points, shape (n, 3) [m], on a part, every point of its surface at most ``spacing / sqrt(2)`` away."""
    if part.kind == BOX:
        local = _box_points(np.array(part.size), spacing)
    else:
        profile = _profile_points(part, spacing)
        rows = []
        for r, z in profile:
            count = max(1, int(np.ceil(2.0 * np.pi * r / spacing)))
            angles = np.arange(count) * 2.0 * np.pi / count
            rows.append(np.stack([r * np.cos(angles), r * np.sin(angles), np.full(count, z)], axis=1))
        local = np.concatenate(rows)
    found: Array = local @ part.pose[:3, :3].T + part.pose[:3, 3]
    return found


def _steps(length: float, spacing: float) -> Array:
    """Return coordinates from one end of a length to the other, at most ``spacing`` apart, about 0 [m]."""
    return np.linspace(-length / 2, length / 2, int(np.ceil(length / spacing)) + 1)


def _box_points(size: Array, spacing: float) -> Array:
    found = []
    for axis in range(3):
        u, v = (k for k in range(3) if k != axis)
        across, up = np.meshgrid(_steps(size[u], spacing), _steps(size[v], spacing), indexing="ij")
        for side in (-0.5, 0.5):
            points = np.empty((across.size, 3))
            points[:, axis], points[:, u], points[:, v] = side * size[axis], across.ravel(), up.ravel()
            found.append(points)
    return np.unique(np.concatenate(found), axis=0)


def _profile_points(part: Part, spacing: float) -> Array:
    """Return radius and height of circles on a round part, at most ``spacing`` apart along it, shape (n, 2) [m]."""
    radius, half = part.size[0], part.size[1] / 2.0
    if part.kind == CYLINDER:
        rays = np.linspace(0.0, radius, int(np.ceil(radius / spacing)) + 1)
        walls = np.stack([np.full(len(z := _steps(2 * half, spacing)), radius), z], axis=1)
        caps = [np.stack([rays[:-1], np.full(len(rays) - 1, z)], axis=1) for z in (-half, half)]
        return np.concatenate([walls, *caps])
    angles = np.linspace(0.0, np.pi / 2, int(np.ceil(np.pi / 2 * radius / spacing)) + 1)
    upper = np.stack([radius * np.cos(angles), half + radius * np.sin(angles)], axis=1)
    walls = np.stack([np.full(len(z := _steps(2 * half, spacing)), radius), z], axis=1)
    return np.concatenate([upper, upper * (1.0, -1.0), walls if half else upper[:0]])
