from __future__ import annotations

import signal
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest
from ompl import base as ob
from ompl import util as ou
from support import ROOT

import apex_ompl
from apex_ompl import MotionPlanner, PlanStatus, load_problem, plan, planners
from apex_ompl.collision import CollisionChecker
from apex_ompl.errors import FileFormatError, ParameterError, UnknownNameError
from apex_ompl.ompl.process import seed_ompl
from apex_ompl.ompl.repair import repair
from apex_ompl.ompl.setup import assemble
from apex_ompl.ompl.space import path_to_array
from apex_ompl.ompl.validity import FullCheck, full_check
from apex_ompl.paths.path import path_length, resample
from apex_ompl.planning import steps
from apex_ompl.robot import Robot, load_robot
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.scene.problem import Goal, Problem

BAXTER = ROOT / "examples" / "baxter_table.yaml"


@pytest.mark.parametrize("name", ["shelf_swap", "reach_past_post", BAXTER])
def test_shipped_problems_are_solved_and_proved(name: str | Path) -> None:
    problem = load_problem(name)
    result = plan(problem, timeout=20.0, seed=1)
    assert result and result.status is PlanStatus.EXACT_SOLUTION and result.reason == ""
    robot = load_robot(problem.robot)
    assert result.path is not None and result.path.dof == robot.dof
    start, goals = problem.start_state(robot.joint_names), problem.goal_states(robot.joint_names)
    assert np.array_equal(result.path[0], start) and np.array_equal(result.path[-1], goals[0])
    # Checked anew by a fresh checker, on a grid that the planner did not use.
    check = full_check(CollisionChecker(robot, problem.scene, problem.attached), result.path, start, goals)
    assert check, check.reason
    assert result.length == pytest.approx(path_length(result.path.states)) and result.length < 40
    assert result.clearance > 0.0 and result.checks > 100
    without_model = problem.robot != "dual_panda_softhand"
    assert result.planner == "apex" and result.solved_by
    assert any("no model of" in note for note in result.notes) == without_model
    assert {"setup", "solve", "verify", "total"} <= set(result.times)
    assert not full_check(CollisionChecker(robot, problem.scene), np.array([start, goals[0]])), (
        "the straight line is too easy"
    )


@pytest.mark.parametrize(
    ("planner", "params"),
    [("rrtconnect", {}), ("kpiece1", {}), ("fmt", {"num_samples": 300}), ("bfmt", {"num_samples": 300})],
)
def test_the_same_seed_gives_the_same_path_in_one_process(planner: str, params: dict, problem: Problem) -> None:
    raw = [plan(problem, planner, timeout=300.0, seed=seed, params=params, simplify=False) for seed in (5, 5, 6)]
    pairs = [raw[:2]]
    if planner == "rrtconnect":  # simplification is the same for all
        pairs.append([plan(problem, planner, timeout=300.0, seed=5) for _ in range(2)])
    for first, second in pairs:
        assert first and second
        assert np.array_equal(first.path, second.path)
    assert not np.array_equal(raw[0].path, raw[2].path), "the seed must matter, or this test shows nothing"


@pytest.mark.parametrize("planner", ["bkpiece1", "lbkpiece1"])
def test_the_same_seed_gives_one_arm_the_same_path(planner: str, problem: Problem) -> None:
    """With both arms and hands these take minutes."""
    options = {"timeout": 300.0, "simplify": False, "group": "left_arm"}
    with MotionPlanner(problem.robot) as session:
        session.world.add(*problem.scene)
        goal = problem.goal.joints[0]
        first, second, other = (session.plan(problem.start, goal, planner, seed=seed, **options) for seed in (5, 5, 6))
    assert first and second
    assert np.array_equal(first.path, second.path)
    assert not np.array_equal(first.path, other.path), "the seed must matter, or this test shows nothing"


