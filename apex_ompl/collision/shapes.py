"""Coal geometry of the shapes of a problem, exact or as convex hulls."""

from __future__ import annotations

import hashlib
import threading
from pathlib import Path
from weakref import WeakValueDictionary

import coal
import numpy as np
from numpy.typing import NDArray

from apex_ompl.errors import FileFormatError
from apex_ompl.scene.bodies import Body
from apex_ompl.scene.meshes import extent_fault, orientation_fault, surface_note, triangles
from apex_ompl.types import Array
from apex_ompl.util.files import read_file
from apex_ompl.util.weak_cache import weakly_cached

KEPT_MESHES = 32  # meshes that were loaded last and are kept for the next problem
DIRECTIONS = (400, 60)  # in which hulls of too many vertices are sampled; fewer where Coal takes no more
MOST_VERTICES = 50_000  # of a mesh whose hull is not sampled

_loading = threading.RLock()
_meshes: WeakValueDictionary[str, coal.BVHModelBase] = WeakValueDictionary()  # by content and scale
_recent: list[coal.BVHModelBase] = []


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
    """Return the convex hull of a mesh, or the geometry itself when it is convex already.

    Coal takes at most 255 neighbours of a vertex. Where a hull has more, and of meshes of more than ``MOST_VERTICES``,
    which take seconds, a slightly larger body with fewer vertices is returned.
    """
    if not is_shell(geometry):
        return geometry
    return geometry.convex if geometry.convex is not None else _hull_of_mesh(geometry)


@weakly_cached
def _hull_of_mesh(mesh: coal.BVHModelBase) -> coal.Convex:
    vertices = np.array(mesh.vertices())
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
    """Return the point that is farthest in each direction, shape (D,), and how far it is, shape (D,) [m]."""
    columns = np.ascontiguousarray(points.T)
    found = np.empty(len(directions), np.intp)
    for k in range(0, len(directions), 4):  # few at a time stay in the processor's cache
        found[k : k + 4] = (directions[k : k + 4] @ columns).argmax(axis=1)
    return found, np.einsum("ij,ij->i", directions, points[found])


def mesh_note(body: Body) -> str:
    """Return a sentence on a mesh that is no proper solid as it is and how it is taken, or an empty string.

    Raises:
        MissingFileError: The mesh file cannot be read.
        FileFormatError: The mesh file holds no solid.
    """
    if body.mesh is None:
        return ""
    note = surface_note(*triangles(coal_geometry(body)))
    return f"the mesh of {body.name!r} ({Path(body.mesh.file).name}) {note}" if note else ""


def _load_mesh(name: str, file: str, scale: Array) -> coal.CollisionGeometry:
    """Return the mesh in a file; files of the same content share it."""
    role = f"mesh of {name!r}"
    content = read_file(Path(file), role)
    key = hashlib.sha256(content + Path(file).suffix.lower().encode() + scale.tobytes()).hexdigest()
    with _loading:
        mesh = _meshes.get(key)
        if mesh is None:
            mesh = _meshes[key] = _parse_mesh(role, file, content, scale)
        _recent[:] = [mesh, *(other for other in _recent if other is not mesh)][:KEPT_MESHES]
        return mesh


def _parse_mesh(role: str, file: str, content: bytes, scale: Array) -> coal.CollisionGeometry:
    try:
        # Trees of oriented boxes, which collisions need, are made of sound vertices only: Coal prints many lines else.
        parsed = coal.MeshLoader(coal.BV_AABB).load(file, scale) if content.strip() else None
    except Exception as error:
        found = content[:60].decode(errors="replace")
        raise FileFormatError(file, "", found, f"expected an STL or OBJ mesh ({role})") from error
    if parsed is None:
        raise FileFormatError(file, "", "an empty file", f"expected an STL or OBJ mesh ({role})")
    fault = "no triangles"
    if parsed.num_tris > 0:
        vertices, faces = triangles(parsed)
        fault = extent_fault(vertices) or orientation_fault(vertices, faces)
    if fault:
        raise FileFormatError(file, "", fault, f"expected a closed mesh of consistently oriented triangles ({role})")
    mesh = coal.BVHModelOBBRSS()
    mesh.beginModel(len(faces), len(vertices))
    mesh.addVertices(vertices)
    mesh.addTriangles(faces)
    mesh.endModel()
    return mesh
