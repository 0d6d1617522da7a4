"""Contacts of robots that move, under the assumptions of the guarantee, over many short runs of the closed loop.

The loop plans anew without the network (every tenth attack with it), at full speed, for at most 3 s a run, in worlds of
all suites' kinds whose obstacles do not come out of nowhere, and in worlds that attack it (``attack_worlds.py``). Of
those with a moving cube the first 600 are frozen, with a witness; others may be such that no robot could evade. In
every fifth run it looks for faster motions too, which takes most of the time. A run ends after 0.5 s of rest, in
every fifth after 1.5. The referee knows what truly happened, and every contact counts, not only the first one. The last
rows are controls: the same attacks on a loop that steps aside at its risk, and on one that asks for no fail-safe stop.

Runs are stored in benchmarks/runs/guarded_runs when they end; the command resumes where it was stopped, and those of
the committed table are packed (``python -m benchmarks.lib.pack unpack guarded_runs``).

Usage: python -m benchmarks.loop.guarded_runs [-n 8000] [--attacks 2000] [--controls 200] [--jobs 1] [--report]
"""

from __future__ import annotations

import json
import math
from typing import Any

from apex_ompl import run
from apex_ompl.loop.referee import LIMIT_TOLERANCE
from apex_ompl.moving.settings import LoopSettings
from apex_ompl.problems import worlds
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.statistics import share_interval
from apex_ompl.util.validation import one_or_more
from benchmarks.lib import record
from benchmarks.loop.attack_worlds import KIND, SUITES, AttackEnvironment
from benchmarks.loop.closed_loop import FOLDER, SCRIPTED, Job, kept, made_by, stored

DEPENDS = (
    "benchmarks/loop/closed_loop.py", "benchmarks/loop/attack_worlds.py", "@planning", "apex_ompl/moving",
    "apex_ompl/loop", "apex_ompl/timing",
)  # fmt: skip
SHORT, RESTS, LONGER = 3.0, 0.5, 1.5  # time of a run, and of rest after which it ends, in every fifth run longer [s]
HASTENING, PROPOSING = 5, 10  # of so many runs one looks for faster motions, of so many attacks one uses the network
KINDS = ("moving", "turning", "crowd", "pusher")
CONTROLS: dict[str, dict[str, Any]] = {"no-network+risk": {"evade": "risk"}, "no-network+unguarded": {"guarded": False}}
HEAD = (
    "worlds", "N", "hit while moving, as assumed", "share at most % (95 %)", "unguarded steps", "hit at rest",
    "reached", "runs with broken assumptions", "over limits",
)  # fmt: skip


def made(job: Job) -> dict[str, Any]:
    """Run once, and return what is kept."""
    number = int(job.world.rpartition("/")[2])
    hastens = number % HASTENING == 0
    changed = CONTROLS.get(job.method, {})
    settings = LoopSettings(timeout=SHORT, stuck=LONGER if hastens else RESTS, hastens=hastens, **changed)
    method = job.method.partition("+")[0]
    if kind_of(job.world) != KIND:
        return kept(job, run(job.world, method, speed=job.speed, seed=0, settings=settings))
    world = AttackEnvironment(number, FOLDER.with_name("guarded_runs"))
    return kept(job, run(world, method, speed=job.speed, seed=0, settings=settings, sensor=world.sensor))


def kind_of(world: str) -> str:
    """Return the kind of a world by its name."""
    first = world.split("/", maxsplit=1)[0]
    return first if first in (*worlds.kinds(), KIND) else SCRIPTED


def row(kind: str, runs: list[dict[str, Any]]) -> list[Any]:
    """Return the row of some runs."""
    hits = sum(one["hit_while_expected"] for one in runs)
    return [
        kind, len(runs), hits, f"{100 * share_interval(hits, len(runs))[1]:.3g}" if runs else "-",
        int(sum(one["unguarded_steps"] for one in runs)), sum(one["outcome"] == "hit-at-rest" for one in runs),
        sum(one["outcome"] == "reached" for one in runs), sum(one["broken_steps"] > 0 for one in runs),
        sum(one["limit_use"] > 1.0 + LIMIT_TOLERANCE for one in runs),
    ]  # fmt: skip


def main() -> None:
    """Run what is missing, and write the results."""
    parser = record.parser(__doc__, n=8000, of="runs in the suites' worlds", jobs=1)
    parser.add_argument(
        "--attacks", type=one_or_more, default=2000, help="runs in worlds that attack (default: %(default)s)"
    )
    parser.add_argument(
        "--controls", type=one_or_more, default=200, help="attacks on each control (default: %(default)s)"
    )
    parser.add_argument("--split", default="test", choices=("test", "validation"))
    parser.add_argument("--report", action="store_true", help="run nothing; write the results of the stored runs")
    args = parser.parse_args()
    args.store = FOLDER.with_name("guarded_runs")
    each = [worlds.ids(kind, args.split, math.ceil(args.n / len(KINDS))) for kind in KINDS]
    suites = [Job(name, "no-network", 1.0) for some in zip(*each, strict=True) for name in some][: args.n]
    ids = [f"{KIND}/{SUITES[k % 2]}/{k}" for k in range(args.attacks)]
    attacks = [Job(name, "no-network" if k % PROPOSING else "apex", 1.0) for k, name in enumerate(ids)]
    controls = [Job(name, method, 1.0) for method in CONTROLS for name in ids[: args.controls]]
    jobs = [*attacks, *controls, *suites]
    stored(jobs, args, made)
    runs = [json.loads((args.store / job.file).read_text()) for job in jobs if (args.store / job.file).exists()]
    guarded = [one for one in runs if one["method"] not in CONTROLS]
    rows = [row(kind, [one for one in guarded if kind_of(one["world"]) == kind]) for kind in (*KINDS, KIND)]
    rows.append(row("all", guarded))
    rows += [row(f"{KIND}, {method}", [one for one in runs if one["method"] == method]) for method in CONTROLS]
    lines = [HEAD, ["---", *["---:"] * (len(HEAD) - 1)], *rows]
    text = "\n".join(record.row(list(line)) for line in lines)
    data = {"rows": rows, "columns": HEAD}
    record.write("guarded_runs", data, text, split=args.split, n=len(runs), seed=0, **made_by(runs))


if __name__ == "__main__":
    run_script(main)
