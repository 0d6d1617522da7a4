"""Apex and its controls on the frozen problems of ``unseen``: scenes of kinds that no training data are of.

Rows: apex; the same planner with random perturbations, a network of random weights, another problem's conditions, or
    the
nearest training paths in the place of proposals; apex, random perturbations and random weights without trees, to see
what proposals are worth where nothing else searches; rrtconnect+polish; rrtconnect as OMPL has it and tuned; the
straight line and its repair, which ends by itself. With --model, apex with another checkpoint stands beside the one
that ships, under the checkpoint's digest; controls of a network are those of the one that ships.
Planners are tuned on the first 16 problems of a level, which are left out by default.
Each run is stored in benchmarks/runs/unseen when it ends; the command resumes where it was stopped.

Usage: python -m benchmarks.planners.unseen [LEVEL ...] [-n 34] [--first 16] [--rows NAME ...] [--model FOLDER] [--jobs
       1] [--report]
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from apex_ompl.evaluation import Results, Row, Workers, bench
from apex_ompl.evaluation.summary import statistics, warnings
from apex_ompl.model.checkpoint import read_config
from apex_ompl.ompl.tuned import TUNED
from apex_ompl.problems.catalogue import VALIDATION
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.validation import one_or_more
from benchmarks.lib import record
from benchmarks.lib.controls import checkpoint_digest
from benchmarks.planners.head_to_head import ROWS, TREELESS, together

DEPENDS = (
    "@benchmark", "benchmarks/lib/controls.py", "benchmarks/lib/control_planners.py",
    "benchmarks/planners/head_to_head.py",
)  # fmt: skip
FOLDER = record.RESULTS.parent / "runs" / "unseen"
TIMEOUT = 10.0  # [s]
FROZEN = 50  # problems of a level
TUNED_ON = 16  # the first of these
SUITE = "unseen"
CONTROLS = ("perturbations", "random weights", "shuffled conditions", "nearest paths")
WITHOUT = " without trees"
ALONE = tuple(name + WITHOUT for name in ("apex", "perturbations", "random weights"))
TREES = ("rrtconnect+polish", "rrtconnect", Row.of("rrtconnect", TUNED["rrtconnect"]).label, "straight line + repair")
NAMES = ("apex", *CONTROLS, *ALONE, *TREES)


def rows(names: Sequence[str], model: Path | None) -> list[Row]:
    """Return the rows of some names, and of apex with a checkpoint, labeled with its digest.

    Raises:
        ApexError: The checkpoint cannot be read.
    """
    known = {row.label: row for row in ROWS if row.label in TREES}
    known |= {name: Row(name, name) for name in CONTROLS} | {
        "perturbations": Row("perturbations", "apex", {"model": "none"})
    }
    known["apex"] = Row("apex", "apex")
    for name in ALONE:
        whole = known[name.removesuffix(WITHOUT)]
        known[name] = Row(name, whole.planner, {**whole.params, **TREELESS})
    found = [known[name] for name in names]
    if model is not None:
        read_config(model)
        found.append(Row(f"apex, {checkpoint_digest(model)}", "apex", {"model": str(model.resolve())}))
    return found


def main() -> None:
    """Run what is missing, and write the table."""
    parser = record.parser(__doc__, jobs=1)
    parser.add_argument("levels", nargs="*", metavar="LEVEL", help="of unseen (default: all)")
    parser.add_argument(
        "-n", type=one_or_more, default=FROZEN - TUNED_ON, help="problems of a level (default: %(default)s)"
    )
    parser.add_argument("--first", type=int, default=TUNED_ON, help="those left out before (default: %(default)s)")
    parser.add_argument("--rows", nargs="*", choices=NAMES, default=NAMES, metavar="NAME", help="(default: all)")
    parser.add_argument("--model", type=Path, metavar="FOLDER", help="checkpoint beside the one that ships")
    parser.add_argument("--store", type=Path, default=FOLDER, help="folder of the runs")
    parser.add_argument("--report", action="store_true", help="run nothing; write the results of the stored runs")
    args = parser.parse_args()
    if not 0 <= args.first <= FROZEN - args.n or not set(args.levels) <= set(VALIDATION[SUITE]):
        parser.error(f"expected --first and -n of {FROZEN} at most together, levels {', '.join(VALIDATION[SUITE])}")
    levels = [f"{SUITE}/{level}" for level in args.levels or VALIDATION[SUITE]]
    wanted, workers = rows(args.rows, args.model), Workers(args.jobs, modules=("benchmarks.lib.control_planners",))
    if not args.report:
        bench(
            levels, wanted, args.store, runs=args.n, first=args.first, timeout=TIMEOUT, split="validation",
            workers=workers, provenance=record.session(),
        )  # fmt: skip
    results = Results.load(args.store)
    labels, seeds = {row.label for row in wanted}, range(args.first, args.first + args.n)
    mine = [r for r in results.runs if r["label"] in labels and r["experiment"] in levels and r["seed"] in seeds]
    results = replace(results, runs=mine)
    table = together(statistics(results), wanted, {"all": levels, **{level: (level,) for level in levels}})
    text = "\n\n".join([*warnings(results), table.markdown()])
    data = {"table": {"title": table.title, "head": list(table.head), "rows": [list(row) for row in table.rows]}}
    about = {"timeout": f"{TIMEOUT:g} s", "seeds": f"{seeds[0]} to {seeds[-1]}"}
    record.write("unseen", data, text, split="validation", **about, **record.made_with(results))


if __name__ == "__main__":
    run_script(main)
