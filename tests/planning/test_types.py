"""What type checkers, and with them editors, know of the functions that users call."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import fields
from pathlib import Path

import pytest
from support import ROOT

from apex_ompl.planning.one_plan import PlanKeywords, PlanOptions, ProblemKeywords

SOURCES = ("api.py", "loop/run.py", "planning/one_plan.py", "planning/planner.py")
RECORDS = ("scene/bodies.py", "scene/problem.py", "util/record_type.py", "util/schema.py")
USE = """
from apex_ompl.api import plan
from apex_ompl import run
from apex_ompl.scene.problem import PoseTarget, Problem
from apex_ompl.planning.planner import MotionPlanner

def use(planner: MotionPlanner, problem: Problem) -> None:
    planner.plan([0.0], [1.0], timeout=3.0, timing=False, group="left_arm", leave_contact=0.001)
    planner.plan([0.0], [1.0], timeot=3)
    planner.plan([0.0], [1.0], seed="one")
    planner.plan_problem(problem, sed=3)
    plan("shelf_swap", timeot=3)
    run("popup", planer="apex")
    PoseTarget(frame="left_hand_palm", positon=(0.5, 0.2, 0.4))
"""
REFUSED = {9: '"timeot"', 10: '"seed"', 11: '"sed"', 12: '"timeot"', 13: '"planer"', 14: '"position"'}  # by line


def test_keywords_are_those_that_plans_take() -> None:
    names = {field.name for field in fields(PlanOptions)}
    assert set(ProblemKeywords.__annotations__) == names and set(PlanKeywords.__annotations__) == names - {"group"}


def test_a_type_checker_refuses_options_and_fields_that_do_not_exist(tmp_path: Path) -> None:
    """It reads the modules of these functions alone, since the whole package takes it half a minute."""
    pytest.importorskip("mypy")
    (tmp_path / "use.py").write_text(USE)
    sources = [ROOT / "apex_ompl" / source for source in (*SOURCES, *RECORDS)]
    command = [
        sys.executable, "-m", "mypy", "--config-file=", "--follow-imports=skip", "--ignore-missing-imports",
        f"--cache-dir={tmp_path}", tmp_path / "use.py", *sources,
    ]  # fmt: skip
    done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=120, cwd=ROOT)
    errors = [line for line in done.stdout.splitlines() if "error:" in line and "use.py" in line]
    assert len(errors) == len(REFUSED), done.stdout
    for line, (number, name) in zip(errors, REFUSED.items(), strict=True):
        assert f"use.py:{number}: " in line and name in line, line
