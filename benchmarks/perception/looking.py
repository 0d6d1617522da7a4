"""Looks before alignments: errors of held objects after looking, tasks missed, number of looks, and time.

Tasks are ready-made problems with their obstacles. Starts are random free states around home. A camera stands 1 to
1.5 m from the hands. What is reported differs from the truth as in perception_held: grasps by standard deviations of
(8, 8, 3) mm and (4, 4, 10) degrees, closings of the fingers by 0.05, the camera by 2 mm and 0.2 degrees, the scale of
depth by 0.3 %, and depths; clutter on the tables is unknown to the search. Nine frames are taken at the start. While
two standard deviations of the faces together are larger than the tolerance of the task, a planner moves the robot to
the first state offered that it finds a path to (5 s each), three times at most, and nine frames are taken there.

"looked" are tasks with a look after the first one, "missed" those without an answer in the end, "off" those with an
answer whose errors are larger than the tolerance, "offer" the mean number of the state in the list that was reached
(1 is the first). Errors are those after all looks; of round bodies they do not depend on turns about their axes.
"squared" is the mean of normalized squared errors over their 6 dimensions with its 95 % band by chi-squared, "within"
the share of objects within the 95 % ellipsoid; "fused" are objects with answers in two looks or more, not those that
one look found. In brackets: each seed. Times are CPU times of a first call that seeks states, on one core.

Usage: python -m benchmarks.perception.looking [-n 150] [--mujoco 75] [--cameras 1] [--tune]
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import coal
import numpy as np
import pinocchio as pin
from tqdm import tqdm

from apex_ompl import MotionPlanner, load_problem
from apex_ompl.collision.shapes import coal_geometry
from apex_ompl.perception.alignment import AlignSettings, SeenTask, vect_align
from apex_ompl.perception.camera import look_at
from apex_ompl.perception.frames import Frame
from apex_ompl.perception.held import HeldObject
from apex_ompl.perception.looking import LookState
from apex_ompl.perception.rendering import DepthSensor, Mujoco, Part, Renderer, ZBuffer
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
from apex_ompl.scene.problem import ALIGNMENT_DEFAULTS, Problem
from apex_ompl.types import Array
from apex_ompl.util.entry_point import run_script
from benchmarks.lib import record
from benchmarks.perception.held import compact, squared_cells, squared_error, table

DEPENDS = (
    "apex_ompl/perception/looking.py", "apex_ompl/perception/visibility.py", "apex_ompl/perception/fusion.py",
    "apex_ompl/perception/alignment.py", "apex_ompl/perception/held.py", "apex_ompl/perception/held_fit.py",
    "apex_ompl/perception/held_pixels.py", "apex_ompl/perception/held_settings.py",
    "apex_ompl/perception/held_shapes.py", "apex_ompl/perception/registration.py", "apex_ompl/perception/frames.py",
    "apex_ompl/perception/rendering.py", "apex_ompl/perception/surfaces.py",
    "apex_ompl/perception/camera.py", "apex_ompl/kernel/compiled/perception", "apex_ompl/kernel/perception.py",
)  # fmt: skip
SEEDS = (21, 22)
TUNING_SEEDS = (2001, 2002)
PROBLEMS = ("stack_boxes", "ball_in_cup", "peg_in_hole", "pour", "handover")
FRAMES, LOOKS, DEVIATIONS = 9, 3, 2.0
PATIENCE = 5.0  # of a planner [s]
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
        offers: Numbers of the states in the lists that were reached, from 1 on; 0 where none was.
        answered: Whether there was a task in the end.
        reason: Why the object is not known, or empty.
        face: Error of the face's center, or of a ball's center [m].
        axis: Error of the axis [degrees], NaN for a ball.
        off: Whether the errors are larger than the task's tolerance.
        fused: Whether it was known before the last look, too.
        place_spread: Own standard deviation of the place in the worst direction [m].
        expected: That which the last look was expected to leave, NaN without one [m].
        squared: Normalized squared error.
        spent: CPU time of the first call that sought states, NaN without one [s].
    """

    task: int
    problem: str
    kind: str
    looks: int
    offers: tuple[int, ...]
    answered: bool
    reason: str
    face: float
    axis: float
    off: bool
    fused: bool
    place_spread: float
    expected: float
    squared: float
    spent: float


