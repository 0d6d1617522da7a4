"""How good a model's proposals are: sampled, repaired and judged by the kernel alone."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Sequence

import numpy as np
import torch

from apex_ompl.datasets.cases import WrittenCase
from apex_ompl.diffusion.conditions import ObstacleSet, Query
from apex_ompl.diffusion.proposals import Sampling, TrajectoryModel
from apex_ompl.kernel import Kernel
from apex_ompl.trajopt.candidates import first_valid
from apex_ompl.trajopt.optimizer import Optimizer
from apex_ompl.util.resolution import FULL_RESOLUTION


def query_of_case(case: WrittenCase) -> Query:
    """Return a written problem as the model sees it."""
    return Query(case.start, case.goal, case.points[0], ObstacleSet.of(case.row.things))


def judged(
    model: TrajectoryModel, cases: Sequence[WrittenCase], count: int, *, sampling: Sampling | None = None, seed: int = 0
) -> dict[str, float]:
    """Return how many problems a model solves.

    Args:
        model: The model.
        cases: Problems.
        count: Proposals for each.
        sampling: How they are denoised.
        seed: Of the noise; one generator for each problem.

    Returns:
        Shares of the problems: ``sampled`` with a valid path among the proposals, ``repaired`` with one after the
        optimiser has worked on them, and the latter for each level by name; ``seconds``, the median of a problem.
    """
    optimizer = Optimizer(model.spline)
    sampled, repaired, seconds = [], [], []
    levels: dict[str, list[bool]] = defaultdict(list)
    for case in cases:
        kernel = Kernel(case.robot, case.scene)

        def is_valid(path: np.ndarray, kernel: Kernel = kernel) -> bool:
            return kernel.proves(path, FULL_RESOLUTION)

        begin = time.perf_counter()
        generator = torch.Generator().manual_seed(seed)
        control = model.propose(query_of_case(case), kernel, count, sampling=sampling, generator=generator).control
        direct = any(is_valid(model.spline.path(points)) for points in control)
        found = direct or first_valid(optimizer, kernel, control, is_valid) is not None
        seconds.append(time.perf_counter() - begin)
        sampled.append(direct)
        repaired.append(found)
        levels[f"{case.suite}/{case.level}"].append(found)
    said = {"sampled": float(np.mean(sampled)), "repaired": float(np.mean(repaired))}
    said["seconds"] = float(np.median(seconds))
    return said | {level: float(np.mean(found)) for level, found in sorted(levels.items())}
