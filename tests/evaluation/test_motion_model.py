"""The benchmark of models trained on motions: its data, the runs of proposals, and the comparison of rows."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from support import DATA, benchmark_script

from apex_ompl.collision import CollisionChecker
from apex_ompl.ompl.setup import assemble
from apex_ompl.paths.spline import Spline
from apex_ompl.problems import load
from apex_ompl.problems.suite_robot import robot
from apex_ompl.timing.duration import DurationOptimizer
from apex_ompl.training import load as load_paths
from apex_ompl.training.store import Store

PROBLEM = "wall/easy/800000"


@pytest.fixture(scope="module")
def made() -> ModuleType:
    return benchmark_script("model.motion_data")


@pytest.fixture(scope="module")
def script() -> ModuleType:
    return benchmark_script("model.motion_model")


@pytest.mark.parametrize("ramp", [0.05, 0.2, 0.5])
def test_the_scale_of_time_is_that_of_ramps_of_speed_and_has_an_inverse(made: ModuleType, ramp: float) -> None:
    time = np.linspace(0.0, 1.0, 100_001)
    speed = np.minimum(1.0, np.minimum(time, 1.0 - time) / ramp)
    way = np.append(0.0, np.cumsum((speed[1:] + speed[:-1]) / 2))
    np.testing.assert_allclose(made.ramped(time, ramp), way / way[-1], atol=1e-9)
    np.testing.assert_allclose(made.times_of(made.ramped(time, ramp), ramp), time, atol=1e-7)


def test_control_points_of_a_motion_give_it_back(made: ModuleType) -> None:
    machine, spline = robot(), Spline()
    states = np.stack([machine.home, machine.home + np.where(np.arange(machine.dof) < 7, 0.4, 0.0)])
    found = DurationOptimizer(CollisionChecker(machine).kernel, machine.limits).fastest(states)
    assert found is not None
    motion = found.trajectory(machine.joint_names)
    control, deviation = made.control_of(motion, spline)
    again = made.states_in_time(control, spline)
    wanted = motion(np.linspace(0.0, motion.duration, made.STATES))
    moved = np.abs(wanted - np.linspace(*states, made.STATES)).max()
    assert np.abs(again - wanted).max() < 1.05 * deviation + 1e-3 < 0.1 * moved
    np.testing.assert_array_equal(control[[0, -1]], states)


def test_motions_and_their_paths_are_kept_side_by_side(made: ModuleType, tmp_path: Path) -> None:
    source = DATA / "paths.zip"
    assert list(made.make(source, tmp_path, 2)) == ["0000"]
    motions, paths = (Store(tmp_path / name).read("0000") for name in (made.MOTIONS, made.PATHS))
    whole = load_paths(source)
    known = {(start.tobytes(), goal.tobytes()) for start, goal in zip(whole.start, whole.goal, strict=True)}
    assert len(motions) == len(paths) > 0 and motions.problems == paths.problems == 2
    np.testing.assert_array_equal(motions.start, paths.start)
    np.testing.assert_array_equal(motions.goal, paths.goal)
    assert {(start.tobytes(), goal.tobytes()) for start, goal in zip(paths.start, paths.goal, strict=True)} <= known
    assert not np.array_equal(motions.control(), paths.control())
    before = (tmp_path / made.MOTIONS / "units" / "0000.zip").stat().st_mtime_ns
    assert list(made.make(source, tmp_path, 2)) == ["0000"]
    assert (tmp_path / made.MOTIONS / "units" / "0000.zip").stat().st_mtime_ns == before
    found = made.statistics(tmp_path)
    assert found.kept == len(motions) <= found.tried and (found.duration > 0.999).all()


def test_a_guess_in_time_keeps_the_states(script: ModuleType) -> None:
    runs = benchmark_script("model.motion_runs")
    setup = assemble(load(PROBLEM), robot())
    optimizer = runs.MotionOptimizer(setup.checker.kernel, setup.robot.limits)
    share = np.linspace(0.0, 1.0, 257)[:, None] ** 2  # slow at first
    states = setup.start + share * (setup.goals[0] - setup.start)
    guess = optimizer._guess(states)
    count = len(guess.control) - 5  # three control points are the start, three are the goal
    wanted = setup.start + np.linspace(0.0, 1.0, count + 1)[:, None] ** 2 * (setup.goals[0] - setup.start)
    np.testing.assert_allclose(guess.control[2:-2], wanted, atol=1e-4)
    as_path = DurationOptimizer(setup.checker.kernel, setup.robot.limits)._guess(states)
    assert as_path is not None and as_path.spans == guess.spans


def run(label: str, problem: str, duration: float, cpu: float, solved: bool = True) -> dict[str, object]:
    seed = "abc".index(problem)
    return {"label": label, "problem": problem, "seed": seed, "duration": duration, "cpu": cpu, "solved": solved}


def test_rows_are_compared_on_the_runs_that_both_solved(script: ModuleType) -> None:
    runs = [
        run("one", "a", 1.0, 0.2), run("two", "a", 2.0, 0.1), run("one", "b", 3.0, 0.1),
        run("two", "b", 3.0, 0.2), run("one", "c", 1.0, 1.0), run("two", "c", 1.0, 1.0, False),
    ]  # fmt: skip
    found = dict(zip(script.PAIRED_HEAD, script.paired(runs, "one", "two", "cpu"), strict=True))
    assert (found["both solved"], found["alone solved"], found["the other alone"]) == (2, 1, 0)
    assert found["duration ratio"] == f"{np.sqrt(0.5):.4f}" and found["CPU ratio"] == "1.000"
    assert (found["shorter by 1 %"], found["longer by 1 %"]) == (1, 0)


def test_the_interval_counts_problems_once(script: ModuleType) -> None:
    rng = np.random.default_rng(1)
    logs = {(str(k), 0): float(v) for k, v in enumerate(rng.normal(0.1, 0.2, 400))}
    mean, low, high = np.log(script.interval(logs))
    assert mean == pytest.approx(np.mean(list(logs.values())))
    assert high - low == pytest.approx(2 * 1.96 * 0.2 / np.sqrt(400), rel=0.15)
    twice = np.log(script.interval(logs | {(problem, 1): value for (problem, _), value in logs.items()}))
    np.testing.assert_allclose(twice, (mean, low, high), atol=1e-12)


def test_a_motion_that_cannot_be_proved_is_left_out(made: ModuleType) -> None:
    setup = assemble(load(PROBLEM), robot())
    optimizer = DurationOptimizer(setup.checker.kernel, setup.robot.limits)
    states = np.stack([setup.start, setup.goals[0]])
    assert made.proved(setup, optimizer, states, setup.goals[0] + 0.1) is None
    assert made.proved(setup, optimizer, states[:1], setup.start) is None
