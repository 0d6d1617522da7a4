"""Tasks in physics from what cameras see: where objects are in the hands, and obstacles, are seen and not told.

Hands hold the objects off from where the problem has them, and red cubes stand in the way. Once the hands have closed,
cameras whose poses and depths are off by their spreads look, ``vect_align`` makes the task, and it is planned, executed
and judged. With ``told`` it is planned for what is true instead, to compare with.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pinocchio as pin

from apex_ompl.collision import CollisionChecker
from apex_ompl.drivers.grasps import in_link
from apex_ompl.drivers.mujoco import MujocoDriver
from apex_ompl.drivers.twin import COLORS
from apex_ompl.drivers.vessels import liquid
from apex_ompl.errors import ParameterError
from apex_ompl.perception.alignment import AlignSettings, SeenTask, vect_align
from apex_ompl.perception.camera import Camera
from apex_ompl.perception.frames import Frame
from apex_ompl.perception.held_settings import HeldSettings
from apex_ompl.perception.obstacle_settings import ObstacleSettings
from apex_ompl.perception.rig import RED, check_cameras, default_cameras, misplaced, noisy, repeated
from apex_ompl.perception.twin_camera import TwinCamera
from apex_ompl.physics.execution import Executor
from apex_ompl.physics.judges import Check
from apex_ompl.physics.meeting import can_meet
from apex_ompl.physics.result import FAILED, UNSEEN, TaskRun
from apex_ompl.physics.runner import TIMEOUT, TaskRunner, unplanned
from apex_ompl.physics.trials import Spread, Trial, draw
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import AttachedObject, Obstacle, pose_fields
from apex_ompl.scene.problem import Goal, Problem
from apex_ompl.util.validation import check_integer, check_number

DEVIATIONS = 2.0  # of faces that have to be within the tolerance
YIELD = 0.03  # by which fingers that yield may be off [m]
LOOKS = 3  # from other states, at most
FRAMES, PERIOD = 9, 0.1  # of a look, and time between two of them [s]
CUBE = 0.06, 0.14  # edges of drawn cubes [m]
LOW, HIGH = (0.25, -0.4, 0.12), (0.75, 0.4, 0.8)  # corners of the space of their centers [m]
CLEAR = 0.04  # of the start from a drawn cube [m]
TRIES = 200  # of a cube, and of objects in hands
APART = 0.005  # of objects from what they may not touch at the start [m]
SHRINKS = (1.0, 0.5, 0.0)  # shares of the margin with which a seen obstacle may be clear of the robot at the start


@dataclass(frozen=True)
class GraspSpread:
    """How far objects in hands are from where the problem has them, drawn by a normal distribution.

    Attributes:
        shift: Standard deviations along the axes of the link that holds them [m]; along z they are off from the palm.
        turn: Standard deviations about them [degrees].
        most: Largest error of each, in standard deviations.
    """

    shift: tuple[float, float, float] = (0.008, 0.008, 0.003)
    turn: tuple[float, float, float] = (4.0, 4.0, 10.0)
    most: float = 2.0

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ParameterError: A number is out of its range.
        """
        for value in self.shift:
            check_number(value, "shift", 0.0, 0.05)
        for value in self.turn:
            check_number(value, "turn", 0.0, 45.0)
        check_number(self.most, "most", 0.0, 5.0)


@dataclass(frozen=True, eq=False)
class Scene:
    """A problem with what is seen in it and not told.

    Attributes:
        trial: The start; ``known`` has the objects where the problem has them, and what is furniture.
        hidden: Obstacles that are seen and not told.
    """

    trial: Trial
    hidden: tuple[Obstacle, ...]


