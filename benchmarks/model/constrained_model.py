"""Whether a model that is told the constraints of a path proposes better ones than the shipped model.

``data``: paths under constraints, of problems of the train split, see benchmarks/model/constrained_data.py.
``train``: two models start from the weights of ``apex`` and go on with these paths, with the same steps, batches,
learning rates and seeds, on one core: ``constrained`` is told the constraints (benchmarks/model/constrained_told.py),
``paths`` is not.
``compare``: both and ``apex`` itself on validation problems of the suites and of unseen kinds. Those that are frozen
are left out: planners are compared on them elsewhere. Shown are how far 16 proposals are off the constraints, and which
of them become paths when they are optimized under constraints; then the planner, with trees and without. ``line fails``
are the problems whose straight line does not become a path. Raw proposals at lower temperatures follow, of some of the
problems, and those of ``constrained`` without what it is told.

Everything is kept in benchmarks/runs/constrained_model and resumed from there; a comparison has a folder of its own for
each set of checkpoints. On one core, data take 10 minutes, training 10, the comparison 25.

Usage: python -m benchmarks.model.constrained_model [--part data train compare] [--problems 1680] [--steps 600]
       [--batch 128] [-n 8] [--unseen 48]
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from apex_ompl import load_model
from apex_ompl.evaluation import Row, Workers, bench
from apex_ompl.evaluation.runs import NO_PROBLEM, Run
from apex_ompl.model.checkpoint import SHIPPED, read_config
from apex_ompl.problems.broad import UNSEEN
from apex_ompl.problems.catalogue import CONSTRAINED, SPLITS, VALIDATION
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.statistics import share_interval
from apex_ompl.util.validation import one_or_more
from benchmarks.lib import record
from benchmarks.lib.controls import digest
from benchmarks.model import constrained_data, constrained_told
from benchmarks.model.constrained_data import PATHS
from benchmarks.model.constrained_runs import LINE as LINE_KEY
from benchmarks.model.constrained_runs import TEMPERATURES
from benchmarks.timing.motions import cells, table

DEPENDS = (
    "@benchmark", "apex_ompl/constraints", "apex_ompl/training", "benchmarks/model/constrained_data.py",
    "benchmarks/model/constrained_told.py", "benchmarks/model/constrained_runs.py",
    "scripts/configs/apex-continued.yaml",
)  # fmt: skip
FOLDER = record.RESULTS.parent / "runs" / "constrained_model"
ROBOT = record.ROOT / "data" / "dual_panda_softhand" / "robot.npz"
CONFIG = record.ROOT / "scripts" / "configs" / "apex-continued.yaml"
PARTS = ("data", "train", "compare")
APEX, CONSTRAINED_MODEL = "apex", "constrained"
TRAINED = (PATHS, CONSTRAINED_MODEL)
FIRST = 200  # seeds of the validation split that are left out
TIMEOUT = 60.0  # of a run on the clock [s]; the planner has a limit of CPU time
RATE, WARMUP, EMA = 3e-4, 100, 0.998
LOG_EVERY = 200  # steps
DRAWS = 2000  # of the bootstrap
MODULE = "benchmarks.model.constrained_runs"
LINE, UNTOLD = "straight line", f"{CONSTRAINED_MODEL}, told zeros"
RAW = (2, 8)  # problems of a level whose raw proposals are looked at, and of a level of unseen kinds
LEVELS = tuple(f"unseen, {level}" for level in CONSTRAINED[UNSEEN])  # groups that are too small for pairs of rows
KINDS = ("proposals", "planner without trees", "planner")
PAIRS = ((CONSTRAINED_MODEL, APEX), (CONSTRAINED_MODEL, PATHS), (PATHS, APEX))


def trained(args: argparse.Namespace, name: str) -> Path:
    """Train a model, told the constraints or not, or go on with that, and return its folder."""
    run: Path = args.store / f"trained-{name}-{args.problems}-{args.steps}x{args.batch}"
    run.mkdir(parents=True, exist_ok=True)
    if (run / "checkpoint").is_dir() and read_config(run / "checkpoint").trained["step"] == args.steps:
        return run
    import torch

    from apex_ompl.training.config import TrainingConfig
    from apex_ompl.training.training import DistributedProcess, Trainer

    torch.set_num_threads(1)
    # Objects are held in all problems: nothing is mirrored, and no obstacles of other scenes are added.
    changes: dict[str, Any] = {"data": str(args.store / PATHS), "initial": APEX, "cases": None, "mirror": None}
    changes |= {"mixed": 0.0, "robot": str(ROBOT), "steps": args.steps, "batch": args.batch, "rate": RATE}
    changes |= {"warmup": WARMUP, "ema": EMA, "log_every": LOG_EVERY}
    is_told = name == CONSTRAINED_MODEL
    kind = constrained_told.told_trainer(constrained_data.told_of(args.store)) if is_told else Trainer
    kind(TrainingConfig.read(CONFIG, changes), run, DistributedProcess.current()).run()
    return run


def data(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    """Make the data, and return their statistics."""
    for _ in constrained_data.make(args.store, args.problems, load_model(APEX)):
        pass
    found = constrained_data.statistics(args.store)
    head, rows = ["", "p5", "p50", "p95"], [["length / straight line", *cells(found.detour.tolist(), (5, 50, 95))]]
    for name, off in (("as stored", found.stored), ("in the latent space of apex", found.latent)):
        for what, unit, values in zip(("distance", "angle", "tilt"), ("mm", "mrad", "mrad"), off.T, strict=True):
            some = values[~np.isnan(values)].tolist()
            rows.append([f"largest {what} along a path {name} [{unit}]", *cells(some, (5, 50, 95), 1e3, 1)])
    about = f"{found.paths} paths, both directions counted, of {found.solved} of {found.drawn} problems."
    return {"paths": found.paths, "solved": found.solved, "drawn": found.drawn, "rows": rows}, about + "\n\n" + table(
        head, rows, 1
    )


def train(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    """Train both models, and return their losses."""
    from apex_ompl.training.run import read_log

    head, lines = ["model", "steps", "batch", "minutes", "step", "loss", "held-out loss"], []
    for name in TRAINED:
        log = read_log(trained(args, name))
        minutes = f"{float(log[-1]['seconds']) / 60:.0f}"
        lines += [[name, args.steps, args.batch, minutes, row["step"], row["loss"], row["held_out"]] for row in log]
    return {"rows": [dict(zip(head, line, strict=True)) for line in lines]}, table(head, lines, 1)


def checkpoints(args: argparse.Namespace) -> dict[str, Path]:
    """Return the folders of the models by name."""
    return {APEX: SHIPPED / APEX, **{name: trained(args, name) / "checkpoint" for name in TRAINED}}


def rows_of(models: Mapping[str, Path]) -> list[Row]:
    """Return the rows that are run; the label of a row of a model is that of its kind and the model's name."""
    kinds = zip(KINDS, ("proposed", "planned", "planned"), ({}, {"trees": False}, {"trees": True}), strict=True)
    return [
        Row(LINE, APEX, runner=f"{MODULE}:line"),
        *(
            Row(f"{kind}, {name}", APEX, {"model": str(folder), **more}, runner=f"{MODULE}:{runner}")
            for kind, runner, more in kinds for name, folder in models.items()
        ),
    ]  # fmt: skip


