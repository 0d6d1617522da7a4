"""Signed distances between convex hulls by GJK, and by EPA where they overlap."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import coal
import numpy as np
import pinocchio as pin

from apex_ompl.collision.solids import Solid, box_distances, transform, world_boxes
from apex_ompl.types import Array
from apex_ompl.util.display import fields_line


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
        dynamic: Solids of the one set.
        at: Their poses in the world.
        others: Solids of the other set.
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
