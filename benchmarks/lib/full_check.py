"""The full check of paths of other libraries, with the repair that rrtconnect's paths have."""

from __future__ import annotations

from collections.abc import Sequence

from apex_ompl.ompl.repair import repair
from apex_ompl.ompl.setup import PlanningSetup
from apex_ompl.ompl.validity import full_check
from apex_ompl.planning.steps import NOT_PROVED
from apex_ompl.types import Array
from apex_ompl.util.clocks import timed


def proved_or_repaired(
    ready: PlanningSetup, candidates: Sequence[Array], deadline: float, times: dict[str, float]
) -> tuple[Array | None, str]:
    """Return the first candidate that passes the full check, or is repaired, and the reason where there is none."""
    reason = ""
    for states in candidates:
        with timed(times, "verify"):
            check = full_check(ready.checker, states, ready.start, ready.goals, deadline=deadline)
        if check:
            return states, ""
        if check.timed_out:
            return None, NOT_PROVED
        reason = reason or f"the path found failed the full check and repair, {check.reason}"
        with timed(times, "repair"):
            repaired = repair(ready, states, check, deadline)
        if repaired is not None:
            return repaired[0].states, ""
    return None, reason
