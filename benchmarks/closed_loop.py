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

Usage: python benchmarks/closed_loop.py [-n 60] [--jobs 1] [--split test] [--kinds moving popup] [--report]
       [--clock sim] [--clairvoyant 60]
"""

from __future__ import annotations

import argparse
import json
import math
import os
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import record
from tqdm import tqdm

from apex_ompl import plan, problems
from apex_ompl.loop.charges import cost_table
from apex_ompl.loop.methods import METHODS
from apex_ompl.loop.metrics import NEAR
from apex_ompl.loop.referee import LIMIT_TOLERANCE
from apex_ompl.loop.result import GOING, Outcome, RunResult
from apex_ompl.loop.run import CLOCKS, run
from apex_ompl.problems import worlds
from apex_ompl.trajectory.timing import Timing
from apex_ompl.util import provenance
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.files import write_atomically
from apex_ompl.util.statistics import share_interval
from apex_ompl.util.validation import one_or_more

DEPENDS = (
    "@planning", "apex_ompl/imitation", "apex_ompl/live", "apex_ompl/loop", "apex_ompl/roadmaps",
    "apex_ompl/trajectory", "benchmarks/baselines",
)  # fmt: skip
FOLDER = record.RESULTS.parent / "runs" / "closed_loop"
SPEEDS = (1.0, 0.25)
KEPT = (
    "time_to_goal", "rest_time", "stops", "clearance", "limit_use", "broken_steps", "improvements", "tick_p50",
    "tick_p99", "tick_worst", "deadline_misses",
)  # fmt: skip

CLAIRVOYANT = "clairvoyant"
SEARCHED = 10.0  # [s]
SIMULATED, REAL = CLOCKS
SCRIPTED = "moving"  # kind of the worlds whose obstacles go their way whatever the robot does


class Job(NamedTuple):
    """A run: name of the world, way of replanning, share of the velocity limits, and clock."""

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
    taken = [event for event in result.events if event.kind in ("accepted", "improved")]
    timed = {
        name: [event.data["took"] for event in result.events if event.kind in some and "took" in event.data]
        for name, some in (("replans", ("accepted", "rejected")), ("plans", ("accepted",)))
    }
    expected = result.outcome is Outcome.HIT_MOVING and not result.metrics["broken_steps"]
    contact = next((event.time for event in result.events if event.kind == "contact"), math.inf)
    leaving = [event.data["leaving"] for event in taken if event.time <= contact][-1:]
    reactions = [
        [event.data[name] for name in ("seconds", "ahead", "doing")]
        for event in result.events
        if event.kind == "reaction"
    ]
    return {
        **job._asdict(), **made_with(), "outcome": str(result.outcome), "reason": result.reason,
        "hit_while_expected": expected, "hit_while_leaving": expected and leaving == [True], **timed,
        "reactions": reactions,
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
        "hit_while_expected": False,
        "hit_while_leaving": False, "seeds": seed, "reactions": [], "replans": [], "plans": [], **reached,
    }  # fmt: skip


def ratios(some: Sequence[dict[str, Any]], best: Sequence[dict[str, Any]]) -> list[float]:
    """Return times to the goal by those of other runs in the same worlds, where both came there."""
    of = reached(best)
    return [time / of[world] for world, time in reached(some).items() if world in of]


def summary(some: Sequence[dict[str, Any]], best: Sequence[dict[str, Any]] = ()) -> dict[str, Any]:
    """Return the failure ratio of some runs with Wilson's interval, causes, and percentiles of those that succeed.

    Args:
        some: The runs.
        best: The clairvoyant's in the same worlds.
    """
    good = [one for one in some if one["outcome"] == "reached"]
    failed = len(some) - len(good)
    causes: dict[str, int] = {}
    for one in some:
        if one["outcome"] != "reached":
            causes[one["outcome"]] = causes.get(one["outcome"], 0) + 1
    times = [one["time_to_goal"] for one in good]
    compared, replans = ratios(some, best), [took for one in some for took in one["replans"]]
    plans, reactions = [took for one in some for took in one["plans"]], [r for one in some for r in one["reactions"]]
    near = [took for took, ahead, doing in reactions if ahead < NEAR and doing == GOING]
    levels: dict[str, list[bool]] = {}
    for one in some:
        levels.setdefault(one["world"].rpartition("/")[0], []).append(one["outcome"] != "reached")
    leaving = sum(one["hit_while_leaving"] for one in some)
    ticks = {name: column(some, name) for name in ("tick_p50", "tick_p99", "tick_worst", "deadline_misses")}
    return {
        "n": len(some), "failed": failed / len(some), "interval": list(share_interval(failed, len(some))),
        "causes": causes, "hits_while_expected": sum(one["hit_while_expected"] for one in some) - leaving,
        "hits_while_leaving": leaving,
        "time_to_goal_s": of_all(times), "by_clairvoyant": of_all(compared), "compared": len(compared),
        "replan_s": of_all(replans), "replans": len(replans), "plan_s": of_all(plans),
        "levels": {level: [sum(row), len(row)] for level, row in levels.items()},
        "worst_level": max(sum(row) / len(row) for row in levels.values()),
        "stops": sum(one["stops"] for one in some) / len(some),
        "reaction_s": of_all([took for took, *_ in reactions]), "reactions": len(reactions),
        "near_reaction_s": of_all(near), "near": len(near),
        **{f"{name}_s": float(np.median(ticks[name])) for name in ("tick_p50", "tick_p99") if ticks[name]},
        **({"tick_worst_s": max(ticks["tick_worst"])} if ticks["tick_worst"] else {}),
        **({"deadline_misses": sum(ticks["deadline_misses"])} if ticks["deadline_misses"] else {}),
        "over_limits": sum(one["limit_use"] > 1.0 + LIMIT_TOLERANCE for one in some),
    }  # fmt: skip


def of_all(values: Sequence[float]) -> list[float | None]:
    """Return the 50th and the 95th percentile, or nothing of no values."""
    return list(record.percentiles(list(values), 50, 95)) if values else [None, None]


def column(some: Sequence[dict[str, Any]], name: str) -> list[float]:
    """Return a number of some runs, those that have it."""
    return [one[name] for one in some if name in one]


def shown(value: float | None, unit: float = 1.0) -> str:
    """Return a number as the tables have it."""
    return "-" if value is None else f"{unit * value:.3g}"


def by_size(runs: Sequence[dict[str, Any]]) -> tuple[str, dict[str, Any]]:
    """Return the table of failure ratios over the size of obstacles, and its numbers."""
    found: dict[str, dict[str, list[bool]]] = {}
    for one in runs:
        size = one["world"].split("/")[-2].removeprefix("moving-").split("-")[0]
        row = f"speed {one['speed']:g}, {one['method']}"
        found.setdefault(row, {}).setdefault(size, []).append(one["outcome"] != "reached")
    sizes = list(next(iter(found.values())))
    lines: list[list[Any]] = [
        ["moving, failed %, by size", *sizes, "N of a size"],
        ["---", *["---:"] * (len(sizes) + 1)],
    ]
    for name, row in found.items():
        shares = [f"{100 * sum(row[size]) / len(row[size]):.1f}" if size in row else "-" for size in sizes]
        lines.append([name, *shares, min(map(len, row.values()))])
    numbers = {name: {size: [sum(x), len(x)] for size, x in row.items()} for name, row in found.items()}
    return "\n".join(record.row(line) for line in lines), numbers


def named(row: tuple[str, float, str]) -> str:
    """Return the name of a row: kind of worlds, speed, and method."""
    kind, speed, method = row
    return f"{kind}, speed {speed:g}, {method}"


def by_clock(
    rows: dict[tuple[str, float, str], list[dict[str, Any]]], timed: dict[tuple[str, float, str], list[dict[str, Any]]]
) -> tuple[str, dict[str, Any]]:
    """Return the table of the runs on the real clock beside those on the simulated one in the same worlds."""
    head = ["both clocks", "clock", "N", "failed", "95 % interval", "causes", "time to goal s p50", "p95",
            "plan ms p50", "p95", "reaction ms p50", "p95", "near ms p95", "stops", "step ms p99, median", "worst",
            "steps late"]  # fmt: skip
    lines, numbers = [head, ["---", "---", *["---:"] * (len(head) - 2)]], {}
    for row, real in timed.items():
        there = {one["world"] for one in real}
        simulated = [one for one in rows.get(row, ()) if one["world"] in there]
        for clock, some in ((SIMULATED, simulated), (REAL, real)):
            if not some:
                continue
            s = numbers[f"{named(row)}, {clock}"] = summary(some)
            times = [shown(v) for v in s["time_to_goal_s"]]
            times += [shown(v, 1e3) for v in (*s["plan_s"], *s["reaction_s"], s["near_reaction_s"][1])]
            steps = [shown(s.get("tick_p99_s"), 1e3), shown(s.get("tick_worst_s"), 1e3), s.get("deadline_misses", "-")]
            low, high = s["interval"]
            lines.append([
                named(row), clock, s["n"], f"{100 * s['failed']:.1f} %", f"{100 * low:.1f} to {100 * high:.1f}",
                causes_of(s), *times, f"{s['stops']:.2g}", *steps,
            ])  # fmt: skip
    return "\n".join(record.row(line) for line in lines), numbers


def by_waiting(rows: dict[tuple[str, float, str], list[dict[str, Any]]]) -> tuple[str, dict[str, Any]]:
    """Return the table of apex's times to the goal by those of stop-and-wait, over worlds in which both come there."""
    head = ["apex by stop-and-wait", "worlds", "ratio of times to goal p50", "of their sums"]
    lines, numbers = [head, ["---", *["---:"] * (len(head) - 1)]], {}
    for speed in sorted({speed for _, speed, _ in rows}, reverse=True):
        found: dict[str, list[tuple[float, float]]] = {}
        for kind in dict.fromkeys(kind for kind, *_ in rows):
            own, other = (reached(rows.get((kind, speed, method), ())) for method in ("apex", "stop-and-wait"))
            found[kind] = [(own[world], other[world]) for world in own if world in other]
        found["all"] = [pair for pairs in found.values() for pair in pairs]
        for kind, pairs in found.items():
            if pairs:
                total = [sum(times) for times in zip(*pairs, strict=True)]
                row = [float(np.median([a / b for a, b in pairs])), total[0] / total[1]]
                numbers[f"{kind}, speed {speed:g}"] = [len(pairs), *row]
                lines.append([f"{kind}, speed {speed:g}", len(pairs), *(f"{v:.2f}" for v in row)])
    return "\n".join(record.row(line) for line in lines), numbers


