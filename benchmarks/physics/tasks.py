"""Ready-made problems executed in physics to the end, from starts that differ from what the plan knows.

Each start is drawn by seed: joints of the arms within 0.02 rad, which are measured, and what is not: objects within
5 mm in the hands, masses and friction within 20 %. A run succeeds where the objects are where they should be
(:mod:`apex_ompl.physics.judges`). Runs are stored in benchmarks/runs/tasks when they end; the command resumes.

With --pictures, a run that fails is drawn as it ends, from afar and near, with the reason, as FOLDER/PROBLEM.SEED.png
(MUJOCO_GL=egl or osmesa); runs that are stored already are not drawn.

Usage: python -m benchmarks.physics.tasks [PROBLEM ...] [-n 40] [--pictures FOLDER] [--report]
"""

from __future__ import annotations

import argparse
import io
import json
import textwrap
import time
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw
from tqdm import tqdm

from apex_ompl import problems
from apex_ompl.drivers.library import mujoco
from apex_ompl.drivers.mujoco import MujocoDriver
from apex_ompl.physics import Spread, TaskRunner
from apex_ompl.physics.result import UNPLANNED, TaskRun
from apex_ompl.problems.suite_robot import robot
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.files import write_atomically
from apex_ompl.util.statistics import share_interval
from benchmarks.lib import record
from benchmarks.lib.pack import RUNS

DEPENDS = ("@planning", "apex_ompl/timing", "apex_ompl/drivers", "apex_ompl/physics")
FOLDER = RUNS / "tasks"
TIMEOUT = 120.0  # of a plan [s]
VIEW, NEAR = (
    (400, 320),
    (200.0, 0.8),
)  # size of each picture [pixels]; direction and distance of the near one [degrees, m]
LINE, CHARACTER, MARGIN, COLORS = 15, 6, 8, 64  # of the text below [pixels], and number of colors
LINKS = frozenset(robot().link_names)
HEAD = (
    "problem", "N", "succeeded", "95 % interval", "held by", "duration s p50", "CPU s p50", "links touched obstacles",
    "failures",
)  # fmt: skip


def row_of(run: TaskRun, seconds: float) -> dict[str, Any]:
    """Return what is stored of a run."""
    failed = [f"{check.name}: {check.found}" for check in run.checks if not check.passed]
    obstacles = [list(pair) for pair in sorted(run.contacts) if not set(pair) <= LINKS]
    return {
        "seed": run.seed, "outcome": run.outcome, "reason": run.reason, "failed": failed, "causes": causes(run),
        "grasps": [[one.object, one.hand, one.kind] for one in run.grasps], "metrics": dict(run.metrics),
        "obstacles": obstacles, "cpu": round(seconds, 3), "commit": record.session()["commit"],
    }  # fmt: skip


def causes(run: TaskRun) -> list[str]:
    """Return why a run failed: hands that got hold of nothing, the conditions that do not hold, or the planner's."""
    if run:
        return []
    if run.outcome == UNPLANNED:
        return [f"not planned: {run.reason.split(';')[0]}"]
    return [f"not: {check.name}" for check in run.checks if not check.passed]


def stored(name: str, seeds: Sequence[int], folder: Path, pictures: Path | None = None) -> list[dict[str, Any]]:
    """Make the runs of a problem that are missing, draw those that fail into a folder, and return all."""
    runner = TaskRunner(problems.load(name), Spread(), timeout=TIMEOUT)
    return made(name, seeds, folder, lambda _: runner, pictures)


def made(
    name: str, seeds: Sequence[int], folder: Path, runner_of: Callable[[int], TaskRunner], pictures: Path | None = None
) -> list[dict[str, Any]]:
    """Make the runs of seeds that are missing in a folder, each by the runner of its seed, and return all."""
    files = [folder / f"{name}.{seed}.json" for seed in seeds]
    for seed, file in zip(seeds, tqdm(files, desc=name, mininterval=10.0), strict=True):
        if file.exists():
            continue
        started, runner = time.process_time(), runner_of(seed)
        run, _ = runner.run(seed)
        data = row_of(run, time.process_time() - started)
        if pictures is not None and not run and runner.executor is not None:
            picture = drawn(runner.executor.driver, f"{name}, seed {seed}: {run.reason}")
            write_atomically(pictures / f"{name}.{seed}.png", picture)
        write_atomically(file, (json.dumps(data, indent=1) + "\n").encode())
    return [json.loads(file.read_text()) for file in files]


