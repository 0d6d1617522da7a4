"""Trees in compiled code beside OMPL's RRTConnect: the same problems, step, resolution and time, steps a second.

OMPL's asks this project's validator for each motion, as it does in every comparison with ``rrtconnect``. Compiled trees
take for blocked what the spheres do not prove free; how many of their paths pass the full proof as they are is a column
for both.

Usage: python -m benchmarks.planners.trees [-n 6] [--seeds 2]
"""

from __future__ import annotations

import time
from itertools import count
from types import SimpleNamespace
from typing import Any

import numpy as np
from ompl import base as ob
from tqdm import tqdm

from apex_ompl import problems
from apex_ompl.apex.stages.trees import ompl_trees
from apex_ompl.kernel.search import TreePair
from apex_ompl.ompl.process import quiet_ompl, seed_ompl
from apex_ompl.ompl.setup import PlanningSetup, assemble
from apex_ompl.ompl.space import path_to_array
from apex_ompl.ompl.tuned import TUNED
from apex_ompl.paths.path import SEARCH_RESOLUTION
from apex_ompl.types import Array
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.validation import one_or_more
from benchmarks.lib import record
from benchmarks.planners.apex_profile import HARD

DEPENDS = ("@planning",)
TIMEOUT = 5.0  # [s]
RANGE = TUNED["apex"]["range"]
KINDS = ("OMPL's", "compiled")


def of_ompl(ready: PlanningSetup, seed: int) -> tuple[Array | None, int, int]:
    """Return the path of OMPL's trees, or None, their number of nodes, and that of the steps that were tried."""
    seed_ompl(seed)
    si = ready.simple_setup.getSpaceInformation()
    validity, validator = si.getStateValidityChecker(), si.getMotionValidator()
    checker, check, steps, blocked = validity.checker, validator.check, count(), count()
    # RRTConnect asks for the motion of each step, but where it has asked for the end before, and that is blocked
    validator.check = lambda a, b: next(steps) >= 0 and check(a, b)
    validity.checker = SimpleNamespace(is_free=lambda q: checker.is_free(q) or next(blocked) < 0)
    try:
        tree, pdef = ompl_trees(si, [ready.start], ready.valid_goals[0], RANGE)
        solved = tree.solve(TIMEOUT).getStatus() == ob.PlannerStatus.EXACT_SOLUTION
    finally:
        validity.checker, validator.check = checker, check
    data = ob.PlannerData(si)
    tree.getPlannerData(data)
    path = path_to_array(pdef.getSolutionPath(), len(ready.start)) if solved else None
    return path, data.numVertices(), next(steps) + next(blocked)


def compiled(ready: PlanningSetup, seed: int) -> tuple[Array | None, int, int]:
    """Return the path of compiled trees, or None, their number of nodes, and that of the steps that were tried."""
    began = time.perf_counter()
    ends = ready.start[None], ready.valid_goals[:1]
    trees = TreePair(ready.checker.kernel, *ends, RANGE, SEARCH_RESOLUTION, np.random.default_rng(seed))
    found = trees.grow(10**9, lambda: time.perf_counter() - began > TIMEOUT)
    return found, trees.size, trees.steps


def main() -> None:
    """Measure, and write the results."""
    parser = record.parser(__doc__, n=6)
    parser.add_argument("--seeds", type=one_or_more, default=2, help="seeds of each (default: %(default)s)")
    args = parser.parse_args()
    names = [n for level in HARD for n in problems.frozen_names(*level.split("/"), "validation")[: args.n]]
    found: dict[str, list[dict[str, Any]]] = {kind: [] for kind in KINDS}
    with quiet_ompl():
        for name in tqdm(names, unit="problem"):
            ready = assemble(problems.load(name), seed=0)
            ready.checker.prepare()
            for seed in range(args.seeds):
                for kind, grow in zip(KINDS, (of_ompl, compiled), strict=True):
                    began = time.perf_counter()
                    path, nodes, steps = grow(ready, seed + 1)
                    took = time.perf_counter() - began
                    whole = path is not None and bool(ready.checker.prove(path, tolerance=0.0))
                    found[kind].append({
                        "solved": path is not None, "whole": whole, "nodes": nodes, "steps": steps, "seconds": took,
                    })  # fmt: skip
    head = ["trees", "N", "solved", "paths proved as they are", "ms p50", "p95", "mean"]
    head += ["nodes", "steps tried", "steps a second"]
    rows: list[list[Any]] = [head, ["---", *["---:"] * (len(head) - 1)]]
    rates, means = {}, {}
    for kind, runs in found.items():
        seconds = [run["seconds"] for run in runs]
        nodes, steps = (sum(run[key] for run in runs) for key in ("nodes", "steps"))
        rates[kind] = steps / sum(seconds)
        means[kind] = float(np.mean(seconds))
        p50, p95 = record.percentiles(seconds, 50, 95)
        shares = [f"{np.mean([run[key] for run in runs]):.3f}" for key in ("solved", "whole")]
        times = [f"{1e3 * v:.0f}" for v in (p50, p95, means[kind])]
        rows.append([kind, len(runs), *shares, *times, nodes, steps, f"{rates[kind]:.0f}"])
    text = "\n".join(record.row(row) for row in rows)
    faster, more = means[KINDS[0]] / means["compiled"], rates["compiled"] / rates[KINDS[0]]
    text += f"\n\n{faster:.1f} times as fast on average, {more:.1f} times as many steps a second."
    record.write("trees", found, text, split="validation", range=RANGE, resolution=SEARCH_RESOLUTION)


if __name__ == "__main__":
    run_script(main)
