"""Base class of this package's OMPL planners, the report that each makes, and the starts and goals that they read."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from itertools import product
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from ompl import base as ob
from ompl import geometric as og

from apex_ompl.errors import ApexError
from apex_ompl.ompl.space import array_to_path, await_goal, forget_states, to_array, to_state
from apex_ompl.paths.path import Path
from apex_ompl.types import Array
from apex_ompl.util.clocks import timed
from apex_ompl.util.display import fields_line
from apex_ompl.util.process import running

LOG = logging.getLogger("apex_ompl")
Status = ob.PlannerStatus
BAD_CAST = "std::bad_cast"  # message of the bindings where Python gave OMPL a value of another type
NO_TRUTH = "the state validity checker must return True or False (OMPL takes no numpy.bool_): return bool(...)"


@dataclass
class SolveReport:
    """Outcome of one call of ``solve``, by stages.

    Attributes:
        solved_by: Stage that found the first valid path: ``line``, ``experience``, ``apex`` or ``apex+resample``,
            with ``+repair`` where the optimizer had to help; ``sprint``, ``apex+bridge`` or ``rrtconnect``; empty
            without one.
        reason: One sentence where there is no exact solution.
        times: Seconds by stage; those of ``guidance`` and ``distance`` are part of other stages.
        first: Seconds until the first valid path, NaN without one.
        first_verified: Whether the first valid path had passed the full check by then.
        first_path: First valid path, or None.
        best_path: Shortest valid path, or None.
        lengths: Time [s] and length [rad] of each path that was accepted as a solution.
        candidates: Number of candidates before trees: straight lines, earlier paths, proposals.
        proposed: Number of candidates that the model proposed.
        resampled: Number of candidates from collision-triggered resampling.
        steps: Number of optimizer steps in repair.
        improved: Number of shorter paths that were found after the first one.
        solutions: Paths that were added to OMPL's solutions, by ``id`` of OMPL's path, which is kept with each.
    """

    solved_by: str = ""
    reason: str = ""
    times: dict[str, float] = field(default_factory=dict)
    first: float = float("nan")
    first_verified: bool = False
    first_path: Path | None = None
    best_path: Path | None = None
    lengths: list[tuple[float, float]] = field(default_factory=list)
    candidates: int = 0
    proposed: int = 0
    resampled: int = 0
    steps: int = 0
    improved: int = 0
    solutions: dict[int, tuple[og.PathGeometric, Path]] = field(default_factory=dict, repr=False)

    __repr__ = fields_line

    def timed(self, stage: str) -> AbstractContextManager[None]:
        """Count the time of a block to a stage."""
        return timed(self.times, stage)

    def add_solution(self, planner: ob.Planner, path: Path, seconds: float) -> None:
        """Add a valid path to OMPL's solutions, and note it.

        Args:
            planner: The planner that found it, in whose problem definition it is entered.
            path: The path.
            seconds: Time since the start of ``solve`` [s].
        """
        if self.first_path is None:
            self.first, self.first_path = seconds, path
        self.lengths.append((seconds, path.length))
        if self.best_path is None or path.length < self.best_path.length:
            self.best_path = path
        solution = array_to_path(planner.getSpaceInformation(), path.states)
        self.solutions[id(solution)] = solution, path
        planner.getProblemDefinition().addSolutionPath(solution, False, 0.0, planner.getName())

    def path_of(self, solution: ob.Path) -> Path | None:
        """Return the path, with its spline, that was added as a solution of OMPL, or None for one that was not."""
        found = self.solutions.get(id(solution))
        return None if found is None else found[1]


class ReportingPlanner(Protocol):
    """Planner that reports on its last call of ``solve``.

    Attributes:
        report: The report.
        rejected_lines: Straight lines that were found invalid before ``solve``, each of shape (2, dof); the planner
            need not try them again.
    """

    report: SolveReport
    rejected_lines: list[Array]


def reporting(planner: Any) -> ReportingPlanner | None:
    """Return a planner that makes reports, or None for one that does not, as OMPL's own."""
    return planner if hasattr(planner, "report") else None


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
        rejected_lines: Straight lines that were found invalid before ``solve``, each of shape (2, dof).
    """

    def __init__(self, si: ob.SpaceInformation, name: str) -> None:
        """Plan in the space of ``si``."""
        super().__init__(si, name)
        self.report = SolveReport()
        self.rejected_lines: list[Array] = []
        self._name = name

    def solve(self, ptc: ob.PlannerTerminationCondition) -> ob.PlannerStatus:
        """Solve the problem; no exception leaves it, since one would end the process inside OMPL.

        Every call reads starts and goals again. ``report`` has times, counts, and the reason where nothing was found.
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

    def _ends(self, ptc: ob.PlannerTerminationCondition) -> tuple[list[Array], list[Array], Any]:
        """Return the valid starts and goals, each of shape (dof,), and a status where there are none, else None."""
        inputs, dof = self.getPlannerInputStates(), int(self.getSpaceInformation().getStateDimension())
        starts, goals = read_starts(inputs, dof), read_goals(inputs, dof, ptc, self.getProblemDefinition().getGoal())
        if starts and goals:
            return starts, goals, None
        self.report.reason = "no valid goal state was sampled" if starts else "no start state is valid"
        if not starts:
            return starts, goals, Status.INVALID_START
        return starts, goals, Status.TIMEOUT if ptc() else Status.INVALID_GOAL

    def clear(self) -> None:
        """Forget the last solution."""
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
        states = []  # referenced by the data until they are copied

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


