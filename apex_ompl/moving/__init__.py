"""Dynamic obstacles: predictions, certificates, stops and retiming in time; and what replanners share."""

from __future__ import annotations

from typing import TYPE_CHECKING

from apex_ompl.util.lazy import lazy_names

if TYPE_CHECKING:
    from apex_ompl.moving.compute_costs import ComputeBudget
    from apex_ompl.moving.context import Following, RunContext
    from apex_ompl.moving.dynamic_obstacles import Conflict, DynamicObstacles, clearance_in_time, prove_motion
    from apex_ompl.moving.replanner import Answer, Replanner, Request, register
    from apex_ompl.moving.retime import Retimed
    from apex_ompl.moving.search import Search
    from apex_ompl.moving.stopping import Stop, stop, stop_along, stops_proved

_HOMES = {
    "Answer": "replanner",
    "ComputeBudget": "compute_costs",
    "Conflict": "dynamic_obstacles",
    "DynamicObstacles": "dynamic_obstacles",
    "Following": "context",
    "Replanner": "replanner",
    "Request": "replanner",
    "Retimed": "retime",
    "RunContext": "context",
    "Search": "search",
    "Stop": "stopping",
    "clearance_in_time": "dynamic_obstacles",
    "prove_motion": "dynamic_obstacles",
    "register": "replanner",
    "stop": "stopping",
    "stop_along": "stopping",
    "stops_proved": "stopping",
}

__all__ = [
    "Answer",
    "ComputeBudget",
    "Conflict",
    "DynamicObstacles",
    "Following",
    "Replanner",
    "Request",
    "Retimed",
    "RunContext",
    "Search",
    "Stop",
    "clearance_in_time",
    "prove_motion",
    "register",
    "stop",
    "stop_along",
    "stops_proved",
]

__getattr__, __dir__ = lazy_names(__name__, _HOMES)
