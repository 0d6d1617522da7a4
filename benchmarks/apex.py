"""APEX head to head: with and without trees, against controls of its model, RRTConnect, and RRTConnect polished.

Every run is a call of ``plan`` in the same space, by the same checker, at the same resolution, with the same seed (the
number of the problem modulo 1000). "Without trees" is APEX with ``fallback=false`` and ``bridge=false``; the controls
are the same pipeline with random weights, with the conditions of another problem, with random bumps instead of
proposals, and with the straight line and its repair alone. Times leave out the setup of problem and planner, which is
given by itself, and are those of a warm process; the first path counts from when it has passed the full check, of
rrtconnect+polish from when what it found would have. Paths are judged once more at a tenth of the resolution of
the full check; one that fails there counts as false-valid. Runs are kept in a store as they end, so that the command
goes on where it was stopped.

Usage: python benchmarks/apex.py [SUITE[/LEVEL] ...] [-n 100] [--controls 50] [--split test] [--methods ...] [--report]
"""

from __future__ import annotations

import argparse
import json
import math
from collections import Counter
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import record
import torch
from controls import OTHER, checkpoint_digest, next_query
from store import RunStore

from apex_ompl import plan, problems
from apex_ompl.diffusion.checkpoint import SHIPPED
from apex_ompl.ompl_adapter.setup import assemble
from apex_ompl.ompl_adapter.validity import full_check
from apex_ompl.problems.reach import robot
from apex_ompl.result import FIRST, INSIDE, PlanResult
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.resolution import FULL_RESOLUTION
from apex_ompl.util.validation import one_or_more, whole_number

STORE = record.RESULTS.parent / "runs" / "apex.jsonl"
LIMIT, SHORT_LIMIT = 10.0, 2.0  # [s]; of controls
MOMENTS = (0.05, 0.1, 0.5, 2.0)  # at which shares are given [s]
ALL_HARD = "all hard levels"
TREELESS = {"fallback": False, "bridge": False}
METHODS: dict[str, tuple[str, dict[str, Any], float]] = {
    "apex": ("apex", {}, LIMIT),
    "rrtconnect": ("rrtconnect", {}, LIMIT),
    "rrtconnect+polish": ("rrtconnect+polish", {}, LIMIT),
    "apex without trees": ("apex", TREELESS, SHORT_LIMIT),
    "random weights": ("random weights", TREELESS, SHORT_LIMIT),
    "shuffled conditions": ("shuffled conditions", TREELESS, SHORT_LIMIT),
    "bumps": ("bumps", TREELESS, SHORT_LIMIT),
    "line": ("apex", {**TREELESS, "first": 0, "second": 0, "third": 0, "resample": 0}, SHORT_LIMIT),
}
FULL = ("apex", "rrtconnect", "rrtconnect+polish")


@cache
def made_of(method: str) -> str:
    """Return what tells runs of a method apart from those with another model or other parameters."""
    planner, params, limit = METHODS[method]
    model = "" if planner.startswith("rrtconnect") else checkpoint_digest(SHIPPED / "apex")
    return f"{model} {json.dumps(params)} {limit:g} s"


def attempted(job: tuple[str, str, str]) -> dict[str, Any]:
    """Return a run; one that raises counts as not solved, and says why."""
    try:
        return run(job)
    except Exception as error:
        print(f"{job}: {error!r}", flush=True)
        return {
            "problem": job[0], "method": job[1], "made_of": job[2], "solved": False, "by": "", "found_s": math.inf,
            "total_s": math.inf, "length": None, "status": repr(error), "stages": {}, "setup_s": 0.0,
        }  # fmt: skip


def run(job: tuple[str, str, str]) -> dict[str, Any]:
    """Return one run of a method on a problem."""
    name, method, kind = job
    planner, params, limit = METHODS[method]
    if planner == "shuffled conditions":
        OTHER[:] = [next_query(name)]
    result = plan(problems.load(name), planner, timeout=limit, seed=int(name.rsplit("/", 1)[1]) % 1000, params=params)
    times = result.times
    total = sum(times.get(k, 0.0) for k in ("line", "solve", "simplify", "verify", "repair"))
    found = {
        "problem": name, "method": method, "made_of": kind, "solved": bool(result), "by": result.solved_by,
        "found_s": first_path(result),
        "total_s": total, "length": result.length if result else None, "status": str(result.status),
        "stages": {k: v for k, v in times.items() if k.startswith(INSIDE)}, "setup_s": times.get("setup", 0.0),
    }  # fmt: skip
    if result:
        ready = assemble(problems.load(name), robot())
        found["false"] = not full_check(ready.checker, result.path, resolution=FULL_RESOLUTION / 10)
    return found


def first_path(result: PlanResult) -> float:
    """Return the time until a first path had passed the full check; simplification is left out [s]."""
    times = result.times
    proof = ("verify", "repair") if result.planner.startswith("rrtconnect") else ()  # apex has it behind it by then
    return sum(times.get(k, 0.0) for k in ("line", *proof)) + times.get(FIRST, times.get("solve", 0.0))


