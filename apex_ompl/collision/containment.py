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

from apex_ompl.collision.hulls import convex_hull, hull_corners, hull_planes
from apex_ompl.collision.shapes import is_shell
from apex_ompl.kernel.geometry import EnclosingSurface
from apex_ompl.scene.meshes import capped, edges_of, is_watertight, piece_points, triangles
from apex_ompl.types import Array
from apex_ompl.util.boxes import bounding_box
from apex_ompl.util.weak_cache import weakly_cached

ANCHOR_RADIUS = 1e-6  # [m]
CONVEX_TOLERANCE = 5e-4  # a mesh is convex when its triangles' centers are no deeper than this below its hull [m]
MOST_DEPTHS = 2**22  # of triangles below faces of the hull; a mesh of more counts as not convex


@dataclass(frozen=True)
class EnclosingMesh:
    """A mesh that may contain other solids.

    A mesh counts as convex when no point of a triangle is deeper below its hull than 3 ``CONVEX_TOLERANCE``. Only the
    centers of the triangles are tested: the depth is a concave function that is not negative, so on a triangle it is
    at most three times its value at the center.

    Attributes:
        hull: Convex hull.
        convex: Whether the hull represents the solid.
        corners: Corners of the triangles, shape (T, 3, 3) [m], with holes closed by
            :func:`apex_ompl.scene.meshes.capped`.
        closed: Whether it has no holes.
        watertight: Whether its winding numbers are whole numbers.
        box: Bounding box, shape (2, 3) [m].
    """

    hull: coal.CollisionGeometry
    convex: bool
    corners: Array
    closed: bool
    watertight: bool
    box: Array

    @staticmethod
    @weakly_cached
    def of(mesh: coal.BVHModelBase) -> EnclosingMesh:
        """Analyze a mesh; the analysis is kept as long as the mesh."""
        hull = convex_hull(mesh)
        vertices, faces = triangles(mesh)
        corners, edges = np.ascontiguousarray(capped(vertices, faces)), edges_of(vertices, faces)
        closed = not len(edges.open)
        convex = closed and _is_convex(vertices[faces].mean(axis=1), hull)
        box = bounding_box(corners)
        watertight = not edges.balance.any() if closed else is_watertight(corners)
        return EnclosingMesh(hull, convex, corners, closed, watertight, box)

    @property
    def boundary(self) -> Array:
        """Corners of the triangles of the hull if the mesh is convex, else of the mesh, shape (T, 3, 3) [m]."""
        return hull_corners(self.hull) if self.convex else self.corners

    def contains(self, point: Array) -> bool:
        """Whether a point in the mesh's frame, not on its surface, lies in the solid."""
        return self.surface.encloses(point)

    @property
    def surface(self) -> EnclosingSurface:
        """Its triangles for the kernel."""
        return EnclosingSurface(self.corners, self.box, self.watertight)


def _is_convex(centers: Array, hull: coal.Convex) -> bool:
    """Whether no center of a triangle, shape (T, 3) [m], is deeper below a hull than ``CONVEX_TOLERANCE``."""
    if len(centers) * hull.num_polygons > MOST_DEPTHS:
        return False
    normals, offsets = hull_planes(hull)
    depths = offsets[:, None] - normals @ centers.T
    return float(depths.min(axis=0).max()) <= CONVEX_TOLERANCE


@dataclass(frozen=True)
class Extent:
    """Sizes of a solid, by which it is seen that it does not fit into another.

    Attributes:
        inscribed: Lower bound of the radius of the largest ball inside, infinite for a half-space [m].
        widest: Upper bound of it, by the bounding box [m].
        volume: Volume that another solid must have to contain this one, 0 where it is not known [m^3].
        room: Volume of the convex hull [m^3].
    """

    inscribed: float
    widest: float
    volume: float
    room: float

    @staticmethod
    @weakly_cached
    def of(geometry: coal.CollisionGeometry) -> Extent:
        """Measure a geometry."""
        if geometry.getNodeType() == coal.GEOM_HALFSPACE:
            return Extent(np.inf, np.inf, np.inf, np.inf)
        geometry.computeLocalAABB()
        box = geometry.aabb_local
        widest, room = 0.5 * min(box.width(), box.height(), box.depth()), convex_hull(geometry).computeVolume()
        return Extent(_inscribed_radius(geometry), widest, 0.0 if is_shell(geometry) else room, room)

    def may_contain(self, inner: Extent) -> bool:
        """Whether the sizes allow that another solid lies inside this one."""
        return inner.inscribed <= self.widest and inner.volume <= self.room


@weakly_cached
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
