"""One call of ``APEX.solve``: read the query, run the stages in turn, shorten, improve."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Any

from ompl import base as ob

from apex_ompl.apex.context import SolveContext
from apex_ompl.apex.stages import Anytime, Shorten, Stage
from apex_ompl.apex.start_goal import nearest_pairs, read_goals, read_starts
from apex_ompl.ompl.space import array_to_path
from apex_ompl.types import Array

LOG = logging.getLogger("apex_ompl")
Status = ob.PlannerStatus

MAX_EXPERIENCE = 4  # earlier paths that are candidates for the next query


def solve(
    context: SolveContext, inputs: Any, stages: Sequence[Stage], shorten: Shorten | None, anytime: Anytime
) -> Any:
    """Solve a problem definition by stages, and return OMPL's status.

    Args:
        context: What the stages share.
        inputs: The planner's ``getPlannerInputStates()``.
        stages: Run in turn until one returns a valid path.
        shorten: Shortens that path, or None.
        anytime: Improves it while there is time.
    """
    status, reason = _read_query(context, inputs)
    if reason:
        return _unsolved(context, status, reason)
    for stage in stages:
        found = stage.run(context)
        if found is not None:
            context.report.solved_by = found.stage
            context.accept(found.path)
            if shorten is not None:
                shorten.run(context)
            anytime.run(context)
            _remember(context)
            return Status.EXACT_SOLUTION
    _unsolved(context, Status.TIMEOUT, f"no path among {context.report.candidates} candidates in the time given")
    if context.nearest is None:
        return Status.TIMEOUT
    path, distance = context.nearest
    context.pdef.addSolutionPath(array_to_path(context.si, path.states), True, distance, "apex")
    return Status.APPROXIMATE_SOLUTION


def _read_query(context: SolveContext, inputs: Any) -> tuple[Any, str]:
    """Read starts and goals into the context; return a status and a reason where they are of no use."""
    dof = context.kernel.robot.dof
    with context.report.timed("query"):
        context.starts = read_starts(inputs, dof)
        goal = context.pdef.getGoal()
        if goal is not None and not goal.hasType(ob.GOAL_SAMPLEABLE_REGION):
            reason = "the goal cannot be sampled, expected a goal state, goal states or a sampleable region"
            return Status.UNRECOGNIZED_GOAL_TYPE, reason
        context.goals = [] if goal is None else read_goals(inputs, dof, context.ptc, goal)
        if not context.starts:
            return Status.INVALID_START, "no start state is valid"
        if not context.goals:
            return Status.TIMEOUT if context.stop() else Status.INVALID_GOAL, "no valid goal state was sampled"
        context.pairs = nearest_pairs(context.starts, context.goals)
    return None, ""


def _unsolved(context: SolveContext, status: Any, reason: str) -> Any:
    context.report.reason = reason
    LOG.info("apex: %s", reason)
    return status


def _remember(context: SolveContext) -> None:
    """Keep the difference of the best path from its straight line for later queries, where it is a spline."""
    best = context.best
    if best is not None and best.spline is not None and best.control is not None:
        difference: Array = best.control - best.spline.line(best.control[0], best.control[-1])
        context.experience.insert(0, difference)
        del context.experience[MAX_EXPERIENCE:]
