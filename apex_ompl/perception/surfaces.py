"""Surfaces of bodies and of robots as triangles, to be drawn as a camera sees them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import coal
import numpy as np
import pinocchio as pin
import trimesh

from apex_ompl.collision.shapes import cloud_of, coal_geometry, is_shell, is_surface
from apex_ompl.errors import ParameterError
from apex_ompl.kernel.perception import place_vertices
from apex_ompl.robot.model import Robot
from apex_ompl.scene.bodies import Body
from apex_ompl.scene.meshes import capped, triangles
from apex_ompl.types import Array, Indices
from apex_ompl.util.arrays import bounding_box

SLICES = 32  # of round surfaces
BALL_STEPS = 3  # subdivisions of an icosahedron


class Surface(NamedTuple):
    """Triangles.

    Attributes:
        vertices: Shape (V, 3) [m].
        faces: Corners of triangles, counter-clockwise from outside, shape (F, 3).
    """

    vertices: Array
    faces: Indices

    @property
    def radius(self) -> float:
        """Largest distance of a vertex from the origin [m]."""
        return float(np.linalg.norm(self.vertices, axis=1).max())

    def at(self, pose: Array) -> Surface:
        """Return the surface at a pose, shape (4, 4) [m]."""
        return Surface(self.vertices @ pose[:3, :3].T + pose[:3, 3], self.faces)

    def face_normals(self) -> Array:
        """Return unit normals of the triangles, shape (F, 3)."""
        areas = self._areas()
        return np.asarray(areas / np.maximum(np.linalg.norm(areas, axis=1, keepdims=True), 1e-12))

    def _areas(self) -> Array:
        """Return normals of the triangles as long as twice their areas, shape (F, 3)."""
        corners = self.vertices[self.faces]
        return np.asarray(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))

    def normals(self) -> Array:
        """Return unit normals at the vertices, means of those of triangles weighted by area, shape (V, 3)."""
        areas = self._areas()
        sums = np.zeros_like(self.vertices)
        for k in range(3):
            np.add.at(sums, self.faces[:, k], areas)
        lengths = np.linalg.norm(sums, axis=1, keepdims=True)
        return np.asarray(sums / np.where(lengths > 0.0, lengths, 1.0))


def joined(surfaces: Sequence[Surface]) -> Surface:
    """Return surfaces as one, their triangles in order."""
    firsts = np.cumsum([0, *(len(one.vertices) for one in surfaces)])
    faces = [one.faces + first for one, first in zip(surfaces, firsts, strict=False)]
    return Surface(
        np.concatenate([np.empty((0, 3)), *(one.vertices for one in surfaces)]),
        np.concatenate([np.empty((0, 3), np.int64), *faces]),
    )


def body_surface(body: Body, slices: int = SLICES, ball_steps: int = BALL_STEPS) -> Surface:
    """Return the surface of a body in its frame.

    Raises:
        ApexError: Its file cannot be read, or it has no surface of triangles.
    """
    return geometry_surface(coal_geometry(body), body.name, slices, ball_steps)


def body_box(body: Body, spread: float) -> Array:
    """Return the box around a body in its frame, larger by a distance [m] on all sides, shape (2, 3) [m].

    Raises:
        ApexError: Its file cannot be read, or it has no surface of triangles.
    """
    found: Array = bounding_box(body_surface(body).vertices) + np.array([[-spread], [spread]])
    return found


def geometry_surface(
    geometry: coal.CollisionGeometry, name: str, slices: int = SLICES, ball_steps: int = BALL_STEPS
) -> Surface:
    """Return the surface of a geometry in its frame.

    Round surfaces become polyhedra of the same volume; of a mesh without an inside both sides are returned.

    Args:
        geometry: Geometry of the collision checker.
        name: Name of the body, for errors.
        slices: Sides of cylinders and capsules.
        ball_steps: How often the triangles of an icosahedron are divided for a ball.

    Raises:
        ParameterError: It has no surface of triangles.
    """
    if isinstance(geometry, coal.Box) and cloud_of(geometry) is None:
        return _made(trimesh.creation.box(2.0 * np.asarray(geometry.halfSide)))
    if isinstance(geometry, coal.Sphere):
        ball = trimesh.creation.icosphere(ball_steps, geometry.radius)
        ball.apply_scale(float(np.cbrt(4.0 / 3.0 * np.pi * geometry.radius**3 / ball.volume)))
        return _made(ball)
    if isinstance(geometry, coal.Cylinder | coal.Capsule):
        radius, height = geometry.radius * _equal_area(slices), 2.0 * geometry.halfLength
        if isinstance(geometry, coal.Cylinder):
            return _made(trimesh.creation.cylinder(radius, height, sections=slices))
        capsule = trimesh.creation.capsule(height, radius, count=[slices, max(6, slices // 2)])
        return _made(capsule.apply_translation(-capsule.bounds.mean(axis=0)))
    if is_shell(geometry):
        return _mesh_surface(geometry)
    raise ParameterError("shape", f"{type(geometry).__name__} of {name!r}", "a box, ball, cylinder, capsule or mesh")


def _equal_area(slices: int) -> float:
    """Return the radius of a regular polygon with the area of a circle of radius 1."""
    turn = 2.0 * np.pi / slices
    return float(np.sqrt(turn / np.sin(turn)))


def _made(mesh: Any) -> Surface:
    return Surface(np.array(mesh.vertices, float), np.array(mesh.faces, np.int64))


def _mesh_surface(mesh: coal.BVHModelBase) -> Surface:
    vertices, faces = triangles(mesh)
    corners = vertices[faces] if is_surface(mesh) else capped(vertices, faces)
    points, number = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)
    faces = number.reshape(-1, 3).astype(np.int64)
    if is_surface(mesh):
        return Surface(points, np.concatenate([faces, faces[:, ::-1]]))
    a, b, c = np.moveaxis(points[faces] - points.mean(axis=0), 1, 0)
    inside_out = float(np.sum(a * np.cross(b, c))) < 0.0
    return Surface(points, np.ascontiguousarray(faces[:, ::-1]) if inside_out else faces)


class RobotSurface:
    """Surface of all links of a robot.

    Attributes:
        robot: The robot.
        vertices: In the frames of the geometries, shape (V, 3) [m].
        normals: Unit normals there, shape (V, 3).
        part: Geometry of each vertex, shape (V,).
        faces: Triangles, shape (F, 3).
    """

    def __init__(self, robot: Robot, slices: int = 12) -> None:
        """Collect the surfaces of the links; round ones have ``slices`` sides."""
        self.robot = robot
        items = list(robot.geometry.geometryObjects)
        parts = [geometry_surface(item.geometry, item.name, slices) for item in items]
        self.vertices, self.faces = joined(parts)
        self.normals = np.concatenate([np.empty((0, 3)), *(part.normals() for part in parts)])
        self.part = np.repeat(np.arange(len(parts)), [len(part.vertices) for part in parts])
        self._data = robot.model.createData(), robot.geometry.createData()

    def poses(self, state: Array) -> Array:
        """Return the poses of the geometries in the world in a state, shape (dof,); of shape (P, 4, 4) [m]."""
        data, placements = self._data
        q = self.robot.to_pinocchio(state)
        pin.updateGeometryPlacements(self.robot.model, data, self.robot.geometry, placements, q)
        return np.array([one.homogeneous for one in placements.oMg]).reshape(-1, 4, 4)

    def seen_from(self, camera: Array, poses: Array, thicker: float = 0.0) -> Array:
        """Return the vertices in the optical frame of a camera, shape (V, 3) [m].

        Args:
            camera: Pose of the optical frame in the world, shape (4, 4) [m].
            poses: Poses of the geometries.
            thicker: Distance by which the vertices are moved outwards [m].
        """
        vertices = self.vertices + thicker * self.normals if thicker else self.vertices
        return place_vertices(vertices, self.part, inverse(camera) @ poses)


def inverse(pose: Array) -> Array:
    """Return the inverse of a pose, shape (4, 4) [m]."""
    found = np.eye(4)
    found[:3, :3] = pose[:3, :3].T
    found[:3, 3] = -pose[:3, :3].T @ pose[:3, 3]
    return found
