"""GPMP and GPMP2 on static validation problems of each level, and with restarts, not part of the method, on easy ones.

They are local methods: they end without a path when they have nothing left to begin from. Open scenes are those
without obstacles, with small cubes, and the easy levels; each level is in the result. Problems that they are tuned
on are left out.
Each run is stored in benchmarks/runs/gpmp when it ends; the command resumes where it was stopped.

Usage: python -m benchmarks.planners.gpmp [SUITE[/LEVEL] ...] [-n 12] [--jobs 1] [--report]
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from apex_ompl.evaluation import Results, Row, Workers, bench
from apex_ompl.evaluation.summary import statistics, warnings
from apex_ompl.util.entry_point import run_script
from benchmarks.lib import record
from benchmarks.planners.head_to_head import together
from benchmarks.planners.tune import TUNED_ON

DEPENDS = ("@benchmark", "benchmarks/planners/head_to_head.py", "benchmarks/planners/tune.py")
FOLDER = Path(__file__).parents[1] / "runs" / "gpmp"
TIMEOUT = 10.0  # [s]
ROWS = (
    Row("gpmp", "gpmp"),
    Row("gpmp2", "gpmp2"),
    Row("gpmp2, 8 restarts", "gpmp2", {"restarts": 8}, levels=("/free", "/small", "/easy")),
)


def groups(levels: list[str]) -> dict[str, list[str]]:
    """Return the levels of the table's rows by name, the groups first."""
    found = {"without obstacles, and small cubes": ("/free", "/small"), "easy": ("/easy",), "medium": ("/medium",)}
    found |= {"hard and large": ("/hard", "/large"), "extreme": ("/extreme",)}
    several = {name: [level for level in levels if level.endswith(ends)] for name, ends in found.items()}
    return {name: some for name, some in several.items() if some} | {level: [level] for level in levels}


def main() -> None:
    """Run what is missing, and write the table."""
    parser = record.parser(__doc__, n=12, jobs=1)
    parser.add_argument("levels", nargs="*", metavar="SUITE[/LEVEL]", help="default: all static ones")
    parser.add_argument("--report", action="store_true", help="run nothing; write the results of the stored runs")
    args = parser.parse_args()
    levels = record.static_levels(args.levels)
    if not args.report:
        bench(
            levels, list(ROWS), FOLDER, runs=args.n, timeout=TIMEOUT, first=TUNED_ON, split="validation",
            workers=Workers(args.jobs), provenance=record.session(),
        )  # fmt: skip
    results = Results.load(FOLDER)
    mine = [run for run in results.runs if run["experiment"] in levels and 0 <= run["seed"] - TUNED_ON < args.n]
    results = replace(results, runs=mine)
    table = together(statistics(results), ROWS, groups(levels))
    text = "\n\n".join([*warnings(results), table.markdown()])
    data = {"table": {"title": table.title, "head": list(table.head), "rows": [list(row) for row in table.rows]}}
    about = {"timeout": f"{TIMEOUT:g} s", "n": args.n, "seeds": "number of the problem modulo 1000"}
    record.write("gpmp", data, text, split="validation", **about, **record.made_with(results))


if __name__ == "__main__":
    run_script(main)
