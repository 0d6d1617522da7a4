"""Off-screen renderer of a scene with a robot, by PyVista; how things look is said by :mod:`appearance`."""

from __future__ import annotations

import os
from ctypes.util import find_library
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apex_ompl.errors import MissingFileError
from apex_ompl.ompl.setup import PlanningSetup
from apex_ompl.scene.scripts import is_there
from apex_ompl.types import Array
from apex_ompl.viz.appearance import BACKGROUND, EDGE, OBSTACLES, Item, focus_of, ghosts_of, items_of, joint_poses

SIZE = (1280, 960)
AZIMUTH = 26.0
CAPTION = "#222222"  # color of text


class SceneRenderer:
    """Off-screen renderer of one scene, with the robot at any state."""

    def __init__(self, setup: PlanningSetup, size: tuple[int, int] = SIZE, azimuth: float = AZIMUTH) -> None:
        """Add robot, fixtures, obstacles and held objects, and place the camera.

        Args:
            setup: Robot and problem.
            size: Width and height of the images [pixels].
            azimuth: Direction of the camera from the front of the robot, counter-clockwise [degrees].

        Raises:
            MissingFileError: The ``viz`` extra is not installed.
        """
        self._pv = _pyvista()
        self.robot, self._setup = setup.robot, setup
        self._data = self.robot.model.createData()
        self._plotter = self._pv.Plotter(off_screen=True, window_size=size, lighting="three lights")
        self._plotter.set_background(BACKGROUND)
        items = items_of(setup)
        self._moving = [item for item in items if item.moves]
        self._actors = [self._add(item, np.eye(4)) for item in self._moving]
        self._obstacles: dict[str, tuple[Array, list[Any]]] = {}  # where they were placed, and their actors
        for item in items:
            if item.layer == OBSTACLES:
                self._obstacles[item.name] = item.placement, []
            if not item.moves:
                self._add(item, item.placement)
        for obstacle in setup.problem.scene:
            if not is_there(obstacle, 0.0):
                self.show_obstacle(obstacle.name, None)
        self._place_camera(setup, azimuth)

    def _add(self, item: Item, pose: Array) -> Any:
        """Add an item at a pose, and return its actor; edges show what of an obstacle is nearly invisible."""
        pv = self._pv
        if item.mesh is None:
            ball = pv.Sphere(radius=item.radius, theta_resolution=8, phi_resolution=8)
            mesh = pv.PolyData(item.points).glyph(geom=ball, scale=False, orient=False)
        else:
            mesh = pv.wrap(item.mesh)
        mesh = mesh.transform(pose, inplace=False)
        actors = [self._plotter.add_mesh(mesh, color=item.color, opacity=item.opacity, specular=0.15)]
        if item.layer == OBSTACLES:
            if item.opacity < 0.5:
                actors.append(self._plotter.add_mesh(mesh.extract_feature_edges(30), color=EDGE, line_width=1.5))
            self._obstacles[item.name][1].extend(actors)
        return actors[0]

    def _place_camera(self, setup: PlanningSetup, azimuth: float) -> None:
        """Point the camera at the middle of hands and scene; from the front, the left arm is on the right."""
        focus, _ = focus_of(setup)
        turn = np.radians(azimuth)
        offset = np.array([2.6 * np.cos(turn), 2.6 * np.sin(turn), 1.25])
        self._plotter.camera_position = [focus + offset, focus, (0.0, 0.0, 1.0)]
        self._plotter.camera.view_angle = 34.0

    def add_ghost(self, q: Array) -> None:
        """Add a translucent copy of robot and held objects at a state."""
        joints = joint_poses(self.robot, self._data, q)
        for item in ghosts_of(self._setup):
            self._add(item, joints[item.joint] @ item.placement)

    def show_obstacle(self, name: str, pose: Array | None) -> None:
        """Show an obstacle of the scene at a pose, shape (4, 4), or hide it."""
        placed, actors = self._obstacles[name]
        for actor in actors:
            actor.visibility = pose is not None
            if pose is not None:
                actor.user_matrix = pose @ np.linalg.inv(placed)

    def _poses(self, q: Array) -> list[Array]:
        joints = joint_poses(self.robot, self._data, q)
        return [joints[item.joint] @ item.placement for item in self._moving]

    def screenshot(self, q: Array, caption: str = "") -> NDArray[np.uint8]:
        """Return an image of the scene with the robot at a state, shape (height, width, 3), and a line of text."""
        for actor, pose in zip(self._actors, self._poses(q), strict=True):
            actor.user_matrix = pose
        if caption:
            size = max(6, self._plotter.window_size[1] // 45)
            self._plotter.add_text(
                caption, position=(size, size), font_size=size, color=CAPTION, name="caption", render=False
            )
        self._plotter.render()
        return np.asarray(self._plotter.screenshot(None, return_img=True), dtype=np.uint8)


def _pyvista() -> Any:
    """Return the module ``pyvista``, set up for a machine without a display."""
    window = "vtkEGLRenderWindow" if find_library("EGL") else "vtkOSOpenGLRenderWindow"
    os.environ.setdefault("VTK_DEFAULT_OPENGL_WINDOW", window)
    try:
        import pyvista
    except ImportError as error:
        raise MissingFileError("pyvista", "package for pictures", "install the extra: apex-ompl[viz]") from error
    return pyvista
