"""Dynamic RRT: a tree from the goal that is kept between calls of ``solve``, trimmed where obstacles changed."""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from ompl import base as ob
from ompl import util as ou

from apex_ompl.baselines.drrt.dynamic_rrt import DynamicRRT, GoalTree
from apex_ompl.collision.path_proof import may_have_become_blocked
from apex_ompl.kernel import Kernel
from apex_ompl.ompl.own_planner import OwnPlanner, Tree
from apex_ompl.ompl.parameters import Parameters, bounded, register
from apex_ompl.ompl.space import motions_free, require_real_vectors
from apex_ompl.ompl.tuned import TUNED
from apex_ompl.ompl.validity import MotionValidator, StateValidityChecker
from apex_ompl.paths.path import Path
from apex_ompl.types import Array, Flags

NAME = "drrt"
Status = ob.PlannerStatus


class DRRT(OwnPlanner):
    """OMPL planner: :class:`~apex_ompl.baselines.drrt.dynamic_rrt.DynamicRRT` by the space's validators.

    ``solve`` keeps its tree: a later call, after obstacles or the start changed, trims it and grows it on. Edges that
    this project's sphere cover proves clear of every obstacle that is new or moved are not checked again; with another
    validity checker all edges are. ``clear`` forgets the tree, ``clearQuery`` does not. In the closed loop it is the
    method ``drrt``.

    Attributes:
        search: The tree, and how it grows.
        report: What the last call of ``solve`` did.
        removed: Number of nodes that the last call removed.
    """

    def __init__(self, si: ob.SpaceInformation, parameters: DRRTParameters) -> None:
        """Plan in the space of ``si``.

        Raises:
            ParameterError: It is not a space of real vectors.
        """
        require_real_vectors(si.getStateSpace())
        super().__init__(si, NAME)
        self._seed, self._solves = parameters.seed, 0
        self.search = DynamicRRT(parameters.range, parameters.goal_bias, parameters.waypoint_bias)
        self.removed = 0
        self._trimmed: Kernel | None = None  # the kernel with which the edges were free

    def clear(self) -> None:
        """Forget the tree and the last path."""
        super().clear()
        self.search.forget()
        self._solves, self._trimmed = 0, None

    def clearQuery(self) -> None:  # noqa: N802 - OMPL's name
        """Keep the tree, which stays useful as long as the goals are the same."""

    def _solve(self, ptc: ob.PlannerTerminationCondition) -> Any:
        self.removed = 0
        si, started = self.getSpaceInformation(), time.perf_counter()
        starts, goals, status = self._ends(ptc)
        if status is not None:
            return status
        first = self._seed if self._seed >= 0 else int(ou.RNG().uniformInt(0, 2**31 - 2))
        rng, box = np.random.default_rng(first + self._solves), si.getStateSpace().getBounds()
        self._solves += 1
        lower, upper = np.array(box.low), np.array(box.high)
        tree = self.search.rooted_at(np.stack(goals))
        with self.report.timed("trim"):
            self._trim(tree)
        with self.report.timed("grow"):
            path = self.search.grow(
                tree, np.stack(starts), lambda: rng.uniform(lower, upper), rng=rng, free=partial(motions_free, si),
                stop=lambda: bool(ptc()),
            )  # fmt: skip
        if path is None:
            self.report.reason = f"no path by a tree of {len(tree)} nodes in the time given"
            return Status.TIMEOUT
        self.report.solved_by = NAME
        self.report.add_solution(self, Path(path), time.perf_counter() - started)
        return Status.EXACT_SOLUTION

    def _trim(self, tree: GoalTree) -> None:
        """Remove what is no longer free since the last call."""
        si = self.getSpaceInformation()
        validity_checker, motions = si.getStateValidityChecker(), si.getMotionValidator()
        ours = type(validity_checker) is StateValidityChecker and type(motions) is MotionValidator
        before, now = self._trimmed, validity_checker.checker.kernel if ours else None
        self._trimmed = now
        if len(tree) == tree.roots:
            return

        def free(first: Array, last: Array) -> Flags:
            found = np.ones(len(first), bool)
            if before is not None and now is not None:
                suspect = np.flatnonzero(may_have_become_blocked(before, now, first, last))
            else:
                suspect = np.arange(len(first))
            found[suspect] = motions_free(si, first[suspect], last[suspect])
            return found

        self.removed = tree.trim(free)

    def _trees(self) -> list[Tree]:
        tree = self.search.tree
        return [] if tree is None else [Tree(tree.states.copy(), tree.parents.copy(), True)]


@register(NAME)
@dataclass(frozen=True)
class DRRTParameters(Parameters):
    """Dynamic RRT (Ferguson, Kalra and Stentz 2006): a tree from the goal, kept between calls of ``solve``.

    Range and goal bias are what ``python -m benchmarks.planners.tune --baselines`` chose on the validation split; the
    share of way-points, which are used from the second call of ``solve`` on, was not tuned.

    Attributes:
        range: Longest step of the tree, by the largest change of a joint.
        goal_bias: Share of the extensions towards the start, which is where a tree from the goal is to go.
        waypoint_bias: Share of those towards nodes of the last path, where there is one.
        seed: Of the random choices; -1 takes one that follows from OMPL's.
    """

    range: float = bounded(TUNED[NAME]["range"], 1e-3, unit="rad")
    goal_bias: float = bounded(TUNED[NAME]["goal_bias"], 0.0, 1.0)
    waypoint_bias: float = bounded(0.6, 0.0, 1.0)
    seed: int = bounded(-1, -1)

    def build(self, si: ob.SpaceInformation) -> ob.Planner:
        """Return the planner.

        Raises:
            ParameterError: The space of ``si`` is not one of real vectors.
        """
        return DRRT(si, self)
