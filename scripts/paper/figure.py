"""Figures of the paper: their content, their failure ratios with confidence intervals, and their files."""

from __future__ import annotations

import io
import json
from argparse import Namespace
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from apex_ompl.evaluation import Results
from apex_ompl.evaluation.metrics import failure_ratio
from apex_ompl.evaluation.summary import Table, about, warnings
from apex_ompl.util.files import write_atomically
from apex_ompl.util.statistics import share_interval
from benchmarks.lib import record

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Notes = list[tuple[str, Any]]
ASKED = "asked"  # entry of the provenance of results: how many runs of each row a figure asks for
DPI = 120


@dataclass(frozen=True, eq=False)
class Made:
    """A figure of the paper, measured.

    Attributes:
        data: Its numbers by name, ready for JSON.
        tables: Tables of them.
        notes: How they were made, as pairs of a name and a text.
        picture: The picture, if there is one.
        commits: Commits of the runs, where they are stored with the runs.
    """

    data: Mapping[str, Any]
    tables: Sequence[Table]
    notes: Notes
    picture: Figure | None = None
    commits: str = ""
    settings: Mapping[str, Any] = field(default_factory=dict)

    def write(self, name: str, args: Namespace) -> None:
        """Write ``paper_NAME.json``, ``.md`` and ``.png``.

        Where runs are missing, cells of the result that is there stay in the JSON file if they have more runs, with
        their date.
        """
        text = [
            *(table.markdown() for table in self.tables),
            "\n".join(f"- {key}: {value}" for key, value in self.notes),
        ]
        of_runs = {"run_commits": self.commits} if self.commits else {}
        notes = [list(pair) for pair in self.notes]
        settings = {"N": args.n, **self.settings, **of_runs}
        file, cost = args.out / f"paper_{name}.json", self.data.get("cost")
        data = dict(self.data)
        if cost and cost["runs"] < cost["of"] and file.is_file():
            data = with_older(data, json.loads(file.read_text("utf-8")))
        record.write(f"paper_{name}", {"notes": notes, **data}, "\n\n".join(text), args.out, **settings)
        if self.picture is not None:
            drawn = io.BytesIO()
            self.picture.savefig(drawn, format="png", dpi=DPI)
            write_atomically(args.out / f"paper_{name}.png", drawn.getvalue())


def with_older(cells: Mapping[str, Any], earlier: Mapping[str, Any]) -> dict[str, Any]:
    """Return the cells of a result with those of an earlier one that have more runs.

    These have the date and the commits of their runs as ``earlier``.
    """
    about = earlier.get("about", {})
    made = f"{about.get('date')}, commits {about.get('run_commits')}"

    def merged(new: Any, old: Any) -> Any:
        if not isinstance(old, Mapping) or not isinstance(new, Mapping | None):
            return new
        if "interval" in old:
            return new if new is not None and new.get("N", 0) >= old["N"] else {"earlier": made, **old}
        names = [name for name in {**(new or {}), **old} if name not in ("about", "notes", "cost")]
        found = {name: merged((new or {}).get(name), old.get(name)) for name in names}
        return {name: value for name, value in found.items() if value is not None}

    kept: dict[str, Any] = merged(cells, earlier)
    return kept | {name: cells[name] for name in ("cost",) if name in cells}


def blank(width: float, height: float) -> Figure:
    """Return an empty picture, of a size in inches."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def ratio(solved: Iterable[bool]) -> dict[str, Any]:
    """Return N, R_f and Wilson's interval of it [%], of tasks that were solved or not.

    Raises:
        ParameterError: No task is given.
    """
    outcomes = list(solved)
    found = failure_ratio(outcomes)
    ends = share_interval(len(outcomes) - sum(outcomes), len(outcomes))
    return {"N": len(outcomes), "R_f": found, "interval": [100.0 * end for end in ends]}


def ratio_cells(cell: Mapping[str, Any]) -> list[str]:
    """Return N, R_f and its interval as the tables have them."""
    low, high = cell["interval"]
    return [str(cell["N"]), f"{cell['R_f']:.1f}", f"{low:.1f} to {high:.1f}"]


def of_runs(results: Results, *, planned: bool = True) -> tuple[Notes, str]:
    """Return the provenance of runs, and their commits.

    Args:
        results: The runs.
        planned: Whether the runs were planned by OMPL's Benchmark, so that its notes and warnings are of interest.
    """
    commits = record.made_with(results)["run_commits"]
    sessions, cost = results.sessions(), cost_of(results)
    wanted = {"Hardware", "Versions", "Split and first seed", *(("Spacing of states",) if planned else ())}
    short = [pair for pair in about(results) if pair[0] in wanted]
    commands = dict.fromkeys(f"{one['command']} ({one['jobs']} at a time)" for one in sessions)
    dates = sorted(one["date"][:10] for one in sessions)
    made = [("Commands", "; ".join(commands)), ("Dates", f"{dates[0]} to {dates[-1]}")]
    if cost["timed"]:
        made.append(("Runs", f"{cost['runs']} of {cost['of']}; {cost['core_hours']:.1f} core-hours for "
                      f"{cost['rated']} of them, by the CPU times of {cost['timed']}"))  # fmt: skip
    notes = [("Note", warning) for warning in warnings(results)] if planned else []
    return [*made, *short, ("Commits of the runs", commits), *notes], commits


def cost_of(results: Results) -> dict[str, Any]:
    """Return what a figure takes: the runs that are there, those that it asks for, and CPU time [core-hours].

    That time is each row's mean CPU time, of the runs that stored theirs (``timed``), times the runs asked for; of rows
    with such runs (``rated`` of the runs asked for).
    """
    asked = Counter(results.about.get(ASKED, {}))
    seconds = {label: [run["cpu"] for run in results.runs if run["label"] == label and run.get("cpu") is not None]
               for label in asked}  # fmt: skip
    total = sum(float(np.mean(some)) * asked[label] for label, some in seconds.items() if some)
    rated = sum(asked[label] for label, some in seconds.items() if some)
    return {"runs": len(results.runs), "of": asked.total(), "timed": sum(map(len, seconds.values())), "rated": rated,
            "core_hours": total / 3600.0}  # fmt: skip


def number(value: float | None, digits: int = 2) -> str:
    """Return a number as the tables have it, a dash where there is none."""
    return "-" if value is None else f"{value:.{digits}f}"
