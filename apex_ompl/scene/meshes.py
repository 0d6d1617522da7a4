"""Triangle meshes as arrays: validity, connected pieces, bounding boxes and winding numbers."""

from __future__ import annotations

import coal
import numpy as np
from numpy.typing import NDArray

from apex_ompl.types import Array

BOX_PAD = 1e-6  # margin of bounding boxes, which exceeds rounding errors [m]
MOST_TRIANGLES = 200_000  # number at which large triangles are subdivided no further
LARGEST = 1e4  # larger coordinates are errors [m]


def triangles(mesh: coal.BVHModelBase) -> tuple[Array, NDArray[np.int64]]:
    """Return the vertices, shape (V, 3) [m], and the vertex indices of the triangles, shape (T, 3)."""
    faces = [mesh.tri_indices(k) for k in range(mesh.num_tris)]
    return np.array(mesh.vertices()), np.array([[t[0], t[1], t[2]] for t in faces])


def extent_fault(vertices: Array) -> str:
    """Return the reason for which vertices, shape (V, 3) [m], are not those of a solid, or an empty string.

    Vertices must be finite, at most ``LARGEST``, and not all in one plane; Coal aborts the process for others.
    """
    if not (np.isfinite(vertices).all() and np.abs(vertices).max() < LARGEST):
        return "vertices that are not finite or too far away"
    spread = np.linalg.svd(vertices - vertices.mean(axis=0), compute_uv=False)
    if len(vertices) < 4 or spread[2] <= 1e-9 * max(spread[0], 1e-9):
        return "vertices that all lie in one plane"
    return ""


def orientation_fault(vertices: Array, faces: NDArray[np.int64]) -> str:
    """Return an error message if neighbouring triangles are oriented inconsistently, or an empty string.

    Holes are allowed: the inside is then defined by the generalised winding number.

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


def is_closed(vertices: Array, faces: NDArray[np.int64]) -> bool:
    """Whether every edge of a mesh belongs to more than one triangle."""
    edges = np.sort(_edges(vertices, faces), axis=1)
    return bool((np.unique(edges, axis=0, return_counts=True)[1] > 1).all())


def _edges(vertices: Array, faces: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the directed edges of all triangles but slivers, as indices of welded vertices, shape (E, 2)."""
    corners = weld(vertices)[faces]
    corners = corners[(corners != np.roll(corners, 1, axis=1)).all(axis=1)]
    return np.concatenate([corners[:, [k, (k + 1) % 3]] for k in range(3)])


def weld(vertices: Array) -> NDArray[np.int64]:
    """Return the index of the position of every vertex, shape (V,); vertices at the same position share one."""
    scale = max(float(np.abs(vertices).max()), 1e-9)
    return np.unique(np.round(vertices / scale, 9), axis=0, return_inverse=True)[1].ravel()


def piece_points(vertices: Array, faces: NDArray[np.int64]) -> Array:
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
    points: Array = vertices[faces[first, 0]]
    return points


def bounding_boxes(corners: Array, columns: int = 8) -> Array:
    """Return boxes whose union contains the solid of a mesh, shape (boxes, 2, 3) [m].

    The mesh is cut into columns along one axis. A line along that axis through a point of the solid leaves the solid
    at both ends through the surface, inside the same column. The box around the part of the surface in a column
    therefore contains the part of the solid in it. The axis with the smallest volume of boxes is chosen. A surface
    that is not closed gets a single box, as points with a winding number above 1/2 lie in its convex hull.

    Args:
        corners: Corners of the triangles, holes capped (see :func:`capped`), shape (T, 3, 3) [m].
        columns: Number of columns along each of the two other axes.
    """
    if not _is_cycle(corners):
        columns = 1
    size = float(np.ptp(corners.reshape(-1, 3), axis=0).min())
    small = _halved(corners, 0.5 * size / columns)
    found = [_columns(small, np.delete(np.arange(3), axis), columns) for axis in range(3)]
    return min(found, key=lambda boxes: float(np.prod(boxes[:, 1] - boxes[:, 0], axis=1).sum()))


def _is_cycle(corners: Array) -> bool:
    """Whether every edge occurs equally often in both directions, so that winding numbers are integers."""
    edges = _edges(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3))
    turned = np.where(edges[:, 0] > edges[:, 1], -1.0, 1.0)
    place = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True)[1].ravel()
    return not np.bincount(place, weights=turned).any()


def _halved(corners: Array, longest: float) -> Array:
    """Bisect triangles, shape (T, 3, 3), at their longest edges until no edge is longer than ``longest`` [m].

    Subdivision ends early at ``MOST_TRIANGLES``.
    """
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


def _columns(corners: Array, cut: NDArray[np.intp], columns: int) -> Array:
    """Return the bounding boxes of triangles, shape (T, 3, 3), in each column; ``cut`` are the axes that are cut."""
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
    wide: Array = found + np.array([-BOX_PAD, BOX_PAD])[:, None]
    return wide


def capped(vertices: Array, faces: NDArray[np.int64]) -> Array:
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


def winding_number(point: Array, corners: Array) -> float:
    """Return the winding number of a triangle mesh around a point: 1 inside a closed mesh, 0 outside.

    Args:
        point: Shape (3,), not on the surface.
        corners: Corners of the triangles, shape (T, 3, 3), counter-clockwise from outside.

    It is the sum of the solid angles of the triangles (van Oosterom, Strackee 1983) over 4 pi.
    """
    a, b, c = np.moveaxis(corners - point, 1, 0)
    la, lb, lc = (np.linalg.norm(v, axis=1) for v in (a, b, c))
    numerator = np.einsum("ij,ij->i", a, np.cross(b, c))
    dots = [np.einsum("ij,ij->i", u, v) for u, v in ((a, b), (b, c), (c, a))]
    denominator = la * lb * lc + dots[0] * lc + dots[1] * la + dots[2] * lb
    return float(np.arctan2(numerator, denominator).sum() / (2.0 * np.pi))
