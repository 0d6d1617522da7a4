"""Obstacles that move."""

from __future__ import annotations

from typing import TYPE_CHECKING

from apex_ompl.util.lazy import lazy_names

if TYPE_CHECKING:
    from apex_ompl.moving.dynamic_obstacles import Conflict, DynamicObstacles, clearance_in_time, prove_motion
    from apex_ompl.moving.retime import Retimed
    from apex_ompl.moving.stopping import Stop, stop, stop_along, stops_proved

__all__ = [
    "Conflict",
    "DynamicObstacles",
    "Retimed",
    "Stop",
    "clearance_in_time",
    "prove_motion",
    "stop",
    "stop_along",
    "stops_proved",
]

__getattr__, __dir__ = lazy_names(
    __name__,
    {
        "Conflict": "dynamic_obstacles",
        "DynamicObstacles": "dynamic_obstacles",
        "Retimed": "retime",
        "Stop": "stopping",
        "clearance_in_time": "dynamic_obstacles",
        "prove_motion": "dynamic_obstacles",
        "stop": "stopping",
        "stop_along": "stopping",
        "stops_proved": "stopping",
    },
)
