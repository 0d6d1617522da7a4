"""Contacts of robots that move, under the assumptions of the guarantee, over many short runs of the closed loop.

The loop plans anew without the network, at full speed, for at most 4 s a run, in worlds of all kinds whose obstacles
do not come out of nowhere. Of those with a moving cube the first 600 are frozen, with a witness; others may be such
that no robot could evade. In every fifth run it looks for faster motions too, which takes most of the time. The
referee knows what truly happened. A robot that leaves a place that an obstacle comes to does so without a proved stop:
contacts then are counted apart. Runs are stored in benchmarks/runs/guarded_runs when they end; the command resumes
where it was stopped, and those of the committed table are packed (``python benchmarks/pack.py unpack guarded_runs``).

Usage: python benchmarks/guarded_runs.py [-n 10000] [--jobs 1] [--split test] [--report]
"""

from __future__ import annotations

import argparse
import json
import math
from typing import Any

import record
from closed_loop import FOLDER, SCRIPTED, Job, kept, made_by, stored

from apex_ompl.loop.referee import LIMIT_TOLERANCE
from apex_ompl.loop.run import run
from apex_ompl.loop.settings import LoopSettings
from apex_ompl.problems import worlds
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.statistics import share_interval
from apex_ompl.util.validation import one_or_more

DEPENDS = ("benchmarks/closed_loop.py", "@planning", "apex_ompl/live", "apex_ompl/loop", "apex_ompl/trajectory")
SHORT = 4.0  # time of a run [s]
HASTENING = 5  # of so many runs one looks for faster motions
KINDS = ("moving", "turning", "crowd", "pusher")
HEAD = (
    "worlds", "N", "hit while moving, as assumed", "share at most % (95 %)", "hit while leaving", "hit at rest",
    "runs with broken assumptions", "over limits",
)  # fmt: skip


def made(job: Job) -> dict[str, Any]:
    """Run once, and return what is kept."""
    hastens = int(job.world.rpartition("/")[2]) % HASTENING == 0
    settings = LoopSettings(timeout=SHORT, hastens=hastens)
    return kept(job, run(job.world, job.method, speed=job.speed, seed=0, settings=settings))


def kind_of(world: str) -> str:
    """Return the kind of a world by its name."""
    first = world.split("/", maxsplit=1)[0]
    return first if first in worlds.kinds() else SCRIPTED


def row(kind: str, runs: list[dict[str, Any]]) -> list[Any]:
    """Return the row of some runs."""
    leaving = sum(one["hit_while_leaving"] for one in runs)
    hits = sum(one["hit_while_expected"] for one in runs) - leaving
    return [
        kind, len(runs), hits, f"{100 * share_interval(hits, len(runs))[1]:.3g}" if runs else "-", leaving,
        sum(one["outcome"] == "hit-at-rest" for one in runs), sum(one["broken_steps"] > 0 for one in runs),
        sum(one["limit_use"] > 1.0 + LIMIT_TOLERANCE for one in runs),
    ]  # fmt: skip


def main() -> None:
    """Run what is missing, and write the results."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-n", type=one_or_more, default=10000, help="runs (default: %(default)s)")
    parser.add_argument("--jobs", type=one_or_more, default=1, help="runs at a time (default: %(default)s)")
    parser.add_argument("--split", default="test", choices=("test", "validation"))
    parser.add_argument("--report", action="store_true", help="run nothing; write the results of the stored runs")
    args = parser.parse_args()
    args.store = FOLDER.with_name("guarded_runs")
    each = [worlds.ids(kind, args.split, math.ceil(args.n / len(KINDS))) for kind in KINDS]
    jobs = [Job(name, "no-network", 1.0) for some in zip(*each, strict=True) for name in some][: args.n]
    stored(jobs, args, made)
    runs = [json.loads((args.store / job.file).read_text()) for job in jobs if (args.store / job.file).exists()]
    rows = [row(kind, [one for one in runs if kind_of(one["world"]) == kind]) for kind in KINDS]
    rows.append(row("all", runs))
    lines = [HEAD, ["---", *["---:"] * (len(HEAD) - 1)], *rows]
    text = "\n".join(record.row(list(line)) for line in lines)
    data = {"rows": rows, "columns": HEAD}
    record.write("guarded_runs", data, text, split=args.split, n=len(runs), seed=0, **made_by(runs))


if __name__ == "__main__":
    run_script(main)