@dataclass(eq=False)
class CameraRunner:
    """Executes a problem in physics from what cameras see.

    Attributes:
        problem: The problem; its obstacles stand still.
        cameras: The cameras, as they are reported; by default two, before the robot and above.
        cubes: Number of red cubes that are drawn by the seed.
        spread: How far joints, masses and friction are from the problem; objects are by ``grasps``.
        grasps: How far objects in hands are from where the problem has them.
        settings: How an alignment is looked for.
        frames: Number of frames of a look.
        timeout: Of each plan [s].
        friction: Names of the objects that friction holds; by default those of a rehearsal.
    """

    problem: Problem
    cameras: Sequence[Camera] = field(default_factory=default_cameras)
    cubes: int = 0
    spread: Spread = field(default_factory=lambda: Spread(place=0.0))
    grasps: GraspSpread = field(default_factory=GraspSpread)
    settings: AlignSettings = field(
        default_factory=lambda: AlignSettings(held=HeldSettings(thickness=YIELD), deviations=DEVIATIONS)
    )
    frames: int = FRAMES
    timeout: float = TIMEOUT
    friction: Collection[str] | None = None

    def __post_init__(self) -> None:
        """Load the robot.

        Raises:
            ApexError: There is no camera, its link is unknown, there is nothing that a camera finds, or as
                :class:`apex_ompl.physics.TaskRunner`.
        """
        self.cameras = check_cameras(self.cameras)
        check_integer(self.cubes, "cubes", 0)
        check_integer(self.frames, "frames", 1)
        self.runner = TaskRunner(self.problem, self.spread, timeout=self.timeout, friction=self.friction)
        self.robot = self.runner.robot
        for camera in self.cameras:
            if camera.link is not None:
                self.robot.link_frame(camera.link)
        looked = self.settings.obstacles or ObstacleSettings()
        self.hidden = tuple(one for one in self.problem.scene if is_findable(one, looked))
        if not self.problem.attached and not self.hidden and not self.cubes:
            raise ParameterError(
                "problem", self.problem.name, "held objects or obstacles that cameras can find, or cubes"
            )

    def run(
        self, seed: int | None = None, film: tuple[int, int] | None = None, *, told: bool = False
    ) -> tuple[TaskRun, list[Any]]:
        """Execute the task once.

        Args:
            seed: Seed of the start, of the grasps, and of the errors of cameras; by default the start is that of the
                problem, and other errors are those of seed 0.
            film: Width and height of a film [pixels].
            told: Whether poses of objects and obstacles are told as they are, in place of being seen.

        Returns:
            What happened, and the frames of the film.

        Raises:
            MissingFileError: There is no OpenGL, or the extra ``perception`` is not installed.
            ApexError: The problem is faulty, or the seed is negative.
        """
        scene = self.drawn(seed)
        trial = scene.trial
        executor = Executor(
            self.robot, trial, friction=self.runner.held_by_friction(), settings=self.runner.settings, seed=seed,
            film=film,
        )  # fmt: skip
        color(executor.driver, {one.name: COLORS["fixture"] for one in trial.known.scene})
        color(executor.driver, {one.name: RED for one in scene.hidden})
        executor.grasp()
        if told:
            known, place = told_problem(executor.driver, trial, scene.hidden), self.runner.spread.place
            found: dict[str, float] = {}
        else:
            task, trial = self.look(executor, trial, seed or 0)
            executor.trial = trial
            if not task:
                return unplanned(self.problem, seed, "; ".join(task.reasons), UNSEEN), executor.frames
            found = errors_of(executor.driver, task, scene.hidden)
            known, place = self.seen_problem(task, trial.known), _most_off(task, self.settings.margin)
        plan = self.runner.plan(known, seed or 0, place)
        if not plan or plan.trajectory is None:
            return unplanned(self.problem, seed, f"{plan.status}: {plan.reason}"), executor.frames
        executor.trial = replace(trial, known=known)
        run = executor.run(plan)
        run = replace(run, metrics={**run.metrics, **found})
        return _with_contacts(run, executor.driver, {one.name for one in scene.hidden}), executor.frames

    def drawn(self, seed: int | None) -> Scene:
        """Return the start of a seed, with objects off in the hands, and cubes."""
        trial = draw(self.robot, self.problem, seed, self.spread, self.runner.settings.density)
        rng = np.random.default_rng((seed or 0, 1))
        cubes = [_cube(self.robot, trial.known, rng, f"cube_{k + 1}") for k in range(self.cubes)]
        real = self._held(trial.real, trial.known, rng)
        names = {one.name for one in self.hidden}
        known = trial.known.model_copy(
            update={"scene": tuple(one for one in trial.known.scene if one.name not in names)}
        )
        true = trial.real.model_copy(update={"scene": (*trial.real.scene, *cubes), "attached": real})
        return Scene(replace(trial, known=known, real=true), (*self.hidden, *cubes))

    def _held(self, real: Problem, known: Problem, rng: np.random.Generator) -> tuple[AttachedObject, ...]:
        """Return objects that are off in the hands, clear of the scene and of links that may not touch them.

        The hands leave room for what lines bring onto the objects that they hold (:mod:`apex_ompl.physics.meeting`).

        Where there are none in some tries, they are where the problem has them.
        """
        start, names = known.start_state(self.robot.joint_names), {held.name for held in known.attached}
        solid = tuple(held for held in real.attached if held.name in names)  # liquids apart
        least = min(0.5 * CollisionChecker(self.robot, real.scene, solid, real.allowed).clearance(start), APART)
        for _ in range(TRIES):
            found = tuple(
                held if held.links is not None or held.touch_links == () else off_in_hand(held, rng, self.grasps)
                for held in solid
            )
            clear = CollisionChecker(self.robot, real.scene, found, real.allowed).clearance(start) > least
            if clear and can_meet(self.robot, start, found, known.after):
                return (*found, *liquid(real.model_copy(update={"attached": found})))
        return real.attached

    def look(self, executor: Executor, trial: Trial, seed: int) -> tuple[SeenTask, Trial]:
        """Return what cameras see, and the trial whose start is the state from which the robot looked last.

        Where something is not known well enough, the robot moves to states from which cameras see it, while there are
        any, and looks again: ``LOOKS`` times at most.

        Args:
            executor: The robot, at rest.
            trial: The start.
            seed: Seed of the errors of cameras and of plans.
        """
        rngs = [np.random.default_rng((seed, 2 + k)) for k in range(len(self.cameras))]
        true = [misplaced(camera, rng) for camera, rng in zip(self.cameras, rngs, strict=True)]
        eyes = [TwinCamera(executor.driver, a, reported=b) for a, b in zip(true, self.cameras, strict=True)]
        frames: list[Frame] = []
        try:
            for count in range(1 + LOOKS):
                executor.wait((self.frames - 1) * PERIOD)
                for eye, rng in zip(eyes, rngs, strict=True):
                    frames += repeated(eye.frame(), self.frames, noisy(eye.camera, rng), PERIOD)
                known = trial.known
                task = vect_align(
                    frames, self.robot, known.attached, known.goal.alignment, self.settings, world=known.scene,
                    constraints=known.constraints,
                )  # fmt: skip
                moved = None if task or count == LOOKS else self._moved(executor, trial, task, seed)
                if moved is None:
                    break
                trial = moved
        finally:
            for eye in eyes:
                eye.close()
        return task, trial

    def _moved(self, executor: Executor, trial: Trial, task: SeenTask, seed: int) -> Trial | None:
        """Move to a state from which cameras see what is missing, and return the trial that starts there, or None."""
        known = self.seen_problem(task, trial.known)
        for k, look in enumerate(task.looks):
            end = dict(zip(self.robot.joint_names, look.state.tolist(), strict=True))
            there = known.model_copy(update={"goal": Goal(joints=(end,)), "after": ()})
            plan = self.runner.plan(there, seed + k, 0.0)
            if plan and plan.trajectory is not None:
                executor.move(f"look by {look.camera}", plan.trajectory)
                q = executor.driver.commanded()
                start = dict(zip(self.robot.joint_names, q.tolist(), strict=True))
                return replace(trial, known=trial.known.model_copy(update={"start": start}))
        return None

    def seen_problem(self, task: SeenTask, known: Problem) -> Problem:
        """Return the problem with objects and obstacles as they were seen.

        The margin of an obstacle that would touch the robot at the start is smaller.
        """
        start = known.start_state(self.robot.joint_names)
        margins = [share * self.settings.margin for share in SHRINKS]
        names = {body.name for body in (*known.scene, *task.attached)}
        obstacles = []
        for k, one in enumerate(task.seen):
            name = next(n for n in (f"seen_{k + 1}", f"seen_obstacle_{k + 1}") if n not in names)
            grown = [one.obstacle(name, margin) for margin in margins]
            free = (o for o in grown if CollisionChecker(self.robot, [o], task.attached, known.allowed).is_free(start))
            obstacles.append(next(free, grown[-1]))
        return known.model_copy(update={"scene": (*known.scene, *obstacles), "attached": task.attached})


