"""What a camera would see of held objects in a state, without a frame: visible surface, and covariances of a fit.

Robot, held objects, fixtures and obstacles are drawn as the camera sees them. Points of an object's surface are visible
where no other surface is before them; a fit to the drawn depths (:mod:`apex_ompl.perception.held`) has the covariance
that a fit to measured ones would have.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
import trimesh

from apex_ompl.collision.shapes import cloud_of, coal_geometry
from apex_ompl.kernel.perception import draw_triangles
from apex_ompl.perception.camera import Camera
from apex_ompl.perception.frames import Frame
from apex_ompl.perception.held import HeldObject, HeldObjectFinder
from apex_ompl.perception.held_settings import HeldSettings
from apex_ompl.perception.rendering import lens_of
from apex_ompl.perception.surfaces import RobotSurface, Surface, body_surface, geometry_surface, inverse, joined
from apex_ompl.robot.model import Robot
from apex_ompl.scene.bodies import AttachedObject, Body
from apex_ompl.types import Array, Flags, Indices

POINTS, FACE_POINTS = 200, 60  # of an object's surface, and of its contact face
FACE_COSINE = 0.7  # between the normals of a contact face and its axis, of which the normals of a ball's are spread
BEFORE = 0.015  # distance by which a surface that hides a point is before it [m]
COARSE = 4  # pixels of the camera for one of the drawing that tells what is visible
NO_DISTORTION = (0.0, 0.0, 0.0, 0.0, 0.0)


class SurfacePoints(NamedTuple):
    """Points spread evenly over a surface, in the frame of a link.

    Attributes:
        points: Shape (N, 3) [m].
        normals: Outward unit normals, shape (N, 3).
        face: Whether they are of the contact face, shape (N,).
    """

    points: Array
    normals: Array
    face: Flags


class Visible(NamedTuple):
    """Visible shares of an object.

    Attributes:
        surface: Share of its whole surface; of a closed surface about half at most.
        face: Share of its contact face, 0 without one.
    """

    surface: float
    face: float


class ViewPredictor:
    """Predicts what cameras see of the objects that a robot holds.

    Attributes:
        robot: The robot.
        attached: The held objects.
        finder: Finds the objects in frames.
    """

    def __init__(
        self, robot: Robot, attached: Sequence[AttachedObject], obstacles: Iterable[Body] = (), *,
        settings: HeldSettings | None = None, seed: int = 0, surface: RobotSurface | None = None,
    ) -> None:  # fmt: skip
        """Collect the surfaces of the robot, the objects, the robot's fixtures and obstacles.

        Args:
            robot: The robot.
            attached: The held objects, where they are believed to be.
            obstacles: Obstacles; half-spaces and distance grids hide nothing.
            settings: Settings of the fit.
            seed: Seed of the points of surfaces.
            surface: The robot's surface, where it is known already.

        Raises:
            ApexError: An object has a link that the robot does not have, or a shape without a surface.
        """
        self.robot, self.attached = robot, tuple(attached)
        self._robot = surface or RobotSurface(robot)
        self.finder = HeldObjectFinder(robot, attached, settings, self._robot)
        held = [body_surface(one).at(one.pose) for one in self.attached]
        bodies = map(obstacle_surface, (*robot.fixtures, *obstacles))
        still = [one for one in bodies if one is not None]
        self._held, self._still = held, still
        own = Surface(self._robot.vertices, self._robot.faces)
        self._faces = joined([own, *held, *still]).faces
        rng = np.random.default_rng(seed)
        self._points = [surface_points(one, its, rng) for one, its in zip(self.attached, held, strict=True)]

    def draw(self, camera: Camera, state: Array, coarse: int = 1) -> Array:
        """Return depths without noise, shape (height, width) [m], infinite where there is nothing.

        Args:
            camera: The camera, whose distortion does not count.
            state: State of the robot, shape (dof,).
            coarse: Pixels of the camera for one of the image.
        """
        pose = camera.pose_at(self.robot, state)
        own = self._robot.seen_from(pose, self._robot.poses(state))
        links = [self.robot.link_pose(state, one.link) for one in self.attached]
        parts = [one.at(inverse(pose) @ link) for one, link in zip(self._held, links, strict=True)]
        parts += [one.at(inverse(pose)) for one in self._still]
        size = camera.height // coarse, camera.width // coarse
        return draw_triangles(
            np.concatenate([own, *(one.vertices for one in parts)]), self._faces, lens_of(camera) / coarse, *size
        )[0]

    def visible(self, camera: Camera, state: Array, least_cosine: float) -> tuple[Visible, ...]:
        """Return the visible shares of the objects.

        A point is visible that is in the image and in range, whose normal is turned to the camera, and that nothing is
        before.

        Args:
            camera: The camera.
            state: State of the robot, shape (dof,).
            least_cosine: Least cosine between a normal and the direction to the camera.
        """
        depth, world = self.draw(camera, state, COARSE), inverse(camera.pose_at(self.robot, state))
        found = []
        for one, own in zip(self.attached, self._points, strict=True):
            pose = world @ self.robot.link_pose(state, one.link)
            points, normals = own.points @ pose[:3, :3].T + pose[:3, 3], own.normals @ pose[:3, :3].T
            seen = visible_points(points, normals, camera, depth, least_cosine)
            face = float(seen[own.face].mean()) if own.face.any() else 0.0
            found.append(Visible(float(seen[:POINTS].mean()), face))
        return tuple(found)

    def predicted(self, camera: Camera, state: Array, frames: int) -> tuple[HeldObject, ...]:
        """Return what a fit to a number of frames would find, in the order of ``attached``."""
        plain = camera.model_copy(update={"distortion": NO_DISTORTION})
        depth = self.draw(plain, state)
        seen = np.where(np.isfinite(depth) & (depth <= camera.depth.farthest), depth / camera.depth.scale, 0.0)
        joints = dict(zip(self.robot.joint_names, state.tolist(), strict=True))
        return self.finder.find(Frame(plain, seen, joints=joints), frames)


def obstacle_surface(body: Body) -> Surface | None:
    """Return the surface of a body in the world; balls of a cloud are cubes, and None stands for no bounded surface."""
    if body.half_space is not None or body.distance_grid is not None:
        return None
    geometry = coal_geometry(body)
    cloud = cloud_of(geometry)
    if cloud is None:
        return geometry_surface(geometry, body.name).at(body.pose)
    cube = trimesh.creation.box(np.full(3, 2.0 * cloud.radius))
    vertices = (cloud.points[:, None] + np.array(cube.vertices)).reshape(-1, 3)
    firsts = len(cube.vertices) * np.arange(len(cloud.points))
    faces: Indices = (firsts[:, None, None] + np.array(cube.faces, np.int64)).reshape(-1, 3)
    return Surface(vertices, faces).at(body.pose)


def surface_points(body: AttachedObject, surface: Surface, rng: np.random.Generator) -> SurfacePoints:
    """Return points of an object's surface, and after these points of its contact face.

    The contact face is what is turned along the contact axis, and the nearest such part to the contact point.

    Args:
        body: The object.
        surface: Its surface in the frame of its link.
        rng: Source of places.
    """
    mesh = trimesh.Trimesh(surface.vertices, surface.faces, process=False)
    corners, normals, areas = surface.vertices[surface.faces], surface.face_normals(), np.asarray(mesh.area_faces)
    parts = [_sampled(corners, normals, areas, POINTS, rng)]
    if body.contact is not None:
        axis = body.pose[:3, :3] @ np.asarray(body.contact.axis, float)
        point = body.pose[:3, :3] @ np.asarray(body.contact.point, float) + body.pose[:3, 3]
        axis = axis / np.linalg.norm(axis)
        turned = normals @ axis > FACE_COSINE
        height = np.abs((corners.mean(axis=1) - point) @ axis)
        nearest = height.min(where=turned, initial=np.inf)
        chosen = turned & (height < nearest + 0.1 * surface.radius)
        if chosen.any():
            parts.append(_sampled(corners[chosen], normals[chosen], areas[chosen], FACE_POINTS, rng))
    points, turned_to = (np.concatenate([part[k] for part in parts]) for k in range(2))
    return SurfacePoints(points, turned_to, np.arange(len(points)) >= POINTS)


def _sampled(
    corners: Array, normals: Array, areas: Array, count: int, rng: np.random.Generator
) -> tuple[Array, Array]:  # fmt: skip
    """Return points of triangles, shape (T, 3, 3), spread evenly over their areas, and normals, shape (N, 3) each.

    Shares of so few points vary less than those of independent ones, which trimesh draws.
    """
    places = (np.arange(count) + rng.random()) / count * areas.sum()
    chosen = np.minimum(np.searchsorted(np.cumsum(areas), places), len(areas) - 1)
    a, b = rng.random((2, count))
    outside = a + b > 1.0
    a, b = np.where(outside, 1.0 - a, a), np.where(outside, 1.0 - b, b)
    shares = np.stack([1.0 - a - b, a, b], axis=1)
    return (shares[:, :, None] * corners[chosen]).sum(axis=1), normals[chosen]


def visible_points(points: Array, normals: Array, camera: Camera, depth: Array, least_cosine: float) -> Flags:
    """Return which points of surfaces a camera sees, shape (N,).

    Args:
        points: In the optical frame, shape (N, 3) [m].
        normals: Unit normals there, shape (N, 3).
        camera: The camera.
        depth: Depths of all surfaces at every ``COARSE``-th pixel, shape (h, w) [m].
        least_cosine: Least cosine between a normal and the direction to the camera.
    """
    z = points[:, 2]
    front = (z > camera.depth.nearest) & (z < camera.depth.farthest)
    pixels = camera.focal * points[:, :2] / np.where(front, z, 1.0)[:, None] + camera.center
    inside = front & (pixels > 0.0).all(axis=1) & (pixels < (camera.width - 1.0, camera.height - 1.0)).all(axis=1)
    distance = np.maximum(np.linalg.norm(points, axis=1), 1e-9)
    turned = -(normals * points).sum(axis=1) > least_cosine * distance
    cell = np.where(inside[:, None], pixels / COARSE, 0.0).round().astype(np.int64)
    column, row = np.minimum(cell[:, 0], depth.shape[1] - 1), np.minimum(cell[:, 1], depth.shape[0] - 1)
    return np.asarray(inside & turned & (depth[row, column] > z - BEFORE))
