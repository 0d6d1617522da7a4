"""Whether a model trained on motions gives shorter durations, or the same ones sooner, than one trained on paths.

``data``: paths of the data set that ships are turned into locally fastest motions, see benchmarks/model/motion_data.py.
``train``: two models start from the weights of ``apex``; one goes on with the motions (``motions``), one with the paths
that these were made of (``paths``), with the same steps, batches, learning rates and seeds, on one core.
``compare``: both and ``apex`` itself on validation problems, hard, extreme and large levels and unseen kinds: in the
planner without trees, with the objective ``time``; and their proposals alone, from which the duration optimizer starts,
as it would from any path, or from the timing of the proposals.

Everything is kept in benchmarks/runs/motion_model and resumed from there; a comparison has a folder of its own for each
set of checkpoints. Data take 10 minutes of CPU, training 10, the comparison 15.

Usage: python -m benchmarks.model.motion_model [SUITE[/LEVEL] ...] [--part data train compare] [--problems 3000]
       [--steps 1000] [--batch 128] [-n 4] [--seeds 2]
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from apex_ompl import load_model
from apex_ompl.evaluation import Results, Row, Workers, bench
from apex_ompl.evaluation.runs import Run
from apex_ompl.model.checkpoint import SHIPPED, read_config
from apex_ompl.training.store import Store
from apex_ompl.types import Array
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.validation import one_or_more
from benchmarks.lib import record
from benchmarks.lib.controls import digest
from benchmarks.model import motion_data
from benchmarks.model.motion_data import MOTIONS, PATHS
from benchmarks.model.motion_runs import AS_MOTION, AS_PATH
from benchmarks.timing.motions import best_known, cells, chosen_levels, grouped, table

DEPENDS = (
    "@benchmark", "apex_ompl/timing", "apex_ompl/training", "benchmarks/model/motion_data.py",
    "benchmarks/model/motion_runs.py", "benchmarks/timing/motion_rows.py", "scripts/configs/apex-continued.yaml",
)  # fmt: skip
FOLDER = record.RESULTS.parent / "runs" / "motion_model"
SOURCE = record.ROOT / "data" / "dual_panda_softhand" / "paths.zip"
CONFIG = record.ROOT / "scripts" / "configs" / "apex-continued.yaml"
PARTS = ("data", "train", "compare")
APEX = "apex"
TIMEOUT = 10.0  # of a run [s]
SEED_STEP = 1000  # from one seed of a problem to the next
RATE, WARMUP, EMA = 3e-4, 100, 0.998
LOG_EVERY = 250  # steps
DRAWS = 2000  # of the bootstrap
ALIKE = 0.01  # relative difference of durations that counts as none
MODULE = "benchmarks.model.motion_runs"


def trained(folder: Path, name: str, steps: int, batch: int) -> Path:
    """Train a model on the motions or the paths, or go on with that, and return its folder.

    Args:
        folder: Folder of the data; the run is kept there, too.
        name: ``motions`` or ``paths``.
        steps: Number of steps.
        batch: Paths in a step.
    """
    run = folder / f"trained-{name}-{steps}x{batch}"
    run.mkdir(parents=True, exist_ok=True)
    if (run / "checkpoint").is_dir() and read_config(run / "checkpoint").trained["step"] == steps:
        return run
    import torch

    from apex_ompl.training.config import TrainingConfig
    from apex_ompl.training.training import DistributedProcess, Trainer

    torch.set_num_threads(1)
    # A part of a motion is none: it does not begin at rest.
    changes: dict[str, Any] = {"data": str(folder / name), "initial": APEX, "cases": None, "parts": 0.0}
    changes |= {"robot": str(SOURCE.parent / "robot.npz"), "steps": steps, "batch": batch, "rate": RATE}
    changes |= {"warmup": WARMUP, "ema": EMA, "log_every": LOG_EVERY}
    Trainer(TrainingConfig.read(CONFIG, changes), run, DistributedProcess.current()).run()
    return run


def latent_deviation(name: str, folder: Path) -> Array:
    """Return how far apex's latent space moves the curves of a data set [rad, max-norm], shape (N,)."""
    model, found = load_model(APEX), list[Array]()
    for paths in Store(folder / name):
        control = paths.control()
        decoded = model.control(model.encode(control), (paths.start, paths.goal))
        found.append(np.abs(paths.spline.path(control) - paths.spline.path(decoded)).max(axis=(1, 2)))
    return np.concatenate(found)


