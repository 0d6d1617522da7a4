"""A planner that is kept: a robot, a model and a world that stay ready between plans; ``plan`` lends such planners.

What plans need is imported when a planner is made, so that the import of this module is quick.
"""

from __future__ import annotations

import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path as FilePath
from typing import TYPE_CHECKING, Any, Self, Unpack

from apex_ompl import planners
from apex_ompl.errors import ParameterError
from apex_ompl.planning.options import OPTIONS, PlanKeywords, PlanOptions, ProblemKeywords, check_arguments
from apex_ompl.util.display import one_line
from apex_ompl.util.forking import ProcessLock, unforked
from apex_ompl.util.process import running
from apex_ompl.util.validation import check_integer, check_options, check_seed

if TYPE_CHECKING:
    from numpy.typing import ArrayLike
    from ompl import geometric as og

    from apex_ompl.collision import CollisionChecker
    from apex_ompl.constraints.user import UserConstraint
    from apex_ompl.paths.path import Path
    from apex_ompl.planners import AnyPlanner
    from apex_ompl.planning.checks import ProofResult, StateCheck
    from apex_ompl.planning.inverse_kinematics import IKResult
    from apex_ompl.planning.line_query import Waypoint
    from apex_ompl.planning.lines import LineResult
    from apex_ompl.planning.query import Group, State, Target
    from apex_ompl.planning.task_result import TaskResult
    from apex_ompl.planning.tasks import TaskSearch
    from apex_ompl.result import PlanResult
    from apex_ompl.robot import Robot
    from apex_ompl.scene.constraints import Constraint
    from apex_ompl.scene.problem import PoseTarget, Problem
    from apex_ompl.scene.steps import Step
    from apex_ompl.timing import Timing, Trajectory
    from apex_ompl.types import Array


