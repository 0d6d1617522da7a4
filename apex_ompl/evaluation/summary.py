"""Statistics of a benchmark, for each row on each level, and tables of them."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from apex_ompl.evaluation.metrics import next_percentile, percentile_interval
from apex_ompl.evaluation.results import Results
from apex_ompl.evaluation.runs import NO_PROBLEM, Run, ompl_status
from apex_ompl.result import PlanStatus
from apex_ompl.util.statistics import share_interval

TOLERATED_LOAD = 0.5  # load average above that of the runs themselves
SHARE_TIMES = (0.1, 0.5, 2.0, 10.0)  # at which the share of runs with a first path is given [s]
FULL_TIME = (PlanStatus.TIMEOUT, PlanStatus.APPROXIMATE_SOLUTION, PlanStatus.EXACT_SOLUTION)
TREES = ("rrtconnect", "sprint")  # stages of apex that are tree search alone


@dataclass(frozen=True)
class Table:
    """A table: title, column heads, rows of text."""

    title: str
    head: Sequence[str]
    rows: Sequence[Sequence[str]]

    @classmethod
    def by_level(cls, title: str, head: Sequence[str], cells: Iterable[tuple[Statistics, Sequence[str]]]) -> Table:
        """Return a table with a row for each statistics: the level where it changes, the planner, and some cells."""
        rows, last = list[Sequence[str]](), ""
        for one, texts in cells:
            rows.append(["" if one.experiment == last else one.experiment, one.label, *texts])
            last = one.experiment
        return cls(title, ["level", "planner", *head], rows)

    def markdown(self) -> str:
        """Return the table as Markdown."""
        lines = [self.head, ["---", "---", *["---:"] * (len(self.head) - 2)], *self.rows]
        return f"### {self.title}\n\n" + "\n".join("| " + " | ".join(line) + " |" for line in lines)


@dataclass(frozen=True)
class Statistics:
    """Statistics of a row on a level.

    Attributes:
        experiment: Name of the level.
        label: Label of the row.
        runs: The runs.
    """

    experiment: str
    label: str
    runs: Sequence[Run]

    @property
    def solved(self) -> list[Run]:
        """Runs whose path passed the full check."""
        return [run for run in self.runs if run["solved"]]

    @property
    def planner(self) -> str:
        """Name of the planner."""
        return str(self.runs[0]["planner"])

    @property
    def limit(self) -> float:
        """Longest time limit of a run [s]."""
        return max(float(run["timeout"]) for run in self.runs)

    def times(self, which: str = "first") -> np.ndarray:
        """Return times, ``first`` or ``total``, infinite where a run is not solved, shape (N,) [s]."""
        return np.sort([run[which] if run["solved"] else math.inf for run in self.runs])

    def share_within(self, seconds: float) -> float:
        """Return the share of runs with a first path in some time."""
        return float(np.mean(self.times() <= seconds))

    def percentile(self, which: str, p: float) -> float:
        """Return a percentile of times, the next larger one; infinite where fewer runs are solved [s]."""
        return next_percentile(self.times(which), p)

    def median(self, key: str) -> float:
        """Return the median of a column over solved runs that have it, NaN without any."""
        values = [run[key] for run in self.solved if run[key] is not None]
        return float(np.median(values)) if values else math.nan

    @property
    def by(self) -> Counter[str]:
        """Number of runs that each planner or stage solved."""
        return Counter(run["by"] for run in self.solved)


def statistics(results: Results) -> list[Statistics]:
    """Return the statistics of all rows on all levels: levels by name, rows in the order of the results."""
    runs: dict[tuple[str, str], list[Run]] = {}
    for run in sorted(results.runs, key=lambda run: int(run["seed"])):
        if run["status"] != NO_PROBLEM:
            runs.setdefault((run["experiment"], run["label"]), []).append(run)
    labels = list(results.about["rows"])
    order = sorted(runs, key=lambda key: (key[0], labels.index(key[1]) if key[1] in labels else len(labels)))
    return [Statistics(*key, runs[key]) for key in order]


def tables(results: Results) -> list[Table]:
    """Return the tables of a report."""
    found = statistics(results)
    return [successes(found), times(found), paths(found), stages(found)]


def successes(found: Iterable[Statistics]) -> Table:
    """Return the table of shares solved, in all and within some times."""
    rows = []
    for f in found:
        low, high = share_interval(len(f.solved), len(f.runs))
        within = [_share(f.share_within(t)) if t <= f.limit else "-" for t in SHARE_TIMES]
        share = f"{_share(len(f.solved) / len(f.runs))} ({_share(low)} to {_share(high)})"
        trees = sum(f.by[name] for name in TREES if f.planner != name) / len(f.runs)
        rows.append((f, [str(len(f.runs)), f"{f.limit:g}", share, *within, _share(trees)]))
    head = ["N", "limit s", "solved (95 %, Wilson)", *(f"in {t:g} s" for t in SHARE_TIMES), "by its trees alone"]
    return Table.by_level("Success", head, rows)


def times(found: Iterable[Statistics]) -> Table:
    """Return the table of times to the first path and to the end."""
    rows = []
    for f in found:
        low, high = percentile_interval(f.times(), 50.0)
        first = [f"{_ms(f.percentile('first', 50))} ({_ms(low)} to {_ms(high)})"]
        first += [_ms(f.percentile("first", p)) for p in (95, 99)]
        total = [_ms(f.percentile("total", p)) for p in (50, 95, 99)]
        setup = [run["setup"] for run in f.runs if run["setup"] is not None]
        made = _ms(float(np.median(setup))) if setup else "-"
        rows.append((f, [*first, *total, made]))
    head = ["first path p50 ms (95 %, bootstrap)", "p95", "p99", "end p50 ms", "p95", "p99", "setup ms"]
    return Table.by_level("Time", head, rows)


def paths(found: Iterable[Statistics]) -> Table:
    """Return the table of lengths, jerks and clearances."""
    rows = []
    for f in found:
        numbers = [_number(f.median(key)) for key in ("raw_length", "length", "raw_jerk", "jerk")]
        clearance = f.median("clearance")
        numbers.append("-" if math.isnan(clearance) else f"{1e3 * clearance:.1f}")
        rows.append((f, numbers))
    head = ["first length rad", "length rad", "first jerk rad/s^3", "jerk rad/s^3", "clearance mm"]
    return Table.by_level("Paths (medians of solved runs; jerk of a run in 1 s at even speed)", head, rows)


def stages(found: Iterable[Statistics]) -> Table:
    """Return the table of shares solved by each stage."""
    chosen = [f for f in found if len(f.by) > 1 or set(f.by) - {f.planner}]
    names = sorted({name for f in chosen for name in f.by})
    rows = []
    for f in chosen:
        shares = [_share(f.by[name] / len(f.runs)) for name in names]
        rows.append((f, [*shares, _share(1.0 - len(f.solved) / len(f.runs))]))
    return Table.by_level("Share solved by each stage", [*names, "not solved"], rows)


def warnings(results: Results) -> list[str]:
    """Return warnings for a reader of the times."""
    sessions, found = results.sessions(), list[str]()
    if any(session["address"] for session in sessions):
        found.append("Runs were made on a cluster, whose machines are not recorded.")
    if any(session["jobs"] > 1 for session in sessions):
        found.append("Several runs were made at the same time, so that times are longer than those of single runs.")
    most = max(session["jobs"] for session in sessions) + TOLERATED_LOAD
    loaded = sum(run["load"] is not None and run["load"] > most for run in results.runs)
    if loaded:
        of = len(results.runs)
        found.append(
            f"The load was over {most:g} in {loaded} of {of} runs: other processes, or many threads that wake."
        )
    if len({session["hardware"] for session in sessions}) > 1:
        found.append("The runs were made on different machines.")
    if len({str(session["versions"]) for session in sessions}) > 1:
        found.append("The runs were made with different versions of libraries.")
    crashed = [run for run in results.runs if run["status"] == "CRASH"]
    if crashed:
        reasons = Counter(f"{run['label']}: {run['reason']}" for run in crashed)
        found.append("Crashed: " + "; ".join(f"{n} x {reason}" for reason, n in reasons.most_common(5)) + ".")
    ended = ((run["label"], ompl_status(run["properties"])) for run in results.runs if run["properties"])
    refused = Counter(f"{label}, {status}" for label, status in ended if status not in FULL_TIME)
    if refused:
        found.append("Ended early, unsolved: " + "; ".join(f"{n} x {name}" for name, n in refused.most_common(5)) + ".")
    faulty = Counter(
        f"{run['problem']}: {run['reason']}" for run in results.runs if run["status"].startswith("INVALID")
    )
    if faulty:
        found.append("Faulty problems: " + "; ".join(list(faulty)[:5]) + ".")
    skipped = len({run["problem"] for run in results.runs if run["status"] == NO_PROBLEM})
    if skipped:
        found.append(f"{skipped} seeds gave no problem and are not counted.")
    if any(not run["raw_length"] for run in results.runs if run["solved"]):
        found.append(
            "First paths of planners that use all their time are observed up to 0.05 s late, without their length, and "
            "are not checked; the full check of the last path counts in their place, no repair of it."
        )
    found.append("OMPL's Benchmark reads the clock every 0.1 s: planners end up to that much earlier, or at 0.1 s.")
    return found


def about(results: Results) -> list[tuple[str, Any]]:
    """Return the provenance of results, as pairs of a name and a text."""
    sessions = results.sessions()
    last = sessions[-1]
    pairs = [("Command", f"{one['command']} ({one['date']}, {one['jobs']} at a time)") for one in sessions]
    versions = ", ".join(f"{name} {version}" for name, version in last["versions"].items())
    resolution = results.about["resolution"]
    full = f"{resolution['full']} rad in the full check" if "full" in resolution else "none in the full check, a proof"
    warm = ", ".join(f"{label} {seconds:.2f} s" for label, seconds in results.about["warm_up"].items())
    pairs += [
        ("Hardware", "; ".join(dict.fromkeys(one["hardware"] for one in sessions))),
        ("Versions", f"Python {last['python']}, {versions}"),
        ("Split and first seed", f"{last['split']}, {last['seed']}"),
        ("Spacing of states", f"{resolution['search']} rad in searches, {full}"),
        ("First run of a process, not counted", warm),
    ]  # fmt: skip
    return pairs


def _share(value: float) -> str:
    return f"{value:.2f}"


def _ms(seconds: float) -> str:
    return f"{1e3 * seconds:.0f}" if math.isfinite(seconds) else "-"


def _number(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.3g}"
