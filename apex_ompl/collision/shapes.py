"""Coal geometry of the shapes of a problem.

Coal has no point clouds: a cloud, balls of one radius around points, is given to it as the box around them, and its
contacts are found by :mod:`apex_ompl.collision.cloud_contact`.
"""

from __future__ import annotations

import base64
import hashlib
import logging
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from pathlib import Path
from weakref import WeakValueDictionary

import coal
import numpy as np
from numpy.typing import NDArray

from apex_ompl.errors import FileFormatError
from apex_ompl.kernel.distance_grid import grid_of_triangles_beside
from apex_ompl.scene.bodies import (
    AttachedObject,
    Body,
    BodyT,
    GridFile,
    MeshFile,
    PointFile,
    file_shape,
    located,
    size_note,
)
from apex_ompl.scene.grids import parse_surface
from apex_ompl.scene.mesh_files import read_mesh
from apex_ompl.scene.meshes import (
    capped,
    edges_of,
    extent_fault,
    hole_fault,
    orientation_fault,
    surface_note,
    triangles,
)
from apex_ompl.scene.points import parse_points
from apex_ompl.types import Array
from apex_ompl.util.arrays import bounding_box
from apex_ompl.util.cache import weakly_cached
from apex_ompl.util.files import read_file
from apex_ompl.util.forking import ProcessLock

KEPT_MESHES = 32  # meshes that were loaded last and are kept for the next problem
LARGE = 50_000  # triangles of a mesh from which its distance grid is made in parallel to its tree
MANY_TRIANGLES = 200_000  # which take seconds

LOG = logging.getLogger("apex_ompl")

_loading = ProcessLock()
_meshes: WeakValueDictionary[str, coal.BVHModelBase] = WeakValueDictionary()  # by content and scale
_recent: list[coal.BVHModelBase] = []


