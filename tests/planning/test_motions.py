"""The motion of a plan by its objective: faster, calmer or along the path, and one curve for path, motion and proof."""

from __future__ import annotations

import json

import numpy as np
import pytest
from ompl import base as ob
from ompl import geometric as og
from planning import cached_problem

from apex_ompl import MotionPlanner, plan
from apex_ompl.cli import main
from apex_ompl.collision import CollisionChecker
from apex_ompl.errors import ParameterError, TimingError, TimingStoppedError, UnknownNameError
from apex_ompl.planning import steps
from apex_ompl.result import PlanResult
from apex_ompl.scene.scripts import problem_at
from apex_ompl.timing import Timing

NAME = "shelf/hard/800020"


@pytest.fixture(scope="module")
def results() -> dict[str, PlanResult]:
    problem = cached_problem(NAME)
    return {name: plan(problem, seed=1, timeout=20.0, objective=name) for name in ("time", "length", "calm")}


def test_each_objective_has_its_own(results: dict[str, PlanResult]) -> None:
    fast, short, calm = (results[name] for name in ("time", "length", "calm"))
    assert fast and short and calm and fast.trajectory and short.trajectory and calm.trajectory
    assert fast.trajectory.duration < 0.97 * short.trajectory.duration and short.length < fast.length
    assert calm.trajectory.duration == pytest.approx(1.1 * fast.trajectory.duration, rel=1e-3)
    assert calm.trajectory.jerk < 0.6 * fast.trajectory.jerk
    assert fast.deviation == calm.deviation == 0.0 < short.deviation


def test_path_and_motion_are_one_curve_and_free_at_dense_states(results: dict[str, PlanResult]) -> None:
    problem = problem_at(cached_problem(NAME), 0.0)
    for name in ("time", "calm"):
        result = results[name]
        motion, path = result.trajectory, result.path
        assert motion is not None and path is not None
        times = np.linspace(0.0, motion.duration, len(path.states))
        np.testing.assert_allclose(motion(times), path.states, atol=1e-9)
        assert result.limit_use["velocity"] <= 1.0 + 1e-9 and result.limit_use["torque"] <= 1.0
        from apex_ompl.robot import load_robot

        checker = CollisionChecker(load_robot(problem.robot), problem.scene, problem.attached, problem.allowed)
        assert checker.are_free(motion.sample(1e-3).position).all()


def test_every_planner_and_less_time(results: dict[str, PlanResult]) -> None:
    for planner in ("rrtconnect", "rrtconnect+polish", og.RRTConnect):
        fast, short = (
            plan(cached_problem(NAME), planner, seed=1, timeout=20.0, objective=o) for o in ("time", "length")
        )
        assert fast and short and fast.trajectory and short.trajectory
        assert fast.trajectory.duration < short.trajectory.duration
    slow = plan(cached_problem(NAME), seed=1, timeout=20.0, timing=Timing(minimum_duration=4.0))
    assert slow and slow.trajectory is not None and slow.trajectory.duration == pytest.approx(4.0, abs=1e-6)
    half = plan(cached_problem(NAME), seed=1, timeout=20.0, timing=Timing(velocity_scale=0.5))
    assert half and half.trajectory is not None and half.limit_use["velocity"] <= 0.5 + 1e-9
    assert half.trajectory.duration > results["time"].trajectory.duration  # type: ignore[union-attr]


def test_a_start_that_moves_is_timed_along_the_path() -> None:
    velocity = np.zeros(16)
    velocity[0] = 0.05
    result = plan(cached_problem(NAME), seed=1, timeout=20.0, timing=Timing(start_velocity=velocity.tolist()))
    assert result and result.trajectory is not None
    np.testing.assert_allclose(result.trajectory.velocities[0], velocity)


@pytest.mark.parametrize("error", [TimingError, TimingStoppedError])
def test_an_optimized_motion_stays_where_the_straight_line_cannot_be_timed(
    error: type[Exception], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*args: object, **options: object) -> None:
        raise error("on purpose")

    planner = MotionPlanner()
    home, goal = planner.robot.home, planner.robot.home.copy()
    goal[[0, 7]] += 0.4, -0.3
    assert planner.plan(home, goal, timeout=20.0).solved_by == "straight line"
    monkeypatch.setattr(steps, "time_path", fails)
    result = planner.plan(home, goal, timeout=20.0)
    assert result and result.trajectory is not None and result.deviation == 0.0
    assert not planner.plan(home, goal, timeout=20.0, objective="length")


def test_a_checker_of_the_users_decides_what_its_motion_is_along() -> None:
    """What it forbids this project's optimizer does not know: the motion follows the path."""
    asked = 0

    def planner(si: ob.SpaceInformation) -> og.RRTConnect:
        def valid(state: ob.State) -> bool:
            nonlocal asked
            asked += 1
            return checker.are_free(np.array([[state[k] for k in range(16)]]))[0] and state[15] < 0.9

        checker = si.getStateValidityChecker().checker
        si.setStateValidityChecker(valid)
        return og.RRTConnect(si)

    result = plan(cached_problem(NAME), planner, seed=1, timeout=30.0)
    assert result and asked and result.trajectory is not None and result.trajectory.positions[:, 15].max() < 0.9
    assert result.deviation > 0.0 and "optimized" not in result.timing_method


def test_faulty_objectives(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(UnknownNameError, match="unknown objective 'fast'"):
        plan(cached_problem(NAME), objective="fast")
    for factor in (0.5, float("nan"), "x"):
        with pytest.raises(ParameterError, match="calm_factor"):
            plan(cached_problem(NAME), objective="calm", calm_factor=factor)  # type: ignore[arg-type]
    assert main(["plan", NAME, "--objective", "fast"]) == 2
    assert "unknown objective 'fast'" in capsys.readouterr().err
    assert main(["plan", NAME, "--objective", "calm", "--calm-factor", "1.5", "--seed", "1", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["timing_method"].startswith("ruckig")
