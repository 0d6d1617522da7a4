"""DAMON: A* over a graph on a learned manifold of states, without the nodes that obstacles hit."""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

import numpy as np
from ompl import base as ob

from apex_ompl.apex.path_validator import PathValidator
from apex_ompl.baselines.damon.latent_graph import Damon
from apex_ompl.baselines.damon.manifold import shared_manifold
from apex_ompl.kernel import Kernel
from apex_ompl.ompl.own_planner import OwnPlanner
from apex_ompl.ompl.parameters import Parameters, bounded, one_of, register
from apex_ompl.ompl.space import motions_free
from apex_ompl.ompl.tuned import TUNED
from apex_ompl.paths.path import Path
from apex_ompl.types import Array, Flags

NAME = "damon"
Status = ob.PlannerStatus
DEEP = 0.03  # overlap of spheres beyond which a node counts as in contact without a check by exact shapes [m]
SEEN = 0.001  # largest clearance that is computed [m]


class DAMON(OwnPlanner):
    """OMPL planner: :class:`apex_ompl.baselines.damon.latent_graph.Damon` by the validators of the space information.

    Every motion of a path is checked by the motion validator; nothing is random. The graph is finite, so that ``solve``
    may end before its time without a path. In the closed loop it is the method ``damon``.

    Attributes:
        damon: The graph, and queries of it.
        validator: Decides what is valid.
        report: What the last call of ``solve`` did.
    """

    def __init__(self, si: ob.SpaceInformation, validator: PathValidator, damon: Damon) -> None:
        """Plan in the space of ``si``, where ``validator`` decides what is valid."""
        super().__init__(si, NAME)
        self.damon, self.validator = damon, validator
        self._hit = dict[bytes, tuple[Kernel, tuple[Flags, Flags]]]()

    def clear(self) -> None:
        """Forget which nodes obstacles hit."""
        super().clear()
        self._hit.clear()

    def _solve(self, ptc: ob.PlannerTerminationCondition) -> Any:
        before, self.validator = self.validator, self.validator.current()
        if self.validator is not before:
            self._hit.clear()
        started = time.perf_counter()
        starts, goals, status = self._ends(ptc)
        if status is not None:
            return status
        with self.report.timed("nodes"):
            states = self.damon.states(starts[0])
            usable, free_nodes = self._nodes(states)
        ends = np.stack(starts), np.stack(goals)
        search = self.damon.search(states, usable, *ends, free_nodes=free_nodes)
        with self.report.timed("search"):
            free = partial(motions_free, self.getSpaceInformation())
            path = search.run(free, lambda: bool(ptc()), nodes_free=self.validator.are_free)
        self.report.candidates = search.searches
        if path is None:
            used = f"{int(usable.sum())} of {len(usable)} nodes"
            self.report.reason = f"no path over {used} by {search.searches} searches"
            self.report.reason += " in the time given" if ptc() else ", and none is left"
            return Status.TIMEOUT
        self.report.solved_by = NAME
        self.report.add_solution(self, Path(path), time.perf_counter() - started)
        return Status.EXACT_SOLUTION

    def _nodes(self, states: Array) -> tuple[Flags, Flags]:
        """Return which nodes may be used, and which of them are free for sure, each of shape (N,).

        By the sphere cover, which proves the second where no other checker has a say. Of nodes that it does not prove
        free, those deep in contact are not used; the others are checked when a path uses them. The same until the scene
        changes.
        """
        checker = self.validator.checker
        box, key = self.getSpaceInformation().getStateSpace().getBounds(), states[0].tobytes()
        kernel, known = self._hit.get(key, (None, None))
        if known is None or kernel is not checker.kernel:
            kernel = checker.kernel
            inside = np.all((states >= np.array(box.low)) & (states <= np.array(box.high)), axis=1)
            free = inside & (kernel.unproved(states)[1] == 0)
            left = np.flatnonzero(inside & ~free)
            usable = free.copy()
            usable[left] = kernel.clearance(states[left], SEEN).min(axis=1) > -DEEP
            known = usable, free if self.validator.exclusive else np.zeros_like(free)
            self._hit[key] = kernel, known
        return known


@register(NAME)
@dataclass(frozen=True)
class DAMONParameters(Parameters):
    """DAMON (arXiv 2203.13282): A* over a graph on a learned manifold of states, reimplemented.

    Manifold and number of connections are what ``python -m benchmarks.planners.tune --baselines`` chose on the
    validation split.

    Attributes:
        model: Name of a folder of the tree's ``benchmarks/baselines``, or a path; it has the dimension of the manifold.
        nodes: ``decoded``, nodes are what the decoder makes of their latent vectors, as the paper has it, or
            ``stored``, the states that these were encoded from.
        connections: Number of nodes over which paths may leave each start, and reach each goal, at first; three times
            as many where these lead to none.
    """

    smooth: ClassVar[bool] = False
    model: str = "damon-8"
    nodes: str = one_of("decoded", "stored")
    connections: int = bounded(TUNED[NAME]["connections"], 1, 10_000)

    def build(self, si: ob.SpaceInformation) -> ob.Planner:
        """Return the planner.

        Raises:
            ParameterError: ``si`` has neither a validity checker of this project nor is it of ``apex_ompl.setup``.
            MissingFileError: The model is missing.
            FileFormatError: The model is damaged, or for another robot.
        """
        validator = PathValidator.of_setup(si, NAME)
        robot = validator.checker.robot
        manifold = shared_manifold(self.model, robot.name)
        return DAMON(si, validator, Damon.of(manifold, robot, self.nodes, self.connections))
