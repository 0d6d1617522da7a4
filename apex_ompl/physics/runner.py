"""Planning tasks and executing them in physics, from the start of a problem or from starts drawn by seed."""

from __future__ import annotations

import os
from collections.abc import Collection
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from apex_ompl.drivers.grasps import GRASPING
from apex_ompl.drivers.twin_settings import TwinSettings
from apex_ompl.drivers.vessels import filled
from apex_ompl.errors import ParameterError
from apex_ompl.physics.execution import Executor, rehearsed
from apex_ompl.physics.result import UNPLANNED, TaskRun
from apex_ompl.physics.stages import motion_of
from apex_ompl.physics.trials import Spread, draw, nominal
from apex_ompl.planning.planner import MotionPlanner
from apex_ompl.planning.task_result import TaskResult
from apex_ompl.planning.tasks import TaskSearch
from apex_ompl.result import PlanResult
from apex_ompl.robot import load_robot
from apex_ompl.scene.constraints import Upright
from apex_ompl.scene.problem import Problem
from apex_ompl.util.validation import check_integer, check_name, check_positive

TIMEOUT = 30.0  # of planning [s]
AT_REST = 1e-3  # largest velocity at the start of what is executed [rad/s]
PLANS, SEEDS = 4, 10**6  # most plans of a task, and the distance of their seeds
SPILLING = 1.45  # angle from upright up to which a vessel is tilted on the way to a goal [rad]


@dataclass(eq=False)
class TaskRunner:
    """Executes a problem in physics, from any number of starts.

    Attributes:
        problem: The problem; its obstacles stand still.
        spread: How far starts are from the problem.
        settings: Settings of the model.
        timeout: Of each plan [s].
        friction: Names of the objects that friction holds; by default those of a rehearsal from the problem's start.
        search: How the steps of the task are planned.
        executor: That of the last run, with the robot and the objects as they were at its end; None before.
    """

    problem: Problem
    spread: Spread = field(default_factory=Spread)
    settings: TwinSettings = GRASPING
    timeout: float = TIMEOUT
    friction: Collection[str] | None = None
    search: TaskSearch = field(default_factory=TaskSearch)
    executor: Executor | None = field(default=None, init=False)

    def __post_init__(self) -> None:
        """Load the robot.

        Raises:
            ParameterError: An obstacle moves, fingers do not yield, or the timeout is not positive.
            UnknownNameError: There is no held object of a name in ``friction``.
            ApexError: The robot is unknown or faulty.
        """
        if self.problem.moving:
            raise ParameterError("problem", self.problem.moving[0], "obstacles that stand still")
        if self.settings.finger_stiffness is None:
            raise ParameterError("settings.finger_stiffness", None, "a stiffness: fingers yield to what they grasp")
        for name in self.friction or ():
            check_name(name, "held object in friction", [held.name for held in self.problem.attached])
        check_positive(self.timeout, "timeout")
        self.robot = load_robot(self.problem.robot)
        self._planner = MotionPlanner(self.robot)

    def run(self, seed: int | None = None, film: tuple[int, int] | None = None) -> tuple[TaskRun, list[Any]]:
        """Execute the task once.

        Args:
            seed: Seed of the start; by default it is that of the problem.
            film: Width and height of a film [pixels].

        Returns:
            What happened, and the frames of the film.

        Raises:
            ApexError: The problem is faulty.
            ParameterError: The seed is negative.
        """
        if seed is not None:
            check_integer(seed, "seed", 0)
        self.executor, friction = None, self.held_by_friction()
        trial = draw(self.robot, self.problem, seed, self.spread, self.settings.density)
        plan = self.plan(trial.known, seed or 0, self.spread.place)
        if not plan or plan.trajectory is None:
            return unplanned(self.problem, seed, f"{plan.status}: {plan.reason}"), []
        executor = self.executor = Executor(
            self.robot, trial, friction=friction, settings=self.settings, seed=seed, film=film
        )  # fmt: skip
        executor.grasp()
        return executor.run(plan), executor.frames

    def held_by_friction(self) -> Collection[str]:
        """Return the names of the objects that friction holds, of a rehearsal where they are not given."""
        if self.friction is None:
            self.friction = self._rehearsed()
        return self.friction

    def _rehearsed(self) -> frozenset[str]:
        """Return the names of the objects that friction holds from the start of the problem to the goal."""
        trial = draw(self.robot, self.problem, None, self.spread, self.settings.density)
        if not any(held.links is None and held.touch_links != () for held in trial.known.attached):
            return frozenset()
        plan = self.plan(trial.known, 0, self.spread.place)
        if not plan or plan.trajectory is None:
            return frozenset()
        motion = motion_of(self.robot, trial.known, plan.trajectory, plan.steps[0])
        return rehearsed(self.robot, trial, motion, self.settings)

    def plan(self, known: Problem, seed: int, place: float) -> TaskResult:
        """Plan some times, until the way to the goal is as clear as objects may be off; return the clearest plan.

        Args:
            known: The problem as it is known.
            seed: Seed of the plans.
            place: How far objects may be off [m].
        """
        found, make = list[TaskResult](), partial(self._planner.plan_task, known, timeout=self.timeout)
        for k in range(PLANS):
            plan = make(seed=seed + k * SEEDS, constraints=self._level(known), search=self.search)
            found.append(plan)
            if plan and plan.steps[0].clearance >= place:
                break
        return max(found, key=lambda plan: plan.steps[0].clearance if plan else -1.0)

    def _level(self, problem: Problem) -> tuple[Upright, ...]:
        """Return constraints by which full vessels do not tilt too far on the way to the goal."""
        upright = {one.frame for one in problem.constraints if isinstance(one, Upright)}
        axes = {one.name: one.contact.axis for one in problem.attached if one.contact is not None}
        full = [name for name in filled(problem) if name not in upright]
        return tuple(Upright(frame=name, axis=axes[name], angle=SPILLING) for name in full)


