"""Pictures and films of problems and results, without a display; needs the ``viz`` extra (PyVista, imageio)."""

from __future__ import annotations

import io
import os
from collections.abc import Sequence
from ctypes.util import find_library
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apex_ompl.errors import ParameterError
from apex_ompl.loop.result import RunResult
from apex_ompl.ompl.setup import PlanningSetup, assemble
from apex_ompl.paths.path import resample
from apex_ompl.planning.task_result import TaskResult
from apex_ompl.result import PlanResult
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.scene.problem import Problem
from apex_ompl.scene.scripts import is_there, obstacle_at
from apex_ompl.timing import Trajectory
from apex_ompl.types import Array
from apex_ompl.util.extras import import_extra
from apex_ompl.util.files import check_writable, write_atomically
from apex_ompl.util.validation import check_number
from apex_ompl.viz.appearance import (
    BACKGROUND,
    EDGE,
    HELD,
    OBSTACLES,
    SILENT_EVENTS,
    Item,
    focus_of,
    ghosts_of,
    items_of,
    joint_poses,
)
from apex_ompl.viz.sources import robot_of

SIZE = (1280, 960)
AZIMUTH = 26.0
CAPTION = "#222222"  # color of text
PICTURES, FILMS = (".png",), (".gif", ".mp4")
STRIP = (3, 2)  # columns and rows of the frames of a result's picture
FRAMES, MAX_FRAMES, FRAME_RATE = 72, 720, 24  # frames of an untimed path, and of a timed one at most; [1/s]


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
        self._objects: dict[str, Array | None] = {}  # poses in the world of held objects that are shown elsewhere
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
        """Add an item at a pose, and return its actor; edges outline obstacles that are nearly transparent."""
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

    def show_object(self, name: str, pose: Array | None) -> None:
        """Show an object that is held at some time at a pose in the world, shape (4, 4), or hide it."""
        if any(held.name == name for held in self._setup.problem.attached):
            self._objects[name] = pose
        else:
            self.show_obstacle(name, pose)

    def _poses(self, q: Array) -> list[Array | None]:
        joints, found = joint_poses(self.robot, self._data, q), list[Array | None]()
        for item in self._moving:
            moved = item.layer == HELD and item.name in self._objects
            found.append(self._objects[item.name] if moved else joints[item.joint] @ item.placement)
        return found

    def screenshot(self, q: Array, caption: str = "") -> NDArray[np.uint8]:
        """Return an image of the scene with the robot at a state, shape (height, width, 3), and a line of text."""
        for actor, pose in zip(self._actors, self._poses(q), strict=True):
            actor.visibility = pose is not None
            if pose is not None:
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
    return import_extra("pyvista", "pictures", "viz")


def render(
    source: Problem | PlanResult | RunResult,
    out: str | os.PathLike[str],
    size: tuple[int, int] = SIZE,
    azimuth: float = AZIMUTH,
) -> None:
    """Draw a problem, a plan or a run.

    The .png of a problem shows the start, and a goal as a ghost. The .png of a result shows states along its path in
    reading order. A .gif or .mp4 shows the motion of a result; a timed motion in real time, up to 30 s. Dynamic
    obstacles that the motion was proved among in time move, and all those of a run, whose pictures show the time and
    the last event.

    Args:
        source: A problem, a plan that has a path, or a run.
        out: Where to write: .png, .gif or .mp4.
        size: Width and height [pixels].
        azimuth: Direction of the camera from the front of the robot, counter-clockwise [degrees].

    Raises:
        ParameterError: Another suffix, a film of a source without a path, or a direction that is no number.
        MissingFileError: The folder cannot be written, or the ``viz`` extra is not installed.
    """
    out = Path(out)
    if out.suffix not in PICTURES + FILMS:
        raise ParameterError("output", str(out), f"a file name ending in {', '.join(PICTURES + FILMS)}")
    check_writable(out)
    check_number(azimuth, "azimuth")
    if isinstance(source, Problem):
        content = _problem_picture(source, out, size, azimuth)
    elif isinstance(source, PlanResult) and (source.path is None or source.problem is None):
        raise ParameterError("result", source.status.value, "a result with a path and its problem")
    elif out.suffix in FILMS:
        content = _film(source, out.suffix, size, azimuth)
    else:
        content = _strip(source, size, azimuth)
    write_atomically(out, content)


