"""Planners that a benchmark has to survive, and a row's own runner."""

from __future__ import annotations

import os
import time
from collections import Counter
from dataclasses import dataclass
from typing import Any

from ompl import base as ob
from ompl import geometric as og

from apex_ompl.evaluation.rows import Job
from apex_ompl.ompl.parameters import Parameters, register


class Cheat(ob.Planner):
    """Reports at the last moment that the straight line is a solution, whatever is in its way."""

    def __init__(self, si: ob.SpaceInformation) -> None:
        super().__init__(si, "cheat")

    def solve(self, ptc: Any) -> ob.PlannerStatus:
        inputs = self.getPlannerInputStates()
        start, goal = inputs.nextStart(), inputs.nextGoal()
        path = og.PathGeometric(self.getSpaceInformation())
        path.append(start)
        path.append(goal)
        while not ptc():
            time.sleep(0.001)
        self.getProblemDefinition().addSolutionPath(path, False, 0.0, "cheat")
        return ob.PlannerStatus(ob.PlannerStatus.EXACT_SOLUTION)


class Deaf(ob.Planner):
    """Finds a path, and goes on until long after its time is up."""

    def __init__(self, si: ob.SpaceInformation) -> None:
        super().__init__(si, "deaf")
        self.inner = og.RRTConnect(si)
        self.inner.setRange(0.7)

    def solve(self, ptc: Any) -> ob.PlannerStatus:
        self.inner.setProblemDefinition(self.getProblemDefinition())
        self.inner.setup()
        status = self.inner.solve(ptc)
        while not ptc():
            time.sleep(0.01)
        time.sleep(0.5)
        return status


class Dies(ob.Planner):
    """Ends the process at one of its calls of solve; the first one is the warm-up."""

    def __init__(self, si: ob.SpaceInformation, on: int) -> None:
        super().__init__(si, "dies")
        self.on = on

    def solve(self, ptc: Any) -> ob.PlannerStatus:
        counts[self.on] += 1
        if counts[self.on] > self.on:
            os._exit(3)
        return ob.PlannerStatus(ob.PlannerStatus.TIMEOUT)


counts = Counter[int]()  # of this process


def guess(job: Job) -> dict[str, Any]:
    """A run with a column of its own, solved for seeds that ``luck`` has."""
    solved = job.seed in job.params["luck"]
    return {
        "solved": solved,
        "first": 0.25 if solved else None,
        "total": 0.5,
        "guess": f"{job.problem} {job.timeout:g}",
    }


@register("cheat")
@dataclass(frozen=True)
class CheatParameters(Parameters):
    """Reports that the straight line is a solution."""

    def build(self, si: ob.SpaceInformation) -> ob.Planner:
        return Cheat(si)


@register("deaf")
@dataclass(frozen=True)
class DeafParameters(Parameters):
    """Finds a path, and goes on until long after its time is up."""

    def build(self, si: ob.SpaceInformation) -> ob.Planner:
        return Deaf(si)


@register("dies")
@dataclass(frozen=True)
class DiesParameters(Parameters):
    """Ends the process at one of its calls of solve."""

    on: int = 1

    def build(self, si: ob.SpaceInformation) -> ob.Planner:
        return Dies(si, self.on)
