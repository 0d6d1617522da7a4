"""The closed loop: a robot that moves among obstacles that it observes, and replans while it moves."""

from __future__ import annotations

from typing import TYPE_CHECKING

from apex_ompl.util.lazy import lazy_names

if TYPE_CHECKING:
    from apex_ompl.loop.camera_sensor import Cameras as Cameras
    from apex_ompl.loop.camera_sensor import CameraSensor as CameraSensor
    from apex_ompl.loop.environment import Environment as Environment
    from apex_ompl.loop.environment import LiveSensor as LiveSensor
    from apex_ompl.loop.environment import Observation as Observation
    from apex_ompl.loop.loop import Command as Command
    from apex_ompl.loop.loop import Loop as Loop
    from apex_ompl.loop.result import Event as Event
    from apex_ompl.loop.result import Outcome as Outcome
    from apex_ompl.loop.result import RunResult as RunResult
    from apex_ompl.loop.sensor import Sensor as Sensor
    from apex_ompl.loop.sensor import SensorStream as SensorStream

__all__, __getattr__, __dir__ = lazy_names(
    __name__,
    {
        "camera_sensor": "Cameras CameraSensor",
        "environment": "Environment LiveSensor Observation",
        "loop": "Command Loop",
        "result": "Event Outcome RunResult",
        "sensor": "Sensor SensorStream",
    },  # fmt: skip
)
