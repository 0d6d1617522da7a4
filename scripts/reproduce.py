"""Reproduce a figure of the paper for static scenes: its numbers, a table, and a picture.

``failure``: failure ratio R_f, smoothness S_r and planning time, vertical and horizontal tasks among cubes.
``size``: failure ratio over the size of the cubes, guided and unguided.
``fid``: FID and KID of guided and unguided paths against solutions of the same problems, in the features of the
variational autoencoder of ``apex-paper`` and in principal components.

``failure`` and ``size`` have the same runs. Each is stored in benchmarks/runs/paper_figures when it ends; so
are the solutions of ``fid``. All planners have the same problems. The command resumes where it was stopped.

Usage: python scripts/reproduce.py failure|size|fid [-n 40] [--jobs 1] [--keep FOLDER] [-o FOLDER]
"""

from __future__ import annotations

import argparse
import io
import sys
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from apex_ompl.benchmark import Results, Row, Workers, bench, metrics
from apex_ompl.benchmark.rows import PAPER
from apex_ompl.benchmark.summary import Statistics, Table, about, statistics, warnings
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.files import make_folder, write_atomically
from apex_ompl.util.provenance import hardware, versions
from apex_ompl.util.statistics import share_interval
from apex_ompl.util.validation import one_or_more

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ROOT = Path(__file__).resolve().parents[1]
DEPENDS = ("@benchmark", "apex_ompl/datasets", "apex_ompl/generation", "scripts/paper")
COMMITS = "Commits of the runs"
TASKS, SIZES = ("vertical", "horizontal"), ("small", "medium", "large")
EDGES = {"free": 0.0, "small": 0.06, "medium": 0.10, "large": 0.15}  # of the cubes [m]
TIMEOUT = 10.0  # [s]
ALONE = {**PAPER, "model": "apex"}
ROWS = (
    Row("apex", "apex"),
    Row("apex-paper", "apex", {**PAPER, "guidance": True}),
    Row("apex-paper, unguided", "apex", PAPER),
    Row("apex's model alone", "apex", {**ALONE, "guidance": True}),
    Row("apex's model alone, unguided", "apex", ALONE),
    Row("rrt", "rrt"),
    Row("rrtconnect", "rrtconnect"),
)
PAIRS = (("apex-paper", "apex-paper, unguided"), ("apex's model alone", "apex's model alone, unguided"))
COLOURS = ("#0b6e4f", "#3d5a80", "#98b6d8", "#7a5195", "#c9a6d6", "#c8553d", "#e0a458")
FID_LEVELS = [f"{task}/{size}" for task in TASKS for size in SIZES]


def blank(width: float, height: float) -> Figure:
    """Return an empty picture, of a size in inches."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def runs(args: argparse.Namespace) -> Results:
    """Return the runs of the planners on the paper's tasks, all on the same problems."""
    levels, labels = [f"{task}/{size}" for task in TASKS for size in EDGES], {row.label for row in ROWS}
    folder, workers = args.keep / "paper_figures", Workers(args.jobs)
    import record

    found = bench(levels, ROWS, folder, runs=args.n, timeout=TIMEOUT, workers=workers, provenance=record.session())
    mine = [r for r in found.runs if r["experiment"] in levels and r["label"] in labels and r["seed"] < args.n]
    return replace(found, runs=mine)