def test_the_same_seed_gives_the_same_tree_for_rrt(problem: Problem) -> None:
    """RRT is too weak for the post in so many dimensions, and ``plan`` needs no planner on its near side."""
    near = dict(problem.goal.joints[0], left_joint1=-0.4)
    problem = problem.model_copy(update={"goal": Goal(joints=(near,))})
    paths = []
    for seed in (6, 6, 7):
        seed_ompl(seed)
        simple_setup = assemble(problem).simple_setup
        simple_setup.setPlanner(planners.make("rrt", simple_setup.getSpaceInformation(), range=0.2, goal_bias=0.2))
        status = simple_setup.solve(ob.timedPlannerTerminationCondition(30.0))
        assert status.getStatus() == ob.PlannerStatus.EXACT_SOLUTION
        paths.append(path_to_array(simple_setup.getSolutionPath(), len(near)))
    assert np.array_equal(paths[0], paths[1]) and not np.array_equal(paths[0], paths[2])


def test_the_same_seed_gives_the_same_path_in_two_processes(tmp_path: Path) -> None:
    code = "import apex_ompl, sys; apex_ompl.plan('reach_past_post', seed=11, timeout=30.0).save(sys.argv[1])"
    paths = []
    for k in range(2):
        file = tmp_path / f"{k}.npz"
        subprocess.run([sys.executable, "-c", code, file], check=True, timeout=120, cwd=tmp_path)
        paths.append(np.load(file)["path"])
    here = plan("reach_past_post", seed=11, timeout=30.0).path
    assert here is not None
    assert np.array_equal(paths[0], paths[1]) and np.array_equal(paths[0], here)


def changed_start(problem: Problem, **joints: float) -> Problem:
    return problem.model_copy(update={"start": {**problem.start, **joints}})


def test_invalid_start_and_goal_say_why(problem: Problem, robot: Robot) -> None:
    result = plan(changed_start(problem, left_joint4=0.5))
    assert not result and result.status is PlanStatus.INVALID_START and result.path is None
    assert result.reason == "left_joint4 = 0.5 is outside its limits [-3.0718, -0.0698]"
    result = plan(changed_start(problem, left_joint1=-0.9))
    assert result.status is PlanStatus.INVALID_START
    assert "<-> post, " in result.reason and result.reason.endswith("mm deep")
    bad = dict(problem.goal.joints[0], right_joint2=1.7, right_joint4=-0.3)
    result = plan(problem.model_copy(update={"goal": Goal(joints=(bad,))}))
    assert result.status is PlanStatus.INVALID_GOAL and "table_right" in result.reason
    either = plan(problem.model_copy(update={"goal": Goal(joints=(bad, problem.goal.joints[0]))}), timeout=20.0)
    assert either and np.array_equal(either.path[-1], problem.goal_states(robot.joint_names)[0])


def test_no_plan_is_a_status_with_a_reason(problem: Problem) -> None:
    cage = [
        Obstacle(name=f"wall{k}", box=(0.02, 0.5, 1.5), position=(0.35 + 0.0 * k, y, 0.75))
        for k, y in enumerate((0.25, -0.25))
    ]
    closed = problem.model_copy(update={"scene": tuple([*problem.scene, *cage])})
    result = plan(closed, timeout=0.5)
    assert not result and result.status in (PlanStatus.TIMEOUT, PlanStatus.INVALID_START, PlanStatus.INVALID_GOAL)
    result = plan("shelf_swap", "rrt", timeout=0.2)
    assert result.status is PlanStatus.APPROXIMATE_SOLUTION and "rad from the goal" in result.reason
    assert result.path is not None and not result
    assert plan("shelf_swap", timeout=1e-5).status is PlanStatus.TIMEOUT


@pytest.mark.parametrize("planner", planners.names())
def test_a_goal_in_a_straight_line_or_at_the_start_needs_no_planner(planner: str, problem: Problem) -> None:
    """Several of OMPL's planners hang, raise or give up on these."""
    near = dict(problem.start, left_joint1=problem.start["left_joint1"] + 1e-17, right_joint1=0.2)
    for goals in [(problem.start,), (near,), (near, problem.start)]:
        result = plan(problem.model_copy(update={"goal": Goal(joints=goals)}), planner, timeout=10.0)
        assert result and result.solved_by == "straight line" and len(result.path) == 2


