"""What the planners of this package have in common inside of OMPL."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from ompl import base as ob

from apex_ompl.errors import ApexError
from apex_ompl.ompl.report import SolveReport
from apex_ompl.ompl.space import forget_states, to_state
from apex_ompl.types import Array
from apex_ompl.util.process import running

LOG = logging.getLogger("apex_ompl")
Status = ob.PlannerStatus
BAD_CAST = "std::bad_cast"  # message of the bindings where Python gave OMPL a value of another type
NO_TRUTH = "the state validity checker must return True or False (OMPL takes no numpy.bool_): return bool(...)"


class Tree(NamedTuple):
    """A tree of states.

    Attributes:
        states: Shape (N, dof).
        parents: Number of the parent of each, -1 for roots, shape (N,).
        to_goal: Whether its roots are goals, and motions go from a state to its parent.
    """

    states: Array
    parents: NDArray[np.intp]
    to_goal: bool


class OwnPlanner(ob.Planner):
    """OMPL planner in Python: a subclass has ``_solve``, which may raise, and OMPL sees a status.

    Attributes:
        report: Report on the last call of ``solve``.
    """

    def __init__(self, si: ob.SpaceInformation, name: str) -> None:
        """Plan in the space of ``si``."""
        super().__init__(si, name)
        self.report = SolveReport()
        self._name = name

    def solve(self, ptc: ob.PlannerTerminationCondition) -> ob.PlannerStatus:
        """Solve the problem; no exception leaves it, since one would end the process inside OMPL.

        Starts and goals are read anew by every call. ``report`` says what was done, and why where nothing was found.
        """
        self.report = SolveReport()
        try:
            with running(ptc.terminate):
                return Status(self._solve(ptc))
        except ApexError as error:
            LOG.error("%s: %s", self._name, error)
            forget_states(error)
            self.report.reason = str(error)
            return Status(Status.ABORT)
        except Exception as error:
            if str(error) == BAD_CAST:
                LOG.error("%s: %s", self._name, NO_TRUTH)
                self.report.reason = NO_TRUTH
                return Status(Status.ABORT)
            LOG.exception("%s failed", self._name)
            forget_states(error)
            self.report.reason = f"{self._name} failed, {error!r}"
            return Status(Status.CRASH)

    def _solve(self, ptc: ob.PlannerTerminationCondition) -> Any:
        """Solve the problem, and return OMPL's status."""
        raise NotImplementedError

    def clear(self) -> None:
        """Forget what was found."""
        super().clear()
        self.report = SolveReport()

    def fill_data(self, data: ob.PlannerData) -> None:
        """Fill in the states and motions of the last call of ``solve``, as ``getPlannerData`` of OMPL's planners does.

        A ``getPlannerData`` in Python would end the process when OMPL calls it: the bindings cannot hand it the data.
        The SimpleSetup of ``apex_ompl.setup`` calls this method in its place.
        """
        for planner in self._inner_planners():
            planner.getPlannerData(data)
        path, trees = self.report.best_path, self._trees()
        if path is not None:
            trees.append(Tree(path.states, np.arange(-1, len(path.states) - 1), False))
        vertices: dict[bytes, ob.PlannerDataVertex] = {}
        states = []  # which the data refers to until they are copied

        def vertex(q: Array) -> ob.PlannerDataVertex:
            if q.tobytes() not in vertices:
                states.append(to_state(self.getSpaceInformation(), q))
                vertices[q.tobytes()] = ob.PlannerDataVertex(states[-1])
            return vertices[q.tobytes()]

        for tree in trees:
            add_root = data.addGoalVertex if tree.to_goal else data.addStartVertex
            for q, parent in zip(tree.states, tree.parents.tolist(), strict=True):
                if parent < 0:
                    add_root(vertex(q))
                else:
                    ends = data.addVertex(vertex(tree.states[parent])), data.addVertex(vertex(q))
                    data.addEdge(*(reversed(ends) if tree.to_goal else ends))
        if path is not None:
            data.addGoalVertex(vertex(path.states[-1]))
        data.decoupleFromPlanner()

    def _inner_planners(self) -> Sequence[ob.Planner]:
        """Return OMPL's planners that took part in the last call of ``solve``."""
        return ()

    def _trees(self) -> list[Tree]:
        """Return the trees of the last call of ``solve``."""
        return []