def failure(args: argparse.Namespace) -> tuple[dict[str, Any], list[Table], Figure, list[tuple[str, Any]]]:
    """Return R_f, S_r and time of each planner on each task, over all sizes of cubes."""
    results = runs(args)
    per_level = [f for f in statistics(results) if f.experiment.split("/")[1] in SIZES]
    found: dict[str, Any] = {}
    rows = []
    picture = blank(11, 4)
    axes = picture.subplots(1, 3)
    for t, task in enumerate(TASKS):
        for k, row in enumerate(ROWS):
            mine = [f for f in per_level if f.experiment.startswith(f"{task}/") and f.label == row.label]
            f = Statistics(task, row.label, [run for one in mine for run in one.runs])
            ratio = metrics.failure_ratio([run["solved"] for run in f.runs])
            low, high = (100.0 * (1.0 - v) for v in share_interval(len(f.solved), len(f.runs)))
            length, raw, took = f.median("length"), f.median("raw_length"), f.percentile("total", 50)
            found[f"{task}, {row.label}"] = {
                "N": len(f.runs), "R_f": ratio, "interval": [high, low], "S_r": length, "S_r as found": raw,
                "time_s": took if np.isfinite(took) else None,
            }  # fmt: skip
            seconds = f"{took:.3f}" if np.isfinite(took) else "-"
            lengths = ["-" if np.isnan(v) else f"{v:.2f}" for v in (length, raw)]
            ends = f"{high:.1f} to {low:.1f}"
            rows.append([task, row.label, str(len(f.runs)), f"{ratio:.1f}", ends, *lengths, seconds])
            at, colour = t * (len(ROWS) + 1) + k, COLOURS[k]
            for axis, value in zip(axes, (ratio, length, took), strict=True):
                axis.bar(at, value if np.isfinite(value) else 0.0, color=colour, label=row.label if t == 0 else None)
            axes[0].plot([at, at], [high, low], color="black", linewidth=1)
    for axis, title in zip(axes, ("R_f %", "S_r rad", "median time s, where most are solved"), strict=True):
        axis.set_title(title)
        middle = (len(ROWS) - 1) / 2
        axis.set_xticks([middle, middle + len(ROWS) + 1], TASKS)
    axes[2].set_yscale("log")
    picture.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, fontsize=8)
    head = ["task", "planner", "N", "R_f %", "95 %", "S_r rad (median of solved)", "as found", "time s (median of all)"]
    return found, [Table("Failure ratio, smoothness, time", head, rows)], picture, provenance(results)


def size(args: argparse.Namespace) -> tuple[dict[str, Any], list[Table], Figure, list[tuple[str, Any]]]:
    """Return the failure ratio over the size of the cubes, guided and not."""
    results = runs(args)
    by = {(f.experiment, f.label): f for f in statistics(results)}
    found: dict[str, Any] = {}
    rows = []
    picture = blank(9, 4.4)
    labels = [label for pair in PAIRS for label in pair]
    for axis, task in zip(picture.subplots(1, 2, sharey=True), TASKS, strict=True):
        for k, label in enumerate(labels):
            line, ends = [], []
            for level, edge in EDGES.items():
                f = by[f"{task}/{level}", label]
                ratio = metrics.failure_ratio([run["solved"] for run in f.runs])
                low, high = (100.0 * (1.0 - v) for v in share_interval(len(f.solved), len(f.runs)))
                found[f"{task}/{level}, {label}"] = {"N": len(f.runs), "R_f": ratio, "interval": [high, low]}
                cells = [f"{edge:.2f}", str(len(f.runs)), f"{ratio:.1f}", f"{high:.1f} to {low:.1f}"]
                rows.append([task, label, *cells])
                line.append(ratio)
                ends.append((ratio - high, low - ratio))
            style = "--" if "unguided" in label else "-"
            colour = COLOURS[1 if "paper" in label else 3]
            at = np.array(list(EDGES.values())) + 0.0012 * (k - 1.5)  # beside each other, for the intervals
            axis.errorbar(at, line, np.transpose(ends), fmt=style, color=colour, marker="o", linewidth=1.5,
                          elinewidth=0.8, label=label)  # fmt: skip
        axis.set_title(task)
        axis.set_xlabel("edge of the cubes m")
        axis.grid(alpha=0.3)
    picture.axes[0].set_ylabel("R_f %")
    picture.legend(*picture.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, fontsize=8)
    head = ["task", "planner", "edge m", "N", "R_f %", "95 %"]
    return found, [Table("Failure ratio over the size of obstacles", head, rows)], picture, provenance(results)


def provenance(results: Results) -> list[tuple[str, Any]]:
    """Return the provenance of the runs, and warnings for a reader of the times."""
    import record

    commits = (COMMITS, record.made_with(results)["run_commits"])
    return [*about(results), commits, *(("Note", warning) for warning in warnings(results))]


