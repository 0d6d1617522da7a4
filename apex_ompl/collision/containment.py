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
from apex_ompl.meshes import is_closed, piece_points, triangles, winding_number

ANCHOR_RADIUS = 1e-6  # [m]
CONVEX_TOLERANCE = 1e-3  # a mesh is convex when its hull has no more than this share of extra volume


@dataclass(frozen=True)
class Host:
    """A mesh that may contain others: its hull, and whether the hull is the solid itself."""

    hull: coal.CollisionGeometry
    convex: bool
    corners: NDArray[np.float64]

    @classmethod
    def of(cls, mesh: coal.BVHModelBase) -> Host:
        """Analyse a mesh."""
        hull = convex_hull(mesh)
        vertices, faces = triangles(mesh)
        full = float(hull.computeVolume())
        convex = is_closed(vertices, faces) and abs(full - abs(float(mesh.computeVolume()))) <= CONVEX_TOLERANCE * full
        return cls(hull, convex, vertices[faces])

    def contains(self, point: NDArray[np.float64]) -> bool:
        """Whether a point, in the mesh's frame and off its surface, lies in the solid."""
        return abs(winding_number(point, self.corners)) > 0.5


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
