"""The closed loop of the worlds in physics, and by a robot that is exactly where it is commanded to be.

Each world is run once with each driver, with the same seeds: the exact one, that of physics, and that of physics with
1 kg in each hand that the controller does not know, which hangs when the run starts. The clock is simulated, the sensor
has its default settings, and every run is judged by the referee at samples 1 ms apart, by the measured motion. A run
fails where it does not end at rest at a goal within 10 s. Obstacles are not in the physics.

Differences of the failure ratio are paired by worlds, with intervals of Agresti and Min (2005), and p is that of
McNemar's exact test.

Runs are stored in benchmarks/runs/physics_worlds, a file for each world; the command resumes where it was stopped. The
results are those of the worlds that each of the drivers has run in.

Usage: python -m benchmarks.physics.worlds [-n 60] [--split test] [--kinds moving popup] [--drivers exact physics]
    [--report]
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Sequence
from statistics import NormalDist
from typing import Any

import numpy as np
from scipy.stats import binomtest
from tqdm import tqdm

from apex_ompl import run
from apex_ompl.drivers import KinematicDriver, MujocoDriver
from apex_ompl.drivers.library import mujoco
from apex_ompl.loop.result import Outcome
from apex_ompl.moving.settings import LoopSettings
from apex_ompl.problems import worlds
from apex_ompl.problems.suite_robot import robot
from apex_ompl.scene.problem import Problem
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.files import write_atomically
from apex_ompl.util.statistics import share_interval
from benchmarks.lib import record

DEPENDS = ("@planning", "apex_ompl/moving", "apex_ompl/loop", "apex_ompl/timing", "apex_ompl/drivers")
FOLDER = record.RESULTS.parent / "runs" / "physics_worlds"
METHOD, SEED, TIMEOUT = "apex", 0, 10.0
LOAD, HANGS = 1.0, 1.0  # in each hand [kg], and time for which it hangs before a run [s]
EXACT, PHYSICS, LOADED = DRIVERS = ("exact", "physics", "physics, unknown 1 kg")
KEPT = (
    "time_to_goal", "rest_time", "stops", "clearance", "limit_use", "broken_steps", "unguarded_steps", "late_commands",
    "tracking_error", "tracking_error_p95", "duration",
)  # fmt: skip
HEAD = (
    "worlds", "driver", "N", "failed % (95 %)", "hit while moving", "as assumed", "hit at rest", "stuck or late",
    "time to goal s p50", "error mrad p50", "p95", "most", "over limits", "unguarded steps",
)  # fmt: skip
PAIRED = ("against the exact robot", "N", "only it failed", "only the other failed", "difference % (95 %)", "p")


def driver_of(name: str, problem: Problem) -> Any:
    """Return a driver by its name in the table, at the start of a problem."""
    if name == EXACT:
        return KinematicDriver(robot(), problem.start_state(robot().joint_names))
    if name == PHYSICS:
        return MujocoDriver(robot(), problem)
    held = problem.model_copy(update={"payload": dict.fromkeys(robot().hands, LOAD)})
    driver = MujocoDriver(robot(), held, assumed=problem)
    driver.advance(HANGS)
    driver.forget()
    return driver


def made(world: str, name: str) -> dict[str, Any]:
    """Run once, and return what is kept."""
    environment, started = worlds.load(world), time.process_time()
    driver = driver_of(name, environment.problem.still)
    found = run(environment, METHOD, seed=SEED, settings=LoopSettings(timeout=TIMEOUT), driver=driver)
    touched = sorted(map(list, getattr(driver, "contacts", {})))
    driver.close()
    return {
        "outcome": str(found.outcome), "reason": found.reason, "contacts": touched,
        "seconds": time.process_time() - started,
        **{key: found.metrics[key] for key in KEPT if key in found.metrics},
    }  # fmt: skip


def failed(one: dict[str, Any]) -> bool:
    """Whether a run failed."""
    return bool(one["outcome"] != Outcome.REACHED)


def row(kind: str, name: str, runs: Sequence[dict[str, Any]]) -> list[Any]:
    """Return the row of some runs of a driver."""
    count, bad = len(runs), sum(map(failed, runs))
    low, high = share_interval(bad, count)
    hits = [one for one in runs if one["outcome"] == Outcome.HIT_MOVING]
    off = 1e3 * np.array([one.get("tracking_error", np.nan) for one in runs])
    times = [one["time_to_goal"] for one in runs if not failed(one)]
    others = (Outcome.REACHED, Outcome.HIT_MOVING, Outcome.HIT_AT_REST)
    middle, high_error, most = np.nanpercentile(off, [50, 95, 100]).tolist()
    return [
        kind, name, count, f"{100 * bad / count:.1f} ({100 * low:.1f} to {100 * high:.1f})", len(hits),
        sum(not one["broken_steps"] for one in hits), sum(one["outcome"] == Outcome.HIT_AT_REST for one in runs),
        sum(one["outcome"] not in others for one in runs), f"{np.median(times):.2f}" if times else "-",
        f"{middle:.3g}", f"{high_error:.3g}", f"{most:.3g}", sum(one["outcome"] == Outcome.LIMITS for one in runs),
        int(sum(one["unguarded_steps"] for one in runs)),
    ]  # fmt: skip


def paired(name: str, pairs: Sequence[tuple[bool, bool]]) -> list[Any]:
    """Return the row of a driver's failures beside those of the exact one, which come first in each pair."""
    count = len(pairs)
    fewer, more = (sum(one > other for one, other in some) for some in (pairs, [pair[::-1] for pair in pairs]))
    difference, half = agresti_min(fewer, more, count)
    p = binomtest(fewer, fewer + more).pvalue if fewer + more else 1.0
    low, high = 100 * (difference - half), 100 * (difference + half)
    shown = f"{100 * (more - fewer) / count:+.1f} ({low:+.1f} to {high:+.1f})"
    return [name, count, fewer, more, shown, f"{p:.2g}"]


