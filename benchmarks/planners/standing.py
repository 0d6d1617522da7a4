"""Where apex stands on the hard, large and extreme levels of the test split, and what its network and its trees add.

Rows: apex; the same planner with random perturbations in place of the network's proposals, and with no proposals at
    all; apex
without trees; rrtconnect+polish and rrtconnect with the tuned range. Runs are stored with those of head_to_head.py, in
benchmarks/runs/head_to_head, and those that are there are not made again; the command resumes where it was stopped.

Usage: python -m benchmarks.planners.standing [SUITE[/LEVEL] ...] [-n 30] [--jobs 1]
"""

from __future__ import annotations

from dataclasses import replace

from apex_ompl.evaluation import Row, Workers, bench
from apex_ompl.evaluation.summary import statistics, warnings
from apex_ompl.ompl.tuned import TUNED
from apex_ompl.util.entry_point import run_script
from benchmarks.lib import record
from benchmarks.planners import head_to_head

DEPENDS = (
    "@benchmark", "benchmarks/lib/controls.py", "benchmarks/lib/control_planners.py",
    "benchmarks/planners/head_to_head.py",
)  # fmt: skip
KINDS = ("hard", "large", "extreme")
NO_PROPOSALS = {"first": 0, "second": 0, "third": 0, "resample": 0}
TREES = ("rrtconnect+polish", Row.of("rrtconnect", TUNED["rrtconnect"]).label)
ROWS = (
    *(row for row in head_to_head.ROWS if row.label in ("apex", "apex without trees")),
    Row("apex, perturbations for proposals", "apex", {"model": "none"}),
    Row("apex without proposals", "apex", NO_PROPOSALS),
    *(row for row in head_to_head.ROWS if row.label in TREES),
)


def main() -> None:
    """Run what is missing, and write the table."""
    parser = record.parser(__doc__, n=30, jobs=1)
    parser.add_argument("levels", nargs="*", metavar="SUITE[/LEVEL]")
    args = parser.parse_args()
    levels = [level for level in record.static_levels(args.levels) if level.split("/")[1] in KINDS]
    if not levels:
        parser.error(f"no level of the kinds {', '.join(KINDS)} is named")
    workers = Workers(args.jobs)
    results = bench(
        levels, ROWS, head_to_head.FOLDER, runs=args.n, timeout=head_to_head.TIMEOUT, workers=workers,
        keep=True, provenance=record.session(),
    )  # fmt: skip
    labels = {row.label for row in ROWS}
    mine = [r for r in results.runs if r["label"] in labels and r["experiment"] in levels and r["seed"] < args.n]
    results = replace(results, runs=mine)
    groups = {"all": KINDS, **{kind: (kind,) for kind in KINDS}, **{level: (level,) for level in levels}}
    table = head_to_head.together(statistics(results), ROWS, groups)
    text = "\n\n".join([*warnings(results), table.markdown()])
    data = {"table": {"title": table.title, "head": list(table.head), "rows": [list(row) for row in table.rows]}}
    about = {"timeout": f"{head_to_head.TIMEOUT:g} s", "seeds": f"0 to {args.n - 1}"}
    record.write("standing", data, text, split="test", **about, **record.made_with(results))


if __name__ == "__main__":
    run_script(main)
