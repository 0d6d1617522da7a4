"""The closed loop among moving obstacles, on the simulated clock: failure ratios by kind of world, speed and method.

Every run is judged by the referee at samples 1 ms apart with what truly happened. The sensor has its default settings
(30 Hz, 50 ms late, errors of 8 mm, 2 % missed), and obstacles were observed for 0.3 s before a run begins. Each run is
stored in benchmarks/runs/closed_loop when it ends; the command resumes where it was stopped.

Usage: python benchmarks/closed_loop.py [-n 60] [--jobs 1] [--split test] [--kinds moving popup] [--report]
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any, NamedTuple

import record
from tqdm import tqdm

from apex_ompl.loop.charges import cost_table
from apex_ompl.loop.methods import METHODS
from apex_ompl.loop.result import Outcome
from apex_ompl.loop.run import run
from apex_ompl.problems import worlds
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.files import write_atomically
from apex_ompl.util.statistics import share_interval
from apex_ompl.util.validation import one_or_more

DEPENDS = ("@planning", "apex_ompl/live", "apex_ompl/loop", "apex_ompl/trajectory")
FOLDER = record.RESULTS.parent / "runs" / "closed_loop"
SPEEDS = (1.0, 0.25)
KEPT = ("time_to_goal", "rest_time", "stops", "reaction_p95", "clearance", "limit_use", "broken_steps")


class Job(NamedTuple):
    """A run: name of the world, way of replanning, and share of the velocity limits."""

    world: str
    method: str
    speed: float

    @property
    def file(self) -> str:
        """Name of the file of the run."""
        return f"{self.world.replace('/', '_')}-{self.method}-{self.speed:g}.json"


def made(job: Job) -> dict[str, Any]:
    """Run once, and return what is kept."""
    result = run(job.world, job.method, speed=job.speed, seed=0)
    moving = result.outcome is Outcome.HIT_MOVING
    return {
        **job._asdict(), "outcome": str(result.outcome), "reason": result.reason, "costs": cost_table()["version"],
        "hit_while_expected": moving and not result.metrics["broken_steps"],
        **{name: result.metrics[name] for name in KEPT if name in result.metrics},
    }  # fmt: skip


def summary(some: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return the failure ratio of some runs with Wilson's interval, causes, and percentiles of those that succeed."""
    good = [one for one in some if one["outcome"] == "reached"]
    failed = len(some) - len(good)
    causes: dict[str, int] = {}
    for one in some:
        if one["outcome"] != "reached":
            causes[one["outcome"]] = causes.get(one["outcome"], 0) + 1
    times = [one["time_to_goal"] for one in good]
    reactions = [one["reaction_p95"] for one in some if "reaction_p95" in one]
    return {
        "n": len(some), "failed": failed / len(some), "interval": list(share_interval(failed, len(some))),
        "causes": causes, "hits_while_expected": sum(one["hit_while_expected"] for one in some),
        "time_to_goal_s": record.percentiles(times, 50, 95) if times else [None, None],
        "stops": sum(one["stops"] for one in some) / len(some),
        "reaction_p95_s": record.percentiles(reactions, 50, 95) if reactions else [None, None],
        "over_limits": sum(one["limit_use"] > 1.0 + 1e-9 for one in some),
    }  # fmt: skip


def table(rows: dict[str, dict[str, Any]]) -> str:
    """Return the Markdown table of rows."""
    head = ["", "N", "failed", "95 % interval", "causes", "hit while moving, as assumed", "time to goal s p50", "p95",
            "stops", "over limits"]  # fmt: skip
    lines = [head, ["---", *["---:"] * (len(head) - 1)]]
    for name, s in rows.items():
        low, high = s["interval"]
        causes = ", ".join(f"{count} {cause}" for cause, count in sorted(s["causes"].items())) or "-"
        times = ["-" if v is None else f"{v:.3g}" for v in s["time_to_goal_s"]]
        lines.append([
            name, s["n"], f"{100 * s['failed']:.1f} %", f"{100 * low:.1f} to {100 * high:.1f}", causes,
            s["hits_while_expected"], *times, f"{s['stops']:.2g}", s["over_limits"],
        ])  # fmt: skip
    return "\n".join(record.row(line) for line in lines)


def main() -> None:
    """Run what is missing, and write the results."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-n", type=one_or_more, default=60, help="worlds of each kind (default: %(default)s)")
    parser.add_argument("--jobs", type=one_or_more, default=1, help="runs at a time (default: %(default)s)")
    parser.add_argument("--split", default="test", choices=("test", "validation"))
    parser.add_argument("--kinds", nargs="+", default=list(worlds.kinds()), choices=worlds.kinds())
    parser.add_argument("--methods", nargs="+", default=list(METHODS), choices=list(METHODS))
    parser.add_argument("--speeds", nargs="+", type=float, default=list(SPEEDS))
    parser.add_argument("--store", type=Path, default=FOLDER, help="folder of the runs")
    parser.add_argument("--report", action="store_true", help="run nothing; write the results of the stored runs")
    args = parser.parse_args()
    jobs = {
        kind: [
            Job(world, method, speed)
            for world in worlds.ids(kind, args.split, args.n)
            for method in args.methods
            for speed in args.speeds
        ]
        for kind in args.kinds
    }
    args.store.mkdir(parents=True, exist_ok=True)
    missing = [job for some in jobs.values() for job in some if not (args.store / job.file).exists()]
    if missing and not args.report:
        os.environ.setdefault("OMP_NUM_THREADS", "1")
        with ProcessPoolExecutor(args.jobs) as pool:
            pending = {pool.submit(made, job): job for job in missing}
            for future in tqdm(as_completed(pending), total=len(pending)):
                if future.exception() is not None:
                    pool.shutdown(cancel_futures=True)
                text = json.dumps(future.result(), indent=1)
                write_atomically(args.store / pending[future].file, text.encode())
    rows: dict[str, list[dict[str, Any]]] = {}
    for kind, some in jobs.items():
        for job in some:
            if (args.store / job.file).exists():
                row = f"{kind}, speed {job.speed:g}, {job.method}"
                rows.setdefault(row, []).append(json.loads((args.store / job.file).read_text()))
    found = {name: summary(some) for name, some in rows.items()}
    record.write("closed_loop", {"rows": found}, table(found), split=args.split, n=args.n, seed=0)


if __name__ == "__main__":
    run_script(main)
