"""How fast the data engine makes proven paths: per level and source, where the time goes, and with one and two workers.

Non-trivial paths are those of problems that the straight line does not solve, and parts that it does not solve either.

Usage: python -m benchmarks.model.data_engine [--units 2] [--workers 2] [--first 40000]
"""

from __future__ import annotations

import json
import multiprocessing
import resource
import subprocess
import sys
import tempfile
import time
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from apex_ompl.paths.spline import Spline
from apex_ompl.problems import scenes
from apex_ompl.training.engine import EngineOptions
from apex_ompl.training.records import SOURCES
from apex_ompl.training.units import UNIT_SIZE, Unit, level_weight, solve_unit, static_levels
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.validation import one_or_more, whole_number
from benchmarks.lib import record

DEPENDS = ("@planning", "apex_ompl/training", "apex_ompl/training")
SCRIPT = Path(__file__).resolve().parents[2] / "scripts" / "generate_data.py"
WANTED, CORES = 500_000, (2, 16, 64)
SCALED = ("vertical", "horizontal", "wall/easy", "swap/medium")  # levels solved with one and with several workers
PROBLEMS = 240
MOST_DEEP = 3  # columns of stages


def one(unit: Unit) -> dict[str, Any]:
    """Return yield and cost of a unit."""
    begin = time.perf_counter()
    paths, times = solve_unit(unit, EngineOptions(), Spline())
    seconds = time.perf_counter() - begin
    a = paths.arrays
    straight = set(a["problem"][a["source"] == SOURCES.index("line")].tolist())
    hard_way = np.array([p not in straight for p in a["problem"].tolist()], bool)
    counts = {s: int(((a["source"] == k) & hard_way).sum()) for k, s in enumerate(SOURCES)}
    found = {"level": f"{unit.suite}/{unit.level}", "seconds": seconds, "sources": counts, "times": times}
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    tried = paths.counts.get("drawn", 0) - paths.counts.get("straight, left out", 0)
    return {**found, "tried": tried, "solved": paths.counts.get("solved", 0), "memory_mb": memory}


def warm_up() -> None:
    """Load the kernel and the robot, so that no unit pays for it."""
    for level in ("easy", "hard"):
        solve_unit(Unit("wall", level, 1, 1), EngineOptions(), Spline())


