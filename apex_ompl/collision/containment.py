"""Containment: solids that lie entirely inside a triangle mesh, which a test of the triangles alone does not find.

A small obstacle inside a link, or a link inside a mesh obstacle, touches no triangle. If no triangles touch, each
connected piece of the inner solid is either entirely inside the mesh or entirely outside, so one point of each piece
decides. Links of the robot are not tested against each other: a kinematic chain cannot enter a closed surface without
crossing it.
"""

from __future__ import annotations

from dataclasses import dataclass

import coal
import numpy as np

from apex_ompl.collision.shapes import convex_hull, is_shell
from apex_ompl.scene.meshes import capped, is_closed, piece_points, triangles, winding_number
from apex_ompl.types import Array

ANCHOR_RADIUS = 1e-6  # [m]
CONVEX_TOLERANCE = 5e-4  # a mesh is convex when its triangles' centres are no deeper than this below its hull [m]


@dataclass(frozen=True)
class EnclosingMesh:
    """A mesh that may contain other solids.

    A mesh counts as convex when no point of a triangle is deeper below its hull than 3 ``CONVEX_TOLERANCE``. Only the
    centres of the triangles are tested: the depth is a concave function that is not negative, so on a triangle it is
    at most three times its value at the centre.

    Attributes:
        hull: Convex hull.
        convex: Whether the hull represents the solid.
        corners: Corners of the triangles, shape (T, 3, 3) [m], with holes closed by
            :func:`apex_ompl.scene.meshes.capped`.
    """

    hull: coal.CollisionGeometry
    convex: bool
    corners: Array

    @classmethod
    def of(cls, mesh: coal.BVHModelBase) -> EnclosingMesh:
        """Analyse a mesh."""
        hull = convex_hull(mesh)
        vertices, faces = triangles(mesh)
        outside = hull_corners(hull)
        normals = np.cross(outside[:, 1] - outside[:, 0], outside[:, 2] - outside[:, 0])
        long = np.linalg.norm(normals, axis=1)
        sound = long > 1e-14
        normals = normals[sound] / long[sound, None]
        offsets = np.einsum("ij,ij->i", normals, outside[sound, 0])
        middle = outside.mean(axis=(0, 1))
        normals, offsets = (
            v * np.sign(offsets - normals @ middle)[(...,) + (None,) * (v.ndim - 1)] for v in (normals, offsets)
        )
        depth = (offsets - vertices[faces].mean(axis=1) @ normals.T).min(axis=1)
        return cls(hull, is_closed(vertices, faces) and float(depth.max()) <= CONVEX_TOLERANCE, capped(vertices, faces))

    @property
    def boundary(self) -> Array:
        """Corners of the triangles of the hull if the mesh is convex, else of the mesh, shape (T, 3, 3) [m]."""
        return hull_corners(self.hull) if self.convex else self.corners

    def contains(self, point: Array) -> bool:
        """Whether a point in the mesh's frame, not on its surface, lies in the solid."""
        return abs(winding_number(point, self.corners)) > 0.5


def hull_corners(hull: coal.ConvexBase32) -> Array:
    """Return the corners of the triangles of a convex hull, shape (T, 3, 3) [m]."""
    points = np.array(hull.points())
    rows = [hull.polygons(k) for k in range(hull.num_polygons)]
    corners: Array = points[np.array([[row[0], row[1], row[2]] for row in rows])]
    return corners


def may_contain(outer: coal.BVHModelBase, inner: coal.CollisionGeometry) -> bool:
    """Whether ``inner`` may fit into ``outer``, by a bound on the inscribed radius and by the volume."""
    if inner.getNodeType() == coal.GEOM_HALFSPACE:
        return False
    hull = convex_hull(outer)
    outer.computeLocalAABB()
    box = outer.aabb_local
    widest_ball = 0.5 * min(box.width(), box.height(), box.depth())
    volume = convex_hull(inner).computeVolume() if is_shell(inner) else inner.computeVolume()
    return _inscribed_radius(inner) <= widest_ball and (is_shell(inner) or volume <= hull.computeVolume())


def anchor_points(geometry: coal.CollisionGeometry) -> Array:
    """Return one point of each connected piece of a solid, in its own frame, shape (pieces, 3) [m]."""
    return piece_points(*triangles(geometry)) if is_shell(geometry) else np.zeros((1, 3))


def _inscribed_radius(inner: coal.CollisionGeometry) -> float:
    kind = inner.getNodeType()
    if kind == coal.GEOM_BOX:
        return float(np.min(inner.halfSide))
    if kind == coal.GEOM_CYLINDER:
        return float(min(inner.radius, inner.halfLength))
    if kind in (coal.GEOM_SPHERE, coal.GEOM_CAPSULE):
        return float(inner.radius)
    return 0.0