def warm_up(methods: Sequence[str]) -> None:
    """Load the kernel, the robot and the models, so that no run pays for it."""
    torch.set_num_threads(1)
    for method in methods:
        run(("wall/easy/800000", method, ""))


def figures(runs: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return what came of every method on a level, and of pairs with RRTConnect and RRTConnect polished."""
    by = {method: {r["problem"]: r for r in runs if r["method"] == method} for method in METHODS}
    found: dict[str, Any] = {}
    for method, mine in by.items():
        if not mine:
            continue
        some = list(mine.values())
        first = np.array([r["found_s"] if r["solved"] else math.inf for r in some])
        total = np.array([r["total_s"] if r["solved"] else math.inf for r in some])
        found[method] = {
            "n": len(some), "solved": float(np.mean([r["solved"] for r in some])),
            "in": {str(t): float(np.mean(first <= t)) for t in MOMENTS},
            "found_s": [record.reached(first, p) for p in (50, 95)],
            "total_s": [record.reached(total, p) for p in (50, 95)],
            "length": float(np.median([r["length"] for r in some if r["solved"]] or [math.nan])),
            "setup_s": float(np.median([r["setup_s"] for r in some])),
            "stages": _shares(some),
            "by": dict(Counter(r["by"] for r in some if r["solved"])),
            "false": sum(r.get("false", False) for r in some),
            "lost": sum(
                not r["solved"] and _within(by["rrtconnect"].get(n), METHODS[method][2]) for n, r in mine.items()
            ),
        }  # fmt: skip
        for other in ("rrtconnect", "rrtconnect+polish"):
            pairs = [(r, by[other][n]) for n, r in mine.items() if r["solved"] and by[other].get(n, {}).get("solved")]
            ratios = {key: [a[key] / max(b[key], 1e-9) for a, b in pairs] for key in ("length", "total_s")}
            found[method][f"over {other}"] = {k: float(np.exp(np.mean(np.log(v)))) for k, v in ratios.items() if v}
    return found


def _shares(runs: Sequence[dict[str, Any]]) -> dict[str, float]:
    """Return what share of the time of solved runs went to each stage of the planner."""
    spent = Counter[str]()
    for run in runs:
        spent.update({k.removeprefix(INSIDE): v for k, v in run["stages"].items() if run["solved"] and k != FIRST})
    whole = sum(run["total_s"] for run in runs if run["solved"])
    return {stage: seconds / whole for stage, seconds in spent.items()} if whole else {}


def _within(run: dict[str, Any] | None, limit: float) -> bool:
    return run is not None and run["solved"] and run["found_s"] <= limit


def table(levels: Sequence[dict[str, Any]]) -> str:
    """Return the Markdown tables: who solved, then times and lengths."""
    stages = sorted({by for level in levels for by in level["methods"].get("apex", {}).get("by", {})})
    lines = [record.row(["suite/level", "N", *stages, "not solved"])]
    lines.append(record.row(["---", *["---:"] * (len(stages) + 2)]))
    for level in levels:
        f = level["methods"].get("apex")
        if f:
            shares = [f"{f['by'].get(stage, 0) / f['n']:.2f}" for stage in stages]
            lines.append(record.row([level["level"], f["n"], *shares, f"{1.0 - f['solved']:.2f}"]))
    head = ["suite/level", "method", "N", "solved", *(f"in {t:g} s" for t in MOMENTS), "lost", "first ms p50", "p95"]
    head += ["total ms p50", "p95", "setup ms", "length rad"]
    head += ["length / rrtconnect", "length / polished", "time / polished", "false-valid"]
    lines += ["", record.row(head), record.row(["---", "---", *["---:"] * (len(head) - 2)])]
    for level in levels:
        for k, (method, f) in enumerate(level["methods"].items()):
            cells = [level["level"] if k == 0 else "", method, f["n"], f"{f['solved']:.2f}"]
            cells += [f"{share:.2f}" for share in f["in"].values()] + [f["lost"]]
            cells += ["-" if v is None else f"{1e3 * v:.0f}" for v in (*f["found_s"], *f["total_s"])]
            cells.append(f"{1e3 * f['setup_s']:.0f}")
            cells.append("-" if math.isnan(f["length"]) else f"{f['length']:.1f}")
            tree, polished = f["over rrtconnect"], f["over rrtconnect+polish"]
            ratios = tree.get("length"), polished.get("length"), polished.get("total_s")
            cells += ["-" if value is None else f"{value:.2f}" for value in ratios] + [f["false"]]
            lines.append(record.row(cells))
    false = Counter[str]()
    for level in levels:
        if level["level"] == ALL_HARD:  # counted already
            continue
        false.update({method: f["false"] for method, f in level["methods"].items()})
    return "\n".join([*lines, "", "False-valid paths: " + ", ".join(f"{k} {n}" for k, n in false.items()) + "."])


def aims(levels: Sequence[dict[str, Any]]) -> str:
    """Return a Markdown table of what was aimed at, level by level, and which stages took apex's time.

    No problem is lost that rrtconnect solves; among cubes and on easy levels a first path is there as soon as
    rrtconnect's, in the median; on hard ones the short path takes at most a fifth of the time of rrtconnect and
    simplification in the median, a third at the 95th percentile, is shorter, and takes less time than rrtconnect+polish
    at no more than 1.01 times the length.
    """
    head = ["suite/level", "aim", "found", "met", "apex's time by stage"]
    lines = [record.row(head), record.row(["---"] * len(head))]
    for level in levels:
        f, tree = level["methods"].get("apex"), level["methods"].get("rrtconnect")
        if f is None or tree is None:
            continue
        over, polished = f["over rrtconnect"], f["over rrtconnect+polish"]
        found: list[tuple[str, str, bool]] = [("lost 0", str(f["lost"]), f["lost"] == 0)]
        if level["level"].endswith("/hard"):
            for name, k, most in (("p50", 0, 0.2), ("p95", 1, 1 / 3)):
                ours, theirs = f["total_s"][k] or math.inf, tree["total_s"][k] or LIMIT  # it takes at least as long
                found.append(
                    (f"time {name} / rrtconnect's <= {most:.2f}", f"{ours / theirs:.3f}", ours / theirs <= most)
                )
            found.append(("length / rrtconnect's < 1", f"{over['length']:.2f}", over["length"] < 1.0))
            good = polished["total_s"] < 1.0 and polished["length"] <= 1.01
            said = f"{polished['total_s']:.2f}, {polished['length']:.2f}"
            found.append(("time, length / rrtconnect+polish's < 1, <= 1.01", said, good))
        elif level["level"].split("/")[0] in ("vertical", "horizontal") or level["level"].endswith("/easy"):
            ours, theirs = f["found_s"][0] or math.inf, tree["found_s"][0] or math.inf
            found.append(
                ("first path p50 <= rrtconnect's", f"{1e3 * ours:.1f} and {1e3 * theirs:.1f} ms", ours <= theirs)
            )
        spent = sorted(f["stages"].items(), key=lambda pair: -pair[1])[:4]
        where = ", ".join(f"{stage} {share:.2f}" for stage, share in spent)
        for k, (aim, value, met) in enumerate(found):
            cells = [level["level"] if k == 0 else "", aim, value, "yes" if met else "no", where if k == 0 else ""]
            lines.append(record.row(cells))
    return "\n".join(lines)


def main() -> None:
    """Run what is missing, and write the results of all."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("levels", nargs="*", metavar="SUITE[/LEVEL]")
    parser.add_argument("-n", type=one_or_more, default=100, help="problems of a level (default: %(default)s)")
    parser.add_argument("--controls", type=whole_number, default=50, help="of a hard level (default: %(default)s)")
    parser.add_argument("--split", choices=("validation", "test"), default="test")
    parser.add_argument("--jobs", type=one_or_more, default=1, help="processes (default: one, as runs are timed)")
    parser.add_argument("--methods", nargs="*", choices=list(METHODS), default=list(METHODS), metavar="NAME")
    parser.add_argument("--store", type=Path, default=STORE)
    parser.add_argument("--name", default="apex", help="of the results (default: %(default)s)")
    parser.add_argument("--report", action="store_true", help="run nothing; write the results of what the store holds")
    args = parser.parse_args()
    chosen = record.static_levels(args.levels)
    jobs: list[tuple[str, str, str]] = []
    for level in chosen:
        names = problems.frozen_names(*level.split("/"), args.split)
        for method in args.methods:
            most = args.n if method in FULL else args.controls if level.endswith("/hard") else 0
            jobs += [(name, method, made_of(method)) for name in names[:most]]
    store = RunStore(args.store, ("problem", "method", "made_of"))
    done = store.read()
    todo = [] if args.report else [job for job in jobs if job not in done]
    todo.sort(key=lambda job: int(job[0].rsplit("/", 1)[1]))  # all methods and levels in turn
    store.complete(attempted, todo, args.jobs, warm_up, args.methods)
    done = store.read()
    runs = [done[job] for job in jobs if job in done]
    levels = [{"level": v, "methods": figures([r for r in runs if r["problem"].startswith(f"{v}/")])} for v in chosen]
    levels = [level for level in levels if level["methods"]]
    hard = [r for r in runs if "/hard/" in r["problem"]]
    if hard:
        levels.append({"level": ALL_HARD, "methods": figures(hard)})
    text = f"{table(levels)}\n\n{aims(levels)}"
    record.write(
        args.name, {"levels": levels}, text, split=args.split, limits=f"{LIMIT:g} s, controls {SHORT_LIMIT:g} s",
        seeds="number of the problem modulo 1000", **record.made_with(runs),
    )  # fmt: skip


if __name__ == "__main__":
    run_script(main)