def fid(args: argparse.Namespace) -> tuple[dict[str, Any], list[Table], Figure, list[tuple[str, Any]]]:
    """Return distances of guided and unguided paths from solutions of the same problems."""
    from paper import realism

    units = realism.solutions(args.keep / "solutions", args.n, FID_LEVELS, args.jobs)
    real, made, seconds = realism.made_for(units, args.n, args.jobs)
    found_all: dict[str, Any] = {}
    rows = []
    picture = blank(8, 4)
    for axis, (name, features) in zip(picture.subplots(1, 2), realism.feature_spaces().items(), strict=True):
        truth = features(real)
        for k, (label, paths) in enumerate(made.items()):
            r = metrics.realism(truth, features(paths))
            found_all[f"{name}, {label}"] = {**asdict(r), "seconds a path": seconds[label] / len(real)}
            ends = f"{r.interval[0]:.2f} to {r.interval[1]:.2f}"
            cells = [str(r.made), str(r.dimension), f"{r.fid:.2f}", ends, f"{r.floor:.2f}", f"{r.kid:.4f}"]
            rows.append([name, label, *cells, f"{1e3 * seconds[label] / len(real):.1f}"])
            axis.bar(k, r.fid, color=COLOURS[(1 if "paper" in label else 3) + ("unguided" in label)])
            axis.plot([k, k], r.interval, color="black", linewidth=1)
        axis.axhline(r.floor, color="grey", linestyle=":")
        axis.set_title(f"FID, {name} features (dots: floor)")
        axis.set_xticks(range(len(made)), list(made), rotation=15, fontsize=8)
    head = ["features", "paths", "N", "d", "FID", "95 %", "floor", "KID", "CPU ms a path"]
    notes = [
        ("Real", f"solutions of {len(real)} validation problems, one each, of {', '.join(FID_LEVELS)}"),
        ("Made", f"one path for each of them; apex by its own sampling, apex-paper by {realism.STEPS} steps of DDIM"),
        ("Seeds", f"the number of the first of {realism.BATCH} problems at a time, 0 to {len(real) - 1}"),
        ("Floor", "FID between two halves of the real set, of other problems each: larger than it would be for all"),
        ("Made with", f"{hardware()}, {args.jobs} processes; {', '.join(f'{k} {v}' for k, v in versions().items())}"),
    ]
    return found_all, [Table("FID and KID", head, rows)], picture, notes


FIGURES = {"failure": (failure, 40), "size": (size, 40), "fid": (fid, 10_000)}


def main() -> None:
    """Make a figure."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("figure", choices=FIGURES)
    parser.add_argument("-n", type=one_or_more, help="problems of a level, or for fid in all (default: 40, 10000)")
    parser.add_argument("--jobs", type=one_or_more, default=1, help="runs at a time (default: one, as they are timed)")
    parser.add_argument("--keep", type=Path, default=ROOT / "benchmarks" / "runs", metavar="FOLDER", help="for runs")
    parser.add_argument("-o", "--out", type=Path, default=ROOT / "benchmarks" / "results", metavar="FOLDER")
    args = parser.parse_args()
    blank(1.0, 1.0)  # a missing matplotlib is reported now, not after hours
    make, usual = FIGURES[args.figure]
    args.n = usual if args.n is None else args.n
    if args.n < 4:
        parser.error("-n is 4 or more")
    make_folder(args.keep)
    make_folder(args.out)
    sys.path.append(str(ROOT / "benchmarks"))
    import record

    found, tables, picture, notes = make(args)
    name = f"paper_{args.figure}"
    text = [*(table.markdown() for table in tables), "\n".join(f"- {key}: {value}" for key, value in notes)]
    commits = [value for key, value in notes if key == COMMITS]
    about = {"run_commits": commits[0]} if commits else {}
    record.write(name, {"notes": notes, **found}, "\n\n".join(text), args.out, N=args.n, **about)
    drawn = io.BytesIO()
    picture.savefig(drawn, format="png", dpi=120)
    write_atomically(args.out / f"{name}.png", drawn.getvalue())


if __name__ == "__main__":
    run_script(main, "bench,data")
