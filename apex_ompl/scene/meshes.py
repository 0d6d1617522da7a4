"""Triangle meshes as arrays: faults, pieces, closedness, inside and outside."""

from __future__ import annotations

import coal
import numpy as np
from numpy.typing import NDArray

BOX_PAD = 1e-6  # boxes are larger than what they must hold by this, to stand above rounding [m]
MOST_TRIANGLES = 200_000  # after which large ones are taken as they are
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


def bounding_boxes(corners: NDArray[np.float64], columns: int = 8) -> NDArray[np.float64]:
    """Return boxes that together contain the solid of a mesh, cavities left open, shape (boxes, 2, 3) [m].

    The mesh is cut into columns along one axis. A line along that axis through a point of the solid leaves the solid
    at both ends through the surface, inside the same column; so the box around what the column has of the surface
    contains what it has of the solid. The axis is the one with the least volume of boxes. A surface that is not
    closed gets one box around all of it, as points with a winding number over a half lie in its convex hull.

    Args:
        corners: Corners of the triangles, holes capped (see :func:`capped`), shape (T, 3, 3) [m].
        columns: How many along each of the two other axes.
    """
    if not _is_cycle(corners):
        columns = 1
    size = float(np.ptp(corners.reshape(-1, 3), axis=0).min())
    small = _halved(corners, 0.5 * size / columns)
    found = [_columns(small, np.delete(np.arange(3), axis), columns) for axis in range(3)]
    return min(found, key=lambda boxes: float(np.prod(boxes[:, 1] - boxes[:, 0], axis=1).sum()))


def _is_cycle(corners: NDArray[np.float64]) -> bool:
    """Whether every edge is run through as often one way as the other, so that winding numbers are whole."""
    edges = _edges(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3))
    turned = np.where(edges[:, 0] > edges[:, 1], -1.0, 1.0)
    place = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True)[1].ravel()
    return not np.bincount(place, weights=turned).any()


def _halved(corners: NDArray[np.float64], longest: float) -> NDArray[np.float64]:
    """Halve triangles, shape (T, 3, 3), along their longest edges until all edges are short, or there are many."""
    while len(corners) < MOST_TRIANGLES:
        edges = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2)
        large = edges.max(axis=1) > longest
        if not large.any():
            break
        turn = (edges[large].argmax(axis=1)[:, None] + np.arange(3)) % 3
        a, b, c = np.moveaxis(np.take_along_axis(corners[large], turn[:, :, None], axis=1), 1, 0)
        middle = (a + b) / 2.0
        corners = np.concatenate([corners[~large], np.stack([a, middle, c], 1), np.stack([middle, b, c], 1)])
    return corners


def _columns(corners: NDArray[np.float64], cut: NDArray[np.intp], columns: int) -> NDArray[np.float64]:
    """Return the boxes around triangles, shape (T, 3, 3), column by column; ``cut`` are the axes that are cut."""
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    width = np.maximum((high - low)[cut] / columns, 1e-12)
    least, most = corners.min(axis=1), corners.max(axis=1)
    first, last = (
        np.clip((v[:, cut] - low[cut]) / width, 0, columns - 1).astype(int) for v in (least - 1e-9, most + 1e-9)
    )
    boxes = np.full((columns, columns, 2, 3), np.inf)
    boxes[:, :, 1] = -np.inf
    span = (last - first).max(axis=0) + 1
    for shift in np.ndindex(*span):
        cell = first + shift
        here = (cell <= last).all(axis=1)
        x, y = cell[here].T
        floor, roof = least[here].copy(), most[here].copy()
        floor[:, cut] = np.maximum(floor[:, cut], low[cut] + cell[here] * width)
        roof[:, cut] = np.minimum(roof[:, cut], low[cut] + (cell[here] + 1) * width)
        np.minimum.at(boxes[:, :, 0], (x, y), floor)
        np.maximum.at(boxes[:, :, 1], (x, y), roof)
    found = boxes[np.isfinite(boxes).all(axis=(2, 3))]
    wide: NDArray[np.float64] = found + np.array([-BOX_PAD, BOX_PAD])[:, None]
    return wide


def capped(vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the corners of the triangles of a mesh, shape (T, 3, 3), with a fan of triangles over every hole.

    Args:
        vertices: Shape (V, 3) [m].
        faces: Indices of the corners, shape (T, 3), oriented alike.
    """
    corners = vertices[faces]
    if is_closed(vertices, faces):
        return corners
    place = weld(vertices)
    where = np.zeros((int(place.max()) + 1, 3))
    where[place] = vertices
    rows = place[faces]
    edges = np.concatenate([rows[:, [k, (k + 1) % 3]] for k in range(3)])
    edges = edges[edges[:, 0] != edges[:, 1]]
    _, index, inverse = np.unique(np.sort(edges, axis=1), axis=0, return_index=True, return_inverse=True)
    turned = np.where(edges[:, 0] > edges[:, 1], -1.0, 1.0)
    balance = np.bincount(inverse.ravel(), weights=turned)
    uses = np.bincount(inverse.ravel())
    rim = edges[index[(uses == 1) & (balance != 0)]]
    label = np.arange(len(where))
    while True:
        new = label.copy()
        least = label[rim].min(axis=1)
        for column in rim.T:
            np.minimum.at(new, column, least)
        if np.array_equal(new, label):
            break
        label = new
    fans = []
    for loop in np.unique(label[rim[:, 0]]):
        own = where[rim[label[rim[:, 0]] == loop]]
        hub = np.broadcast_to(own.mean(axis=(0, 1)), (len(own), 3))
        fans.append(np.stack([own[:, 1], own[:, 0], hub], axis=1))  # against the edge of the neighbour
    return np.concatenate([corners, *fans])


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
