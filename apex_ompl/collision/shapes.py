"""Coal geometry of the shapes of a problem, exact or as convex hulls."""

from __future__ import annotations

import hashlib
import io
import logging
import threading
from contextlib import AbstractContextManager, nullcontext
from itertools import product
from pathlib import Path
from weakref import WeakValueDictionary

import coal
import numpy as np
from numpy.typing import NDArray

from apex_ompl.collision.clouds import PointCloud, cloud_geometry
from apex_ompl.errors import FileFormatError
from apex_ompl.kernel.compiled.farthest_points import farthest_points
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
from apex_ompl.util.boxes import bounding_box
from apex_ompl.util.files import read_file
from apex_ompl.util.weak_cache import weakly_cached

LOADED_BY_COAL = (".stl", ".obj")  # which takes half a second less than the other library's import
THICKNESS = 1e-6  # by which hulls of surfaces are larger [m]
KEPT_MESHES = 32  # meshes that were loaded last and are kept for the next problem
DIRECTIONS = (400, 60)  # in which hulls of too many vertices are sampled; fewer where Coal takes no more
CELLS = 24  # along the longest side of a grid over vertices
LARGE = 50_000  # triangles of a mesh from which on its grid of distances is made while its tree is
MANY_TRIANGLES = 200_000  # which take seconds
MOST_VERTICES = 50_000  # of a mesh whose hull is not sampled

LOG = logging.getLogger("apex_ompl")

_loading = threading.RLock()
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


def convex_hull(geometry: coal.CollisionGeometry) -> coal.CollisionGeometry:
    """Return the convex hull of a mesh, or the geometry itself when it is convex already.

    That of a surface without an inside, which may be flat, is the box around it. Coal takes at most 255 neighbours of a
    vertex. Where a hull has more, and of meshes of more than ``MOST_VERTICES``,
    which take seconds, a slightly larger body with fewer vertices is returned.
    """
    if not is_shell(geometry):
        return geometry
    return geometry.convex if geometry.convex is not None and not is_surface(geometry) else _hull_of_mesh(geometry)


@weakly_cached
def _hull_of_mesh(mesh: coal.BVHModelBase) -> coal.Convex:
    vertices = np.array(mesh.vertices())
    if is_surface(mesh):
        low, high = vertices.min(axis=0) - THICKNESS, vertices.max(axis=0) + THICKNESS
        return _hull_of(np.array(list(product(*np.stack([low, high], axis=1)))))
    if len(vertices) > MOST_VERTICES:
        return _larger_hull(vertices)
    try:
        with _loading:
            mesh.buildConvexHull(True, "Qt")
    except RuntimeError:
        return _larger_hull(vertices)
    return mesh.convex


def hull_corners(hull: coal.Convex) -> Array:
    """Return the corners of the triangles of a convex hull, shape (T, 3, 3) [m]."""
    rows = [(row[0], row[1], row[2]) for row in map(hull.polygons, range(hull.num_polygons))]
    corners: Array = np.array(hull.points())[np.array(rows)]
    return corners


def hull_planes(hull: coal.Convex) -> tuple[Array, Array]:
    """Return outward unit normals n, shape (planes, 3), and offsets o, shape (planes,) [m]: n . x <= o in the hull."""
    corners = hull_corners(hull)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    long = np.linalg.norm(normals, axis=1)
    sound = long > 1e-14
    normals = normals[sound] / long[sound, None]
    offsets = np.einsum("ij,ij->i", normals, corners[sound, 0])
    sign = np.sign(offsets - normals @ corners.mean(axis=(0, 1)))
    return normals * sign[:, None], offsets * sign


def _larger_hull(vertices: Array) -> coal.Convex:
    """Return a convex body of few vertices that contains the given ones, shape (V, 3) [m].

    It is the hull of those that are farthest in some direction, stretched about its centre until it contains all.
    """
    for count in DIRECTIONS:
        rise = 1.0 - (2.0 * np.arange(count) + 1.0) / count
        turn = np.pi * (1.0 + 5.0**0.5) * np.arange(count)
        flat = np.sqrt(1.0 - rise**2)
        directions = np.stack([flat * np.cos(turn), flat * np.sin(turn), rise], axis=1)
        chosen = vertices[np.unique(_farthest(directions, vertices)[0])]
        try:
            normals, offsets = hull_planes(_hull_of(chosen))
            centre = chosen.mean(axis=0)
            room = offsets - normals @ centre
            wide = room > 1e-6 * room.max()  # planes of slivers may be turned by rounding
            reach = _farthest(normals[wide], vertices - centre)[1]
            return _hull_of(centre + (1.0 + 1e-6) * max(1.0, float((reach / room[wide]).max())) * (chosen - centre))
        except RuntimeError:
            continue
    raise AssertionError("a hull of few vertices has few neighbours")


def _hull_of(points: Array) -> coal.Convex:
    found = coal.StdVec_Vec3s()
    found.extend(list(points))
    return coal.Convex.convexHull(found, True, "Qt")


def _farthest(directions: Array, points: Array) -> tuple[NDArray[np.intp], Array]:
    """Return the point that is farthest in each direction, shape (D,), and how far it is, shape (D,) [m].

    Of the points of a grid's cells only those are looked at whose cell may reach farther than any first point of one.
    """
    low, high = bounding_box(points)
    wide = float((high - low).max())
    side = max(wide / CELLS, 1e-12)
    cells = np.ravel_multi_index(tuple(((points - low) / side).astype(np.int64).T), (CELLS + 1,) * 3)
    order = np.argsort(cells, kind="stable")
    first = np.flatnonzero(np.diff(cells[order], prepend=-1))
    points = np.ascontiguousarray(points[order])
    middles = low + side * (np.floor((points[first] - low) / side) + 0.5)
    found = np.empty(len(directions), np.int64)
    half, directions = (0.5 + 1e-6) * side, np.ascontiguousarray(directions)
    farthest_points(directions, points, np.append(first, len(order)), middles, half, found)
    return order[found], np.einsum("ij,ij->i", directions, points[found])


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
    return np.array(loaded.vertices, float) * scale, np.array(loaded.faces, np.int64)


def mesh_geometry(vertices: Array, faces: NDArray[np.int64]) -> coal.BVHModelOBBRSS:
    """Return the geometry of triangles, given by vertices, shape (V, 3) [m], and indices, shape (T, 3)."""
    if len(faces) > MANY_TRIANGLES:
        LOG.warning("apex_ompl prepares %d triangles (about %d s, once)", len(faces), len(faces) * 1e-5)
    mesh = coal.BVHModelOBBRSS()
    mesh.beginModel(len(faces), len(vertices))
    mesh.addVertices(vertices)
    mesh.addTriangles(faces)
    mesh.endModel()
    vertices.flags.writeable = faces.flags.writeable = False
    triangles.keep(mesh, (vertices, faces))
    return mesh
