"""The figure of FID: how far paths of models and planners are from solutions of the same problems."""

from __future__ import annotations

from argparse import Namespace
from dataclasses import asdict
from typing import Any

import numpy as np
from paper import realism
from paper.figure import Made, blank, of_runs
from paper.rows import PLANNERS, STATIC, color, installed
from paper.static import runs_of

from apex_ompl import planners
from apex_ompl.evaluation import metrics
from apex_ompl.evaluation.summary import Table
from apex_ompl.problems.catalogue import SPLITS

LEVELS = tuple(level for level in STATIC if level.endswith(("/small", "/medium", "/large")))
"""Levels that the models know from training."""
PLANNED = ("rrt", "rrtconnect", "drrt", "gpmp", "gpmp2", "il", "damon", "damon, stored")
LIMIT = 2.0  # of a planner [s]
LEAST = 4  # paths of a row, for an interval


def fid(args: Any) -> Made:
    """Return FID and KID of all algorithms, with N, d, the floor and the interval."""
    units = realism.solutions(args.keep / f"solutions_{args.n}", args.n, LEVELS, args.jobs)
    real = realism.one_each(units, args.n)
    rows = [realism.proposing(model, guided=guided) for model in realism.MODELS for guided in (True, False)]
    found = [row for row in PLANNERS if row.label in PLANNED]
    rows += [realism.planning(row) for row in installed(found, planners.names())]
    first = SPLITS["validation"].start
    each = 1 + max(int(name.rsplit("/", 1)[1]) for name in real) - first
    wanted = Namespace(n=each, keep=args.keep, report=False, parts=None)
    results = runs_of(wanted, [(LEVELS, rows)], "paper_paths", jobs=args.jobs, timeout=LIMIT, split="validation")
    data: dict[str, Any] = {}
    lines, picture = [], blank(10, 4.6)
    for axis, (name, features) in zip(picture.subplots(1, 2), realism.feature_spaces().items(), strict=True):
        truth, floor = dict(zip(real, features(list(real.values())), strict=True)), 0.0
        for k, row in enumerate(rows):
            mine = [run for run in results.runs if run["label"] == row.label and run["problem"] in real]
            solved = [run for run in mine if run["solved"]]
            paths = [np.array(run["control"]) for run in solved]
            if len(paths) < LEAST:
                print(f"{row.label}: left out, {len(paths)} paths of {len(mine)}", flush=True)
                continue
            r = metrics.realism(np.stack([truth[run["problem"]] for run in solved]), features(paths))
            took = 1e3 * float(np.mean([run["total"] for run in mine if run["total"] is not None]))
            data[f"{name}, {row.label}"] = {**asdict(r), "of": len(mine), "CPU ms a path": took}
            ends = f"{r.interval[0]:.2f} to {r.interval[1]:.2f}"
            measured = [str(r.dimension), f"{r.fid:.2f}", ends, f"{r.floor:.2f}", f"{r.kid:.4f}", f"{took:.1f}"]
            lines.append([name, row.label, f"{r.made} of {len(mine)}", *measured])
            axis.bar(k, r.fid, color=color(row.label))
            axis.plot([k, k], np.maximum(r.interval, 1e-2), color="black", linewidth=1)
            floor = max(floor, r.floor)
        axis.axhline(floor, color="gray", linestyle=":")
        axis.set_yscale("log")
        axis.set_title(f"FID, {name} features (dots: floor)")
        axis.set_xticks(range(len(rows)), [row.label for row in rows], rotation=40, fontsize=7, ha="right")
    head = ["features", "paths", "N", "d", "FID", "95 %", "floor", "KID", "CPU ms a path"]
    notes, commits = of_runs(results, planned=False)
    notes += [
        ("Real", f"solutions of {len(real)} validation problems, one each, of {', '.join(LEVELS)}"),
        ("Made", f"one path for each: of the models one proposal by their own sampling, valid or not; of planners what "
                 f"they find in {LIMIT:g} s, beside the solutions of the problems that they solve"),
        ("Floor", "FID between two halves of the real set, of other problems each: larger than it would be for all"),
    ]  # fmt: skip
    return Made(data, [Table("FID and KID", head, lines)], notes, picture, commits)
