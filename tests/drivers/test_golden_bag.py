"""The messages of both arms by the rules of their controllers, and a bag of an earlier day that must not change."""

from __future__ import annotations

import copy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import golden_bag
import numpy as np
import pytest
import trajectory_rules as rules
from bags import read

from apex_ompl.drivers import BagDriver
from apex_ompl.robot import Robot
from apex_ompl.timing import Trajectory, time_path

pytest.importorskip("rosbags")

TOPICS = [f"/{name}/joint_trajectory" for name in golden_bag.CONTROLLERS]


def limits_of(robot: Robot) -> dict[str, tuple[float, float, float, float]]:
    rows = zip(*(getattr(robot.limits, name) for name in ("lower", "upper", "velocity", "acceleration")), strict=True)
    return {name: tuple(map(float, row)) for name, row in zip(robot.joint_names, rows, strict=True)}  # type: ignore[misc]


def test_the_golden_bag_holds_the_motion(robot: Robot) -> None:
    motion, bag = Trajectory.load(golden_bag.FOLDER / "motion.npz"), read(golden_bag.FOLDER / "bag")
    assert sorted(bag) == sorted([*TOPICS, "/joint_states"])
    zero = round(golden_bag.ZERO * 1e9)
    start = zero + round(golden_bag.START * 1e9)
    for topic, part in zip(TOPICS, golden_bag.CONTROLLERS.values(), strict=True):
        ((time, message),) = bag[topic]
        assert time == zero and rules.nanoseconds(message.header.stamp) == start
        assert tuple(message.joint_names) == robot.joint_names[part]
        times = [rules.nanoseconds(point.time_from_start) for point in message.points]
        np.testing.assert_array_equal(times, np.rint(motion.times * 1e9))
        for name in ("positions", "velocities", "accelerations"):
            given = [getattr(point, name) for point in message.points]
            np.testing.assert_allclose(given, getattr(motion, name)[:, part], atol=1e-9)
    states = bag["/joint_states"]
    assert len(states) == 1 + int((golden_bag.START + motion.duration + 0.1) * golden_bag.RATE)
    for k, (time, message) in enumerate(states):
        assert time == zero + k * round(1e9 / golden_bag.RATE)
        since = min(max((time - start) / 1e9, 0.0), motion.duration)
        np.testing.assert_allclose(message.position, motion(since), atol=1e-9)
        np.testing.assert_allclose(message.velocity, motion(since, 1), atol=1e-7)


def test_today_the_same_bag_is_written(robot: Robot, tmp_path: Path) -> None:
    golden_bag.write(robot, Trajectory.load(golden_bag.FOLDER / "motion.npz"), tmp_path / "bag")
    old, new = read(golden_bag.FOLDER / "bag"), read(tmp_path / "bag")
    assert list(old) == list(new)
    for topic, messages in old.items():
        assert [time for time, _ in messages] == [time for time, _ in new[topic]]
        for (_, one), (_, other) in zip(messages, new[topic], strict=True):
            assert same(one, other)


def same(one: Any, other: Any) -> bool:
    if isinstance(one, (str, int)):
        return bool(one == other)
    if isinstance(one, float) or isinstance(one, np.ndarray):
        return np.shape(one) == np.shape(other) and bool(np.allclose(one, other, rtol=0.0, atol=1e-9))
    if isinstance(one, list):
        return len(one) == len(other) and all(map(same, one, other))
    return type(one).__name__ == type(other).__name__ and all(
        same(value, getattr(other, name)) for name, value in vars(one).items() if not name.startswith("__")
    )


