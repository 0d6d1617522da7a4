"""Statistics and table of ``benchmarks/proposals.py``."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import record


def figures(runs: Sequence[dict[str, Any]], methods: Mapping[str, Sequence[int]]) -> dict[str, Any]:
    """Return the statistics of a level's runs by method and number of proposals.

    Args:
        runs: The runs.
        methods: Numbers of proposals by method.
    """
    polished = {r["problem"]: r for r in runs if r["method"] == "rrtconnect+polish" and r["solved"]}
    found: dict[str, Any] = {}
    for method, counts in methods.items():
        for count in counts:
            some = [r for r in runs if (r["method"], r["count"]) == (method, count)]
            if some:
                found[f"{method}, {count}" if len(counts) > 1 else method] = _of_runs(some, polished)
    return found


def _of_runs(some: Sequence[dict[str, Any]], polished: dict[str, dict[str, Any]]) -> dict[str, Any]:
    took = np.sort([r["total_s"] if r["solved"] else math.inf for r in some])
    found = np.sort([r["found_s"] if r["solved"] else math.inf for r in some])
    both = [(r, polished[r["problem"]]) for r in some if r["solved"] and r["problem"] in polished]
    total, first = (float(times[(len(times) - 1) // 2]) for times in (took, found))
    return {
        "n": len(some), "sampled": float(np.mean([r["sampled"] for r in some])),
        "solved": float(np.mean([r["solved"] for r in some])),
        "propose_s_p50": float(np.median([r.get("propose_s", math.nan) for r in some])),
        "found_s_p50": first if math.isfinite(first) else None,
        "total_s_p50": total if math.isfinite(total) else None,
        "both": len(both),
        "length_p50": float(np.median([r["length"] for r in some if r["solved"]] or [math.nan])),
        "length_over_polished": float(np.exp(np.mean([math.log(a["length"] / b["length"]) for a, b in both])))
        if both else None,
        "time_over_polished": float(np.exp(np.mean([math.log(a["total_s"] / b["total_s"]) for a, b in both])))
        if both else None,
    }  # fmt: skip


def table(levels: Sequence[dict[str, Any]]) -> str:
    """Return the Markdown table."""
    head = ["suite/level", "proposals", "N", "valid", "repaired", "propose ms", "found ms p50", "shortened ms p50"]
    head += ["length rad", "length / rrtconnect+polish", "time / rrtconnect+polish", "on"]
    rows = [head, ["---", "---", *["---:"] * (len(head) - 2)]]
    for level in levels:
        for k, (method, f) in enumerate(level["methods"].items()):
            cells = [level["level"] if k == 0 else "", method, f["n"], f"{f['sampled']:.2f}", f"{f['solved']:.2f}"]
            cells += list(_cells(f))
            rows.append(cells)
    return "\n".join(record.row(row) for row in rows)


def _cells(f: dict[str, Any]) -> Iterator[str]:
    def ms(value: float | None, otherwise: str) -> str:
        return otherwise if value is None or math.isnan(value) else f"{1e3 * value:.0f}"

    yield ms(f["propose_s_p50"], "-")
    yield ms(f["found_s_p50"], "not found")
    yield ms(f["total_s_p50"], "not found")
    yield "-" if math.isnan(f["length_p50"]) else f"{f['length_p50']:.1f}"
    for name in ("length_over_polished", "time_over_polished"):
        yield "-" if f[name] is None else f"{f[name]:.2f}"
    yield str(f["both"])
