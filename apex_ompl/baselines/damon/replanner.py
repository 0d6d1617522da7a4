"""Replanning over a graph on a learned manifold: DAMON."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from apex_ompl.baselines.damon.latent_graph import Damon
from apex_ompl.baselines.damon.lazy_search import Motion
from apex_ompl.baselines.damon.manifold import shared_manifold
from apex_ompl.baselines.damon.planner import DAMONParameters
from apex_ompl.baselines.drrt.replanner import Clearances, timed
from apex_ompl.moving.compute_costs import ComputeBudget
from apex_ompl.moving.context import RunContext
from apex_ompl.moving.replanner import FROM_REST, Answer, Request, register
from apex_ompl.moving.search import Search
from apex_ompl.types import Array, Flags

PLANNER = "damon"


@dataclass(eq=False)
class DamonReplanner:
    """The planner ``damon`` in the loop: :class:`~apex_ompl.baselines.damon.latent_graph.Damon` with its defaults.

    Nodes are checked for static obstacles before a run, edges when they are first used in it. At each replan, nodes
    that an obstacle hits at its place when the new motion starts are left out, and A* finds a path over the others. It
    is shortened between its nodes, timed, and proved among the predicted obstacles.

    It plans from rest: it returns nothing while the robot will be moving at the time of joining.

    Attributes:
        damon: The graph, from :meth:`prepare` on.
    """

    damon: Damon | None = None
    _usable: dict[bytes, Flags] = field(default_factory=dict, repr=False)
    _clear_of_static: dict[bytes, bool] = field(default_factory=dict, repr=False)
    _blocked: set[Motion] = field(default_factory=set, repr=False)
    _start: bytes = b""

    def prepare(self, context: RunContext) -> None:
        """Load the graph, and find the nodes that are free of static obstacles.

        Raises:
            MissingFileError: The model is missing.
            FileFormatError: The model is damaged, or for another robot.
        """
        values = DAMONParameters()
        robot = context.setup.robot
        manifold = shared_manifold(values.model, robot.name)
        self.damon = Damon.of(manifold, robot, values.nodes, values.connections)
        self._usable.clear()
        self._clear_of_static.clear()
        self._blocked.clear()
        self._free_of_static(context, self.damon.states(context.setup.start), ComputeBudget(np.inf))

    def replan(self, context: RunContext, request: Request, budget: ComputeBudget) -> Answer:
        """Return a motion from rest along a path of the graph, or none."""
        if not request.following.at_rest(request.join) or not len(context.goals):
            return Answer(None, "", budget)
        if self.damon is None:
            self.prepare(context)
        assert self.damon is not None
        search = Search(context, request, budget)
        clear, start = Clearances(search), search.start.position
        states = self.damon.states(start)
        usable = self._free_of_static(context, states, budget).copy()
        usable[usable] = clear.of_dynamic(states[usable])
        paths = self.damon.search(states, usable, start[None], context.goals)
        budget.spend("query of a graph")
        connect, blocked = paths.more, self._blocked_from(start)
        for one in blocked:
            paths.block(one)

        def free(first: Array, last: Array) -> Flags:
            found = self._is_free(clear, first[0], last[0])
            if self._clear_of_static.get(first.tobytes() + last.tobytes()) is False:
                blocked.add(paths.motion)
            return np.array([found])

        def more() -> bool:
            budget.spend("query of a graph")
            return connect()

        paths.more = more
        path = paths.run(free, budget.over, lambda reached: budget.spend("node of a graph", reached))
        motion = None if path is None else timed(search, path, clear)
        if motion is None or not context.clear_of_static(motion, budget):
            return Answer(None, "", budget)
        return Answer(search.following(motion) if search.accepts(motion) else None, "graph", budget)

    def _blocked_from(self, start: Array) -> set[Motion]:
        """Return the motions that static obstacles are known to block; those from other starts are forgotten."""
        key = start.tobytes()
        if key != self._start:
            self._start, self._blocked = key, {one for one in self._blocked if one[0] != "start"}
        return self._blocked

    def _is_free(self, clear: Clearances, first: Array, last: Array) -> bool:
        """Whether a straight motion is clear after its first state; static obstacles are checked once."""
        key = first.tobytes() + last.tobytes()
        if not self._clear_of_static.get(key, True) or not clear.edges_of_dynamic(first[None], last[None])[0]:
            return False
        if key not in self._clear_of_static:
            self._clear_of_static[key] = clear.search.context.line_is_clear(first, last, clear.search.budget)
        return self._clear_of_static[key]

    def _free_of_static(self, context: RunContext, states: Array, budget: ComputeBudget) -> Flags:
        """Return which nodes are inside the limits, and free of static obstacles and of the robot, shape (N,)."""
        key = states[0, context.fingers].tobytes()  # the other joints of nodes are always the same
        if key not in self._usable:
            limits = context.setup.robot.limits
            inside: Flags = np.all((states >= limits.lower) & (states <= limits.upper), axis=1)
            inside[inside] = context.checker.are_free(states[inside])
            budget.spend("near clearance", len(states))
            self._usable[key] = inside
        return self._usable[key]


register(
    "damon", DamonReplanner, "DAMON: stops where the way is blocked; A* over a graph on a learned manifold", FROM_REST
)
