"""Replanning with a tree that is kept: dynamic RRT."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apex_ompl.live.movers import clearance_in_time
from apex_ompl.loop.charges import Charges, cost_table
from apex_ompl.loop.goal_tree import GoalTree
from apex_ompl.loop.ready import Ready
from apex_ompl.loop.request import Answer, Request
from apex_ompl.loop.search import Search
from apex_ompl.trajectory import Timing, Trajectory, time_path
from apex_ompl.types import Array
from apex_ompl.util.resolution import SEARCH_RESOLUTION

DEEP = 0.03  # overlap of spheres beyond which a state counts as in contact without a look at exact shapes [m]
DEVIATION = 0.02  # of the motion from the path [rad]
SEEN = 0.01  # clearances beyond this are not told apart [m]


@dataclass(eq=False)
class DynamicRRT:
    """Dynamic RRT (Ferguson, Kalra and Stentz 2006, "Replanning with RRTs").

    A tree rooted at the goals is kept over the run. At each replan, nodes whose edges meet an obstacle where it stands
    when the new motion begins are removed with all behind them, and the tree grows until it reaches the robot: towards
    the robot's state, towards states of the path that it had, or towards random ones. Its path is made shorter between
    its nodes, timed, and proved among the obstacles as they are predicted.

    It plans from rest: while the robot will be moving at the time of joining it answers nothing. Two sets
    of parameters were tried in 5 to 20 worlds of each of the kinds ``moving``, ``popup`` and ``interceptor`` of the
    validation split.

    Attributes:
        step: Largest length of an edge [rad, max-norm].
        to_robot: Share of the extensions towards the robot.
        to_waypoint: Share of those towards states of the last path.
        most: Number of nodes from which on the tree begins anew.
    """

    step: float = 0.3
    to_robot: float = 0.2
    to_waypoint: float = 0.3
    most: int = 600
    tree: GoalTree | None = None
    waypoints: Array | None = None

    def prepare(self, ready: Ready) -> None:
        """Forget earlier runs."""
        self.tree, self.waypoints = None, None

    def replan(self, ready: Ready, request: Request, charges: Charges) -> Answer:
        """Return a motion from rest along a path of the tree, or none."""
        if not request.following.at_rest(request.join) or not len(ready.goals):
            return Answer(None, "", charges)
        search = Search(ready, request, charges)
        if self.tree is None or self.tree.full:
            self.tree = GoalTree(ready.goals, self.step, SEARCH_RESOLUTION, self.most)
        clear = Clearances(search)
        self.tree.trim(clear.of_movers)
        node = self._grow(search, self.tree, clear)
        motion = None if node < 0 else self._timed(search, self.tree.path(node), clear)
        if motion is None:
            return Answer(None, "", charges)
        if not ready.clear_of_still(motion, charges):
            self.prepare(ready)
            return Answer(None, "the path of the tree is not proved", charges)
        return Answer(search.following(motion) if search.accepts(motion) else None, "tree", charges)

    def _grow(self, search: Search, tree: GoalTree, clear: Clearances) -> int:
        """Grow the tree until it has the robot's state; return the number of its node, or -1 where time is up."""
        start, rng, robot = search.start.position, search.rng, search.ready.setup.robot.limits
        node = tree.at(start)
        while node < 0 and not search.charges.over() and not tree.full:
            kind, q = rng.random(), rng.uniform(robot.lower, robot.upper)
            if kind < self.to_robot:
                q = start
            elif kind < self.to_robot + self.to_waypoint and self.waypoints is not None:
                q = self.waypoints[rng.integers(len(self.waypoints))]
            q = q.copy()
            q[search.ready.fingers] = start[search.ready.fingers]
            grown = tree.extend(tree.nearest(q), q, clear)
            search.charges.charge("extension of a tree")
            if grown >= 0 and np.abs(tree.states[grown] - start).max() <= self.step:
                node = tree.at(start) if np.array_equal(tree.states[grown], start) else tree.extend(grown, start, clear)
        return node

    def _timed(self, search: Search, path: Array, clear: Clearances) -> Trajectory | None:
        """Return the motion along a path made shorter, or None where there is no time for it any more."""
        self.waypoints = path
        short, charges = shortened(path, clear), search.charges
        kind = "straight motion" if len(short) == 2 else "path in time"
        if charges.spent + cost_table()["seconds"][kind] > charges.limit:
            return None
        charges.charge(kind)
        return time_path(short, search.ready.limits, search.ready.names, Timing(deviation=DEVIATION)).trajectory


@dataclass(frozen=True, eq=False)
class Clearances:
    """Which states are clear of what stands still, of the robot itself, and of obstacles where they are at joining.

    Attributes:
        search: The replan.
    """

    search: Search

    def __call__(self, states: Array) -> NDArray[np.bool_]:
        """Return whether each state, shape (N, dof), is clear of all."""
        clear, ready = self.of_movers(states), self.search.ready
        left = np.flatnonzero(clear)
        own = ready.kernel.clearance(states[left], SEEN).min(axis=1)
        self.search.charges.charge("near clearance", len(left))
        clear[left] = own > 0.0
        close = left[(own <= 0.0) & (own > -DEEP)]
        clear[close] = ready.checker.are_free(states[close])
        self.search.charges.charge("exact proof", len(close))
        return clear

    def of_movers(self, states: Array) -> NDArray[np.bool_]:
        """Return whether each state, shape (N, dof), is clear of obstacles where they are at joining."""
        ready, request = self.search.ready, self.search.request
        times = np.full(len(states), request.join)
        clear: NDArray[np.bool_] = clearance_in_time(ready.kernel, request.predicted, states, times, SEEN)[0] > 0.0
        self.search.charges.charge("near clearance in time", len(states))
        return clear


def shortened(path: Array, clear: Clearances) -> Array:
    """Return a path without the states that clear straight lines pass by, each as far along as bisection finds one."""
    found, at = [path[0]], 0
    while at < len(path) - 1:
        low, high, tried = at + 1, len(path), len(path) - 1
        while high - low > 1 and not clear.search.charges.over():
            way = path[tried] - path[at]
            count = int(np.ceil(np.abs(way).max() / SEARCH_RESOLUTION)) + 1
            good = clear(path[at] + np.linspace(0.0, 1.0, count)[1:-1, None] * way).all()
            low, high = (tried, high) if good else (low, tried)
            tried = (low + high) // 2
        at = low
        found.append(path[at])
    return np.stack(found)
