"""OMPL's constrained state spaces with RRTConnect, from Python, on problems with constraints.

The space is ``projected``, ``atlas`` or ``tangent_bundle`` (Kingston, Moll and Kavraki 2019). Residuals and Jacobians,
and in the projected space the projection, are one call each of this project's compiled code; states are checked by its
collision checker, and against the limits. Only the joints of the arms are planned. In the projected space inequalities
are a residual that is 0 inside of their dead zone; atlas and tangent bundle need equations, so that there the axes of
cups stay where the inequality is furthest from its bound.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from ompl import base as ob
from ompl import geometric as og

from apex_ompl.constraints.constraint_set import ConstraintSet
from apex_ompl.errors import ParameterError
from apex_ompl.evaluation.rows import Job
from apex_ompl.evaluation.runs import Run
from apex_ompl.kernel.constraints import ConstraintRows
from apex_ompl.ompl.setup import PlanningSetup, assemble
from apex_ompl.types import Array
from apex_ompl.util.clocks import timed
from benchmarks.planners.constrained_check import arm_joints, columns, problem_of

RUNNER = f"{__name__}:plan_with_ompl"
PROJECTED, ATLAS, TANGENT_BUNDLE = "projected", "atlas", "tangent_bundle"
SPACES = {
    PROJECTED: ob.ProjectedStateSpace, ATLAS: ob.AtlasStateSpace, TANGENT_BUNDLE: ob.TangentBundleStateSpace,
}  # fmt: skip


@dataclass(frozen=True)
class Settings:
    """Parameters of a space and of RRTConnect; those that are None keep OMPL's default.

    Attributes:
        delta: Step along the manifold [rad].
        stretch: Longest way along the manifold over the distance of its ends (OMPL's lambda).
        range: Longest motion of RRTConnect [rad]; by default the charts' radius, or OMPL's in the projected space.
        tolerance: Norm of the residual that counts as 0.
        compiled: Whether the projection is compiled, not OMPL's own.
        exploration: Share of samples of an atlas outside of its charts.
        epsilon: Largest distance of a chart from the manifold [rad].
        rho: Radius of a chart [rad].
        alpha: Largest angle between a chart and the manifold [rad].
        simplify: Share of the time limit that simplification may take.
    """

    delta: float = 0.05
    stretch: float = 2.0
    range: float | None = None
    tolerance: float = 1e-4
    compiled: bool = True
    exploration: float | None = None
    epsilon: float | None = None
    rho: float | None = None
    alpha: float | None = None
    simplify: float = 0.5


class Rows(ob.Constraint):
    """Rows of the kernel as a constraint of OMPL, on some of the planned joints.

    Groups with a dead zone are one row each, the norm beyond it, unless all are equations.
    """

    def __init__(
        self, constraints: ConstraintSet, joints: Array, start: Array, tolerance: float, *, equations: bool
    ) -> None:  # fmt: skip
        """Take the rows of constraints, with the joints that are not among ``joints`` as at the start.

        Raises:
            ParameterError: There are no compiled rows.
        """
        if constraints.rows is None or constraints.user:
            raise ParameterError("constraints", constraints.names, "compiled constraints alone")
        rows: ConstraintRows = constraints.rows
        ends = np.cumsum([0, *(group.rows for group in rows.groups)])
        self.spans = list(zip(ends[:-1].tolist(), ends[1:].tolist(), strict=True))
        self.slacks = [0.0 if equations else group.slack for group in rows.groups]
        count = sum(1 if slack else last - first for slack, (first, last) in zip(self.slacks, self.spans, strict=True))
        super().__init__(len(joints), count, tolerance)
        self.rows, self.joints, self.end = rows, joints, 0.5 * tolerance
        self._q = np.array(start, float)

    def state(self, x: Array) -> Array:
        """Return the state of all planned joints, shape (dof,), a buffer of this object."""
        self._q[self.joints] = x
        return self._q

    def function(self, x: Array, out: Array) -> None:
        """Write the residual at joints ``x``."""
        residual, _ = self.rows.residual(self.state(x))
        k = 0
        for slack, (first, last) in zip(self.slacks, self.spans, strict=True):
            if slack:
                out[k] = max(0.0, float(np.linalg.norm(residual[first:last])) - slack)
                k += 1
            else:
                out[k : k + last - first] = residual[first:last]
                k += last - first

    def jacobian(self, x: Array, out: Array) -> None:
        """Write the Jacobian at joints ``x``."""
        residual, jacobian = self.rows.residual(self.state(x))
        jacobian = jacobian[:, self.joints]
        k = 0
        for slack, (first, last) in zip(self.slacks, self.spans, strict=True):
            if slack:
                size = float(np.linalg.norm(residual[first:last]))
                out[k, :] = residual[first:last] @ jacobian[first:last] / size if size > slack else 0.0
                k += 1
            else:
                out[k : k + last - first, :] = jacobian[first:last]
                k += last - first


class ProjectedRows(Rows):
    """The same with the projection of compiled code."""

    def project(self, x: Array) -> bool:
        """Move joints ``x`` onto the constraint in place, and return whether they arrived."""
        moved, arrived = self.rows.project(self.state(x), self.end)
        x[:] = moved[0, self.joints]
        return bool(arrived[0])


def constrained_space(
    kind: str, constraint: Rows, low: Array, high: Array, settings: Settings
) -> tuple[Any, ob.SpaceInformation]:
    """Return a constrained space of a kind with its space information, between limits of its joints, shape (n,)."""
    ambient, bounds = ob.RealVectorStateSpace(len(low)), ob.RealVectorBounds(len(low))
    for k, (lower, upper) in enumerate(zip(low.tolist(), high.tolist(), strict=True)):
        bounds.setLow(k, lower)
        bounds.setHigh(k, upper)
    ambient.setBounds(bounds)
    space = SPACES[kind](ambient, constraint)
    information = (ob.TangentBundleSpaceInformation if kind == TANGENT_BUNDLE else ob.ConstrainedSpaceInformation)(
        space
    )
    space.setup()
    space.setDelta(settings.delta)
    space.setLambda(settings.stretch)
    if kind != PROJECTED:
        for name in ("exploration", "epsilon", "rho", "alpha"):
            value = getattr(settings, name)
            if value is not None:
                getattr(space, f"set{name.capitalize()}")(value)
    return space, information


def plan_with_ompl(job: Job) -> Run:
    """Return the columns of a run; the planner of the job is the kind of the space, its parameters are ``Settings``."""
    settings = Settings(**job.params)
    ready = assemble(problem_of(job), seed=job.seed)
    constraints = ConstraintSet.of(ready.robot, ready.problem.constraints, ready.problem.attached, ready.start)
    joints = arm_joints(ready)
    made = ProjectedRows if job.planner == PROJECTED and settings.compiled else Rows
    constraint = made(constraints, joints, ready.start, settings.tolerance, equations=job.planner != PROJECTED)
    limits = ready.robot.limits
    low, high = limits.lower[joints], limits.upper[joints]
    space, information = constrained_space(job.planner, constraint, low, high, settings)
    state = ready.start.copy()
    count = range(len(joints))

    def is_valid(one: ob.State) -> bool:
        x = np.array([one[k] for k in count])
        if not ((x >= low) & (x <= high)).all():
            return False
        state[joints] = x
        return bool(ready.checker.is_free(state))

    simple = og.SimpleSetup(information)
    simple.setStateValidityChecker(is_valid)
    ends = [space.allocState(), space.allocState()]
    for one, q in zip(ends, (ready.start, ready.goals[0]), strict=True):
        one.copy(q[joints].tolist())
        if job.planner != PROJECTED:
            space.anchorChart(one)
    simple.setStartAndGoalStates(*ends)
    planner = og.RRTConnect(information)
    if settings.range is not None or job.planner != PROJECTED:
        planner.setRange(settings.range if settings.range is not None else space.getRho_s())
    simple.setPlanner(planner)
    simple.setup()
    return _solved(job, settings.simplify, ready, constraints, simple)


def _solved(
    job: Job, share: float, ready: PlanningSetup, constraints: ConstraintSet, simple: og.SimpleSetup
) -> Run:  # fmt: skip
    times: dict[str, float] = {}
    until = time.perf_counter() + job.timeout
    with timed(times, "solve"):
        status = simple.solve(ob.PlannerTerminationCondition(lambda: time.perf_counter() > until)).getStatus()
    if status != ob.PlannerStatus.PlannerStatusType.EXACT_SOLUTION:
        return columns(ready, constraints, (), times, limit=job.timeout, reason=str(status.name))
    paths = [_states(ready, simple)]
    left = min(until - time.perf_counter(), share * job.timeout)
    if left > 0.0:
        with timed(times, "simplify"):
            simple.simplifySolution(left)
        paths.insert(0, _states(ready, simple))
    return columns(ready, constraints, paths, times, limit=job.timeout)


def _states(ready: PlanningSetup, simple: og.SimpleSetup) -> Array:
    """Return the states of the path that was found, on the manifold ``delta`` apart, with exact ends."""
    joints = arm_joints(ready)
    path = og.PathGeometric(simple.getSolutionPath())
    path.interpolate()
    rows: Sequence[Sequence[float]] = [[one[k] for k in range(len(joints))] for one in path.getStates()]
    states = np.repeat(ready.start[None], len(rows), axis=0)
    states[:, joints] = rows
    states[0], states[-1] = ready.start, ready.goals[0]
    return states