def problems_of(count: int, unseen: int) -> list[str]:
    """Return the ids of the problems: so many of each level, and of each level of unseen kinds, the levels in turn."""
    levels = [(suite, level) for suite, some in CONSTRAINED.items() for level in some]
    return [
        f"{suite}/{level}/{SPLITS['validation'][FIRST + number]}"
        for number in range(max(count, unseen))
        for suite, level in levels
        if number < (unseen if suite in VALIDATION else count)
    ]


def groups_of(runs: Sequence[Run]) -> dict[str, set[str]]:
    """Return the problems by group: suites and unseen, all of them and those whose line fails, and levels of unseen."""
    failing = {run["problem"] for run in runs if run["label"] == LINE and not run["solved"]}
    found: dict[str, set[str]] = {}
    for problem in sorted({run["problem"] for run in runs}):
        suite, level, _ = problem.split("/")
        kind = "unseen" if suite in VALIDATION else "suites"
        found.setdefault(kind, set()).add(problem)
        found.setdefault(f"{kind}, line fails", set())
        if problem in failing:
            found[f"{kind}, line fails"].add(problem)
        if suite in VALIDATION:
            found.setdefault(f"unseen, {level}", set()).add(problem)
    return dict(sorted(found.items()))


def share(count: int, of: int) -> str:
    """Return a share and its 95 % interval (Wilson) as a cell of a table."""
    if not of:
        return "-"
    low, high = share_interval(count, of)
    return f"{count / of:.3f} ({low:.3f} to {high:.3f})"


