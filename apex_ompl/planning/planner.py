"""A planner that is kept: a robot, a model and a world that stay ready between plans.

What plans need is imported when a planner is made, so that the import of this module is quick.
"""

from __future__ import annotations

import os
import time
from collections.abc import Set
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self, Unpack

from apex_ompl import planners
from apex_ompl.util.display import one_line
from apex_ompl.util.forking import ProcessLock, unforked
from apex_ompl.util.process import running
from apex_ompl.util.validation import check_options

if TYPE_CHECKING:
    from ompl import geometric as og

    from apex_ompl.collision import CollisionChecker, Contact
    from apex_ompl.planning.one_plan import PlanKeywords, ProblemKeywords
    from apex_ompl.planning.query import Group, State, Target
    from apex_ompl.result import PlanResult
    from apex_ompl.robot import Robot
    from apex_ompl.scene.problem import Problem


@dataclass(frozen=True)
class StateCheck:
    """Outcome of :meth:`MotionPlanner.check`; true for a state that is inside the limits and free.

    Attributes:
        reason: Why it is neither, in one sentence; empty for a valid state.
        clearance: Distance of the nearest pair of bodies that is checked [m], the negative depth where they overlap.
        contacts: Pairs that overlap, the deepest first.
    """

    reason: str
    clearance: float
    contacts: tuple[Contact, ...]

    def __bool__(self) -> bool:
        """Whether the state is valid."""
        return not self.reason

    def __repr__(self) -> str:
        """Return whether the state is valid, why it is not, and the clearance."""
        found = "valid" if self else f"invalid: {self.reason}"
        return one_line("StateCheck", found, f"clearance {1e3 * self.clearance:.2f} mm")


