"""Planning: a planner that is kept with its world, and the steps of a plan, which benchmarks compose, too."""

from __future__ import annotations

from typing import TYPE_CHECKING

from apex_ompl.util.lazy import lazy_names

if TYPE_CHECKING:
    from apex_ompl.planning.among_dynamic_obstacles import plan_among_dynamic_obstacles
    from apex_ompl.planning.one_plan import check_arguments
    from apex_ompl.planning.planner import MotionPlanner, StateCheck
    from apex_ompl.planning.pool import kept_planner
    from apex_ompl.planning.run import PlanRun
    from apex_ompl.planning.solving import (
        NOT_PROVED,
        STRAIGHT_LINE,
        find_path,
        query_fault,
        solve,
        straight_line,
        verify,
        with_exact_ends,
    )
    from apex_ompl.planning.timing import finish, parameterize
    from apex_ompl.planning.world import World

__all__ = [
    "NOT_PROVED",
    "STRAIGHT_LINE",
    "MotionPlanner",
    "PlanRun",
    "StateCheck",
    "World",
    "check_arguments",
    "find_path",
    "finish",
    "kept_planner",
    "parameterize",
    "plan_among_dynamic_obstacles",
    "query_fault",
    "solve",
    "straight_line",
    "verify",
    "with_exact_ends",
]

__getattr__, __dir__ = lazy_names(
    __name__,
    {
        "MotionPlanner": "planner",
        "PlanRun": "run",
        "StateCheck": "planner",
        "World": "world",
        "check_arguments": "one_plan",
        "finish": "timing",
        "kept_planner": "pool",
        "parameterize": "timing",
        "plan_among_dynamic_obstacles": "among_dynamic_obstacles",
        **dict.fromkeys(
            (
                "NOT_PROVED", "STRAIGHT_LINE", "find_path", "query_fault", "solve", "straight_line", "verify",
                "with_exact_ends",
            ),
            "solving",
        ),
    },
)  # fmt: skip
