"""Every command and every public function of the installed package, once, in a folder that holds nothing.

Run by the Python into whose environment the package was installed, as ``.ci/run`` does:

    python tests/installed

What is missing in the wheel shows here, and only here: other tests find it in the clone.
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from pathlib import Path

import commands
import functions

import apex_ompl

ROOT = Path(__file__).resolve().parents[2]


def main() -> None:
    """Run all, and end with a sentence where something was not run."""
    if ROOT in Path(apex_ompl.__file__).resolve().parents:
        sys.exit(f"{apex_ompl.__file__} is the clone, expected an installed package: pip install .")
    for part, run in (("functions", functions.run), ("commands", commands.run)):
        with tempfile.TemporaryDirectory() as folder:
            os.chdir(folder)
            started = time.perf_counter()
            left = run(ROOT)
            os.chdir("/")
        print(f"installed: {part} in {time.perf_counter() - started:.0f} s", flush=True)
        if left:
            sys.exit(f"installed: never called, so call it in tests/installed/{part}.py: {', '.join(left)}")


if __name__ == "__main__":
    main()
