"""The closed loop: a robot that moves among obstacles that it observes, and replans while it moves."""

from __future__ import annotations

from typing import TYPE_CHECKING

from apex_ompl.util.lazy import lazy_names

if TYPE_CHECKING:
    from apex_ompl.loop.environment import Environment, Observation
    from apex_ompl.loop.result import Event, Outcome, RunResult
    from apex_ompl.loop.sensor import Sensor, SensorStream

__all__ = ["Environment", "Event", "Observation", "Outcome", "RunResult", "Sensor", "SensorStream"]

__getattr__, __dir__ = lazy_names(
    __name__,
    {
        "Environment": "environment",
        "Event": "result",
        "Observation": "environment",
        "Outcome": "result",
        "RunResult": "result",
        "Sensor": "sensor",
        "SensorStream": "sensor",
    },
)
