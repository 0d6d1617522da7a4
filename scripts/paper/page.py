"""The page that compares the paper's numbers with ours, written from the results alone."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from paper.fid import LIMIT as FID_LIMIT
from paper.moving import LIMIT
from paper.published import ENTRIES, PICTURES, RIVALS, Entry, Rival, Where
from paper.rows import PACE, PATIENCE
from paper.static import TIMEOUT

from apex_ompl.model.guidance import EQUATION_7
from apex_ompl.moving.compute_costs import cost_table
from apex_ompl.moving.settings import LoopSettings
from apex_ompl.util.files import write_atomically
from benchmarks.lib import record

MISSING, NONE = "not measured yet", ""
PREFIX = "paper_"
TEMPLATE = Path(__file__).with_name("page_template.md")
FIGURES_SHOWN = ("time", "failure", "size", "dynamic", "fid", "strips", "failures", "denoising", "diversity")


class Results:
    """The results of the figures in a folder."""

    def __init__(self, folder: Path) -> None:
        """Read the available results."""
        self.folder = folder
        files = {path.stem.removeprefix(PREFIX): path for path in sorted(folder.glob(f"{PREFIX}*.json"))}
        self.found: dict[str, dict[str, Any]] = {name: json.loads(p.read_text("utf-8")) for name, p in files.items()}

    def entry(self, where: Where) -> Mapping[str, Any] | None:
        """Return an entry of a result, or None where there is none."""
        found: Any = self.found
        for key in where:
            found = found.get(key) if isinstance(found, dict) else None
        return found if isinstance(found, dict) else None


def shown(entry: Mapping[str, Any] | None, number: str) -> str:
    """Return a number of an entry, with its interval where it has one."""
    if entry is None or number not in entry:
        return MISSING
    value = entry[number]
    if value is None:  # not a number: most runs failed
        return "-"
    text = f"{value:.1f}" if number == "R_f" else f"{value:.2f}"
    if "interval" in entry and number in ("R_f", "fid"):
        low, high = entry["interval"]
        digits = 1 if number == "R_f" else 2
        text += f" ({low:.{digits}f} to {high:.{digits}f})"
    return text


def count(*entries: Mapping[str, Any] | None) -> str:
    """Return the numbers of tasks of some entries, each once."""
    found = [entry["made"] if "made" in entry else entry.get("N", "?") for entry in entries if entry is not None]
    return ", ".join(dict.fromkeys(map(str, found)))


def row(cells: Sequence[str]) -> str:
    """Return a row of a Markdown table."""
    return record.row(list(cells))


def entries(results: Results, some: Sequence[Entry] = ENTRIES) -> str:
    """Return the table of the paper's numbers and ours."""
    lines = [row(["figure", "what", "the paper", "`apex-paper`", "`apex`", "N", "what differs"]), row(["---"] * 7)]
    for one in some:
        both = [results.entry(where) if where else None for where in (one.faithful, one.ours)]
        ours = [shown(entry, one.number) if where else NONE
                for entry, where in zip(both, (one.faithful, one.ours), strict=True)]  # fmt: skip
        lines.append(row([one.figure, one.what, one.paper, *ours, count(*both), one.differs]))
    return "\n".join(lines)


def rivals(results: Results, some: Sequence[Rival] = RIVALS) -> str:
    """Return the table of the algorithms that the paper compares, on both tasks together."""
    head = [
        "the paper's",
        "R_f %",
        "S_r",
        "ours",
        "R_f %, standing",
        "N",
        "R_f %, moving",
        "N",
        "S_r rad",
        "what differs",
    ]
    lines = [row(head), row(["---"] * len(head))]
    for one in some:
        static = results.entry(("failure", f"both, {one.static}"))
        moving = results.entry(("dynamic", "tasks", f"both, {one.moving}")) if one.moving else None
        cells = [one.name, one.ratio, one.smoothness, f"`{one.static}`", shown(static, "R_f"), count(static)]
        cells += [shown(moving, "R_f") if one.moving else NONE, count(moving), shown(static, "S_r"), one.differs]
        lines.append(row(cells))
    return "\n".join(lines)


