"""A camera without physics: frames of a robot that any driver moves, drawn by the kernel's own renderer.

It needs neither MuJoCo nor OpenGL, and a frame of 320 x 240 pixels takes some milliseconds. The robot is where the
driver measures it, and holds its objects as the problem has them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np
from numpy.typing import NDArray

from apex_ompl.drivers.driver import Driver
from apex_ompl.drivers.twin import COLORS
from apex_ompl.errors import ParameterError
from apex_ompl.kernel.perception import draw_triangles
from apex_ompl.perception.camera import Camera
from apex_ompl.perception.frames import Frame, check_camera
from apex_ompl.perception.rendering import View, lens_of, seen_through
from apex_ompl.perception.surfaces import RobotSurface, Surface, body_surface
from apex_ompl.robot.model import Robot
from apex_ompl.scene.bodies import Body, Obstacle, same_solid
from apex_ompl.scene.problem import Problem
from apex_ompl.types import Array
from apex_ompl.util.display import one_line

FURNITURE = COLORS["fixture"]  # color of what stands still
RED = (0.8, 0.1, 0.08, 1.0)  # of other obstacles
AMBIENT = 0.5  # share of light from all sides; the rest comes from the camera
SLICES = 32  # of round surfaces


def no_others(_: float) -> Iterable[Obstacle]:
    """Return that there is no obstacle besides those of the problem."""
    return ()


class RenderedCamera:
    """A camera that sees a driver's robot among obstacles.

    Attributes:
        driver: The driver.
        camera: The camera as it is.
        reported: The camera that frames name.
    """

    def __init__(
        self, driver: Driver, robot: Robot, problem: Problem, camera: Camera, *, reported: Camera | None = None,
        others: Callable[[float], Iterable[Obstacle]] = no_others, measured: Callable[[Array], Array] | None = None,
    ) -> None:  # fmt: skip
        """Collect the surfaces.

        Args:
            driver: The driver, whose joints are the robot's.
            robot: The robot.
            problem: Obstacles that stand still, in the color of furniture, and held objects.
            camera: The camera as it is.
            reported: The camera that frames name, by default the same one.
            others: Returns other obstacles by the time [s], in red.
            measured: Function from exact depths, shape (height, width) [m], to measured ones.

        Raises:
            ApexError: A body has no surface, or an argument is of another kind.
        """
        check_camera(camera)
        self.driver, self.camera, self.reported = driver, camera, camera if reported is None else reported
        check_camera(self.reported, "reported")
        if (self.reported.width, self.reported.height) != (camera.width, camera.height):
            size = f"{self.reported.width} x {self.reported.height}"
            raise ParameterError("reported", size, f"a camera of {camera.width} x {camera.height} pixels")
        self._robot, self._surface = robot, RobotSurface(robot, SLICES)
        self._others, self._measured = others, measured
        self._held = [(held, body_surface(held, SLICES)) for held in problem.attached]
        still = [body_surface(one, SLICES).at(one.pose) for one in (*robot.fixtures, *problem.still.scene)]
        self._still = _joined(still)
        self._known: dict[str, tuple[Body, Surface]] = {}

    def __repr__(self) -> str:
        """Return the camera and the robot."""
        return one_line("RenderedCamera", self.camera.name, self._robot.name)

    def frame(self) -> Frame:
        """Return what the camera sees now, with the measured positions of joints and their stamp.

        Raises:
            ApexError: A body has no surface.
        """
        state = self.driver.state()
        q = np.asarray(state.positions, float)
        eye = self.camera.pose_at(self._robot, q)
        turn, place = eye[:3, :3], eye[:3, 3]
        links = self._surface.seen_from(eye, self._surface.poses(q))
        held = _joined([shape.at(self._robot.link_pose(q, one.link) @ one.pose) for one, shape in self._held])
        others = _joined([self._shape(one).at(one.pose) for one in self._others(state.stamp)])
        parts = [Surface(links, self._surface.faces)]
        parts += [Surface((one.vertices - place) @ turn, one.faces) for one in (self._still, held, others)]
        view = self._view(parts)
        depth, errors = view.depth, self.camera.depth
        depth = np.where((depth >= errors.nearest) & (depth <= errors.farthest), depth, 0.0) / errors.scale
        joints = dict(zip(self._robot.joint_names, q.tolist(), strict=True))
        seen = depth if self._measured is None else self._measured(depth)
        return Frame(self.reported, seen, _shaded(view), state.stamp, joints)

    def close(self) -> None:
        """Release nothing; other cameras have something to release."""

    def _shape(self, body: Obstacle) -> Surface:
        known = self._known.get(body.name)
        if known is None or not same_solid(known[0], body):
            known = self._known[body.name] = body, body_surface(body, SLICES)
        return known[1]

    def _view(self, parts: list[Surface]) -> View:
        """Return depths, the numbers of the parts from 1 on, and normals."""
        camera, all_parts = self.camera, _joined(parts)
        label = np.repeat(np.arange(1, len(parts) + 1), [len(part.faces) for part in parts])
        depth, index = draw_triangles(all_parts.vertices, all_parts.faces, lens_of(camera), camera.height, camera.width)
        corners = all_parts.vertices[all_parts.faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        there = index >= 0
        return seen_through(
            camera,
            View(
                np.where(there, depth, 0.0), np.where(there, label[index], 0),
                np.where(there[..., None], normals[index], 0.0),
            ),
        )  # fmt: skip


def _joined(parts: list[Surface]) -> Surface:
    """Return surfaces as one."""
    firsts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    vertices = [np.empty((0, 3)), *(part.vertices for part in parts)]
    faces = [np.empty((0, 3), np.int64), *(part.faces + first for part, first in zip(parts, firsts, strict=False))]
    return Surface(np.concatenate(vertices), np.concatenate(faces))


def _shaded(view: View) -> NDArray[np.uint8]:
    """Return colors by the number of the part, lit from the camera, shape (height, width, 3)."""
    names = [COLORS["floor"], COLORS["link"], FURNITURE, COLORS["held"], RED]
    table = np.array([rgba[:3] for rgba in names])
    shade = AMBIENT + (1.0 - AMBIENT) * np.abs(view.normals[..., 2])
    image = table[view.labels] * shade[..., None]
    return np.asarray((255.0 * image.clip(0.0, 1.0)).round().astype(np.uint8))
