"""A camera without physics: frames of a robot that any driver moves, drawn by the kernel's own renderer.

It needs neither MuJoCo nor OpenGL, and a frame of 320 x 240 pixels takes some milliseconds. The robot is where the
driver measures it, and holds its objects as the problem has them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np

from apex_ompl.drivers.driver import Driver
from apex_ompl.drivers.twin import COLORS
from apex_ompl.errors import ParameterError
from apex_ompl.perception.camera import Camera
from apex_ompl.perception.frames import Frame, check_camera
from apex_ompl.perception.rendering import Light, Part, ZBuffer, image_of, lit
from apex_ompl.perception.rig import RED
from apex_ompl.perception.surfaces import RobotSurface, Surface, body_surface, joined
from apex_ompl.robot.model import Robot
from apex_ompl.scene.bodies import Body, Obstacle, same_solid
from apex_ompl.scene.problem import Problem
from apex_ompl.types import Array
from apex_ompl.util.display import one_line

LIGHT = Light(direction=(0.0, 0.0, -1.0), ambient=0.5, warmth=(1.0, 1.0, 1.0), gain=1.0)  # from the camera
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
        self._still = [body_surface(one, SLICES).at(one.pose) for one in (*robot.fixtures, *problem.still.scene)]
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
        links = Surface(self._surface.seen_from(np.eye(4), self._surface.poses(q)), self._surface.faces)
        held = [shape.at(self._robot.link_pose(q, one.link) @ one.pose) for one, shape in self._held]
        others = [self._shape(one).at(one.pose) for one in self._others(state.stamp)]
        roles = ((COLORS["link"], [links]), (COLORS["fixture"], self._still), (COLORS["held"], held), (RED, others))
        parts = [Part(joined(some), k, rgba[:3]) for k, (rgba, some) in enumerate(roles, 1)]
        view = ZBuffer().draw(parts, self.camera, self.camera.pose_at(self._robot, q))
        depth, errors = view.depth, self.camera.depth
        depth = np.where((depth >= errors.nearest) & (depth <= errors.farthest), depth, 0.0) / errors.scale
        joints = dict(zip(self._robot.joint_names, q.tolist(), strict=True))
        seen = depth if self._measured is None else self._measured(depth)
        return Frame(self.reported, seen, image_of(lit(view, parts, LIGHT)), state.stamp, joints)

    def _shape(self, body: Obstacle) -> Surface:
        known = self._known.get(body.name)
        if known is None or not same_solid(known[0], body):
            known = self._known[body.name] = body, body_surface(body, SLICES)
        return known[1]
