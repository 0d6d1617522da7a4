"""Limits of torques and tool speeds: shares, slowing down, paths that gravity overloads, and motions timed by them."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support import distance

from apex_ompl.errors import ApexError, ParameterError, RobotError, TimingError, UnknownNameError
from apex_ompl.robot import Robot, load_robot
from apex_ompl.scene.bodies import AttachedObject
from apex_ompl.timing import MotionLimits, TimedPath, Timing, Trajectory, time_path
from apex_ompl.timing.parameterization import fitted

PAYLOAD = {"left_hand": 2.5, "right_hand": 2.5}
DENSE = 0.0005  # [s]
BETWEEN = 1.0 + 1e-3  # ratio of the largest value between samples to that at them


def random_path(robot: Robot, seed: int, states: int = 4) -> np.ndarray:
    """Some states between which both arms move."""
    rng = np.random.default_rng(seed)
    path = robot.home + rng.normal(0.0, 0.8, (states, robot.dof))
    return np.clip(path, robot.limits.lower, robot.limits.upper)


def timed(robot: Robot, path: np.ndarray, timing: Timing, limits: MotionLimits | None = None) -> TimedPath:
    return time_path(path, robot.limits, robot.joint_names, timing, motion_limits=limits)


def largest_torque(limits: MotionLimits, motion: Trajectory) -> float:
    states = motion.states(np.append(np.arange(0.0, motion.duration, DENSE), motion.times))
    return float((np.abs(limits.dynamics.torques(*states)) / limits.torque).max())


def largest_speed(robot: Robot, motion: Trajectory, link: str, point: np.ndarray, spacing: float = 0.004) -> float:
    """By differences of positions [m/s]."""
    states = motion(np.arange(0.0, motion.duration, spacing))
    places = np.array([(robot.link_pose(q, link) @ np.append(point, 1.0))[:3] for q in states])
    return float(np.linalg.norm(np.diff(places, axis=0), axis=1).max()) / spacing


@pytest.mark.parametrize("states", [2, 4])
@pytest.mark.parametrize("seed", range(2))
def test_shares_are_those_of_dense_samples(robot: Robot, states: int, seed: int) -> None:
    limits = Timing(payload=PAYLOAD, max_tool_speed=0.5).motion_limits(robot)
    assert limits is not None
    motion = timed(robot, random_path(robot, seed, states), Timing("spline")).trajectory
    use = limits.use(motion)
    assert list(use) == ["tool_speed", "torque"]
    dense = largest_torque(limits, motion)
    assert dense / BETWEEN <= use["torque"] <= dense * BETWEEN
    speeds = [largest_speed(robot, motion, h.palm, np.array(h.point)) for h in robot.hands.values()]
    assert use["tool_speed"] == pytest.approx(max(speeds) / 0.5, rel=1e-3)


@settings(max_examples=5)
@given(seed=st.integers(0, 99), payload=st.sampled_from([1.0, 2.0, 2.5]), speed=st.sampled_from([None, 0.25, 1.0]))
def test_the_stretch_is_the_least_that_keeps_the_limits(seed: int, payload: float, speed: float | None) -> None:
    robot = load_robot("dual_panda_softhand")
    timing = Timing(payload={"left_hand": payload, "right_hand": payload}, max_tool_speed=speed, torque_scale=0.9)
    limits = timing.motion_limits(robot)
    assert limits is not None
    motion = timed(robot, random_path(robot, seed), Timing("spline")).trajectory
    found = limits.stretch(motion)
    if math.isinf(found):
        return
    slower = motion.slower(found)
    assert not limits.fault(slower) and max(limits.use(slower).values()) <= 1.0
    low, high = 1.0, 64.0
    while high - low > 1e-5:  # bisection
        middle = (low + high) / 2.0
        low, high = (low, middle) if max(limits.use(motion.slower(middle)).values()) <= 0.999 else (middle, high)
    assert found == pytest.approx(high, rel=1e-3)


@pytest.mark.parametrize("method", ["spline", "ruckig"])
@pytest.mark.parametrize(
    "options",
    [{"payload": PAYLOAD}, {"max_tool_speed": 0.25}, {"payload": PAYLOAD, "max_tool_speed": {"left_hand": 1.0}}],
)
def test_motions_keep_the_limits_and_lose_less_time_than_by_slowing_down(
    robot: Robot, method: str, options: dict[str, object]
) -> None:
    timing = Timing(method, **options)  # type: ignore[arg-type]
    limits = timing.motion_limits(robot)
    assert limits is not None
    gained = []
    for seed in range(2):
        path = random_path(robot, seed)
        plain, made = (timed(robot, path, timing, some).trajectory for some in (None, limits))
        assert largest_torque(limits, made) <= BETWEEN
        for name, speed in limits.tool_speed.items():
            hand = robot.hands[name]
            assert largest_speed(robot, made, hand.palm, np.array(hand.point)) <= speed * BETWEEN
        assert max(made.use(robot.limits).values()) <= 1.0 + 1e-9
        slowed = plain.duration * limits.stretch(plain)
        assert plain.duration * (1.0 - 1e-3) <= made.duration <= slowed * (1.0 + 1e-3)
        gained.append(made.duration / slowed)
    assert min(gained) < 0.95


def test_motions_within_the_limits_are_the_same_as_without_them(robot: Robot) -> None:
    path, timing = random_path(robot, 3), Timing("spline")
    limits = timing.motion_limits(robot)
    assert limits is not None
    plain, made = (timed(robot, path, timing, some).trajectory for some in (None, limits))
    assert limits.use(plain)["torque"] < 1.0
    np.testing.assert_array_equal(plain.positions, made.positions)


def test_straight_lines_keep_the_limits(robot: Robot) -> None:
    path, timing = random_path(robot, 5, states=2), Timing(max_tool_speed=0.25)
    limits = timing.motion_limits(robot)
    assert limits is not None
    plain, made = (timed(robot, path, timing, some) for some in (None, limits))
    assert not limits.fault(made.trajectory)
    assert (
        plain.trajectory.duration
        < made.trajectory.duration
        < plain.trajectory.duration * limits.stretch(plain.trajectory)
    )
    direction = (path[1] - path[0]) / np.linalg.norm(path[1] - path[0])
    moved = made.trajectory(np.linspace(0.0, made.trajectory.duration, 500)) - path[0]
    np.testing.assert_allclose(moved, np.outer(moved @ direction, direction), atol=1e-9)


@pytest.mark.parametrize("seed", [0, 2])
def test_a_motion_is_fitted_into_the_limits_along_its_path(robot: Robot, seed: int) -> None:
    timing = Timing("spline", payload=PAYLOAD, deviation=0.02)
    limits = timing.motion_limits(robot)
    assert limits is not None
    motion = timed(robot, random_path(robot, seed), Timing("spline")).trajectory
    made = fitted(motion, robot.limits, limits, timing)
    assert made.form == "blended" and not limits.fault(made.trajectory)
    assert max(made.trajectory.use(robot.limits).values()) <= 1.0 + 1e-9
    assert made.trajectory.duration < 0.95 * motion.duration * limits.stretch(motion)
    np.testing.assert_array_equal(made.trajectory.positions[[0, -1]], motion.positions[[0, -1]])
    dense = [some(np.linspace(0.0, some.duration, 2000)) for some in (made.trajectory, motion)]
    assert distance(*dense) <= made.deviation + 1e-9 and made.deviation <= 0.02
    light = Timing().motion_limits(robot)
    assert light is not None and fitted(motion, robot.limits, light, timing).trajectory is motion


def test_a_moving_start_over_a_limit_is_refused_by_joint_and_time(robot: Robot) -> None:
    start = np.zeros(robot.dof)
    start[0] = 2.0
    timing = Timing(start_velocity=start, max_tool_speed={"left_hand": 0.1})
    with pytest.raises(TimingError, match=r"the speed of left_hand is [\d.]+ of its limit of 0.1 m/s at 0"):
        timed(robot, random_path(robot, 0), timing, timing.motion_limits(robot))


def test_a_path_that_gravity_overloads_is_refused_by_joint_and_state(robot: Robot) -> None:
    heavy = Timing(payload={"left_hand": 4.0}).motion_limits(robot)
    assert heavy is not None
    states = robot.random_state(np.random.default_rng(0), 200)
    shares = np.abs(heavy.dynamics.torques(states)) / robot.effort
    bad = int(shares.max(axis=1).argmax())
    joint = robot.joint_names[int(shares[bad].argmax())]
    path = np.array([robot.home, states[bad], robot.home])
    reason = heavy.gravity_fault(path)
    assert (
        f"of {joint} near state 1 of the path" in reason
        and f"limit is {robot.effort[shares[bad].argmax()]:g} Nm" in reason
    )
    with pytest.raises(TimingError, match=f"gravity alone asks for .* of {joint} near state 1"):
        timed(robot, path, Timing(), heavy)
    assert math.isinf(heavy.stretch(timed(robot, path, Timing("spline")).trajectory))
    assert not heavy.gravity_fault(np.array([robot.home]))
    assert timed(robot, path, Timing()).trajectory, "without the limits"


def test_held_objects_and_payloads_count(robot: Robot) -> None:
    held = AttachedObject(name="block", link="left_hand_palm", box=(0.05, 0.05, 0.05), position=(0, 0, -0.1), mass=2.0)
    empty, full = (Timing().motion_limits(robot, some) for some in ((), (held,)))
    by_link = Timing(max_tool_speed=0.25).motion_limits(robot, payload={"left_hand_palm": 2.0})
    assert empty is not None and full is not None and by_link is not None
    assert full.dynamics.mass == by_link.dynamics.mass == pytest.approx(empty.dynamics.mass + 2.0)
    fast = Timing(max_tool_speed={"block": 0.2, "left_link7": 0.3}).motion_limits(robot, (held,))
    assert fast is not None and fast.tool_speed == {"block": 0.2, "left_link7": 0.3}
    everything = Timing(max_tool_speed=0.25).motion_limits(robot, (held,))
    assert everything is not None and list(everything.tool_speed) == ["left_hand", "right_hand", "block"]
    own = Timing(payload={"left_hand": 1.0}).motion_limits(robot, payload={"left_hand": 9.0, "right_hand": 2.0})
    assert own is not None and own.dynamics.mass == pytest.approx(empty.dynamics.mass + 3.0)


def test_only_joints_whose_effort_the_robot_file_gives_are_limited(robot: Robot, baxter: Robot) -> None:
    assert Timing().motion_limits(baxter) is None
    assert Timing(torque_limits=False).motion_limits(robot) is None
    one = Timing(max_torque={"left_s0": 20.0}, torque_scale=0.5).motion_limits(baxter)
    assert one is not None and one.torque[0] == 10.0 and np.isinf(one.torque[1:]).all()
    handless = replace(baxter, hands={})
    tools = Timing(max_tool_speed=0.25).motion_limits(handless)
    assert tools is not None and list(tools.tool_speed) == list(baxter.last_links)


@pytest.mark.parametrize(
    ("options", "error", "expected"),
    [
        ({"max_tool_speed": 0.0}, ParameterError, "max_tool_speed: expected a positive number"),
        ({"max_tool_speed": {"left_hand": math.nan}}, ParameterError, "max_tool_speed.left_hand: expected a positive"),
        ({"max_tool_speed": "fast"}, ParameterError, "max_tool_speed: expected a positive number, or numbers by name"),
        ({"max_tool_speed": {"left_hnd": 0.25}}, UnknownNameError, "unknown tool 'left_hnd', did you mean 'left_hand'"),
        ({"payload": {"left_hand": -1.0}}, ParameterError, "payload.left_hand: expected a positive number, got -1"),
        ({"payload": {"hand": 1.0}}, UnknownNameError, "unknown payload 'hand'"),
        ({"payload": 2.0}, ParameterError, "payload: expected masses by hand or link, got 2.0"),
        ({"max_torque": {"left_joint1": 88.0}}, ParameterError, "max_torque.left_joint1: expected at most 87"),
        ({"max_torque": {"left_joint9": 1.0}}, UnknownNameError, "unknown joint 'left_joint9'"),
        ({"max_torque": {"left_joint1": math.inf}}, ParameterError, "max_torque.left_joint1: expected a positive"),
        ({"torque_scale": 1.5}, ParameterError, "torque_scale: expected a number from 0.001 to 1"),
        ({"torque_limits": "yes"}, ParameterError, "torque_limits: expected True or False"),
    ],
)
def test_faulty_options_are_named(
    robot: Robot, options: dict[str, object], error: type[ApexError], expected: str
) -> None:
    with pytest.raises(error, match=expected):
        Timing(**options).motion_limits(robot)  # type: ignore[arg-type]


def test_torques_need_masses(robot: Robot) -> None:
    light = robot.model.copy()
    for body in light.inertias:
        body.mass = 0.0
    with pytest.raises(RobotError, match="no link of dual_panda_softhand has a mass"):
        Timing().motion_limits(replace(robot, model=light))
