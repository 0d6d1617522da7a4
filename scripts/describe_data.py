"""Print and plot the statistics of a data set: a folder that generate_data made, or a file of paths.

Writes description.md, figures.png and motions.jpg (random motions) into a folder.

Usage: python scripts/describe_data.py DATA [--out FOLDER] [--check 200] [--motions 10] [--seed 0]
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from apex_ompl import problems
from apex_ompl.ompl.setup import assemble
from apex_ompl.ompl.validity import full_check
from apex_ompl.problems.suite_robot import robot
from apex_ompl.training import records
from apex_ompl.training.records import SOURCES, DatasetError, Paths
from apex_ompl.training.store import Store, load
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.files import check_writable, is_file, write_atomically
from apex_ompl.util.validation import one_or_more, whole_number

SHOTS, MOTIONS, SIZE = 5, 10, (320, 240)


def table(figures: list[records.LevelStatistics]) -> str:
    """Return the table of the levels in Markdown."""
    head = ["level", "problems", "paths", *SOURCES, "straight", "homotopies", "several", "duplicates"]
    head += ["length rad p5", "p50", "p95", "clearance mm p5", "p50", "p95"]
    rows = [head, ["---", *["---:"] * (len(head) - 1)]]
    for f in figures:
        numbers = [f"{f.straight:.2f}", f"{f.homotopies:.2f}", f"{f.several:.2f}", f.duplicates]
        spread = [f"{v:.1f}" for v in f.length] + [f"{1e3 * v:.0f}" for v in f.clearance]
        rows.append([f.name, f.problems, f.paths, *f.sources.values(), *numbers, *spread])
    return "\n".join("| " + " | ".join(str(c) for c in row) + " |" for row in rows)


def checked(paths: Paths, which: np.ndarray) -> str:
    """Return a sentence with the number of given stored paths that pass the full check."""
    control, spline, good = paths.control(which), paths.spline, 0
    for k, points in zip(which, control, strict=True):
        ready = assemble(problems.load(paths.problem_name(int(paths.arrays["problem"][k]))), robot())
        good += bool(full_check(ready.checker, spline.path(points), paths.start[k], [paths.goal[k]]))
    return f"{good} of {len(which)} random paths pass the full check as they are stored."


def plot(paths: Paths, figures: list[records.LevelStatistics], file: Path) -> None:
    """Draw lengths, clearances, sources and the coverage of joints."""
    from io import BytesIO

    from matplotlib.figure import Figure

    limits = robot().limits
    fig = Figure(figsize=(13, 9), layout="constrained")
    axes = fig.subplots(2, 2)
    suites = np.array([paths.names["suite"][k] for k in paths.arrays["suite"]])[paths.arrays["problem"]]
    for axis, key, scale, unit in ((axes[0, 0], "length", 1.0, "rad"), (axes[0, 1], "clearance", 1e3, "mm")):
        names = sorted(set(suites.tolist()))
        axis.boxplot([scale * paths.arrays[key][suites == s] for s in names], tick_labels=names, showfliers=False)
        axis.set_title(f"{key} [{unit}], by suite")
        axis.tick_params(axis="x", rotation=30)
    rows, bottom = figures[:-1], np.zeros(len(figures) - 1)
    for source in SOURCES:
        counts = np.array([f.sources[source] for f in rows], float)
        axes[1, 0].barh([f.name for f in rows], counts, left=bottom, label=source)
        bottom += counts
    axes[1, 0].set_title("paths, by level and source")
    axes[1, 0].tick_params(axis="y", labelsize=7)
    axes[1, 0].legend(fontsize=8)
    low, middle, high = records.coverage(paths, limits.lower, limits.upper)
    joints = np.arange(len(low))
    axes[1, 1].bar(joints, high - low, bottom=low, color="#9db8d2", label="1st to 99th percentile")
    axes[1, 1].plot(joints, middle, "k_", markersize=14, label="median")
    axes[1, 1].set_xticks(joints, robot().joint_names, rotation=90, fontsize=7)
    axes[1, 1].set_ylim(0.0, 1.0)
    axes[1, 1].set_title("joints, share of their range")
    axes[1, 1].legend(fontsize=8)
    stream = BytesIO()
    fig.savefig(stream, format="png", dpi=90)
    write_atomically(file, stream.getvalue())


def draw(paths: Paths, which: np.ndarray, file: Path) -> list[str]:
    """Draw some motions, a row each, and return their captions."""
    import imageio.v3 as iio

    from apex_ompl.viz.scene_renderer import SceneRenderer

    rows, captions, spline = [], [], paths.spline
    for k, points in zip(which, paths.control(which), strict=True):
        name = paths.problem_name(int(paths.arrays["problem"][k]))
        renderer = SceneRenderer(assemble(problems.load(name), robot()), SIZE)
        at = np.linspace(0, spline.states - 1, SHOTS).astype(int)
        rows.append(np.concatenate([renderer.screenshot(q) for q in spline.path(points)[at]], axis=1))
        length = f"{float(paths.arrays['length'][k]):.1f} rad"
        captions.append(f"{name}, {SOURCES[paths.arrays['source'][k]]}, {length}")
    write_atomically(file, iio.imwrite("<bytes>", np.concatenate(rows), extension=".jpg", quality=80))
    return captions


def describe(args: argparse.Namespace) -> None:
    """Describe the data set."""
    for name in ("description.md", "figures.png", "motions.jpg"):
        check_writable(args.out / name)
    paths = load(args.data) if is_file(args.data) else Paths.concatenate(Store(args.data))
    if not len(paths):
        raise DatasetError(f"{args.data}: there are no paths, expected some")
    figures = records.level_statistics(paths)
    rng = np.random.default_rng(args.seed)
    text = [f"# {args.data.name}", "", f"{len(paths)} paths of {paths.problems} problems.", "", table(figures), ""]
    if args.check:
        which = np.sort(rng.choice(len(paths), min(args.check, len(paths)), replace=False))
        text += [checked(paths, which), ""]
    plot(paths, figures, args.out / "figures.png")
    chosen = np.sort(rng.choice(len(paths), min(args.motions, len(paths)), replace=False))
    captions = draw(paths, chosen, args.out / "motions.jpg")
    text += ["![figures](figures.png)", "", f"{len(chosen)} random motions, from left to right:", ""]
    text += [*(f"{k}. {c}" for k, c in enumerate(captions, 1)), "", "![motions](motions.jpg)", ""]
    print("\n".join(text))
    write_atomically(args.out / "description.md", "\n".join(text).encode())


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path, metavar="DATA")
    parser.add_argument("--out", type=Path, default=Path(), help="folder of the results (default: the current one)")
    parser.add_argument(
        "--check", type=whole_number, default=200, help="paths that are proved again (default: %(default)s)"
    )
    parser.add_argument(
        "--motions", type=one_or_more, default=MOTIONS, help="motions that are drawn (default: %(default)s)"
    )
    parser.add_argument("--seed", type=whole_number, default=0, help="seed of the choices (default: %(default)s)")
    args = parser.parse_args()
    describe(args)


if __name__ == "__main__":
    run_script(main, "data,viz")
