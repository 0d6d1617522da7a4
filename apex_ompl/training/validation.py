"""Success rates of a model on validation problems, checked by the kernel alone."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Sequence

import numpy as np

from apex_ompl.kernel import Kernel
from apex_ompl.model.proposals import Sampling, TrajectoryModel
from apex_ompl.model.query import ObstacleSet, Query
from apex_ompl.paths.candidates import first_valid
from apex_ompl.paths.optimizer import Optimizer
from apex_ompl.paths.path import FINE_RESOLUTION
from apex_ompl.training.kernel_problems import KernelProblem
from apex_ompl.training.records import held_extents


def query_from_problem(problem: KernelProblem) -> Query:
    """Return the model's query of a problem."""
    obstacles = ObstacleSet.from_rows(problem.record.obstacles)
    held = held_extents(problem.record.held)
    return Query(problem.start, problem.goal, problem.points[0], obstacles, held=held)


def success_rates(
    model: TrajectoryModel, problems: Sequence[KernelProblem], count: int, *, sampling: Sampling | None = None,
    seed: int = 0,
) -> dict[str, float]:  # fmt: skip
    """Return the shares of problems that a model solves.

    Args:
        model: The model.
        problems: Problems to solve.
        count: Number of proposals for each.
        sampling: Parameters of sampling; by default the model's own.
        seed: Seed of the noise; each problem has a generator of its own.

    Returns:
        Shares of the problems: ``sampled`` with a valid path among the proposals, ``repaired`` with a valid path before
        or after optimization of the proposals, and the latter by level, ``suite/level``. ``seconds`` is the median
        time of a problem [s].
    """
    optimizer = Optimizer(model.spline)
    sampled, repaired, seconds = [], [], []
    levels: dict[str, list[bool]] = defaultdict(list)
    for problem in problems:
        kernel = Kernel(problem.robot, problem.scene)

        def is_valid(path: np.ndarray, kernel: Kernel = kernel) -> bool:
            return kernel.proves(path, FINE_RESOLUTION)

        started = time.perf_counter()
        generator = np.random.default_rng(seed)
        query = query_from_problem(problem)
        control = model.propose(query, kernel, count, sampling=sampling, generator=generator).control
        direct = any(is_valid(model.spline.path(points)) for points in control)
        found = direct or first_valid(optimizer, kernel, control, is_valid) is not None
        seconds.append(time.perf_counter() - started)
        sampled.append(direct)
        repaired.append(found)
        levels[f"{problem.suite}/{problem.level}"].append(found)
    rates = {"sampled": float(np.mean(sampled)), "repaired": float(np.mean(repaired))}
    rates["seconds"] = float(np.median(seconds))
    return rates | {level: float(np.mean(found)) for level, found in sorted(levels.items())}
