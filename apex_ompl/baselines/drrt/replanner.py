"""Replanning with a kept tree: dynamic RRT."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from apex_ompl.baselines.drrt.dynamic_rrt import DynamicRRT, GoalTree
from apex_ompl.moving.compute_costs import ComputeBudget, cost_table
from apex_ompl.moving.context import RunContext
from apex_ompl.moving.dynamic_obstacles import clearance_in_time
from apex_ompl.moving.replanner import FROM_REST, Answer, Request, register
from apex_ompl.moving.search import Search
from apex_ompl.paths.path import SEARCH_RESOLUTION, states_between
from apex_ompl.timing import Timing, Trajectory, time_path
from apex_ompl.types import Array, Flags

DEEP = 0.03  # overlap of spheres beyond which a state counts as in contact without a check by exact shapes [m]
DEVIATION = 0.02  # of the motion from the path [rad]
SEEN = 0.01  # largest clearance that is computed [m]


@dataclass(eq=False)
class DynamicRRTReplanner:
    """The planner ``drrt`` in the loop: :class:`apex_ompl.baselines.drrt.dynamic_rrt.DynamicRRT`, kept over a run.

    At each replan, nodes whose edges meet an obstacle at its place when the new motion starts are removed with their
    descendants, and the tree grows until it reaches the robot. Its path is shortened between its nodes, timed, and
    proved among the predicted obstacles.

    It plans from rest: it returns nothing while the robot will be moving at the time of joining. Two sets of parameters
    were tried in 5 to 20 worlds of each of the kinds ``moving``, ``popup`` and ``interceptor`` of the validation split.
    Longer steps, which are better among static obstacles, are no better here: at a quarter of the velocity limits, runs
    with steps of 0.3, 0.7 and 1.4 rad fail in 7, 9 and 8 of the same 23 worlds ``moving``. Proved as if obstacles were
    at rest, its motions reach a goal in 10 of 24 other worlds; among predicted obstacles, in 9.

    Attributes:
        search: The tree, and how it grows.
    """

    search: DynamicRRT = field(default_factory=lambda: DynamicRRT(step=0.3, to_start=0.2, to_waypoint=0.3, most=600))

    def prepare(self, context: RunContext) -> None:
        """Forget earlier runs."""
        self.search.forget()

    def replan(self, context: RunContext, request: Request, budget: ComputeBudget) -> Answer:
        """Return a motion from rest along a path of the tree, or none."""
        if not request.following.at_rest(request.join) or not len(context.goals):
            return Answer(None, "", budget)
        search = Search(context, request, budget)
        tree, clear = self.search.rooted_at(context.goals), Clearances(search)
        tree.trim(clear.edges_of_dynamic)
        path = self._grown(search, tree, clear)
        motion = None if path is None else timed(search, path, clear)
        if motion is None:
            return Answer(None, "", budget)
        if not context.clear_of_static(motion, budget):
            self.prepare(context)
            return Answer(None, "the path of the tree is not proved", budget)
        return Answer(search.following(motion) if search.accepts(motion) else None, "tree", budget)

    def _grown(self, search: Search, tree: GoalTree, clear: Clearances) -> Array | None:
        """Grow the tree until it has the robot's state; return its path, or None where the time is up."""
        start, rng, robot = search.start.position, search.rng, search.context.setup.robot
        fingers, (lower, upper) = search.context.fingers, robot.range_around(start, turns=1.0)

        def sample() -> Array:
            q = rng.uniform(lower, upper)
            q[fingers] = start[fingers]
            search.budget.spend("extension of a tree")
            return q

        return self.search.grow(tree, start[None], sample, rng=rng, free=clear.edges, stop=search.budget.over)


def timed(search: Search, path: Array, clear: Clearances) -> Trajectory | None:
    """Return the motion along the shortened path, or None where the budget is used up."""
    short, budget = shortened(path, clear), search.budget
    kind = "straight motion" if len(short) == 2 else "path in time"
    if budget.spent + cost_table()["seconds"][kind] > budget.limit:
        return None
    budget.spend(kind)
    context, timing = search.context, Timing(deviation=DEVIATION)
    return time_path(short, context.limits, context.names, timing, motion_limits=context.torques).trajectory


@dataclass(frozen=True, eq=False)
class Clearances:
    """Collision checks of states: static obstacles, self-collision, and dynamic obstacles at the time of joining.

    Attributes:
        search: The replan.
    """

    search: Search

    def __call__(self, states: Array) -> Flags:
        """Return whether each state, shape (N, dof), passes all checks."""
        clear = self.of_dynamic(states)
        clear[clear] = self.of_static(states[clear])
        return clear

    def of_static(self, states: Array) -> Flags:
        """Return whether each state, shape (N, dof), is clear of static obstacles and self-collision."""
        context = self.search.context
        own = context.kernel.clearance(states, SEEN).min(axis=1)
        self.search.budget.spend("near clearance", len(states))
        clear: Flags = own > 0.0
        close = np.flatnonzero(~clear & (own > -DEEP))
        clear[close] = context.checker.are_free(states[close])
        self.search.budget.spend("exact proof", len(close))
        return clear

    def edges(self, first: Array, last: Array) -> Flags:
        """Return whether straight motions, between states of shape (N, dof), are clear after their first state."""
        return self._along(first, last, self)

    def line(self, first: Array, last: Array) -> bool:
        """Whether a straight motion is proved clear of static obstacles, and in steps clear of dynamic ones."""
        seen = self.edges_of_dynamic(first[None], last[None])[0]
        return bool(seen) and self.search.context.line_is_clear(first, last, self.search.budget)

    def edges_of_dynamic(self, first: Array, last: Array) -> Flags:
        """Return whether straight motions are clear of dynamic obstacles at joining, after their first state."""
        return self._along(first, last, self.of_dynamic)

    def _along(self, first: Array, last: Array, clear: Callable[[Array], Flags]) -> Flags:
        if not len(first):
            return np.ones(0, bool)
        pieces = [
            np.concatenate([states_between(a, b, SEARCH_RESOLUTION), b[None]]) for a, b in zip(first, last, strict=True)
        ]
        firsts = np.cumsum([0] + [len(piece) for piece in pieces[:-1]])
        return np.asarray(np.logical_and.reduceat(clear(np.concatenate(pieces)), firsts))

    def of_dynamic(self, states: Array) -> Flags:
        """Return whether each state, shape (N, dof), is clear of dynamic obstacles at the time of joining."""
        context, request = self.search.context, self.search.request
        times = np.full(len(states), request.join)
        clear: Flags = clearance_in_time(context.kernel, request.predicted, states, times, SEEN)[0] > 0.0
        self.search.budget.spend("near clearance in time", len(states))
        return clear


def shortened(path: Array, clear: Clearances) -> Array:
    """Return a path with shortcuts: from each state a clear straight line to the farthest one that bisection finds."""
    found, at = [path[0]], 0
    while at < len(path) - 1:
        low, high, tried = at + 1, len(path), len(path) - 1
        while high - low > 1 and not clear.search.budget.over():
            good = clear.line(path[at], path[tried])
            low, high = (tried, high) if good else (low, tried)
            tried = (low + high) // 2
        at = low
        found.append(path[at])
    return np.stack(found)


register(
    "drrt", DynamicRRTReplanner, "dynamic RRT: stops where the way is blocked; a tree from the goal, kept and repaired",
    FROM_REST,
)  # fmt: skip