class MotionPlanner:
    """A robot in a world, ready to plan again and again.

    What takes time is done once: the robot is built, its tables and those of the world are made, the model and the
    compiled code are loaded. The world is edited in place (:class:`apex_ompl.planning.World`), like MoveIt's
    planning scene. Several threads may use a planner; plans, checks and edits of one planner wait for each other, so
    that a plan holds for the world in which it started. Two planners work at the same time.

        with apex_ompl.MotionPlanner() as planner:
            planner.world.add(name="post", box=(0.1, 0.1, 0.6), position=(0.5, 0.0, 0.3))
            result = planner.plan(planner.robot.home, goal)
    """

    @unforked()
    def __init__(self, robot: str | FilePath | Robot = "dual_panda_softhand", model: str | None = None) -> None:
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
            from apex_ompl.planning import one_motion  # noqa: F401 - with all that plans need
            from apex_ompl.planning.world_checkers import WorldCheckers
        self._checkers, self._lock = WorldCheckers(self.world), self.world.lock

    def __repr__(self) -> str:
        """Return the robot, a given model, and the contents of the world."""
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
        self, start: State, goal: Target, planner: AnyPlanner | None = None, *,
        group: Group | None = None, name: str = "world", while_executing: Trajectory | None = None,
        offset: float = 0.0, **options: Unpack[PlanKeywords],
    ) -> PlanResult:  # fmt: skip
        """Plan in the world as it is now.

        With ``while_executing`` other joints, of another arm, execute a known motion meanwhile. The trajectory of the
        result is then the motion of all joints, until both have ended; ``trajectory.selected(joints)`` is that of the
        group.

        Args:
            start: The start.
            goal: The goal.
            planner: A planner; see :func:`apex_ompl.plan`.
            group: Joints that are planned, by names of groups and joints; the others stay as at the start, and a goal
                by joint names may leave them out. All by default.
            name: Name of the problem in the result.
            while_executing: Motion of some of the other joints, or of all joints, of which those count that move. The
                start has the values that they have at ``offset``, or leaves them out; goals do not change them.
            offset: Time of that motion at which the plan starts [s]; where it is negative the motion starts later.
            **options: As of :func:`apex_ompl.plan`: ``timeout``, ``seed``, ``simplify``, ``params``, ``snapshot``,
                ``timing``, ``objective``, ``calm_factor``, ``leave_contact``, ``constraints``.

        Raises:
            ApexError: The start, the goal, the planner, a parameter or the name of an option is faulty.
            KeyboardInterrupt: Ctrl-C was pressed; planning ended in good order first.
        """
        from apex_ompl.planning.query import check_is_no_line

        started = time.perf_counter()
        check_options(options, OPTIONS)
        with running(), self._lock:
            given = PlanOptions(group=group, **options)
            if while_executing is None:
                if offset != 0.0:
                    raise ParameterError("offset", offset, "0 without while_executing")
                problem = self.problem(start, goal, name, group, given.seed)
                check_is_no_line(problem)
                return self._plan(problem, planner, started, given)
            with unforked():
                from apex_ompl.planning.while_executing import Asked, plan_beside

            asked = Asked.of(self.robot, start, group, while_executing, offset)
            problem = self.problem(asked.at_end, goal, name, asked.planned, given.seed)
            problem = problem.model_copy(update={"goal": asked.goal_at_end(problem.goal)})
            check_is_no_line(problem)
            self._checkers.check_still()
            return plan_beside(self._checkers, problem, asked, planner, given, model=self.model, started=started)

    def plan_problem(
        self, problem: Problem, planner: AnyPlanner | None = None, **options: Unpack[ProblemKeywords]
    ) -> PlanResult:
        """Put the bodies of a problem into the world in place of those that are there, and plan.

        Args:
            problem: A problem of this robot.
            planner: A planner; see :func:`apex_ompl.plan`.
            **options: As of :meth:`plan`, ``group`` among them.

        Raises:
            ApexError: The problem, the planner, a parameter or the name of an option is faulty.
        """
        from apex_ompl.planning.query import check_is_no_line, check_problem

        started = time.perf_counter()
        check_options(options, OPTIONS)
        check_problem(problem)
        check_is_no_line(problem)
        with running(), self._lock:
            with unforked():
                self.world.load(problem)
            return self._plan(problem, planner, started, PlanOptions(**options))

    def sequence(
        self, start: State, steps: Sequence[Step | Mapping[str, Any]], planner: AnyPlanner | None = None, *,
        name: str = "sequence", search: TaskSearch | None = None, **options: Unpack[ProblemKeywords],
    ) -> TaskResult:  # fmt: skip
        """Plan steps one after the other, in the world as it is now: motions, lines, grasps, releases and others.

        Goals are chosen so that the later steps can be done, as which of the grasps of an object; see
        `docs/sequences.md`. The world is the same afterwards.

        Args:
            start: The start.
            steps: The steps: records of :mod:`apex_ompl.scene`, or entries of ``after`` in problem files. The goal of a
                ``move`` may be any goal of :meth:`plan` but an object that draws states.
            planner: A planner; see :func:`apex_ompl.plan`.
            name: Name of the problem in the result.
            search: How goals are chosen, and whether steps of several arms may be done at once.
            **options: As of :meth:`plan`, ``group`` among them; ``timeout`` is for the whole sequence.

        Raises:
            ApexError: The start, a step, the planner, a parameter or the name of an option is faulty.
            KeyboardInterrupt: Ctrl-C was pressed; planning ended in good order first.
        """
        from apex_ompl.planning.task_problem import sequence_problem

        check_options(options, OPTIONS)
        with running(), self._lock:
            self._checkers.check_still()
            problem = sequence_problem(self.robot, self.problem(start, start, name), steps)
            return self._plan_task(problem, planner, search, options)

    def plan_task(
        self, problem: Problem, planner: AnyPlanner | None = None, search: TaskSearch | None = None,
        **options: Unpack[ProblemKeywords],
    ) -> TaskResult:  # fmt: skip
        """Put the bodies of a problem into the world, and plan to its goal and the steps after it.

        The world is then that on the way to the goal.

        Args:
            problem: A problem of this robot.
            planner: A planner; see :func:`apex_ompl.plan`.
            search: How goals are chosen, and whether steps of several arms may be done at once.
            **options: As of :meth:`plan`, ``group`` among them; ``timeout`` is for the whole task.

        Raises:
            ApexError: The problem, a step, the planner, a parameter or the name of an option is faulty.
        """
        check_options(options, OPTIONS)
        with running(), self._lock:
            with unforked():
                self.world.load(problem)
            return self._plan_task(problem, planner, search, options)

    def _plan_task(
        self, problem: Problem, planner: AnyPlanner | None, search: TaskSearch | None, options: ProblemKeywords
    ) -> TaskResult:
        """Plan a task whose bodies are in the world, while the lock is held."""
        with unforked():
            from apex_ompl.planning.task_problem import with_lines
            from apex_ompl.planning.tasks import plan_task
        given = PlanOptions(**options)

        def plan_to(goals: Problem, timeout: float, first: bool, group: Group | None) -> PlanResult:
            now = replace(given if first else given.from_rest(), timeout=timeout, group=group)
            return self._plan(goals, planner, time.perf_counter(), now)

        return plan_task(self.world.checker, with_lines(problem), given, plan_to, search)

    def _plan(
        self, problem: Problem, planner: AnyPlanner | None, started: float, options: PlanOptions
    ) -> PlanResult:  # fmt: skip
        """Plan in the world as it is now, while the lock is held; see :func:`apex_ompl.planning.one_motion.plan`."""
        from apex_ompl.planning import one_motion

        return one_motion.plan(self._checkers, problem, planner, options, model=self.model, started=started)

    def plan_line(
        self, start: State, pose: Waypoint | Sequence[Waypoint], *, frame: str | None = None,
        speed: float | None = None, blend: float = 0.0, timeout: float = 5.0, timing: bool | Timing = True,
        name: str = "line",
    ) -> LineResult:  # fmt: skip
        """Plan a motion along which frames go straight from pose to pose, in the world as it is now.

        Position and orientation go in step, the latter by the shortest turn, within 0.1 mm and 0.1 degrees at all
        times; other joints stay. Where the frames cannot reach the last pose, the result says how far they get, and
        why. They stop at poses in between unless there are blends. See `docs/straight_lines.md`.

        Args:
            start: The start.
            pose: A pose or several: a ``PoseTarget``; a rigid transform, shape (4, 4); a position, shape (3,), with the
                orientation as before; or poses by frame, for two arms at once [m].
            frame: Hand, link or held object, where the poses do not name it.
            speed: Largest speed of the frames [m/s].
            blend: Radius around the poses in between inside of which the frames may leave the lines, at most half of
                the segments beside them [m].
            timeout: Seconds for the plan.
            timing: How the path is timed, or whether; from rest to rest.
            name: Name of the problem in the result.

        Raises:
            ApexError: The start, a pose, a frame, or an option is faulty.
            KeyboardInterrupt: Ctrl-C was pressed; planning ended in good order first.
        """
        with unforked():
            from apex_ompl.collision.conservative import CheckCounts
            from apex_ompl.ompl.process import Interrupt
            from apex_ompl.planning import lines
            from apex_ompl.planning.line_query import line_query
            from apex_ompl.planning.query import state_array
            from apex_ompl.timing.parameterization import warm_up
            from apex_ompl.util.clocks import Deadline

        check_arguments(timeout, 0)
        with running(), self._lock:
            with unforked():
                self._checkers.check_still()
                checker = self._checkers.now()
                checker.check_counts = CheckCounts()
                query = line_query(
                    checker, state_array(self.robot, start, "start"), pose, frame=frame, blend=blend, speed=speed,
                    timing=timing, problem=lambda goals: self.problem(start, goals, name),
                )  # fmt: skip
                warm_up()
            deadline = Deadline(timeout)
            with Interrupt() as interrupt, running(interrupt.end):
                return lines.plan_along(checker, query, deadline, lambda: interrupt.pressed or deadline.expired)

    def problem(
        self, start: State, goal: Target, name: str = "world", group: Group | None = None, seed: int = 0
    ) -> Problem:
        """Return the problem of going from a start to a goal in the world as it is now.

        Args:
            start: The start.
            goal: The goal.
            name: Name of the problem.
            group: Joints that are planned; values of the others are added to a goal by joint names.
            seed: Seed of a goal that a user's object draws; the states drawn become the goal of the problem.

        Raises:
            ParameterError: A state has not the robot's joints.
            UnknownNameError: There is no such group.
        """
        import numpy as np

        from apex_ompl.planning.query import GoalSampler, goal_record, joint_values, planned_joints, sampled_goals
        from apex_ompl.scene.problem import Problem
        from apex_ompl.util.schema import validate

        if isinstance(goal, GoalSampler):
            check_seed(seed)
            goal = sampled_goals(goal, self.robot, np.random.default_rng(seed), self.is_free)
        given = joint_values(self.robot, start, "start")
        moving = self.robot.joint_names if group is None else planned_joints(self.robot, group)
        wanted = goal_record(self.robot, goal, {joint: v for joint, v in given.items() if joint not in moving})
        query = validate(Problem, {"name": name, "robot": self.robot_file, "start": given, "goal": wanted}, "problem")
        with self._lock:  # bodies of the world are valid already
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
            return self.robot.limit_fault(q) is None and self._checkers.now().is_free(q)

    def check(self, state: State) -> StateCheck:
        """Check a state in the world as it is now, without obstacles that are yet to appear.

        Raises:
            ParameterError: The state has not the robot's joints.
        """
        from apex_ompl.planning.checks import check_state
        from apex_ompl.planning.query import state_array

        q = state_array(self.robot, state, "state")
        with self._lock:
            return check_state(self._checkers.now(), q)

    def fk(self, state: State, frame: str) -> Array:
        """Return the pose of a frame in the world at a state, shape (4, 4) [m].

        Args:
            state: The state.
            frame: Hand, link or held object, as in a ``PoseTarget``.

        Raises:
            ParameterError: The state has not the robot's joints.
            UnknownNameError: There is no such frame.
        """
        from apex_ompl.constraints.frames import frame_of
        from apex_ompl.planning.query import state_array

        q = state_array(self.robot, state, "state")
        with self._lock:
            found = frame_of(self.robot, frame, self.world.held, "frame")
        pose: Array = self.robot.link_pose(q, found.link) @ found.pose
        return pose

    def ik(
        self, targets: PoseTarget | Sequence[PoseTarget], *, near: State | None = None, group: Group | None = None,
        count: int = 256, descents: int = 512, seed: int = 0,
    ) -> IKResult:  # fmt: skip
        """Return the free states that reach poses, in the world as it is now.

        A redundant arm reaches a pose along self-motions; there is a state every 0.1 rad of the joint that moves most.

        Args:
            targets: A pose, or several that are reached together.
            near: State near which the solutions are wanted: the nearest come first. By default those with the largest
                clearance come first, by millimeters, then those nearest to home. Joints that move none of the frames
                stay as there, or as at home.
            group: Joints that may move, by names of groups and joints; all by default.
            count: Most solutions.
            descents: Most descents from random states, for each arm.
            seed: Seed of the random states.

        Returns:
            The solutions; where there is none, ``reason`` says why, and ``causes`` what stood in the way.

        Raises:
            ApexError: A frame or a joint is unknown, or an option is faulty.
        """
        import numpy as np

        from apex_ompl.planning.inverse_kinematics import solve
        from apex_ompl.planning.query import planned_joints, pose_targets, state_array

        check_seed(seed)
        check_integer(count, "count", 1)
        check_integer(descents, "descents", 1)
        poses, limits = pose_targets(targets), self.robot.limits
        base = self.robot.home if near is None else state_array(self.robot, near, "near")
        moving = self.robot.joint_names if group is None else planned_joints(self.robot, group)
        fixed = np.array([k for k, joint in enumerate(self.robot.joint_names) if joint not in moving], np.intp)
        with running(), self._lock:
            return solve(
                self._checkers.now(), poses, base.clip(limits.lower, limits.upper), fixed,
                by_distance=near is not None, count=count, descents=descents, seed=seed,
            )  # fmt: skip

    def prove(
        self, path: Sequence[State] | ArrayLike | Path | Trajectory | PlanResult, *,
        constraints: Sequence[Constraint | UserConstraint] = (),
    ) -> ProofResult:  # fmt: skip
        """Prove a path or a motion of your own in the world as it is now: the full check that each plan passes.

        It has to be inside the limits (a motion inside those of velocity, acceleration and jerk, too) and free of
        collision from end to end, between its states, too.

        Args:
            path: States that are joined by straight lines, shape (N, dof); or a timed motion of all joints, which is
                proved along its own cubic pieces; or the result of a plan, of which that is its motion or its path.
            constraints: Constraints along it.

        Raises:
            ParameterError: It has not the robot's joints, or a number that is not finite.
            ApexError: A constraint is faulty.
        """
        from apex_ompl.planning.checks import prove

        with running(), self._lock:
            self._checkers.check_still()
            return prove(self._checkers.now(), path, lambda start: self.problem(start, start), constraints)

    @property
    def checker(self) -> CollisionChecker:
        """The collision checker of the world: of states, distances, contacts and paths, for tools of your own.

        It follows edits of the world; ask it while no other thread edits, or in ``with planner.world.locked()``.
        """
        return self._checkers.now()

    def simple_setup(
        self, start: State, goal: Target, *, constraints: Sequence[Constraint | UserConstraint] = ()
    ) -> og.SimpleSetup:
        """Return OMPL's SimpleSetup in the world as it is now, for planners and tools of OMPL's own.

        Edits of the world change what its checkers say, unless an obstacle is yet to appear: that one is left out.

        Args:
            start: The start.
            goal: The goal.
            constraints: Constraints along the path; with any, the space is OMPL's projected one, whose planners return
                states on the constraints that are joined by projections of straight lines.

        Raises:
            ApexError: The start, the goal or a constraint is faulty.
        """
        from apex_ompl.apex.parameters import NAME
        from apex_ompl.ompl.setup import assemble

        with self._lock:
            checker = self._checkers.now(kept=False)
            ready = assemble(self.problem(start, goal), self.robot, checker=checker, constraints=constraints)
        ready.simple_setup.setPlannerAllocator(planners.allocator(NAME))
        return ready.simple_setup
