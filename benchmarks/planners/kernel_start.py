"""How long it takes from nothing to a plan: the installation, the first plan after it, later ones, other starts.

Every row is a process of its own, timed from outside; those of a first plan have an empty home. ``--install`` makes a
new environment as README's first command does, in parts: environment, downloads, files, byte code, first plan.
``--numba`` times the first and later plans where the library of the kernel is not used.

Usage: python -m benchmarks.planners.kernel_start [--runs 10] [--install] [--numba]
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from apex_ompl.kernel.library import CHOICE
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.validation import one_or_more
from benchmarks.lib import record

DEPENDS = ("@planning", "apex_ompl/cli", "apex_ompl/planning", "apex_ompl/loop", "pyproject.toml", "constraints.txt")
PLAN = ("apex-ompl", "plan", "ball_in_cup")
RUN = """
import apex_ompl
from apex_ompl.moving.settings import LoopSettings
apex_ompl.run("vertical/moving-huge-0.4/800007", settings=LoopSettings(timeout=1.0))
"""
STARTS = {
    "`apex-ompl plan ball_in_cup`, first in an empty home": (PLAN, True, 2.0),
    "`apex-ompl plan ball_in_cup`, later": (PLAN, False, 1.0),
    "`apex-ompl --help`": (("apex-ompl", "--help"), False, 0.1),
    "`from apex_ompl import MotionPlanner`": (("python", "-c", "from apex_ompl import MotionPlanner"), False, 0.4),
    "`apex_ompl.run`, the first of a process, 1 s of a run": (("python", "-c", RUN), False, 3.0),
}


def main() -> None:
    """Measure and write."""
    parser = record.parser(__doc__)
    parser.add_argument("--runs", type=one_or_more, default=10, help="(default: %(default)s)")
    parser.add_argument("--install", action="store_true", help="time README's first command in a new environment, too")
    parser.add_argument("--numba", action="store_true", help="time plans without the library, too")
    args = parser.parse_args()
    figures: dict[str, object] = {}
    lines = [record.row(["process", "minimum [s]", "median [s]", "aim [s]", "memory [MB]"])]
    lines.append(record.row(["---", "---:", "---:", "---:", "---:"]))
    with tempfile.TemporaryDirectory() as folder:
        for what, (command, empty, aim) in STARTS.items():
            found = [timed(command, home(Path(folder), empty)) for _ in range(args.runs + 1)][1:]  # files are in memory
            seconds, memory = np.array(found).T
            figures[what] = {"seconds": seconds.tolist(), "megabytes": memory.tolist()}
            values = f"{seconds.min():.2f}", f"{np.median(seconds):.2f}", aim, f"{memory.max():.0f}"
            lines.append(record.row([what, *values]))
    if args.numba:
        with tempfile.TemporaryDirectory() as folder:
            env = home(Path(folder), True) | {CHOICE: "numba"}
            first, later = timed(PLAN, env)[0], [timed(PLAN, env)[0] for _ in range(3)]
        figures["numba"] = {"first": first, "later": later}
        lines.append(record.row(["first plan, compiled on the spot, once", f"{first:.1f}", "", "", ""]))
        lines.append(
            record.row(["later, code from the cache, 3", f"{min(later):.2f}", f"{np.median(later):.2f}", "", ""])
        )
    if args.install:
        parts, sizes = installed()
        figures |= {"install": parts, "sizes": sizes}
        lines += ["", record.row(["README's first command, once", "seconds"]), record.row(["---", "---:"])]
        lines += [record.row([what, f"{value:.1f}"]) for what, value in [*parts.items(), ("sum", sum(parts.values()))]]
        lines += ["", record.row(["what it installs", "MB"]), record.row(["---", "---:"])]
        largest = sorted(sizes.items(), key=lambda item: -item[1])
        lines += [record.row([what, f"{value:.0f}"]) for what, value in largest[:12]]
        lines.append(record.row(["all", f"{sum(sizes.values()):.0f}"]))
    record.write("kernel_start", figures, "\n".join(lines), N=args.runs)


def home(folder: Path, empty: bool) -> dict[str, str]:
    """Return the environment of a user whose home is a folder, emptied if asked for."""
    if empty:
        shutil.rmtree(folder / "home", ignore_errors=True)
    (folder / "home").mkdir(exist_ok=True)
    own = {CHOICE, "PYTHONDONTWRITEBYTECODE", "PYTHONUNBUFFERED", "PYTHONPATH", "NUMBA_CACHE_DIR", "XDG_CACHE_HOME"}
    env = {name: value for name, value in os.environ.items() if name not in own}
    return env | {"HOME": str(folder / "home")}


def timed(command: Sequence[str], env: dict[str, str], cwd: Path | None = None) -> tuple[float, float]:
    """Return the wall time [s] and the largest memory [MB] of a command of this environment."""
    program = [str(Path(env.get("VIRTUAL_ENV", sys.prefix)) / "bin" / command[0]), *command[1:]]
    timer = [sys.executable, "-S", "-c", TIMER, *program]
    done = subprocess.run(timer, env=env, cwd=cwd, check=False, capture_output=True, text=True)
    if done.returncode:
        sys.exit(f"{' '.join(command)}: {done.stdout}{done.stderr}")
    seconds, kilobytes = done.stdout.splitlines()[-1].split()
    return float(seconds), float(kilobytes) / 1024.0


TIMER = """
import os, sys, time
begin = time.perf_counter()
_, status, usage = os.wait4(os.posix_spawn(sys.argv[1], sys.argv[1:], os.environ), 0)
print("\\n", time.perf_counter() - begin, usage.ru_maxrss)
sys.exit(os.waitstatus_to_exitcode(status))
"""  # small, since a process counts the memory of the one that started it


def installed() -> tuple[dict[str, float], dict[str, float]]:
    """Return the times of the parts of an installation [s], and the sizes of what it consists of [MB]."""
    with tempfile.TemporaryDirectory() as folder:
        place, wheels = Path(folder) / "venv", str(Path(folder) / "wheels")
        env = home(Path(folder), True) | {"VIRTUAL_ENV": sys.prefix}
        parts = {"environment": timed(("python", "-m", "venv", str(place)), env)[0]}
        env["VIRTUAL_ENV"] = str(place)
        steps = {
            "downloads, and our own wheel": ("pip", "wheel", "-q", "-c", "constraints.txt", "-w", wheels, "."),
            "files": ("pip", "install", "-q", "--no-index", "--find-links", wheels, "--no-compile", "apex-ompl"),
            "byte code": (
                "python",
                "-m",
                "compileall",
                "-q",
                "-x",
                "bad_coding|badsyntax|lib2to3|py312",
                str(place / "lib"),
            ),
            "first plan": PLAN,
        }
        for what, command in steps.items():
            parts[what] = timed(command, env, record.ROOT if what.startswith("downloads") else None)[0]
        code = "from importlib.metadata import distributions\n" + SIZES
        done = subprocess.run([place / "bin" / "python", "-c", code], capture_output=True, text=True, check=True)
        sizes = dict(line.rsplit(" ", 1) for line in done.stdout.splitlines())
    return parts, {name: float(value) for name, value in sizes.items()}


SIZES = """
for one in distributions():
    found = [one.locate_file(file) for file in one.files or ()]
    print(one.name, sum(file.stat().st_size for file in found if file.is_file()) / 1e6)
"""


if __name__ == "__main__":
    run_script(main)
