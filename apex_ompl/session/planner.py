"""A planner that is kept: a robot, a model and a world that stay ready between plans."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping, Sequence, Set
from contextlib import ExitStack
from dataclasses import dataclass
from inspect import signature
from pathlib import Path
from typing import Any, Self

from ompl import geometric as og

from apex_ompl import planners
from apex_ompl.apex.models import has_model
from apex_ompl.collision import CollisionChecker
from apex_ompl.collision.conservative import CheckCounts
from apex_ompl.collision.mesh_stage import Contact
from apex_ompl.errors import ParameterError
from apex_ompl.ompl_adapter.interrupt import Interrupt
from apex_ompl.ompl_adapter.process import quiet_ompl, seed_ompl
from apex_ompl.ompl_adapter.setup import assemble, state_fault
from apex_ompl.planners.apex_parameters import NAME
from apex_ompl.planning import PlanRun, find_path, finish, parameterize, plan_among_movers
from apex_ompl.planning.among_movers import warm_up as warm_up_among_movers
from apex_ompl.planning.departure import LARGEST_DEPTH, find_departure, with_departure
from apex_ompl.planning.movers import movers_of, snapshot_notes
from apex_ompl.planning.query import Group, State, Target, goal_record, joint_values, planned_joints, state_array
from apex_ompl.result import PlanResult
from apex_ompl.robot import Robot, load_robot
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.scene.problem import Problem
from apex_ompl.scene.scripts import is_there
from apex_ompl.session.world import World
from apex_ompl.trajectory import Timing, warm_up
from apex_ompl.util.deadline import Deadline
from apex_ompl.util.exiting import running
from apex_ompl.util.forking import ProcessLock, unforked
from apex_ompl.util.schema import validate
from apex_ompl.util.validation import check_flag, check_number, check_options, check_positive, check_seed


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


class MotionPlanner:
    """A robot in a world, ready to plan again and again.

    What takes time is done once: the robot is built, its tables and those of the world are made, the model and the
    compiled code are loaded. The world is edited in place (:class:`apex_ompl.session.world.World`), as a planning scene
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
        self.robot = robot if isinstance(robot, Robot) else load_robot(robot)
        file = self.robot.name if isinstance(robot, Robot) else str(robot)
        self.robot_file = os.path.abspath(file) if file.endswith((".yaml", ".yml")) else file
        self.model = model
        self.world = World(CollisionChecker(self.robot), ProcessLock(), self.robot_file)
        self._set_up()

    def _set_up(self) -> None:
        self._checker, self._lock = self.world.checker, self.world.lock
        self._left: CollisionChecker | None = None  # of the world without some obstacles, as it was needed last

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
        group: Group | None = None, name: str = "world", **options: Any,
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
        check_options(options, OPTIONS)
        with running(), self._lock:
            return self._plan(self.problem(start, goal, name, group), planner, started, group=group, **options)

    def plan_problem(self, problem: Problem, planner: str | None = None, **options: Any) -> PlanResult:
        """Put the bodies of a problem into the world in place of those that are there, and plan.

        Args:
            problem: A problem of this robot.
            planner: Name of a planner.
            **options: As of :meth:`plan`, ``group`` among them.

        Raises:
            ApexError: The problem, the planner, a parameter or the name of an option is faulty.
        """
        started = time.perf_counter()
        check_options(options, OPTIONS)
        with running(), self._lock:
            with unforked():
                self.world.load(problem)
            return self._plan(problem, planner, started, **options)

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
        q = state_array(self.robot, state, "state")
        with self._lock:
            return self.robot.limit_fault(q) is None and self._checker_now().is_free(q)

    def check(self, state: State) -> StateCheck:
        """Check a state in the world as it is now, without obstacles that are yet to appear.

        Raises:
            ParameterError: The state has not the robot's joints.
        """
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
        with self._lock:
            checker = self._checker_without(self._absent(), kept=False)
            ready = assemble(self.problem(start, goal), self.robot, checker=checker)
        ready.simple_setup.setPlannerAllocator(planners.allocator(NAME))
        return ready.simple_setup

    def _plan(
        self, problem: Problem, planner: str | None, started: float, *, timeout: float = 5.0, seed: int = 0,
        simplify: bool = True, params: Mapping[str, Any] | None = None, snapshot: bool = False,
        timing: bool | Timing = True, group: Group | None = None, leave_contact: float = 0.0,
    ) -> PlanResult:  # fmt: skip
        check_arguments(timeout, seed)
        check_number(leave_contact, "leave_contact", 0.0, LARGEST_DEPTH)
        check_flag(simplify, "simplify")
        check_flag(snapshot, "snapshot")
        if not isinstance(timing, (bool, Timing)):
            raise ParameterError("timing", timing, "True, False or a Timing")
        how = (Timing() if timing else None) if isinstance(timing, bool) else timing
        changing = self._checker.changing_obstacles
        movers = _movers(changing, snapshot, how, leave_contact)
        with quiet_ompl(), ExitStack() as preparing:
            preparing.enter_context(unforked())
            seed_ompl(seed)
            notes = snapshot_notes(changing) if snapshot else []
            if planner is None:
                planner = NAME
                if not has_model(self.robot.name):
                    notes.append(f"no model of {self.robot.name} ships, so random bumps take the place of proposals")
            parameters = planners.parameters(planner, **self._parameters(planner, params, seed))
            if how is not None:
                start = how.start(how.limits(self.robot.limits, self.robot.joint_names))  # whether it fits the robot
                if start is not None and leave_contact:
                    raise ParameterError("leave_contact", leave_contact, "0 for a start that moves")
            moving = None if group is None else planned_joints(self.robot, group)
            checker = self._checker_without({mover.name for mover in movers}) if movers else self._checker_now()
            checker.check_counts = CheckCounts()
            given = ready = assemble(problem, self.robot, seed=seed, checker=checker, moving=moving)
            departure = find_departure(ready, leave_contact, seed) if leave_contact and ready.start_fault else None
            if departure is not None:
                begin = dict(zip(self.robot.joint_names, departure.end.tolist(), strict=True))
                departed = problem.model_copy(update={"start": begin})
                ready = assemble(departed, self.robot, seed=seed, checker=checker, moving=moving)
            notes += given.notes
            notes += [note for note in self._checker.mesh_notes if note not in given.notes]
            if how is not None:
                warm_up()
            if movers:
                warm_up_among_movers(checker)
            times = {"setup": time.perf_counter() - started}
            run = PlanRun(ready, planner, parameters, seed, Deadline(timeout), times, notes)
            preparing.close()
            with Interrupt() as run.interrupt, running(run.interrupt.end):
                if movers and how is not None:
                    result = plan_among_movers(run, movers, simplify, how)
                else:
                    result = find_path(run, simplify)
                    if how is not None:
                        result = parameterize(run, result, how)
            if departure is not None:
                result = with_departure(result, given, departure, how)
            return finish(run, result, started)

    def _checker_now(self) -> CollisionChecker:
        """Return a checker of what is there at time 0."""
        return self._checker_without(self._absent())

    def _absent(self) -> set[str]:
        """Return the names of the obstacles that are not there at time 0."""
        return {o.name for o in self._checker.changing_obstacles if not is_there(o, 0.0)}

    def _checker_without(self, names: Set[str], *, kept: bool = True) -> CollisionChecker:
        """Return a checker of the world without some obstacles, which is the world's own where there are none.

        Args:
            names: Names of these obstacles.
            kept: Whether it may be the one of the last time, in which only what was changed since is changed.
        """
        if not names:
            return self._checker
        scene = {name: body for name, body in self.world.obstacles.items() if name not in names}
        held, pairs = self.world.held, [pair for pair in self.world.allowed if names.isdisjoint(pair)]
        if kept and self._left is not None:
            self._left.become(scene, held, pairs)
            if [*self._left.obstacles] == [*scene] and [*self._left.held] == [*held]:  # as in one that is made anew
                return self._left
        made = CollisionChecker(self.robot, scene.values(), held.values(), pairs)
        self._left = made if kept else self._left
        return made

    def _parameters(self, planner: str, params: Mapping[str, Any] | None, seed: int) -> dict[str, Any]:
        given, known = planners.named(params), planners.parameters(planner)
        if self.model is not None and hasattr(known, "model"):
            given.setdefault("model", self.model)
        if hasattr(known, "seed"):  # OMPL's is that of the whole process, where other threads plan as well
            given.setdefault("seed", seed)
        return given


OPTIONS = tuple(name for name, one in signature(MotionPlanner._plan).parameters.items() if one.kind is one.KEYWORD_ONLY)
"""Options of a plan."""


def check_arguments(timeout: float, seed: int) -> None:
    """Check what every plan needs.

    Raises:
        ParameterError: ``timeout`` is not a positive number of seconds, or ``seed`` not a whole number from 0.
    """
    check_positive(timeout, "timeout", "a positive number of seconds")
    check_seed(seed)


def _movers(
    changing: Sequence[Obstacle], snapshot: bool, timing: Timing | None, leave_contact: float
) -> tuple[Obstacle, ...]:
    """Return the obstacles that a plan is made among in time: those that move, unless they are to stand still.

    Raises:
        ParameterError: There are such, and an option that does not go with them; or one follows a script.
    """
    movers = () if snapshot else movers_of(changing)
    if movers and timing is None:
        raise ParameterError("timing", False, f"True or a Timing, since the obstacle {movers[0].name!r} moves")
    if movers and leave_contact:
        raise ParameterError("leave_contact", leave_contact, f"0, since the obstacle {movers[0].name!r} moves")
    return movers