def is_findable(body: Obstacle, settings: ObstacleSettings) -> bool:
    """Whether cameras find an obstacle: a box or a cylinder of a size that is looked for."""
    if body.box is not None:
        lengths: tuple[float, ...] = body.box
    elif body.cylinder is not None:
        lengths = (2.0 * body.cylinder.radius, body.cylinder.length)
    else:
        return False
    return min(lengths) > settings.smallest and max(lengths) < settings.largest


def off_in_hand(held: AttachedObject, rng: np.random.Generator, spread: GraspSpread) -> AttachedObject:
    """Return an object that is off in its hand, along z away from the palm."""
    shift, turn = np.array(spread.shift), np.radians(spread.turn)
    draws = rng.standard_normal(6).clip(-spread.most, spread.most)
    off = shift * draws[:3]
    off[2] = abs(off[2]) * np.sign(held.position[2] or 1.0)
    pose = held.pose.copy()
    pose[:3, :3] = pin.rpy.rpyToMatrix(turn * draws[3:]) @ pose[:3, :3]
    pose[:3, 3] += off
    return held.model_copy(update=pose_fields(pose))


def _cube(robot: Robot, known: Problem, rng: np.random.Generator, name: str) -> Obstacle:
    """Return an upright red cube that is clear of the robot at the start, and of the scene.

    Raises:
        ParameterError: There is no room for one.
    """
    start = known.start_state(robot.joint_names)
    for _ in range(TRIES):
        edge, yaw = rng.uniform(*CUBE), rng.uniform(0.0, np.pi / 2.0)
        place = rng.uniform(LOW, HIGH)
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = pin.utils.rotate("z", yaw), place
        wide = Obstacle.model_validate({"name": name, "box": (edge + 2.0 * CLEAR,) * 3, **pose_fields(pose)})
        if CollisionChecker(robot, [wide], known.attached, known.allowed).is_free(start):
            return wide.model_copy(update={"box": (edge, edge, edge)})
    raise ParameterError("cubes", name, "fewer: there is no room for one that is clear of the robot")


