"""Dynamic obstacles: predictions, certificates, stops and retiming in time; and what replanners share."""

from __future__ import annotations

from typing import TYPE_CHECKING

from apex_ompl.util.lazy import lazy_names

if TYPE_CHECKING:
    from apex_ompl.moving.compute_costs import ComputeBudget as ComputeBudget
    from apex_ompl.moving.context import Following as Following
    from apex_ompl.moving.context import RunContext as RunContext
    from apex_ompl.moving.dynamic_obstacles import Conflict as Conflict
    from apex_ompl.moving.dynamic_obstacles import DynamicObstacles as DynamicObstacles
    from apex_ompl.moving.dynamic_obstacles import clearance_in_time as clearance_in_time
    from apex_ompl.moving.dynamic_obstacles import prove_motion as prove_motion
    from apex_ompl.moving.replanner import Answer as Answer
    from apex_ompl.moving.replanner import Replanner as Replanner
    from apex_ompl.moving.replanner import Request as Request
    from apex_ompl.moving.replanner import register as register
    from apex_ompl.moving.retime import Retimed as Retimed
    from apex_ompl.moving.search import Search as Search
    from apex_ompl.moving.stopping import Stop as Stop
    from apex_ompl.moving.stopping import stop as stop
    from apex_ompl.moving.stopping import stop_along as stop_along
    from apex_ompl.moving.stopping import stops_proved as stops_proved

__all__, __getattr__, __dir__ = lazy_names(
    __name__,
    {
        "compute_costs": "ComputeBudget",
        "context": "Following RunContext",
        "dynamic_obstacles": "Conflict DynamicObstacles clearance_in_time prove_motion",
        "replanner": "Answer Replanner Request register",
        "retime": "Retimed",
        "search": "Search",
        "stopping": "Stop stop stop_along stops_proved",
    },
)