def sweeps(results: Results) -> str:
    """Return the table of the effects of single choices of the loop."""
    found = results.found.get("dynamic", {}).get("sweeps", {})
    if not found:
        return f"({MISSING}: `python scripts/reproduce.py dynamic`)"
    lines = [row(["large cubes, moving", "R_f %", "N", "causes"]), row(["---"] * 4)]
    for label, entry in found.items():
        causes = ", ".join(f"{k} {cause}" for cause, k in entry["causes"].items()) or "-"
        lines.append(row([label, shown(entry, "R_f"), count(entry), causes]))
    return "\n".join(lines)


def distances(results: Results) -> str:
    """Return the table of FID in the latent space of the paper's model."""
    found = {key.removeprefix("VAE, "): v for key, v in results.found.get("fid", {}).items() if key.startswith("VAE, ")}
    if not found:
        return f"({MISSING}: `python scripts/reproduce.py fid`)"
    lines = [row(["paths", "FID (95 %)", "floor", "KID", "N", "d"]), row(["---"] * 6)]
    for label, entry in found.items():
        cells = [label, shown(entry, "fid"), f"{entry['floor']:.2f}", f"{entry['kid']:.4f}", count(entry)]
        lines.append(row([*cells, str(entry["dimension"])]))
    return "\n".join(lines)


def pictures(results: Results, to: str) -> str:
    """Return the available pictures, each under its title.

    Args:
        results: The results.
        to: Path from the page to their folder.
    """
    parts = []
    for name, title in PICTURES.items():
        there = (results.folder / f"{PREFIX}{name}.png").is_file()
        link = f"![{title}]({to}/{PREFIX}{name}.png)" if there else f"({MISSING}: `python scripts/reproduce.py {name}`)"
        parts.append(f"{title}\n\n{link}")
    return "\n\n".join(parts)


def made_with(results: Results, to: str) -> str:
    """Return the table of how each result was made."""
    lines = [row(["result", "command", "date", "commits", "hardware", "versions"]), row(["---"] * 6)]
    for name in FIGURES_SHOWN:
        if name not in results.found:
            lines.append(row([name, f"`python scripts/reproduce.py {name}`", MISSING, "", "", ""]))
            continue
        about = results.found[name]["about"]
        versions = ", ".join(f"{library} {version}" for library, version in about["versions"].items())
        commits = about.get("run_commits") or about["commit"]
        cells = [f"[{name}]({to}/{PREFIX}{name}.md)", f"`{about['command']}`", about["date"], commits]
        lines.append(row([*cells, about["hardware"], f"Python {about['python']}, {versions}"]))
    return "\n".join(lines)


def text(results: Results, to: str) -> str:
    """Return the page.

    Args:
        results: The results.
        to: Path from the page to their folder.
    """
    seconds, loop = cost_table()["seconds"], LoopSettings()
    return TEMPLATE.read_text("utf-8").format(
        entries=entries(results), rivals=rivals(results), sweeps=sweeps(results), distances=distances(results),
        pictures=pictures(results, to), made_with=made_with(results, to), trigger=f"{loop.trigger:g}",
        stuck=f"{loop.stuck:g}", limit=f"{LIMIT:g}", timeout=f"{TIMEOUT:g}", patience=f"{PATIENCE:g}",
        pace=f"{PACE:g}", gamma=EQUATION_7.gamma, active=EQUATION_7.active_below,
        fid_limit=f"{FID_LIMIT:g}", guided=f"{seconds['guided path of the paper']:.2g} s",
        unguided=f"{seconds['path of the paper']:.2g} s",
    )  # fmt: skip


def write(folder: Path, page: Path) -> None:
    """Write the page from the results in a folder.

    Raises:
        MissingFileError: The page cannot be written.
    """
    to = Path(os.path.relpath(folder.resolve(), page.resolve().parent)).as_posix()
    write_atomically(page, text(Results(folder), to).encode())
    print(page)
