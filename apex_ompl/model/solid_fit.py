"""Boxes, balls and cylinders with the second moments of a set of places."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np

from apex_ompl.kernel.arrays import BOX, CYLINDER, SPHERE
from apex_ompl.model.geometry import signed_distances
from apex_ompl.types import Array

PLACES, POINTS = 3000, 300  # of which moments, and orientations, are taken
THINNEST = 0.002  # least half side or radius [m]
TURNS = np.radians(np.arange(0.0, 90.0, 5.0))
ORDERS = [list(order) for order in itertools.permutations(range(3))]
FINE_TURNS = np.radians(np.arange(-4.0, 4.5, 1.0))


@dataclass(frozen=True, eq=False)
class Solid:
    """A box, a ball or a cylinder.

    Attributes:
        kind: BOX, SPHERE or CYLINDER.
        rotation: From its frame, shape (3, 3).
        position: Of its center, shape (3,) [m].
        size: Half edges; radius; or radius and half length along z; shape (3,), 0 behind these [m].
    """

    kind: int
    rotation: Array
    position: Array
    size: Array

    def distances(self, places: Array) -> Array:
        """Return signed distances of places, shape (N, 3) [m]."""
        rows = (np.array([self.kind]), self.position[None], self.rotation[None], self.size[None])
        return np.asarray(signed_distances(*rows, places[None])[0])


def solids_like(places: Array, spacing: float, less: float) -> list[Solid]:
    """Return boxes, a ball and cylinders with the second moments of places.

    Args:
        places: Nodes of a lattice inside of a solid, shape (N, 3) [m].
        spacing: Of the lattice [m].
        less: By which radii and half sides are made smaller [m].
    """
    places = places[:: max(1, len(places) // PLACES)]
    middle = places.mean(axis=0)
    spread = np.cov(places.T) + spacing**2 / 12.0 * np.eye(3)
    variances, axes = np.linalg.eigh(spread)

    def fit(kind: int, rotation: Array, *size: float) -> Solid:
        row = np.zeros(3)
        row[: len(size)] = np.maximum(np.array(size) - less, THINNEST)
        return Solid(kind, rotation, middle, row)

    fits = [
        fit(BOX, np.eye(3), *np.sqrt(3.0 * np.diag(spread))),
        fit(SPHERE, np.eye(3), math.sqrt(5.0 * variances.mean())),
    ]
    some = places[:: max(1, len(places) // POINTS)] - middle
    for z in range(3):
        x, y = (z + 1) % 3, (z + 2) % 3
        frame = np.stack([axes[:, x], axes[:, y], axes[:, z]], axis=1)
        frame[:, 0] *= np.sign(np.linalg.det(frame))
        radius = math.sqrt(2.0 * (variances[x] + variances[y]))
        fits.append(fit(CYLINDER, turned_to(frame[:, 2]), radius, math.sqrt(3.0 * variances[z])))
        turned = _nearest_axes(frame @ _smallest_rectangle(some @ frame))
        fits.append(fit(BOX, turned, *np.sqrt(3.0 * np.diag(turned.T @ spread @ turned))))
    return fits


def turned_to(axis: Array) -> Array:
    """Return the smallest rotation, shape (3, 3), that takes the z axis to an axis or its opposite."""
    x, y, z = axis if axis[2] >= 0.0 else -axis
    return np.array(
        [
            [1.0 - x * x / (1.0 + z), -x * y / (1.0 + z), x],
            [-x * y / (1.0 + z), 1.0 - y * y / (1.0 + z), y],
            [-x, -y, z],
        ]
    )


def _nearest_axes(rotation: Array) -> Array:
    """Return the rotation nearest to none of those that have the same axes, in another order or opposite."""
    order = max(ORDERS, key=lambda some: float(np.abs(np.diag(rotation[:, some])).sum()))
    found = rotation[:, order]
    found = found * np.where(np.diag(found) < 0.0, -1.0, 1.0)
    if np.linalg.det(found) < 0.0:
        found[:, int(np.abs(np.diag(found)).argmin())] *= -1.0
    return found


def _smallest_rectangle(local: Array) -> Array:
    """Return the rotation about z, shape (3, 3), after which the rectangle around points, shape (N, 3), is smallest."""
    best = 0.0
    for turns in (TURNS, FINE_TURNS):
        angles = best + turns
        axes = np.stack([np.cos(angles), np.sin(angles)])
        sides = np.ptp(local[:, :2] @ axes, axis=0) * np.ptp(local[:, :2] @ np.stack([-axes[1], axes[0]]), axis=0)
        best = float(angles[sides.argmin()])
    c, s = math.cos(best), math.sin(best)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
