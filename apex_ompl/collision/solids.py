"""Solids of a scene: the robot's links, what it holds, and obstacles, each fixed to a joint of Pinocchio's model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import coal
import numpy as np
import pinocchio as pin

from apex_ompl.collision.hulls import convex_hull
from apex_ompl.types import Array, Flags

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
