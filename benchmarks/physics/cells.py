"""Random cells executed in physics: pick and place, handover and stacking, each from its start to its end.

Each run is another cell and another start: joints of the arms within 0.02 rad, which are measured, masses and friction
within 20 %, which are not; with --place, objects do not stand where the plan has them either. A run succeeds where the
objects are where they belong at the end (:mod:`apex_ompl.physics.judges`). The Panda's gripper holds boxes by friction
alone; hands with fingers are guided while they close, and hold by welds (:mod:`apex_ompl.drivers.grasps`). Runs are
stored in benchmarks/runs/cells_in_physics when they end; the command resumes.

Usage: python -m benchmarks.physics.cells [-n 20] [--first 1000] [--kind handover] [--place 0.005] [--pictures FOLDER]
"""

from __future__ import annotations

from itertools import product
from pathlib import Path
from typing import Any

from apex_ompl.drivers.library import mujoco
from apex_ompl.physics import Spread, TaskRunner
from apex_ompl.planning import TaskSearch
from apex_ompl.problems import cells
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.validation import whole_number
from benchmarks.lib import record
from benchmarks.lib.pack import RUNS
from benchmarks.physics import tasks

DEPENDS = ("@planning", "apex_ompl/timing", "apex_ompl/drivers", "apex_ompl/physics")
FOLDER = RUNS / "cells_in_physics"
TIMEOUT = 60.0  # of a plan [s]
TWO_ARMS = "handover", "stacking"  # which have asynchronous rows


def main() -> None:
    """Make the runs that are missing, and write the results."""
    parser = record.parser(__doc__ or "", n=20, of="cells of a kind, each with a start of its own")
    parser.add_argument("--first", type=whole_number, default=1000, help="first seed (default: %(default)s)")
    parser.add_argument("--kind", action="append", choices=cells.names(), default=[])
    parser.add_argument("--place", type=float, nargs="*", default=[0.0], help="distances of objects [m]")
    parser.add_argument("--pictures", type=Path, metavar="FOLDER", help="draw runs that fail into it, as they end")
    given = parser.parse_args()
    for folder in filter(None, (FOLDER, given.pictures)):
        folder.mkdir(parents=True, exist_ok=True)
    lines = [record.row(list(tasks.HEAD)), record.row(["---"] * len(tasks.HEAD))]
    seeds, found = range(given.first, given.first + given.n), dict[str, list[dict[str, Any]]]()
    for place, asynchronous in product(given.place, (False, True)):
        for kind in given.kind or cells.names():
            if asynchronous and kind not in TWO_ARMS:
                continue
            parts = [kind, *["asynchronous"] * asynchronous, *([f"objects {1e3 * place:g} mm off"] if place else [])]
            name, search = ", ".join(parts), TaskSearch(asynchronous=asynchronous)
            rows = tasks.made(
                name.replace(", ", "-").replace(" ", "_"), seeds, FOLDER,
                lambda seed, kind=kind, place=place, search=search: TaskRunner(
                    cells.draw(kind, seed), Spread(place=place), timeout=TIMEOUT, search=search
                ),
                given.pictures,
            )  # fmt: skip
            found[name] = rows
            lines.append(record.row(tasks.cells(name, rows)))
    commits = "; ".join(sorted({row["commit"] for rows in found.values() for row in rows}))
    record.write(
        "physics_cells", {"runs": found}, "\n".join(lines), N=given.n, seeds=f"{seeds[0]}-{seeds[-1]}",
        timeout=TIMEOUT, mujoco=mujoco().__version__, run_commits=commits,
    )  # fmt: skip


if __name__ == "__main__":
    run_script(main)
