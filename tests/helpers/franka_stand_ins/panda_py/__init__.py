"""A stand-in for ``panda_py``, with the parts that the driver uses."""

from __future__ import annotations

from typing import Any

import numpy as np
from stand_in_arm import StandInArm

from panda_py.controllers import JointPosition
from panda_py.libfranka import RealtimeConfig, Robot, RobotState


class Panda:
    def __init__(self, hostname: str, name: str = "panda", realtime_config: Any = RealtimeConfig.kIgnore) -> None:
        self._arm = StandInArm(hostname)

    def get_robot(self) -> Robot:
        return Robot(self._arm)

    def start_controller(self, controller: JointPosition) -> None:
        controller._set = lambda q, v: self._arm.reference(q, v, np.zeros(7))

    def stop_controller(self) -> None:
        pass

    def get_state(self) -> RobotState:
        return RobotState(*self._arm.measured())

    def raise_error(self) -> None:
        fault = self._arm.fault()
        if fault:
            raise RuntimeError(fault)

    def recover(self) -> None:
        self._arm.recover()
