"""Triangle meshes as arrays: validity, connected pieces, holes and winding numbers."""

from __future__ import annotations

from dataclasses import dataclass

import coal
import numpy as np
from numpy.typing import NDArray

from apex_ompl.types import Array
from apex_ompl.util.cache import weakly_cached

LARGEST = 1e4  # larger coordinates are errors [m]
SMALLEST = 1e-6  # smaller meshes are errors, for example of units [m]
FLAT = 1e-6  # least thickness of a solid by its length; hulls of a thirtieth of it crash Coal


@weakly_cached
def triangles(mesh: coal.BVHModelBase) -> tuple[Array, NDArray[np.int64]]:
    """Return the vertices, shape (V, 3) [m], and the vertex indices of the triangles, shape (T, 3); read only."""
    rows = [(t[0], t[1], t[2]) for t in map(mesh.tri_indices, range(mesh.num_tris))]
    vertices, faces = np.array(mesh.vertices()), np.array(rows, np.int64).reshape(-1, 3)
    vertices.flags.writeable = faces.flags.writeable = False
    return vertices, faces


def extent_fault(vertices: Array, flat: bool = False) -> str:
    """Return the reason for which vertices, shape (V, 3) [m], are not those of a solid, or an empty string.

    Vertices must be finite, at most ``LARGEST``, farther apart than ``SMALLEST``, and not all in one plane; Coal aborts
    the process for others. Those of a surface may be ``flat``.
    """
    if not (np.isfinite(vertices).all() and np.abs(vertices).max() < LARGEST):
        return "vertices that are not finite or too far away"
    size = float(np.ptp(vertices, axis=0).max())
    if size < SMALLEST:
        return f"vertices no more than {size:.3g} m apart, less than {SMALLEST:g} m"
    if flat:
        return ""
    spread = np.linalg.svd(vertices - vertices.mean(axis=0), compute_uv=False)
    if len(vertices) < 4 or spread[2] <= FLAT * spread[0]:
        return "vertices that all lie in one plane"
    return ""


def orientation_fault(vertices: Array, faces: NDArray[np.int64]) -> str:
    """Return an error message if neighboring triangles are oriented inconsistently, or an empty string.

    Holes are allowed: the inside is then defined by the generalized winding number.

    Args:
        vertices: Shape (V, 3) [m].
        faces: Indices of the corners, shape (T, 3).
    """
    opposed = edges_of(vertices, faces).opposed
    return "neighboring triangles that are oriented against each other" if opposed else ""


def hole_fault(vertices: Array, faces: NDArray[np.int64]) -> str:
    """Return where the holes of a mesh are, or an empty string; arguments as of :func:`orientation_fault`."""
    place = weld(vertices)
    rim = edges_of(vertices, faces).open
    if not len(rim):
        return ""
    where = np.zeros((int(place.max()) + 1, 3))
    where[place] = vertices
    label = _components(rim)[rim[:, 0]]
    middles = [where[rim[label == loop]].mean(axis=(0, 1)) for loop in np.unique(label)[:3]]
    around = ", ".join(f"({x:.4g}, {y:.4g}, {z:.4g})" for x, y, z in middles)
    count = len(np.unique(label))
    return f"{count} {'hole' if count == 1 else 'holes'}, around {around}{' and others' if count > 3 else ''} m"


def surface_note(vertices: Array, faces: NDArray[np.int64]) -> str:
    """Return why a mesh bounds no solid as it is, and how it is interpreted, or an empty string.

    Args:
        vertices: Shape (V, 3) [m].
        faces: Indices of the corners, shape (T, 3).
    """
    count = len(edges_of(vertices, faces).open)
    if count:
        return f"is not closed ({count} open edges): its holes count as closed where something may lie inside"
    a, b, c = np.moveaxis(vertices[faces] - vertices.mean(axis=0), 1, 0)
    if float(np.einsum("ij,ij->", a, np.cross(b, c))) < 0.0:
        return "is inside out (its triangles face inwards): it is taken as the solid that they enclose"
    return ""


