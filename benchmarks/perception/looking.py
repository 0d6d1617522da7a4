"""Looks before alignments: errors of held objects after looking, tasks missed, number of looks, and time.

Tasks are ready-made problems with their obstacles. Starts are random free states around home. One camera stands 1 to
1.5 m from the hands, as in perception_held, with its errors of grasps (standard deviations of (8, 8, 3) mm and (4, 4,
10) degrees), of fingers (0.05), of the camera (2 mm, 0.2 degrees), of the scale of depths (0.3 %) and of depths; clutter
on the tables is not known. Nine frames are taken at the start. While the task's tolerance is smaller than two standard
deviations of both faces together, the robot goes to the first state that vect_align offers, three times at most, and
takes nine frames there. Motions are not planned here, but for "reached": the share of tasks with a look in which
APEX-MR, or another planner, finds a path to one of the states within 5 s each.

"missed" are tasks without an answer in the end, "off" those with an answer whose error is larger than the tolerance. Of
round bodies errors are those of what does not depend on their turn about their axis. "squared" is the mean of
normalized squared errors of fused poses over their 6 dimensions with its 95 % band by chi-squared, "within" the share
of objects within the 95 % ellipsoid. Times are CPU times of a call with the search for states, on one core.

Usage: python -m benchmarks.perception.looking [-n 75] [--tune]
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import cache
from typing import Any

import coal
import numpy as np
import pinocchio as pin

from apex_ompl import load_problem
from apex_ompl.collision import CollisionChecker
from apex_ompl.collision.shapes import coal_geometry
from apex_ompl.perception.alignment import AlignSettings, SeenTask, vect_align
from apex_ompl.perception.camera import look_at
from apex_ompl.perception.frames import Frame
from apex_ompl.perception.held import HeldObject
from apex_ompl.perception.rendering import DepthSensor, Part, Renderer
from apex_ompl.perception.surfaces import RobotSurface, geometry_surface
from apex_ompl.perception.synthetic import (
    GRASP_SHIFT,
    GRASP_TURN,
    HELD,
    LEAST_DISTANCE,
    LEAST_HEIGHT,
    LINK_SLICES,
    LINKS,
    SPREAD,
    SyntheticSettings,
    default_camera,
    random_error,
    solid_part,
)
from apex_ompl.problems.suite_robot import robot
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import AttachedObject
from apex_ompl.scene.problem import Problem
from apex_ompl.types import Array
from benchmarks.perception.held import squared_error

DEPENDS = (
    "apex_ompl/perception/looking.py", "apex_ompl/perception/visibility.py", "apex_ompl/perception/fusion.py",
    "apex_ompl/perception/alignment.py", "apex_ompl/perception/held.py", "apex_ompl/perception/registration.py",
    "apex_ompl/perception/frames.py", "apex_ompl/perception/rendering.py", "apex_ompl/perception/surfaces.py",
    "apex_ompl/perception/camera.py", "apex_ompl/kernel/compiled/perception", "apex_ompl/kernel/perception.py",
)  # fmt: skip
SEEDS = (21, 22)
TUNING_SEEDS = (2001, 2002)
PROBLEMS = ("stack_boxes", "ball_in_cup", "peg_in_hole", "pour", "handover")
FRAMES, LOOKS, DEVIATIONS = 9, 3, 2.0
CLUTTER, BACKGROUND = 4, 1  # labels
GRAY = (0.6, 0.6, 0.6)


@dataclass(frozen=True)
class Sample:
    """An object of a task, as it was known in the end.

    Attributes:
        task: Number of the task.
        problem: Name of the problem.
        kind: Shape of the object.
        looks: Number of looks after the first one.
        answered: Whether there was a task in the end.
        offered: Whether states were offered whenever they were asked for.
        reason: Why the object is not known, or empty.
        face: Error of the face's center, or of a ball's center [m].
        axis: Error of the axis [degrees], NaN for a ball.
        off: Whether the errors are larger than the task's tolerance.
        place_spread: Own standard deviation of the place in the worst direction [m].
        expected: That which the last look was expected to leave, NaN without one [m].
        squared: Normalized squared error.
        first_squared: That of the first look alone, NaN without an answer.
        spent: CPU time of the first call that sought states, NaN without one [s].
    """

    task: int
    problem: str
    kind: str
    looks: int
    answered: bool
    offered: bool
    reason: str
    face: float
    axis: float
    off: bool
    place_spread: float
    expected: float
    squared: float
    first_squared: float
    spent: float


@cache
def prepared(name: str) -> tuple[Problem, CollisionChecker]:
    """Return a problem and its checker."""
    problem = load_problem(name)
    return problem, CollisionChecker(robot(), problem.scene, problem.attached)


@cache
def link_surfaces() -> tuple[RobotSurface, list[Any]]:
    """Return the robot's surface, and those of its links to be drawn."""
    made = robot()
    items = made.geometry.geometryObjects
    return RobotSurface(made, LINK_SLICES), [geometry_surface(one.geometry, one.name, LINK_SLICES) for one in items]