def scaled(workers: int) -> dict[str, float]:
    """Return the rate of the script with some workers, their start included."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, str(SCRIPT), folder, *SCALED, "--problems", str(PROBLEMS), "--quiet"]
        subprocess.run([*command, "--workers", str(workers)], check=True, stdout=subprocess.DEVNULL)
        made = json.loads((Path(folder) / "manifest.json").read_text())["runs"][0]
    return {"workers": workers, "paths": made["paths"], "seconds": made["seconds"]}


def main() -> None:
    """Measure, and write the results."""
    parser = record.parser(__doc__)
    parser.add_argument(
        "--units",
        type=one_or_more,
        choices=range(1, 100),
        metavar="N",
        default=2,
        help=f"of {UNIT_SIZE} problems, a level (default: %(default)s)",
    )
    parser.add_argument("--workers", type=one_or_more, default=2, help="processes at once (default: %(default)s)")
    parser.add_argument(
        "--first", type=whole_number, default=40_000, help="number of the first unit (default: %(default)s)"
    )
    args = parser.parse_args()
    units = [Unit(s, v, args.first + k) for s, v in static_levels() for k in range(args.units)]
    units.sort(key=lambda unit: unit.level != "hard")  # long ones first, so that workers end together
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(args.workers, mp_context=context, initializer=warm_up) as pool:
        made = list(pool.map(one, units))
    levels = [_summary(f"{s}/{v}", made, args.workers) for s, v in static_levels()]
    groups = {
        "alignment suites": [r for r in made if r["level"].split("/")[0] in ("vertical", "horizontal")],
        "hard suites": [r for r in made if r["level"].split("/")[0] in scenes.SUITES],
        "broad": [r for r in made if r["level"].startswith("broad/")],
    }
    totals = [_totals(name, rows, args.workers) for name, rows in groups.items()]
    mix = _mixed(levels)
    hours = {cores: WANTED / (mix / args.workers * cores) / 3600 for cores in CORES}
    scaling = [scaled(n) for n in sorted({1, args.workers})]
    memory = max(r["memory_mb"] for r in made)
    text = [_table([*levels, *totals]), ""]
    text += [f"Mixed as generate_data mixes the levels: {mix:.1f} paths/s on {args.workers} cores. {WANTED} paths take "
             + ", ".join(f"{h:.1f} h on {c} cores" for c, h in hours.items())
             + " (from the rate of one worker beside another; no cluster was there to try)."]  # fmt: skip
    text += [f"A worker took {memory:.0f} MiB at most.", ""]
    text += [f"generate_data {' '.join(SCALED)} --problems {PROBLEMS}: " + "; ".join(
        f"{s['workers']} worker{'s' if s['workers'] > 1 else ''} {s['paths'] / s['seconds']:.1f} paths/s "
        f"({s['seconds']:.0f} s)" for s in scaling) + "."]  # fmt: skip
    record.write(
        "data_engine", {"levels": levels, "totals": totals, "mixed_rate": mix, "hours": hours, "scaling": scaling,
                        "memory_mb": memory}, "\n".join(text), units=args.units, problems_per_unit=UNIT_SIZE,
        workers=args.workers, first_seed=args.first * UNIT_SIZE, seed=0,
    )  # fmt: skip


def _totals(name: str, rows: list[dict[str, Any]], workers: int) -> dict[str, Any]:
    """Return the figures of several units together."""
    seconds = sum(r["seconds"] for r in rows)
    sources, times = Counter[str](), Counter[str]()
    for r in rows:
        sources.update(r["sources"])
        times.update(r["times"])
    tried, solved = sum(r["tried"] for r in rows), sum(r["solved"] for r in rows)
    rates = {s: workers * n / seconds for s, n in sources.items()}
    shares = {stage: value / seconds for stage, value in times.most_common()}
    return {"level": name, "rate": sum(rates.values()), "rates": rates, "tried": tried, "solved": solved,
            "seconds_per_problem": seconds / max(1, UNIT_SIZE * len(rows)), "time": shares}  # fmt: skip


def _summary(level: str, made: list[dict[str, Any]], workers: int) -> dict[str, Any]:
    return _totals(level, [r for r in made if r["level"] == level], workers)


def _mixed(levels: list[dict[str, Any]]) -> float:
    """Return the rate of levels drawn in the proportions of the script, both per drawn problem."""
    paths = seconds = 0.0
    for f in levels:
        suite, level = f["level"].split("/")
        share = level_weight(suite, level)
        seconds += share * f["seconds_per_problem"]
        paths += share * f["seconds_per_problem"] * f["rate"]
    return paths / seconds


def _table(rows: list[dict[str, Any]]) -> str:
    head = ["level", "paths/s", *SOURCES[1:], "problems tried", "solved", "s a problem drawn", "where the time goes"]
    lines = [head, ["---", *["---:"] * (len(head) - 2), "---"]]
    for f in rows:
        where = ", ".join(f"{stage} {share:.0%}" for stage, share in list(f["time"].items())[:MOST_DEEP])
        rates = [f"{f['rates'].get(s, 0.0):.1f}" for s in SOURCES[1:]]
        solved = f"{f['solved'] / max(1, f['tried']):.2f}"
        lines.append(
            [f["level"], f"{f['rate']:.1f}", *rates, f["tried"], solved, f"{f['seconds_per_problem']:.2f}", where]
        )
    return "\n".join(record.row(line) for line in lines)


if __name__ == "__main__":
    run_script(main)
