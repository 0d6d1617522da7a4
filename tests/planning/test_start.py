"""Starts that are a little off: outside limits, or touching something."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest

import apex_ompl
from apex_ompl import MotionPlanner, PlanStatus, Timing
from apex_ompl.errors import ParameterError
from apex_ompl.loop.referee import is_at_goal
from apex_ompl.result import PlanResult

DEPTH = 4e-4  # of the contact at the start [m]


@cache
def planner() -> MotionPlanner:
    return MotionPlanner()


def resting(depth: float) -> MotionPlanner:
    """A planner whose robot's right hand, at home, rests in a box from below by a depth [m]."""
    kept = planner()
    kept.world.clear()
    home = kept.robot.home
    at = kept.robot.link_pose(home, "right_hand_palm")[:3, 3]
    height = 0.05
    kept.world.add(name="table", box=(0.1, 0.1, height), position=(at[0], at[1], at[2] - 0.5))
    low, high = 0.0, 0.5  # bisected to contact
    for _ in range(40):
        middle = 0.5 * (low + high)
        kept.world.move("table", (at[0], at[1], at[2] - 0.5 + middle))
        low, high = (middle, high) if kept.check(home).clearance > -depth else (low, middle)
    kept.world.move("table", (at[0], at[1], at[2] - 0.5 + high))
    return kept


def goal_of(kept: MotionPlanner) -> np.ndarray:
    goal = kept.robot.home.copy()
    goal[kept.robot.joint_names.index("right_joint2")] -= 0.4
    return goal


@pytest.mark.parametrize("over", [4e-4, 1e-3])
def test_a_start_a_little_outside_a_limit_is_moved_to_it(over: float) -> None:
    kept = planner()
    kept.world.clear()
    start, limits = kept.robot.home.copy(), kept.robot.limits
    start[4], start[14] = limits.upper[4] + 0.99 * over, limits.lower[14] - 0.5 * over
    result = kept.plan(start, goal_of(kept))
    assert result and result.path is not None, result.reason
    np.testing.assert_array_equal(result.path.states[0], np.clip(start, limits.lower, limits.upper))
    names = [note.split()[0] for note in result.notes if "of the start is" in note]
    assert names == [kept.robot.joint_names[4], kept.robot.joint_names[14]]


@pytest.mark.parametrize("over", [1e-9, 4e-4, 1e-3])
def test_a_goal_a_little_outside_a_limit_is_moved_to_it(over: float, tmp_path: Path) -> None:
    kept = planner()
    kept.world.clear()
    home, limits = kept.robot.home, kept.robot.limits
    goal = home.copy()
    goal[0], goal[14] = limits.upper[0] + 0.99 * over, limits.lower[14] - 0.5 * over
    inside = np.clip(goal, limits.lower, limits.upper)
    far = np.r_[limits.upper[0] + 2e-3, home[1:]]
    for goals, labels in ((goal, ["goal", "goal"]), ([far, goal], ["goal 1", "goal 1"])):
        result = kept.plan(home, goals)
        assert result and result.path is not None and result.trajectory is not None, result.reason
        np.testing.assert_array_equal(result.path.states[-1], inside)
        np.testing.assert_allclose(result.trajectory.positions[-1], inside, atol=1e-9)
        notes = [note for note in result.notes if "outside its limits and is moved to" in note]
        names = [f"{kept.robot.joint_names[k]} of the {label} is" for k, label in zip((0, 14), labels, strict=True)]
        assert [" ".join(note.split()[: len(name.split())]) for note, name in zip(notes, names, strict=True)] == names
        result.save(tmp_path / "r.npz")
        assert PlanResult.load(tmp_path / "r.npz")
    assert is_at_goal(kept.robot, result.problem, inside)
    refused = kept.plan(home, far)
    assert refused.status is PlanStatus.INVALID_GOAL and "outside its limits" in refused.reason


def test_a_start_further_out_is_refused() -> None:
    kept = planner()
    kept.world.clear()
    start = kept.robot.home.copy()
    start[4] = kept.robot.limits.upper[4] + 2e-3
    result = kept.plan(start, goal_of(kept))
    assert result.status is PlanStatus.INVALID_START and "outside its limits" in result.reason


def test_a_contact_at_the_start_is_refused_with_the_remedy_or_left() -> None:
    kept = resting(DEPTH)
    home, goal = kept.robot.home, goal_of(kept)
    refused = kept.plan(home, goal)
    assert refused.status is PlanStatus.INVALID_START and "leave_contact=0.001" in refused.reason
    result = kept.plan(home, goal, leave_contact=1e-3)
    assert result and result.path is not None and result.trajectory is not None, result.reason
    assert any("touch at the start" in note for note in result.notes), result.notes
    path, motion = result.path.states, result.trajectory
    np.testing.assert_array_equal(path[[0, -1]], [home, goal])
    np.testing.assert_array_equal(motion.positions[[0, -1]], [home, goal])
    assert max(motion.use(kept.robot.limits).values()) <= 1.0 + 1e-6
    out = [kept.check(q).clearance for q in np.linspace(path[0], path[1], 200)]  # finer than what was looked at
    assert (np.diff(out) > -1e-6).all() and out[0] == pytest.approx(-DEPTH, abs=1e-5) and out[-1] > 5e-5
    assert all(map(kept.check, path[1:]))
    seen = [kept.check(q).clearance for q in motion(np.arange(0.0, motion.duration, 0.01))]
    free = int(np.argmax(np.array(seen) > 1e-5))
    assert (np.diff(seen[: free + 1]) > -1e-6).all() and min(seen[free:]) > 0.0
    assert kept.plan(home, goal, leave_contact=1e-3, timing=False).path is not None
    slow = kept.plan(home, goal, leave_contact=1e-3, timing=Timing(velocity_scale=0.5))
    assert slow and slow.trajectory is not None and slow.trajectory.duration > motion.duration


def test_a_saved_result_with_a_departure_is_read_back(tmp_path: object) -> None:
    kept = resting(DEPTH)
    result = kept.plan(kept.robot.home, goal_of(kept), leave_contact=1e-3)
    file = f"{tmp_path}/result.json"
    result.save(file)
    assert apex_ompl.PlanResult.load(file).notes == result.notes


def test_a_deeper_contact_is_not_left() -> None:
    kept = resting(3e-3)
    result = kept.plan(kept.robot.home, goal_of(kept), leave_contact=1e-3)
    assert result.status is PlanStatus.INVALID_START and "leave_contact" not in result.reason
    with pytest.raises(ParameterError, match="leave_contact: expected"):
        kept.plan(kept.robot.home, goal_of(kept), leave_contact=0.01)
    pushed = Timing(start_velocity=np.full(kept.robot.dof, 0.01))
    with pytest.raises(ParameterError, match="leave_contact: expected 0 for a start that moves"):
        kept.plan(kept.robot.home, goal_of(kept), leave_contact=1e-3, timing=pushed)


def test_joints_that_stay_do_not_leave_a_contact() -> None:
    kept = resting(DEPTH)
    goal = kept.robot.home.copy()
    goal[kept.robot.joint_names.index("left_joint2")] -= 0.2
    result = kept.plan(kept.robot.home, goal, group="left_arm", leave_contact=1e-3)
    assert result.status is PlanStatus.INVALID_START, "the right hand touches, and only the left arm is planned"
