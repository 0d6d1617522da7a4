"""What several tests share."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from apex_ompl.robot import Robot

ROOT = Path(__file__).resolve().parent.parent


def states_around_home(robot: Robot, rng: np.random.Generator, count: int, spread: float = 0.4) -> np.ndarray:
    states = robot.home + rng.normal(0.0, spread, (count, robot.dof))
    hands = robot.groups.get("hands", [])
    states[:, hands] = rng.uniform(0.0, 1.0, (count, len(hands)))
    return np.clip(states, robot.limits.lower, robot.limits.upper)