def execute(plan: PlanResult, settings: TwinSettings = GRASPING) -> TaskRun:
    """Execute a plan in physics, from the start and with the objects that it was planned for.

    Objects that a hand holds at the start are welded to it. While a hand closes or opens, all arms are at rest: where
    arms do steps at once, the whole motion stops along its path there.

    Args:
        plan: A planned task or sequence, or the plan of one motion, such as that of a schedule; with a motion.
        settings: Settings of the model.

    Raises:
        ParameterError: It is no result of a plan, or has no motion that starts at rest, or an obstacle moves, or
            fingers do not yield.
    """
    if not isinstance(plan, PlanResult):
        raise ParameterError(
            "plan", _named(plan), "what plan, plan_task or sequence returns, .result of a schedule, or a loaded result"
        )
    if not plan or plan.trajectory is None:
        what = f"{plan.status} without a motion" if plan else f"{plan.status}, {plan.reason}"
        raise ParameterError("plan", what, "a result that was planned and timed")
    fastest = int(np.argmax(np.abs(plan.trajectory.velocities[0])))
    if (speed := abs(float(plan.trajectory.velocities[0, fastest]))) > AT_REST:
        what = f"{plan.trajectory.joint_names[fastest]} at {speed:.3g} rad/s"
        raise ParameterError("plan", what, "a motion that starts at rest")
    if not isinstance(plan, TaskResult) or not plan.steps:
        plan = TaskResult.of_motion(plan)
    runner = TaskRunner(plan.problem, settings=settings)
    trial = nominal(runner.robot, plan.problem, settings.density)
    executor = Executor(runner.robot, trial, friction=(), settings=settings)
    executor.grasp()
    return executor.run(plan)


def _named(given: object) -> object:
    """Return a value, or its type where its text is long."""
    return given if given is None or isinstance(given, str | os.PathLike) else type(given)


def unplanned(problem: Problem, seed: int | None, reason: str, outcome: str = UNPLANNED) -> TaskRun:
    """Return the result of a task that was not planned."""
    nothing = np.empty((0, 0))
    return TaskRun(
        problem.name, seed, outcome, reason, (), (), (), np.empty(0), nothing, nothing, {},
        {}, {},
    )  # fmt: skip
