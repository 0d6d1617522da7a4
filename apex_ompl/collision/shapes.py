"""Coal geometry of the shapes of a problem, exact or as convex hulls."""

from __future__ import annotations

from pathlib import Path

import coal
import numpy as np

from apex_ompl.errors import FileFormatError, MissingFileError
from apex_ompl.scene.bodies import Body
from apex_ompl.scene.meshes import extent_fault, orientation_fault, triangles
from apex_ompl.types import Array
from apex_ompl.util.files import is_file


def coal_geometry(body: Body) -> coal.CollisionGeometry:
    """Return the Coal geometry of a body's shape, in the body's frame.

    Boxes, spheres, cylinders, capsules and half-spaces become solids, meshes become a bounding volume
    hierarchy over their triangles.

    Raises:
        MissingFileError: The mesh file cannot be read.
        FileFormatError: The mesh file holds no solid; see ``apex_ompl.scene.meshes``.
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
        return _half_space(np.asarray(body.half_space.normal, float), body.half_space.offset)
    assert body.mesh is not None
    return _load_mesh(body.name, body.mesh.file, np.asarray(body.mesh.scale, float))


def world_geometry(body: Body) -> tuple[coal.CollisionGeometry, Array]:
    """Return the Coal geometry of a body and its placement in the world, shape (4, 4).

    A half-space is returned in world coordinates with the identity as placement, because Coal's bounding box of a
    rotated half-space overflows and the broadphase then misses collisions.

    Raises:
        MissingFileError: The mesh file cannot be read.
        FileFormatError: The mesh file holds no solid.
    """
    if body.half_space is None:
        return coal_geometry(body), body.pose
    normal = body.pose[:3, :3] @ np.asarray(body.half_space.normal, float)
    length = float(np.linalg.norm(normal))
    offset = body.half_space.offset / length + float(normal @ body.pose[:3, 3]) / length
    return _half_space(normal / length, offset), np.eye(4)


def _half_space(normal: Array, offset: float) -> coal.Halfspace:
    length = float(np.linalg.norm(normal))
    return coal.Halfspace(normal / length, offset / length)


def is_shell(geometry: coal.CollisionGeometry) -> bool:
    """Whether the geometry is a triangle mesh, which collides by its surface and not by its inside."""
    return bool(geometry.getObjectType() == coal.OT_BVH)


def convex_hull(geometry: coal.CollisionGeometry) -> coal.CollisionGeometry:
    """Return the convex hull of a mesh, or the geometry itself when it is convex already."""
    if not is_shell(geometry):
        return geometry
    if geometry.convex is None:
        geometry.buildConvexHull(True, "Qt")
    return geometry.convex


def _load_mesh(name: str, file: str, scale: Array) -> coal.CollisionGeometry:
    role = f"mesh of {name!r}"
    if not is_file(Path(file)):
        raise MissingFileError(file, role)
    try:
        mesh = coal.MeshLoader().load(file, scale)
    except Exception as error:
        raise FileFormatError(file, "", "something else", f"expected an STL or OBJ mesh ({role})") from error
    if mesh is None or mesh.num_tris == 0:
        fault = "no triangles"
    else:
        vertices, faces = triangles(mesh)
        fault = extent_fault(vertices) or orientation_fault(vertices, faces)
    if fault:
        raise FileFormatError(file, "", fault, f"expected a closed mesh of consistently oriented triangles ({role})")
    return mesh
