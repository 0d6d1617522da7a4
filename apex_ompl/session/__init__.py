"""A planner that is kept between plans, and the world that it plans in."""

from __future__ import annotations

from typing import TYPE_CHECKING

from apex_ompl.util.lazy import lazy_names

if TYPE_CHECKING:
    from apex_ompl.session.one_plan import check_arguments
    from apex_ompl.session.planner import MotionPlanner, StateCheck
    from apex_ompl.session.pool import kept_planner
    from apex_ompl.session.world import World

__all__ = ["MotionPlanner", "StateCheck", "World", "check_arguments", "kept_planner"]

__getattr__, __dir__ = lazy_names(
    __name__,
    {
        "MotionPlanner": "planner",
        "StateCheck": "planner",
        "World": "world",
        "check_arguments": "one_plan",
        "kept_planner": "pool",
    },
)