class Stage:
    """A problem with its true grasps, camera, scale of depths, fingers and surroundings.

    Attributes:
        problem: The problem.
        checker: Its checker.
        grasps: True poses of the objects in the frames of their links, shape (4, 4) each [m].
        cameras: Cameras as they are reported.
        start: Start state, shape (dof,).
    """

    def __init__(self, name: str, rng: np.random.Generator, cameras: int = 1) -> None:
        """Draw what is not known."""
        settings = SyntheticSettings()
        self.problem, self.checker = prepared(name)
        self.robot = self.checker.robot
        self.grasps = [_slipped(one, rng) for one in self.problem.attached]
        self.start = self._start(rng)
        middle = np.mean([self.robot.link_pose(self.start, hand.palm)[:3, 3] for hand in self.robot.hands.values()], 0)
        self._true = [_camera_pose(rng, middle) for _ in range(cameras)]
        self.cameras = tuple(
            default_camera(settings)
            .placed(pose @ random_error(rng, settings.camera_shift, settings.camera_turn))
            .model_copy(update={"name": f"camera_{k}"})
            for k, pose in enumerate(self._true)
        )
        self._fingers = rng.normal(0.0, settings.synergy_spread, len(self.robot.hands))
        self._sensors = [DepthSensor(bias=rng.normal(0.0, settings.scale_spread)) for _ in range(cameras)]
        self._still = _surroundings(self.robot, self.problem, rng)

    def _start(self, rng: np.random.Generator) -> Array:
        made = self.robot
        while True:
            q = np.clip(made.home + rng.normal(0.0, SPREAD, made.dof), made.limits.lower, made.limits.upper)
            for k in self._synergies():
                q[k] = self.problem.start_state(made.joint_names)[k]
            a, b = (made.link_pose(q, hand.palm)[:3, 3] for hand in made.hands.values())
            apart = float(np.linalg.norm(a - b))
            if min(a[2], b[2]) > LEAST_HEIGHT and apart > LEAST_DISTANCE and self.checker.is_free(q):
                return q

    def _synergies(self) -> list[int]:
        return [self.robot.joint_names.index(str(hand.synergy)) for hand in self.robot.hands.values()]

    def frames(self, state: Array, renderer: Renderer, rng: np.random.Generator) -> list[Frame]:
        """Return frames of all cameras in a state, shape (dof,)."""
        true = state.copy()
        held = {one.link for one in self.problem.attached}
        for k, hand, off in zip(self._synergies(), self.robot.hands.values(), self._fingers, strict=True):
            if hand.palm in held:
                true[k] = np.clip(state[k] + off, 0.0, 1.0)
        surface, links = link_surfaces()
        items = self.robot.geometry.geometryObjects
        parts = [
            Part(own.at(pose), LINKS + k, GRAY, item.geometry, pose)
            for k, (item, own, pose) in enumerate(zip(items, links, surface.poses(true), strict=True))
        ]
        for k, pose in enumerate(self.poses(state)):
            parts.append(solid_part(coal_geometry(self.problem.attached[k]), pose, HELD + k, GRAY))
        joints = dict(zip(self.robot.joint_names, state.tolist(), strict=True))
        labels, found = [HELD + k for k in range(len(self.grasps))], []
        for camera, pose, sensor in zip(self.cameras, self._true, self._sensors, strict=True):
            view = renderer.draw([*parts, *self._still], camera, pose)
            depths = sensor.measure(view, camera, rng, labels, FRAMES)
            found += [Frame(camera, depth, joints=joints) for depth in depths]
        return found

    def poses(self, state: Array) -> list[Array]:
        """Return the true poses of the objects in the world in a state, shape (4, 4) each [m]."""
        pairs = zip(self.problem.attached, self.grasps, strict=True)
        return [self.robot.link_pose(state, one.link) @ grasp for one, grasp in pairs]


def _slipped(body: AttachedObject, rng: np.random.Generator) -> Array:
    """Return a pose of an object in its link with the errors of grasps."""
    grasp = body.pose.copy()
    grasp[:3, :3] = pin.rpy.rpyToMatrix(np.radians(rng.normal(0.0, GRASP_TURN))) @ grasp[:3, :3]
    grasp[:3, 3] += rng.normal(0.0, GRASP_SHIFT)
    return grasp


