"""Constants and functions that several tests share."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from apex_ompl.robot import Robot

ROOT = Path(__file__).resolve().parents[2]
DATA = ROOT / "tests" / "data" / "dual_panda_softhand"  # drawn by scripts/make_test_data.py

STEP = """\
v 0 0 0\nv 0.3 0 0\nv 0.3 0.1 0\nv 0.1 0.1 0\nv 0.1 0.3 0\nv 0 0.3 0
v 0 0 0.2\nv 0.3 0 0.2\nv 0.3 0.1 0.2\nv 0.1 0.1 0.2\nv 0.1 0.3 0.2\nv 0 0.3 0.2
f 4 3 2\nf 4 2 1\nf 6 5 4\nf 6 4 1\nf 10 8 9\nf 10 7 8\nf 12 10 11\nf 12 7 10
f 1 2 8\nf 1 8 7\nf 2 3 9\nf 2 9 8\nf 3 4 10\nf 3 10 9\nf 4 5 11\nf 4 11 10\nf 5 6 12\nf 5 12 11\nf 6 1 7\nf 6 7 12
"""
CUBE_OBJ = """v 0 0 0
v 1 0 0
v 1 1 0
v 0 1 0
v 0 0 1
v 1 0 1
v 1 1 1
v 0 1 1
f 1 3 2
f 1 4 3
f 5 6 7
f 5 7 8
f 1 2 6
f 1 6 5
f 2 3 7
f 2 7 6
f 3 4 8
f 3 8 7
f 4 1 5
f 4 5 8
"""


def benchmark_script(name: str) -> ModuleType:
    """A module below the folder of benchmarks, such as ``lib.freshness``."""
    sys.path.append(str(ROOT))
    try:
        return importlib.import_module(f"benchmarks.{name}")
    finally:
        sys.path.remove(str(ROOT))


def states_around_home(robot: Robot, rng: np.random.Generator, count: int, spread: float = 0.4) -> np.ndarray:
    """States home + N(0, spread^2), hands uniform, clipped to the limits; shape (count, dof)."""
    states = robot.home + rng.normal(0.0, spread, (count, robot.dof))
    hands = robot.groups.get("hands", [])
    states[:, hands] = rng.uniform(0.0, 1.0, (count, len(hands)))
    return np.clip(states, robot.limits.lower, robot.limits.upper)


def distance(points: np.ndarray, path: np.ndarray) -> float:
    """Largest distance of points, shape (N, dof), from a polyline, shape (M, dof)."""
    segments = np.diff(path, axis=0)
    squares = np.maximum(np.sum(segments**2, axis=1), 1e-300)
    fraction = np.clip(np.einsum("nkd,kd->nk", points[:, None] - path[:-1], segments) / squares, 0.0, 1.0)
    return float(np.linalg.norm(points[:, None] - path[:-1] - fraction[..., None] * segments, axis=2).min(axis=1).max())


def needs(path: str) -> pytest.MarkDecorator:
    """Skip a test where a part of the repository is missing that the source distribution leaves out."""
    return pytest.mark.skipif(
        not (ROOT / path).exists(), reason=f"{path} is not in the source distribution; run this test in a clone"
    )
