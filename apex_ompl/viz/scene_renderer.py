"""Off-screen renderer of a scene with a robot, by PyVista and with the robot's visual meshes.

Obstacles are red, fixtures have the colour of wood, held objects have colours of their own. The contact faces of an
alignment are arrows along their outward axes.
"""

from __future__ import annotations

import os
from ctypes.util import find_library
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from apex_ompl.collision.clouds import PointCloud, cloud_of
from apex_ompl.collision.shapes import coal_geometry, is_shell
from apex_ompl.collision.solids import Solid, world_boxes
from apex_ompl.errors import MissingFileError
from apex_ompl.ompl_adapter.setup import PlanningSetup
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import Body
from apex_ompl.scene.meshes import triangles
from apex_ompl.tasks.link_faces import LinkFace
from apex_ompl.types import Array

SIZE = (1280, 960)
AZIMUTH = 26.0
GHOST_OPACITY = 0.3
HELD_COLOURS = ("#2a9d8f", "#e9a03b", "#8e6bbf", "#4c78a8")
OBSTACLE, FIXTURE, BACKGROUND = "#c8553d", "#c9a77c", "#f4f4f1"
SIDE_COLOURS = {"left": "#e8eef4", "right": "#f3ece2"}
ARROW_COLOURS = ("#d62728", "#1f4ed8")
MOST_BALLS = 30_000  # that are drawn of a cloud
HALF_SPACE_EDGE = 3.0  # edge of the square that stands for a half-space [m]


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
        self.robot: Robot = setup.robot
        self._data = self.robot.model.createData()
        self._plotter = self._pv.Plotter(off_screen=True, window_size=size, lighting="three lights")
        self._plotter.set_background(BACKGROUND)
        self._meshes = self._robot_meshes(setup)
        self._actors = [self._plotter.add_mesh(mesh, **style) for _, _, mesh, style in self._meshes]
        for body in self.robot.fixtures:
            self._add_body(body, FIXTURE, 1.0)
        for body in setup.problem.scene:
            self._add_body(body, OBSTACLE, 0.14 if _is_thin_plate(body) else 0.9)
        self._place_camera(setup, azimuth)

    def _robot_meshes(self, setup: PlanningSetup) -> list[tuple[int, Any, Any, dict[str, Any]]]:
        """Return (parent joint, placement, mesh, drawing options) of links, held objects and contact faces."""
        robot, meshes = self.robot, []
        visuals = pin.buildGeomFromUrdfString(robot.model, robot.urdf, pin.GeometryType.VISUAL)
        for item in visuals.geometryObjects:
            side = item.name.split("_", 1)[0]
            hand = "hand" in item.name or "gripper" in item.name
            colour = "#4a4e57" if hand else SIDE_COLOURS.get(side, "#d9dce1")
            style = {"color": colour, "smooth_shading": False, "specular": 0.15}
            meshes.append((item.parentJoint, item.placement, self._mesh(item.geometry), style))
        for k, held in enumerate(setup.problem.attached):
            frame = robot.model.frames[robot.link_frame(held.link)]
            style = {"color": HELD_COLOURS[k % len(HELD_COLOURS)], "specular": 0.2}
            placement = frame.placement * pin.SE3(held.pose)
            meshes.append((frame.parentJoint, placement, self._mesh(coal_geometry(held)), style))
        faces: list[LinkFace] = []
        if setup.alignment is not None:
            faces = [setup.alignment.first, setup.alignment.second]
        for face, colour in zip(faces, ARROW_COLOURS, strict=False):
            frame = robot.model.frames[robot.link_frame(face.link)]
            arrow = self._pv.Arrow(
                start=face.point, direction=face.axis, scale=0.12, shaft_radius=0.035, tip_radius=0.09, tip_length=0.3
            )
            meshes.append((frame.parentJoint, frame.placement, arrow, {"color": colour}))
        return meshes

    def _mesh(self, geometry: Any) -> Any:
        """Return a PyVista mesh of a Coal geometry."""
        pv, kind = self._pv, type(geometry).__name__
        if is_shell(geometry):
            vertices, faces = triangles(geometry)
            return pv.PolyData(vertices, np.hstack([np.full((len(faces), 1), 3), faces]))
        if kind == "Box":
            x, y, z = geometry.halfSide
            return pv.Box(bounds=(-x, x, -y, y, -z, z))
        if kind == "Sphere":
            return pv.Sphere(radius=geometry.radius)
        if kind in ("Cylinder", "Capsule"):
            radius, half = geometry.radius, geometry.halfLength
            bar = pv.Cylinder(direction=(0, 0, 1), radius=radius, height=2 * half, resolution=48)
            if kind == "Cylinder":
                return bar
            return bar.merge([pv.Sphere(radius=radius, center=(0, 0, side * half)) for side in (-1, 1)])
        normal, offset = np.array(geometry.n), float(geometry.d)
        return pv.Plane(center=normal * offset, direction=normal, i_size=HALF_SPACE_EDGE, j_size=HALF_SPACE_EDGE)

    def _add_body(self, body: Body, colour: str, opacity: float) -> None:
        cloud = cloud_of(coal_geometry(body))
        if cloud is not None:
            self._add_cloud(cloud, body, colour, opacity)
            return
        mesh = self._mesh(coal_geometry(body)).transform(body.pose, inplace=False)
        self._plotter.add_mesh(mesh, color=colour, opacity=opacity, show_edges=False, specular=0.1)
        if opacity < 1.0 and body.box is not None:
            self._plotter.add_mesh(mesh.extract_feature_edges(30), color="#6b2d20", line_width=1.5)

    def _add_cloud(self, cloud: PointCloud, body: Body, colour: str, opacity: float) -> None:
        """Draw the balls of a cloud, or of some of its points where they are many."""
        points = cloud.points[:: len(cloud.points) // MOST_BALLS + 1]
        ball = self._pv.Sphere(radius=cloud.radius, theta_resolution=8, phi_resolution=8)
        balls = self._pv.PolyData(points).glyph(geom=ball, scale=False, orient=False)
        self._plotter.add_mesh(balls.transform(body.pose, inplace=False), color=colour, opacity=opacity)

    def _place_camera(self, setup: PlanningSetup, azimuth: float) -> None:
        """Point the camera at the middle of hands and scene; from the front, the left arm is on the right."""
        states = (setup.start, *setup.goals[:1])
        points = [setup.robot.link_pose(q, link)[:3, 3] for q in states for link in self._end_links()]
        points += [_middle(body) for body in setup.problem.scene if body.half_space is None]
        middle = np.mean([np.min(points, axis=0), np.max(points, axis=0)], axis=0)
        focus = np.array([0.5 * middle[0], 0.5 * middle[1], max(0.25, 0.7 * middle[2])])
        turn = np.radians(azimuth)
        offset = np.array([2.6 * np.cos(turn), 2.6 * np.sin(turn), 1.25])
        self._plotter.camera_position = [focus + offset, focus, (0.0, 0.0, 1.0)]
        self._plotter.camera.view_angle = 34.0

    def _end_links(self) -> list[str]:
        return [hand.palm for hand in self.robot.hands.values()] or [self.robot.link_names[-1]]

    def add_ghost(self, q: Array) -> None:
        """Add a translucent copy of robot and held objects at a state."""
        for (joint, placement, mesh, style), pose in zip(self._meshes, self._poses(q), strict=True):
            del joint, placement
            self._plotter.add_mesh(mesh.transform(pose, inplace=False), **{**style, "opacity": GHOST_OPACITY})

    def _poses(self, q: Array) -> list[Array]:
        pin.forwardKinematics(self.robot.model, self._data, self.robot.to_pinocchio(q))
        return [np.array((self._data.oMi[joint] * placement).homogeneous) for joint, placement, _, _ in self._meshes]

    def screenshot(self, q: Array) -> NDArray[np.uint8]:
        """Return an image of the scene with the robot at a state, shape (height, width, 3)."""
        for actor, pose in zip(self._actors, self._poses(q), strict=True):
            actor.user_matrix = pose
        self._plotter.render()
        return np.asarray(self._plotter.screenshot(None, return_img=True), dtype=np.uint8)


def _is_thin_plate(body: Body) -> bool:
    """Whether a body is a thin plate, which is drawn translucent to show what is behind it."""
    return body.box is not None and min(body.box) <= 0.25 * sorted(body.box)[1]


def _pyvista() -> Any:
    """Return the module ``pyvista``, set up for a machine without a display."""
    window = "vtkEGLRenderWindow" if find_library("EGL") else "vtkOSOpenGLRenderWindow"
    os.environ.setdefault("VTK_DEFAULT_OPENGL_WINDOW", window)
    try:
        import pyvista
    except ImportError as error:
        raise MissingFileError("pyvista", "package for pictures", "install the extra: apex-ompl[viz]") from error
    return pyvista


def _middle(body: Body) -> Array:
    """Return the middle of the box around a body in the world, shape (3,) [m]."""
    solid = Solid(body.name, 0, pin.SE3(body.pose), coal_geometry(body))
    return np.asarray(world_boxes([solid], [solid.placement])[0].mean(axis=0))
