"""Tests whether one of two solids of a scene lies inside of the other."""

from __future__ import annotations

from dataclasses import dataclass

import coal
import numpy as np
import pinocchio as pin

from apex_ompl.collision.containment import ANCHOR_RADIUS, EnclosingMesh, Extent, anchor_points
from apex_ompl.collision.shapes import is_shell, is_surface
from apex_ompl.collision.solids import Solid, transform
from apex_ompl.types import Array


@dataclass(frozen=True, eq=False)
class ContainmentTest:
    """Test whether a solid lies entirely inside of another one's mesh.

    Attributes:
        outer_first: Whether the mesh is that of the first solid of the pair.
        mesh: The mesh.
        points: A point of each connected piece of the inner solid, in its frame, shape (pieces, 3) [m].
    """

    outer_first: bool
    mesh: EnclosingMesh
    points: Array

    def holds(self, outer: pin.SE3, inner: pin.SE3, request: coal.CollisionRequest) -> bool:
        """Whether a piece is inside, for the poses of both solids in the world."""
        for point in self.points:
            world = inner.act(point)
            if not self.mesh.convex:
                local, (low, high) = outer.actInv(world), self.mesh.box
                if (local >= low).all() and (local <= high).all() and self.mesh.contains(local):
                    return True
                continue
            ball, result = coal.Sphere(ANCHOR_RADIUS), coal.CollisionResult()
            at = coal.Transform3s(np.eye(3), world)
            if coal.collide(self.mesh.hull, transform(outer), ball, at, request, result):
                return True
        return False


def containment_tests(first: Solid, second: Solid) -> list[ContainmentTest]:
    """Return the tests whether one of two solids lies inside of the other; none where sizes rule it out."""
    tests = []
    for outer_first, (outer, inner) in ((True, (first, second)), (False, (second, first))):
        if (
            is_shell(outer.shape)
            and not is_surface(outer.shape)
            and Extent.of(outer.shape).may_contain(Extent.of(inner.shape))
        ):
            tests.append(ContainmentTest(outer_first, EnclosingMesh.of(outer.shape), anchor_points(inner.shape)))
    return tests
