"""Saved motions, read by a reader of its own and followed as a controller follows them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from followed import SUFFIXES, Points, follow, points_of, read
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from timings import LIMITS, NAMES, paths, timed

from apex_ompl.errors import ParameterError
from apex_ompl.robot import Robot
from apex_ompl.robot.model import Limits
from apex_ompl.timing import Timing, Trajectory, joined, time_path

RATES = (100.0, 400.0)


def within_limits(points: Points, limits: Limits, columns: list[int]) -> bool:
    """Whether a controller that follows the points keeps the limits of the joints to a thousandth, at any time."""
    bounds = limits.velocity, limits.acceleration, limits.jerk
    rows = zip(follow(points)[1:], bounds, strict=True)
    return all(bool((np.abs(row) <= 1.001 * bound[columns]).all()) for row, bound in rows)


def assert_followed(points: Points, motion: Trajectory, limits: Limits, wanted: Trajectory) -> None:
    """Check that a controller that follows the points makes the wanted motion, and ends where the motion does."""
    columns = [motion.joint_names.index(name) for name in points.names]
    assert within_limits(points, limits, columns)
    np.testing.assert_array_equal(points.states[0, [0, -1]], motion.positions[[0, -1]][:, columns])
    assert points.times[0] == 0.0 and points.times[-1] == pytest.approx(motion.duration, abs=1e-9)
    times = points.times[:-1, None] + np.diff(points.times)[:, None] * np.linspace(0.0, 1.0, 17)
    made = follow(points)[0].reshape(-1, len(columns))
    np.testing.assert_allclose(made, wanted(times.ravel()), rtol=0.0, atol=2e-9)


class Saving(NamedTuple):
    """How a motion is saved."""

    suffix: str
    rate: float | None
    joints: list[str]


savings = st.builds(
    Saving, st.sampled_from(SUFFIXES), st.sampled_from([None, None, *RATES]),
    st.lists(st.sampled_from(NAMES), min_size=1, unique=True),
)  # fmt: skip


@settings(max_examples=24, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(path=paths(), timing=st.sampled_from([Timing(), Timing("spline"), Timing(minimum_duration=5.0)]), saving=savings)
def test_controllers_that_follow_files_keep_the_limits(
    tmp_path: Path, path: np.ndarray, timing: Timing, saving: Saving
) -> None:
    motion = timed(np.clip(path, -2.9, 2.9), timing).trajectory
    suffix, rate, joints = saving
    file = tmp_path / f"motion{suffix}"
    try:
        motion.save(file, rate=rate, joints=joints, limits=LIMITS)
    except ParameterError as error:
        assert error.name == "rate" and rate is not None, "never with its own knots"
        return
    wanted = motion.saved(rate=rate, joints=joints, limits=LIMITS)
    points = read(file)
    assert points.names == joints and np.diff(points.times).min() >= 1e-3 - 1e-9
    assert_followed(points, motion, LIMITS, wanted)
    if rate is None:
        assert wanted.times is motion.times, "what was timed is what is saved"
    else:
        assert wanted.deviation(motion.selected(joints)) < 5e-3


@settings(max_examples=20, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(path=paths(), share=st.floats(0.05, 0.9), suffix=st.sampled_from(SUFFIXES))
def test_moving_starts_stops_and_joined_motions_are_followed(
    tmp_path: Path, path: np.ndarray, share: float, suffix: str
) -> None:
    path, file = np.clip(path, -2.0, 2.0), tmp_path / f"motion{suffix}"
    moving = timed(path, Timing(start_velocity=(0.5 * share, 0.0, -0.5 * share))).trajectory
    stopped = moving.stop_at(share * moving.duration, LIMITS)
    back = timed(np.stack([stopped.positions[-1], path[0]])).trajectory
    for motion in (moving, stopped, joined([stopped, back])):
        motion.save(file)
        assert_followed(read(file), motion, LIMITS, motion.saved())


def test_files_of_two_arms_are_small(robot: Robot, tmp_path: Path) -> None:
    t = np.linspace(0.0, 1.0, 256)[:, None]
    rng = np.random.default_rng(3)
    path = robot.home + 0.6 * np.sin(2.0 * np.pi * t * rng.uniform(0.1, 1.0, robot.dof)) * rng.choice(
        [-1, 1], robot.dof
    )
    path = np.clip(path, robot.limits.lower, robot.limits.upper)
    motion = time_path(path, robot.limits, robot.joint_names, Timing(minimum_duration=3.0)).trajectory
    assert len(motion.times) <= 60.0 * motion.duration + 1
    controllers = {group: [robot.joint_names[k] for k in joints] for group, joints in robot.groups.items()}
    for suffix in SUFFIXES:
        file = tmp_path / f"motion{suffix}"
        motion.save(file)
        assert file.stat().st_size <= 200_000
        assert_followed(read(file), motion, robot.limits, motion)
    motion.save(file, controllers)
    for group, message in json.loads(file.read_text()).items():
        points = points_of(message)
        assert points.names == controllers[group]
        assert_followed(points, motion, robot.limits, motion.selected(controllers[group]))
    assert Trajectory.load(file).deviation(motion.selected(Trajectory.load(file).joint_names)) < 1e-8


def test_motions_of_extreme_knots_are_saved(tmp_path: Path) -> None:
    """Of long rests, of a few milliseconds, and of knots a nanosecond apart."""
    still = np.zeros((2, 3))
    rest = Trajectory(np.array([0.0, 3600.0]), still, still, still, NAMES)
    go = timed(np.array([[0.0, 0.0, 0.0], [1e-7, 0.0, 0.0]])).trajectory
    near = timed(np.array([[0.0, 0.0, 0.0], [1.0, 0.5, 0.0]])).trajectory
    times = np.sort(np.concatenate([near.times, near.times[1:-1] + 1.5e-9]))
    near = Trajectory.unchecked(times, near.states(times), NAMES)
    for motion in (rest, go, joined([rest, near]), near):
        for suffix in SUFFIXES:
            file = tmp_path / f"motion{suffix}"
            motion.save(file)
            assert_followed(read(file), motion, LIMITS, motion.saved())
            assert Trajectory.load(file).deviation(motion) < 1e-6
    with pytest.raises(ParameterError, match="duration: expected at least"):
        Trajectory(np.array([0.0, 5e-9]), still, still, still, NAMES).save(tmp_path / "x.csv")
    for wrong in ({"rate": -1.0}, {"joints": ["four"]}, {"joints": []}, {"rate": 3.0}):
        with pytest.raises(ParameterError, match=next(iter(wrong))):
            near.save(tmp_path / "x.csv", **wrong)  # type: ignore[arg-type]
    with pytest.raises(ParameterError, match="each joint of the trajectory once"):
        near.save(tmp_path / "x.traj.json", {"a": list(NAMES)}, joints=["one"])
    assert not list(tmp_path.glob("x*"))
