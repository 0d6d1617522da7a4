"""The Python API: ``load_problem``, ``setup``, ``plan``, ``plan_task`` and ``run``."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Unpack

from ompl import geometric as og

from apex_ompl import planners, problems
from apex_ompl.apex.parameters import NAME
from apex_ompl.errors import ParameterError
from apex_ompl.ompl.setup import assemble
from apex_ompl.planners import AnyPlanner
from apex_ompl.planning.options import PlanKeywords, PlanOptions, check_arguments
from apex_ompl.planning.pool import kept_planner
from apex_ompl.result import PlanResult
from apex_ompl.robot.model import named_poses
from apex_ompl.scene.problem import Problem
from apex_ompl.timing import Timing
from apex_ompl.util.files import is_file, path_text
from apex_ompl.util.forking import unforked

if TYPE_CHECKING:
    from apex_ompl.constraints.user import UserConstraint
    from apex_ompl.drivers.driver import Driver
    from apex_ompl.loop.environment import Environment, LiveSensor
    from apex_ompl.loop.result import RunResult
    from apex_ompl.loop.run import SensorFactory
    from apex_ompl.loop.sensor import Sensor
    from apex_ompl.moving.replanner import Replanner
    from apex_ompl.moving.settings import LoopSettings
    from apex_ompl.planning.task_result import TaskResult
    from apex_ompl.planning.tasks import TaskSearch
    from apex_ompl.scene.constraints import Constraint


@unforked()
def load_problem(name_or_path: str | os.PathLike[str]) -> Problem:
    """Return a problem by its name, one of a suite by its id (``shelf/hard/900012``), or one from a YAML file.

    Raises:
        UnknownNameError: No problem of that name, or no such suite or level; the message lists the known ones.
        ParameterError: No such seed, the rest of an id is no level and seed, or neither a name nor a path is given.
        MissingFileError: The file, or one that it names, cannot be read.
        FileFormatError: The file does not follow the schema.
    """
    text = path_text(name_or_path, "problem")
    if problems.is_id(text):
        return problems.load(text)
    if is_file(Path(text)) or text.endswith((".yaml", ".yml")):
        return Problem.load(text, named_poses)
    suite, *levels = text.split("/")
    if levels and suite in problems.suites():
        raise ParameterError("problem", text, f"an id such as {suite}/{problems.suites()[suite][0]}/12, or a file")
    return Problem.load(text, named_poses) if os.sep in text else problems.load(text)


@unforked()
def setup(
    problem: Problem | str | os.PathLike[str], *, constraints: Sequence[Constraint | UserConstraint] = ()
) -> og.SimpleSetup:
    """Return OMPL's SimpleSetup of a problem, for planners and tools of OMPL's own.

    Space, checker, motion validator, start and goals are set, and the default planner is allocated unless another one
    is set. Dynamic obstacles stand where they are at time 0.

    Args:
        problem: A problem, its name, or its file.
        constraints: Constraints along the path besides those of the problem; with any, the space is OMPL's projected
            one, see :meth:`apex_ompl.MotionPlanner.simple_setup`.

    Raises:
        ApexError: The problem or a constraint is unknown or faulty.
    """
    loaded = problem if isinstance(problem, Problem) else load_problem(problem)
    ready = assemble(loaded, constraints=constraints)
    simple_setup = ready.simple_setup
    simple_setup.setPlannerAllocator(planners.allocator(NAME))
    return simple_setup


def plan(
    problem: Problem | str | os.PathLike[str],
    planner: AnyPlanner | None = None,
    *,
    timeout: float = 5.0,
    seed: int = 0,
    simplify: bool = True,
    params: Mapping[str, Any] | None = None,
    snapshot: bool = False,
    timing: bool | Timing = True,
    objective: str = "time",
    calm_factor: float = 1.1,
    leave_contact: float = 0.0,
    constraints: Sequence[Constraint | UserConstraint] = (),
) -> PlanResult:
    """Plan a path, prove it by the full check, and optimize its motion.

    The straight line to each goal is tried before the planner runs. What the planner finds is shortened unless it is
    smooth, proved, and planned anew where the proof fails. A path that was found and not proved, or not timed, in time
    has the status TIMEOUT and that reason.

    Args:
        problem: A problem, its name, or its file.
        planner: Name of a planner, see ``apex_ompl.planners.names()``, its parameters, or a function that makes one for
            OMPL's space information, such as ``lambda si: APEX(si, stages=...)``; by default apex, which does without a
            network for a robot that no model ships for.
        timeout: Seconds for all that follows the set-up of problem and planner. The search ends a tenth of it before,
            from 0.05 to 0.5 s and at most half of it, so that its path can be proved and timed.
        seed: Seed of all random numbers, 0 or more. The same seed gives the same path for planners that are
            neither stopped by the clock nor threaded, as long as no other thread plans at the same time (OMPL
            seeds one generator per process).
        simplify: Whether to shorten the path that was found.
        params: Parameters of the planner by name.
        snapshot: Take dynamic obstacles to stand where they are at time 0. Otherwise the motion is planned and proved
            in time (:mod:`apex_ompl.planning.among_dynamic_obstacles`).
        timing: How the path is timed, or whether; the timed motion is proved too.
        objective: What the motion is to be: ``time``, as fast as the limits allow; ``length``, along the shortest path
            found; ``calm``, the least integral of the squared jerk in ``calm_factor`` times the fastest motion's time.
        calm_factor: See ``objective``, 1 to 100.
        leave_contact: Depth of contacts at the start that the path may leave along growing clearance, up to 0.001 [m];
            a note says so, since that way out is not proved.
        constraints: Constraints along the path (:mod:`apex_ompl.scene.constraints`, or a user's own), besides those of
            the problem.

    Returns:
        The result; it is true only for an exact path that passed the full check and, unless timing is off, is timed.

    Raises:
        ApexError: The problem, the planner or a parameter is unknown or faulty.
        KeyboardInterrupt: Ctrl-C was pressed; planning ended in good order first.
    """
    check_arguments(timeout, seed)
    if planner is not None:
        planners.chosen(planner, params)  # before the problem is read
    loaded = problem if isinstance(problem, Problem) else load_problem(problem)
    with kept_planner(loaded.robot) as kept:
        return kept.plan_problem(
            loaded, planner, timeout=timeout, seed=seed, simplify=simplify, params=params, snapshot=snapshot,
            timing=timing, objective=objective, calm_factor=calm_factor, leave_contact=leave_contact,
            constraints=constraints,
        )  # fmt: skip


def plan_task(
    problem: Problem | str | os.PathLike[str], planner: AnyPlanner | None = None, *, search: TaskSearch | None = None,
    **options: Unpack[PlanKeywords],
) -> TaskResult:  # fmt: skip
    """Plan to the goal of a problem and the steps ``after`` it, prove all of it, and join it to one timed motion.

    As MoveIt's ``MoveGroup.plan`` goes to a goal and its ``Task.plan`` through all stages, :func:`plan` leaves the
    steps after the goal out, and this function takes them too. Goals from which they cannot be done are not chosen; the
    status is STEP_FAILED where no other one is found.

    Args:
        problem: A problem, its name, or its file; without steps after the goal the task is the motion to the goal.
        planner: As of :func:`plan`.
        search: How goals are chosen, and whether steps of several arms may be done at once.
        **options: As of :func:`plan`: ``timeout``, for the whole task, ``seed``, ``simplify``, ``params``,
            ``snapshot``, ``timing``, ``objective``, ``calm_factor``, ``leave_contact``, ``constraints``, which hold up
            to the goal.

    Returns:
        The result; its ``trajectory`` goes through all steps, and its ``steps`` have their times and their scenes.

    Raises:
        ApexError: The problem, a step, the planner or a parameter is unknown or faulty.
        KeyboardInterrupt: Ctrl-C was pressed; planning ended in good order first.
    """
    check_arguments(options.get("timeout", PlanOptions.timeout), options.get("seed", PlanOptions.seed))
    if planner is not None:
        planners.chosen(planner, options.get("params"))  # before the problem is read
    loaded = problem if isinstance(problem, Problem) else load_problem(problem)
    with kept_planner(loaded.robot) as kept:
        return kept.plan_task(loaded, planner, search=search, **options)


def run(
    problem: Problem | Environment | str | os.PathLike[str],
    method: str | Replanner = "apex",
    *,
    clock: str = "sim",
    prediction: str = "cv",
    seed: int = 0,
    speed: float = 1.0,
    settings: LoopSettings | None = None,
    sensor: Sensor | LiveSensor | SensorFactory | None = None,
    driver: Driver | str | None = None,
    tolerance: float = 0.05,
) -> RunResult:
    """Let a robot go to a goal while obstacles move.

    The robot observes obstacles by a sensor and tracks them. It follows a motion only as long as a stop after its next
    step is proved clear of the reachable sets of all obstacles, and replans where its motion meets the prediction.

    Args:
        problem: A world by its name (:func:`apex_ompl.problems.worlds.load`), a problem some of whose obstacles move,
            its name or its file; or an environment (:class:`apex_ompl.loop.environment.Environment`).
        method: Name of a replanner (:func:`apex_ompl.loop.replan.methods.names`), or a replanner of your own
            (:class:`apex_ompl.moving.replanner.Replanner`).
        clock: ``sim``, on which work takes its time by a compute-cost model, so that the same seed gives the same run;
            or ``real``, the wall clock, with the replanner in a process of its own, which it is pickled to.
        prediction: ``still``, ``cv`` or ``truth``, see :class:`apex_ompl.moving.settings.LoopSettings`.
        seed: Seed of random choices, and of the sensor where none is given.
        speed: Share of the velocity limits that motions use, 0.001 to 1.
        settings: Parameters of the loop; ``prediction`` counts instead of theirs. Their largest error and speed are by
            default those of the modeled sensor and the environment; for a sensor of your own they are required.
        sensor: How obstacles are observed: the model of a sensor, or one of your own, an object with ``read(now)``
            (:class:`apex_ompl.loop.environment.LiveSensor`), or a function that makes one of the driver and the
            environment, such as :class:`apex_ompl.loop.Cameras`.
        driver: The robot, at rest at the start (:class:`apex_ompl.drivers.driver.Driver`), or a name: ``mujoco``, one
            in physics, or ``kinematic``. With ``clock="sim"`` its clock is advanced. By default the robot is exactly
            where it is commanded to be, and a step decides what it does at once, not from the next step on.
        tolerance: Largest distance of a measured joint from where it should be, beyond which the robot stops and the
            run ends [rad].

    Raises:
        ApexError: The world, the problem, a name or a number is unknown or faulty.
    """
    from apex_ompl.loop.run import run_in

    return run_in(
        load_environment(problem), method, clock=clock, prediction=prediction, seed=seed, speed=speed,
        settings=settings, sensor=sensor, driver=driver, tolerance=tolerance,
    )  # fmt: skip


def load_environment(problem: Problem | Environment | str | os.PathLike[str]) -> Environment:
    """Return the environment of a problem, of the name of a world or a problem, or of a problem file.

    Raises:
        ApexError: It is unknown or faulty.
    """
    from apex_ompl.problems import worlds
    from apex_ompl.problems.worlds import environment_of

    if isinstance(problem, Problem):
        return environment_of(problem)
    if isinstance(problem, str | os.PathLike):
        return worlds.load(path_text(problem, "problem"))
    if not all(hasattr(problem, name) for name in ("present", "script", "ran")):
        raise ParameterError("problem", problem, "a problem, its name, its file, or an environment")
    return problem