def reached(some: Sequence[dict[str, Any]]) -> dict[str, float]:
    """Return times to the goal of the runs that came there, by world [s]."""
    return {one["world"]: one["time_to_goal"] for one in some if one["outcome"] == "reached"}


def causes_of(s: dict[str, Any]) -> str:
    """Return the causes of failures of a row."""
    return ", ".join(f"{count} {cause}" for cause, count in sorted(s["causes"].items())) or "-"


def table(rows: dict[str, dict[str, Any]]) -> str:
    """Return the Markdown table of rows."""
    head = ["", "N", "failed", "95 % interval", "causes", "hit while moving, as assumed", "leaving",
            "time to goal s p50", "p95", "by clairvoyant's p50", "p95", "stops", "worst level %",
            "plan ms p50", "p95", "reaction ms p95", "near ms p95", "over limits"]  # fmt: skip
    lines = [head, ["---", *["---:"] * (len(head) - 1)]]
    for name, s in rows.items():
        low, high = s["interval"]
        times = [shown(v) for v in (*s["time_to_goal_s"], *s["by_clairvoyant"])]
        replans = [shown(v, 1e3) for v in (*s["plan_s"], s["reaction_s"][1], s["near_reaction_s"][1])]
        lines.append([
            name, s["n"], f"{100 * s['failed']:.1f} %", f"{100 * low:.1f} to {100 * high:.1f}", causes_of(s),
            s["hits_while_expected"], s["hits_while_leaving"], *times, f"{s['stops']:.2g}",
            f"{100 * s['worst_level']:.3g}", *replans, s["over_limits"],
        ])  # fmt: skip
    return "\n".join(record.row(line) for line in lines)


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
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-n", type=one_or_more, default=60, help="worlds of each kind (default: %(default)s)")
    parser.add_argument("--jobs", type=one_or_more, default=1, help="runs at a time (default: %(default)s)")
    parser.add_argument("--split", default="test", choices=("test", "validation"))
    parser.add_argument("--kinds", nargs="+", default=list(worlds.kinds()), choices=worlds.kinds())
    parser.add_argument("--methods", nargs="+", default=list(METHODS), choices=list(METHODS))
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
    rows: dict[tuple[str, float, str], list[dict[str, Any]]] = {}
    timed: dict[tuple[str, float, str], list[dict[str, Any]]] = {}
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