@pytest.mark.parametrize("planner", ["prm", "prmstar", "rrtconnect", "rrtstar", "bitstar"])
def test_several_goals_never_hang(planner: str, problem: Problem, tmp_path: Path) -> None:
    """In a process of its own: OMPL's threaded planners deadlock over several goals."""
    other = dict(problem.goal.joints[0], right_joint1=0.3)
    problem.model_copy(update={"goal": Goal(joints=(*problem.goal.joints, other))}).save(tmp_path / "p.yaml")
    command = [sys.executable, "-m", "apex_ompl.cli", "plan", tmp_path / "p.yaml", "--planner", planner]
    done = subprocess.run([*command, "--timeout", "1"], check=False, capture_output=True, text=True, timeout=30)
    assert done.returncode in (0, 1, 4), done.stderr
    if planner.startswith("prm"):
        assert "takes one goal: the nearest of 2" in done.stdout


@pytest.mark.parametrize("stage", ["shorten", "repair"])
def test_ctrl_c_after_the_search_is_not_lost(stage: str, problem: Problem, monkeypatch: pytest.MonkeyPatch) -> None:
    honest = getattr(steps, stage)

    def pressed(*args: object) -> object:
        signal.raise_signal(signal.SIGINT)
        return honest(*args)

    monkeypatch.setattr(steps, stage, pressed)
    if stage == "repair":
        monkeypatch.setattr(steps, "full_check", lambda *_, **__: FullCheck(False, "on purpose", 0))
    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        plan(problem, "rrtconnect", timeout=20.0)
    assert signal.getsignal(signal.SIGINT) is before


def test_a_huge_timeout_is_long(problem: Problem) -> None:
    assert plan(problem, timeout=1e300)


