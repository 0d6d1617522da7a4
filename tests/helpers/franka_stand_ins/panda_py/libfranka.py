from __future__ import annotations

import enum
from typing import Any

import numpy as np
from stand_in_arm import StandInArm


class RealtimeConfig(enum.Enum):
    kEnforce = 0
    kIgnore = 1


class RobotState:
    def __init__(self, q: np.ndarray, dq: np.ndarray) -> None:
        self.q, self.dq = q.tolist(), dq.tolist()


class Robot:
    def __init__(self, arm: StandInArm) -> None:
        self._arm = arm

    def set_collision_behavior(self, *thresholds: Any) -> None:
        assert [len(row) for row in thresholds] == [7, 7, 6, 6]
        self._arm.thresholds = thresholds
