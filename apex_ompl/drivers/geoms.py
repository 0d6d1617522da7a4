"""Geometry of the collision checker as geoms of MuJoCo, which collides convex shapes.

A mesh that is convex is one geom. Of any other surface (a cup, voxels, a mesh without an inside) each triangle is a
prism below it, so that contacts are those with the surface itself, and not with its convex hull.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import coal
import numpy as np

from apex_ompl.collision.hulls import convex_hull, hull_corners
from apex_ompl.collision.shapes import cloud_of, is_shell, is_surface
from apex_ompl.errors import SceneError
from apex_ompl.scene.meshes import capped, triangles
from apex_ompl.types import Array
from apex_ompl.util.cache import weakly_cached

CONVEX_SHARE = 0.99  # share of the volume of its hull above which a mesh is one geom
THICKNESS = 1e-3  # of the prisms that stand for a surface [m]
SMALLEST_AREA = 1e-10  # of a triangle that becomes a prism [m^2]
MOST_GEOMS = 10_000  # of one body


@dataclass(frozen=True, eq=False)
class GeomShape:
    """Shape of a geom in the frame of its body.

    Attributes:
        kind: Name of the type in MuJoCo, such as ``BOX``.
        size: Its sizes, up to three [m].
        pose: Pose in the frame of the body, shape (4, 4) [m].
        vertices: Corners of a convex mesh, shape (V, 3) [m]; None for other types.
    """

    kind: str
    size: tuple[float, ...]
    pose: Array
    vertices: Array | None = None


def geom_shapes(geometry: coal.CollisionGeometry, pose: Array, name: str) -> Iterator[GeomShape]:
    """Yield the shapes of the geoms for a geometry at a pose in the frame of its body, shape (4, 4) [m].

    Args:
        geometry: Geometry of the collision checker.
        pose: Its pose in the frame of the body.
        name: Name of the body, for errors.

    Raises:
        SceneError: It has too many points or triangles.
    """
    cloud = cloud_of(geometry)
    if cloud is not None:
        _check_count(len(cloud.points), "points", name)
        for point in cloud.points:
            yield GeomShape("SPHERE", (cloud.radius,), _moved(pose, point))
    elif isinstance(geometry, coal.Box):
        yield GeomShape("BOX", tuple(geometry.halfSide), pose)
    elif isinstance(geometry, coal.Sphere):
        yield GeomShape("SPHERE", (geometry.radius,), pose)
    elif isinstance(geometry, coal.Cylinder | coal.Capsule):
        yield GeomShape(type(geometry).__name__.upper(), (geometry.radius, geometry.halfLength), pose)
    elif isinstance(geometry, coal.Halfspace):
        yield GeomShape("PLANE", (0.0, 0.0, 1.0), pose @ _plane_pose(geometry.n, geometry.d))
    elif is_shell(geometry):
        for corners in convex_pieces(geometry, name):
            yield GeomShape("MESH", (), pose, corners)
    elif isinstance(geometry, coal.Convex):
        yield GeomShape("MESH", (), pose, np.array(geometry.points()))
    else:
        raise SceneError(f"{name}: a {type(geometry).__name__} has no counterpart in MuJoCo")


def convex_pieces(mesh: coal.BVHModelBase, name: str) -> list[Array]:
    """Return the corners of convex pieces of a mesh, each of shape (V, 3) [m].

    Raises:
        SceneError: It is not convex, and has too many triangles.
    """
    if is_convex(mesh):
        return [triangles(mesh)[0]]
    _check_count(mesh.num_tris, "triangles", name)
    return _prisms(mesh)


@weakly_cached
def is_convex(mesh: coal.BVHModelBase) -> bool:
    """Whether the convex hull of a mesh is hardly larger than the mesh."""
    if is_surface(mesh):
        return False
    hull = np.abs(_volumes(hull_corners(convex_hull(mesh)))).sum()
    return bool(np.abs(_volumes(capped(*triangles(mesh))).sum()) > CONVEX_SHARE * hull)


def _prisms(mesh: coal.BVHModelBase) -> list[Array]:
    """Return the corners of a prism below each triangle, shape (6, 3); around it where the mesh has no inside."""
    vertices, faces = triangles(mesh)
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normals, axis=1) / 2.0
    corners, normals = corners[area > SMALLEST_AREA], normals[area > SMALLEST_AREA]
    down = -THICKNESS * normals / np.linalg.norm(normals, axis=1)[:, None]
    top = corners - down[:, None] / 2.0 if is_surface(mesh) else corners
    if not is_surface(mesh) and _volumes(capped(vertices, faces)).sum() < 0.0:  # it is inside out
        down = -down
    return list(np.concatenate([top, top + down[:, None]], axis=1))


def _volumes(corners: Array) -> Array:
    """Return the signed volumes of the tetrahedra from the mean corner to each triangle, shape (T,) [m^3].

    Args:
        corners: Corners of the triangles, shape (T, 3, 3) [m].
    """
    a, b, c = np.moveaxis(corners - corners.mean(axis=(0, 1)), 1, 0)
    return np.asarray(np.sum(a * np.cross(b, c), axis=1) / 6.0)


def _plane_pose(normal: Array, offset: float) -> Array:
    """Return a pose whose z axis is the normal, and whose origin is on the plane, shape (4, 4)."""
    other = np.eye(3)[int(np.argmin(np.abs(normal)))]
    x = np.cross(other, normal)
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([x, np.cross(normal, x), normal], axis=1)
    pose[:3, 3] = offset * np.asarray(normal)
    return pose


def _moved(pose: Array, point: Array) -> Array:
    """Return a pose whose origin is a point of its frame, shape (4, 4)."""
    moved: Any = pose.copy()
    moved[:3, 3] += pose[:3, :3] @ point
    return np.asarray(moved)


def _check_count(count: int, what: str, name: str) -> None:
    if count > MOST_GEOMS:
        raise SceneError(f"{name}: {count} {what} are too many for MuJoCo, expected at most {MOST_GEOMS}")