@cache
def prepared(name: str) -> tuple[Problem, MotionPlanner]:
    """Return a problem, and a planner in its world."""
    problem, planner = load_problem(name), MotionPlanner(robot())
    planner.world.load(problem)
    return problem, planner


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
        planner: A planner in its world.
        grasps: True poses of the objects in the frames of their links, shape (4, 4) each [m].
        cameras: Cameras as they are reported.
        start: Start state, shape (dof,).
    """

    def __init__(self, name: str, rng: np.random.Generator, cameras: int = 1) -> None:
        """Draw what is not known."""
        settings = SyntheticSettings()
        self.problem, self.planner = prepared(name)
        self.robot = self.planner.robot
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
            if min(a[2], b[2]) > LEAST_HEIGHT and apart > LEAST_DISTANCE and self.planner.world.checker.is_free(q):
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
    alignment = stage.problem.goal.alignment
    assert alignment is not None
    settings = AlignSettings(obstacles=None, deviations=DEVIATIONS)
    frames, state, offers, tasks, spent = list[Frame](), stage.start, list[int](), list[SeenTask](), float("nan")
    expected: dict[str, float] = {}
    while True:
        frames += stage.frames(state, renderer, rng)
        started = time.process_time()
        tasks.append(
            vect_align(frames, stage.robot, stage.problem.attached, alignment, settings, world=stage.planner.world)
        )
        if tasks[-1].looks and np.isnan(spent):
            spent = time.process_time() - started
        if tasks[-1] or len(offers) == LOOKS:
            break
        offers.append(_reached(stage.planner, state, tasks[-1].looks))
        if offers[-1] == 0:
            break
        look = tasks[-1].looks[offers[-1] - 1]
        state, expected = look.state, expected | {view.name: view.place_spread for view in look.objects}
    first, last = tasks[0], tasks[-1]
    tolerance = alignment.tolerance or ALIGNMENT_DEFAULTS[alignment.kind][1]
    found = []
    for k, (one, before) in enumerate(zip(last.held, first.held, strict=True)):
        true = stage.poses(state)[k]
        face, axis = errors(one, true)
        off = bool(face > min(tolerance.lateral, tolerance.axial) or np.radians(axis) > tolerance.angle)
        found.append(
            Sample(
                number, name, _kind(one.body), len(offers), tuple(offers), bool(last), one.reason, face, axis, off,
                not before.reason and len(tasks) > 1, one.place_spread, expected.get(one.name, float("nan")),
                squared_error(one.pose, one.covariance, true), spent,
            )
        )  # fmt: skip
    return found


def _reached(planner: MotionPlanner, state: Array, looks: Sequence[LookState]) -> int:
    """Return the number of the first state to which there is a path, from 1 on, or 0."""
    for k, look in enumerate(looks, 1):
        if planner.plan(state, look.state, timeout=PATIENCE):
            return k
    return 0


def _kind(body: AttachedObject) -> str:
    return str(body.mesh.file).rsplit("/", 1)[-1].removesuffix(".obj") if body.mesh is not None else str(body.shape)


def samples(renderer: Renderer, seed: int, n: int, cameras: int) -> list[Sample]:
    """Return the objects of ``n`` tasks."""
    numbers = tqdm(range(n), desc=f"{type(renderer).__name__} {seed}")
    return [one for k in numbers for one in run_task(k, np.random.default_rng((seed, k)), renderer, cameras)]


def _each(values: Sequence[float], total: float, form: str) -> str:
    """Return a number of all seeds, and in brackets those of each."""
    return f"{total:{form}} ({', '.join(f'{one:{form}}' for one in values)})"


def _p(found: Sequence[float], p: float) -> float:
    kept = np.array([one for one in found if np.isfinite(one)])
    return float(np.percentile(kept, p)) if len(kept) else float("nan")


def errors_row(label: str, drawn: dict[int, list[Sample]]) -> list[Any]:
    """Return the cells of a row of errors of all answers, by seed."""
    answered = {seed: [one for one in found if one.answered] for seed, found in drawn.items()}
    every = [one for found in answered.values() for one in found]
    cells: list[Any] = [label, len(every)]
    for name, p, factor in (("face", 50, 1e3), ("face", 95, 1e3), ("axis", 50, 1.0), ("axis", 95, 1.0)):
        parts = [factor * _p([getattr(one, name) for one in found], p) for found in answered.values()]
        cells.append(_each(parts, factor * _p([getattr(one, name) for one in every], p), ".1f"))
    return cells


def tasks_row(label: str, drawn: dict[int, list[Sample]]) -> list[Any]:
    """Return the cells of a row on tasks: how many needed a look, how many looks, how many were missed."""
    tasks = [one for found in drawn.values() for one in {sample.task: sample for sample in found}.values()]
    off = len({(seed, one.task) for seed, found in drawn.items() for one in found if one.answered and one.off})
    looked = [one for one in tasks if one.looks]
    offers = [number for one in looked for number in one.offers if number]
    counts = np.bincount([one.looks for one in tasks], minlength=LOOKS + 1)
    spent = [one.spent for one in looked]
    return [
        label, len(tasks), f"{len(looked) / len(tasks):.2f}", ", ".join(map(str, counts)),
        f"{np.mean(offers):.2f}" if offers else "", sum(not one.answered for one in tasks), off,
        f"{_p(spent, 50):.2f}", f"{_p(spent, 95):.2f}",
    ]  # fmt: skip


def squared_rows(found: Sequence[Sample], renderers: int) -> list[list[Any]]:
    """Return the rows of normalized squared errors by kind of object, of renderers that draw the same tasks."""
    rows = []
    for label, chosen in (("all", list(found)), ("fused", [one for one in found if one.fused])):
        for kind in (*sorted({one.kind for one in chosen}), "every kind"):
            squared = [s.squared for s in chosen if s.answered and kind in (s.kind, "every kind")]
            if squared:
                rows.append([label, kind, *squared_cells(squared, renderers)])
    return rows


HEAD = ("renderer", "objects", "face p50 mm", "face p95 mm", "axis p50 deg", "axis p95 deg")
TASKS = ("renderer", "tasks", "looked", "0, 1, 2, 3 looks", "offer", "missed", "off", "s p50", "s p95")
SQUARED = ("objects of", "kind", "objects", "squared", "band", "median", "within", "its band")
MISSED = ("renderer", "problem", "object", "looks", "reason")


def tables(drawn: dict[str, dict[int, list[Sample]]]) -> tuple[dict[str, Any], str]:
    """Return the results, and their tables, of the samples of each renderer and seed."""
    tasks = [tasks_row(name, by_seed) for name, by_seed in drawn.items()]
    rows = []
    for name, by_seed in drawn.items():
        looked = {seed: [one for one in found if one.looks] for seed, found in by_seed.items()}
        rows += [errors_row(name, by_seed), errors_row(f"{name}, tasks with a look", looked)]
    every = [one for by_seed in drawn.values() for found in by_seed.values() for one in found]
    squared = squared_rows(every, len(drawn))
    missed = [
        [name, one.problem, one.kind, one.looks, one.reason or f"{1e3 * one.place_spread:.1f} mm"]
        for name, by_seed in drawn.items() for found in by_seed.values() for one in found if not one.answered
    ]  # fmt: skip
    text = [table(TASKS, tasks), table(HEAD, rows), table(SQUARED, squared), table(MISSED, missed)]
    return {"tasks": tasks, "rows": rows, "squared": squared, "samples": compact(every)}, "\n\n".join(text)


def main() -> None:
    """Measure, and write the results."""
    parser = record.parser(__doc__ or "", 150, "tasks of a seed, drawn by the kernel")
    parser.add_argument("--mujoco", type=int, default=75, help="tasks of a seed, drawn by MuJoCo")
    parser.add_argument("--cameras", type=int, default=1, help="number of cameras")
    parser.add_argument("--tune", action="store_true", help="print errors on seeds that are not reported")
    given = parser.parse_args()
    if given.tune:
        drawn = {"ZBuffer": {seed: samples(ZBuffer(), seed, given.n, given.cameras) for seed in TUNING_SEEDS}}
        print(tables(drawn)[1])
        return
    drawn = {
        type(renderer).__name__: {seed: samples(renderer, seed, count, given.cameras) for seed in SEEDS}
        for renderer, count in ((ZBuffer(), given.n), (Mujoco(), given.mujoco))
        if count > 0
    }
    data, text = tables(drawn)
    name = "perception_looking" if given.cameras == 1 else f"perception_looking_{given.cameras}_cameras"
    record.write(name, data, text, n=given.n, seeds=list(SEEDS))


if __name__ == "__main__":
    run_script(main)
