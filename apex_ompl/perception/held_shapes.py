"""Shapes of held objects: their surfaces, symmetries, and how much measurements of them say."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import trimesh

from apex_ompl.kernel.perception import AXIS, BALL
from apex_ompl.perception.surfaces import Surface, body_surface
from apex_ompl.scene.bodies import AttachedObject
from apex_ompl.types import Array, Indices

INFLATION = {
    "box": (1.50, 0.58), "cylinder": (1.05, 0.56), "capsule": (1.05, 0.56), "slender": (1.10, 0.52),
    "sphere": (1.02, 0.64), "mesh": (1.40, 0.68), "thin mesh": (1.06, 0.64),
}  # fmt: skip
"""Factors of the variances of measurements by shape: of one frame, and of means of frames, without flying pixels.

They make mean normalized squared errors those of chi-squared on scenes of their own (``python -m
benchmarks.perception.held --calibrate``, which prints those to take).
"""
SLENDER = 0.3  # radius over half length of cylinders and capsules below which they are slender
THIN = 0.5  # share of the volume of its hull below which a mesh is thin
ROUND, LEAST_RING = 1e-3, 12  # of vertices on rings: share of the radius in which they agree, and their least number


class HeldShape(NamedTuple):
    """The shape of an object, as fits take it.

    Attributes:
        body: The object.
        surface: Its surface.
        ties: Unknown of the scale along each axis, shape (3,).
        symmetry: ``AXIS``, ``BALL``, or 0.
        inflation: Factors of the variances of its measurements, of one frame and of means of frames.
    """

    body: AttachedObject
    surface: Surface
    ties: Indices
    symmetry: int
    inflation: tuple[float, float]


class Expected(NamedTuple):
    """Where an object should be.

    Attributes:
        shape: Its shape.
        pose: Its pose in the world, shape (4, 4) [m].
        covariance: Of a turn and a shift in the axes of the world, shape (6, 6).
    """

    shape: HeldShape
    pose: Array
    covariance: Array

    @property
    def name(self) -> str:
        """Name of the object."""
        return self.shape.body.name


def held_shape(body: AttachedObject) -> HeldShape:
    """Return the shape of an object.

    Raises:
        ApexError: Its file cannot be read, or it has no surface of triangles.
    """
    surface = body_surface(body)
    inflation = INFLATION[_kind_of(body, surface)]
    return HeldShape(body, surface, _ties(body, surface), symmetry(body, surface), inflation)


def _ties(body: AttachedObject, surface: Surface) -> Indices:
    """Return which axes have the same scale: those of round surfaces, and of meshes that are as wide as deep."""
    if body.sphere is not None:
        return np.array([0, 0, 0])
    if body.box is not None:
        return np.array([0, 1, 2])
    sides = np.ptp(surface.vertices, axis=0)
    return np.array([0, 0, 2]) if abs(sides[0] - sides[1]) < 1e-3 * sides[0] else np.array([0, 1, 2])


def symmetry(body: AttachedObject, surface: Surface | None = None) -> int:
    """Return ``AXIS`` for a body of revolution about its z, ``BALL`` or 0; vertices of round meshes lie on rings.

    Args:
        body: The body.
        surface: Its surface, where that is known.

    Raises:
        ApexError: The file of its mesh cannot be read.
    """
    if body.sphere is not None:
        return BALL
    if body.cylinder is not None or body.capsule is not None:
        return AXIS
    if body.mesh is None:
        return 0
    surface = surface or body_surface(body)
    radii = np.hypot(surface.vertices[:, 0], surface.vertices[:, 1])
    rings = np.round(np.stack([radii, surface.vertices[:, 2]], axis=1) / (ROUND * surface.radius))
    _, owner, count = np.unique(rings, axis=0, return_inverse=True, return_counts=True)
    small = radii < ROUND * surface.radius
    return AXIS if (small | (count[owner.ravel()] >= LEAST_RING)).all() else 0


def _kind_of(body: AttachedObject, surface: Surface) -> str:
    """Return the key of a body in ``INFLATION``."""
    for round_body in (body.cylinder, body.capsule):
        if round_body is not None and round_body.radius < SLENDER * round_body.length / 2.0:
            return "slender"
    if body.shape in INFLATION and body.mesh is None:
        return body.shape
    mesh = trimesh.Trimesh(surface.vertices, surface.faces, process=False)
    return "thin mesh" if abs(mesh.volume) < THIN * mesh.convex_hull.volume else "mesh"
