"""Parts of broad scenes for the tests: some drawn at random, their poses, and how near they are to points."""

from __future__ import annotations

import numpy as np

from apex_ompl.problems import broad_parts
from apex_ompl.problems.broad_representation import distances
from apex_ompl.problems.broad_structures import solid


def some_parts(count: int = 12, seed: int = 0) -> broad_parts.Parts:
    rng = np.random.default_rng(seed)
    return [
        p
        for _ in range(count)
        for p in broad_parts.place(solid(rng, 0.05, 0.3), broad_parts.shift(*rng.uniform(-0.4, 0.4, 3)))
    ]


def poses(parts: broad_parts.Parts) -> np.ndarray:
    return np.array([part.pose for part in parts])


def nearest(parts: broad_parts.Parts, points: np.ndarray) -> np.ndarray:
    return distances(parts, points).min(axis=0)