def data(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    """Make the data, and return their statistics."""
    for _ in motion_data.make(SOURCE, args.store, args.problems):
        pass
    found = motion_data.statistics(args.store)
    latent = {name: latent_deviation(name, args.store).tolist() for name in (MOTIONS, PATHS)}
    head = ["", "p50", "p95"]
    rows = [
        ["duration of a motion / direct", *cells(found.duration.tolist(), (50, 95))],
        ["deviation of its control points [mrad]", *cells(found.deviation.tolist(), (50, 95), 1e3, 1)],
        *([f"deviation of {k} by apex's latent space [mrad]", *cells(v, (50, 95), 1e3, 0)] for k, v in latent.items()),
    ]
    about = f"{found.kept} motions of {found.tried} paths; {found.valid:.3f} of them pass the full check as stored."
    return {"tried": found.tried, "kept": found.kept, "valid": found.valid, "rows": rows}, about + "\n\n" + table(
        head, rows, 1
    )


def train(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    """Train both models, and return their losses."""
    from apex_ompl.training.run import read_log

    head, lines = ["trained on", "steps", "batch", "minutes", "step", "loss", "held-out loss"], []
    for name in (MOTIONS, PATHS):
        log = read_log(trained(args.store, name, args.steps, args.batch))
        for row in log:
            seconds = float(log[-1]["seconds"])
            lines.append(
                [name, args.steps, args.batch, f"{seconds / 60:.0f}", row["step"], row["loss"], row["held_out"]]
            )
    return {"rows": [dict(zip(head, line, strict=True)) for line in lines]}, table(head, lines, 1)


def checkpoints(args: argparse.Namespace) -> dict[str, Path]:
    """Return the folders of the models by name."""
    own = {name: args.store / f"trained-{name}-{args.steps}x{args.batch}" / "checkpoint" for name in (PATHS, MOTIONS)}
    return {APEX: SHIPPED / APEX, **own}


def rows_of(models: Mapping[str, Path]) -> tuple[list[Row], list[Row]]:
    """Return the rows of the planner, and those of proposals."""
    planner = [
        Row(f"{name}{'' if other else ', no other paths'}", APEX, {"model": str(folder), "other_paths": other},
            runner=f"{MODULE}:planned")
        for other in (True, False) for name, folder in models.items()
    ]  # fmt: skip
    alone = [
        Row(proposals_label(name, kind, repair), APEX, {"model": str(folder), "taken_as": kind, "repaired": repair},
            runner=f"{MODULE}:proposed")
        for repair in (False, True) for kind in (AS_PATH, AS_MOTION)
        for name, folder in models.items()
        if kind == AS_PATH or name == MOTIONS
    ]  # fmt: skip
    return planner, alone


def proposals_label(name: str, kind: str, repair: bool) -> str:
    """Return the label of a row of proposals."""
    return f"{name} as {kind}{', repaired' if repair else ''}"


PLANNER_HEAD = (
    "levels", "row", "N", "solved", "faults", "duration / direct p50", "p95", "duration / best p50", "p95",
    "CPU ms p50", "p95", "of it motion ms p50", "p95",
)  # fmt: skip
ALONE_HEAD = (
    "levels", "row", "N", "solved", "motions a run (from 2 proposals, or 1 repaired)", "first duration / best p50",
    "p95", "least duration / best p50", "p95", "CPU ms until the first p50", "p95", "CPU ms of all p50", "p95",
)  # fmt: skip


def planner_line(group: str, label: str, runs: Sequence[Run], best: Mapping[str, float]) -> list[Any]:
    """Return the line of a row of the planner."""
    solved = [run for run in runs if run["solved"]]
    return [
        group, label, len(runs), len(solved), sum(bool(run.get("fault")) for run in runs),
        *cells([run["duration"] / run["direct"] for run in solved], (50, 95)),
        *cells([run["duration"] / best[run["problem"]] for run in solved], (50, 95)),
        *cells([run["cpu"] for run in solved], (50, 95), 1e3, 0),
        *cells([run["motion_cpu"] for run in solved], (50, 95), 1e3, 0),
    ]  # fmt: skip


def alone_line(group: str, label: str, runs: Sequence[Run], best: Mapping[str, float]) -> list[Any]:
    """Return the line of a row of proposals."""
    solved = [run for run in runs if run["solved"]]
    return [
        group, label, len(runs), len(solved), f"{sum(run['free'] for run in runs) / max(1, len(runs)):.2f}",
        *cells([run["durations"][0] / best[run["problem"]] for run in solved], (50, 95)),
        *cells([run["duration"] / best[run["problem"]] for run in solved], (50, 95)),
        *cells([run["first_cpu"] for run in solved], (50, 95), 1e3, 0),
        *cells([run["cpu"] for run in runs], (50, 95), 1e3, 0),
    ]  # fmt: skip


PAIRED_HEAD = (
    "row", "beside", "both solved", "alone solved", "the other alone", "duration ratio",
    "95 % (bootstrap over problems)", "shorter by 1 %", "longer by 1 %", "CPU ratio", "95 %",
)  # fmt: skip


def paired(runs: Sequence[Run], one: str, other: str, cpu: str) -> list[Any]:
    """Return how a row's durations and CPU times compare with another row's on the same problems and seeds."""
    mine, theirs = ({(r["problem"], r["seed"]): r for r in runs if r["label"] == label} for label in (one, other))
    keys = sorted(set(mine) & set(theirs))
    both = [key for key in keys if mine[key]["solved"] and theirs[key]["solved"]]
    alone = [
        sum(a[key]["solved"] and not b[key]["solved"] for key in keys) for a, b in ((mine, theirs), (theirs, mine))
    ]
    ratios = {
        name: {key: math.log(mine[key][name] / theirs[key][name]) for key in both} for name in ("duration", cpu)
    }  # fmt: skip
    shorter, longer = (
        sum(sign * ratio > math.log1p(ALIKE) for ratio in ratios["duration"].values()) for sign in (-1.0, 1.0)
    )
    (mean, low, high), (c_mean, c_low, c_high) = (interval(some) for some in ratios.values())
    return [
        one, other, len(both), *alone, f"{mean:.4f}", f"{low:.4f} to {high:.4f}", shorter, longer, f"{c_mean:.3f}",
        f"{c_low:.3f} to {c_high:.3f}",
    ]  # fmt: skip


def interval(logs: Mapping[tuple[str, int], float]) -> tuple[float, float, float]:
    """Return the geometric mean of ratios by problem and seed, and its 95 % bootstrap interval over problems."""
    by_problem: dict[str, list[float]] = {}
    for (problem, _), value in logs.items():
        by_problem.setdefault(problem, []).append(value)
    if not by_problem:
        return (math.nan,) * 3
    sums = np.array([[sum(values), len(values)] for values in by_problem.values()])
    drawn = sums[np.random.default_rng(0).integers(len(sums), size=(DRAWS, len(sums)))].sum(axis=1)
    low, high = np.percentile(drawn[:, 0] / drawn[:, 1], (2.5, 97.5))
    return math.exp(sums[:, 0].sum() / sums[:, 1].sum()), math.exp(low), math.exp(high)


def pairs() -> list[tuple[str, str, str]]:
    """Return the pairs of rows that are compared, and the name of the CPU time that counts."""
    models = (MOTIONS, APEX), (MOTIONS, PATHS), (PATHS, APEX)
    found = [(f"{one}{rest}", f"{other}{rest}", "cpu") for rest in ("", ", no other paths") for one, other in models]
    for repair in (False, True):
        as_path = {name: proposals_label(name, AS_PATH, repair) for name in (APEX, PATHS, MOTIONS)}
        as_motion = proposals_label(MOTIONS, AS_MOTION, repair)
        found += [(as_path[one], as_path[other], "first_cpu") for one, other in models]
        found += [(as_motion, as_path[name], "first_cpu") for name in (APEX, PATHS, MOTIONS)]
    return found


def made_with(made: Sequence[Results]) -> dict[str, str]:
    """Return how the runs of several results were made."""
    some = [record.made_with(results) for results in made]
    return {name: "; ".join(sorted({one[name] for one in some})) for name in some[0]}


def compare(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    """Run what is missing of the comparison, and return its tables."""
    models, levels = checkpoints(args), chosen_levels(args.levels)
    made_of = digest(*(folder / file for folder in models.values() for file in ("config.json", "model.safetensors")))
    planner, alone = rows_of(models)
    chosen = [*(planner if args.other_paths else planner[: len(models)]), *alone]
    seeds = [SEED_STEP * k for k in range(args.seeds)]
    made = [
        bench(
            levels, chosen, args.store / f"compare-{made_of}" / str(seed), runs=args.n, timeout=TIMEOUT, seed=seed,
            split="validation", workers=Workers(args.jobs), provenance=record.session(),
        )
        for seed in seeds
    ]  # fmt: skip
    runs = [
        run for seed, results in zip(seeds, made, strict=True) for run in results.runs
        if run["seed"] - seed < args.n and run["experiment"] in levels
    ]  # fmt: skip
    args.made_with = made_with(made)
    best = best_known(runs, [row.label for row in (*planner, *alone)])
    lines: dict[str, list[list[Any]]] = {"planner": [], "proposals": []}
    for group, some in grouped(levels).items():
        if group in levels and len(levels) > 1:
            continue  # a level alone has too few problems
        there = [run for run in runs if run["experiment"] in some]
        for name, rows, line in (("planner", planner, planner_line), ("proposals", alone, alone_line)):
            mine = {row.label: [run for run in there if run["label"] == row.label] for row in rows}
            lines[name] += [line(group, label, found, best) for label, found in mine.items() if found]
    labels = {run["label"] for run in runs}
    compared = [paired(runs, *pair) for pair in pairs() if {*pair[:2]} <= labels]
    tables = {
        "planner": (PLANNER_HEAD, lines["planner"]), "proposals": (ALONE_HEAD, lines["proposals"]),
        "paired": (PAIRED_HEAD, compared),
    }  # fmt: skip
    text = [f"### {name.capitalize()}\n\n{table(head, some)}" for name, (head, some) in tables.items()]
    found = {name: [dict(zip(head, line, strict=True)) for line in some] for name, (head, some) in tables.items()}
    return {**found, "made_of": made_of}, "\n\n".join(text)


MEASURES = dict(zip(PARTS, (data, train, compare), strict=True))


def main() -> None:
    """Run what is missing, and write the results."""
    parser = record.parser(__doc__, n=4, jobs=1)
    parser.add_argument("levels", nargs="*", metavar="SUITE[/LEVEL]")
    parser.add_argument("--part", nargs="+", choices=PARTS, default=PARTS, help="(default: all)")
    parser.add_argument("--seeds", type=one_or_more, default=2, help="of a problem (default: %(default)s)")
    parser.add_argument("--problems", type=one_or_more, default=3000, help="of the data (default: %(default)s)")
    parser.add_argument("--steps", type=one_or_more, default=1000, help="of a training (default: %(default)s)")
    parser.add_argument("--batch", type=one_or_more, default=128, help="paths in a step (default: %(default)s)")
    parser.add_argument(
        "--other-paths", action="store_true", help="add rows of the planner whose motions have no other paths"
    )
    parser.add_argument("--store", type=Path, default=FOLDER, help="folder of data, checkpoints and runs")
    parser.add_argument("--results", type=Path, default=record.RESULTS, help="folder of the results")
    args = parser.parse_args()
    found: dict[str, Any] = {}
    texts, args.made_with = list[str](), {}
    for part in args.part:
        found[part], text = MEASURES[part](args)
        texts.append(f"## {part.capitalize()}\n\n{text}")
    about = {"split": "validation", "n": args.n, "seeds": f"{args.seeds} of each problem", "timeout": f"{TIMEOUT:g} s"}
    about |= {"problems": args.problems, "steps": args.steps, "batch": args.batch, "rate": RATE}
    name = "motion_model" if len(args.part) == len(PARTS) else f"motion_model_{'_'.join(args.part)}"
    record.write(name, found, "\n\n".join(texts), args.results, **about, **args.made_with)


if __name__ == "__main__":
    run_script(main)
