"""Bags that are written, read back by rosbags' own reader, and followed as a controller would."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from bags import read
from support import benchmark_script

from apex_ompl.drivers import BagDriver
from apex_ompl.errors import ParameterError
from apex_ompl.robot import Robot
from apex_ompl.timing import Trajectory, time_path

pytest.importorskip("rosbags")

ZERO = 1_700_000_000.25
CONTROLLERS = {"left_arm": slice(0, 7), "right_arm": slice(7, 14), "hands": slice(14, 16)}


@pytest.fixture(scope="module")
def written(robot: Robot, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Trajectory, Trajectory]:
    """A bag of a motion that is replaced by its stop in the middle, and both."""
    folder = tmp_path_factory.mktemp("bags") / "motion"
    goal = robot.home + 0.3 * (np.arange(robot.dof) % 8 < 3)
    motion = time_path(np.stack([robot.home, goal]), robot.limits, robot.joint_names).trajectory
    controllers = {name: robot.joint_names[part] for name, part in CONTROLLERS.items()}
    renamed = {name: f"r_{name}" for name in robot.joint_names}
    driver = BagDriver(robot, folder, controllers, renamed=renamed, zero=ZERO)
    driver.send(motion, 0.1)
    half = 0.5 * motion.duration
    driver.advance(0.05 + half)
    rest = motion.stop_at(half, robot.limits).after(half)
    driver.send(rest, 0.1 + half)
    driver.advance(driver.end + 0.2)
    driver.close()
    return folder, motion, rest


def test_joint_states_are_those_of_the_motion(written: tuple[Path, Trajectory, Trajectory], robot: Robot) -> None:
    folder, motion, rest = written
    states = read(folder)["/joint_states"]
    half = 0.1 + 0.5 * motion.duration
    assert len(states) > 30
    for k, (time, message) in enumerate(states):
        now = 0.01 * k
        assert time == round(ZERO * 1e9) + k * 10**7
        assert message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == time
        assert message.name == [f"r_{name}" for name in robot.joint_names]
        one, since = (motion, now - 0.1) if now < half else (rest, now - half)
        q, v, _ = one.states(np.array([min(max(since, 0.0), one.duration)]))[:, 0]
        assert np.abs(message.position - q).max() < 1e-9 and np.abs(message.velocity - v).max() < 1e-6


def test_a_controller_that_follows_the_messages_is_where_the_motions_are(
    written: tuple[Path, Trajectory, Trajectory], robot: Robot
) -> None:
    folder, motion, rest = written
    messages = read(folder)
    exported = benchmark_script("timing.exported_motions")
    shares = np.array([0.2, 0.5, 0.9])
    for name, part in CONTROLLERS.items():
        sent = [message for _, message in messages[f"/{name}/joint_trajectory"]]
        assert len(sent) == 2
        for message, one in zip(sent, (motion, rest), strict=True):
            assert message.joint_names == [f"r_{joint}" for joint in robot.joint_names[part]]
            times = [p.time_from_start.sec * 10**9 + p.time_from_start.nanosec for p in message.points]
            states = np.array([[p.positions, p.velocities, p.accelerations] for p in message.points])
            points = exported.Points(np.array(times), np.moveaxis(states, 1, 0), tuple(message.joint_names))
            assert times[0] == 0
            coefficients, lengths = exported.quintics(points)
            found = exported.evaluated(coefficients, lengths, shares, 0)
            for begin, length, rows in zip(times, lengths[:, 0], found, strict=False):
                for share, row in zip(shares, rows, strict=True):
                    assert np.abs(row - one(min(begin / 1e9 + share * length, one.duration))[part]).max() < 1e-8
        starts = [message.header.stamp.sec * 10**9 + message.header.stamp.nanosec for message in sent]
        assert starts == [round(ZERO * 1e9) + round(1e9 * at) for at in (0.1, 0.1 + 0.5 * motion.duration)]


def test_a_folder_that_is_there_is_not_overwritten(robot: Robot, tmp_path: Path) -> None:
    (tmp_path / "kept").write_text("x")
    with pytest.raises(ParameterError, match="path: expected a folder that can be made"):
        BagDriver(robot, tmp_path)
    assert [one.name for one in tmp_path.iterdir()] == ["kept"]
    with pytest.raises(ParameterError, match="rate: expected a positive number of states a second"):
        BagDriver(robot, tmp_path / "bag", rate=0.0)
    with pytest.raises(ParameterError, match="controllers: expected each joint of the trajectory once"):
        BagDriver(robot, tmp_path / "bag", {"arm": robot.joint_names[:3]})
    assert not (tmp_path / "bag").exists()
