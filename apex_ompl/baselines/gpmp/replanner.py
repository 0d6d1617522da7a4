"""Replanning on a Gaussian-process prior: GPMP and GPMP2 from the state that the robot will have."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from apex_ompl.baselines.gpmp.gaussian_process import GaussianProcess
from apex_ompl.baselines.gpmp.optimizer import Factors
from apex_ompl.baselines.gpmp.planner import GPMP, GPMP2, GaussianProcessParameters
from apex_ompl.kernel.path import clearance_costs
from apex_ompl.moving.compute_costs import ComputeBudget
from apex_ompl.moving.context import RunContext
from apex_ompl.moving.motion_optimizer import InitialMotion, shortest_duration
from apex_ompl.moving.replanner import ONE_PLAN, Answer, Request, register
from apex_ompl.moving.search import STATES, Search, rest_of_route
from apex_ompl.timing import Trajectory
from apex_ompl.timing.spline_method import least_knot_spacing
from apex_ompl.timing.timed_spline import PINNED, Start, TimedSpline
from apex_ompl.types import Array

WORK = "state of a factor graph"
KNOT_SPACING = 0.08  # aimed at [s]
SLOWER = 1.01  # factor on the duration that the limits require of a motion that exceeds them


@dataclass(eq=False)
class IncrementalGPMP2:
    """GPMP2 at each replan, warm-started from the last motion, as iGPMP2 does (Mukadam et al., IJRR 2018).

    The first support is the state that the robot will have when the new motion starts, with its velocity; the last one
    is a goal, at rest. Levenberg-Marquardt steps start at the remaining motion to a goal, and then at straight lines to
    the nearest goals. Clearances to dynamic obstacles are those at the time of each state.

    Left open by the papers, or done otherwise: iGPMP2 updates one Bayes tree (iSAM2); here the few steps of a replan
    solve the whole block-tridiagonal system, which is small. Its duration is fixed; here it is that of the initial
    motion without obstacles, times each of ``factors``, and longer where limits require it, with obstacles at the new
    times then. Its states have no acceleration; the robot follows the cubic B-spline in time whose control points are
    states of the solution: it starts in the robot's state, keeps the limits, and is proved. The prior's power is that
    of the planner ``gpmp2`` over the duration cubed.

    Attributes:
        parameters: Parameters of the planner.
        factors: Durations that are tried, as multiples of the shortest one without obstacles.
        rounds: Largest number of rounds, between which a motion gets more time.
        goals: Number of goals of straight lines.
    """

    parameters: GaussianProcessParameters = GPMP2(intervals=10, checked=4, iterations=8, tolerance=1e-2)
    factors: tuple[float, ...] = (1.1, 1.8)
    rounds: int = 4
    goals: int = 2

    def prepare(self, context: RunContext) -> None:
        """Load or compile what it needs."""
        clearance_costs(context.kernel, context.setup.start, 0.01, 0.01)

    def replan(self, context: RunContext, request: Request, budget: ComputeBudget) -> Answer:
        """Return the first motion that is proved among the predicted obstacles, or none."""
        search = Search(context, request, budget)
        for part, initial in self.initial_motions(search):
            for factor in self.factors:
                if budget.over():
                    return Answer(None, "", budget)
                motion = self.motion(search, initial, factor * initial.duration)
                if motion is not None:
                    return Answer(search.following(motion), part, budget)
        return Answer(None, "", budget)

    def initial_motions(self, search: Search) -> Iterator[tuple[str, InitialMotion]]:
        """Yield initial motions, and their names."""
        limits, rest = search.context.limits, rest_of_route(search)
        if rest is not None:
            yield "route", InitialMotion(rest, rest[-1], shortest_duration(rest, limits))
        for goal in search.goals[: self.goals]:
            line = np.linspace(search.start.position, goal, STATES)
            yield "line", InitialMotion(line, goal, shortest_duration(line, limits))

    def motion(self, search: Search, initial: InitialMotion, duration: float) -> Trajectory | None:
        """Return a proved motion of about a duration [s], or a longer one where limits require it, or None."""
        supports, limits = self.supports(search, initial, duration), search.context.limits
        for _ in range(self.rounds):
            problem = self.problem(search, duration)
            best = self.parameters.optimum(problem, supports, search.budget.over)
            search.budget.spend(WORK, best.evaluations * len(problem.times))
            search.budget.spend("straight motion")
            spline = spline_of(problem, best.supports, search.start)
            slower = least_knot_spacing(spline.control, limits) / spline.spacing
            if slower > 1.0:
                spline = spline.lasting(SLOWER * slower * spline.spacing)
            if least_knot_spacing(spline.control, limits) <= spline.spacing:
                motion = spline.trajectory(search.context.names)
                if search.accepts(motion):
                    return motion
            if slower <= SLOWER or search.budget.over():
                return None
            supports = best.supports.copy()
            supports[1:-1, 1] /= slower
            duration *= slower
        return None

    def supports(self, search: Search, initial: InitialMotion, duration: float) -> Array:
        """Return the supports of an initial motion, shape (N + 1, 2, dof)."""
        count = self.parameters.intervals + 1
        wanted, at = np.linspace(0.0, len(initial.states) - 1.0, count), np.arange(len(initial.states))
        positions = np.stack([np.interp(wanted, at, column) for column in initial.states.T], axis=1)
        positions[0], positions[-1] = search.start.position, initial.goal
        velocities = np.gradient(positions, duration / (count - 1), axis=0)
        velocities[0], velocities[-1] = search.start.velocity, 0.0
        return np.stack([positions, velocities], axis=1)

    def problem(self, search: Search, duration: float) -> Factors:
        """Return what is optimized for motions of a duration [s]."""
        p, request, limits = self.parameters, search.request, search.context.limits
        process = GaussianProcess(p.intervals, duration, p.power / duration**3)
        return p.problem(
            process, search.context.kernel, limits.lower, limits.upper, start_time=request.join,
            dynamic=request.predicted.packed,
        )  # fmt: skip


@dataclass(eq=False)
class IncrementalGPMP(IncrementalGPMP2):
    """GPMP in the same way: steps along the functional gradient, up to the first motion that is clear at its states.

    The paper (Mukadam, Yan and Boots, ICRA 2016) plans once; the warm start from the moving robot is that of
    :class:`IncrementalGPMP2`. With 10, 20 or 40 iterations, and tolerances of 1e-3 or 1e-2, it fails in 2 of 16
    validation worlds.
    """

    parameters: GPMP = GPMP(intervals=10, checked=4, iterations=20, tolerance=1e-3)


def spline_of(problem: Factors, supports: Array, start: Start) -> TimedSpline:
    """Return the cubic B-spline in time near a motion, from a given state to rest at its end.

    Its control points are states of the motion. The end, and a start at rest, take a knot spacing longer.
    """
    count = max(round(problem.process.spacing / KNOT_SPACING), 1)
    states = problem.process.states(supports, count)[:, 0]
    moving = bool(start.velocity.any() or start.acceleration.any())
    ends = np.repeat(states[:1], 1 if moving else 2, axis=0), np.repeat(states[-1:], 2, axis=0)
    control = np.clip(np.concatenate([ends[0], states, ends[1]]), problem.lower, problem.upper)
    control[-PINNED:] = supports[-1, 0]
    spacing = problem.process.spacing / count
    return TimedSpline(control, spacing, start).lasting(spacing)


register("gpmp2", IncrementalGPMP2, "GPMP2 from the moving robot, warm from the last motion (as iGPMP2)", ONE_PLAN)
register("gpmp", IncrementalGPMP, "GPMP from the moving robot: steps along the functional gradient", ONE_PLAN)
