"""Rate at which problems of each suite and level are drawn on one core, start and goal included [1/s].

Usage: python -m benchmarks.planners.sampling [-n 200] [SUITE[/LEVEL] ...]
"""

from __future__ import annotations

import time

import numpy as np

from apex_ompl import problems
from apex_ompl.util.entry_point import run_script
from benchmarks.lib import record

DEPENDS = ("@checking", "problems")
FIRST = 100_000  # seed of the first problem, of the training split


def main() -> None:
    """Measure and write."""
    parser = record.parser(__doc__, n=200, of="problems a level")
    parser.add_argument("levels", nargs="*", metavar="SUITE[/LEVEL]")
    args = parser.parse_args()
    every = [f"{suite}/{level}" for suite, levels in problems.suites().items() for level in levels]
    figures, rows = [], [["suite/level", "problems/s", "ms p50", "p95"], ["---", *["---:"] * 3]]
    for level in (v for v in every if not args.levels or v in args.levels or v.split("/")[0] in args.levels):
        suite, name = level.split("/")
        problems.sample(suite, level=name, seed=0)  # loads robot and held objects, compiles the kernel
        for seed in range(20):
            problems.sample(suite, level=name, seed=seed)
        spent = []
        for seed in range(FIRST, FIRST + args.n):
            started = time.perf_counter()
            problems.sample(suite, level=name, seed=seed)
            spent.append(time.perf_counter() - started)
        rate, (middle, slow) = 1.0 / float(np.mean(spent)), record.percentiles(spent, 50, 95)
        figures.append({"level": level, "problems_per_s": rate, "s_p50": middle, "s_p95": slow})
        rows.append([level, f"{rate:.0f}", f"{middle * 1e3:.1f}", f"{slow * 1e3:.1f}"])
    seeds = f"{FIRST} to {FIRST + args.n - 1}"
    record.write("sampling", {"levels": figures}, "\n".join(map(record.row, rows)), N=args.n, seeds=seeds)


if __name__ == "__main__":
    run_script(main)
