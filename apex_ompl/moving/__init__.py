"""Obstacles that move."""

from __future__ import annotations

from typing import TYPE_CHECKING

from apex_ompl.util.lazy import lazy_names

if TYPE_CHECKING:
    from apex_ompl.moving.movers import Conflict, Movers, clearance_in_time, prove_motion
    from apex_ompl.moving.retime import Retimed
    from apex_ompl.moving.stopping import Stop, stop, stop_along, stops_proved

__all__ = [
    "Conflict",
    "Movers",
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
        "Conflict": "movers",
        "Movers": "movers",
        "Retimed": "retime",
        "Stop": "stopping",
        "clearance_in_time": "movers",
        "prove_motion": "movers",
        "stop": "stopping",
        "stop_along": "stopping",
        "stops_proved": "stopping",
    },
)