def test_plans_in_threads_leave_ompls_log_level_alone(problem: Problem) -> None:
    before = ou.getLogLevel()
    threads = [threading.Thread(target=plan, args=(problem,), kwargs={"timeout": 20.0}) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    assert ou.getLogLevel() == before


def test_a_broken_checker_is_a_crash_status(problem: Problem, monkeypatch: pytest.MonkeyPatch) -> None:
    calls = iter(range(10**9))
    honest = CollisionChecker.first_collision

    def breaks(self: CollisionChecker, *arguments: object, **options: object) -> object:
        if next(calls) > 3:
            raise RuntimeError("broken on purpose")
        return honest(self, *arguments, **options)

    monkeypatch.setattr(CollisionChecker, "first_collision", breaks)
    result = plan(problem, "rrtconnect", timeout=0.5)
    assert result.status is PlanStatus.CRASH and "broken on purpose" in result.reason


@pytest.mark.parametrize(
    ("options", "error", "match"),
    [
        ({"timeout": 0.0}, ParameterError, "timeout: expected a positive number of seconds, got 0.0"),
        ({"timeout": -1}, ParameterError, "timeout"),
        ({"timeout": float("nan")}, ParameterError, "timeout"),
        ({"timeout": float("inf")}, ParameterError, "timeout"),
        ({"timeout": "long"}, ParameterError, "timeout"),
        ({"seed": -1}, ParameterError, "seed: expected a whole number"),
        ({"seed": 1.5}, ParameterError, "seed"),
        ({"planner": "rrtconect"}, UnknownNameError, "did you mean 'rrtconnect'"),
        ({"params": {"rnge": 1}}, UnknownNameError, "did you mean 'range'"),
        ({"timeout": 10**400}, ParameterError, "timeout: expected a positive number of seconds, got 1000"),
        ({"leave_contact": -(10**400)}, ParameterError, "leave_contact: expected a number from 0 to 0.001, got -1000"),
        ({"seed": 10**400}, ParameterError, "seed: expected a whole number from 0 to 2147483647, got 1000"),
        ({"planner": 5}, UnknownNameError, "unknown planner 5; known: .*rrtconnect"),
        ({"planner": ["apex"]}, UnknownNameError, r"unknown planner \['apex'\]; known: .*rrtconnect"),
        ({"params": {5: 1}}, ParameterError, "params: expected values by name of parameter, got {5: 1}"),
        ({"params": "range=1"}, ParameterError, "params: expected values by name of parameter, got 'range=1'"),
        ({"params": [1]}, ParameterError, r"params: expected values by name of parameter, got \[1\]"),
        ({"params": {"range": 10**400}}, ParameterError, r"parameter 'range': expected a number in \[0, inf\]"),
        ({"simplify": "false"}, ParameterError, "simplify: expected True or False, got 'false'"),
        ({"snapshot": None}, ParameterError, "snapshot: expected True or False, got None"),
    ],
)
def test_faulty_arguments_are_named(problem: Problem, options: dict, error: type[Exception], match: str) -> None:
    with pytest.raises(error, match=match):
        plan(problem, **options)


def test_wrong_joints_and_robots_are_named(problem: Problem) -> None:
    with pytest.raises(FileFormatError, match="left_jiont1"):
        plan(problem.model_copy(update={"start": {"left_jiont1": 0.0}}))
    with pytest.raises(UnknownNameError, match="unknown robot 'dual_panda', did you mean 'dual_panda_softhand'"):
        plan(problem.model_copy(update={"robot": "dual_panda"}))


def test_a_path_that_fails_the_full_check_is_repaired(problem: Problem) -> None:
    """The straight line through the post, as if a planner had missed the collision."""
    ready = assemble(problem)
    path = np.array([ready.start, ready.goals[0]])
    fault = full_check(ready.checker, path, ready.start, ready.goals)
    assert not fault
    import time

    mended = repair(ready, path, fault, time.perf_counter() + 30.0)
    assert mended is not None and full_check(ready.checker, mended[0].states, ready.start, ready.goals)
    assert repair(ready, path, fault, time.perf_counter() - 1.0) is None


def test_repair_goes_past_states_that_collide_themselves(problem: Problem) -> None:
    ready = assemble(problem)
    line = resample(np.array([ready.start, ready.goals[0]]), 9)
    fault = full_check(ready.checker, line, ready.start, ready.goals)
    assert not fault and not all(ready.checker.is_free(q) for q in line)
    import time

    mended = repair(ready, line, fault, time.perf_counter() + 30.0)
    assert mended is not None and full_check(ready.checker, mended[0].states, ready.start, ready.goals)


def test_two_plans_run_in_two_threads(problem: Problem) -> None:
    results: dict[int, object] = {}
    threads = [
        threading.Thread(target=lambda k=k: results.__setitem__(k, plan(problem, timeout=20.0, seed=k)))
        for k in range(2)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    assert all(results.values()) and len(results) == 2


def test_importing_the_package_is_light() -> None:
    code = "import sys, apex_ompl; print([m for m in ('torch', 'ompl', 'pinocchio', 'numpy') if m in sys.modules])"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert found.stdout.strip() == "[]"
    assert set(apex_ompl.__all__) <= set(dir(apex_ompl))
    with pytest.raises(AttributeError, match="nothing"):
        _ = apex_ompl.nothing
    for name in apex_ompl.__all__:
        assert getattr(apex_ompl, name) is not None


@pytest.mark.parametrize("count", [2, 5, 32])
def test_resampling_is_even_by_length(count: int) -> None:
    path = np.array([[0.0, 0.0], [3.0, 4.0], [3.0, 5.0]])
    states = resample(path, count)
    assert np.array_equal(states[[0, -1]], path[[0, -1]])
    along = [q[0] / 3 * 5 if q[0] < 3 else 5 + (q[1] - 4) for q in states]
    np.testing.assert_allclose(along, np.linspace(0, 6, count))
