"""Where the time of apex goes on hard problems, and what was tried to make it less.

Every run is one call of ``APEX.solve`` without trees (``fallback=false``, ``bridge=false``) on a validation problem of
a hard level, in a warm process, with a limit of 5 s; one that finds nothing counts as endless. The first table holds
the stages of the planner as it is, shortening included; the second holds variants of it, without shortening: what was
taken is the first row. The third tells what the first sprint, RRTConnect's iterations before proposals, costs where it
does not help, and how often it is enough in open scenes; later sprints are left out there.

Usage: python benchmarks/apex_profile.py [-n 30]
"""

from __future__ import annotations

import argparse
import math
import time
from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np
import record
import torch
from ompl import base as ob

from apex_ompl import problems
from apex_ompl.apex import solver
from apex_ompl.ompl_adapter.process import quiet_ompl, seed_ompl
from apex_ompl.ompl_adapter.setup import PlanningSetup, assemble
from apex_ompl.planners.apex import APEX
from apex_ompl.planners.apex_parameters import ApexParameters
from apex_ompl.problems.reach import robot
from apex_ompl.trajopt.optimizer import Optimizer, Settings
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.validation import one_or_more

LIMIT, SEED = 5.0, 1  # [s]
TREELESS = {"fallback": False, "bridge": False}
HARD = ("shelf", "bins", "cage", "posts", "wall", "swap", "clutter")
OPEN = ("vertical/free", "vertical/small", "horizontal/small", "bins/easy", "wall/easy")
SPRINTS = (0, 20, 40, 80, 160)  # iterations
VARIANTS: dict[str, tuple[dict[str, Any], int | None]] = {
    "as it is": ({}, None),
    "1, 7, 24 proposals": ({"first": 1, "second": 7}, None),
    "2, 6, 24 proposals": ({"first": 2, "second": 6}, None),
    "8, 24, 24 proposals": ({"first": 8, "second": 24}, None),
    "128 samples in repair": ({}, 128),
    "48 samples": ({}, 48),
    "1, 7, 24 proposals, 128 samples: as it was": ({"first": 1, "second": 7}, 128),
    "1 denoising step": ({"denoising_steps": 1}, None),
    "3 denoising steps": ({"denoising_steps": 3}, None),
    "DPM-Solver++, 2 steps": ({"sampler": "dpm_solver", "denoising_steps": 2}, None),
    "guided": ({"guidance": True}, None),
    "no resampling": ({"resample": 0}, None),
    "2 resamplings a round": ({"resample": 2}, None),
    "no straight line": ({"line": False}, None),
}


def run(ready: PlanningSetup, samples: int | None = None, **params: Any) -> tuple[float, float, APEX]:
    """Return the time to a first path, that to the end, both endless without one, and the planner [s]."""
    setup = ready.simple_setup
    setup.clear()
    seed_ompl(SEED)
    planner = APEX(setup.getSpaceInformation(), ApexParameters(seed=SEED, **params))
    if samples is not None:
        planner.optimizer = Optimizer(planner.model.spline, Settings(samples=samples))
    setup.setPlanner(planner)
    setup.setup()
    begin = time.perf_counter()
    status = setup.solve(ob.timedPlannerTerminationCondition(LIMIT)).getStatus()
    took = time.perf_counter() - begin
    solved = status == ob.PlannerStatus.EXACT_SOLUTION
    return (planner.report.first if solved else math.inf), (took if solved else math.inf), planner


def times(values: Sequence[float]) -> list[str]:
    """Return percentiles of times in ms."""
    found = [record.reached(values, p) for p in (50, 80, 95)]
    return ["-" if v is None else f"{1e3 * v:.1f}" for v in found]


