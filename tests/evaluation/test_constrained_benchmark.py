"""The benchmark under constraints: its dense check, its rows and problems, and McVAMP's problems."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from support import ROOT, benchmark_script

from apex_ompl import problems
from apex_ompl.errors import ApexError, UnknownNameError
from apex_ompl.evaluation import Results, Row
from apex_ompl.evaluation.rows import Job
from apex_ompl.ompl.parameters import REGISTRY
from apex_ompl.problems.catalogue import CONSTRAINED
from apex_ompl.robot import Robot, load_robot
from apex_ompl.scene.bodies import pose_matrix
from apex_ompl.scene.constraints import FixedOrientation, OnLine, OnPlane, RelativePose, ToolRegion, Upright
from apex_ompl.scene.problem import Problem
from apex_ompl.types import Array

constrained = benchmark_script("planners.constrained")
constrained_mcvamp = benchmark_script("planners.constrained_mcvamp")
check = benchmark_script("planners.constrained_check")
DENSE, FrameReader, all_constraints = check.DENSE, check.FrameReader, check.all_constraints
arm_joints, dense_check, residual_of = check.arm_joints, check.dense_check, check.residual_of

POSE = {"tool": np.eye(4)}


@pytest.fixture(scope="module")
def problem() -> Problem:
    return problems.load("carry_tray")


def start_of(problem: Problem, robot: Robot) -> Array:
    return problem.start_state(robot.joint_names)


@pytest.mark.parametrize(
    ("constraint", "moved"),
    [
        (Upright(frame="tool", angle=0.1), pose_matrix((0, 0, 0), (np.sin(0.05), 0, 0, np.cos(0.05)))),
        (OnPlane(frame="tool", normal=(0, 0, 2.0), tolerance=2e-3), pose_matrix((5, 5, 2e-3), (0, 0, 0, 1))),
        (OnLine(frame="tool", direction=(0, 0, 1.0)), pose_matrix((6e-4, 8e-4, 7), (0, 0, 0, 1))),
        (FixedOrientation(frame="tool", angle=0.2), pose_matrix((1, 1, 1), (0, np.sin(0.1), 0, np.cos(0.1)))),
        (RelativePose(first="world", second="tool"), pose_matrix((0, 1e-3, 0), (0, 0, 0, 1))),
        (RelativePose(first="world", second="tool", free=("y", "rz")), pose_matrix((1e-3, 9, 0), (0, 0, 0.6, 0.8))),
        (ToolRegion(frame="tool", lower=(None, 0, -1), upper=(None, 2, 1)), pose_matrix((9, 2, 0), (0, 0, 0, 1))),
    ],
)
def test_violations_are_relative_to_the_tolerance(constraint: object, moved: Array) -> None:
    """Each pose is just at the tolerance of its constraint, by hand."""
    start = POSE | {"world": np.eye(4)}
    assert residual_of(constraint, start)({"tool": moved, "world": np.eye(4)}) == pytest.approx(1.0, abs=1e-6)


def test_the_dense_check_finds_a_short_violation_between_two_states(problem: Problem, robot: Robot) -> None:
    start = start_of(problem, robot)
    still = dense_check(robot, problem, np.stack([start, start]))
    assert still and still.violation < 1e-3
    moved = start.copy()
    moved[0] += 0.01  # the left shoulder alone opens the chain by up to 8 mm
    there_and_back = dense_check(robot, problem, np.stack([start, moved, start]))
    assert there_and_back.states >= 2 * 0.01 / DENSE and there_and_back.violation > 2.0 and not there_and_back
    opened = dense_check(
        robot, problem.model_copy(update={"attached": (), "constraints": ()}), np.stack([start, moved])
    )
    assert opened.violation == 0.0 and opened


def test_a_tray_closes_a_chain_beside_the_constraints(problem: Problem, robot: Robot) -> None:
    found = all_constraints(problem)
    assert [type(one) for one in found] == [RelativePose, Upright]
    poses = FrameReader(robot, problem)(start_of(problem, robot), (found[0].first, "tray"))
    np.testing.assert_allclose(poses["tray"][:3, 2], (0, 0, 1), atol=1e-4)


def test_every_level_has_problems_of_its_split() -> None:
    levels = constrained.levels_of([])
    assert len(levels) == sum(len(some) for some in CONSTRAINED.values()) == 15
    assert constrained.levels_of(["shelf", "unseen/cups"]) == ["shelf/tray", "shelf/level", "shelf/cups", "unseen/cups"]
    assert constrained.problems_of("shelf/tray", 2, tune=False) == ["shelf/tray/900000", "shelf/tray/900001"]
    first = 800_000 + constrained.TUNED_ON
    assert constrained.problems_of("unseen/tray", 1, tune=False) == [f"unseen/tray/{first}"]
    tuned = constrained.problems_of("unseen/tray", 99, tune=True)
    assert len(tuned) == constrained.TUNED_ON and tuned[-1] == f"unseen/tray/{first - 1}"
    assert sum(len(constrained.problems_of(v, 17, tune=False)) for v in levels if not v.startswith("unseen")) >= 200
    with pytest.raises(UnknownNameError, match="shelf/hard"):
        constrained.levels_of(["shelf/hard"])


def test_all_rivals_have_as_many_candidates_and_the_tuned_one_is_among_them() -> None:
    rivals = [row for row in constrained.ROWS if "apex" not in row.planner]
    assert [row.label for row in rivals] == list(constrained.CANDIDATES) == list(constrained.TUNED)
    for row in rivals:
        rows = constrained.candidates(row.label)
        assert len({one.label for one in rows}) == len(rows) == constrained.RUNGS[0][0]
        assert row.params in [one.params for one in rows] and not rows[0].params


def test_tuned_parameters_are_those_of_the_least_score() -> None:
    written = json.loads((ROOT / "benchmarks" / "results" / "constrained_tuning.json").read_text())
    assert written["about"]["split"] == "validation" and set(written["rows"]) == set(constrained.TUNED)
    for row in constrained.ROWS:
        if row.label in constrained.TUNED:
            last = {label: one["scores_s"][-1] for label, one in written["rows"][row.label].items()}
            chosen = min((score, label) for label, score in last.items() if score is not None)[1]
            assert Row.of(row.planner, constrained.TUNED[row.label]).label == chosen


def job(label: str, problem: str, **params: Any) -> Job:
    row = next(row for row in constrained.ROWS if row.label == label)
    return Job("", problem, label, row.planner, {**row.params, **params}, 0, 10.0, True, row.runner)


def test_runs_of_apex_and_cbirrt_have_paths_and_motions_that_passed_the_dense_check(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(REGISTRY, "cbirrt", constrained.CbirrtParameters)  # and out of it again
    for label in ("apex without network", "cbirrt"):
        run = constrained.plan_with_apex(job(label, "wall/tray/800000"))
        assert run["solved"] and not run["failed_check"] and 0.0 < run["violation"] < 1.0, run["reason"]
        assert 0.0 < run["first"] < run["total"] and run["duration"] >= run["direct"] > 0.0
    assert run["by"] == "trees on constraints"
    motions = constrained.motions_of_apex(job("apex without network", "wall/tray/800000", seeds=2))
    assert len(motions["violations"]) == 2 and not motions["faults"] and max(motions["violations"]) < 1.0


def run_of(label: str, problem: str, first: float | None, length: float = 2.0, **more: Any) -> dict[str, Any]:
    return {
        "label": label, "problem": problem, "solved": first is not None, "first": first, "total": first,
        "cpu": 0.5, "length": None if first is None else length, "failed_check": False, "violation": 0.5,
        "status": "", "reason": "", **more,
    }  # fmt: skip


def test_tables_compare_rows_on_the_same_problems(tmp_path: Path) -> None:
    a, b = "shelf/tray/900000", "wall/tray/900000"
    runs = [
        run_of("apex", a, 0.1, 3.0, duration=1.1, direct=1.0), run_of("apex", b, 0.3, duration=1.2, direct=1.0),
        run_of("cbirrt", a, 0.2, 4.0, duration=1.0, direct=1.0), run_of("cbirrt", b, None),
        run_of("roboplan", a, 0.4, 6.0),
        run_of("roboplan", b, None, status="NO_PROBLEM", reason="it has shapes that RoboPlan has not"),
    ]  # fmt: skip
    found, table = constrained.tabulate(Results(tmp_path, {}, runs), constrained.ROWS)
    apex, rival = found["groups"]["suites, apex"], found["groups"]["suites, roboplan"]
    assert apex["n"] == 2 and apex["first_s"] == [0.1, 0.3] and apex["pairs"] == 1
    assert apex["length_ratio"] == pytest.approx(0.75) and apex["duration_over_best"][0] == pytest.approx(1.05)
    assert (rival["n"], rival["left_out"], rival["solved"]) == (1, 1, 1.0)
    assert found["pairs"]["suites, roboplan"]["first_s"][0] == [0.4, 0.1]
    assert found["pairs"]["suites, cbirrt"]["solved"] == [1, 2]
    assert found["unsolved"] == [] and "shapes that RoboPlan has not" in table and "unseen" not in found["groups"]


def test_scores_count_unsolved_problems_twice() -> None:
    runs = [run_of("x", "a", 0.2, 3.0), run_of("x", "b", None)]
    assert constrained.score(runs, {"a": 2.0}, shortens=False) == pytest.approx(1.1)
    assert constrained.score(runs, {"a": 2.0}, shortens=True) == pytest.approx(1.1 * 1.75)


def test_the_clock_of_a_benchmark_on_a_busy_machine_leaves_out_sleep() -> None:
    code = "import time, benchmarks.planners.constrained_clock; s = time.perf_counter(); time.sleep(0.5)\n"
    code += "assert time.perf_counter() - s < 0.4"
    subprocess.run([sys.executable, "-c", code], check=True, cwd=Path(constrained.__file__).parents[2])


def test_the_arms_are_planned_without_the_hands(robot: Robot) -> None:
    class Ready:
        pass

    ready = Ready()
    ready.robot = robot  # type: ignore[attr-defined]
    assert arm_joints(ready).tolist() == list(range(14))  # type: ignore[arg-type]


PLANE = {  # made up, in the form of McVAMP's files
    "eef_transforms": [0.0, 1.0, 0.0, 0.0, 0.5, 0.1, 0.4],
    "tsr_lower_bound": [-10.0, -10.0, -1e-4, -1e-4, -1e-4, -1e-4],
    "tsr_upper_bound": [10.0, 10.0, 1e-4, 1e-4, 1e-4, 1e-4], "cuboid_obstacles": [[0.5, 0.2, 0.1, 0.01, 0.02, 0.03]],
    "problem_start": [0.0, -0.5, 0.0, -2.3, 0.0, 1.8, 2.95], "problem_end": [0.3, -0.5, 0.0, -2.3, 0.0, 1.8, 0.7],
}  # fmt: skip


@pytest.fixture
def clone(tmp_path: Path) -> Path:
    """A folder in the form of McVAMP's repository with a problem of each set."""
    folder, scene = tmp_path / "experiments/assets/problems/benchmark", tmp_path / constrained_mcvamp.MAZE
    folder.mkdir(parents=True)
    scene.parent.mkdir(parents=True)
    line = PLANE | {"tsr_lower_bound": [-1e-4, -10.0, -1e-4, 0, 0, 0], "tsr_upper_bound": [1e-4, 10.0, 1e-4, 0, 0, 0]}
    ends = {name: PLANE[name] for name in ("problem_start", "problem_end")}
    for kind, rows in {"plane": [PLANE], "line": [line], "maze": [ends]}.items():
        (folder / constrained_mcvamp.FILES[kind]).write_text(json.dumps(rows))
    wall = {"x": 0.4, "y": 0.0, "z": 0.1, "dx": 0.2, "dy": 0.02, "dz": 0.2, "yaw": np.pi / 2}
    scene.write_text(json.dumps([wall]))
    return tmp_path


