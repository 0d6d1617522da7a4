"""The Python planning API: ``load_problem``, ``setup`` and ``plan``."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ompl import geometric as og

from apex_ompl import planners, problems
from apex_ompl.errors import ParameterError
from apex_ompl.ompl_adapter.interrupt import Interrupt
from apex_ompl.ompl_adapter.process import quiet_ompl, seed_ompl
from apex_ompl.ompl_adapter.setup import assemble
from apex_ompl.planners.apex_parameters import WITHOUT_MODEL, default_planner
from apex_ompl.planning import PlanRun, find_path, finish, parameterize
from apex_ompl.result import PlanResult
from apex_ompl.robot import load_robot
from apex_ompl.scene.problem import Problem
from apex_ompl.trajectory import Timing, warm_up
from apex_ompl.util.deadline import Deadline
from apex_ompl.util.files import is_file
from apex_ompl.util.validation import check_positive, check_seed


def load_problem(name_or_path: str | os.PathLike[str]) -> Problem:
    """Return a problem by its name, one of a suite by its id (``shelf/hard/900012``), or one from a YAML file.

    Raises:
        UnknownNameError: No problem of that name, or no such suite or level; the message lists the known ones.
        ParameterError: No such seed, or the rest of an id is no level and seed.
        MissingFileError: The file, or one that it names, cannot be read.
        FileFormatError: The file does not follow the schema.
    """
    text = os.fspath(name_or_path)
    if problems.is_id(text):
        return problems.load(text)
    if is_file(Path(text)) or text.endswith((".yaml", ".yml")):
        return Problem.load(text)
    suite, *levels = text.split("/")
    if levels and suite in problems.suites():
        raise ParameterError("problem", text, f"an id such as {suite}/{problems.suites()[suite][0]}/12, or a file")
    return Problem.load(text) if os.sep in text else problems.load(text)


def setup(problem: Problem | str | os.PathLike[str]) -> og.SimpleSetup:
    """Return OMPL's SimpleSetup of a problem, for planners and tools of OMPL's own.

    Space, checker, motion validator, start and goals are set, and the default planner is allocated unless another one
    is set. Moving obstacles stand where they are at time 0.

    Raises:
        ApexError: The problem is unknown or faulty.
    """
    loaded = problem if isinstance(problem, Problem) else load_problem(problem)
    ready = assemble(loaded)
    simple_setup = ready.simple_setup
    simple_setup.setPlannerAllocator(planners.allocator(default_planner(ready.robot.name)))
    return simple_setup


def plan(
    problem: Problem | str | os.PathLike[str],
    planner: str | None = None,
    *,
    timeout: float = 5.0,
    seed: int = 0,
    simplify: bool = True,
    params: Mapping[str, Any] | None = None,
    snapshot: bool = False,
    timing: bool | Timing = True,
) -> PlanResult:
    """Plan a path, prove it by the full check, and time it.

    The straight line to each goal is tried before the planner runs. What the planner finds is shortened unless it is
    smooth, proved, and planned anew where the proof fails. A path that was found and not proved, or not timed, in time
    has the status TIMEOUT and that reason.

    Args:
        problem: A problem, its name, or its file.
        planner: Name of a planner, see ``apex_ompl.planners.names()``; by default apex, or rrtconnect+polish for a
            robot that no model ships for.
        timeout: Seconds for all that follows the set-up of problem and planner. The search ends a tenth of it before,
            from 0.05 to 0.5 s and at most half of it, so that its path can be proved and timed.
        seed: Seed of all random numbers, 0 or more. The same seed gives the same path for planners that are
            neither stopped by the clock nor threaded, as long as no other thread plans at the same time (OMPL
            seeds one generator per process).
        simplify: Whether to shorten the path that was found.
        params: Parameters of the planner by name.
        snapshot: Plan among moving obstacles as they stand at time 0.
        timing: How the path is timed, or whether; the timed motion is proved too.

    Returns:
        The result; it is true only for an exact path that passed the full check and, unless timing is off, is timed.

    Raises:
        ApexError: The problem, the planner or a parameter is unknown or faulty.
        KeyboardInterrupt: Ctrl-C was pressed; planning ended in good order first.
    """
    started = time.perf_counter()
    check_arguments(timeout, seed)
    if not isinstance(timing, (bool, Timing)):
        raise ParameterError("timing", timing, "True, False or a Timing")
    how = (Timing() if timing else None) if isinstance(timing, bool) else timing
    if planner is not None:
        planners.parameters(planner, **dict(params or {}))  # before the problem is read
    loaded = problem if isinstance(problem, Problem) else load_problem(problem)
    if loaded.moving and not snapshot:
        expected = f"True, since the obstacle {loaded.moving[0]!r} moves and plans hold for one moment only"
        raise ParameterError("snapshot", snapshot, expected)
    with quiet_ompl():
        seed_ompl(seed)
        robot = load_robot(loaded.robot)
        notes = [f"snapshot: {', '.join(loaded.moving)} taken to stand still"] if loaded.moving else []
        if planner is None:
            planner = default_planner(robot.name)
            if planner == WITHOUT_MODEL:
                notes.append(f"no model of {robot.name} ships, so {planner} plans")
        parameters = planners.parameters(planner, **dict(params or {}))
        if how is not None:
            how.start(how.limits(robot.limits))  # whether it fits the robot
        ready = assemble(loaded, robot, seed=seed)
        notes += ready.notes
        if how is not None:
            warm_up()
        times = {"setup": time.perf_counter() - started}
        run = PlanRun(ready, planner, parameters, seed, Deadline(timeout), times, notes)
        with Interrupt() as run.interrupt:
            result = find_path(run, simplify)
            if how is not None:
                result = parameterize(run, result, how)
        return finish(run, result, started)


def check_arguments(timeout: float, seed: int) -> None:
    """Check what every plan needs.

    Raises:
        ParameterError: ``timeout`` is not a positive number of seconds, or ``seed`` not a whole number from 0.
    """
    check_positive(timeout, "timeout", "a positive number of seconds")
    check_seed(seed)
