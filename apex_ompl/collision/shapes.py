"""From the shapes of a problem to Coal geometry, exact and convex."""

from __future__ import annotations

from pathlib import Path

import coal
import numpy as np
from numpy.typing import NDArray

from apex_ompl.errors import FileFormatError, MissingFileError
from apex_ompl.problem import Body


def coal_geometry(body: Body) -> coal.CollisionGeometry:
    """Return the Coal geometry of a body's shape, in the body's frame.

    Boxes, spheres, cylinders, capsules and half-spaces become solids, meshes become a bounding volume
    hierarchy over their triangles.

    Raises:
        MissingFileError: The mesh file cannot be read.
        FileFormatError: The mesh file holds no triangles.
    """
    if body.box is not None:
        return coal.Box(*body.box)
    if body.sphere is not None:
        return coal.Sphere(body.sphere.radius)
    if body.cylinder is not None:
        return coal.Cylinder(body.cylinder.radius, body.cylinder.length)
    if body.capsule is not None:
        return coal.Capsule(body.capsule.radius, body.capsule.length)
    if body.half_space is not None:
        normal = np.asarray(body.half_space.normal, float)
        length = float(np.linalg.norm(normal))
        return coal.Halfspace(normal / length, body.half_space.offset / length)
    assert body.mesh is not None
    return _load_mesh(body.name, body.mesh.file, np.asarray(body.mesh.scale, float))


def is_shell(geometry: coal.CollisionGeometry) -> bool:
    """Whether collision with the geometry only sees its surface (a triangle mesh), not its inside."""
    return bool(geometry.getObjectType() == coal.OT_BVH)


def convex_hull(geometry: coal.CollisionGeometry) -> coal.CollisionGeometry:
    """Return the convex hull of a mesh, or the geometry itself when it is convex already."""
    if not is_shell(geometry):
        return geometry
    if geometry.convex is None:
        geometry.buildConvexHull(True, "Qt")
    return geometry.convex


def triangles(mesh: coal.BVHModelBase) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return the vertices, shape (V, 3) [m], and the vertex indices of the triangles, shape (T, 3)."""
    faces = [mesh.tri_indices(k) for k in range(mesh.num_tris)]
    return np.array(mesh.vertices()), np.array([[t[0], t[1], t[2]] for t in faces])


def _load_mesh(name: str, file: str, scale: NDArray[np.float64]) -> coal.CollisionGeometry:
    role = f"mesh of {name!r}"
    if not Path(file).is_file():
        raise MissingFileError(file, role)
    try:
        mesh = coal.MeshLoader().load(file, scale)
    except Exception as error:
        raise FileFormatError(file, "", str(error), f"expected a readable mesh ({role})") from error
    if mesh is None or mesh.num_tris == 0:
        raise FileFormatError(file, "", "no triangles", f"expected a triangle mesh ({role})")
    return mesh


def winding_number(point: NDArray[np.float64], corners: NDArray[np.float64]) -> float:
    """Return how often a closed triangle mesh winds around a point: about 1 inside, 0 outside.

    Args:
        point: Shape (3,), not on the surface.
        corners: Corners of the triangles, shape (T, 3, 3), counter-clockwise from outside.

    The solid angle of each triangle is taken by the formula of van Oosterom and Strackee (1983).
    """
    a, b, c = np.moveaxis(corners - point, 1, 0)
    la, lb, lc = (np.linalg.norm(v, axis=1) for v in (a, b, c))
    numerator = np.einsum("ij,ij->i", a, np.cross(b, c))
    dots = [np.einsum("ij,ij->i", u, v) for u, v in ((a, b), (b, c), (c, a))]
    denominator = la * lb * lc + dots[0] * lc + dots[1] * la + dots[2] * lb
    return float(np.arctan2(numerator, denominator).sum() / (2.0 * np.pi))
