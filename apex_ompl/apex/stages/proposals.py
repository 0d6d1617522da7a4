"""Rounds of proposals: propose, check, repair, resample (Algorithm 1 of the paper, execute)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from apex_ompl.apex.context import SolveContext, joins
from apex_ompl.apex.stages.stage import Solution, Stage, solution_of
from apex_ompl.types import Array

PROPOSED, RESAMPLED = "apex", "apex+resample"
BATCH = 8  # proposals between two checks of the clock
MIN_REPAIR_STEPS = 48  # of repair in a round
STEPS_PER_PROPOSAL = 8  # of repair in a round, on average
SHORT_REPAIR_STEPS = 24  # of the short repair before it
MAX_RESAMPLED = 4  # candidates that are resampled in a round


def proposal_round(
    count: int, *, repair: bool, resample: int, noise: float, temperature: float = 1.0, between: Sequence[Stage] = ()
) -> list[Stage]:
    """Return the stages of a round of proposals.

    Args:
        count: Number of proposals for each pair of start and goal.
        repair: Whether candidates are improved by the optimizer.
        resample: How often colliding candidates are resampled.
        noise: How far they are noised for that, as a share of the schedule.
        temperature: Factor on the standard deviation of the proposals' initial noise.
        between: Stages that follow on a short repair, which most candidates need no more than, before the long one.
    """
    stages: list[Stage] = [Propose(count, temperature)]
    if repair and between:
        stages.append(Repair(SHORT_REPAIR_STEPS, 0))
    stages += between
    if repair:
        stages.append(Repair(MIN_REPAIR_STEPS, STEPS_PER_PROPOSAL * count))
    for _ in range(resample):
        stages.append(Resample(noise))
        if repair:
            stages.append(Repair(STEPS_PER_PROPOSAL * MAX_RESAMPLED, 0))
    return stages


@dataclass(frozen=True)
class Propose:
    """Proposals of the model, checked as they come.

    Attributes:
        count: Number of proposals for each pair of start and goal.
        temperature: Factor on the standard deviation of their initial noise.
    """

    count: int
    temperature: float = 1.0

    def run(self, context: SolveContext) -> Solution | None:
        """Return the first valid proposal, or None."""
        if context.stop():
            return None
        at_once = max(1, BATCH // len(context.queries))
        for first in range(0, self.count, at_once):
            if context.stop():
                return None
            with context.report.timed("propose"):
                some = min(at_once, self.count - first)
                control = context.sampler.propose(context.queries, some, self.temperature)
            with context.report.timed("check"):
                found = None if control is None else check(context, control, PROPOSED)
            if found is not None:
                return found
        return None


@dataclass(frozen=True)
class Repair:
    """Optimizer steps on the candidates, the most promising one first.

    Attributes:
        min_steps: Budget of steps in all, at least.
        steps: Budget of steps for each pair of start and goal.
    """

    min_steps: int
    steps: int

    def run(self, context: SolveContext) -> Solution | None:
        """Return the first candidate that becomes valid, or None."""
        if context.stop():
            return None
        steps, before = max(self.min_steps, self.steps * len(context.queries)), context.pool.steps
        with context.report.timed("repair"):
            found = context.pool.improve(steps, context.stop)
        context.report.steps += context.pool.steps - before
        return solution_of(found, context)


@dataclass(frozen=True)
class Resample:
    """Collision-triggered resampling: the candidates nearest to being valid, noised and denoised again.

    Attributes:
        noise: How far they are noised, as a share of the schedule.
    """

    noise: float

    def run(self, context: SolveContext) -> Solution | None:
        """Return the first resampled path that is valid, or None."""
        if context.stop():
            return None
        with context.report.timed("resample"):
            best = sorted(context.pool.candidates, key=lambda one: one.clearance_cost)[:MAX_RESAMPLED]
            for query in context.queries:
                mine = [one.control for one in best if joins(one.control, query.start, query.goal)]
                control = context.sampler.renoise(np.stack(mine), query, self.noise) if mine else None
                found = None if control is None else check(context, control, RESAMPLED)
                if found is not None or context.stop():
                    return found
        return None


@dataclass(frozen=True)
class Farthest:
    """Of valid paths nearer to obstacles than ``lambda_obs``, the one that keeps the largest distance."""

    def run(self, context: SolveContext) -> Solution | None:
        """Return that path, or None where no valid path was set aside."""
        return solution_of(context.farthest(), context)


def check(context: SolveContext, control: Array, origin: str) -> Solution | None:
    """Take paths into the pool, count them, and return the first that is valid as it is, or None.

    Args:
        context: Shared by the stages.
        control: Control points, shape (B, points, dof).
        origin: Name of what made them.
    """
    report = context.report
    report.candidates += len(control)
    report.proposed += len(control) if origin == PROPOSED else 0
    report.resampled += len(control) if origin == RESAMPLED else 0
    return solution_of(context.pool.add(control, origin, context.stop), context)