def test_mcvamps_problems_are_read_from_a_clone(clone: Path, tmp_path: Path) -> None:
    robot = constrained_mcvamp.robot_file(tmp_path / "robot")
    plane, line, maze = (next(constrained_mcvamp.problems_of(clone, kind, robot)) for kind in constrained_mcvamp.FILES)
    on_plane = plane.constraints[0]
    assert isinstance(on_plane, OnPlane) and on_plane.point == (0.5, 0.1, 0.4)
    np.testing.assert_allclose(np.abs(on_plane.normal), (0, 0, 1), atol=1e-12)
    assert plane.scene[0].box == (0.02, 0.04, 0.06) and plane.start["panda_joint7"] == 2.95
    assert isinstance(line.constraints[0], OnLine)
    np.testing.assert_allclose(np.abs(line.constraints[0].direction), (0, 1, 0), atol=1e-12)
    region, upright = maze.constraints
    assert isinstance(region, ToolRegion) and isinstance(upright, Upright) and upright.up[2] == pytest.approx(-1.0)
    assert len(maze.attached) == 9 and maze.attached[-1].position[2] == pytest.approx(0.105 + 0.16)
    np.testing.assert_allclose(maze.scene[0].pose[:3, 0], (0, 1, 0), atol=1e-12)
    with pytest.raises(ApexError, match="expected a clone of McVAMP"):
        next(constrained_mcvamp.problems_of(tmp_path / "nowhere", "plane", robot))


def test_the_panda_of_mcvamp_has_wider_limits(tmp_path: Path) -> None:
    path = constrained_mcvamp.robot_file(tmp_path)
    assert yaml.safe_load(path.read_text())["name"] == "panda_mcvamp"
    ours, theirs = load_robot("panda"), load_robot(str(path))
    assert (theirs.limits.lower < ours.limits.lower).all() and (theirs.limits.upper > ours.limits.upper).all()
    assert theirs.hands["hand"].point[2] == 0.105
