"""Masses and inertias of held objects, from their shapes where problem files do not give them."""

from __future__ import annotations

import numpy as np

from apex_ompl.collision.shapes import coal_geometry, is_shell, is_surface
from apex_ompl.robot.dynamics import Load
from apex_ompl.scene.bodies import AttachedObject, symmetric
from apex_ompl.scene.meshes import capped, triangles
from apex_ompl.types import Array


def held_load(held: AttachedObject) -> Load | None:
    """Return the mass of a held object in the frame of its link, or None where it has none.

    Where the center of mass or the inertia are not given, they are those of its shape (:func:`per_mass`).

    Raises:
        MissingFileError: The file of its shape cannot be read.
        FileFormatError: The file holds no shape.
    """
    if held.mass is None:
        return None
    center, inertia = per_mass(held) if None in (held.center_of_mass, held.inertia) else (np.zeros(3), np.zeros((3, 3)))
    center = center if held.center_of_mass is None else np.asarray(held.center_of_mass)
    inertia = held.mass * inertia if held.inertia is None else symmetric(held.inertia)
    turn, place = held.pose[:3, :3], held.pose[:3, 3]
    return Load(held.link, held.mass, turn @ center + place, turn @ inertia @ turn.T)


def per_mass(held: AttachedObject) -> tuple[Array, Array]:
    """Return the center of mass, shape (3,) [m], and the inertia about it for 1 kg, shape (3, 3) [m^2], of a shape.

    The shape is a solid of uniform density, a mesh with holes as if they were closed, or a surface of uniform density
    by area. With simplices of corners p_i and measure m (tetrahedra with an inner point as their fourth corner, or
    triangles), the second moments are the sum of m / (k (k + 1)) (sum_i p_i p_i^T + s s^T), where s = sum_i p_i and k
    is the number of corners.
    """
    geometry = coal_geometry(held)
    if not is_shell(geometry):
        return np.zeros(3), np.array(geometry.computeMomentofInertia()) / geometry.computeVolume()
    vertices, faces = triangles(geometry)
    corners = vertices[faces] if is_surface(geometry) else capped(vertices, faces)
    origin = corners.mean(axis=(0, 1))
    corners = corners - origin
    a, b, c = np.moveaxis(corners, 1, 0)
    if is_surface(geometry):
        measure, k = np.linalg.norm(np.cross(b - a, c - a), axis=1), 3
    else:
        measure, k = np.einsum("ij,ij->i", a, np.cross(b, c)), 4
    measure = measure / measure.sum()
    sums = corners.sum(axis=1)
    center = measure @ sums / k
    second = np.einsum("n,nki,nkj->ij", measure, corners, corners) + np.einsum("n,ni,nj->ij", measure, sums, sums)
    second = second / (k * (k + 1)) - np.outer(center, center)
    return origin + center, np.trace(second) * np.eye(3) - second