def agresti_min(fewer: int, more: int, count: int, confidence: float = 0.95) -> tuple[float, float]:
    """Return the middle and half the width of the interval of a paired difference of proportions.

    Agresti and Min (2005), Statistics in Medicine 24: Wald's interval with half a pair added to each cell.
    """
    b, c, n = fewer + 0.5, more + 0.5, count + 2.0
    return (c - b) / n, NormalDist().inv_cdf(0.5 + 0.5 * confidence) * math.sqrt(b + c - (b - c) ** 2 / n) / n


def main() -> None:
    """Run what is missing, and write the results."""
    parser = record.parser(__doc__ or "", n=60, of="worlds of a kind")
    parser.add_argument("--split", default="test", choices=("test", "validation"))
    parser.add_argument("--kinds", nargs="+", default=list(worlds.kinds()), choices=worlds.kinds())
    parser.add_argument("--drivers", nargs="+", default=list(DRIVERS), choices=DRIVERS)
    parser.add_argument("--report", action="store_true", help="run nothing; write the results of the stored runs")
    given = parser.parse_args()
    each = {kind: worlds.ids(kind, given.split, given.n) for kind in given.kinds}
    names = [name for some in zip(*each.values(), strict=True) for name in some]  # all kinds grow alike
    files = {name: FOLDER / f"{name.replace('/', '_')}.json" for name in names}
    FOLDER.mkdir(parents=True, exist_ok=True)
    runs = {name: json.loads(file.read_text()) for name, file in files.items() if file.exists()}
    missing = [name for name in names if not {*given.drivers} <= runs.get(name, {}).keys()]
    for name in tqdm([] if given.report else missing):
        stored = runs.setdefault(name, {"commit": record.session()["commit"]})
        stored |= {driver: made(name, driver) for driver in given.drivers if driver not in stored}
        write_atomically(files[name], json.dumps(stored, indent=1).encode())
    runs = {name: one for name, one in runs.items() if {*given.drivers} <= one.keys()}
    here = {kind: [name for name in some if name in runs] for kind, some in each.items()}
    here["all"] = list(runs)
    rows = [
        row(kind, driver, [runs[n][driver] for n in some]) for kind, some in here.items() for driver in given.drivers
    ]
    physical = [driver for driver in given.drivers if driver != EXACT]
    beside = [
        paired(driver, [(failed(one[EXACT]), failed(one[driver])) for one in runs.values()])
        for driver in (physical if EXACT in given.drivers else [])
    ]
    touched = {driver: sum(bool(one[driver]["contacts"]) for one in runs.values()) for driver in physical}
    tables = [[HEAD, *rows], [PAIRED, *beside]]
    text = "\n\n".join(
        "\n".join(record.row(list(line)) for line in (head, ["---", *["---:"] * (len(head) - 1)], *lines))
        for head, *lines in tables
    )
    counts = ", ".join(f"{count} ({driver})" for driver, count in touched.items())
    text += f"\n\nRuns in which the robot touched itself or a static obstacle in physics: {counts or '-'}.\n"
    data = {"columns": HEAD, "rows": rows, "paired_columns": PAIRED, "paired": beside, "touched": touched}
    commits = "; ".join(sorted({one["commit"] for one in runs.values()}))
    settings = {"split": given.split, "n": len(runs), "seed": SEED, "mujoco": mujoco().__version__}
    record.write("physics_worlds", data, text.rstrip(), **settings, run_commits=commits)


if __name__ == "__main__":
    run_script(main)
