"""Pictures and films of problems and results, without a display, with the robot's own visual meshes.

Needs the ``viz`` extra (PyVista, imageio). Obstacles are drawn in red, fixtures in wood, held objects in colours of
their own, contact faces of an alignment as arrows along their outward axes.
"""

from __future__ import annotations

import io
import os
from collections.abc import Sequence
from ctypes.util import find_library
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from apex_ompl.collision.shapes import coal_geometry, is_shell
from apex_ompl.errors import MissingFileError, ParameterError
from apex_ompl.ompl_adapter.setup import PlanningSetup, assemble
from apex_ompl.result import PlanResult
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import Body
from apex_ompl.scene.meshes import triangles
from apex_ompl.scene.problem import Problem
from apex_ompl.tasks.link_faces import LinkFace
from apex_ompl.trajopt.path import resample
from apex_ompl.types import Array
from apex_ompl.util.files import check_writable, write_atomically

PICTURES, FILMS = (".png",), (".gif", ".mp4")
SIZE = (1280, 960)
AZIMUTH = 26.0
STRIP = (3, 2)  # columns and rows of the frames of a result's picture
FRAMES, MOST_FRAMES, FRAME_RATE = 72, 720, 24
GHOST = 0.3  # opacity of the goal in a problem's picture
HELD_COLOURS = ("#2a9d8f", "#e9a03b", "#8e6bbf", "#4c78a8")
OBSTACLE, FIXTURE, BACKGROUND = "#c8553d", "#c9a77c", "#f4f4f1"
SIDE_COLOURS = {"left": "#e8eef4", "right": "#f3ece2"}
ARROWS = ("#d62728", "#1f4ed8")
HALF_SPACE_EDGE = 3.0  # how far of a half-space is drawn [m]


