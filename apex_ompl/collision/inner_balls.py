"""Balls inside solids, by which the compiled kernel proves collisions without the meshes.

Where a ball inside a body overlaps an obstacle, the body does. A handful of balls finds most collisions of a search,
which are centimeters deep; the meshes check the rest.
"""

from __future__ import annotations

import coal
import numpy as np

from apex_ompl.collision.containment import CONVEX_TOLERANCE, EnclosingMesh
from apex_ompl.collision.cover.spheres import shape_key
from apex_ompl.collision.hulls import convex_hull, hull_planes
from apex_ompl.collision.shapes import is_shell, is_surface
from apex_ompl.types import Array
from apex_ompl.util.cache import kept

PLACES = 60  # at which the depth is computed, about
MOST = 12  # balls of a solid
LEAST = 0.01  # share of the places inside that a further ball must add
POINT = 1e-9  # radius of the ball that stands for a point [m]
MOST_KEPT = 1024  # shapes whose balls are kept

_known: dict[str, Array] = {}  # by shape key


def inner_balls(geometry: coal.CollisionGeometry) -> Array:
    """Return centers and radii of a few balls inside a solid, shape (K, 4) [m]; none for a surface.

    They are chosen greedily: each covers the most of the places, on a lattice, that none before covers.

    Raises:
        ParameterError: The kind of geometry has no balls.
    """
    return kept(_known, shape_key(geometry), lambda: _chosen(geometry), MOST_KEPT)


def _chosen(geometry: coal.CollisionGeometry) -> Array:
    lattice = _lattice(geometry)
    depth = _depths(geometry, lattice)
    inside = depth > 0.0
    places, depth = lattice[inside], depth[inside]
    covers = np.linalg.norm(places[:, None] - places, axis=2) < depth[:, None]
    left, chosen = np.ones(len(places), bool), list[int]()
    while len(chosen) < MOST and left.any():
        gains = (covers & left).sum(axis=1)
        best = int(np.lexsort((depth, gains))[-1])
        if gains[best] < LEAST * len(places):
            break
        chosen.append(best)
        left &= ~covers[best]
    return np.column_stack([places[chosen], depth[chosen]]).reshape(-1, 4)


def _lattice(geometry: coal.CollisionGeometry) -> Array:
    """Return about ``PLACES`` points, evenly spaced in the box around a geometry, its middle planes among them."""
    geometry.computeLocalAABB()
    box = geometry.aabb_local
    sides = np.array([box.width(), box.height(), box.depth()])
    spacing = max(float(np.prod(sides) / PLACES) ** (1.0 / 3.0), float(sides.max()) / PLACES, 1e-9)
    steps = [np.arange(-n, n + 1) / (2 * n + 1) for n in np.ceil(0.5 * (sides / spacing - 1.0)).astype(int).clip(0)]
    mesh = np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1).reshape(-1, 3)
    found: Array = np.asarray(box.center()) + mesh * sides
    return found


def _depths(geometry: coal.CollisionGeometry, points: Array) -> Array:
    """Return lower bounds of how deep points, shape (N, 3) [m], are in a solid, shape (N,) [m]; 0 or less outside."""
    kind = geometry.getNodeType()
    x, y, z = np.abs(points).T
    if kind == coal.GEOM_SPHERE:
        return np.asarray(geometry.radius - np.linalg.norm(points, axis=1))
    if kind == coal.GEOM_CAPSULE:
        return np.asarray(geometry.radius - np.hypot(np.hypot(x, y), np.maximum(z - geometry.halfLength, 0.0)))
    if kind == coal.GEOM_CYLINDER:
        return np.asarray(np.minimum(geometry.radius - np.hypot(x, y), geometry.halfLength - z))
    if kind == coal.GEOM_BOX:
        return np.asarray((geometry.halfSide - np.abs(points)).min(axis=1))
    if not is_shell(geometry):
        return _below_planes(geometry, points) if kind == coal.GEOM_CONVEX else np.zeros(len(points))
    if is_surface(geometry):
        return np.zeros(len(points))
    mesh = EnclosingMesh.of(geometry)
    if mesh.convex:  # whose hull may be larger by that much
        return _below_planes(convex_hull(geometry), points) - 3.0 * CONVEX_TOLERANCE
    return _from_triangles(geometry, mesh, points) if mesh.closed and mesh.watertight else np.zeros(len(points))


def _below_planes(hull: coal.Convex, points: Array) -> Array:
    normals, offsets = hull_planes(hull)
    return np.asarray((offsets - points @ normals.T).min(axis=1, initial=np.inf))


def _from_triangles(geometry: coal.BVHModelBase, mesh: EnclosingMesh, points: Array) -> Array:
    dot, request, found = coal.Sphere(POINT), coal.DistanceRequest(), np.zeros(len(points))
    for k, point in enumerate(points):
        if mesh.contains(point):
            there = coal.Transform3s(np.eye(3), point)
            found[k] = coal.distance(geometry, coal.Transform3s.Identity(), dot, there, request, coal.DistanceResult())
    return found
