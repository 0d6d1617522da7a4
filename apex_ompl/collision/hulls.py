"""Convex hulls of meshes, their planes, and bodies of few vertices that contain them."""

from __future__ import annotations

from itertools import product

import coal
import numpy as np
from numpy.typing import NDArray

from apex_ompl.collision.shapes import is_shell, is_surface
from apex_ompl.kernel.geometry import farthest_points
from apex_ompl.scene.meshes import FLAT
from apex_ompl.types import Array
from apex_ompl.util.boxes import bounding_box
from apex_ompl.util.forking import ProcessLock
from apex_ompl.util.weak_cache import weakly_cached

THICKNESS = 1e-6  # by which hulls of surfaces are larger; of those longer than 1 m as much by their length [m]
DIRECTIONS = (400, 60)  # in which hulls of too many vertices are sampled; fewer where Coal takes no more
CELLS = 24  # along the longest side of a grid over vertices
MOST_VERTICES = 50_000  # of a mesh whose hull is not sampled

_building = ProcessLock()


def convex_hull(geometry: coal.CollisionGeometry) -> coal.CollisionGeometry:
    """Return the convex hull of a mesh, or the geometry itself when it is convex already.

    That of a surface without an inside, which may be flat, is the box around it. Coal takes at most 255 neighbors of a
    vertex. Where a hull has more, and of meshes of more than ``MOST_VERTICES``,
    which take seconds, a slightly larger body with fewer vertices is returned.
    """
    if not is_shell(geometry):
        return geometry
    return geometry.convex if geometry.convex is not None and not is_surface(geometry) else _hull_of_mesh(geometry)


@weakly_cached
def _hull_of_mesh(mesh: coal.BVHModelBase) -> coal.Convex:
    vertices = np.array(mesh.vertices())
    if is_surface(mesh):
        low, high = bounding_box(vertices)
        room = max(THICKNESS, FLAT * float((high - low).max()))
        low, high = low - room, high + room
        return _hull_of(np.array(list(product(*np.stack([low, high], axis=1)))))
    if len(vertices) > MOST_VERTICES:
        return _larger_hull(vertices)
    try:
        with _building:
            mesh.buildConvexHull(True, "Qt")
    except RuntimeError:
        return _larger_hull(vertices)
    return mesh.convex


def hull_corners(hull: coal.Convex) -> Array:
    """Return the corners of the triangles of a convex hull, shape (T, 3, 3) [m]."""
    rows = [(row[0], row[1], row[2]) for row in map(hull.polygons, range(hull.num_polygons))]
    corners: Array = np.array(hull.points())[np.array(rows)]
    return corners


def hull_planes(hull: coal.Convex) -> tuple[Array, Array]:
    """Return outward unit normals n, shape (planes, 3), and offsets o, shape (planes,) [m]: n . x <= o in the hull."""
    corners = hull_corners(hull)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    long = np.linalg.norm(normals, axis=1)
    sound = long > 1e-14
    normals = normals[sound] / long[sound, None]
    offsets = np.einsum("ij,ij->i", normals, corners[sound, 0])
    sign = np.sign(offsets - normals @ corners.mean(axis=(0, 1)))
    return normals * sign[:, None], offsets * sign


def _larger_hull(vertices: Array) -> coal.Convex:
    """Return a convex body of few vertices that contains the given ones, shape (V, 3) [m].

    It is the hull of those that are farthest in some direction, stretched about its center until it contains all.
    """
    for count in DIRECTIONS:
        rise = 1.0 - (2.0 * np.arange(count) + 1.0) / count
        turn = np.pi * (1.0 + 5.0**0.5) * np.arange(count)
        flat = np.sqrt(1.0 - rise**2)
        directions = np.stack([flat * np.cos(turn), flat * np.sin(turn), rise], axis=1)
        chosen = vertices[np.unique(farthest(directions, vertices)[0])]
        try:
            normals, offsets = hull_planes(_hull_of(chosen))
            center = chosen.mean(axis=0)
            room = offsets - normals @ center
            wide = room > 1e-6 * room.max()  # planes of slivers may be turned by rounding
            reach = farthest(normals[wide], vertices - center)[1]
            return _hull_of(center + (1.0 + 1e-6) * max(1.0, float((reach / room[wide]).max())) * (chosen - center))
        except RuntimeError:
            continue
    raise AssertionError("a hull of few vertices has few neighbors")


def _hull_of(points: Array) -> coal.Convex:
    found = coal.StdVec_Vec3s()
    found.extend(list(points))
    return coal.Convex.convexHull(found, True, "Qt")


def below_support(normals: Array, corners: Array, points: Array) -> Array:
    """Return how deep points are below the supporting planes of a convex body with these normals, shape (N,) [m].

    Of a point inside it is at least the distance to the body's surface, and equal where the normal is that of the
    nearest face. It takes a search over the corners for each point, not one over all faces.

    Args:
        normals: A unit normal for each point, shape (N, 3).
        corners: Corners of the body, shape (P, 3) [m].
        points: Shape (N, 3) [m].
    """
    depths: Array = farthest(normals, corners)[1] - np.einsum("ij,ij->i", normals, points)
    return depths


def farthest(directions: Array, points: Array) -> tuple[NDArray[np.intp], Array]:
    """Return the point that is farthest in each direction, shape (D,), and how far it is, shape (D,) [m].

    Of the points of a grid's cells only those are looked at whose cell may reach farther than any first point of one.
    """
    low, high = bounding_box(points)
    wide = float((high - low).max())
    side = max(wide / CELLS, 1e-12)
    cells = np.ravel_multi_index(tuple(((points - low) / side).astype(np.int64).T), (CELLS + 1,) * 3)
    order = np.argsort(cells, kind="stable")
    first = np.flatnonzero(np.diff(cells[order], prepend=-1))
    points = np.ascontiguousarray(points[order])
    middles = low + side * (np.floor((points[first] - low) / side) + 0.5)
    found = farthest_points(directions, points, np.append(first, len(order)), middles, (0.5 + 1e-6) * side)
    return order[found], np.einsum("ij,ij->i", directions, points[found])
