"""Motions: durations beside the best known and beside rivals, goals with many states, smoothness, export, and torque.

``durations``: on hard, extreme and large levels and on the unseen kinds, the duration over that of the direct motion (a
lower bound: from rest to rest, every joint within its limits, obstacles ignored) and over the best known, which is the
least of all rows of this package and of a multi-start search of ``--search`` seconds of CPU. Rivals are rrtconnect
shortened by OMPL with TOPP-RA, and RoboPlan with its own timing; they have no limits of jerk, so that their motions are
no reference. ``wait`` is what a user waits for: the call and the motion.
``goals``: duration over the best of eight seeds where the goal is an alignment or poses.
``smoothness``: of the arms' joints in motions of a second or longer. ``torque``: the largest share of the arms' limits.
``export``: saved motions, followed by quintic interpolation between points as ROS 2's joint_trajectory_controller does.

Each run is stored in benchmarks/runs/motions-SPLIT when it ends; the command resumes where it was stopped. Unseen kinds
have validation problems alone: the first 16 of each are for tuning, those after them stand for the test split.

Usage: python -m benchmarks.timing.motions [SUITE[/LEVEL] ...] [--part PART ...] [-n 8] [--search 60] [--motions 2000]
       [--split test] [--workers 1]    (rows of TOPP-RA and RoboPlan need the extra "peers")
"""

from __future__ import annotations

import argparse
import importlib.util
import inspect
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from apex_ompl import problems
from apex_ompl.evaluation import Results, Row, Workers, bench
from apex_ompl.evaluation.runs import NO_PROBLEM, Run
from apex_ompl.problems.catalogue import VALIDATION
from apex_ompl.timing import Timing, Trajectory
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.validation import one_or_more, positive_number
from benchmarks.lib import record
from benchmarks.timing.motion_rows import PAYLOADS, SEEDS, SUFFIXES

DEPENDS = (
    "@benchmark", "apex_ompl/timing", "benchmarks/planners/peers.py", "benchmarks/timing/motion_figures.py",
    "benchmarks/timing/motion_rows.py", "benchmarks/timing/motion_search.py", "benchmarks/timing/exported_motions.py",
    "benchmarks/timing/timing_methods.py",
)  # fmt: skip
FOLDER = Path(__file__).parents[1] / "runs"
PARTS = ("durations", "goals", "smoothness", "torque", "export")
TIMEOUT = 10.0  # [s]
TUNED_ON = 16  # first problems of an unseen kind
WITHIN = 1.001  # of a limit, for saved motions
ELSEWHERE = 1e-6  # distance from start or goal, or speed at the ends, for saved motions [rad, rad/s]
WEAK = 1.07  # of the best known duration
RATES = (100.0, 1000.0)  # at which motions are saved besides their own knots [Hz]
HANDS = ("left_hand", "right_hand")
MODULE = "benchmarks.timing.motion_rows"

SCENES = ("shelf", "bins", "cage", "posts", "wall", "swap", "clutter")
ALIGNED = ("vertical", "horizontal")
HARD = tuple(f"{suite}/hard" for suite in SCENES)
EXTREME = tuple(f"{s}/extreme" for s in SCENES if "extreme" in problems.suites()[s])
LARGE = tuple(f"{suite}/{size}" for suite in ALIGNED for size in ("large", "xlarge", "huge", "extreme"))
UNSEEN = tuple(f"unseen/{level}" for level in VALIDATION["unseen"])
GROUPS = {"hard": HARD, "extreme": EXTREME, "large": LARGE, "unseen": UNSEEN}
READY = ("ball_in_cup", "handover", "peg_in_hole", "pour", "stack_boxes")

OBJECTIVES = ("length", "time", "calm")
OWN = tuple(Row(name, "apex", {"objective": name}, runner=f"{MODULE}:by_plan") for name in OBJECTIVES)
POLISHED = tuple(
    Row(f"rrtconnect+polish, {name}", "rrtconnect+polish", {"objective": name}, runner=f"{MODULE}:by_plan")
    for name in ("length", "time")
)
RIVALS = {
    "toppra": Row("rrtconnect, TOPP-RA", "rrtconnect", runner=f"{MODULE}:by_toppra"),
    "roboplan": Row("roboplan", "roboplan", runner=f"{MODULE}:by_roboplan"),
}
"""Rows by the package that they need."""
SPLINES = tuple(
    Row(f"{name}, spline", "apex", {"objective": name, "timing.method": "spline"}, runner=f"{MODULE}:by_plan")
    for name in ("length", "time")
)
GOAL_KINDS = {"given": READY, "alignment": LARGE[:2] + LARGE[4:6], "pose": HARD}
"""Problems, or levels, by the kind of their goal, see :func:`benchmarks.timing.motion_rows.with_goal`."""


