"""Motions that are sent to a driver: what is commanded, and what is refused."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from apex_ompl.drivers.commands import Commands
from apex_ompl.errors import ParameterError
from apex_ompl.robot.model import Limits
from apex_ompl.timing import Trajectory, time_path

NAMES = ("a", "b")
LIMITS = Limits(*(np.full(2, x) for x in (-2.0, 2.0, 1.5, 8.0, 200.0)))
ZERO, GOAL = np.zeros(2), np.array([1.0, -0.7])


def line(start: np.ndarray, goal: np.ndarray) -> Trajectory:
    return time_path(np.stack([start, goal]), LIMITS, NAMES).trajectory


MOTION = line(ZERO, GOAL)


def changed(**values: Any) -> Trajectory:
    """The motion with other numbers, unchecked."""
    states = np.stack([MOTION.positions, MOTION.velocities, MOTION.accelerations])
    motion = Trajectory.unchecked(MOTION.times, states, MOTION.joint_names)
    for name, value in values.items():
        object.__setattr__(motion, name, value)
    return motion


def test_commands_are_those_of_the_motion() -> None:
    commands = Commands(NAMES, LIMITS, ZERO)
    assert commands.end == 0.0
    commands.send(MOTION, 0.5, 0.0)
    times = np.linspace(0.0, 0.8 + MOTION.duration, 301)
    np.testing.assert_array_equal(commands.states(times), MOTION.states(times - 0.5))
    assert commands.end == pytest.approx(0.5 + MOTION.duration)
    still = commands.states(np.array([0.2, commands.end + 1.0]))
    np.testing.assert_allclose(still[0], [ZERO, GOAL], atol=1e-12)
    assert not still[1:].any()


def test_a_later_motion_takes_over_in_the_middle() -> None:
    commands, at = Commands(NAMES, LIMITS, ZERO), 0.4 * MOTION.duration
    commands.send(MOTION, 0.0, 0.0)
    second = MOTION.stop_at(at + 0.1, LIMITS).after(at)  # the same until it slows down
    commands.send(second, at, 0.1)
    times = np.array([0.5 * at, at - 1e-6, at, at + 0.05, at + 0.3, at + 9.0])
    found = commands.states(times)
    np.testing.assert_allclose(found[:, :2], MOTION.states(times[:2]), atol=1e-9)
    np.testing.assert_allclose(found[:, 2:], second.states(times[2:] - at), atol=1e-9)
    commands.forget(at + 0.1)
    np.testing.assert_array_equal(commands.states(times[4:]), found[:, 4:])


def test_an_earlier_start_drops_motions_that_wait() -> None:
    commands = Commands(NAMES, LIMITS, ZERO)
    commands.send(MOTION, 2.0, 0.0)
    commands.send(line(ZERO, -GOAL), 1.0, 0.0)
    np.testing.assert_allclose(commands.states(np.array([9.0]))[0, 0], -GOAL, atol=1e-12)


@given(st.floats(0.0, 1.0))
def test_a_stop_ends_at_rest_within_the_limits(share: float) -> None:
    commands, now = Commands(NAMES, LIMITS, ZERO), 0.5 + share * MOTION.duration
    commands.send(MOTION, 0.5, 0.0)
    commands.stop(now)
    times = np.arange(0.0, 4.0, 0.001)
    q, v, a = commands.states(times)
    assert commands.end <= 0.5 + MOTION.duration + 1e-9
    before = times <= now
    np.testing.assert_allclose(q[before], MOTION.states(times[before] - 0.5)[0], atol=1e-9)
    assert (np.abs(v) <= 1.5 * 1.001).all() and (np.abs(a) <= 8.0 * 1.001).all()
    np.testing.assert_allclose(np.diff(q, axis=0) / 0.001, v[:-1], atol=0.01)  # nothing jumps
    np.testing.assert_allclose(np.diff(v, axis=0) / 0.001, a[:-1], atol=0.3)
    assert not v[times > commands.end].any() and not a[times > commands.end].any()


def test_a_stop_drops_motions_that_wait() -> None:
    commands = Commands(NAMES, LIMITS, ZERO)
    commands.send(MOTION, 1.0, 0.0)
    commands.stop(0.5)
    assert commands.end == 0.0 and not commands.states(np.array([3.0])).any()


@pytest.mark.parametrize("off", [1.001e-3, -5e-3])
def test_another_start_is_refused(off: float) -> None:
    commands = Commands(NAMES, LIMITS, ZERO)
    with pytest.raises(ParameterError, match=r"motion: expected a start within 0\.001 .* position of b"):
        commands.send(line(np.array([0.0, off]), GOAL), 0.0, 0.0)
    commands.send(line(np.array([0.0, 0.9e-3]), GOAL), 0.0, 0.0)
    Commands(NAMES, LIMITS, ZERO, tolerance=0.01).send(line(np.array([0.0, off]), GOAL), 0.0, 0.0)


def test_a_start_at_rest_is_refused_while_the_robot_moves() -> None:
    commands, middle = Commands(NAMES, LIMITS, ZERO), 0.5 * MOTION.duration
    commands.send(MOTION, 0.0, 0.0)
    with pytest.raises(ParameterError, match="velocity of"):
        commands.send(line(MOTION(middle), ZERO), middle, 0.0)


def test_bad_motions_are_refused() -> None:
    commands = Commands(NAMES, LIMITS, ZERO)
    commands.send(MOTION, 0.0, 0.0)
    with pytest.raises(ParameterError, match="at: expected a time that is not over, 0.2 s or later"):
        commands.send(MOTION, 0.1, 0.2)
    with pytest.raises(ParameterError, match="at: expected finite numbers"):
        commands.send(MOTION, float("nan"), 0.0)
    with pytest.raises(ParameterError, match="motion: expected the joints a, b"):
        commands.send(changed(joint_names=("b", "a")), 0.0, 0.0)
    with pytest.raises(ParameterError, match="motion: velocities: expected finite"):
        commands.send(changed(velocities=np.full_like(MOTION.velocities, np.nan)), 0.0, 0.0)
    with pytest.raises(ParameterError, match="of the velocity limit"):
        commands.send(MOTION.slower(0.5), 0.0, 0.0)
    with pytest.raises(ParameterError, match="a motion that ends at rest"):
        commands.send(MOTION.before(0.5 * MOTION.duration), 0.0, 0.0)
    np.testing.assert_array_equal(commands.states(np.array([0.4])), MOTION.states(np.array([0.4])))  # nothing changed
    with pytest.raises(ParameterError, match="tolerance"):
        Commands(NAMES, LIMITS, ZERO, tolerance=0.0)
    with pytest.raises(ParameterError, match="position"):
        Commands(NAMES, LIMITS, np.zeros(3))
