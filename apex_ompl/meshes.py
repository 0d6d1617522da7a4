"""Triangle meshes as arrays: faults, pieces, closedness, inside and outside."""

from __future__ import annotations

import coal
import numpy as np
from numpy.typing import NDArray

LARGEST = 1e4  # coordinates beyond are taken for a fault [m]


def triangles(mesh: coal.BVHModelBase) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return the vertices, shape (V, 3) [m], and the vertex indices of the triangles, shape (T, 3)."""
    faces = [mesh.tri_indices(k) for k in range(mesh.num_tris)]
    return np.array(mesh.vertices()), np.array([[t[0], t[1], t[2]] for t in faces])


def extent_fault(vertices: NDArray[np.float64]) -> str:
    """Return why vertices, shape (V, 3) [m], cannot be those of a solid, or an empty text.

    They must be finite, of sane size, and not all in one plane; Coal ends the process over others.
    """
    if not (np.isfinite(vertices).all() and np.abs(vertices).max() < LARGEST):
        return "vertices that are not finite or too far away"
    spread = np.linalg.svd(vertices - vertices.mean(axis=0), compute_uv=False)
    if len(vertices) < 4 or spread[2] <= 1e-9 * max(spread[0], 1e-9):
        return "vertices that all lie in one plane"
    return ""


def orientation_fault(vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> str:
    """Return that neighbouring triangles are not oriented alike, or an empty text.

    Holes are let pass: what is inside is then decided by the generalised winding number.

    Args:
        vertices: Shape (V, 3) [m].
        faces: Indices of the corners, shape (T, 3).
    """
    edges = _edges(vertices, faces)
    turned = edges[:, 0] > edges[:, 1]
    _, place, uses = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True, return_counts=True)
    balance = np.bincount(place.ravel(), weights=np.where(turned, -1.0, 1.0))
    if ((balance != 0) & (uses > 1)).any():
        return "neighbouring triangles that are oriented against each other"
    return ""


def is_closed(vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> bool:
    """Whether every edge of a mesh belongs to more than one triangle."""
    edges = np.sort(_edges(vertices, faces), axis=1)
    return bool((np.unique(edges, axis=0, return_counts=True)[1] > 1).all())


def _edges(vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the directed edges of all triangles as numbers of places, shape (E, 2), without those of slivers."""
    corners = weld(vertices)[faces]
    corners = corners[(corners != np.roll(corners, 1, axis=1)).all(axis=1)]
    return np.concatenate([corners[:, [k, (k + 1) % 3]] for k in range(3)])


def weld(vertices: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return for every vertex, shape (V, 3), the number of its place; vertices at one place share it."""
    scale = max(float(np.abs(vertices).max()), 1e-9)
    return np.unique(np.round(vertices / scale, 9), axis=0, return_inverse=True)[1].ravel()


def piece_points(vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return one vertex of every connected piece of a mesh, shape (pieces, 3)."""
    corners = weld(vertices)[faces]
    label = np.arange(int(corners.max()) + 1)
    while True:
        least = label[corners].min(axis=1)
        new = label.copy()
        for column in corners.T:
            np.minimum.at(new, column, least)
        if np.array_equal(new, label):
            break
        label = new
    _, first = np.unique(label[corners[:, 0]], return_index=True)
    points: NDArray[np.float64] = vertices[faces[first, 0]]
    return points


def winding_number(point: NDArray[np.float64], corners: NDArray[np.float64]) -> float:
    """Return how often a closed triangle mesh winds around a point: about 1 inside, 0 outside.

    Args:
        point: Shape (3,), not on the surface.
        corners: Corners of the triangles, shape (T, 3, 3), counter-clockwise from outside.

    The solid angle of each triangle is taken by the formula of van Oosterom and Strackee (1983).
    """
    a, b, c = np.moveaxis(corners - point, 1, 0)
    la, lb, lc = (np.linalg.norm(v, axis=1) for v in (a, b, c))
    numerator = np.einsum("ij,ij->i", a, np.cross(b, c))
    dots = [np.einsum("ij,ij->i", u, v) for u, v in ((a, b), (b, c), (c, a))]
    denominator = la * lb * lc + dots[0] * lc + dots[1] * la + dots[2] * lb
    return float(np.arctan2(numerator, denominator).sum() / (2.0 * np.pi))