class Runs:
    """Makes runs, or reads those that are stored.

    Attributes:
        made: Results that runs were taken from.
    """

    def __init__(self, split: str, workers: Workers, store: Path) -> None:
        """Make runs on a split; their folders are in ``store``."""
        self.split, self.workers, self.store = split, workers, store
        self.made = list[Results]()

    def of(self, rows: Sequence[Row], levels: Sequence[str], n: int) -> list[Run]:
        """Return the runs of some rows on the first ``n`` problems of levels, but for problems that a row cannot take.

        Args:
            rows: The rows.
            levels: Levels of suites and of unseen kinds, or ready-made problems.
            n: Number of problems of a level.
        """
        found = list[Run]()
        for unseen in (False, True):
            mine = [level for level in levels if level.startswith("unseen/") == unseen]
            if not mine:
                continue
            first = TUNED_ON if unseen and self.split == "test" else 0
            results = bench(
                mine, rows, self.store / f"motions-{'unseen-' if unseen else ''}{self.split}", runs=n, first=first,
                timeout=TIMEOUT, split="validation" if unseen else self.split, workers=self.workers,
                provenance=record.session(),
            )  # fmt: skip
            labels, seeds = {row.label for row in rows}, range(first, first + n)
            mine_of = [run for run in results.runs if run["label"] in labels and run["experiment"] in mine]
            found += [run for run in mine_of if run["seed"] in seeds and run["status"] != NO_PROBLEM]
            self.made.append(results)
        return found

    def provenance(self) -> dict[str, str]:
        """Return how the runs were made, as :func:`benchmarks.lib.record.made_with` does for one folder."""
        some = [record.made_with(results) for results in self.made]
        return {name: "; ".join(sorted({one[name] for one in some})) for name in some[0]}


def by_problem(runs: Sequence[Run], label: str) -> dict[str, Run]:
    """Return the runs of a row by their problem."""
    return {run["problem"]: run for run in runs if run["label"] == label}


def best_known(runs: Sequence[Run], labels: Sequence[str]) -> dict[str, float]:
    """Return the least duration of each problem over the solved runs of rows [s]."""
    best: dict[str, float] = {}
    for run in runs:
        if run["label"] in labels and run["solved"]:
            best[run["problem"]] = min(run["duration"], best.get(run["problem"], math.inf))
    return best


def cells(values: Sequence[float], which: Sequence[float], scale: float = 1.0, digits: int = 3) -> list[str]:
    """Return percentiles as cells of a table."""
    return [f"{scale * value:.{digits}f}" if values else "-" for value in record.percentiles(list(values), *which)]


def table(head: Sequence[str], rows: Sequence[Sequence[Any]], texts: int = 2) -> str:
    """Return a Markdown table whose first columns are texts."""
    rule = ["---"] * texts + ["---:"] * (len(head) - texts)
    return "\n".join(record.row(list(row)) for row in (head, rule, *rows))


def grouped(levels: Sequence[str]) -> dict[str, list[str]]:
    """Return the wanted levels by group, each level alone, and all."""
    groups = {name: [level for level in some if level in levels] for name, some in GROUPS.items()}
    found = {name: some for name, some in groups.items() if some}
    found |= {"all": list(levels)} if len(found) > 1 else {}
    return found | {level: [level] for level in levels}


DURATION_HEAD = (
    "levels", "row", "N", "solved", "faults", "duration / direct p50", "p95", "duration / best known p50", "p95",
    "duration / length's p50", "p95", "slower than length", "CPU ms p50", "p95", "CPU / length's p50",
    "of it motion ms p50", "p95", "wait s p50", "p95",
)  # fmt: skip


