"""Protocol of APEX's stages, and the solution that they return."""

from __future__ import annotations

import logging
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike

from apex_ompl.apex.context import SolveContext
from apex_ompl.paths.candidates import Candidate
from apex_ompl.paths.path import Path
from apex_ompl.util.validation import check_states, number_array

LOG = logging.getLogger("apex_ompl")


class Solution(NamedTuple):
    """A valid path and the stage that found it.

    Attributes:
        path: The path.
        stage: Name of the stage, as ``solved_by`` gives it.
    """

    path: Path
    stage: str


class Stage(Protocol):
    """One stage of ``solve``; users' own stages return a path."""

    def run(self, context: SolveContext) -> Solution | Path | ArrayLike | None:
        """Return the first valid path that the stage finds, or None.

        A path or its states, shape (N, dof), are checked before they count; a solution of one of APEX's own stages has
        been.
        """


def run_stage(stage: Stage, context: SolveContext) -> Solution | None:
    """Return the solution of a stage, or None; a path that is not valid, or joins no start to a goal, is left out.

    Raises:
        ParameterError: What the stage returned is no path of the robot.
    """
    found = stage.run(context)
    if found is None or isinstance(found, Solution):
        return found
    name = type(stage).__name__
    path = found if isinstance(found, Path) else Path(number_array(found, f"path of stage {name}"))
    check_states(path.states, context.kernel.robot.dof, f"path of stage {name}", least=2)
    ends = path.states[0], path.states[-1]
    joined = any(np.array_equal(q, ends[0]) for q in context.starts)
    joined &= any(np.array_equal(q, ends[1]) for q in context.goals)
    if joined and context.is_valid(path.states):
        return Solution(path, name)
    LOG.info("apex: the path of stage %s %s", name, "is not valid" if joined else "does not join a start to a goal")
    return None


def solution_of(candidate: Candidate | None, context: SolveContext) -> Solution | None:
    """Return the solution that a valid candidate is, or None where there is none."""
    if candidate is None:
        return None
    return Solution(context.spline_path(candidate.control), candidate.origin + ("+repair" if candidate.rounds else ""))