class MotionPlanner:
    """A robot in a world, ready to plan again and again.

    What takes time is done once: the robot is built, its tables and those of the world are made, the model and the
    compiled code are loaded. The world is edited in place (:class:`apex_ompl.planning.World`), as a planning scene
    of MoveIt's. A planner may be used by several threads; plans, checks and edits of one planner wait for each other,
    so that a plan holds for the world in which it began. Two planners work at the same time.

        with apex_ompl.MotionPlanner() as planner:
            planner.world.add(name="post", box=(0.1, 0.1, 0.6), position=(0.5, 0.0, 0.3))
            result = planner.plan(planner.robot.home, goal)
    """

    @unforked()
    def __init__(self, robot: str | Path | Robot = "dual_panda_softhand", model: str | None = None) -> None:
        """Make a planner in an empty world.

        Args:
            robot: Name of a robot that ships, path of a robot file, or a robot; one that does not ship is better given
                by its file, which results and other processes find it by.
            model: Name or folder of the checkpoint that ``apex`` uses; by default its own.

        Raises:
            ApexError: The robot is unknown, or one of its files is faulty.
        """
        from apex_ompl.collision import CollisionChecker
        from apex_ompl.planning.world import World
        from apex_ompl.robot import Robot, load_robot

        self.robot = robot if isinstance(robot, Robot) else load_robot(robot)
        file = self.robot.name if isinstance(robot, Robot) else str(robot)
        self.robot_file = os.path.abspath(file) if file.endswith((".yaml", ".yml")) else file
        self.model = model
        self.world = World(CollisionChecker(self.robot), ProcessLock(), self.robot_file)
        self._set_up()

    def _set_up(self) -> None:
        with unforked():
            import apex_ompl.planning.one_plan  # noqa: F401 - with all that plans need
        self._checker, self._lock = self.world.checker, self.world.lock
        self._left: CollisionChecker | None = None  # of the world without some obstacles, as it was needed last

    def __repr__(self) -> str:
        """Return the robot, the model where one is given, and what is in the world."""
        from apex_ompl.apex.parameters import NAME

        model = "" if self.model is None else f"model {self.model!r}"
        return one_line("MotionPlanner", repr(self.robot.name), f"planner {NAME}", model, self.world.contents)

    def __enter__(self) -> Self:
        """Return the planner."""
        return self

    def __exit__(self, *_: object) -> None:
        """Empty the world."""
        self.world.clear()

    def __getstate__(self) -> dict[str, Any]:
        """Return what another process needs to make the same planner."""
        return {"robot_file": self.robot_file, "model": self.model, "world": self.world}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Make the planner anew."""
        self.__dict__.update(state)
        self.robot = self.world.checker.robot
        self._set_up()

    def plan(
        self, start: State, goal: Target, planner: str | None = None, *,
        group: Group | None = None, name: str = "world", **options: Unpack[PlanKeywords],
    ) -> PlanResult:  # fmt: skip
        """Plan in the world as it is now.

        Args:
            start: The start.
            goal: The goal.
            planner: Name of a planner; see :func:`apex_ompl.plan`.
            group: Joints that are planned, by names of groups and joints; the others stay as at the start, and a goal
                by joint names may leave them out. All by default.
            name: Name of the problem in the result.
            **options: As of :func:`apex_ompl.plan`: ``timeout``, ``seed``, ``simplify``, ``params``, ``snapshot``,
                ``timing``, ``leave_contact``.

        Raises:
            ApexError: The start, the goal, the planner, a parameter or the name of an option is faulty.
            KeyboardInterrupt: Ctrl-C was pressed; planning ended in good order first.
        """
        started = time.perf_counter()
        from apex_ompl.planning.one_plan import OPTIONS, PlanOptions, plan_once

        check_options(options, OPTIONS)
        with running(), self._lock:
            query = self.problem(start, goal, name, group)
            return plan_once(self, query, planner, started, PlanOptions(group=group, **options))

    def plan_problem(
        self, problem: Problem, planner: str | None = None, **options: Unpack[ProblemKeywords]
    ) -> PlanResult:
        """Put the bodies of a problem into the world in place of those that are there, and plan.

        Args:
            problem: A problem of this robot.
            planner: Name of a planner.
            **options: As of :meth:`plan`, ``group`` among them.

        Raises:
            ApexError: The problem, the planner, a parameter or the name of an option is faulty.
        """
        started = time.perf_counter()
        from apex_ompl.planning.one_plan import OPTIONS, PlanOptions, plan_once

        check_options(options, OPTIONS)
        with running(), self._lock:
            with unforked():
                self.world.load(problem)
            return plan_once(self, problem, planner, started, PlanOptions(**options))

    def problem(self, start: State, goal: Target, name: str = "world", group: Group | None = None) -> Problem:
        """Return the problem of going from a start to a goal in the world as it is now.

        Args:
            start: The start.
            goal: The goal.
            name: Name of the problem.
            group: Joints that are planned; values of the others are added to a goal by joint names.

        Raises:
            ParameterError: A state has not the robot's joints.
            UnknownNameError: There is no such group.
        """
        from apex_ompl.planning.query import goal_record, joint_values, planned_joints
        from apex_ompl.scene.problem import Problem
        from apex_ompl.util.schema import validate

        begin = joint_values(self.robot, start, "start")
        moving = self.robot.joint_names if group is None else planned_joints(self.robot, group)
        wanted = goal_record(self.robot, goal, {joint: v for joint, v in begin.items() if joint not in moving})
        query = validate(Problem, {"name": name, "robot": self.robot_file, "start": begin, "goal": wanted}, "problem")
        with self._lock:  # what is in the world is valid already
            bodies = {
                "scene": tuple(self.world.obstacles.values()), "attached": tuple(self.world.held.values()),
                "allowed": self.world.allowed,
            }  # fmt: skip
        return query.model_copy(update={key: value for key, value in bodies.items() if value})

    def is_free(self, state: State) -> bool:
        """Whether a state is inside the limits and free in the world as it is now; :meth:`check` says why it is not.

        Obstacles that are yet to appear are not there.

        Raises:
            ParameterError: The state has not the robot's joints.
        """
        from apex_ompl.planning.query import state_array

        q = state_array(self.robot, state, "state")
        with self._lock:
            return self.robot.limit_fault(q) is None and self._checker_now().is_free(q)

    def check(self, state: State) -> StateCheck:
        """Check a state in the world as it is now, without obstacles that are yet to appear.

        Raises:
            ParameterError: The state has not the robot's joints.
        """
        from apex_ompl.ompl.setup import state_fault
        from apex_ompl.planning.query import state_array

        q = state_array(self.robot, state, "state")
        with self._lock:
            checker = self._checker_now()
            return StateCheck(state_fault(checker, q), checker.clearance(q), tuple(checker.contacts(q)))

    def simple_setup(self, start: State, goal: Target) -> og.SimpleSetup:
        """Return OMPL's SimpleSetup in the world as it is now, for planners and tools of OMPL's own.

        Edits of the world change what its checkers say, unless an obstacle is yet to appear: that one is left out.

        Raises:
            ApexError: The start or the goal is faulty.
        """
        from apex_ompl.apex.parameters import NAME
        from apex_ompl.ompl.setup import assemble

        with self._lock:
            checker = self._checker_without(self._absent(), kept=False)
            ready = assemble(self.problem(start, goal), self.robot, checker=checker)
        ready.simple_setup.setPlannerAllocator(planners.allocator(NAME))
        return ready.simple_setup

    def _checker_now(self) -> CollisionChecker:
        """Return a checker of what is there at time 0."""
        return self._checker_without(self._absent())

    def _absent(self) -> set[str]:
        """Return the names of the obstacles that are not there at time 0."""
        changing = self._checker.changing_obstacles
        if not changing:
            return set()
        from apex_ompl.scene.scripts import is_there

        return {o.name for o in changing if not is_there(o, 0.0)}

    def _checker_without(self, names: Set[str], *, kept: bool = True) -> CollisionChecker:
        """Return a checker of the world without some obstacles, which is the world's own where there are none.

        Args:
            names: Names of these obstacles.
            kept: Whether it may be the one of the last time, in which only what was changed since is changed.
        """
        if not names:
            return self._checker
        from apex_ompl.collision import CollisionChecker

        scene = {name: body for name, body in self.world.obstacles.items() if name not in names}
        held, pairs = self.world.held, [pair for pair in self.world.allowed if names.isdisjoint(pair)]
        if kept and self._left is not None:
            self._left.become(scene, held, pairs)
            if [*self._left.obstacles] == [*scene] and [*self._left.held] == [*held]:  # as in one that is made anew
                return self._left
        made = CollisionChecker(self.robot, scene.values(), held.values(), pairs)
        self._left = made if kept else self._left
        return made
