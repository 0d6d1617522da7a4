"""OMPL: state space, validity checkers, planning setup, simplification, repair."""

from __future__ import annotations

from typing import TYPE_CHECKING

from apex_ompl.util.lazy import lazy_names

if TYPE_CHECKING:
    from apex_ompl.ompl.setup import PlanningSetup, assemble
    from apex_ompl.ompl.space import state_space, to_state
    from apex_ompl.ompl.validity import MotionValidator, StateValidityChecker, full_check

__all__ = [
    "MotionValidator",
    "PlanningSetup",
    "StateValidityChecker",
    "assemble",
    "full_check",
    "state_space",
    "to_state",
]

__getattr__, __dir__ = lazy_names(
    __name__,
    {
        "MotionValidator": "validity",
        "PlanningSetup": "setup",
        "StateValidityChecker": "validity",
        "assemble": "setup",
        "full_check": "validity",
        "state_space": "space",
        "to_state": "space",
    },
)