def _camera_pose(rng: np.random.Generator, middle: Array) -> Array:
    """Return the pose of a camera in front of the hands and above them, as scenes of perception_held have it."""
    azimuth, elevation = np.radians(rng.uniform(-60.0, 60.0)), np.radians(rng.uniform(5.0, 55.0))
    flat = np.cos(elevation) * np.array([np.cos(azimuth), np.sin(azimuth)])
    eye = middle + rng.uniform(1.0, 1.5) * np.array([*flat, np.sin(elevation)])
    return look_at(eye, middle + rng.normal(0.0, 0.05, 3), float(np.radians(rng.normal(0.0, 3.0))))


def _surroundings(made: Robot, problem: Problem, rng: np.random.Generator) -> list[Part]:
    """Return tables, obstacles, clutter on the tables, a wall and the floor."""
    bodies = (*made.fixtures, *problem.scene)
    parts = [solid_part(coal_geometry(one), one.pose, BACKGROUND, GRAY) for one in bodies]
    wall, floor = np.eye(4), np.eye(4)
    wall[:3, 3], floor[2, 3] = (-rng.uniform(0.6, 1.5), 0.0, 0.5), -0.7
    parts += [solid_part(coal.Box(0.02, 4.0, 3.0), wall, BACKGROUND, GRAY)]
    parts += [solid_part(coal.Box(4.0, 4.0, 0.02), floor, BACKGROUND, GRAY)]
    for _ in range(rng.integers(3, 9)):
        at = np.eye(4)
        at[:3, :3] = pin.exp3(rng.normal(size=3))
        at[:3, 3] = rng.uniform(-0.2, 0.8), rng.uniform(-0.9, 0.9), 0.05
        parts.append(solid_part(coal.Box(*rng.uniform(0.04, 0.2, 3)), at, CLUTTER, GRAY))
    return parts


def errors(one: HeldObject, true: Array) -> tuple[float, float]:
    """Return errors of the face's center [m] and of the axis [degrees], whatever a round body's turn about its axis.

    Args:
        one: The object.
        true: Its true pose, shape (4, 4) [m].
    """
    assert one.body.contact is not None
    point, axis = np.array(one.body.contact.point), np.array(one.body.contact.axis)
    if one.body.sphere is not None:
        return float(np.linalg.norm(one.pose[:3, 3] - true[:3, 3])), float("nan")
    turned = true.copy()
    if one.body.box is None and one.body.mesh is None or "cup" in str(one.body.mesh):
        x = one.pose[:3, 0] - (one.pose[:3, 0] @ true[:3, 2]) * true[:3, 2]
        x /= np.linalg.norm(x)
        turned[:3, :3] = np.stack([x, np.cross(true[:3, 2], x), true[:3, 2]], axis=1)
    face = turned[:3, :3] @ point + turned[:3, 3]
    cosine = float(np.clip(one.axis @ turned[:3, :3] @ axis, -1.0, 1.0))
    return float(np.linalg.norm(one.face - face)), float(np.degrees(np.arccos(cosine)))


def run_task(number: int, rng: np.random.Generator, renderer: Renderer, cameras: int = 1) -> list[Sample]:
    """Return the objects of a task after looking."""
    name = PROBLEMS[number % len(PROBLEMS)]
    stage = Stage(name, rng, cameras)
    frames, state, looks, spent, offered = list[Frame](), stage.start, 0, float("nan"), True
    settings = AlignSettings(obstacles=None, deviations=DEVIATIONS)
    expected: dict[str, float] = {}
    alignment = stage.problem.goal.alignment
    assert alignment is not None
    first: SeenTask | None = None
    while True:
        frames += stage.frames(state, renderer, rng)
        started = time.process_time()
        task = vect_align(frames, stage.robot, stage.problem.attached, alignment, settings, world=stage.checker)
        first = task if first is None else first
        if task:
            break
        spent = time.process_time() - started if np.isnan(spent) else spent
        if looks == LOOKS or not task.looks:
            offered = looks == LOOKS
            break
        look, looks = task.looks[0], looks + 1
        state = look.state
        expected |= {view.name: view.place_spread for view in look.objects}
    poses, before = stage.poses(state), stage.poses(stage.start)
    tolerance = alignment.tolerance
    found = []
    for k, one in enumerate(task.held):
        face, axis = errors(one, poses[k])
        ratio = squared_error(first.held[k].pose, first.held[k].covariance, before[k])
        found.append(
            Sample(
                number, name, _kind(one.body), looks, bool(task), offered, one.reason, face, axis, False,
                one.place_spread, expected.get(one.name, float("nan")),
                squared_error(one.pose, one.covariance, poses[k]), float("nan") if first.held[k].reason else ratio,
                spent,
            )
        )  # fmt: skip
    return found


def _kind(body: AttachedObject) -> str:
    return str(body.mesh.file).rsplit("/", 1)[-1].removesuffix(".obj") if body.mesh is not None else str(body.shape)
