"""Planning tasks and executing them in physics, from the start of a problem or from starts drawn by seed."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from apex_ompl.drivers.grasps import GRASPING
from apex_ompl.drivers.twin import TwinSettings
from apex_ompl.drivers.vessels import filled
from apex_ompl.errors import ParameterError
from apex_ompl.physics.execution import Executor, part_of, rehearsed
from apex_ompl.physics.result import UNPLANNED, TaskRun
from apex_ompl.physics.trials import Spread, Trial, draw
from apex_ompl.planning.planner import MotionPlanner
from apex_ompl.planning.task_result import TaskResult
from apex_ompl.robot import load_robot
from apex_ompl.scene.constraints import Upright
from apex_ompl.scene.problem import Problem
from apex_ompl.timing import Timing
from apex_ompl.timing.trajectory import Trajectory
from apex_ompl.types import Array

GRAVITY = 9.81  # [m/s^2]
TIMEOUT = 30.0  # of planning [s]
STEEPEST = 0.3  # ratio of level acceleration to gravity of what stands on a tray, and of liquids
SPILLING = 1.3  # angle from upright up to which a vessel is tilted on the way to a goal [rad]
SLOWER, SLOWEST = 0.85, 0.02  # factors of the speed where a plan is too fast, and the least one
ROUNDS = 5  # plans of a task, each slower
SAMPLES = 400  # of a motion


@dataclass(eq=False)
class TaskRunner:
    """Executes a problem in physics, from any number of starts.

    Attributes:
        problem: The problem; its obstacles stand still.
        spread: How far starts are from the problem.
        settings: Settings of the model.
        timeout: Of each plan [s].
        friction: Names of the objects that friction holds; by default those of a rehearsal from the problem's start.
    """

    problem: Problem
    spread: Spread = field(default_factory=Spread)
    settings: TwinSettings = GRASPING
    timeout: float = TIMEOUT
    friction: Collection[str] | None = None

    def __post_init__(self) -> None:
        """Load the robot.

        Raises:
            ParameterError: An obstacle moves.
            ApexError: The robot is unknown or faulty.
        """
        if self.problem.moving:
            raise ParameterError("problem", self.problem.moving[0], "obstacles that stand still")
        self.robot = load_robot(self.problem.robot)
        self._planner = MotionPlanner(self.robot)
        self._scale: float | None = None  # of the speed, of the plan from the problem's start

    def run(self, seed: int | None = None, film: tuple[int, int] | None = None) -> tuple[TaskRun, list[Any]]:
        """Execute the task once.

        Args:
            seed: Seed of the start; by default it is that of the problem.
            film: Width and height of a film [pixels].

        Returns:
            What happened, and the frames of the film.

        Raises:
            ApexError: The problem is faulty.
        """
        if self._scale is None:
            self._rehearse()
        trial = draw(self.robot, self.problem, seed, self.spread, self.settings.density)
        plan, _ = self._plan(trial, seed or 0)
        if not plan or plan.trajectory is None:
            return unplanned(self.problem, seed, plan), []
        executor = Executor(
            self.robot, trial, plan, friction=self.friction or (), settings=self.settings, seed=seed, film=film
        )  # fmt: skip
        return executor.run(), executor.frames

    def _rehearse(self) -> None:
        """Find the speed of plans from the start of the problem, and what friction holds along its motion."""
        trial = draw(self.robot, self.problem, None, self.spread, self.settings.density)
        plan, self._scale = self._plan(trial, 0)
        if self.friction is None and plan and plan.trajectory is not None:
            motion = part_of(plan.trajectory, plan.steps[0].start, plan.steps[0].end)
            self.friction = rehearsed(self.robot, trial, motion, self.settings)

    def _plan(self, trial: Trial, seed: int) -> tuple[TaskResult, float]:
        """Plan, more slowly where what stands or flows would fall or spill, and return the factor of the speed, too."""
        s = self._scale or 1.0
        known = trial.known
        loose = [held.name for held in known.attached if held.touch_links == () or held.name in filled(known)]
        for _ in range(ROUNDS):
            timing = Timing(velocity_scale=s, acceleration_scale=s * s, jerk_scale=s**3)
            plan = self._planner.plan_task(
                known, timeout=self.timeout, seed=seed, timing=timing, constraints=self._level(known)
            )  # fmt: skip
            if not plan or plan.trajectory is None or not loose:
                break
            factor = max((self._slower(known, name, plan.trajectory) for name in loose), default=1.0)
            if factor >= 1.0:
                break
            s = max(SLOWER * factor * s, SLOWEST)
        return plan, s

    def _level(self, problem: Problem) -> tuple[Upright, ...]:
        """Return constraints by which full vessels do not tilt too far on the way to the goal."""
        upright = {one.frame for one in problem.constraints if isinstance(one, Upright)}
        axes = {one.name: one.contact.axis for one in problem.attached if one.contact is not None}
        full = [name for name in filled(problem) if name not in upright]
        return tuple(Upright(frame=name, axis=axes[name], angle=SPILLING) for name in full)

    def _slower(self, problem: Problem, name: str, motion: Trajectory) -> float:
        """Return the factor of the speed of a motion at which an object's level acceleration is small enough."""
        held = next(one for one in problem.attached if one.name == name)
        times = np.linspace(0.0, motion.duration, SAMPLES)
        step = times[1] - times[0]
        places = np.array([(self.robot.link_pose(q, held.link) @ held.pose)[:3, 3] for q in motion(times)])
        a = np.diff(places, 2, axis=0) / step**2
        need: Array = np.linalg.norm(a[:, :2], axis=1) - STEEPEST * a[:, 2]
        worst = float(need.max(initial=0.0)) / (STEEPEST * GRAVITY)
        return 1.0 if worst <= 1.0 else 1.0 / math.sqrt(worst)


def unplanned(problem: Problem, seed: int | None, plan: TaskResult) -> TaskRun:
    """Return the result of a task that was not planned."""
    nothing = np.empty((0, 0))
    return TaskRun(
        problem.name, seed, UNPLANNED, f"{plan.status}: {plan.reason}", (), (), (), np.empty(0), nothing, nothing, {},
        {}, {},
    )  # fmt: skip
