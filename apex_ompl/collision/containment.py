"""The case that a shell misses: one solid wholly inside another whose surface is a triangle mesh.

Meshes collide by their triangles alone, so a small obstacle wholly inside a link, or a link wholly inside a
mesh obstacle, touches nothing. If nothing touches, each connected piece of a guest is either wholly inside its
host or wholly outside, so one point of each piece decides. Links of the robot are no guests of each other: they
hang together, and a chain cannot enter a shell without crossing it.
"""

from __future__ import annotations

from dataclasses import dataclass

import coal
import numpy as np
from numpy.typing import NDArray

from apex_ompl.collision.shapes import convex_hull, is_shell
from apex_ompl.scene.meshes import capped, is_closed, piece_points, triangles, winding_number

ANCHOR_RADIUS = 1e-6  # [m]
CONVEX_TOLERANCE = 5e-4  # a mesh is convex when its triangles' centres are no deeper than this below its hull [m]


@dataclass(frozen=True)
class EnclosingMesh:
    """A mesh that may contain others: its hull, whether the hull stands for the solid, and its triangles.

    Holes are closed by fans of triangles (``apex_ompl.scene.meshes.capped``). The hull stands for the solid where no
    triangle is deeper than three times ``CONVEX_TOLERANCE`` below it: the depth is a concave function, so that it is
    at most three times its value at the centre of a triangle.
    """

    hull: coal.CollisionGeometry
    convex: bool
    corners: NDArray[np.float64]

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
    def boundary(self) -> NDArray[np.float64]:
        """Corners of the triangles of what stands for the solid, shape (T, 3, 3) [m]."""
        return hull_corners(self.hull) if self.convex else self.corners

    def contains(self, point: NDArray[np.float64]) -> bool:
        """Whether a point, in the mesh's frame and off its surface, lies in the solid."""
        return abs(winding_number(point, self.corners)) > 0.5


def hull_corners(hull: coal.ConvexBase32) -> NDArray[np.float64]:
    """Return the corners of the triangles of a convex hull, shape (T, 3, 3) [m]."""
    points = np.array(hull.points())
    rows = [hull.polygons(k) for k in range(hull.num_polygons)]
    corners: NDArray[np.float64] = points[np.array([[row[0], row[1], row[2]] for row in rows])]
    return corners


def may_contain(host: coal.BVHModelBase, guest: coal.CollisionGeometry) -> bool:
    """Whether the sizes allow ``guest`` inside ``host``: by inscribed radius and by volume."""
    if guest.getNodeType() == coal.GEOM_HALFSPACE:
        return False
    hull = convex_hull(host)
    host.computeLocalAABB()
    box = host.aabb_local
    widest_ball = 0.5 * min(box.width(), box.height(), box.depth())
    volume = convex_hull(guest).computeVolume() if is_shell(guest) else guest.computeVolume()
    return _inscribed_radius(guest) <= widest_ball and (is_shell(guest) or volume <= hull.computeVolume())


def anchor_points(geometry: coal.CollisionGeometry) -> NDArray[np.float64]:
    """Return one point of each connected piece of a solid, in its own frame, shape (pieces, 3) [m]."""
    return piece_points(*triangles(geometry)) if is_shell(geometry) else np.zeros((1, 3))


def _inscribed_radius(guest: coal.CollisionGeometry) -> float:
    kind = guest.getNodeType()
    if kind == coal.GEOM_BOX:
        return float(np.min(guest.halfSide))
    if kind == coal.GEOM_CYLINDER:
        return float(min(guest.radius, guest.halfLength))
    if kind in (coal.GEOM_SPHERE, coal.GEOM_CAPSULE):
        return float(guest.radius)
    return 0.0