def drawn(driver: MujocoDriver, text: str) -> bytes:
    """Return a PNG of a robot and of what is between its hands, with a text below."""
    middle = np.mean([driver.pose(hand.palm)[:3, 3] for hand in driver.robot.hands.values()], axis=0)
    views = np.concatenate([driver.picture(VIEW), driver.picture(VIEW, NEAR[0], middle, NEAR[1])], axis=1)
    lines = textwrap.wrap(text, width=views.shape[1] // CHARACTER)
    whole = Image.new("RGB", (views.shape[1], views.shape[0] + LINE * len(lines) + MARGIN), "white")
    whole.paste(Image.fromarray(views))
    ImageDraw.Draw(whole).text((MARGIN, views.shape[0] + MARGIN // 2), "\n".join(lines), "black")
    buffer = io.BytesIO()
    whole.quantize(COLORS).save(buffer, "png", optimize=True)
    return buffer.getvalue()


def cells(name: str, rows: Sequence[dict[str, Any]]) -> list[Any]:
    """Return the cells of a problem."""
    done = sum(row["outcome"] == "DONE" for row in rows)
    low, high = share_interval(done, len(rows))
    held = sorted({f"{thing} {kind}" for row in rows for thing, _, kind in row["grasps"]})
    durations = [row["metrics"]["duration"] for row in rows if row["metrics"]]
    counted = Counter(cause for row in rows for cause in row["causes"])
    return [
        name, len(rows), done, f"{low:.2f} to {high:.2f}", ", ".join(held),
        f"{record.percentiles(durations, 50)[0]:.1f}", f"{np.median([row['cpu'] for row in rows]):.1f}",
        sum(bool(row["obstacles"]) for row in rows),
        "; ".join(f"{number} {cause}" for cause, number in counted.most_common()),
    ]  # fmt: skip


def parser() -> argparse.ArgumentParser:
    """Return the parser."""
    found = record.parser(__doc__ or "", n=40, of="starts of a problem")
    found.add_argument("problems", nargs="*", default=list(problems.names()), help="default: all ready-made ones")
    found.add_argument("--seed", type=int, default=1, help="of the first start (default: %(default)s)")
    found.add_argument("--store", type=Path, default=FOLDER, help="folder of the runs")
    found.add_argument("--pictures", type=Path, metavar="FOLDER", help="draw runs that fail into it, as they end")
    found.add_argument("--report", action="store_true", help="run nothing; write the results of the stored runs")
    return found


def main() -> None:
    """Make the runs, and write the results."""
    given = parser().parse_args()
    for folder in filter(None, (given.store, given.pictures)):
        folder.mkdir(parents=True, exist_ok=True)
    seeds = range(given.seed, given.seed + given.n)
    found: dict[str, list[dict[str, Any]]] = {}
    for name in given.problems:
        if given.report:
            files = (given.store / f"{name}.{seed}.json" for seed in seeds)
            found[name] = [json.loads(file.read_text()) for file in files if file.exists()]
        else:
            found[name] = stored(name, seeds, given.store, given.pictures)
    found = {name: rows for name, rows in found.items() if rows}
    lines = [record.row(list(HEAD)), record.row(["---"] * len(HEAD))]
    lines += [record.row(cells(name, rows)) for name, rows in found.items()]
    total = [row for rows in found.values() for row in rows]
    done = sum(row["outcome"] == "DONE" for row in total)
    lines.append(record.row(["all of them", len(total), done, *[""] * (len(HEAD) - 3)]))
    settings = {"n": given.n, "seed": given.seed, "timeout": TIMEOUT, "mujoco": mujoco().__version__}
    settings["run_commits"] = "; ".join(sorted({row["commit"] for row in total}))
    record.write("physics_tasks", {"runs": found, "spread": vars(Spread())}, "\n".join(lines), **settings)


if __name__ == "__main__":
    run_script(main)
