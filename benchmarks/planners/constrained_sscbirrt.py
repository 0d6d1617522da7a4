"""CBiRRT of the package sscbirrt (Berenson, Srinivasa and Kuffner 2011) on problems with constraints.

Its search runs in Python, since constraint, projection and collisions are those of this project: one call each of
compiled code. Start and goal are single states; only the joints of the arms are planned.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from sscbirrt import CBiRRT, CBiRRTConfig, FiniteSet, PlanningProblem

from apex_ompl.constraints.constraint_set import ConstraintSet
from apex_ompl.evaluation.rows import Job
from apex_ompl.evaluation.runs import Run
from apex_ompl.ompl.setup import PlanningSetup, assemble
from apex_ompl.types import Array
from apex_ompl.util.clocks import timed
from benchmarks.planners.constrained_check import arm_joints, columns, problem_of

PATIENCE = 10.0  # of the package's own clock, times the limit, which ``abort_fn`` keeps
RUNNER = f"{__name__}:plan_with_sscbirrt"


class Manifold:
    """Set of the arms' states that satisfy constraints, with its projection."""

    def __init__(self, constraints: ConstraintSet, joints: Array, start: Array) -> None:
        """Take the constraints; joints that are not among ``joints`` stay as at the start."""
        self._constraints, self._joints, self._q = constraints, joints, start.copy()

    def contains(self, q: Array) -> bool:
        """Whether a state is a member."""
        self._q[self._joints] = q
        return self._constraints.is_satisfied(self._q)

    def project(self, _: Array, proposed: Array) -> Array | None:
        """Return the member that a state is moved to, or None."""
        self._q[self._joints] = proposed
        moved, arrived = self._constraints.project(self._q[None])
        return np.array(moved[0, self._joints]) if arrived[0] else None


class Arms:
    """Limits and collisions of the arms, as the package asks for them."""

    def __init__(self, ready: PlanningSetup, joints: Array) -> None:
        """Take a problem that is ready to plan, and the joints to plan."""
        limits = ready.robot.limits
        self.joint_limits = limits.lower[joints], limits.upper[joints]
        self.dof = len(joints)
        self._checker, self._joints, self._q = ready.checker, joints, ready.start.copy()

    def forward_kinematics(self, q: Array) -> Array:
        """Not used: no set is a region of the tool."""
        raise NotImplementedError

    def is_valid(self, q: Array) -> bool:
        """Whether a state is free of collisions."""
        self._q[self._joints] = q
        return bool(self._checker.is_free(self._q))


def plan_with_sscbirrt(job: Job) -> Run:
    """Return the columns of a run; parameters of the job are those of ``CBiRRTConfig``."""
    ready = assemble(problem_of(job), seed=job.seed)
    constraints = ConstraintSet.of(ready.robot, ready.problem.constraints, ready.problem.attached, ready.start)
    joints = arm_joints(ready)
    arms = Arms(ready, joints)
    until = time.perf_counter() + job.timeout
    config = CBiRRTConfig(
        timeout=PATIENCE * job.timeout, max_iterations=2**31 - 1, abort_fn=lambda: time.perf_counter() > until,
        **{"smooth_path": False, **job.params},
    )  # fmt: skip
    planner = CBiRRT(arms, None, arms, config)
    start, goal = (FiniteSet([q[joints]], metric=planner.space.distance) for q in (ready.start, ready.goals[0]))
    manifold = Manifold(constraints, joints, ready.start)
    problem = PlanningProblem(planner.space, start, goal, arms, path_constraint=manifold)
    times: dict[str, float] = {}
    with timed(times, "solve"):
        found: Any = planner.solve(problem, seed=job.seed)
    if found.path is None:
        return columns(ready, constraints, (), times, limit=job.timeout, reason=str(found.failure_reason)[:80])
    states = np.repeat(ready.start[None], len(found.path), axis=0)
    states[:, joints] = np.array(found.path)
    states[0], states[-1] = ready.start, ready.goals[0]
    return columns(ready, constraints, [states], times, limit=job.timeout)
