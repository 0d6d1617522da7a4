"""The viewer: sizes of written pages, how often a drag is answered, and what playing costs the server.

1. Pages of results on problems of the test split: size, and time to write.
2. An obstacle, and then the goal of a hand, is dragged through the scene of validation problems: time from a pose to
   the answer whether start and goal are free, as the page asks for it.
3. Steps of the player, 30 a second: time of one, and as a share of a core.

Usage: python -m benchmarks.planners.viewer [-n 20]
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

import numpy as np

from apex_ompl import load_problem, plan, problems
from apex_ompl.ompl.process import quiet_ompl
from apex_ompl.scene.problem import Problem
from apex_ompl.util.entry_point import run_script
from apex_ompl.viz.viewer.editor import GOAL
from apex_ompl.viz.viewer.live_page import PERIOD, LivePage
from apex_ompl.viz.viewer.page import write_page
from apex_ompl.viz.viewer.scene import pose_of
from apex_ompl.viz.viewer.server import serving
from apex_ompl.viz.viewer.shown import Shown
from benchmarks.lib import record

DEPENDS = ("@planning", "apex_ompl/viz", "apex_ompl/planning")
PAGES = ("ball_in_cup", "shelf/hard/900012", "cage/hard/900001", "clutter/hard/900002")
LEVELS = ("shelf/hard", "clutter/hard", "cage/hard", "posts/medium")
DRAGS = 100  # poses of a drag


def pages() -> list[list[str]]:
    """Return rows of pages: size and time to write."""
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for name in PAGES:
            result, file = plan(name, timeout=20.0), Path(folder) / "page.html"
            began = time.perf_counter()
            write_page([Shown.of(result)], file)
            took = time.perf_counter() - began
            duration = 0.0 if result.trajectory is None else result.trajectory.duration
            rows.append([f"page of {name}, {duration:.1f} s", f"{file.stat().st_size / 1e6:.2f} MB", f"{took:.2f} s"])
    return rows


def drags(problem: Problem) -> tuple[list[float], list[float]]:
    """Return how long answers took while the first obstacle was dragged, and while the goal of a hand was [s]."""
    with serving() as server:
        page = LivePage(server, [Shown.of(problem)])
        editor = page.editor
        assert editor is not None
        found: list[list[float]] = []
        for name in (problem.scene[0].name, f"{GOAL}{next(iter(editor.planner.robot.hands))}"):
            editor.grab(name)
            pose = pose_of(editor._control.wxyz, editor._control.position)
            times = []
            for shift in np.linspace(0.0, 0.3, DRAGS):
                moved = pose.copy()
                moved[0, 3] -= shift
                began = time.perf_counter()
                editor.drag(moved)
                times.append(time.perf_counter() - began)
            found.append(times)
    return found[0], found[1]


def steps(problem: Problem) -> list[float]:
    """Return how long steps of the player took [s]."""
    with serving() as server:
        page = LivePage(server, [Shown.of(plan(problem, timeout=20.0))])
        found = []
        for _ in range(150):
            began = time.perf_counter()
            page.step(PERIOD)
            found.append(time.perf_counter() - began)
    return found


def main() -> None:
    """Measure, and write the results."""
    parser = record.parser(__doc__, n=20, of="problems")
    args = parser.parse_args()
    names = [name for level in LEVELS for name in problems.frozen_names(*level.split("/"), "validation")]
    names = names[:: max(1, len(names) // args.n)][: args.n]
    with quiet_ompl():
        written = pages()
        both = [drags(load_problem(name)) for name in names]
        stepped = [t for name in names[:4] for t in steps(load_problem(name))]
    share = 100.0 * float(np.mean(stepped)) / PERIOD
    rows = [["page", "size", "time to write"], ["---", "---:", "---:"], *written, [], ["what", "p50", "p95"]]
    rows.append(["---", "---:", "---:"])
    dragged, goals = ([t for one in both for t in one[k]] for k in range(2))
    found = {}
    for what, times in (
        ("answer to a dragged obstacle", dragged),
        ("answer to a dragged goal", goals),
        ("step of the player", stepped),
    ):
        found[what] = record.percentiles(times, 50, 95)
        rows.append([f"{what} ({len(times)})", *(f"{1e3 * v:.2f} ms" for v in found[what])])
    table = "\n".join(record.row(row) if row else "" for row in rows) + f"\n\nPlaying takes {share:.1f} % of a core."
    data = {"pages": written, "p50 and p95 [s]": found, "share of a core [%]": share}
    record.write("viewer", data, table, split="validation; pages: test", n=len(names))


if __name__ == "__main__":
    run_script(main)
