"""Report of a benchmark: one self-contained HTML page, and Markdown."""

from __future__ import annotations

import base64
import io
import math
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from apex_ompl.errors import FileFormatError
from apex_ompl.evaluation.results import Results, short
from apex_ompl.evaluation.summary import Statistics, about, statistics, tables, warnings
from apex_ompl.util.files import make_folder, write_atomically

COLUMNS = 4  # of subplots
COLORS = (
    "#0b6e4f",
    "#c8553d",
    "#3d5a80",
    "#e0a458",
    "#7a5195",
    "#5f7470",
    "#b56576",
    "#1b998b",
    "#8d6a9f",
    "#444444",
    "#a9bcd0",
    "#6b8e23",
    "#d4a5a5",
    "#2f4858",
    "#f6ae2d",
    "#86bbd8",
)

TITLES = {
    "success": "Share of problems with a first path that passed the full check, over time",
    "time": "Time to the first path of solved runs",
    "length": "Length of the final path of solved runs",
    "stages": "What solved the problems",
}

PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>apex-ompl: benchmark</title><style>
body { font: 15px/1.5 system-ui, sans-serif; margin: 2em auto; max-width: 1200px; padding: 0 1em; color: #222; }
table { border-collapse: collapse; margin: 1em 0; font-size: 13px; display: block; overflow-x: auto; }
th, td { padding: .2em .6em; border-bottom: 1px solid #ddd; text-align: right; white-space: nowrap; }
th:nth-child(-n+2), td:nth-child(-n+2) { text-align: left; }
tr.level td { border-top: 2px solid #888; }
img { max-width: 100%; } dt { font-weight: 600; } dd { margin: 0 0 .4em 1em; } .warning { color: #a33; }
</style></head><body>
<h1>Benchmark</h1>
<p>{{ runs }} runs of {{ labels | length }} planners on {{ experiments | length }} levels. Solved means that the path
passed the full check. A dash stands for a percentile that no solved run reaches.</p>
{% for text in warnings %}<p class="warning">{{ text }}</p>{% endfor %}
{% for name, picture in pictures.items() %}
<h2>{{ titles[name] }}</h2><img alt="{{ titles[name] }}" src="data:image/png;base64,{{ picture }}">
{% endfor %}
{% for table in tables %}
<h2>{{ table.title }}</h2>
<table><thead><tr>{% for cell in table.head %}<th>{{ cell }}</th>{% endfor %}</tr></thead><tbody>
{% for row in table.rows %}<tr{% if row[0] %} class="level"{% endif %}>
{% for cell in row %}<td>{{ cell }}</td>{% endfor %}</tr>
{% endfor %}</tbody></table>
{% endfor %}
<h2>How it was made</h2>
<dl>{% for name, text in about %}<dt>{{ name }}</dt><dd>{{ text }}</dd>{% endfor %}</dl>
<h2>Parameters</h2>
<dl>{% for label, row in planners.items() %}<dt>{{ label }}</dt><dd>{% for name, value in row.all.items() -%}
{{ name }} = {{ value }}{{ "; " if not loop.last }}{%- endfor %}</dd>{% endfor %}</dl>
</body></html>
"""


def report(results: str | os.PathLike[str], out: str | os.PathLike[str]) -> tuple[Path, Path]:
    """Write ``report.html`` and ``report.md`` of a folder of results into a folder, and return the files.

    Raises:
        MissingFileError: There are no results, or the folder cannot be made.
        FileFormatError: The results are damaged, or hold no run.
    """
    read = Results.load(results)
    found = statistics(read)
    if not found:
        raise FileFormatError(str(read.folder), "", "none", "expected results with one run or more")
    folder = make_folder(out)
    page, text = folder / "report.html", folder / "report.md"
    write_atomically(page, html(read, found).encode())
    write_atomically(text, markdown(read).encode())
    return page, text


def markdown(results: Results) -> str:
    """Return the tables as Markdown."""
    parts = ["# Benchmark", "Solved means that the path passed the full check.", *warnings(results)]
    parts += [table.markdown() for table in tables(results) if table.rows]
    parts += ["### How it was made", "\n".join(f"- {name}: `{text}`" for name, text in about(results))]
    return "\n\n".join(parts) + "\n"


def html(results: Results, found: Sequence[Statistics]) -> str:
    """Return the page."""
    labels, experiments = (list(dict.fromkeys(getattr(f, name) for f in found)) for name in ("label", "experiment"))
    template = jinja2.Environment(autoescape=True, trim_blocks=True).from_string(PAGE)
    return template.render(
        runs=sum(len(f.runs) for f in found), labels=labels, experiments=experiments,
        warnings=warnings(results), titles=TITLES, pictures=pictures(found), planners=results.about["rows"],
        tables=[table for table in tables(results) if table.rows], about=about(results),
    )  # fmt: skip


def pictures(found: Sequence[Statistics]) -> dict[str, str]:
    """Return PNG pictures in base 64, by the names of :data:`TITLES`."""
    labels = list(dict.fromkeys(f.label for f in found))
    colors = {label: COLORS[k % len(COLORS)] for k, label in enumerate(labels)}
    made = {"success": _grid(found, _curve, colors, "s", log=True)}
    if any(f.solved for f in found):
        made["time"] = _grid(found, _box("first"), colors, "s", log=True, legend=False)
        made["length"] = _grid(found, _box("length"), colors, "rad", legend=False)
    staged = [f for f in found if len(f.by) > 1]
    if staged:
        made["stages"] = _bars(staged)
    return made


def _grid(
    found: Sequence[Statistics], draw: Callable[..., None], colors: dict[str, str], unit: str, *, log: bool = False,
    legend: bool = True,
) -> str:  # fmt: skip
    """Return a picture with a subplot for each level."""
    levels = list(dict.fromkeys(f.experiment for f in found))
    columns = min(COLUMNS, len(levels))
    rows = math.ceil(len(levels) / columns)
    height = 2.4 if legend else 0.6 + 0.28 * len(colors)
    figure = Figure(figsize=(3.2 * columns, height * rows + 0.7), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for axis, level in zip(axes, levels, strict=False):
        mine = [f for f in found if f.experiment == level]
        draw(axis, mine, colors)
        axis.set_title(short(level), fontsize=9)
        axis.tick_params(labelsize=7)
        axis.set_xlabel(unit, fontsize=7)
        axis.grid(alpha=0.25)
        if log:
            axis.set_xscale("log")
            axis.set_xlim(1e-3, max(f.limit for f in found))
    for axis in axes[len(levels) :]:
        axis.set_visible(False)
    if legend:
        handles = [Line2D([], [], color=color, label=label) for label, color in colors.items()]
        figure.legend(handles=handles, loc="outside upper center", ncols=min(4, len(handles)), fontsize=8)
    return _png(figure)


def _curve(axis: Any, mine: Sequence[Statistics], colors: dict[str, str]) -> None:
    for f in mine:
        times = f.times()
        there = times[np.isfinite(times)]
        at = np.concatenate([[1e-3], np.maximum(there, 1e-3), [max(f.limit, *there, 1e-3)]])
        share = np.concatenate([[0.0], np.arange(1, len(there) + 1), [len(there)]]) / len(times)
        axis.step(at, share, where="post", color=colors[f.label], linewidth=1.4)
    axis.set_ylim(-0.02, 1.02)


def _box(key: str) -> Callable[..., None]:
    def draw(axis: Any, mine: Sequence[Statistics], colors: dict[str, str]) -> None:
        values = [[max(run[key], 1e-4) for run in f.solved if run[key] is not None] for f in mine]
        shown = axis.boxplot(values, orientation="horizontal", patch_artist=True, showfliers=False, whis=(5, 95))
        for patch, f in zip(shown["boxes"], mine, strict=True):
            patch.set_facecolor(colors[f.label])
            patch.set_alpha(0.6)
        for line in shown["medians"]:
            line.set_color("black")
        axis.set_yticks(range(1, len(mine) + 1), [f.label for f in mine], fontsize=7)
        axis.invert_yaxis()

    return draw


def _bars(found: Sequence[Statistics]) -> str:
    names = sorted({name for f in found for name in f.by})
    figure = Figure(figsize=(10, 0.8 + 0.22 * len(found)), layout="constrained")
    axis, left = figure.subplots(), np.zeros(len(found))
    for k, name in enumerate(names):
        shares = np.array([f.by[name] / len(f.runs) for f in found])
        axis.barh(range(len(found)), shares, left=left, label=name, color=COLORS[k % len(COLORS)])
        left += shares
    axis.set_yticks(range(len(found)), [f"{f.experiment}, {f.label}" for f in found], fontsize=7)
    axis.invert_yaxis()
    axis.set_xlim(0.0, 1.0)
    figure.legend(loc="outside right upper", fontsize=8)
    return _png(figure)


def _png(figure: Figure) -> str:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    return base64.b64encode(buffer.getvalue()).decode()
