"""What type checkers, and with them editors, know of the functions that users call."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import fields
from pathlib import Path

import pytest
from support import ROOT

from apex_ompl import Obstacle
from apex_ompl.apex.parameters import ApexKeywords, ApexParameters
from apex_ompl.planning.options import PlanKeywords, PlanOptions, ProblemKeywords
from apex_ompl.planning.world import ObstacleFields

SOURCES = (
    "api.py", "planning/options.py", "planning/planner.py", "planning/world.py", "apex/planner.py",
    "apex/parameters.py", "ompl/parameters.py",
)  # fmt: skip
RECORDS = ("scene/bodies.py", "scene/problem.py", "util/schema.py")
USE = """
from apex_ompl.api import run
from apex_ompl.api import plan
from apex_ompl.apex.planner import APEX
from apex_ompl.scene.problem import PoseTarget, Problem
from apex_ompl.planning.planner import MotionPlanner

def use(planner: MotionPlanner, problem: Problem, si: object) -> None:
    planner.plan([0.0], [1.0], timeout=3.0, timing=False, group="left_arm", leave_contact=0.001)
    planner.plan([0.0], [1.0], timeot=3)
    planner.plan([0.0], [1.0], seed="one")
    planner.plan_problem(problem, sed=3)
    plan("shelf_swap", timeot=3)
    run("popup", planer="apex")
    PoseTarget(frame="left_hand_palm", positon=(0.5, 0.2, 0.4))
    planner.world.add(name="ball", sphere={"radius": 0.1}, position=(0.5, 0.0, 0.3))
    planner.world.add(nam="ball", box=(0.1, 0.1, 0.1))
    APEX(si, first=4, stages=())
    APEX(si, frist=4)
"""
REFUSED = {
    10: '"timeot"',
    11: '"seed"',
    12: '"sed"',
    13: '"timeot"',
    14: '"planer"',
    15: '"position"',
    17: '"nam"',
    19: '"frist"',
}  # by line


def test_keywords_are_those_that_plans_take() -> None:
    names = {field.name for field in fields(PlanOptions)}
    assert set(ApexKeywords.__annotations__) == {field.name for field in fields(ApexParameters)}
    assert set(ObstacleFields.__annotations__) == set(Obstacle.model_fields)
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