def duration_row(group: str, label: str, runs: Sequence[Run], best: Mapping[str, float]) -> list[Any]:
    """Return the row of a table for a row's runs on some levels."""
    mine, length = by_problem(runs, label), by_problem(runs, "length")
    solved = {name: run for name, run in mine.items() if run["solved"]}
    both = {name: run for name, run in solved.items() if name in length and length[name]["solved"]}
    shares = [run["duration"] / length[name]["duration"] for name, run in both.items()]
    costs = [run["cpu"] / length[name]["cpu"] for name, run in both.items()]
    slower = sum(share > 1.0 + 1e-9 for share in shares)
    return [
        group, label, len(mine), len(solved), sum(bool(run.get("fault")) for run in mine.values()),
        *cells([run["duration"] / run["direct"] for run in solved.values()], (50, 95)),
        *cells([run["duration"] / best[name] for name, run in solved.items()], (50, 95)),
        *cells(shares, (50, 95)), slower, *cells([run["cpu"] for run in solved.values()], (50, 95), 1e3, 0),
        *cells(costs, (50,), digits=2),
        *cells([run["motion_cpu"] for run in solved.values()], (50, 95), 1e3, 0),
        *cells([run["total"] + run["duration"] for run in solved.values()], (50, 95), digits=2),
    ]  # fmt: skip


