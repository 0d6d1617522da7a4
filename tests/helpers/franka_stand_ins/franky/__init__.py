"""A stand-in for ``franky``, with the parts that the driver uses."""

from __future__ import annotations

import enum
from types import SimpleNamespace
from typing import Any

import numpy as np
from stand_in_arm import StandInArm


class RealtimeConfig(enum.Enum):
    Enforce = 0
    Ignore = 1


class Robot:
    def __init__(self, fci_hostname: str, *, realtime_config: Any = RealtimeConfig.Enforce) -> None:
        self._arm, self._fault = StandInArm(fci_hostname), ""

    def set_collision_behavior(self, torque_thresholds: float, force_thresholds: float) -> None:
        self._arm.thresholds = torque_thresholds, force_thresholds

    @property
    def current_joint_state(self) -> Any:
        position, velocity = self._arm.measured()
        return SimpleNamespace(position=position, velocity=velocity)

    @property
    def is_in_control(self) -> bool:
        self._fault = self._arm.fault() or self._fault
        return not self._arm.failed

    def poll_motion(self) -> bool:
        fault, self._fault = self._fault, ""
        if fault:
            raise RuntimeError(fault)
        return True

    def recover_from_errors(self) -> bool:
        self._arm.recover()
        return True


class JointImpedanceTracker:
    def __init__(self, robot: Robot, *, stiffness: np.ndarray, damping: np.ndarray) -> None:
        assert stiffness.shape == damping.shape == (7,)
        self._robot = robot

    def set_target(self, q: np.ndarray, dq: np.ndarray, tau_ff: np.ndarray) -> None:
        self._robot._arm.reference(q, dq, tau_ff)

    def stop(self) -> None:
        pass
