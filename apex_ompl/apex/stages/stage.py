"""What a stage of APEX is, and what it returns."""

from __future__ import annotations

from typing import NamedTuple, Protocol

from apex_ompl.apex.context import SolveContext
from apex_ompl.paths.candidates import Candidate
from apex_ompl.paths.path import Path


class Solution(NamedTuple):
    """A valid path and the stage that found it.

    Attributes:
        path: The path.
        stage: Name of the stage, as ``solved_by`` gives it.
    """

    path: Path
    stage: str


class Stage(Protocol):
    """One stage of ``solve``."""

    def run(self, context: SolveContext) -> Solution | None:
        """Return the first valid path that the stage finds, or None."""


def solution_of(candidate: Candidate | None, context: SolveContext) -> Solution | None:
    """Return the solution that a valid candidate is, or None where there is none."""
    if candidate is None:
        return None
    return Solution(context.spline_path(candidate.control), candidate.origin + ("+repair" if candidate.rounds else ""))
