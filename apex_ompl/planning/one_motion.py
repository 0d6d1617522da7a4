"""Plans of one motion in a kept world: the five steps, among dynamic obstacles, too."""

from __future__ import annotations

import time
from contextlib import ExitStack

from apex_ompl import planners
from apex_ompl.apex.model_search import model_notes
from apex_ompl.apex.parameters import NAME
from apex_ompl.collision.conservative import CheckCounts
from apex_ompl.errors import ParameterError
from apex_ompl.ompl.process import Interrupt, quiet_ompl
from apex_ompl.planners import AnyPlanner, Parameters
from apex_ompl.planning import motions, steps
from apex_ompl.planning.departure import departed, with_departure
from apex_ompl.planning.options import PlanOptions
from apex_ompl.planning.query import dynamic_of, robot_notes, snapshot_notes
from apex_ompl.planning.world_checkers import WorldCheckers
from apex_ompl.result import PlanResult
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.scene.problem import Problem
from apex_ompl.timing import Timing
from apex_ompl.util.forking import unforked
from apex_ompl.util.process import running


def plan(
    checkers: WorldCheckers, problem: Problem, planner: AnyPlanner | None, options: PlanOptions, *, model: str | None,
    started: float,
) -> PlanResult:  # fmt: skip
    """Take the five steps of a plan in the world as it is now.

    Args:
        checkers: The checkers of the world, whose lock is held.
        problem: The problem, whose bodies are in the world.
        planner: A planner; apex by default.
        options: The options.
        model: Name or folder of the checkpoint that ``apex`` uses; by default its own.
        started: Value of ``time.perf_counter`` when the call started [s].

    Raises:
        ApexError: The planner, a parameter or an option is faulty.
        KeyboardInterrupt: Ctrl-C was pressed; planning ended in good order first.
    """
    options.check()
    whole = checkers.world.checker
    robot, leave_contact = whole.robot, options.leave_contact
    timing = Timing() if options.timing is True else options.timing or None
    changing = whole.changing_obstacles
    dynamic = () if options.snapshot else dynamic_of(changing)
    if dynamic:
        _check_among(dynamic[0], timing, leave_contact)
    with quiet_ompl(), ExitStack() as preparing:
        preparing.enter_context(unforked())
        notes = snapshot_notes(changing) if options.snapshot else []
        if planner is None and model is None and "model" not in (options.params or {}):
            notes += model_notes(robot)
        parameters = parameters_of(planner, model, options)
        derivatives = None
        if timing is not None:
            derivatives = timing.start(timing.limits(robot.limits, robot.joint_names))  # checked before planning
            timing.motion_limits(robot, problem.attached, problem.payload)  # checked before planning
            if derivatives is not None and leave_contact:
                raise ParameterError("leave_contact", leave_contact, "0 for a start that moves")
        checker = checkers.without({o.name for o in dynamic}) if dynamic else checkers.now()
        checker.check_counts = CheckCounts()
        given = steps.assemble(
            problem, robot, seed=options.seed, group=options.group, checker=checker, constraints=options.constraints
        )
        departure, setup = departed(given, leave_contact, options.seed) if leave_contact else (None, given)
        notes += [*robot_notes(robot), *given.notes]
        notes += [note for note in whole.mesh_notes if note not in given.notes]
        if timing is not None:
            motions.warm_up(checker)
        if dynamic:
            from apex_ompl.planning import among_dynamic_obstacles

            among_dynamic_obstacles.warm_up(checker)
        times = {"setup": time.perf_counter() - started}
        query = steps.check(
            setup, parameters, timeout=options.timeout, objective=options.objective,
            calm_factor=options.calm_factor, timing=timing is not None and not dynamic and derivatives is None,
            started=started, times=times, notes=notes,
        )  # fmt: skip
        preparing.close()
        with Interrupt() as query.interrupt, running(query.interrupt.end):
            if dynamic and timing is not None:
                result = among_dynamic_obstacles.plan_among_dynamic_obstacles(query, dynamic, options.simplify, timing)
            else:
                result = steps.time(steps.prove(steps.solve(query), options.simplify), timing or False)
        if departure is not None:
            result = steps.finish(query, with_departure(result, given, departure, timing))
        return result


def parameters_of(planner: AnyPlanner | None, model: str | None, options: PlanOptions) -> Parameters:
    """Return the parameters of a planner.

    Args:
        planner: The planner; apex by default.
        model: Name or folder of the checkpoint that ``apex`` uses; by default its own.
        options: The options of the plan.

    Raises:
        ApexError: The planner or a parameter is unknown or faulty.
    """
    return planners.chosen(NAME if planner is None else planner, options.params, model=model, seed=options.seed)


def _check_among(obstacle: Obstacle, timing: Timing | None, leave_contact: float) -> None:
    """Check that options go with an obstacle that moves.

    Raises:
        ParameterError: The motion is not timed, or leaves a contact.
    """
    if timing is None:
        raise ParameterError("timing", False, f"True or a Timing, since the obstacle {obstacle.name!r} moves")
    if leave_contact:
        raise ParameterError("leave_contact", leave_contact, f"0, since the obstacle {obstacle.name!r} moves")