def times(runs: Sequence[Run]) -> list[str]:
    """Return p50 and p95 of the CPU time until the first proved path as cells [ms]; unsolved runs take forever."""
    values = [run["first_cpu"] if run["solved"] else math.inf for run in runs]
    found = [record.reached(values, p) for p in (50, 95)]
    return ["-" if value is None else f"{1e3 * value:.0f}" for value in found]


PROPOSALS_HEAD = (
    "problems", "row", "N", "on the first proposal (95 %, Wilson)", "within 16 (95 %, Wilson)", "share of proposals",
    "first path CPU ms p50", "p95", "raw distance mm p50", "angle mrad p50", "tilt mrad p50",
)  # fmt: skip
PLANNER_HEAD = (
    "problems", "row", "N", "solved (95 %, Wilson)", "by proposals", "faults", "first path CPU ms p50", "p95",
    "end CPU ms p50", "length rad p50",
)  # fmt: skip


def proposals_line(group: str, row: str, runs: Sequence[Run]) -> list[Any]:
    """Return the line of proposals of a model."""
    count = len(runs)
    off = [[value for run in runs for value in run[name]] for name in ("distance", "angle", "tilt")]
    return [
        group, row, count, share(sum(run["on_first"] for run in runs), count),
        share(sum(run["solved"] for run in runs), count), f"{np.mean([run['valid'] for run in runs]):.3f}",
        *times(runs), *(cells(values, (50,), 1e3, 0)[0] for values in off),
    ]  # fmt: skip


def planner_line(group: str, row: str, runs: Sequence[Run]) -> list[Any]:
    """Return the line of the planner with a model."""
    solved = [run for run in runs if run["solved"]]
    return [
        group, row, len(runs), share(len(solved), len(runs)), sum("apex" in run["by"] for run in solved),
        sum(bool(run["fault"]) for run in runs), *times(runs), *cells([run["cpu"] for run in runs], (50,), 1e3, 0),
        *cells([run["length"] for run in solved], (50,), 1.0, 2),
    ]  # fmt: skip


PAIRED_HEAD = (
    "problems", "what", "row", "beside", "N", "alone solved", "the other alone", "share of proposals, difference",
    "95 % (bootstrap over problems)", "first CPU ratio", "95 %", "length ratio", "95 %",
)  # fmt: skip


RAW_HEAD = (
    "problems", "row", "temperature", "N", "distance mm p50", "p95", "angle mrad p50", "p95", "tilt mrad p50", "p95",
)  # fmt: skip


def raw_rows(models: Mapping[str, Path]) -> list[Row]:
    """Return the rows of raw proposals: of each model, and of the one that is told, without what it is told."""
    some = [(name, name, True) for name in models] + [(UNTOLD, CONSTRAINED_MODEL, False)]
    return [
        Row(label, APEX, {"model": str(models[name]), "told": is_told}, runner=f"{MODULE}:raw")
        for label, name, is_told in some
    ]


def raw_lines(runs: Sequence[Run]) -> list[list[Any]]:
    """Return the lines of raw proposals, and of the straight line."""
    found = []
    for group in ("suites", UNSEEN):
        there = [run for run in runs if run["problem"].startswith(f"{UNSEEN}/") == (group == UNSEEN)]
        labels = dict.fromkeys(run["label"] for run in there)
        for label, name in [(APEX, LINE_KEY), *((some, f"{t:g}") for some in labels for t in TEMPERATURES)]:
            mine = [run[name] for run in there if run["label"] == label]
            off = [[value for run in mine for value in run[k]] for k in range(3)]
            row = (LINE, "-") if name == LINE_KEY else (label, name)
            found.append([group, *row, len(mine), *(c for some in off for c in cells(some, (50, 95), 1e3, 0))])
    return found


def paired(group: str, kind: str, one: str, other: str, runs: Sequence[Run]) -> list[Any]:
    """Return how a model compares with another one on the same problems."""
    mine, theirs = (
        {run["problem"]: run for run in runs if run["label"] == f"{kind}, {name}"} for name in (one, other)
    )  # fmt: skip
    both = [(mine[problem], theirs[problem]) for problem in sorted(set(mine) & set(theirs))]
    alone = [sum(a["solved"] and not b["solved"] for a, b in some) for some in (both, [(b, a) for a, b in both])]
    solved = [(a, b) for a, b in both if a["solved"] and b["solved"]]
    shares = interval([a["valid"] - b["valid"] for a, b in both]) if kind == KINDS[0] else ("-", "-")
    ratios = [interval([math.log(a[name] / b[name]) for a, b in solved], log=True) for name in ("first_cpu", "length")]
    return [group, kind, one, other, len(both), *alone, *shares, *ratios[0], *ratios[1]]


