"""The stages of APEX inside ``solve``: starts and goals, proposals, bridges, trees, shorter paths."""

from __future__ import annotations

import logging
import time
from itertools import cycle, product
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from ompl import base as ob
from ompl import geometric as og

from apex_ompl.apex import bridge
from apex_ompl.apex.query import make_query
from apex_ompl.apex.search import Search
from apex_ompl.diffusion.conditions import Query
from apex_ompl.ompl_adapter.simplify import simplify
from apex_ompl.ompl_adapter.space import array_to_path, path_to_array, to_array, to_state
from apex_ompl.trajopt.candidates import Candidate
from apex_ompl.trajopt.path import path_length
from apex_ompl.types import Array

if TYPE_CHECKING:
    from apex_ompl.planners.apex import APEX  # noqa

Status = ob.PlannerStatus

NAME = "apex"
LOG = logging.getLogger("apex_ompl")
MOST_GOALS, GOAL_ATTEMPTS = 8, 32  # that are read, and asked for
MOST_QUERIES = 8  # pairs of start and goal that proposals are made for, the nearest ones
BRIDGED = 2  # candidates whose blocked stretches are bridged
LONGER = (1, 32, 128)  # factors on the iterations of sprints, before each round of proposals
KEPT = 4  # earlier paths that are candidates for the next query
VARIATIONS = (0.3, 0.6, None, 0.15)  # noise on the best path, or new proposals, in turn while there is time
GAIN = 1e-3  # least gain in length that counts as one [rad]