def render(
    source: Problem | PlanResult,
    out: str | os.PathLike[str],
    size: tuple[int, int] = SIZE,
    azimuth: float = AZIMUTH,
) -> None:
    """Draw a problem or a result.

    A problem's .png shows the start, and a goal as a ghost; a result's .png shows frames along its path in reading
    order; .gif and .mp4 show the motion of a result as a film, in its own time when it is timed, at most 30 s long.

    Args:
        source: A problem, or a result that has a path.
        out: Where to write: .png, .gif or .mp4.
        size: Width and height [pixels].
        azimuth: Where to look from, counted from the front of the robot counter-clockwise [degrees].

    Raises:
        ParameterError: Another suffix, or a film of something without a path.
        MissingFileError: The folder cannot be written, or the ``viz`` extra is not installed.
    """
    out = Path(out)
    if out.suffix not in PICTURES + FILMS:
        raise ParameterError("output", str(out), f"a file name ending in {', '.join(PICTURES + FILMS)}")
    check_writable(out)
    if isinstance(source, Problem):
        if out.suffix in FILMS:
            raise ParameterError("output", str(out), "a .png for a problem; films are of results")
        ready = assemble(source)
        stage = Stage(ready, size, azimuth)
        if len(ready.goals):
            stage.add_ghost(ready.goals[0])
        write_atomically(out, _encode([stage.shoot(ready.start)], ".png"))
        return
    if source.path is None or source.problem is None:
        raise ParameterError("result", source.status.value, "a result with a path and its problem")
    shot = (3 * size[0] // 4, 3 * size[1] // 4) if out.suffix in FILMS else (size[0] // 2, size[1] // 2)
    stage = Stage(assemble(source.problem), shot, azimuth)
    if out.suffix in FILMS:
        motion = source.trajectory
        each = 0.0 if motion is None else max(1.0 / FRAME_RATE, motion.duration / MOST_FRAMES)
        states = resample(source.path, FRAMES) if motion is None else motion.sample(each).position
        frames = [stage.shoot(q) for q in states]
        pause = [frames[-1]] * (FRAME_RATE // 2)
        write_atomically(out, _encode([*frames, *pause], out.suffix))
        return
    columns, rows = STRIP
    shots = [stage.shoot(q) for q in resample(source.path, columns * rows)]
    grid = [np.concatenate(shots[k * columns : (k + 1) * columns], axis=1) for k in range(rows)]
    write_atomically(out, _encode([np.concatenate(grid, axis=0)], ".png"))


class Stage:
    """A scene with a robot that can be posed and photographed."""

    def __init__(self, ready: PlanningSetup, size: tuple[int, int] = SIZE, azimuth: float = AZIMUTH) -> None:
        """Set robot, fixtures, obstacles, held objects and camera up.

        Raises:
            MissingFileError: The ``viz`` extra is not installed.
        """
        self._pv = _pyvista()
        self.robot: Robot = ready.robot
        self._data = self.robot.model.createData()
        self._plotter = self._pv.Plotter(off_screen=True, window_size=size, lighting="three lights")
        self._plotter.set_background(BACKGROUND)
        self._parts = self._robot_parts(ready)
        self._actors = [self._plotter.add_mesh(mesh, **look) for _, _, mesh, look in self._parts]
        for body in self.robot.fixtures:
            self._add_body(body, FIXTURE, 1.0)
        for body in ready.problem.scene:
            self._add_body(body, OBSTACLE, 0.14 if _is_board(body) else 0.9)
        self._aim(ready, azimuth)

    def _robot_parts(self, ready: PlanningSetup) -> list[tuple[int, Any, Any, dict[str, Any]]]:
        """Return (parent joint, placement, mesh, look) of links, held objects and contact faces."""
        robot, parts = self.robot, []
        visuals = pin.buildGeomFromUrdfString(robot.model, robot.urdf, pin.GeometryType.VISUAL)
        for item in visuals.geometryObjects:
            side = item.name.split("_", 1)[0]
            hand = "hand" in item.name or "gripper" in item.name
            colour = "#4a4e57" if hand else SIDE_COLOURS.get(side, "#d9dce1")
            look = {"color": colour, "smooth_shading": False, "specular": 0.15}
            parts.append((item.parentJoint, item.placement, self._mesh(item.geometry), look))
        for k, held in enumerate(ready.problem.attached):
            frame = robot.model.frames[robot.link_frame(held.link)]
            look = {"color": HELD_COLOURS[k % len(HELD_COLOURS)], "specular": 0.2}
            placement = frame.placement * pin.SE3(held.pose)
            parts.append((frame.parentJoint, placement, self._mesh(coal_geometry(held)), look))
        faces: list[LinkFace] = []
        if ready.alignment is not None:
            faces = [ready.alignment.first, ready.alignment.second]
        for face, colour in zip(faces, ARROWS, strict=False):
            frame = robot.model.frames[robot.link_frame(face.link)]
            arrow = self._pv.Arrow(
                start=face.point, direction=face.axis, scale=0.12, shaft_radius=0.035, tip_radius=0.09, tip_length=0.3
            )
            parts.append((frame.parentJoint, frame.placement, arrow, {"color": colour}))
        return parts

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
        mesh = self._mesh(coal_geometry(body)).transform(body.pose, inplace=False)
        self._plotter.add_mesh(mesh, color=colour, opacity=opacity, show_edges=False, specular=0.1)
        if opacity < 1.0 and body.box is not None:
            self._plotter.add_mesh(mesh.extract_feature_edges(30), color="#6b2d20", line_width=1.5)

    def _aim(self, ready: PlanningSetup, azimuth: float) -> None:
        """Look at the middle of arms and scene; from the front, the left arm is on the right of the picture."""
        states = (ready.start, *ready.goals[:1])
        points = [ready.robot.link_pose(q, link)[:3, 3] for q in states for link in self._ends()]
        points += [np.asarray(b.position, float) for b in ready.problem.scene if b.half_space is None]
        middle = np.mean([np.min(points, axis=0), np.max(points, axis=0)], axis=0)
        focus = np.array([0.5 * middle[0], 0.5 * middle[1], max(0.25, 0.7 * middle[2])])
        turn = np.radians(azimuth)
        offset = np.array([2.6 * np.cos(turn), 2.6 * np.sin(turn), 1.25])
        self._plotter.camera_position = [focus + offset, focus, (0.0, 0.0, 1.0)]
        self._plotter.camera.view_angle = 34.0

    def _ends(self) -> list[str]:
        return [hand.palm for hand in self.robot.hands.values()] or [self.robot.link_names[-1]]

    def add_ghost(self, q: Array) -> None:
        """Draw robot and held objects once more, translucent, at a state."""
        for (joint, placement, mesh, look), pose in zip(self._parts, self._poses(q), strict=True):
            del joint, placement
            self._plotter.add_mesh(mesh.transform(pose, inplace=False), **{**look, "opacity": GHOST})

    def _poses(self, q: Array) -> list[Array]:
        pin.forwardKinematics(self.robot.model, self._data, self.robot.to_pinocchio(q))
        return [np.array((self._data.oMi[joint] * placement).homogeneous) for joint, placement, _, _ in self._parts]

    def shoot(self, q: Array) -> NDArray[np.uint8]:
        """Return a photograph of the scene with the robot at a state, shape (height, width, 3)."""
        for actor, pose in zip(self._actors, self._poses(q), strict=True):
            actor.user_matrix = pose
        self._plotter.render()
        return np.asarray(self._plotter.screenshot(None, return_img=True), dtype=np.uint8)


def _is_board(body: Body) -> bool:
    """Whether a body is a thin plate, drawn translucent so that one sees what is behind it."""
    return body.box is not None and min(body.box) <= 0.25 * sorted(body.box)[1]


def _pyvista() -> Any:
    window = "vtkEGLRenderWindow" if find_library("EGL") else "vtkOSOpenGLRenderWindow"
    os.environ.setdefault("VTK_DEFAULT_OPENGL_WINDOW", window)
    try:
        import pyvista
    except ImportError as error:
        raise MissingFileError("pyvista", "package for pictures", "install the extra: apex-ompl[viz]") from error
    return pyvista


def _encode(frames: Sequence[NDArray[np.uint8]], suffix: str) -> bytes:
    import imageio.v3 as iio

    buffer = io.BytesIO()
    if suffix == ".png":
        iio.imwrite(buffer, frames[0], extension=".png")
    elif suffix == ".gif":
        small = [frame[::2, ::2] for frame in frames]
        iio.imwrite(buffer, small, extension=".gif", duration=1000 / FRAME_RATE, loop=0)
    else:
        return bytes(iio.imwrite("<bytes>", np.stack(frames), extension=".mp4", fps=FRAME_RATE, codec="libx264"))
    return buffer.getvalue()