def color(driver: MujocoDriver, colors: dict[str, tuple[float, float, float, float]]) -> None:
    """Color bodies of a driver's model by name."""
    model = driver.twin.model
    for name, rgba in colors.items():
        model.geom_rgba[model.geom_bodyid == model.body(name).id] = rgba


def told_problem(driver: MujocoDriver, trial: Trial, hidden: Sequence[Obstacle]) -> Problem:
    """Return the problem with all objects and obstacles where they are."""
    attached = tuple(
        held.model_copy(update=pose_fields(in_link(driver, held.name, held.link))) for held in trial.known.attached
    )
    return trial.known.model_copy(update={"attached": attached, "scene": (*trial.known.scene, *hidden)})


def _most_off(task: SeenTask, deviations: float) -> float:
    """Return how far held objects may be off, in a number of standard deviations of the longest axis [m]."""
    spreads = [float(np.linalg.eigvalsh(one.covariance[3:, 3:])[-1]) for one in task.held]
    return deviations * float(np.sqrt(max(spreads, default=0.0)))


def errors_of(driver: MujocoDriver, task: SeenTask, hidden: Sequence[Obstacle]) -> dict[str, float]:
    """Return the errors of what was seen: of faces [m] and axes [rad] by object, and of the obstacles' places [m]."""
    found: dict[str, float] = {"obstacles_seen": float(len(task.seen))}
    for one in task.held:
        true = replace(one, pose=driver.pose(one.name), scale=np.ones(3))
        found[f"face_error_{one.name}"] = float(np.linalg.norm(one.face - true.face))
        found[f"axis_error_{one.name}"] = float(np.arccos(np.clip(one.axis @ true.axis, -1.0, 1.0)))
    for obstacle in hidden:
        apart = [float(np.linalg.norm(one.pose[:3, 3] - obstacle.position)) for one in task.seen]
        found[f"place_error_{obstacle.name}"] = min(apart, default=float("inf"))
    return found


def _with_contacts(run: TaskRun, driver: MujocoDriver, hidden: set[str]) -> TaskRun:
    """Return the run with the check that nothing touched an obstacle that was not told."""
    if not hidden:
        return run
    touched = sorted(pair for pair in driver.contacts if hidden & set(pair))
    text = "; ".join(f"{a} and {b}" for a, b in touched)
    check = Check("nothing touched a red obstacle", not touched, text or "none")
    if check.passed:
        return replace(run, checks=(*run.checks, check))
    reason = "; ".join(filter(None, (run.reason, f"{check.name}: {text}")))
    return replace(run, checks=(*run.checks, check), outcome=run.outcome if not run else FAILED, reason=reason)
