"""The closed loop among moving obstacles: failure ratios by kind of world, speed and method.

The clock is simulated, or with ``--clock real`` that on the wall, one run at a time on a machine that does nothing
else; runs on both clocks in the same worlds stand beside each other in a table of their own.
Every run is judged by the referee at samples 1 ms apart with what truly happened. The sensor has its default settings
(30 Hz, 50 ms late, errors of 8 mm, 2 % missed), and obstacles were observed for 0.3 s before a run begins. Each run is
stored in benchmarks/runs/closed_loop when it ends; the command resumes where it was stopped.

The row ``clairvoyant`` is no loop: ``plan`` knows from the beginning how everything will move, begins at once, and
gives the shortest motion of what it finds in 10 s with as many seeds as fit. Times to the goal are compared with its,
over the runs that both end at the goal. (It is made where motions are independent of the robot's, in moving worlds.)

Reactions are those of all runs of a row: the time from the look at which a conflict was first predicted, wherever on
the rest of the motion, until the command changed; near ones are of conflicts less than half a second ahead of robots
that were on their way: those that braked already had changed their command before, and those that stood needed a plan.

Usage: python -m benchmarks.loop.closed_loop [-n 60] [--jobs 1] [--split test] [--kinds moving popup] [--report]
       [--clock sim] [--clairvoyant 60]
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from tqdm import tqdm

from apex_ompl import plan, problems, run
from apex_ompl.loop.replan.methods import names
from apex_ompl.loop.result import Outcome, RunResult
from apex_ompl.loop.run import CLOCKS
from apex_ompl.moving.compute_costs import cost_table
from apex_ompl.problems import worlds
from apex_ompl.timing.parameterization import Timing
from apex_ompl.util import provenance
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.files import write_atomically
from apex_ompl.util.validation import one_or_more
from benchmarks.lib import record
from benchmarks.loop.closed_loop_tables import Row, Stored, by_clock, by_size, by_waiting, named, summary, table

DEPENDS = (
    "@planning", "apex_ompl/moving", "apex_ompl/loop", "apex_ompl/baselines",
    "apex_ompl/timing", "benchmarks/baselines", "benchmarks/loop/closed_loop_tables.py",
)  # fmt: skip
FOLDER = record.RESULTS.parent / "runs" / "closed_loop"
SPEEDS = (1.0, 0.25)
KEPT = (
    "time_to_goal", "rest_time", "stops", "clearance", "limit_use", "broken_steps", "unguarded_steps", "improvements",
    "tick_p50", "tick_p99", "tick_worst", "deadline_misses",
)  # fmt: skip

CLAIRVOYANT = "clairvoyant"
SEARCHED = 10.0  # [s]
SIMULATED, REAL = CLOCKS
SCRIPTED = "moving"  # kind of the worlds whose obstacles go their way whatever the robot does


class Job(NamedTuple):
    """A run: name of the world, replanner, share of the velocity limits, and clock."""

    world: str
    method: str
    speed: float
    clock: str = SIMULATED

    @property
    def file(self) -> str:
        """Name of the file of the run."""
        clock = "" if self.clock == SIMULATED else f"-{self.clock}"
        return f"{self.world.replace('/', '_')}-{self.method}-{self.speed:g}{clock}.json"


@cache
def made_with() -> dict[str, Any]:
    """Return what a run is to be compared by: commit, hardware, and version of the table of costs."""
    return {**record.session(), "hardware": provenance.hardware(), "costs": cost_table()["version"]}


def made_by(runs: Sequence[dict[str, Any]]) -> dict[str, str]:
    """Return the commits, hardware and tables of costs of some runs, as results say them."""
    found = {name: sorted({str(run.get(name, "unknown")) for run in runs}) for name in ("commit", "hardware", "costs")}
    return {"run_commits": "; ".join(found["commit"]), "run_hardware": "; ".join(found["hardware"]),
            "costs": "; ".join(found["costs"])}  # fmt: skip


def made(job: Job) -> dict[str, Any]:
    """Run once, and return what is kept."""
    if job.method == CLAIRVOYANT:
        return offline(job)
    return kept(job, run(job.world, job.method, speed=job.speed, seed=0, clock=job.clock))


def kept(job: Job, result: RunResult) -> dict[str, Any]:
    """Return what is kept of a run."""
    timed = {
        name: [event.data["took"] for event in result.events if event.kind in some and "took" in event.data]
        for name, some in (("replans", ("accepted", "rejected")), ("plans", ("accepted",)))
    }
    expected = result.outcome is Outcome.HIT_MOVING and not result.metrics["broken_steps"]
    reactions = [
        [event.data[name] for name in ("seconds", "ahead", "doing")]
        for event in result.events
        if event.kind == "reaction"
    ]
    return {
        **job._asdict(), **made_with(), "outcome": str(result.outcome), "reason": result.reason,
        "hit_while_expected": expected, **timed, "reactions": reactions,
        **{name: result.metrics[name] for name in KEPT if name in result.metrics},
    }  # fmt: skip


def offline(job: Job) -> dict[str, Any]:
    """Plan with all that will happen known, and return what is kept."""
    problem, begun, found, seed = problems.load(job.world), time.perf_counter(), [], 0
    while time.perf_counter() - begun < SEARCHED:
        result = plan(problem, timeout=SEARCHED, seed=seed, timing=Timing(velocity_scale=job.speed))
        if result and result.trajectory is not None:
            found.append(result.trajectory.duration)
        seed += 1
    reached = (
        {"time_to_goal": min(found), "stops": 0.0, "limit_use": 1.0} if found else {"stops": 0.0, "limit_use": 0.0}
    )
    return {
        **job._asdict(), **made_with(), "outcome": str(Outcome.REACHED if found else Outcome.TIMEOUT),
        "hit_while_expected": False, "seeds": seed, "reactions": [], "replans": [], "plans": [], **reached,
    }  # fmt: skip


def stored(jobs: Sequence[Job], args: argparse.Namespace, make: Callable[[Job], dict[str, Any]]) -> None:
    """Make and store what is missing."""
    args.store.mkdir(parents=True, exist_ok=True)
    missing = [job for job in jobs if not (args.store / job.file).exists()]
    if not missing or args.report:
        return
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    with ProcessPoolExecutor(args.jobs) as pool:
        pending = {pool.submit(make, job): job for job in missing}
        for future in tqdm(as_completed(pending), total=len(pending)):
            if future.exception() is not None:
                pool.shutdown(cancel_futures=True)
            text = json.dumps(future.result(), indent=1)
            write_atomically(args.store / pending[future].file, text.encode())


def main() -> None:
    """Run what is missing, and write the results."""
    parser = record.parser(__doc__, n=60, of="worlds of each kind", jobs=1)
    parser.add_argument("--split", default="test", choices=("test", "validation"))
    parser.add_argument("--kinds", nargs="+", default=list(worlds.kinds()), choices=worlds.kinds())
    parser.add_argument("--methods", nargs="+", default=names(), choices=names())
    parser.add_argument("--speeds", nargs="+", type=float, default=list(SPEEDS))
    parser.add_argument("--clock", default=SIMULATED, choices=CLOCKS, help="of runs that are made (default: sim)")
    parser.add_argument("--clairvoyant", type=one_or_more, default=60, help="its worlds (default: %(default)s)")
    parser.add_argument("--store", type=Path, default=FOLDER, help="folder of the runs")
    parser.add_argument("--report", action="store_true", help="run nothing; write the results of the stored runs")
    args = parser.parse_args()
    if args.clock == REAL and args.jobs > 1:
        parser.error("runs on the real clock go one at a time, expected --jobs 1")
    jobs = {
        (kind, clock): [
            Job(world, method, speed, clock)
            for world in worlds.ids(kind, args.split, args.n)
            for method in args.methods
            for speed in args.speeds
        ]
        for kind in args.kinds
        for clock in CLOCKS
    }
    if SCRIPTED in args.kinds:
        known = worlds.ids(SCRIPTED, args.split, min(args.n, args.clairvoyant))
        jobs[SCRIPTED, SIMULATED] += [Job(world, CLAIRVOYANT, speed) for world in known for speed in args.speeds]
    stored([job for (_, clock), some in jobs.items() for job in some if clock == args.clock], args, made)
    rows: dict[Row, list[Stored]] = {}
    timed: dict[Row, list[Stored]] = {}
    for (kind, clock), some in jobs.items():
        for job in some:
            if (args.store / job.file).exists():
                of = rows if clock == SIMULATED else timed
                one = json.loads((args.store / job.file).read_text())
                of.setdefault((kind, job.speed, job.method), []).append(one)
    found = {named(row): summary(some, rows.get((row[0], row[1], CLAIRVOYANT), ())) for row, some in rows.items()}
    text, data = table(found), {"rows": found}
    moving = [one for (kind, _, _), some in rows.items() if kind == SCRIPTED for one in some]
    if moving:
        sizes, data["by_size"] = by_size(moving)
        text = f"{text}\n\n{sizes}"
    if timed:
        clocks, data["by_clock"] = by_clock(rows, timed)
        text = f"{text}\n\n{clocks}"
    waiting, data["by_waiting"] = by_waiting(rows)
    if data["by_waiting"]:
        text = f"{text}\n\n{waiting}"
    every = [one for some in (*rows.values(), *timed.values()) for one in some]
    record.write("closed_loop", data, text, split=args.split, n=args.n, seed=0, **made_by(every))


if __name__ == "__main__":
    run_script(main)