@dataclass(frozen=True)
class Edges:
    """Edges of a mesh, without those of slivers.

    Attributes:
        ends: Welded vertices at the ends of each edge as one triangle has it, shape (E, 2).
        uses: Number of triangles at each edge, shape (E,).
        balance: How often an edge occurs in the direction of its vertices' order less how often in the other,
            shape (E,).
    """

    ends: NDArray[np.int64]
    uses: NDArray[np.int64]
    balance: NDArray[np.int64]

    @classmethod
    def of(cls, corners: NDArray[np.int64]) -> Edges:
        """Return the edges of triangles, given by their welded vertices, shape (T, 3)."""
        corners = corners[(corners != np.roll(corners, 1, axis=1)).all(axis=1)]
        edges = np.concatenate([corners[:, [k, (k + 1) % 3]] for k in range(3)])
        names = edges.min(axis=1) * (int(corners.max(initial=0)) + 1) + edges.max(axis=1)
        _, first, place = np.unique(names, return_index=True, return_inverse=True)
        ahead = np.bincount(place[edges[:, 0] < edges[:, 1]], minlength=len(first))
        uses = np.bincount(place, minlength=len(first))
        return cls(edges[first], uses, 2 * ahead - uses)

    @property
    def opposed(self) -> bool:
        """Whether neighboring triangles are oriented against each other."""
        return bool(((self.balance != 0) & (self.uses > 1)).any())

    @property
    def open(self) -> NDArray[np.int64]:
        """Edges of a single triangle, as it has them, shape (holes' edges, 2)."""
        single: NDArray[np.int64] = self.ends[self.uses == 1]
        return single


@weakly_cached
def _known_edges(_: Array) -> dict[int, tuple[NDArray[np.int64], Edges]]:
    """Return the edges that are known of triangles between some vertices, by the identity of the triangles."""
    return {}


def edges_of(vertices: Array, faces: NDArray[np.int64]) -> Edges:
    """Return the edges of a mesh, which are kept as long as its vertices, shape (V, 3) [m]; faces have shape (T, 3)."""
    known = _known_edges(vertices)
    if id(faces) not in known:
        known[id(faces)] = faces, Edges.of(weld(vertices)[faces])
    return known[id(faces)][1]


@weakly_cached
def weld(vertices: Array) -> NDArray[np.int64]:
    """Return the index of the position of every vertex, shape (V,); vertices at the same position share one."""
    scale = max(float(np.abs(vertices).max()), 1e-9)
    return numbered(np.round(vertices / scale, 9))


def numbered(rows: Array) -> NDArray[np.int64]:
    """Return a number for each row of an array, the same for equal rows, shape (N,)."""
    order = np.lexsort(rows.T)
    numbers = np.empty(len(rows), np.int64)
    numbers[order] = np.append(0, np.cumsum((np.diff(rows[order], axis=0) != 0.0).any(axis=1)))
    return numbers


def piece_points(vertices: Array, faces: NDArray[np.int64]) -> Array:
    """Return one vertex of every connected piece of a mesh, shape (pieces, 3)."""
    corners = weld(vertices)[faces]
    label = _components(corners)
    _, first = np.unique(label[corners[:, 0]], return_index=True)
    points: Array = vertices[faces[first, 0]]
    return points


def _components(groups: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the least item connected to each item, where the items of a row, shape (N, k), are connected."""
    label = np.arange(int(groups.max(initial=0)) + 1)
    while True:
        least = label[groups].min(axis=1)
        new = label.copy()
        for column in groups.T:
            np.minimum.at(new, label[column], least)  # on the label's own label too, which halves the number of rounds
            np.minimum.at(new, column, least)
        new = new[new]
        if np.array_equal(new, label):
            return new
        label = new


def capped(vertices: Array, faces: NDArray[np.int64]) -> Array:
    """Return the corners of the triangles of a mesh, shape (T, 3, 3), with a fan of triangles over every hole.

    Vertices at the same position get the coordinates of one of them.

    Args:
        vertices: Shape (V, 3) [m].
        faces: Indices of the corners, shape (T, 3), oriented alike.
    """
    place = weld(vertices)
    where = np.zeros((int(place.max()) + 1, 3))
    where[place] = vertices
    corners: Array = where[place[faces]]
    rim = edges_of(vertices, faces).open
    if not len(rim):
        return corners
    label = _components(rim)
    fans = []
    for loop in np.unique(label[rim[:, 0]]):
        own = where[rim[label[rim[:, 0]] == loop]]
        hub = np.broadcast_to(own.mean(axis=(0, 1)), (len(own), 3))
        fans.append(np.stack([own[:, 1], own[:, 0], hub], axis=1))  # against the edge of the neighbor
    return np.concatenate([corners, *fans])


def is_watertight(corners: Array) -> bool:
    """Whether every edge occurs equally often in both directions, so that winding numbers are whole numbers.

    Args:
        corners: Corners of the triangles, shape (T, 3, 3) [m]; those at the same position are equal bit for bit.
    """
    return not Edges.of(numbered(corners.reshape(-1, 3)).reshape(-1, 3)).balance.any()


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
