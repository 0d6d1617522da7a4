"""Plans with timing: the motion in the result, its check, and the command line."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from followed import follow, read

from apex_ompl import api, cli, plan, planning
from apex_ompl.errors import ParameterError, TimingError
from apex_ompl.ompl.setup import assemble
from apex_ompl.ompl.validity import full_check
from apex_ompl.paths.path import Path as JointPath
from apex_ompl.planning import steps
from apex_ompl.result import PlanResult, PlanStatus
from apex_ompl.timing import Timing, Trajectory, time_path


def test_plans_are_timed_and_checked() -> None:
    result = plan("ball_in_cup", timeout=20.0)
    motion = result.trajectory
    assert result and motion is not None and motion.dof == 16 and 0.3 < motion.duration < 10.0
    assert set(result.limit_use) == {"position", "velocity", "acceleration", "jerk", "torque"}
    assert 0.9 < max(result.limit_use.values()) <= 1.0 + 1e-9 and result.deviation <= Timing().deviation
    ready = assemble(result.problem)
    states = motion.sample(0.001).position
    assert full_check(ready.checker, states, ready.start, ready.goals)
    assert result.times["timing"] > 0.0 and result.times["timing proof"] > 0.0
    assert result.as_dict()["duration"] == motion.duration
    assert 0.0 < result.motion_clearance and 0.0 < result.clearance_bound <= result.clearance


@pytest.mark.parametrize(("problem", "suffix"), [("ball_in_cup", ".traj.json"), ("reach_past_post", ".csv")])
def test_what_a_controller_makes_of_a_saved_plan_is_what_was_proved(problem: str, suffix: str, tmp_path: Path) -> None:
    result = plan(problem, timeout=20.0)
    motion, ready, file = result.trajectory, assemble(result.problem), tmp_path / f"motion{suffix}"
    assert motion is not None and motion.merged() is motion and np.diff(motion.times).min() >= 1e-3 - 1e-9
    result.save(file)
    points, limits = read(file), ready.robot.limits
    rows = follow(points)
    for row, bound in zip(rows[1:], (limits.velocity, limits.acceleration, limits.jerk), strict=True):
        assert np.all(np.abs(row) <= 1.001 * bound)
    states = np.concatenate([rows[0][:, :-1].reshape(-1, motion.dof), points.states[0, -1:]])
    assert full_check(ready.checker, states, ready.start, ready.goals)
    sampled = motion.saved(rate=1000.0, limits=limits)
    assert full_check(ready.checker, sampled, ready.start, ready.goals) and sampled.deviation(motion) < 1e-5


def test_results_without_a_proof_are_read(tmp_path: Path) -> None:
    plan("ball_in_cup", timeout=20.0).save(tmp_path / "new.json")
    data = json.loads((tmp_path / "new.json").read_text())
    for name in ("clearance_bound", "clearance_pair", "proved_by_spheres", "motion_clearance"):
        del data[name]
    (tmp_path / "old.json").write_text(json.dumps(data))
    old = PlanResult.load(tmp_path / "old.json")
    assert np.isnan(old.motion_clearance) and np.isnan(old.clearance_bound) and old.clearance == data["clearance"]


def test_joints_at_their_limits_do_not_stop_a_plan() -> None:
    ready = assemble(api.load_problem("reach_past_post"))
    robot = ready.robot
    states = np.repeat(ready.start[None], 256, axis=0)
    states[:, 6], states[:, 13] = robot.limits.upper[6], robot.limits.lower[13]
    states[:, 5] += 0.2 * np.sin(5.0 * np.linspace(0.0, 1.0, 256))
    ready = replace(ready, start=states[0], goals=states[-1:])
    query = planning.check(ready, "rrtconnect", timeout=20.0)
    proved = planning.ProvedPath(query, PlanStatus.EXACT_SOLUTION, "", JointPath(states))
    assert planning.time(proved).trajectory.duration < 5.0


def test_a_path_that_cannot_be_timed_is_no_success(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*args: object, **options: object) -> None:
        raise TimingError("the motion collides")

    monkeypatch.setattr(steps, "time_path", fails)
    result = plan("ball_in_cup", timeout=20.0, objective="length")
    assert result.status is PlanStatus.TIMING_FAILED and not result and result.path is not None
    assert result.reason == "the path cannot be timed, the motion collides" and result.trajectory is None
    assert plan("ball_in_cup", timeout=20.0, timing=False)


def test_collisions_of_the_timed_motion_are_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    """Blending that cuts a corner by up to half a radian runs into what the path goes around."""
    tight = plan("reach_past_post", "rrtconnect", timeout=20.0, seed=3)
    wide = plan("reach_past_post", "rrtconnect", timeout=20.0, seed=3, timing=Timing(deviation=0.5))
    ready = assemble(tight.problem)
    for result in (tight, wide):
        assert result and result.trajectory is not None
        assert full_check(ready.checker, result.trajectory.sample(0.002).position, ready.start, ready.goals)
    blind = time_path(wide.path, ready.robot.limits, ready.robot.joint_names, Timing(deviation=0.5))  # type: ignore[arg-type]
    assert not full_check(ready.checker, blind.trajectory.sample(0.002).position), "or the test shows nothing"


def test_what_is_no_timing_is_refused() -> None:
    with pytest.raises(ParameterError, match="timing"):
        api.plan("ball_in_cup", timing=0.5)  # type: ignore[arg-type]
    with pytest.raises(ParameterError, match="start_velocity"):
        api.plan("ball_in_cup", timing=Timing(start_velocity=(1.0, 2.0)))


def test_the_command_writes_motions_and_draws_them(tmp_path, capsys: pytest.CaptureFixture[str]) -> None:  # type: ignore[no-untyped-def]
    out = tmp_path / "m.traj.yaml"
    assert cli.main(["plan", "shelf_swap", "--timeout", "20", "--velocity-scale", "0.5", "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    motion = Trajectory.load(out)
    assert f"motion     {motion.duration:.3f} s" in printed and "jerk" in printed and "timing proof" in printed
    assert "mm clear" in printed and "proved by spheres" in printed
    out = tmp_path / "c.traj.json"
    assert cli.main(["plan", "shelf_swap", "--timeout", "20", "--out", str(out), "--controllers"]) == 0
    assert Trajectory.load(out).dof == 16 and "left_arm_controller" in out.read_text()
    out = tmp_path / "s.csv"
    part = ["--rate", "500", "--joints", "right_arm,left_hand_synergy"]
    assert cli.main(["plan", "shelf_swap", "--timeout", "20", "--out", str(out), *part]) == 0
    sampled = Trajectory.load(out)
    assert sampled.joint_names == (*(f"right_joint{k}" for k in range(1, 8)), "left_hand_synergy")
    np.testing.assert_allclose(np.diff(sampled.times)[:-1], 0.002, atol=1.1e-9)
    out = tmp_path / "r.npz"
    assert cli.main(["plan", "shelf_swap", "--timeout", "20", "--out", str(out)]) == 0
    saved = PlanResult.load(out)
    assert saved.trajectory is not None and saved.limit_use["jerk"] > 0.0
    assert saved.motion_clearance > 0.0
    for name in ("p.png", "p.svg"):
        assert cli.main(["plot", str(out), "-o", str(tmp_path / name)]) == 0
    assert (tmp_path / "p.png").read_bytes()[:4] == b"\x89PNG" and "<svg" in (tmp_path / "p.svg").read_text()
    capsys.readouterr()
    untimed = tmp_path / "n.npz"
    assert cli.main(["plan", "shelf_swap", "--timeout", "20", "--no-timing", "--out", str(untimed)]) == 0
    without = PlanResult.load(untimed)
    assert without.trajectory is None and np.isnan(without.motion_clearance)
    for arguments, words in (
        (["plot", str(untimed), "-o", str(tmp_path / "q.png")], "timed motion"),
        (["plot", str(out), "-o", str(tmp_path / "q.txt")], "ending in"),
        (["plot", str(tmp_path / "none.npz"), "-o", str(tmp_path / "q.png")], "none.npz"),
        (["plan", "shelf_swap", "--jerk-scale", "2"], "jerk_scale"),
        (["plan", "shelf_swap", "--controllers"], "--controllers"),
        (["plan", "shelf_swap", "--rate", "100"], "--rate"),
        (["plan", "shelf_swap", "--rate", "0", "--out", str(tmp_path / "q.csv")], "--rate"),
        (["plan", "shelf_swap", "--joints", "left_arm", "--out", str(tmp_path / "q.npz")], "--joints"),
        (["plan", "shelf_swap", "--joints", "left_foot", "--out", str(tmp_path / "q.csv")], "joint 'left_foot'"),
        (["plan", "shelf_swap", "--rate", "5", "--out", str(tmp_path / "q.csv")], "Hz, at which this motion keeps"),
        (["plan", "shelf_swap", "--no-timing", "--out", str(tmp_path / "q.traj.yaml")], "--no-timing"),
    ):
        capsys.readouterr()
        assert cli.main(arguments) == 2
        printed = capsys.readouterr().err
        assert words in printed and printed.count("\n") == 1
    assert not list(tmp_path.glob("q*"))