def test_messages_of_both_arms_follow_the_rules(robot: Robot, tmp_path: Path) -> None:
    controllers = {name: robot.joint_names[part] for name, part in golden_bag.CONTROLLERS.items()}
    driver = BagDriver(robot, tmp_path / "bag", controllers, zero=golden_bag.ZERO)
    rng = np.random.default_rng(5)
    q = robot.home
    for k in range(8):
        goal = np.clip(q + rng.normal(0.0, 0.3, robot.dof), robot.limits.lower + 0.01, robot.limits.upper - 0.01)
        motion = time_path(np.stack([q, goal]), robot.limits, robot.joint_names).trajectory
        start = driver.time + 0.05
        driver.send(motion, start)
        if k % 2:  # stopped or replaced in the middle
            driver.advance(start + 0.4 * motion.duration)
            if k % 4 == 1:
                driver.stop()
            else:
                driver.send(motion.stop_at(0.5 * motion.duration, robot.limits).after(0.45 * motion.duration),
                            start + 0.45 * motion.duration)  # fmt: skip
        driver.advance(driver.end + 0.1)
        q = driver.state().positions
    driver.close()
    bag, limits = read(tmp_path / "bag"), limits_of(robot)
    assert [len(bag[topic]) for topic in TOPICS] == [12] * 3
    for sent in zip(*(bag[topic] for topic in TOPICS), strict=True):
        assert rules.robot_faults([message for _, message in sent], robot.joint_names) == []
        for (time, message), joints in zip(sent, controllers.values(), strict=True):
            assert rules.faults(message, joints, time) == [] and rules.limit_faults(message, limits) == []


def _late(message: Any) -> None:
    message.header.stamp.sec -= 10


def _turned(message: Any) -> None:
    message.points[1], message.points[2] = message.points[2], message.points[1]


def _moving(message: Any) -> None:
    message.points.pop()


def _short(message: Any) -> None:
    message.points[3].velocities = message.points[3].velocities[:-1]


def _renamed(message: Any) -> None:
    message.joint_names[0] = "elbow"


def _empty(message: Any) -> None:
    message.points.clear()


def _unknown(message: Any) -> None:
    message.points[2].positions = message.points[2].positions * np.nan


FAULTY: dict[str, Callable[[Any], None]] = {
    "it ended before it was sent": _late, "times do not increase": _turned, "the last velocity is not zero": _moving,
    "point 3: velocities of shape": _short, "joints ['elbow'": _renamed, "no points": _empty,
    "point 2: positions that are not finite": _unknown,
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTY)
def test_the_rules_name_what_is_wrong(robot: Robot, fault: str) -> None:
    ((time, message),) = read(golden_bag.FOLDER / "bag")[TOPICS[0]]
    joints = robot.joint_names[:7]
    assert rules.faults(message, joints, time) == []
    bad = _thawed(message)
    FAULTY[fault](bad)
    assert any(one.startswith(fault) for one in rules.faults(bad, joints, time))


def test_the_rules_name_limits_and_parts(robot: Robot) -> None:
    bag = read(golden_bag.FOLDER / "bag")
    messages = [bag[topic][0][1] for topic in TOPICS]
    limits = limits_of(robot)
    assert rules.robot_faults(messages, robot.joint_names) == []
    assert rules.robot_faults(messages[:2], robot.joint_names)[0].startswith("joints")
    late = [messages[0], messages[1], _thawed(messages[2])]
    late[2].header.stamp.sec += 1
    assert "the messages do not start at the same time" in rules.robot_faults(late, robot.joint_names)
    low, high, velocity, acceleration = limits["left_joint1"]
    tight = {**limits, "left_joint1": (low, high, 0.5 * velocity, 0.2 * acceleration)}
    found = rules.limit_faults(messages[0], tight)
    assert len(found) == 2 and found[0].startswith("left_joint1: velocity")


def _thawed(message: Any) -> Any:
    """A copy of a message that can be changed."""

    class Copy:
        pass

    if isinstance(message, list):
        return [_thawed(one) for one in message]
    if not hasattr(message, "__dataclass_fields__"):
        return copy.copy(message)
    found = Copy()
    for name in message.__dataclass_fields__:
        setattr(found, name, _thawed(getattr(message, name)))
    return found
