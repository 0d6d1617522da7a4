"""CBiRRT (Berenson, Srinivasa and Kuffner 2011) as a rival of apex: this project's compiled trees, and nothing else.

RRT-Connect by projection from the start and the goal, whose edges are proved; trees that met without a valid path are
planted anew. The path is shortened by shortcuts, and polished by the optimizer of apex, each from the path found alone.
The rest of a plan, the proof and the motion, is that of apex.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from ompl import base as ob

from apex_ompl.apex.context import SolveContext
from apex_ompl.apex.parameters import ApexParameters
from apex_ompl.apex.planner import APEX
from apex_ompl.apex.stages.constrained import TREES, on_constraints
from apex_ompl.apex.stages.stage import Solution, Stage
from apex_ompl.kernel.constraints import ConstrainedTreePair
from apex_ompl.ompl.parameters import bounded
from apex_ompl.paths.path import SEARCH_RESOLUTION, Path

NAME = "cbirrt"
MOST = 1_000_000  # random states of a pair of trees


@dataclass(frozen=True)
class Trees:
    """Pairs of trees, one after the other, until one gives a valid path.

    Attributes:
        longest: Length of an edge before its projection [rad].
        pieces: Number of chords of an edge.
    """

    longest: float
    pieces: int

    def run(self, context: SolveContext) -> Solution | None:
        """Return the first valid path, or None."""
        paths, kernel = on_constraints(context), context.kernel
        ends = np.array(context.starts), np.array(context.goals)
        rows, both = paths.constraints.rows, np.concatenate(ends)
        assert rows is not None
        lower, upper = kernel.robot.arrays.lower.copy(), kernel.robot.arrays.upper.copy()
        still = [k for k in paths.constraints.fixed if (both[:, k] == both[0, k]).all()]
        lower[still] = upper[still] = both[0, still]
        within = kernel.within(lower, upper)
        while not context.stop():
            with context.report.timed("rrtconnect"):
                rng = context.rng.spawn(1)[0]
                pair = ConstrainedTreePair(within, rows, *ends, SEARCH_RESOLUTION, rng, self.longest, self.pieces)
                nodes = pair.grow(MOST, context.stop)
            with context.report.timed("check"):
                states = None if nodes is None else paths.along(nodes)
            if states is not None:
                context.tree_nodes = nodes
                return Solution(Path(states), TREES)
        return None


@dataclass(frozen=True)
class CbirrtParameters(ApexParameters):
    """Trees by projection, shortcuts and polish.

    Attributes:
        longest: Length of an edge before its projection [rad].
        pieces: Number of chords of an edge.
        draws: Number of shortcuts that are tried.
    """

    model: str = "none"
    longest: float = bounded(0.15, 0.001, 3.0, unit="rad")
    pieces: int = bounded(2, 1, 100)
    draws: int = bounded(40, 0, 100_000)

    def constrained_stages(self) -> list[Stage]:
        """Return the trees alone."""
        return [Trees(self.longest, self.pieces)]

    def build(self, si: ob.SpaceInformation) -> ob.Planner:
        """Return the planner."""
        return Cbirrt(si, self)


class Cbirrt(APEX):
    """The planner: apex with trees alone, whose paths are shortened from themselves alone."""

    def _accept(self, context: SolveContext, found: Solution) -> None:
        context.report.solved_by = found.stage
        context.accept(found.path)
        paths, given, nodes = on_constraints(context), self.parameters, context.tree_nodes
        if not isinstance(given, CbirrtParameters) or nodes is None:
            return
        with context.report.timed("polish"):
            short = paths.shortcut(nodes, given.draws, context.rng.spawn(1)[0])
            candidates: list[Any] = [paths.along(short)]
            polished = paths.shortened(paths.fit(short))
            candidates += [] if polished is None else [polished[1]]
            for states in candidates:
                if states is not None:
                    context.accept_if_shorter(Path(states))
