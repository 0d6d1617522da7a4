"""Coal geometry of the shapes of a problem."""

from __future__ import annotations

import hashlib
import io
import logging
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from weakref import WeakValueDictionary

import coal
import numpy as np
from numpy.typing import NDArray

from apex_ompl.collision.clouds import PointCloud, cloud_geometry
from apex_ompl.errors import FileFormatError
from apex_ompl.kernel.distance_grid import grid_of_triangles_beside
from apex_ompl.scene.bodies import Body, GridFile, MeshFile, PointFile
from apex_ompl.scene.grids import parse_surface
from apex_ompl.scene.meshes import (
    binary_stl,
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
from apex_ompl.util.files import read_file
from apex_ompl.util.forking import ProcessLock
from apex_ompl.util.weak_cache import weakly_cached

LOADED_BY_COAL = (".stl", ".obj")  # which takes half a second less than the other library's import
KEPT_MESHES = 32  # meshes that were loaded last and are kept for the next problem
LARGE = 50_000  # triangles of a mesh from which on its grid of distances is made while its tree is
MANY_TRIANGLES = 200_000  # which take seconds

LOG = logging.getLogger("apex_ompl")

_loading = ProcessLock()
_meshes: WeakValueDictionary[str, coal.BVHModelBase] = WeakValueDictionary()  # by content and scale
_recent: list[coal.BVHModelBase] = []


def coal_geometry(body: Body) -> coal.CollisionGeometry:
    """Return the Coal geometry of a body's shape, in the body's frame.

    Boxes, spheres, cylinders, capsules and half-spaces become solids; meshes, voxels and distance grids a bounding
    volume hierarchy over their triangles; points what stands for them (:mod:`apex_ompl.collision.clouds`).

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
    shape = body.mesh or body.points or body.voxels or body.distance_grid
    assert shape is not None
    return _load(body.name, shape)


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
    """Return a sentence on a mesh that is no proper solid as it is and how it is taken, or an empty string.

    Raises:
        MissingFileError: The mesh file cannot be read.
        FileFormatError: The mesh file holds no solid.
    """
    if body.mesh is None or body.mesh.solid is False:
        return ""
    note = surface_note(*triangles(coal_geometry(body)))
    return f"the mesh of {body.name!r} ({Path(body.mesh.file).name}) {note}" if note else ""


def _load(name: str, shape: MeshFile | PointFile | GridFile) -> coal.CollisionGeometry:
    """Return the geometry in a file; files of the same content, read alike, share it."""
    role = f"{'mesh' if isinstance(shape, MeshFile) else 'file'} of {name!r}"
    content = read_file(Path(shape.file), role)
    how = f"{type(shape).__name__} {shape.model_dump_json(exclude={'file'})} {Path(shape.file).suffix.lower()}"
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
        return mesh_geometry(*parse_surface(shape.file, content))
    return _parse_mesh(role, shape, content)


def _parse_mesh(role: str, shape: MeshFile, content: bytes) -> coal.CollisionGeometry:
    file, scale = shape.file, np.asarray(shape.scale, float)
    try:
        vertices, faces = _read_triangles(file, content, scale)
    except Exception as error:
        found = content[:60].decode(errors="replace")
        raise FileFormatError(file, "", found, f"expected a mesh of triangles ({role})") from error
    alone = shape.solid is False
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


def _read_triangles(file: str, content: bytes, scale: Array) -> tuple[Array, NDArray[np.int64]]:
    """Return the vertices, shape (V, 3) [m], and the triangles, shape (T, 3), of a mesh file; of all that it holds."""
    if not content.strip():
        raise ValueError("an empty file")
    suffix = Path(file).suffix.lower()
    if suffix == ".stl" and (binary := binary_stl(content)) is not None:
        return binary[0] * scale, binary[1]
    if suffix in LOADED_BY_COAL:
        # Trees of oriented boxes, which collisions need, are made of sound vertices only: Coal prints many lines else.
        return triangles(coal.MeshLoader(coal.BV_AABB).load(file, scale))
    import trimesh

    loaded = trimesh.load_mesh(io.BytesIO(content), file_type=Path(file).suffix[1:].lower(), process=False)
    vertices, faces = np.array(loaded.vertices, float) * scale, np.array(loaded.faces, np.int64)
    if len(faces) and not 0 <= faces.min() <= faces.max() < len(vertices):
        raise ValueError("a face names a vertex that is not there")
    return vertices, faces


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
