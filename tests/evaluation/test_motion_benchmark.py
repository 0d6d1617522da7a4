"""The benchmark of motions: its reader and follower of saved motions, figures, goals, search and tables."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import BPoly
from support import benchmark_script

from apex_ompl import load_problem
from apex_ompl.evaluation.rows import Job
from apex_ompl.goals.alignment import within
from apex_ompl.ompl.setup import assemble, workspace_goal
from apex_ompl.problems.suite_robot import robot
from apex_ompl.timing import Trajectory

PROBLEM = "wall/easy/800000"


@pytest.fixture(scope="module")
def rows() -> ModuleType:
    return benchmark_script("timing.motion_rows")


@pytest.fixture(scope="module")
def exported() -> ModuleType:
    return benchmark_script("timing.exported_motions")


def job(runner: str, problem: str = PROBLEM, **params: object) -> Job:
    return Job("test", problem, "row", "apex", params, 0, 10.0, True, runner)


def points_of(exported: ModuleType, seed: int, count: int = 5) -> tuple[np.ndarray, object]:
    rng = np.random.default_rng(seed)
    whole = np.append(0, np.cumsum(rng.integers(1_000_000, 50_000_000, count - 1)))
    return whole / 1e9, exported.Points(
        whole, rng.normal(size=(3, count, 2)) * [[[1.0]], [[2.0]], [[20.0]]], ("a", "b")
    )


@given(seed=st.integers(0, 1000))
def test_a_controller_follows_quintic_polynomials(seed: int) -> None:
    exported = benchmark_script("timing.exported_motions")
    times, points = points_of(exported, seed)
    reference = BPoly.from_derivatives(times, np.moveaxis(points.states, 0, 1))
    dense = np.unique(np.concatenate([np.linspace(a, b, 400) for a, b in zip(times[:-1], times[1:], strict=True)]))
    wanted = [np.abs(reference(dense[:-1], order)).max(axis=0) for order in (1, 2, 3)]
    found = exported.largest(points)
    assert np.all(found >= np.array(wanted) * [[1.0 - 1e-2], [1.0 - 1e-9], [1.0 - 1e-9]])
    assert found == pytest.approx(np.array(wanted), rel=2e-2)
    states = exported.followed(points, 0.01)
    assert np.abs(np.diff(states, axis=0)).max() <= 0.0101
    assert states[0] == pytest.approx(points.states[0, 0]) and states[-1] == pytest.approx(points.states[0, -1])
    shares = np.linspace(0.0, 0.99, 7)
    at = times[:-1, None] + np.diff(times)[:, None] * shares
    for order in range(4):
        values = exported.evaluated(*exported.quintics(points), shares, order)
        assert values == pytest.approx(reference(at, order), rel=1e-6, abs=1e-6 * np.abs(values).max())


@pytest.mark.parametrize("suffix", [".npz", ".csv", ".traj.yaml", ".traj.json"])
def test_every_format_is_read_back(suffix: str, tmp_path: Path, exported: ModuleType) -> None:
    jerks = np.array([[2.0, -1.0], [-2.0, 1.0], [-2.0, 1.0], [2.0, -1.0]])  # from rest to rest
    state, states = np.zeros((3, 2)), [np.zeros((3, 2))]
    for jerk in jerks:
        q, v, a = state
        state = np.array([q + v / 2 + a / 8 + jerk / 48, v + a / 2 + jerk / 8, a + jerk / 2])
        states.append(state)
    motion = Trajectory(np.arange(5) / 2, *np.stack(states, axis=1), ("a", "b"))
    motion.save(tmp_path / f"motion{suffix}")
    points = exported.read_points(tmp_path / f"motion{suffix}")
    assert points.joints == ("a", "b") and points.nanoseconds.tolist() == [
        0,
        500_000_000,
        10**9,
        1_500_000_000,
        2 * 10**9,
    ]
    assert exported.largest(points) == pytest.approx(np.array([[0.5, 0.25], [1.0, 0.5], [2.0, 1.0]]))
    dense = exported.followed(points, 1e-3)
    assert np.abs(dense[-1] - motion.positions[-1]).max() < 1e-12 and len(dense) > 400


def test_times_that_do_not_increase_are_refused(exported: ModuleType) -> None:
    with pytest.raises(ValueError, match="do not increase"):
        exported.largest(exported.Points(np.array([0, 5, 5]), np.zeros((3, 3, 1)), ("a",)))


def test_pulses_jerk_and_torque_of_a_motion() -> None:
    figures, machine = benchmark_script("timing.motion_figures"), robot()
    times = np.array([0.0, 0.25, 0.75, 1.0])
    acceleration, limit = 4.0 * np.array([0.0, 1.0, -1.0, 0.0]), machine.limits.acceleration[0]
    velocity = np.append(0.0, np.cumsum(np.diff(times) * (acceleration[1:] + acceleration[:-1]) / 2))
    steps = np.diff(times)
    moves = steps * velocity[:-1] + steps**2 * (2 * acceleration[:-1] + acceleration[1:]) / 6
    states = np.zeros((3, 4, machine.dof))
    states[0] = machine.home
    states[0, :, 0] += np.append(0.0, np.cumsum(moves))
    states[1, :, 0], states[2, :, 0] = velocity, acceleration
    motion = Trajectory(times, *states, machine.joint_names)
    found = figures.smoothness(motion, machine.limits)
    assert found.pulses.tolist() == [0.0] * 14, "4 of 15 rad/s^2 is no pulse"
    sharp = figures.smoothness(motion, replace(machine.limits, acceleration=np.full(machine.dof, 4.0)))
    assert sharp.pulses.tolist() == [2.0, *[0.0] * 13] and found.knots == 3.0
    jerk = np.sqrt(np.mean(np.square([16.0, 16.0]))) / machine.limits.jerk[0] / np.sqrt(14)
    assert found.rms_jerk == pytest.approx(jerk) and limit == 15.0

    still = Trajectory(
        np.array([0.0, 1.0]), *np.stack([[machine.home] * 2, *np.zeros((2, 2, machine.dof))]), machine.joint_names
    )
    gravity = {}
    for payload in (0.0, 2.0):
        gravity[payload] = figures.torque_use(still, machine, payload)
        model = figures.loaded_model(machine, payload)
        data, q = model.createData(), machine.to_pinocchio(machine.home)
        torque = np.abs(pin.computeGeneralizedGravity(model, data, q))
        arms = [k for k, name in enumerate(machine.to_pinocchio(np.arange(16.0)).astype(int)) if name < 14]
        assert gravity[payload] == pytest.approx((torque / model.effortLimit)[arms].max(), rel=1e-9)
        mass = pin.computeTotalMass(model) - pin.computeTotalMass(machine.model)
        assert mass == pytest.approx(2 * payload)
    assert gravity[2.0] > gravity[0.0]


@pytest.mark.parametrize("kind", ["alignment", "pose"])
def test_goals_are_the_alignment_or_the_poses_at_the_goal(kind: str, rows: ModuleType) -> None:
    given_problem = load_problem("horizontal/large/800000" if kind == "alignment" else "shelf/hard/800000")
    setup = assemble(given_problem, robot())
    problem = rows.with_goal(given_problem, kind)
    goal = workspace_goal(robot(), problem)
    errors = goal.errors(setup.goals[0])
    assert errors and within(errors, goal.bounds)
    assert rows.with_goal(given_problem, "given") is given_problem


def test_rows_make_runs_for_tables(rows: ModuleType) -> None:
    motions, runs = benchmark_script("timing.motions"), []
    for label in ("length", "time"):
        made = rows.by_plan(job("x", objective=label))
        assert made["solved"] and made["duration"] >= made["direct"] > 0.0 and made["cpu"] > made["motion_cpu"] > 0.0
        about = {"problem": PROBLEM, "label": label, "experiment": "wall/easy", "seed": 0}
        runs.append(json.loads(json.dumps(about | made)))
    best = motions.best_known(runs, ["length", "time"])
    line = motions.duration_row("hard", "time", runs, best)
    assert len(line) == len(motions.DURATION_HEAD) and line[2:5] == [1, 1, 0]
    assert best[PROBLEM] == min(run["duration"] for run in runs)
    crashed = {**about, "problem": "wall/easy/800001", "solved": False, "status": "CRASH"}
    assert motions.duration_row("hard", "time", [*runs, crashed], best)[2:5] == [2, 1, 0]


def test_the_best_of_several_seeds_is_the_reference() -> None:
    motions = benchmark_script("timing.motions")
    runs = {
        "length": {"a": {"problem": "a", "durations": [2.0, 4.0], "cpu": 0.01}},
        "time": {
            "a": {"problem": "a", "durations": [1.0, None, 1.5], "cpu": 0.02, "fault": "x"},
            "b": {"problem": "b", "solved": False},
        },
    }
    runs["length"]["b"] = {"problem": "b", "durations": [3.0], "cpu": 0.01}
    kind, row, n, solved, faults, own, _, every, *_ = motions.goal_row("pose", "time", runs)
    assert (kind, row, n, solved, faults) == ("pose", "time", 2, "0.125", 1) and own == every == "1.250"
    assert motions.goal_row("pose", "length", runs)[7] == "2.000"


def test_the_search_is_at_least_as_fast_as_the_plan(rows: ModuleType) -> None:
    search = benchmark_script("timing.motion_search")
    made = search.search(replace(job("x", seconds=60.0), experiment="warm-up"))
    assert made["solved"] and made["duration"] >= made["direct"] - 1e-9
    assert [duration for _, duration in made["history"]] == sorted((d for _, d in made["history"]), reverse=True)


def test_saved_motions_are_followed(rows: ModuleType) -> None:
    made = rows.by_export(job("x", objective="time", rates=[0]))
    assert set(made["exports"]) == {".npz 0", ".csv 0", ".traj.yaml 0", ".traj.json 0"}
    for one in made["exports"].values():
        assert max(one["use"]) < 1.001 and not one["collides"] and one["off"] < 1e-6 and one["moving"] < 1e-6
    motions = benchmark_script("timing.motions")
    others = [{"refused": "too low"}, {"unreadable": "no", "bytes": 10}]
    line = motions.export_row("time", ".csv 0", [made["exports"][".csv 0"], *others])
    assert line[2:8] == [3, 1, 1, 0, 0, 0] and line[9:11] == [0, 0]


def test_hands_follow_the_arms_along_the_path(rows: ModuleType) -> None:
    path = np.array([[0.0, 0.0, 5.0], [1.0, 0.0, 6.0], [1.0, 1.0, 8.0]])
    arms = np.array([[0.0, 0.0], [0.5, 0.0], [1.0, 0.5], [1.0, 1.0]])
    states = rows.with_hands(arms, ["a", "b"], path, ["a", "b", "hand"])
    assert states[:, :2] == pytest.approx(arms)
    assert states[[0, -1], 2].tolist() == [5.0, 8.0] and (np.diff(states[:, 2]) > 0.0).all()
    assert rows.with_hands(path[:, :2], ["a", "b"], path, ["a", "b", "hand"]) == pytest.approx(path)
    finer = rows.through_corners(path[:, :2], 0.25)
    assert np.abs(np.diff(finer, axis=0)).max() <= 0.25 and all(
        (finer == corner).all(axis=1).any() for corner in path[:, :2]
    )
