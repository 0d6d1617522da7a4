from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np


class JointPosition:
    def __init__(self, stiffness: np.ndarray, damping: np.ndarray, filter_coeff: float = 1.0) -> None:
        assert stiffness.shape == damping.shape == (7,)
        self._set: Callable[[Any, Any], None]

    def set_control(self, position: np.ndarray, velocity: np.ndarray) -> None:
        self._set(position, velocity)