def stages(ready: Sequence[PlanningSetup]) -> tuple[dict[str, Any], list[str]]:
    """Return seconds by stage of the planner as it is, and a table."""
    told, took = list[dict[str, float]](), list[float]()
    for one in ready:
        _, total, planner = run(one, **TREELESS)
        if math.isfinite(total):
            took.append(total)
            told.append(planner.report.times)
    whole = sum(took)
    rows = [record.row(["stage", "share of the time", "mean ms", "p95 ms"]), record.row(["---", *["---:"] * 3])]
    figures = {}
    spent = {stage: [times.get(stage, 0.0) for times in told] for stage in {name for times in told for name in times}}
    for stage, values in sorted(spent.items(), key=lambda pair: -sum(pair[1])):
        share, mean, high = sum(values) / whole, sum(values) / len(took), record.reached(values, 95) or 0.0
        figures[stage] = {"share": share, "mean_s": mean, "p95_s": high}
        rows.append(record.row([stage, f"{share:.2f}", f"{1e3 * mean:.1f}", f"{1e3 * high:.1f}"]))
    rest = 1.0 - sum(f["share"] for f in figures.values())
    rows.append(record.row(["all else", f"{rest:.2f}", f"{1e3 * rest * whole / len(took):.1f}", ""]))
    return figures, rows


def variants(ready: Sequence[PlanningSetup]) -> tuple[dict[str, Any], list[str]]:
    """Return what comes of variants, and a table."""
    rows = [record.row(["variant", "solved", "first path ms p50", "p80", "p95", "by proposals as they are"])]
    rows.append(record.row(["---", *["---:"] * 5]))
    figures = {}
    for name, (params, samples) in VARIANTS.items():
        firsts, by = list[float](), Counter[str]()
        for one in ready:
            first, _, planner = run(one, samples, polish=False, **TREELESS, **params)
            firsts.append(first)
            by[planner.report.solved_by] += 1
        solved = float(np.mean(np.isfinite(firsts)))
        figures[name] = {"solved": solved, "first_s": [record.reached(firsts, p) for p in (50, 80, 95)], "by": dict(by)}
        rows.append(record.row([name, f"{solved:.3f}", *times(firsts), f"{by['apex'] / len(ready):.2f}"]))
        print(rows[-1], flush=True)
    return figures, rows


def sprints(hard: Sequence[PlanningSetup], scenes: Sequence[PlanningSetup]) -> tuple[dict[str, Any], list[str]]:
    """Return what comes of sprints of several lengths, and a table."""
    head = ["iterations", "open: enough for", "open: first path ms p50", "p80", "p95"]
    head += ["hard: enough for", "hard: sprint ms p50", "hard: first path ms p50", "p80", "p95"]
    rows = [record.row(head), record.row(["---:"] * len(head))]
    figures = {}
    for sprint in SPRINTS:
        cells: list[str] = [str(sprint)]
        for name, ready in (("open", scenes), ("hard", hard)):
            firsts, spent, enough = list[float](), list[float](), 0
            for one in ready:
                first, _, planner = run(one, polish=False, sprint=sprint)
                firsts.append(first)
                spent.append(planner.report.times.get("sprint", 0.0))
                enough += planner.report.solved_by == "sprint"
            figures[f"{sprint}, {name}"] = {
                "enough": enough / len(ready), "first_s": [record.reached(firsts, p) for p in (50, 80, 95)],
                "sprint_s": record.reached(spent, 50),
            }  # fmt: skip
            cells.append(f"{enough / len(ready):.2f}")
            cells += [times(spent)[0]] if name == "hard" else []
            cells += times(firsts)
        rows.append(record.row(cells))
        print(rows[-1], flush=True)
    return figures, rows


def main() -> None:
    """Measure and write the results."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "-n", type=one_or_more, default=30, help="validation problems of a level (default: %(default)s)"
    )
    args = parser.parse_args()
    torch.set_num_threads(1)

    def drawn(level: str) -> list[PlanningSetup]:
        names = problems.frozen_names(*level.split("/"), "validation")[: args.n]
        return [assemble(problems.load(name), robot()) for name in names]

    with quiet_ompl():
        hard = [one for suite in HARD for one in drawn(f"{suite}/hard")]
        scenes = [one for level in OPEN for one in drawn(level)]
        run(hard[0], **TREELESS)
        by_stage, first = stages(hard)
        by_variant, second = variants(hard)
        solver.LONGER = (1, 0, 0)
        by_sprint, third = sprints(hard, scenes)
    text = "\n".join([*first, "", *second, "", *third])
    figures = {"stages": by_stage, "variants": by_variant, "sprints": by_sprint}
    record.write(
        "apex_profile", figures, text, split="validation", N=f"{len(hard)} hard, {len(scenes)} open", seed=SEED,
    )  # fmt: skip


if __name__ == "__main__":
    run_script(main)