def coal_geometry(body: Body) -> coal.CollisionGeometry:
    """Return the Coal geometry of a body's shape, in the body's frame.

    Boxes, spheres, cylinders, capsules and half-spaces become solids; meshes, voxels and distance grids a bounding
    volume hierarchy over their triangles; points the box around them.

    Raises:
        MissingFileError: The mesh file cannot be read.
        FileFormatError: The file holds no solid; see ``apex_ompl.scene.meshes``.
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
    shape = file_shape(body)
    assert shape is not None
    return _as_read(shape) or _load(body.name, shape)


@weakly_cached
def _as_read(_: MeshFile | PointFile | GridFile) -> coal.CollisionGeometry | None:
    """Return the geometry read by :func:`with_file_read` for a shape of a file, None for others."""
    return None


def with_file_read(body: BodyT) -> BodyT:
    """Return a body whose record keeps the current content of its file, and names it by an absolute path.

    The file is not read again for this record, nor for records made from it: it may change or disappear.

    Raises:
        MissingFileError: The file cannot be read.
        FileFormatError: The file holds no solid.
    """
    shape = file_shape(body)
    if shape is None or _as_read(shape) is not None:
        return body
    body = located(body, Path())
    shape = file_shape(body)
    _as_read.keep(shape, _load(body.name, shape)) if shape is not None else None
    return body


def with_file_unread(body: BodyT) -> BodyT:
    """Return a body whose file is read anew when it is needed."""
    shape = file_shape(body)
    return body if shape is None else body.model_copy(update={body.shape: shape.model_copy()})


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


def mesh_note(body: Body) -> str:
    """Return a sentence on a mesh that is no proper solid and how it is interpreted, or an empty string.

    Raises:
        MissingFileError: The mesh file cannot be read.
        FileFormatError: The mesh file holds no solid.
    """
    if body.mesh is None or body.mesh.solid is False:
        return ""
    note = surface_note(*triangles(coal_geometry(body)))
    return f"the mesh of {body.name!r} ({Path(body.mesh.file).name}) {note}" if note else ""


def body_note(body: Body) -> str:
    """Return what is odd about a body: a mesh that is no proper solid, or a length of another unit; else nothing.

    Raises:
        MissingFileError: The file cannot be read.
        FileFormatError: The file holds no solid.
    """
    longest = 0.0
    if file_shape(body) is not None:
        geometry = coal_geometry(body)
        geometry.computeLocalAABB()
        longest = float((geometry.aabb_local.max_ - geometry.aabb_local.min_).max())
    return "; ".join(filter(None, (mesh_note(body), size_note(body, longest))))


def _load(name: str, shape: MeshFile | PointFile | GridFile) -> coal.CollisionGeometry:
    """Return the geometry in a file; files of the same content, read alike, share it."""
    role = f"{'mesh' if isinstance(shape, MeshFile) else 'file'} of {name!r}"
    content = read_file(Path(shape.file), role) if shape.content is None else base64.b64decode(shape.content)
    how = (
        f"{type(shape).__name__} {shape.model_dump_json(exclude={'file', 'content'})} {Path(shape.file).suffix.lower()}"
    )
    key = hashlib.sha256(content + how.encode()).hexdigest()
    with _loading:
        geometry = _meshes.get(key)
        if geometry is None:
            geometry = _meshes[key] = _parse(role, shape, content)
        _recent[:] = [geometry, *(other for other in _recent if other is not geometry)][:KEPT_MESHES]
        return geometry


def _parse(role: str, shape: MeshFile | PointFile | GridFile, content: bytes) -> coal.CollisionGeometry:
    if isinstance(shape, PointFile):
        return cloud_geometry(PointCloud(parse_points(shape.file, content), shape.radius))
    if isinstance(shape, GridFile):
        vertices, faces = parse_surface(shape.file, content)
        if fault := extent_fault(vertices):
            raise FileFormatError(shape.file, "", fault, f"expected cells of a solid ({role})")
        return mesh_geometry(vertices, faces)
    return _parse_mesh(role, shape, content)


def _parse_mesh(role: str, shape: MeshFile, content: bytes) -> coal.CollisionGeometry:
    file, scale = shape.file, np.asarray(shape.scale, float)
    try:
        vertices, faces = read_mesh(file, content)
    except Exception as error:
        raise FileFormatError(file, "", str(error), f"expected a mesh of triangles ({role})") from error
    vertices, alone = vertices * scale, shape.solid is False
    fault = "no triangles" if not len(faces) else extent_fault(vertices, flat=alone)
    fault = fault or ("" if alone else orientation_fault(vertices, faces))
    fault = fault or (hole_fault(vertices, faces) if shape.solid else "")
    if fault:
        wanted = "finite triangles" if alone else "a closed mesh of consistently oriented triangles"
        raise FileFormatError(file, "", fault, f"expected {wanted} ({role})")
    with _grid_beside(vertices, faces, alone):
        mesh = mesh_geometry(vertices, faces)
    if alone:
        is_surface.keep(mesh, True)
    return mesh


def _grid_beside(vertices: Array, faces: NDArray[np.int64], alone: bool) -> AbstractContextManager[None]:
    """Return a block during which the grid of distances of a large mesh is made, as the kernel will ask for it."""
    if len(faces) < LARGE:
        return nullcontext()
    if alone:
        return grid_of_triangles_beside(vertices[faces], solid=False)
    edges = edges_of(vertices, faces)
    closed = not len(edges.open) and not edges.balance.any()
    return grid_of_triangles_beside(capped(vertices, faces), solid=True) if closed else nullcontext()


@weakly_cached
def is_surface(_: coal.CollisionGeometry) -> bool:
    """Whether a geometry is a mesh without an inside, as its file was read."""
    return False


def mesh_geometry(vertices: Array, faces: NDArray[np.int64]) -> coal.BVHModelOBBRSS:
    """Return the geometry of triangles, given by vertices, shape (V, 3) [m], and indices, shape (T, 3)."""
    if len(faces) > MANY_TRIANGLES:
        LOG.warning("apex_ompl prepares %d triangles (about %d s, once)", len(faces), len(faces) * 6e-6)
    mesh = coal.BVHModelOBBRSS()
    mesh.beginModel(len(faces), len(vertices))
    mesh.addVertices(vertices)
    mesh.addTriangles(faces)
    mesh.endModel()
    vertices.flags.writeable = faces.flags.writeable = False
    triangles.keep(mesh, (vertices, faces))
    return mesh


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Balls around points.

    Attributes:
        points: Shape (N, 3) [m].
        radius: Radius of the balls [m].
    """

    points: Array
    radius: float

    @cached_property
    def box(self) -> Array:
        """Box around the balls, shape (2, 3) [m]."""
        found: Array = bounding_box(self.points) + np.array([[-self.radius], [self.radius]])
        return found


@weakly_cached
def cloud_of(_: coal.CollisionGeometry) -> PointCloud | None:
    """Return the point cloud that a geometry stands for, None for other geometries."""
    return None


def cloud_geometry(cloud: PointCloud) -> coal.CollisionGeometry:
    """Return the geometry that stands for a cloud: the box around it."""
    corners = coal.StdVec_Vec3s()
    corners.extend([cloud.box[list(k), [0, 1, 2]] for k in np.ndindex(2, 2, 2)])
    box = coal.Convex.convexHull(corners, True, "Qt")
    cloud_of.keep(box, cloud)
    return box


def held_extent(held: AttachedObject) -> Array:
    """Return the least and the largest corner of a box around a held object, shape (2, 3) [m].

    The box lies along the axes of the link that holds the object.

    Raises:
        MissingFileError, FileFormatError: Its mesh cannot be read.
    """
    return extent_in_link(coal_geometry(held), held.pose)


def extent_in_link(geometry: coal.CollisionGeometry, pose: Array) -> Array:
    """Return :func:`held_extent` of a geometry at a pose in its link's frame, shape (4, 4) [m]."""
    geometry.computeLocalAABB()
    low, high = geometry.aabb_local.min_, geometry.aabb_local.max_
    corners = np.array(list(product(*zip(low, high, strict=True))))
    placed = corners @ pose[:3, :3].T + pose[:3, 3]
    return np.stack([placed.min(axis=0), placed.max(axis=0)])
