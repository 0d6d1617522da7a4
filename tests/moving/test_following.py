"""Motions that are followed by a clock: pieces of them, and what the robot did, against their own values."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from runs import motion_between, moved

from apex_ompl.moving.context import Following, executed
from apex_ompl.moving.stopping import stop
from apex_ompl.problems.suite_robot import robot
from apex_ompl.timing import Trajectory

BEGIN = 0.37
shares = st.floats(0.0, 1.0)


@cache
def motion() -> Trajectory:
    one = robot()
    return motion_between(one, one.home, moved(one, left_joint1=-0.7, right_joint3=0.4), speed=1.0)


def one() -> Following:
    return Following(motion(), BEGIN)


def values(following: Following, time: float) -> np.ndarray:
    """Position, velocity and acceleration by the motion's own polynomials."""
    m, at = following.motion, max(time - following.start_time, 0.0)
    if at >= m.duration:
        return np.stack([m.positions[-1], np.zeros(m.dof), np.zeros(m.dof)])
    k = max(int(np.searchsorted(m.times, at, side="right")) - 1, 0)
    h, jerk = at - m.times[k], (m.accelerations[k + 1] - m.accelerations[k]) / (m.times[k + 1] - m.times[k])
    q, v, a = m.positions[k], m.velocities[k], m.accelerations[k]
    return np.stack([q + h * v + h**2 / 2 * a + h**3 / 6 * jerk, v + h * a + h**2 / 2 * jerk, a + h * jerk])


def check(found: Trajectory, expected, begin: float, end: float) -> None:
    """A motion is what is expected from a time of the clock to another one, everywhere."""
    assert found.duration == pytest.approx(end - begin, abs=1e-8)
    for at in np.concatenate([np.linspace(0.0, found.duration, 60), found.times]):
        got = np.stack([found(at, order) for order in range(3)])
        np.testing.assert_allclose(got, expected(begin + at), rtol=0, atol=1e-9)


@settings(max_examples=40)
@given(shares, shares)
def test_pieces_are_the_motion(first: float, second: float) -> None:
    low, high = BEGIN - 0.3, BEGIN + 1.4 * motion().duration  # also before the start and after the end
    begin, end = sorted((low + first * (high - low), low + second * (high - low)))
    if end - begin > 1e-6:
        check(one().piece(begin, end), lambda t: values(one(), t), begin, end)


@pytest.mark.parametrize("knot", [0, 1, -2, -1])
def test_pieces_may_begin_and_end_at_knots(knot: int) -> None:
    time = BEGIN + float(motion().times[knot])
    for begin, end in ((time, time + 0.01), (time - 0.01, time), (time, time + 2 * motion().duration)):
        if begin >= BEGIN:
            check(one().piece(begin, end), lambda t: values(one(), t), begin, end)


def test_states_are_those_of_the_motion_and_rest_behind_it() -> None:
    for time in np.linspace(BEGIN, BEGIN + 2 * motion().duration, 200):
        np.testing.assert_allclose(np.stack(one().at(time)), values(one(), time), rtol=0, atol=1e-9)
        assert one().at_rest(time) == (time >= one().end - 1e-9)
    assert np.array_equal(one().state(one().end + 3.0), motion().positions[-1])
    assert not np.stack(one().at(one().end))[1:].any()
    assert np.array_equal(one().state(0.0), motion().positions[0]), "before it begins the robot is where it begins"


@settings(max_examples=20)
@given(shares)
def test_a_motion_behind_another_one_joins_it(share: float) -> None:
    join = BEGIN + share * motion().duration * 0.98 + 1e-3
    ended = stop(robot().limits, robot().joint_names, *one().at(join))
    then = Following(ended.trajectory, join, to_goal=True)
    both = then.after(one().piece(BEGIN, join), BEGIN)
    assert both.start_time == BEGIN and both.to_goal and both.end == pytest.approx(then.end, abs=1e-9)
    check(both.motion, lambda t: values(one() if t < join else then, t), BEGIN, then.end)


@settings(max_examples=20)
@given(st.lists(st.integers(0, 120), min_size=1, max_size=5, unique=True))
def test_what_was_executed_is_what_was_followed(ticks: list[int]) -> None:
    standing = Following.resting(robot().home, 0.0, robot().joint_names)
    followed = [(0.0, standing), (0.3, Following(motion(), 0.3))]
    for tick in sorted(ticks):  # a stop from wherever the robot is, and another one from that
        time = 0.3 + 0.01 * tick
        ended = stop(robot().limits, robot().joint_names, *followed[-1][1].at(time)).trajectory
        followed.append((time, Following(ended, time)))
    end = followed[-1][1].end + 0.25
    found = executed(followed, end)

    def expected(time: float) -> np.ndarray:
        return values(next(f for begin, f in reversed(followed) if begin <= time + 1e-9), time)

    check(found, expected, 0.0, end)
    for begin, _ in followed[1:]:
        for order, rate in ((0, 3.0), (1, 20.0), (2, 1e4)):
            jump = found(begin + 1e-7, order) - found(begin - 1e-7, order)
            assert np.abs(jump).max() < 3e-7 * rate
    assert not found.velocities[-1].any() and not found.accelerations[-1].any()


def test_motions_shorter_than_a_tick() -> None:
    home, names = robot().home, robot().joint_names
    there = moved(robot(), left_joint1=1e-7)
    short = motion_between(robot(), home, there, speed=1.0)
    assert 0.0 < short.duration < 0.01
    following = Following(short, 0.02)
    check(following.piece(0.02, 0.03), lambda t: values(following, t), 0.02, 0.03)
    found = executed([(0.0, Following.resting(home, 0.0, names)), (0.02, following)], 0.05)
    assert found.duration == pytest.approx(0.05) and np.array_equal(found.positions[-1], there)
    still = Following.resting(home, 1.0, names)
    assert still.end == 1.0 and still.at_rest(1.0) and np.array_equal(still.piece(1.0, 1.01).positions, [home, home])
    nothing = executed([(0.0, still)], 0.0)
    assert nothing.duration == 0.0 and np.array_equal(nothing.positions, [home])


@pytest.mark.parametrize("time", [0.0, BEGIN, BEGIN + 50.0])
def test_a_piece_of_no_length_is_a_state(time: float) -> None:
    piece = one().piece(time, time)
    assert piece.duration == 0.0 and np.array_equal(piece.positions, [values(one(), time)[0]])
    assert not piece.velocities.any() and not piece.accelerations.any()
