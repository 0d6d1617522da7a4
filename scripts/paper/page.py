"""The page that compares the paper's numbers with ours, written from the results alone."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from paper import verdict
from paper.fid import LIMIT as FID_LIMIT
from paper.moving import LIMIT
from paper.published import ENTRIES, PICTURES, RIVALS, Entry, Rival
from paper.rows import OURS, PACE, PATIENCE
from paper.static import TIMEOUT
from paper.table import MISSING, PREFIX, Results, dated, shown, table

from apex_ompl.model.guidance import EQUATION_7
from apex_ompl.moving.compute_costs import cost_table
from apex_ompl.moving.settings import LoopSettings
from apex_ompl.util.files import write_atomically

NONE = ""
TEMPLATE = Path(__file__).with_name("page_template.md")
FIGURES_SHOWN = (
    "time", "failure", "size", "imposed", "dynamic", "fid", "strips", "failures", "denoising", "diversity",
)  # fmt: skip


def count(*entries: Mapping[str, Any] | None) -> str:
    """Return the numbers of tasks of some entries, each once."""
    there = [entry for entry in entries if entry is not None and "why" not in entry]
    found = [f"{entry['made'] if 'made' in entry else entry.get('N', '?')}{dated(entry)}" for entry in there]
    return ", ".join(dict.fromkeys(found))


def entries(results: Results, some: Sequence[Entry] = ENTRIES) -> str:
    """Return the table of the paper's numbers and ours."""
    rows = []
    for one in some:
        both = [results.entry(where) if where else None for where in (one.faithful, one.ours)]
        ours = [shown(entry, one.number) if where else NONE
                for entry, where in zip(both, (one.faithful, one.ours), strict=True)]  # fmt: skip
        rows.append([one.figure, one.what, one.paper, *ours, count(*both), one.differs])
    return table(["figure", "what", "the paper", "`apex-paper`", "`apex`", "N", "what differs"], rows)


def rivals(results: Results, some: Sequence[Rival] = RIVALS) -> str:
    """Return the table of the algorithms that the paper compares, on both tasks together."""
    head = ["the paper's", "R_f %", "S_r", "ours", "R_f %, standing", "N", "beside `apex`", "R_f %, moving", "N",
            "beside `apex`", "S_r rad", "what differs"]  # fmt: skip
    best = (("failure", f"both, {OURS}"), ("dynamic", "tasks", f"both, {OURS}"))
    rows = []
    for one in some:
        static = results.entry(("failure", f"both, {one.static}"))
        moving = results.entry(("dynamic", "tasks", f"both, {one.moving}")) if one.moving else None
        pairs = zip((static, moving), map(results.entry, best), strict=True)
        beside = [NONE if one.static == OURS else verdict.told(entry, other) for entry, other in pairs]
        cells = [one.name, one.ratio, one.smoothness, f"`{one.static}`", shown(static, "R_f"), count(static), beside[0]]
        cells += [shown(moving, "R_f") if one.moving else NONE, count(moving), beside[1]]
        rows.append([*cells, shown(static, "S_r"), one.differs])
    return table(head, rows)


def motions(results: Results) -> str:
    """Return the table of smoothness and time of motions among the largest cubes."""
    rows = []
    for scene in verdict.SCENES:
        for k, label in enumerate(scene.labels):
            cell = scene.cell(results, verdict.LARGEST, k)
            numbers = [shown(cell, name) for name in ("S_r", "duration_s", "rms_jerk")]
            rows.append([scene.name, label, *numbers, count(cell)])
    return table(["largest cubes", "row", "S_r rad", "duration s", "jerk rad/s^3", "N"], rows)


def sweeps(results: Results) -> str:
    """Return the table of the effects of single choices of the loop."""
    found = results.found.get("dynamic", {}).get("sweeps", {})
    if not found:
        return f"({MISSING}: `python scripts/reproduce.py dynamic`)"
    rows = []
    for label, entry in found.items():
        causes = ", ".join(f"{k} {cause}" for cause, k in entry["causes"].items()) or "-"
        rows.append([label, shown(entry, "R_f"), count(entry), causes])
    return table(["large cubes, moving", "R_f %", "N", "causes"], rows)


def distances(results: Results) -> str:
    """Return the table of FID in the latent space of the paper's model."""
    found = {key.removeprefix("VAE, "): v for key, v in results.found.get("fid", {}).items() if key.startswith("VAE, ")}
    if not found:
        return f"({MISSING}: `python scripts/reproduce.py fid`)"
    rows = []
    for label, entry in found.items():
        cells = [label, shown(entry, "fid"), f"{entry['floor']:.2f}", f"{entry['kid']:.4f}", count(entry)]
        rows.append([*cells, str(entry["dimension"])])
    return table(["paths", "FID (95 %)", "floor", "KID", "N", "d"], rows)


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
    rows = []
    for name in FIGURES_SHOWN:
        if name not in results.found:
            rows.append([name, f"`python scripts/reproduce.py {name}`", MISSING, *[NONE] * 5])
            continue
        about, cost = results.found[name]["about"], results.found[name].get("cost")
        versions = ", ".join(f"{library} {version}" for library, version in about["versions"].items())
        commits = about.get("run_commits") or about["commit"]
        cells = [f"[{name}]({to}/{PREFIX}{name}.md)", f"`{about['command']}`", about["date"]]
        cells += (
            [f"{cost['runs']} of {cost['of']}", f"{cost['core_hours']:.1f} for {cost['rated']}"]
            if cost
            else [NONE, NONE]
        )
        rows.append([*cells, commits, about["hardware"], f"Python {about['python']}, {versions}"])
    head = ["result", "command", "date", "runs", "core-hours for runs", "commits", "hardware", "versions"]
    return table(head, rows)


def text(results: Results, to: str) -> str:
    """Return the page.

    Args:
        results: The results.
        to: Path from the page to their folder.
    """
    seconds, loop = cost_table()["seconds"], LoopSettings()
    return TEMPLATE.read_text("utf-8").format(
        verdict="\n".join(f"{k}. {one}" for k, one in enumerate(verdict.sentences(results), 1)),
        by_size=verdict.by_size(results), causes=verdict.causes(results),
        motions=motions(results), entries=entries(results),
        rivals=rivals(results), sweeps=sweeps(results), distances=distances(results),
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
