"""Tables of stored runs of the closed loop: by kind of world, speed and method, by size, by clock, by other methods."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from apex_ompl.loop.metrics import NEAR
from apex_ompl.loop.referee import LIMIT_TOLERANCE
from apex_ompl.loop.result import GOING
from apex_ompl.loop.run import CLOCKS
from apex_ompl.util.statistics import share_interval
from benchmarks.lib import record

SIMULATED, REAL = CLOCKS
Row = tuple[str, float, str]  # kind of worlds, speed, method
Stored = dict[str, Any]  # a run as it was stored


def ratios(some: Sequence[Stored], best: Sequence[Stored]) -> list[float]:
    """Return times to the goal by those of other runs in the same worlds, where both came there."""
    of = reached(best)
    return [time / of[world] for world, time in reached(some).items() if world in of]


def summary(some: Sequence[Stored], best: Sequence[Stored] = ()) -> dict[str, Any]:
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
    unguarded = column(some, "unguarded_steps")
    ticks = {name: column(some, name) for name in ("tick_p50", "tick_p99", "tick_worst", "deadline_misses")}
    return {
        "n": len(some), "failed": failed / len(some), "interval": list(share_interval(failed, len(some))),
        "causes": causes, "hits_while_expected": sum(one["hit_while_expected"] for one in some),
        "unguarded_steps": sum(unguarded) if len(unguarded) == len(some) else None,  # runs of before did not count them
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


def column(some: Sequence[Stored], name: str) -> list[float]:
    """Return a number of some runs, those that have it."""
    return [one[name] for one in some if name in one]


def shown(value: float | None, unit: float = 1.0) -> str:
    """Return a number as the tables have it."""
    return "-" if value is None else f"{unit * value:.3g}"


def by_size(runs: Sequence[Stored]) -> tuple[str, dict[str, Any]]:
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


def named(row: Row) -> str:
    """Return the name of a row: kind of worlds, speed, and method."""
    kind, speed, method = row
    return f"{kind}, speed {speed:g}, {method}"


def by_clock(rows: dict[Row, list[Stored]], timed: dict[Row, list[Stored]]) -> tuple[str, dict[str, Any]]:
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


def by_waiting(rows: dict[Row, list[Stored]]) -> tuple[str, dict[str, Any]]:
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


def reached(some: Sequence[Stored]) -> dict[str, float]:
    """Return times to the goal of the runs that came there, by world [s]."""
    return {one["world"]: one["time_to_goal"] for one in some if one["outcome"] == "reached"}


def causes_of(s: dict[str, Any]) -> str:
    """Return the causes of failures of a row."""
    return ", ".join(f"{count} {cause}" for cause, count in sorted(s["causes"].items())) or "-"


def table(rows: dict[str, dict[str, Any]]) -> str:
    """Return the Markdown table of rows."""
    head = ["", "N", "failed", "95 % interval", "causes", "hit while moving, as assumed", "unguarded steps",
            "time to goal s p50", "p95", "by clairvoyant's p50", "p95", "stops", "worst level %",
            "plan ms p50", "p95", "reaction ms p95", "near ms p95", "over limits"]  # fmt: skip
    lines = [head, ["---", *["---:"] * (len(head) - 1)]]
    for name, s in rows.items():
        low, high = s["interval"]
        times = [shown(v) for v in (*s["time_to_goal_s"], *s["by_clairvoyant"])]
        replans = [shown(v, 1e3) for v in (*s["plan_s"], s["reaction_s"][1], s["near_reaction_s"][1])]
        lines.append([
            name, s["n"], f"{100 * s['failed']:.1f} %", f"{100 * low:.1f} to {100 * high:.1f}", causes_of(s),
            s["hits_while_expected"], shown(s["unguarded_steps"]), *times, f"{s['stops']:.2g}",
            f"{100 * s['worst_level']:.3g}", *replans, s["over_limits"],
        ])  # fmt: skip
    return "\n".join(record.row(line) for line in lines)
