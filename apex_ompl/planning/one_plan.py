"""One plan of a planner that is kept."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, TypedDict

from apex_ompl import planners
from apex_ompl.apex.models import has_model
from apex_ompl.apex.parameters import NAME
from apex_ompl.collision.conservative import CheckCounts
from apex_ompl.errors import ParameterError
from apex_ompl.ompl.interrupt import Interrupt
from apex_ompl.ompl.process import quiet_ompl, seed_ompl
from apex_ompl.ompl.setup import assemble
from apex_ompl.planning.departure import LARGEST_DEPTH, find_departure, with_departure
from apex_ompl.planning.dynamic_obstacles import dynamic_of, snapshot_notes
from apex_ompl.planning.query import Group, planned_joints
from apex_ompl.planning.run import PlanRun
from apex_ompl.planning.solving import find_path
from apex_ompl.planning.timing import finish, parameterize
from apex_ompl.result import PlanResult
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.scene.problem import Problem
from apex_ompl.timing import Timing, warm_up
from apex_ompl.util.clocks import Deadline
from apex_ompl.util.forking import unforked
from apex_ompl.util.process import running
from apex_ompl.util.validation import check_flag, check_number, check_positive, check_seed

if TYPE_CHECKING:
    from apex_ompl.planning.planner import MotionPlanner


@dataclass(frozen=True)
class PlanOptions:
    """Options of a plan, see :func:`apex_ompl.plan` and :meth:`apex_ompl.MotionPlanner.plan`."""

    timeout: float = 5.0
    seed: int = 0
    simplify: bool = True
    params: Mapping[str, Any] | None = None
    snapshot: bool = False
    timing: bool | Timing = True
    group: Group | None = None
    leave_contact: float = 0.0

    def check(self) -> None:
        """Check the values that need no robot.

        Raises:
            ParameterError: One is faulty.
        """
        check_arguments(self.timeout, self.seed)
        check_number(self.leave_contact, "leave_contact", 0.0, LARGEST_DEPTH)
        check_flag(self.simplify, "simplify")
        check_flag(self.snapshot, "snapshot")
        if not isinstance(self.timing, (bool, Timing)):
            raise ParameterError("timing", self.timing, "True, False or a Timing")


OPTIONS = tuple(field.name for field in fields(PlanOptions))


class PlanKeywords(TypedDict, total=False):
    """:class:`PlanOptions` as keywords of :meth:`apex_ompl.MotionPlanner.plan`, for editors and type checkers."""

    timeout: float
    seed: int
    simplify: bool
    params: Mapping[str, Any] | None
    snapshot: bool
    timing: bool | Timing
    leave_contact: float


class ProblemKeywords(PlanKeywords, total=False):
    """:class:`PlanOptions` as keywords of :meth:`apex_ompl.MotionPlanner.plan_problem`."""

    group: Group | None


def check_arguments(timeout: float, seed: int) -> None:
    """Check what every plan needs.

    Raises:
        ParameterError: ``timeout`` is not a positive number of seconds, or ``seed`` not a whole number from 0.
    """
    check_positive(timeout, "timeout", "a positive number of seconds")
    check_seed(seed)


def plan_once(
    kept: MotionPlanner, problem: Problem, planner: str | None, started: float, options: PlanOptions
) -> PlanResult:
    """Plan in the world of a planner as it is now.

    Args:
        kept: The planner, which no other thread uses meanwhile.
        problem: The problem, whose bodies are in the world.
        planner: Name of a planner; apex by default.
        started: Value of ``time.perf_counter`` when planning began [s].
        options: The options.

    Raises:
        ApexError: The planner, a parameter or an option is faulty.
        KeyboardInterrupt: Ctrl-C was pressed; planning ended in good order first.
    """
    options.check()
    robot, seed, leave_contact = kept.robot, options.seed, options.leave_contact
    timing = Timing() if options.timing is True else options.timing
    how = timing if isinstance(timing, Timing) else None
    changing = kept.world.checker.changing_obstacles
    dynamic = _dynamic(changing, options.snapshot, how, leave_contact)
    with quiet_ompl(), ExitStack() as preparing:
        preparing.enter_context(unforked())
        seed_ompl(seed)
        notes = snapshot_notes(changing) if options.snapshot else []
        if planner is None:
            planner = NAME
            if not has_model(robot.name):
                notes.append(f"no model of {robot.name} ships, so random perturbations take the place of proposals")
        parameters = planners.parameters(planner, **_parameters(planner, kept.model, options))
        if how is not None:
            start = how.start(how.limits(robot.limits, robot.joint_names))  # whether it fits the robot
            if start is not None and leave_contact:
                raise ParameterError("leave_contact", leave_contact, "0 for a start that moves")
        moving = None if options.group is None else planned_joints(robot, options.group)
        checker = (
            kept._checker_without({dynamic_obstacle.name for dynamic_obstacle in dynamic})
            if dynamic
            else kept._checker_now()
        )
        checker.check_counts = CheckCounts()
        given = ready = assemble(problem, robot, seed=seed, checker=checker, moving=moving)
        departure = find_departure(ready, leave_contact, seed) if leave_contact and ready.start_fault else None
        if departure is not None:
            begin = dict(zip(robot.joint_names, departure.end.tolist(), strict=True))
            departed = problem.model_copy(update={"start": begin})
            ready = assemble(departed, robot, seed=seed, checker=checker, moving=moving)
        notes += given.notes
        notes += [note for note in kept.world.checker.mesh_notes if note not in given.notes]
        if how is not None:
            warm_up()
        if dynamic:
            from apex_ompl.planning import among_dynamic_obstacles

            among_dynamic_obstacles.warm_up(checker)
        times = {"setup": time.perf_counter() - started}
        run = PlanRun(ready, planner, parameters, seed, Deadline(options.timeout), times, notes)
        preparing.close()
        with Interrupt() as run.interrupt, running(run.interrupt.end):
            if dynamic and how is not None:
                result = among_dynamic_obstacles.plan_among_dynamic_obstacles(run, dynamic, options.simplify, how)
            else:
                result = find_path(run, options.simplify)
                if how is not None:
                    result = parameterize(run, result, how)
        if departure is not None:
            result = with_departure(result, given, departure, how)
        return finish(run, result, started)


def _parameters(planner: str, model: str | None, options: PlanOptions) -> dict[str, Any]:
    given, known = planners.named(options.params), planners.parameters(planner)
    if model is not None and hasattr(known, "model"):
        given.setdefault("model", model)
    if hasattr(known, "seed"):  # OMPL's is that of the whole process, where other threads plan as well
        given.setdefault("seed", options.seed)
    return given


def _dynamic(
    changing: Sequence[Obstacle], snapshot: bool, timing: Timing | None, leave_contact: float
) -> tuple[Obstacle, ...]:
    """Return the obstacles that a plan is made among in time: those that move, unless they are to stand still.

    Raises:
        ParameterError: There are such, and an option that does not go with them; or one follows a script.
    """
    dynamic = () if snapshot else dynamic_of(changing)
    if dynamic and timing is None:
        raise ParameterError("timing", False, f"True or a Timing, since the obstacle {dynamic[0].name!r} moves")
    if dynamic and leave_contact:
        raise ParameterError("leave_contact", leave_contact, f"0, since the obstacle {dynamic[0].name!r} moves")
    return dynamic
