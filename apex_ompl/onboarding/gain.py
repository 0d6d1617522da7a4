"""What the proposals of a model gain: plans with and without the model on validation problems, in the same time.

Both plans of a problem have the same seed and time limit; the order changes from problem to problem, and the scene is
loaded before. Where trees find all paths before proposals are drawn, there is no gain whatever the times are. Apex
without a model takes random perturbations of straight lines in the place of proposals.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Iterator, Sequence, Set
from typing import Any, NamedTuple

import numpy as np

from apex_ompl.apex.model_search import NONE
from apex_ompl.planning.planner import MotionPlanner
from apex_ompl.planning.steps import STRAIGHT_LINE
from apex_ompl.problems.catalogue import SuiteError
from apex_ompl.problems.robot_problems import name_of
from apex_ompl.scene.problem import Problem
from apex_ompl.training.units import Unit, drawn_problem

ENOUGH = 20  # problems from which on a gain is told
CONFIDENCE = 1.96  # standard deviations of a 95 % interval
SEED = 0
WARM = 0.01  # time limit of the plan that loads the scene of a problem, before the two that are measured [s]
TREES = "sprint"  # what finds paths before proposals are drawn


class Pair(NamedTuple):
    """Two plans of a problem.

    Attributes:
        problem: Its id.
        solved: Whether a path was found with the model, and without.
        seconds: CPU time of the plan with the model, and without [s].
        stage: What found the path with the model, see :class:`apex_ompl.PlanResult`; empty without one.
    """

    problem: str
    solved: tuple[bool, bool]
    seconds: tuple[float, float]
    stage: str


def pairs(
    planner: MotionPlanner, model: str, units: Iterable[Unit], timeout: float, known: Set[str] = frozenset()
) -> Iterator[Pair]:  # fmt: skip
    """Yield the two plans of each problem of some units whose straight line is not free.

    Args:
        planner: A planner of the robot.
        model: Folder of the checkpoint.
        units: Units of validation problems.
        timeout: Time limit of a plan [s].
        known: Ids of problems that are left out.
    """
    count = 0
    for unit in units:
        for seed in unit.seeds:
            if name_of(planner.robot, unit.level, seed) in known:
                continue
            try:
                problem, _ = drawn_problem(unit, seed)
            except SuiteError:
                continue
            order = (model, NONE) if count % 2 else (NONE, model)
            if not count:  # the first plans load what all others find
                for name in order:
                    _planned(planner, problem, name, timeout)
            planner.plan_problem(problem, params={"model": NONE}, timing=False, timeout=WARM, seed=SEED)
            outcomes, count = dict[str, tuple[bool, float, str]](), count + 1
            for name in order:
                outcomes[name] = _planned(planner, problem, name, timeout)
                if outcomes[name][2] == STRAIGHT_LINE:
                    break
            if len(outcomes) == len(order):
                (solved, seconds, stage), (without, others, _) = outcomes[model], outcomes[NONE]
                yield Pair(problem.name, (solved, without), (seconds, others), stage)


def _planned(planner: MotionPlanner, problem: Problem, model: str, timeout: float) -> tuple[bool, float, str]:
    """Return whether a plan finds a path, its CPU time [s], and what found it."""
    started = time.process_time()
    result = planner.plan_problem(problem, params={"model": model}, timing=False, timeout=timeout, seed=SEED)
    return bool(result), time.process_time() - started, result.solved_by


def summary(found: Sequence[Pair], timeout: float) -> dict[str, Any]:
    """Return the figures of some pairs, ready for JSON.

    Args:
        found: The pairs.
        timeout: Time limit of their plans [s].

    Returns:
        ``problems``; ``solved``, ``p50`` and ``p95`` of the CPU time [s], each with the model and without; ``ratio``,
        the geometric mean of the ratios of the times of problems that both solve, with its 95 % ``interval``;
        ``stages`` that found the paths with the model, by number; and ``verdict``, a sentence.
    """
    solved = [sum(pair.solved[side] for pair in found) for side in (0, 1)]
    seconds = np.array([pair.seconds for pair in found]).reshape(-1, 2)
    logs = np.log([pair.seconds[0] / pair.seconds[1] for pair in found if all(pair.solved)])
    middle = float(logs.mean()) if len(logs) else math.nan
    half = CONFIDENCE * float(logs.std(ddof=1)) / math.sqrt(len(logs)) if len(logs) > 1 else math.nan
    interval = [math.exp(middle - half), math.exp(middle + half)]
    stages = [pair.stage for pair in found if pair.solved[0]]
    quantiles = np.quantile(seconds, (0.5, 0.95), axis=0) if len(seconds) else np.full((2, 2), math.nan)
    numbers: dict[str, Any] = {
        "problems": len(found), "timeout": timeout, "solved": solved, "p50": quantiles[0].tolist(),
        "p95": quantiles[1].tolist(), "ratio": math.exp(middle), "interval": interval,
        "stages": {stage: stages.count(stage) for stage in sorted(set(stages))},
    }  # fmt: skip
    told = {key: _finite(value) for key, value in numbers.items()}
    verdict = _verdict(len(found), solved, interval)
    if set(stages) == {TREES} and len(found) >= ENOUGH:
        verdict = "no gain: trees found all paths before proposals were drawn"
    return told | {"verdict": verdict}


def _finite(value: Any) -> Any:
    """Return a value with None for numbers that are not finite, rounded."""
    if isinstance(value, list):
        return [_finite(one) for one in value]
    if isinstance(value, float):
        return float(f"{value:.4g}") if math.isfinite(value) else None
    return value


def _verdict(count: int, solved: Sequence[int], interval: Sequence[float]) -> str:
    low, high = interval
    if count < ENOUGH or math.isnan(low):
        return f"too few problems to tell whether proposals gain: {count}, expected {ENOUGH} or more"
    if high < 1.0 and solved[0] >= solved[1]:
        return f"proposals gain: {1.0 - high:.0%} or more of the CPU time is saved, at a confidence of 95 %"
    if low > 1.0 and solved[0] <= solved[1]:
        return f"proposals do not gain: {low - 1.0:.0%} or more CPU time is taken, at a confidence of 95 %"
    return "no gain by proposals was measured: the CPU times are the same within 95 % confidence"