MAX_GOALS, GOAL_ATTEMPTS = 8, 32  # goals that are read of a region, and samples that are drawn for them
MAX_STATES = 256  # states of a goal that has no more, all of which are read
MAX_PAIRS = 8  # pairs of start and goal that proposals are made for


def read_starts(inputs: Any, dof: int) -> list[Array]:
    """Return the valid start states, each of shape (dof,).

    Args:
        inputs: The planner's ``getPlannerInputStates()``.
        dof: Number of joints.
    """
    found = []
    inputs.restart()
    while inputs.haveMoreStartStates():
        state = inputs.nextStart()
        if state is None:
            break
        found.append(to_array(state, dof))
    return _distinct(found)


def read_goals(inputs: Any, dof: int, ptc: ob.PlannerTerminationCondition, goal: Any) -> list[Array]:
    """Return the valid goal states, each of shape (dof,), or a few where there are many, or the goal is a region.

    Args:
        inputs: The planner's ``getPlannerInputStates()``.
        dof: Number of joints.
        ptc: Ends the sampling of a region.
        goal: The goal.
    """
    found = []
    sampled = goal is not None and goal.hasType(ob.GOAL_SAMPLEABLE_REGION)
    count = goal.maxSampleCount() if sampled else 0
    most, attempts = (count, count) if MAX_GOALS < count <= MAX_STATES else (MAX_GOALS, GOAL_ATTEMPTS)
    await_goal(goal, ptc)
    state = inputs.nextGoal(ptc)
    for _ in range(attempts):
        if state is not None:
            found.append(to_array(state, dof))
        if len(found) == most or ptc() or not inputs.haveMoreGoalStates():
            break
        state = inputs.nextGoal()  # None where the next sample is invalid
    return _distinct(found)


def nearest_pairs(starts: list[Array], goals: list[Array]) -> list[tuple[Array, Array]]:
    """Return the pairs of start and goal that are nearest to each other, the nearest first."""
    pairs = product(starts, goals)
    return sorted(pairs, key=lambda pair: float(np.linalg.norm(pair[1] - pair[0])))[:MAX_PAIRS]


def _distinct(states: list[Array]) -> list[Array]:
    """Return the finite states, each once."""
    found: list[Array] = []
    for state in states:
        if np.isfinite(state).all() and not any(np.array_equal(state, other) for other in found):
            found.append(state)
    return found
