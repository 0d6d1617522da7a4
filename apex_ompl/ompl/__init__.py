"""OMPL: state space, validity checkers, planning setup, simplification, repair."""

from __future__ import annotations

from typing import TYPE_CHECKING

from apex_ompl.util.lazy import lazy_names

if TYPE_CHECKING:
    from apex_ompl.ompl.setup import PlanningSetup as PlanningSetup
    from apex_ompl.ompl.setup import assemble as assemble
    from apex_ompl.ompl.space import state_space as state_space
    from apex_ompl.ompl.space import to_state as to_state
    from apex_ompl.ompl.validity import MotionValidator as MotionValidator
    from apex_ompl.ompl.validity import StateValidityChecker as StateValidityChecker
    from apex_ompl.ompl.validity import full_check as full_check

__all__, __getattr__, __dir__ = lazy_names(
    __name__,
    {
        "setup": "PlanningSetup assemble",
        "space": "state_space to_state",
        "validity": "MotionValidator StateValidityChecker full_check",
    },
)