class SolveLoop:
    """One call of ``APEX.solve``: its stages, one behind the other."""

    def __init__(self, planner: APEX, ptc: ob.PlannerTerminationCondition) -> None:
        """Solve the planner's problem until ``ptc`` holds."""
        self.ptc = ptc
        self.begin = time.perf_counter()
        self.report, self.parameters, self.judge = planner.report, planner.parameters, planner.judge
        self.model, self.optimizer, self.experience = planner.model, planner.optimizer, planner.experience
        self.si, self.pdef = planner.getSpaceInformation(), planner.getProblemDefinition()
        self.inputs = planner.getPlannerInputStates()
        self.kernel = self.judge.checker.kernel
        self.generator = torch.Generator().manual_seed(planner.next_seed())
        self.best: Array | None = None
        self.control: Array | None = None  # of the best path, where it is on a spline
        self.nearest: tuple[Array, float] | None = None  # a path that ends near a goal, and how near
        self.trees: tuple[og.RRTConnect, ob.ProblemDefinition] | None = None  # that were begun

    def stop(self) -> bool:
        """Whether time is up."""
        return bool(self.ptc())

    def is_valid(self, path: Array) -> bool:
        """Whether a path, shape (N, dof), is valid by the judge."""
        return self.judge.is_valid(path, self.stop)

    def run(self) -> Any:
        """Go through the stages, and return OMPL's status."""
        with self.report.timed("query"):
            starts, goals = self._starts(), self._goals()
            if isinstance(goals, str):
                return self._without(Status.UNRECOGNIZED_GOAL_TYPE, goals)
            if not starts:
                return self._without(Status.INVALID_START, "no start state is valid")
            if not goals:
                out = Status.TIMEOUT if self.stop() else Status.INVALID_GOAL
                return self._without(out, "no valid goal state was sampled")
            ends = self._ends(starts, goals)
        search = Search(
            self.model, self.optimizer, self.kernel, self.is_valid, self.judge.gap,
            settings=self.parameters.search(self.model.sampling), generator=self.generator, report=self.report,
        )  # fmt: skip
        self._take(search.known(ends, self.experience, self.stop))
        if self.best is None:
            self._go_round(search, ends)
        if self.best is None and self.parameters.bridge:
            self._bridge(search)
        if self.best is None and self.parameters.approximate:
            with self.report.timed("approximate"):
                self._note_nearest(search, goals)
        if self.best is None and self.parameters.fallback:
            self._grow_trees(starts, whole=len(ends) == 1)
        elif self.best is None:
            self._take(search.again(self._queries(ends), self.stop))
        if self.best is not None:
            self._improve(search, ends)
            self._remember()
            return Status.EXACT_SOLUTION
        self._without(Status.TIMEOUT, f"no path among {self.report.candidates} candidates in the time given")
        if self.nearest is None:
            return Status.TIMEOUT
        self.pdef.addSolutionPath(array_to_path(self.si, self.nearest[0]), True, self.nearest[1], NAME)
        return Status.APPROXIMATE_SOLUTION

    def _go_round(self, search: Search, ends: list[tuple[Array, Array]]) -> None:
        """Let trees and proposals take turns, each longer than the one before."""
        queries: list[Query] = []
        for number in range(search.rounds):
            if self.parameters.sprints and not self.stop():
                self._sprint(ends, self.parameters.sprint * LONGER[min(number, len(LONGER) - 1)])
            if self.best is None and not self.stop():
                queries = queries or self._queries(ends)
                self._take(search.round(number, queries, self.stop))
            if self.best is not None:
                return
        self._take(search.farthest())

    def _take(self, found: Candidate | None) -> None:
        """Take a candidate that is valid, and shorten it."""
        if found is not None:
            self.report.solved_by = found.origin + ("+repair" if found.rounds else "")
            self._accept(self.model.spline.path(found.control), found.control)
            self._shorten(found.control)

    def _without(self, status: Any, reason: str) -> Any:
        self.report.reason = reason
        LOG.info("%s: %s", NAME, reason)
        return status

    def _starts(self) -> list[Array]:
        """Return the valid starts."""
        inputs, found = self.inputs, []
        inputs.restart()
        while inputs.haveMoreStartStates():
            state = inputs.nextStart()
            if state is None:
                break
            found.append(to_array(state, self.kernel.robot.dof))
        return _sound(found)

    def _goals(self) -> list[Array] | str:
        """Return valid goals, some where there are many; or why the goal is of no use."""
        if self.pdef.getGoal() is None:
            return []
        if not self.pdef.getGoal().hasType(ob.GOAL_SAMPLEABLE_REGION):
            return "the goal cannot be sampled, expected a goal state, goal states or a sampleable region"
        inputs, found = self.inputs, []
        state = inputs.nextGoal(self.ptc)  # waits for one
        for _ in range(GOAL_ATTEMPTS):
            if state is not None:
                found.append(to_array(state, self.kernel.robot.dof))
            if len(found) == MOST_GOALS or self.stop() or not inputs.haveMoreGoalStates():
                break
            state = inputs.nextGoal()  # none where the next one is not valid
        return _sound(found)

    @staticmethod
    def _ends(starts: list[Array], goals: list[Array]) -> list[tuple[Array, Array]]:
        """Return the pairs of start and goal that are nearest to each other."""
        return sorted(product(starts, goals), key=lambda pair: float(np.linalg.norm(pair[1] - pair[0])))[:MOST_QUERIES]

    def _queries(self, ends: list[tuple[Array, Array]]) -> list[Query]:
        """Return what the model is asked."""
        checker, point = self.judge.checker, self.model.sees_point
        with self.report.timed("query"):
            return [make_query(checker, start, goal, point=point) for start, goal in ends]

    def _accept(self, path: Array, control: Array | None = None) -> None:
        """Take a valid path as a solution."""
        if self.best is None:
            self.report.first, self.report.path = time.perf_counter() - self.begin, path
            self.report.judged = self.judge.knows_obstacles
        self.report.lengths.append((time.perf_counter() - self.begin, path_length(path)))
        self.best, self.control = path, control
        self.pdef.addSolutionPath(array_to_path(self.si, path), False, 0.0, NAME)

    def _remember(self) -> None:
        """Keep what the best path differs in from its straight line."""
        if self.control is not None:
            self.experience.insert(0, self.control - self.model.spline.line(self.control[0], self.control[-1]))
            del self.experience[KEPT:]

    def _shorten(self, control: Array) -> None:
        """Take the shorter path that the optimiser makes of a valid one."""
        if not self.parameters.polish or self.stop():
            return
        with self.report.timed("polish"):
            better = self.optimizer.shorten(self.kernel, control, self.is_valid, self.stop)
        if better is not None:
            self._accept_shorter(better)

    def _accept_shorter(self, control: Array) -> bool:
        """Take a valid path if it is shorter, and passes no nearer to obstacles than is wanted, or than the best."""
        path, wanted = self.model.spline.path(control), self.parameters.lambda_obs
        if self.best is not None:
            if path_length(path) > path_length(self.best) - GAIN:
                return False
            if wanted > 0.0:
                with self.report.timed("distance"):
                    gap = self.judge.gap(path)
                    if gap < wanted and gap < self.judge.gap(bridge.filled(self.best)):
                        return False
        self._accept(path, control)
        return True

    def _bridge(self, search: Search) -> None:
        """Join the free stretches of the best candidates by short trees."""
        for candidate in sorted(search.pool.candidates, key=lambda one: one.clearance_cost)[:BRIDGED]:
            if self.stop():
                return
            with self.report.timed("bridge"):
                blocked = bridge.thinned(self.model.spline.path(candidate.control))
                path = bridge.joined(self.si, self.judge, blocked, self.stop, self.parameters.range)
            if path is not None:
                self.report.solved_by = "apex+bridge"
                self._polish(path)
                return

    def _grow_trees(self, starts: list[Array], whole: bool) -> None:
        """Let RRTConnect plan with the time that is left, and polish what it finds.

        The trees of sprints go on where they are of the ``whole`` problem.
        """
        while self.best is None and not self.stop():
            tree, pdef = self.trees if self.trees is not None and whole else self._planted(starts)
            self.trees = None
            with self.report.timed("rrtconnect"):
                status = tree.solve(self.ptc).getStatus()
            if status not in (Status.EXACT_SOLUTION, Status.APPROXIMATE_SOLUTION):
                return
            path = path_to_array(pdef.getSolutionPath(), self.kernel.robot.dof)
            if status == Status.EXACT_SOLUTION:
                self._mend(path, "rrtconnect")
            elif self.parameters.approximate and (
                self.nearest is None or pdef.getSolutionDifference() < self.nearest[1]
            ):
                self.nearest = path, pdef.getSolutionDifference()

    def _sprint(self, ends: list[tuple[Array, Array]], iterations: int) -> None:
        """Let RRTConnect try for some iterations, from the start to the goal that are nearest to each other.

        In open scenes that is sooner done than proposals are made; later it goes on where it stopped.
        """
        with self.report.timed("sprint"):
            if self.trees is None:
                pdef = ob.ProblemDefinition(self.si)
                pdef.setStartAndGoalStates(*(to_state(self.si, q) for q in ends[0]))
                self.trees = bridge.rooted(self.si, pdef, self.parameters.range), pdef
            tree, pdef = self.trees
            left = iter(range(iterations))
            ptc = ob.PlannerTerminationCondition(lambda: self.stop() or next(left, None) is None)
            solved = tree.solve(ptc).getStatus() == Status.EXACT_SOLUTION
        if solved:
            self.trees = None
            self._mend(path_to_array(pdef.getSolutionPath(), self.kernel.robot.dof), "sprint")

    def _planted(self, starts: list[Array]) -> tuple[og.RRTConnect, ob.ProblemDefinition]:
        """Return an RRTConnect for all starts and goals, and its problem definition."""
        pdef = ob.ProblemDefinition(self.si)
        for start in starts:
            pdef.addStartState(to_state(self.si, start))
        pdef.setGoal(self.pdef.getGoal())
        return bridge.rooted(self.si, pdef, self.parameters.range), pdef

    def _mend(self, path: Array, origin: str) -> None:
        """Take a path of a tree, whose states are less close than the full check's; plan anew what fails that."""
        found: Array | None = path
        if self.judge.alone and not self.is_valid(path):
            with self.report.timed("bridge"):
                found = bridge.joined(self.si, self.judge, bridge.filled(path), self.stop, self.parameters.range)
        if found is not None:
            self.report.solved_by = origin
            self._polish(found)

    def _polish(self, path: Array) -> None:
        """Take a polyline as a solution; shorten it, put it on a spline, and optimise it."""
        self._accept(path)
        if self.stop() or not self.parameters.polish:
            return
        with self.report.timed("simplify"):
            at_once = 0 if self.judge.alone else 1  # other checkers may take their time
            short = simplify(og.PathSimplifier(self.si), self.si, path, self.stop, at_once)
            if path_length(short) < path_length(path) and self.is_valid(short):
                self._accept(short)
        limits = self.kernel.robot.arrays
        self._shorten(self.model.spline.fit(short, limits.lower, limits.upper).control)

    def _note_nearest(self, search: Search, goals: list[Array]) -> None:
        """Note the valid beginning of the candidate that comes nearest to a goal."""
        for candidate in sorted(search.pool.candidates, key=lambda one: one.clearance_cost)[:BRIDGED]:
            path = bridge.beginning(self.judge, self.model.spline.path(candidate.control), self.stop)
            gap = min(float(np.linalg.norm(goal - path[-1])) for goal in goals)
            if len(path) > 1 and (self.nearest is None or gap < self.nearest[1]):
                self.nearest = path, gap

    def _improve(self, search: Search, ends: list[tuple[Array, Array]]) -> None:
        """With a path length objective, or by parameter, look for shorter paths until time is up."""
        objective = self.pdef.getOptimizationObjective() if self.pdef.hasOptimizationObjective() else None
        if not isinstance(objective, ob.PathLengthOptimizationObjective):
            objective = None
            if not self.parameters.anytime:
                return
        limits = self.kernel.robot.arrays
        with self.report.timed("improve"):
            queries = self._queries(ends)
            for noise in cycle(VARIATIONS):
                assert self.best is not None
                if self.stop() or (objective is not None and objective.isSatisfied(ob.Cost(path_length(self.best)))):
                    return
                start, goal = self.best[0], self.best[-1]
                query = next(
                    (q for q in queries if np.array_equal(q.start, start) and np.array_equal(q.goal, goal)), queries[0]
                )
                if noise is None:
                    found = search.fresh(query, self.stop)
                else:
                    control = self.model.spline.fit(self.best, limits.lower, limits.upper).control
                    found = search.vary(control, query, noise, self.stop)
                if found is None or self.stop():
                    continue
                better = self.optimizer.shorten(self.kernel, found.control, self.is_valid, self.stop)
                self.report.improved += self._accept_shorter(found.control if better is None else better)


def _sound(states: list[Array]) -> list[Array]:
    """Return states that are finite, each once."""
    found: list[Array] = []
    for state in states:
        if np.isfinite(state).all() and not any(np.array_equal(state, other) for other in found):
            found.append(state)
    return found
