"""All comparisons with other planners, one command after the other; each resumes where it was stopped.

These are head_to_head, standing, time_to_quality and peers. The reference lengths of time_to_quality are made only
where they are missing. The paper's figures have a command of their own, scripts/reproduce.py.

Usage: python -m benchmarks.planners.comparisons [--jobs 1]    (needs the extras "bench" and "peers")
"""

from __future__ import annotations

import argparse
import importlib.util
import subprocess
import sys
from pathlib import Path

from apex_ompl.util.entry_point import run_script
from apex_ompl.util.validation import one_or_more

ROOT = Path(__file__).resolve().parents[2]
REFERENCE = ROOT / "benchmarks" / "reference_lengths.json"
NEEDED = ("roboplan",)
COMMANDS = (
    ("head_to_head",),
    ("standing",),
    *(() if REFERENCE.is_file() else (("time_to_quality", "--reference"),)),
    ("time_to_quality",),
    ("peers",),
)


def main() -> None:
    """Run all commands; end with the first that fails."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--jobs", type=one_or_more, default=1, help="runs at a time (default: one, as they are timed)")
    args = parser.parse_args()
    missing = [name for name in NEEDED if importlib.util.find_spec(name) is None]
    if missing:  # reported now, not after hours
        parser.error(f"no {', '.join(missing)}, expected: pip install 'apex-ompl[bench,peers]'")
    for command in COMMANDS:
        given = ["-m", f"benchmarks.planners.{command[0]}", *command[1:], "--jobs", str(args.jobs)]
        print("$ python", *given, flush=True)
        ended = subprocess.run([sys.executable, *given], cwd=ROOT, check=False)
        if ended.returncode:
            sys.exit(ended.returncode)


if __name__ == "__main__":
    run_script(main)
