"""Solids of a scene, each fixed to a joint of Pinocchio's model: their boxes, and distances of their convex hulls.

Solids are the robot's links, held objects and obstacles. Distances are signed: by GJK, and by EPA where hulls overlap.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import coal
import numpy as np
import pinocchio as pin

from apex_ompl.collision.hulls import convex_hull
from apex_ompl.types import Array, Flags
from apex_ompl.util.display import fields_line

BOX_MARGIN = 1e-6  # by which boxes are larger than their solids [m]


@dataclass(frozen=True, eq=False)
class Solid:
    """A solid that is fixed to a joint.

    Attributes:
        name: Name of a link, a held object, an obstacle or a fixture.
        joint: Joint of Pinocchio's model; 0 is the world.
        placement: Pose in the joint's frame [m].
        shape: The geometry.
        part: Name of the geometry, where a link has several.
    """

    name: str
    joint: int
    placement: pin.SE3
    shape: coal.CollisionGeometry
    part: str = ""

    @cached_property
    def half_box(self) -> tuple[Array, Array]:
        """Center and half edges of the bounding box in the solid's frame, each of shape (3,) [m]."""
        if self.shape.getNodeType() == coal.GEOM_HALFSPACE:
            return np.zeros(3), np.full(3, np.inf)
        self.shape.computeLocalAABB()
        box = self.shape.aabb_local
        low, high = np.array(box.min_), np.array(box.max_)
        return (low + high) / 2.0, (high - low) / 2.0 + BOX_MARGIN

    @property
    def hull(self) -> coal.CollisionGeometry:
        """Convex hull of the geometry."""
        return convex_hull(self.shape)

    def at(self, placement: pin.SE3) -> Solid:
        """Return the solid at another placement."""
        other = replace(self, placement=placement)
        other.__dict__["half_box"] = self.half_box
        return other


def transform(pose: pin.SE3) -> coal.Transform3s:
    """Return a pose for Coal."""
    return coal.Transform3s(pose.rotation, pose.translation)


def world_boxes(solids: Sequence[Solid], poses: Sequence[pin.SE3]) -> Array:
    """Return axis-aligned boxes around solids at poses in the world, shape (n, 2, 3) [m]."""
    if not solids:
        return np.empty((0, 2, 3))
    center, half = np.array([solid.half_box for solid in solids]).transpose(1, 0, 2)
    turn = np.array([pose.rotation for pose in poses])
    middle = (turn @ center[:, :, None])[:, :, 0] + np.array([pose.translation for pose in poses])
    with np.errstate(invalid="ignore"):  # half-spaces: 0 times infinity
        reach = (np.abs(turn) @ half[:, :, None])[:, :, 0]
    reach = np.where(np.isnan(reach), np.inf, reach)
    return np.stack([middle - reach, middle + reach], axis=1)


def overlaps(first: Array, second: Array) -> Flags:
    """Whether boxes of shape (n, 2, 3) and boxes of shape (m, 2, 3) overlap, shape (n, m)."""
    a, b = first[:, None], second[None]
    return np.asarray(((a[:, :, 0] <= b[:, :, 1]) & (b[:, :, 0] <= a[:, :, 1])).all(axis=2))


def box_distances(first: Array, second: Array) -> Array:
    """Return the distances of boxes of shape (n, 2, 3) and of shape (m, 2, 3), shape (n, m) [m]."""
    a, b = first[:, None], second[None]
    gaps = np.maximum(np.maximum(a[:, :, 0] - b[:, :, 1], b[:, :, 0] - a[:, :, 1]), 0.0)
    return np.asarray(np.linalg.norm(gaps, axis=2))


@dataclass(frozen=True)
class Distance:
    """Minimum distance at a state, and the pair that has it.

    Attributes:
        value: Signed distance [m]; the negative penetration depth where they overlap; ``inf`` without any pair.
        first: Name of a link or a held object.
        second: Name of an obstacle, a fixture or a link.
        points: Nearest points of ``first`` and ``second`` in the world, shape (2, 3) [m].
    """

    value: float
    first: str
    second: str
    points: Array

    __repr__ = fields_line


NO_PAIR = Distance(float("inf"), "", "", np.full((2, 3), np.nan))


def hull_distance(first: Solid, at: pin.SE3, second: Solid, there: pin.SE3) -> Distance:
    """Return the signed distance of the hulls of two solids at poses in the world.

    A hull contains its mesh, so the distance is a lower bound. It is exact for boxes, spheres, cylinders, capsules and
    convex meshes.
    """
    result = coal.DistanceResult()
    value = coal.distance(first.hull, transform(at), second.hull, transform(there), coal.DistanceRequest(), result)
    points = np.array([result.getNearestPoint1(), result.getNearestPoint2()])
    return Distance(float(value), first.name, second.name, points)


def closest(
    dynamic: Sequence[Solid], at: Sequence[pin.SE3], others: Sequence[Solid], there: Sequence[pin.SE3]
) -> Distance:
    """Return the least signed distance of the hulls of two sets of solids; pairs whose boxes are farther are left out.

    Args:
        dynamic: Solids of the first set.
        at: Their poses in the world.
        others: Solids of the second set.
        there: Their poses in the world.
    """
    best = NO_PAIR
    if not dynamic or not others:
        return best
    bounds = box_distances(world_boxes(dynamic, at), world_boxes(others, there))
    for k in np.argsort(bounds, axis=None, kind="stable").tolist():
        i, j = divmod(k, len(others))
        if bounds[i, j] > max(best.value, 0.0):
            break
        found = hull_distance(dynamic[i], at[i], others[j], there[j])
        if found.value < best.value:
            best = found
    return best