def interval(values: Sequence[float], *, log: bool = False) -> tuple[str, str]:
    """Return the mean of one value a problem and its 95 % interval; of ratios, from their logarithms, the geometric."""
    if not values:
        return "-", "-"
    given = np.array(values)
    means = given[np.random.default_rng(0).integers(len(given), size=(DRAWS, len(given)))].mean(axis=1)
    found = [float(given.mean()), *(float(value) for value in np.percentile(means, (2.5, 97.5)))]
    mean, low, high = (f"{math.exp(value) if log else value:.3f}" for value in found)
    return mean, f"{low} to {high}"


def compare(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    """Run what is missing of the comparison, and return its tables."""
    models = checkpoints(args)
    made_of = digest(*(folder / file for folder in models.values() for file in ("config.json", "model.safetensors")))
    ids, few = problems_of(args.n, args.unseen), problems_of(*map(min, RAW, (args.n, args.unseen)))
    made, proposed = (
        bench(
            some, rows, args.store / f"{name}-{made_of}", runs=1, timeout=TIMEOUT, split="validation",
            workers=Workers(args.jobs), provenance=record.session(),
        )
        for name, some, rows in (("compare", ids, rows_of(models)), ("raw", few, raw_rows(models)))
    )  # fmt: skip
    args.made_with = record.made_with(made)
    chosen = set(ids)
    runs = [run for run in made.runs if run["problem"] in chosen and run["status"] != NO_PROBLEM]
    groups = groups_of(runs)
    lines: dict[str, list[list[Any]]] = {"proposals": [], "planner": [], "paired": []}
    for group, some in groups.items():
        there = [run for run in runs if run["problem"] in some]
        for kind in KINDS:
            name, line = ("proposals", proposals_line) if kind == KINDS[0] else ("planner", planner_line)
            for model in models:
                mine = [run for run in there if run["label"] == f"{kind}, {model}"]
                if mine:
                    row = model if kind == KINDS[0] else f"{model}{', no trees' if kind == KINDS[1] else ''}"
                    lines[name].append(line(group, row, mine))
        if group not in LEVELS:
            lines["paired"] += [paired(group, kind, *pair, there) for kind in KINDS for pair in PAIRS]
    lines["raw proposals"] = raw_lines([r for r in proposed.runs if r["problem"] in few and r["status"] != NO_PROBLEM])
    heads = {"proposals": PROPOSALS_HEAD, "planner": PLANNER_HEAD, "paired": PAIRED_HEAD, "raw proposals": RAW_HEAD}
    texts = {"paired": 4, "raw proposals": 3}
    text = [
        f"### {name.capitalize()}\n\n{table(heads[name], some, texts.get(name, 2))}" for name, some in lines.items()
    ]
    found = {name: [dict(zip(heads[name], line, strict=True)) for line in some] for name, some in lines.items()}
    return {**found, "made_of": made_of}, "\n\n".join(text)


MEASURES = dict(zip(PARTS, (data, train, compare), strict=True))


def main() -> None:
    """Run what is missing, and write the results."""
    parser = record.parser(__doc__, n=8, jobs=1)
    parser.add_argument("--part", nargs="+", choices=PARTS, default=PARTS, help="(default: all)")
    parser.add_argument(
        "--unseen", type=one_or_more, default=48, help="problems of a level of unseen (default: %(default)s)"
    )
    parser.add_argument("--problems", type=one_or_more, default=1680, help="of the data (default: %(default)s)")
    parser.add_argument("--steps", type=one_or_more, default=600, help="of a training (default: %(default)s)")
    parser.add_argument("--batch", type=one_or_more, default=128, help="paths in a step (default: %(default)s)")
    parser.add_argument("--store", type=Path, default=FOLDER, help="folder of data, checkpoints and runs")
    parser.add_argument("--results", type=Path, default=record.RESULTS, help="folder of the results")
    args = parser.parse_args()
    found: dict[str, Any] = {}
    texts, args.made_with = list[str](), {}
    for part in args.part:
        found[part], text = MEASURES[part](args)
        texts.append(f"## {part.capitalize()}\n\n{text}")
    about = {"split": "validation", "n": args.n, "unseen": args.unseen, "problems": args.problems}
    about |= {"steps": args.steps, "batch": args.batch, "rate": RATE}
    name = "constrained_model" if len(args.part) == len(PARTS) else f"constrained_model_{'_'.join(args.part)}"
    record.write(name, found, "\n\n".join(texts), args.results, **about, **args.made_with)


if __name__ == "__main__":
    run_script(main)
