"""Planning: a planner that is kept with its world, and the five steps of a plan, each for itself.

``assemble -> check -> solve -> prove -> time``; see :mod:`apex_ompl.planning.steps`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from apex_ompl.util.lazy import lazy_names

if TYPE_CHECKING:
    from apex_ompl.planning.planner import MotionPlanner, StateCheck
    from apex_ompl.planning.query import GoalSampler
    from apex_ompl.planning.steps import (
        FoundPath,
        PlanQuery,
        ProvedPath,
        assemble,
        check,
        prove,
        solve,
        time,
    )
    from apex_ompl.planning.world import World

__all__ = [
    "FoundPath",
    "GoalSampler",
    "MotionPlanner",
    "PlanQuery",
    "ProvedPath",
    "StateCheck",
    "World",
    "assemble",
    "check",
    "prove",
    "solve",
    "time",
]

_STEPS = ("FoundPath", "PlanQuery", "ProvedPath", "assemble", "check", "prove", "solve", "time")

__getattr__, __dir__ = lazy_names(
    __name__,
    {
        "GoalSampler": "query",
        "MotionPlanner": "planner",
        "StateCheck": "planner",
        "World": "world",
        **dict.fromkeys(_STEPS, "steps"),
    },
)
