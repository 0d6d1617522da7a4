"""Signed distances between convex shapes by GJK, and by EPA where they overlap."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from apex_ompl.collision.shapes import convex_hull
from apex_ompl.types import Array


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


NO_PAIR = Distance(float("inf"), "", "", np.full((2, 3), np.nan))


class HullDistances:
    """Signed distances of pairs of geometries, each replaced by its convex hull.

    A hull contains its mesh, so the distance is a lower bound. It is exact for boxes, spheres, cylinders, capsules and
    convex meshes.
    """

    def __init__(
        self,
        model: pin.Model,
        geometry: pin.GeometryModel,
        pairs: Sequence[tuple[int, int]],
        labels: Sequence[str],
    ) -> None:
        """Prepare the hulls of the geometries in ``pairs``; ``labels`` are the names of all geometries."""
        self._model = model
        self._data = model.createData()
        self._hulls = pin.GeometryModel()
        index: dict[int, int] = {}
        self._labels: list[str] = []
        for number in sorted({i for pair in pairs for i in pair}):
            item = geometry.geometryObjects[number].copy()
            item.geometry = convex_hull(item.geometry)
            index[number] = self._hulls.addGeometryObject(item)
            self._labels.append(labels[number])
        self._pairs = [(index[a], index[b]) for a, b in pairs]
        for a, b in self._pairs:
            self._hulls.addCollisionPair(pin.CollisionPair(a, b))
        self._hull_data = self._hulls.createData()
        self._lock = threading.Lock()

    def values(self, q: Array) -> Array:
        """Return the signed distance of every pair at a state in Pinocchio's order, shape (pairs,) [m]."""
        with self._lock:
            return self._values(q)

    def _values(self, q: Array) -> Array:
        pin.computeDistances(self._model, self._data, self._hulls, self._hull_data, q)
        return np.array([result.min_distance for result in self._hull_data.distanceResults])

    def closest(self, q: Array) -> Distance:
        """Return the closest pair at a state in Pinocchio's order."""
        if not self._pairs:
            return NO_PAIR
        with self._lock:
            values = self._values(q)
            k = int(np.argmin(values))
            result = self._hull_data.distanceResults[k]
            points = np.array([result.getNearestPoint1(), result.getNearestPoint2()])
        first, second = (self._labels[i] for i in self._pairs[k])
        return Distance(float(values[k]), first, second, points)
