"""The examples: each runs as it is, and those of a user's own parts are short."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from support import ROOT

ROS = "10_ros2"  # needs controllers: tests/ros2 runs it
EXAMPLES = sorted(path for path in (ROOT / "examples").glob("*.py") if path.stem != ROS)
ARGUMENTS = {"06_ompl_benchmark": ("reach_past_post", "--runs", "1", "--timeout", "3")}
MOST_LINES = 48  # of an example of parts of one's own


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_runs(example: Path, tmp_path: Path) -> None:
    command = [sys.executable, str(example), *ARGUMENTS.get(example.stem, ())]
    done = subprocess.run(command, check=False, capture_output=True, text=True, cwd=tmp_path, timeout=120)
    assert done.returncode == 0, done.stderr
    assert done.stdout
    if example.stem == "06_ompl_benchmark":
        assert "RRTConnect: EXACT_SOLUTION" in done.stdout and "1/1 solved" in done.stdout
        assert (tmp_path / "ompl_benchmark.log").read_text().startswith("OMPL version")


@pytest.mark.parametrize("example", [one for one in EXAMPLES if "_own_" in one.stem], ids=lambda path: path.stem)
def test_parts_of_ones_own_are_short(example: Path) -> None:
    assert len(example.read_text().splitlines()) < MOST_LINES