def _problem_picture(problem: Problem, out: Path, size: tuple[int, int], azimuth: float) -> bytes:
    """Return a .png of the start, with the first goal as a ghost."""
    if out.suffix in FILMS:
        raise ParameterError("output", str(out), "a .png for a problem; films are of results")
    setup = assemble(problem)
    renderer = SceneRenderer(setup, size, azimuth)
    if len(setup.goals):
        renderer.add_ghost(setup.goals[0])
    return encode([renderer.screenshot(setup.start)], ".png")


def _film(source: PlanResult | RunResult, suffix: str, size: tuple[int, int], azimuth: float) -> bytes:
    """Return a film of the motion, or of the path at an even pace when there are no times; the last frame is held."""
    renderer, motion = _renderer(source, (3 * size[0] // 4, 3 * size[1] // 4), azimuth), source.trajectory
    if motion is None:
        frames = [renderer.screenshot(q) for q in resample(_path(source), FRAMES)]
    else:
        sample = motion.sample(max(1.0 / FRAME_RATE, motion.duration / MAX_FRAMES))
        frames = [_moment(renderer, source, motion, float(t)) for t in np.atleast_1d(sample.time)]
    return encode([*frames, *[frames[-1]] * (FRAME_RATE // 2)], suffix)


def _strip(source: PlanResult | RunResult, size: tuple[int, int], azimuth: float) -> bytes:
    """Return a .png of states along the path, or of moments among dynamic obstacles, in reading order."""
    renderer, motion = _renderer(source, (size[0] // 2, size[1] // 2), azimuth), source.trajectory
    columns, rows = STRIP
    if motion is not None and (_dynamic(source) or isinstance(source, RunResult | TaskResult)):
        times = np.linspace(0.0, motion.duration, columns * rows)
        frames = [_moment(renderer, source, motion, float(t)) for t in times]
    else:
        frames = [renderer.screenshot(q) for q in resample(_path(source), columns * rows)]
    grid = [np.concatenate(frames[k * columns : (k + 1) * columns], axis=1) for k in range(rows)]
    return encode([np.concatenate(grid, axis=0)], ".png")


def _renderer(source: PlanResult | RunResult, size: tuple[int, int], azimuth: float) -> SceneRenderer:
    return SceneRenderer(assemble(source.problem, robot_of(source)), size, azimuth)


def _path(source: PlanResult | RunResult) -> Array:
    """Return the states of the path of a plan that has one."""
    assert isinstance(source, PlanResult) and source.path is not None
    return source.path.states


def _dynamic(source: PlanResult | RunResult) -> list[Obstacle]:
    """Return the dynamic obstacles: those of a run, and those that a plan was proved among in time."""
    names = source.problem.moving if isinstance(source, RunResult) else source.dynamic_obstacles
    return [obstacle for obstacle in source.problem.scene if obstacle.name in names]


def _moment(
    renderer: SceneRenderer, source: PlanResult | RunResult, motion: Trajectory, time: float
) -> NDArray[np.uint8]:
    """Return an image of a motion at a time [s], with the dynamic obstacles at their positions then."""
    for obstacle in _dynamic(source):
        pose = obstacle_at(obstacle, time).pose if is_there(obstacle, time) else None
        renderer.show_obstacle(obstacle.name, pose)
    if isinstance(source, TaskResult):
        for name, pose in source.object_poses(renderer.robot, time).items():
            renderer.show_object(name, pose)
    return renderer.screenshot(motion(time), caption(source, time) if isinstance(source, RunResult) else "")


def caption(run: RunResult, time: float) -> str:
    """Return a line on a run at a time [s]: the time, and the last event by then that is shown."""
    last = [event for event in run.events if event.time <= time and event.kind not in SILENT_EVENTS]
    return f"{time:.2f} s" + (f"   {last[-1].kind} at {last[-1].time:.2f} s" if last else "")


def encode(frames: Sequence[NDArray[np.uint8]], suffix: str, rate: float = FRAME_RATE) -> bytes:
    """Return frames, each of shape (height, width, 3), as the content of a file; a .gif has half the size.

    Args:
        frames: The frames; of a .png the first one counts.
        suffix: .png, .gif or .mp4.
        rate: Frames in a second.

    Raises:
        MissingFileError: The extra ``viz`` is not installed.
    """
    iio = import_extra("imageio.v3", "pictures and films", "viz")
    buffer = io.BytesIO()
    if suffix == ".png":
        iio.imwrite(buffer, frames[0], extension=".png")
    elif suffix == ".gif":
        small = [frame[::2, ::2] for frame in frames]
        iio.imwrite(buffer, small, extension=".gif", duration=1000 / rate, loop=0)
    else:
        return bytes(iio.imwrite("<bytes>", np.stack(frames), extension=".mp4", fps=rate, codec="libx264"))
    return buffer.getvalue()
