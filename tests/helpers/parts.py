"""Parts of broad scenes for the tests: some drawn at random, their poses, and how near they are to points."""

from __future__ import annotations

import numpy as np

from apex_ompl.problems.broad import shapes
from apex_ompl.problems.broad.scattered import solid
from apex_ompl.problems.broad.surfaces import distances


def some_parts(count: int = 12, seed: int = 0) -> shapes.Parts:
    rng = np.random.default_rng(seed)
    return [
        p for _ in range(count) for p in shapes.place(solid(rng, 0.05, 0.3), shapes.shift(*rng.uniform(-0.4, 0.4, 3)))
    ]


def poses(parts: shapes.Parts) -> np.ndarray:
    return np.array([part.pose for part in parts])


def nearest(parts: shapes.Parts, points: np.ndarray) -> np.ndarray:
    return distances(parts, points).min(axis=0)