def durations(runs: Runs, levels: Sequence[str], args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    """Return durations of all rows, beside the best known."""
    search = Row(
        f"search {args.search:g} s", "apex", {"seconds": args.search}, timeout=TIMEOUT + args.search,
        runner="benchmarks.timing.motion_search:search",
    )  # fmt: skip
    missing = [name for name in RIVALS if importlib.util.find_spec(name) is None]
    rivals = [row for name, row in RIVALS.items() if name not in missing]
    rows = [*OWN, *POLISHED, *rivals]
    made = runs.of([*rows, search], levels, args.n)
    best = best_known(made, [row.label for row in (*OWN, *POLISHED, search)])
    lines = []
    for group, some in grouped(levels).items():
        there = [run for run in made if run["experiment"] in some]
        lines += [duration_row(group, row.label, there, best) for row in rows if by_problem(there, row.label)]
    found = by_problem(made, search.label)
    weak = [
        (run["duration"] / best[name], name, run["duration"], best[name], found.get(name, {}).get("how", ""))
        for name, run in by_problem(made, "time").items()
        if run["solved"] and run["duration"] > WEAK * best[name]
    ]
    weak_rows = [[name, how, *(f"{v:.3f}" for v in rest)] for *rest, name, how in map(_weak, sorted(weak)[::-1])]
    head = ["problem", "what the search found it by", "time / best known", "time s", "best known s"]
    text = [table(DURATION_HEAD, lines), f"Where `time` takes more than {WEAK:g} of the best known:"]
    text += [table(head, weak_rows)] + [f"Without rows of {name}, which is not installed." for name in missing]
    faults = [
        f"{run['problem']}, {run['label']}, seed {run['seed']}: {run['fault']}" for run in made if run.get("fault")
    ]
    data = {"rows": [dict(zip(DURATION_HEAD, line, strict=True)) for line in lines], "best": best, "faults": faults}
    data["weak"] = [dict(zip(head, row, strict=True)) for row in weak_rows]
    return data, "\n\n".join(text + (["Faults:", *faults] if faults else []))


def _weak(one: tuple[float, str, float, float, str]) -> tuple[float, float, float, str, str]:
    ratio, name, duration, best, how = one
    return ratio, duration, best, name, how


def goals(runs: Runs, levels: Sequence[str], args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    """Return durations over the best of several seeds where a goal has many states."""
    objectives, lines = ("length", "time"), []
    for kind, places in GOAL_KINDS.items():
        some = [place for place in places if place in levels or (kind == "given" and args.all_levels)]
        if not some:
            continue
        rows = {
            objective: Row(
                f"{objective}, {kind} goal", "apex", {"objective": objective, "goal": kind},
                runner=f"{MODULE}:by_seeds",
            )
            for objective in objectives
        }  # fmt: skip
        made = runs.of(list(rows.values()), some, 1 if kind == "given" else args.n)
        by = {objective: by_problem(made, row.label) for objective, row in rows.items()}
        for objective in objectives:
            lines.append(goal_row(kind, objective, by))
    head = ["goals", "row", "problems", "of 8 seeds solved", "faults", "duration / best of its 8 seeds p50", "p95"]
    head += ["duration / best of all rows p50", "p95", "CPU ms p50"]
    return {"rows": [dict(zip(head, line, strict=True)) for line in lines]}, table(head, lines)


def goal_row(kind: str, objective: str, by: Mapping[str, Mapping[str, Run]]) -> list[Any]:
    """Return the row of a table for an objective; ``by`` has the runs by objective and problem."""
    own, all_rows, solved = list[float](), list[float](), 0
    mine = [run for run in by[objective].values() if "durations" in run]
    for run in mine:
        found = np.array([d for d in run["durations"] if d is not None])
        there = [some[run["problem"]].get("durations", ()) for some in by.values()]
        least = min((d for one in there for d in one if d is not None), default=math.nan)
        solved += len(found)
        own += (found / found.min()).tolist() if len(found) else []
        all_rows += (found / least).tolist()
    return [
        kind, objective, len(by[objective]), f"{solved / max(SEEDS * len(by[objective]), 1):.3f}",
        sum(bool(run.get("fault")) for run in mine), *cells(own, (50, 95)), *cells(all_rows, (50, 95)),
        *cells([run["cpu"] for run in mine], (50,), 1e3, 0),
    ]  # fmt: skip


def smoothness(runs: Runs, levels: Sequence[str], args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    """Return the smoothness of motions of a second and longer."""
    rows, lines = (*OWN, *SPLINES), []
    made = runs.of(rows, levels, args.n)
    for row in rows:
        mine = [run for run in by_problem(made, row.label).values() if run["solved"] and run["pulses"] is not None]
        pulses = [float(value) for run in mine for value in run["pulses"]]
        by_method = ", ".join(sorted({run["method"] for run in mine}))
        lines.append([
            row.label, by_method, len(mine), *cells(pulses, (50, 95), digits=1),
            *cells([run["rms_jerk"] for run in mine], (50, 95)),
            *cells([run["knots"] for run in mine], (50, 95), digits=0),
        ])  # fmt: skip
    head = ["row", "method", "N", "pulses over 30 % of the acceleration limit, a second and joint p50", "p95"]
    head += ["rms jerk / limit p50", "p95", "knots a second p50", "p95"]
    return {"rows": [dict(zip(head, line, strict=True)) for line in lines]}, table(head, lines)


def torque(runs: Runs, levels: Sequence[str], args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    """Return the largest share of the torque limits, without a payload and with one."""
    known = {field.name for field in fields(Timing)}
    rows = list(OWN)
    if "payload" in known:
        for payload in filter(None, PAYLOADS):
            params = {"objective": "time", "timing.payload": dict.fromkeys(HANDS, payload)}
            rows.append(Row(f"time, {payload:g} kg given", "apex", params, runner=f"{MODULE}:by_plan"))
    if "torque_limits" in known:
        params = {"objective": "time", "timing.torque_limits": False}
        rows.append(Row("time, no torque limits", "apex", params, runner=f"{MODULE}:by_plan"))
    made, lines = runs.of(rows, levels, args.n), []
    for row in rows:
        mine = [run for run in by_problem(made, row.label).values() if run["solved"]]
        for k, payload in enumerate(PAYLOADS):
            used = [run["torque"][k] for run in mine]
            lines.append([
                row.label, f"{payload:g}", len(used), *cells(used, (50, 95, 100), digits=2), sum(u > 1.0 for u in used)
            ])  # fmt: skip
    head = ["row", "kg in each hand", "N", "largest torque / limit p50", "p95", "most", "over a limit"]
    return {"rows": [dict(zip(head, line, strict=True)) for line in lines]}, table(head, lines)


def export(runs: Runs, levels: Sequence[str], args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    """Return how saved motions fare that are followed as a controller does."""
    rates = [0.0, *(RATES if "rate" in inspect.signature(Trajectory.save).parameters else ())]
    rows = [
        Row(f"export, {name}", "apex", {"objective": name, "rates": rates}, runner=f"{MODULE}:by_export")
        for name in OBJECTIVES
    ]
    new = len(OBJECTIVES) - 1  # objectives but for the former one
    n = math.ceil(args.motions / (len(levels) * new * len(SUFFIXES) * len(rates)))
    made, lines = runs.of(rows, levels, n), []
    for row in rows:
        saved = [run["exports"] for run in made if run["label"] == row.label and run["solved"]]
        for key in saved[0] if saved else ():
            lines.append(export_row(row.label, key, [one[key] for one in saved]))
    head = [
        "row",
        "format and rate",
        "motions",
        "refused",
        "unreadable",
        "over the velocity",
        "acceleration",
        "jerk limit",
    ]
    head += ["largest use", "in collision", "end elsewhere", "points p50", "kB p50", "most"]
    about = f"A limit counts as exceeded over {WITHIN:g} of it. Rate 0: the motion's own knots."
    return {"rows": [dict(zip(head, line, strict=True)) for line in lines]}, f"{table(head, lines)}\n\n{about}"


def export_row(label: str, key: str, saved: Sequence[Mapping[str, Any]]) -> list[Any]:
    """Return the row of a table for a way to save."""
    written = [one for one in saved if "refused" not in one]
    read = [one for one in written if "unreadable" not in one]
    use = np.array([one["use"] for one in read]).reshape(-1, 3)
    off = sum(one["off"] > ELSEWHERE or one["moving"] > ELSEWHERE for one in read)
    sizes = [one["bytes"] / 1e3 for one in written]
    return [
        label, key, len(saved), len(saved) - len(written), len(written) - len(read),
        *(use > WITHIN).sum(axis=0).tolist(),
        f"{use.max():.6g}" if len(use) else "-", sum(one["collides"] for one in read), off,
        *cells([one["points"] for one in read], (50,), digits=0), *cells(sizes, (50, 100), digits=0),
    ]  # fmt: skip


def chosen_levels(wanted: Sequence[str]) -> list[str]:
    """Return the levels that are measured, or those of them that are wanted, as ``shelf``, ``shelf/hard``, ``unseen``.

    Raises:
        SystemExit: No such level.
    """
    known = [level for some in GROUPS.values() for level in some]
    suites = {level.split("/")[0] for level in known}
    if not set(wanted) <= {*known, *suites}:
        raise SystemExit(f"unknown suite or level; known: {', '.join(known)}")
    return [level for level in known if not wanted or level in wanted or level.split("/")[0] in wanted]


Measure = Callable[[Runs, Sequence[str], argparse.Namespace], tuple[dict[str, Any], str]]
MEASURES: dict[str, Measure] = dict(zip(PARTS, (durations, goals, smoothness, torque, export), strict=True))


def main() -> None:
    """Run what is missing, and write the results."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("levels", nargs="*", metavar="SUITE[/LEVEL]")
    parser.add_argument("--part", nargs="+", choices=PARTS, default=PARTS, help="(default: all)")
    parser.add_argument("-n", type=one_or_more, default=8, help="problems of a level (default: %(default)s)")
    parser.add_argument(
        "--search", type=positive_number, default=60.0, help="CPU time of the multi-start search [s] (default: 60)"
    )
    parser.add_argument("--motions", type=one_or_more, default=2000, help="motions to save (default: %(default)s)")
    parser.add_argument("--split", choices=("validation", "test"), default="test")
    parser.add_argument("--workers", type=one_or_more, default=1, help="runs at a time (default: one, for times)")
    parser.add_argument("--store", type=Path, default=FOLDER, help="folder of the runs")
    parser.add_argument("--results", type=Path, default=record.RESULTS, help="folder of the results")
    args = parser.parse_args()
    levels, runs = chosen_levels(args.levels), Runs(args.split, Workers(args.workers), args.store)
    args.all_levels = not args.levels
    data, texts = {}, list[str]()
    for part in args.part:
        data[part], text = MEASURES[part](runs, levels, args)
        texts.append(f"## {part.capitalize()}\n\n{text}")
    about = {"split": args.split, "n": args.n, "search": f"{args.search:g} s", "timeout": f"{TIMEOUT:g} s"}
    about["seeds"] = "number of the problem modulo 1000"
    name = "motions" if len(args.part) == len(PARTS) else f"motions_{'_'.join(args.part)}"
    record.write(name, data, "\n\n".join(texts), args.results, **about, **runs.provenance())


if __name__ == "__main__":
    run_script(main)
