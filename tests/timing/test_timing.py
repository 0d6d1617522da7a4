from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support import distance
from timings import LIMITS, NAMES, RATE, keeps_limits, paths, timed

from apex_ompl.errors import ParameterError, TimingError, UnknownNameError
from apex_ompl.kernel.timing import curve_duration, max_path_speeds
from apex_ompl.robot import Limits
from apex_ompl.timing import Timing, Trajectory, time_path
from apex_ompl.timing.curve import Curve, Polyline
from apex_ompl.timing.parameterization import DEFAULT_METHOD, METHODS


@settings(max_examples=24)
@given(
    path=paths(), deviation=st.sampled_from([0.2, 0.05, 0.01]), scale=st.sampled_from([1.0, 0.3, 0.01]),
    method=st.sampled_from(list(METHODS)),
)  # fmt: skip
def test_motions_keep_all_limits_and_stay_near_their_paths(
    path: np.ndarray, deviation: float, scale: float, method: str
) -> None:
    path = np.clip(path, -3.0, 3.0)
    timing = Timing(method, deviation=deviation, jerk_scale=scale)
    made = timed(path, timing)
    motion = made.trajectory
    assert keeps_limits(motion, timing.limits(LIMITS, NAMES))
    np.testing.assert_array_equal(motion.positions[[0, -1]], path[[0, -1]])
    assert not motion.velocities[[0, -1]].any() and not motion.accelerations[[0, -1]].any()
    assert made.deviation <= deviation
    dense = motion(np.linspace(0.0, motion.duration, 5_001))
    assert distance(dense, path) <= made.deviation + 1e-9, "measured against all sides"


def test_the_method_is_chosen_by_name_and_reported() -> None:
    path = np.array([[0.0, 0.0, 0.0], [1.0, 0.5, 0.0], [1.0, 1.0, 1.0]])
    by = {method: timed(path, Timing(method)) for method in METHODS}
    assert {method: made.method for method, made in by.items()} == {"ruckig": "ruckig", "spline": "spline"}
    assert timed(path).method == DEFAULT_METHOD == "ruckig"
    assert by["ruckig"].trajectory.duration == pytest.approx(by["spline"].trajectory.duration, rel=1e-3)
    assert np.abs(by["ruckig"].trajectory.jerks).max() > np.abs(by["spline"].trajectory.jerks).max()
    assert timed(path[:2], Timing("spline")).method == "ruckig", "a straight line"
    with pytest.raises(UnknownNameError, match="timing method 'ruckik', did you mean 'ruckig'"):
        Timing("ruckik")


def test_where_ruckig_would_leave_the_position_limits_the_spline_takes_its_place() -> None:
    """A joint that swings from limit to limit overshoots between the states that Ruckig is given."""
    t = np.linspace(0.0, 1.0, 256)
    path = np.stack([3.0 * np.sin(20.0 * t), np.sin(5.0 * t), t], 1)
    made = timed(path)
    assert keeps_limits(made.trajectory) and made.form == "blended"


def test_ten_thousand_points_keep_the_limits() -> None:
    t = np.linspace(0.0, 1.0, 10_000)[:, None]
    path = np.cos(7.0 * t * np.array([1.0, 1.3, 0.7])) + np.random.default_rng(0).normal(0.0, 1e-4, (10_000, 3))
    made = timed(path)
    assert made.form == "blended" and keeps_limits(made.trajectory) and made.deviation < 0.05


@pytest.mark.parametrize("length", [1e-4, 0.01, 0.6, 4.0])
def test_a_straight_line_takes_half_a_percent_more_than_the_least_time_there_is(length: float) -> None:
    """Seven phases of constant jerk, each as long as its limit lets it be (Biagiotti and Melchiorri 2008, 3.4)."""
    v, a, j = 2.0, 10.0, 5000.0
    path = np.array([[-length / 2.0, 0.0, 0.0], [length / 2.0, 0.0, 0.0]])
    ramp = v / a + a / j if v * j >= a**2 else 2.0 * np.sqrt(v / j)
    if length >= v * ramp:
        least = length / v + ramp
    elif length >= 2.0 * a**3 / j**2:
        least = a / j + np.sqrt((a / j) ** 2 + 4.0 * length / a)
    else:
        least = 4.0 * np.cbrt(length / (2.0 * j))
    made = timed(path)
    assert made.form == "line" and made.deviation == 0.0
    motion = made.trajectory
    if length > 1e-3:
        assert motion.duration == pytest.approx(1.005 * least, rel=5e-4)
    else:  # its largest acceleration would last for less than a millisecond
        assert least < motion.duration < 1.05 * least
    assert keeps_limits(motion) and np.diff(motion.times).min() >= 1e-3 - 1e-12 and len(motion.times) <= 8
    assert np.abs(motion.jerks).max() < 0.995 * j, "in exchange for the time"


@pytest.mark.parametrize("jerk", [1e8, 1e11, 1e12, 1e300, np.inf])
def test_without_a_limit_of_jerk_motions_are_the_fastest_within_the_others(jerk: float) -> None:
    """A large number counts as none. Along a line they speed up and slow down at the limits."""
    free = replace(LIMITS, jerk=np.full(3, jerk))
    path = np.array([[0.0, 0.0, 0.0], [0.3, 0.0, 0.0], [0.3, 0.0, 0.4], [0.0, 0.2, 0.0]])
    made = timed(path[:2], limits=free).trajectory
    least = 2.0 * np.sqrt(0.3 / LIMITS.acceleration[0])
    assert least < made.duration <= 1.0051 * least and np.diff(made.times).min() >= 1e-3 - 1e-12
    for method in METHODS:
        limited, motion = (timed(path, Timing(method), limits=one).trajectory for one in (LIMITS, free))
        assert motion.duration <= limited.duration * (1.0 + 1e-3)
        assert keeps_limits(motion, free) and np.isfinite(motion.jerks).all()


@pytest.mark.parametrize("limit", ["velocity", "acceleration", "jerk"])
@pytest.mark.parametrize("value", [0.0, -1.0, np.nan])
def test_a_limit_that_is_not_positive_is_named(limit: str, value: float) -> None:
    faulty = replace(LIMITS, **{limit: np.array([1.0, value, 1.0])})
    for count in (2, 3):
        with pytest.raises(ParameterError, match=rf"^{limit} limit of two: expected a positive number, got {value}$"):
            timed(np.eye(3)[:count], limits=faulty)


def test_a_gentle_curve_takes_little_more_than_the_least_time() -> None:
    angle = np.linspace(0.0, np.pi, 256)
    path = np.stack([1.5 * np.cos(angle), 1.5 * np.sin(angle), np.zeros(256)], 1)
    stiff = Limits(np.full(3, -3.0), np.full(3, 3.0), np.full(3, 2.0), np.full(3, 10.0), np.full(3, 1e6))
    first, second = Curve.along(Polyline.through(path), 0.01).derivatives(10)
    step = Polyline.through(path).length / (len(first) - 1)
    least = curve_duration(max_path_speeds(first, second, stiff.velocity, stiff.acceleration, step), step)
    made = timed(path, limits=stiff)
    assert 0.995 * least < made.trajectory.duration < 1.05 * least


def test_paths_without_length_stand_still() -> None:
    for path in (np.ones((1, 3)), np.ones((7, 3))):
        motion = timed(path).trajectory
        assert motion.duration == 0.0 and motion.positions.tolist() == [path[0].tolist()]
        assert motion.use(LIMITS)["velocity"] == 0.0
    for apart in (1e-12, 5e-10, 1e-8, 1e-6):  # as good as none, and yet another state bit for bit
        path = np.linspace(0.0, apart, 1000)[:, None] * np.ones(3)
        motion = timed(path).trajectory
        assert motion.duration < 0.1 and keeps_limits(motion)
        np.testing.assert_array_equal(motion.positions[[0, -1]], path[[0, -1]])
        np.testing.assert_array_equal(motion.sample(0.01).position[[0, -1]], path[[0, -1]])
    pushed = timed(np.ones((1, 3)), Timing(start_velocity=(0.5, 0.0, 0.0)))
    assert 0.0 < pushed.deviation < 0.1 and pushed.trajectory.positions[-1].tolist() == [1.0] * 3
    motion = timed(np.ones((1, 3)), Timing(minimum_duration=2.0)).trajectory
    assert motion.duration == 2.0 and not motion(np.linspace(0, 2, 9), 1).any()


def test_scales_and_a_minimum_duration_slow_the_motion() -> None:
    path = np.array([[0.0, 0.0, 0.0], [1.0, 0.3, 0.0], [1.0, -0.5, 1.0]])
    quick = timed(path).trajectory
    for name in ("velocity_scale", "acceleration_scale", "jerk_scale"):
        scales = Timing(**{name: 0.02 if name == "jerk_scale" else 0.25})
        slow = timed(path, scales).trajectory
        assert slow.duration > 1.3 * quick.duration and keeps_limits(slow, scales.limits(LIMITS, NAMES))
    late = timed(path, Timing(minimum_duration=9.0)).trajectory
    assert late.duration == pytest.approx(9.0, abs=1e-9) and keeps_limits(late)
    assert timed(path, Timing(minimum_duration=0.01)).trajectory.duration == quick.duration


def test_where_a_motion_is_at_fault_it_stays_closer_and_stops_at_last() -> None:
    path = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [1.0, 1.0, 1.5]])
    tried: list[float] = []

    def leaves(motion: Trajectory) -> str:
        tried.append(distance(motion.sample(0.001).position, path))
        return "it leaves the path" if tried[-1] > 1e-4 else ""

    made = timed(path, fault=leaves)
    assert made.form == "stops" and tried[-1] < 1e-9 and keeps_limits(made.trajectory)
    assert len(tried) > 6 and all(later < 0.8 * earlier for earlier, later in pairwise(tried))
    for corner in path[1:-1]:
        near = int(np.argmin(np.linalg.norm(made.trajectory.positions - corner, axis=1)))
        np.testing.assert_allclose(made.trajectory.velocities[near], 0.0, atol=1e-12)
    with pytest.raises(TimingError, match="never good"):
        timed(path, fault=lambda motion: "never good")


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"velocity_scale": 0.0}, "velocity_scale"), ({"acceleration_scale": 1.1}, "acceleration_scale"),
        ({"jerk_scale": np.nan}, "jerk_scale"), ({"deviation": 0.0}, "deviation"), ({"deviation": "x"}, "deviation"),
        ({"velocity_scale": 1e-9}, "velocity_scale"), ({"minimum_duration": 1e300}, "minimum_duration"),
        ({"start_velocity": "abc"}, "start_velocity"), ({"start_velocity": [[1.0], [1.0, 2.0]]}, "start_velocity"),
        ({"minimum_duration": -1.0}, "minimum_duration"), ({"start_velocity": (1.0,)}, "start_velocity"),
        ({"start_velocity": (9.0, 0.0, 0.0)}, "start_velocity"), ({"start_acceleration": (0, 0, 99)}, "start_acc"),
        ({"start_velocity": (np.nan, 0.0, 0.0)}, "start_velocity"),
    ],
)  # fmt: skip
def test_faulty_options_are_named(options: dict[str, object], words: str) -> None:
    with pytest.raises(ParameterError, match=words):
        time_path(np.zeros((2, 3)), LIMITS, NAMES, Timing(**options))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "path",
    [np.zeros((2, 4)), np.zeros(3), np.zeros((0, 3)), np.full((2, 3), np.nan), [[0, 0, 0], [0, 0]], "abc",
     [[0, 0, 0], [0, 3.01, 0]], np.full((2, 3), 1e200)],
)  # fmt: skip
def test_faulty_paths_are_named(path: object) -> None:
    with pytest.raises(ParameterError, match="path"):
        time_path(path, LIMITS, NAMES)  # type: ignore[arg-type]


def test_faulty_arguments_are_named() -> None:
    with pytest.raises(ParameterError, match="timing"):
        time_path(np.zeros((2, 3)), LIMITS, NAMES, 0.5)  # type: ignore[arg-type]
    with pytest.raises(ParameterError, match="limits: expected a Limits"):
        time_path(np.zeros((2, 3)), 5.0, NAMES)  # type: ignore[arg-type]
    with pytest.raises(ParameterError, match="joint_names"):
        time_path(np.zeros((2, 3)), LIMITS, ("one", "two"))
    assert Timing(start_velocity=[1.0, 0.0]) == Timing(start_velocity=np.array([1.0, 0.0]))


def test_joints_that_stay_at_their_limits_do_not_stop_the_motion() -> None:
    """By rounding a mean of equal numbers may be over them."""
    t = np.linspace(0.0, 1.0, 256)
    path = np.stack([np.full(256, LIMITS.upper[0]), np.sin(5.0 * t), np.full(256, LIMITS.lower[2])], 1)

    def outside(motion: Trajectory) -> str:
        over = (motion.positions < LIMITS.lower) | (motion.positions > LIMITS.upper)
        return "outside" if over.any() else ""

    assert timed(path, fault=outside).form == "blended"


def test_extreme_options_take_no_extreme_time() -> None:
    path = np.array([[0.0, 0.0, 0.0], [1.0, 0.3, 0.0], [1.0, -0.5, 1.0]])
    extremes = ({"velocity_scale": 1e-3}, {"acceleration_scale": 1e-3}, {"jerk_scale": 1e-3}, {"deviation": 1e-3})
    for options in (*extremes, {"minimum_duration": 3600.0}, {"deviation": 10.0}):
        timing = Timing(**options)  # type: ignore[arg-type]
        motion = timed(path, timing).trajectory
        assert len(motion.times) < 10_000 and max(motion.use(timing.limits(LIMITS, NAMES)).values()) <= 1.0 + 1e-9
        assert motion.spectral_arc_length < 0.0
    late = timed(path, Timing(start_velocity=(0.1, 0.1, 0.0), minimum_duration=3600.0)).trajectory
    assert late.duration >= 3600.0 - 1e-6 and max(late.use(LIMITS).values()) <= 1.0 + 1e-9


def test_limits_of_single_joints_are_lowered_for_a_plan() -> None:
    path = np.array([[-1.0, -1.0, -1.0], [1.0, 0.5, 0.0], [0.0, 1.0, 1.0], [1.0, -1.0, 0.5]])
    full = timed(path)
    lowered = Timing(max_velocity={"two": 0.3}, max_jerk={"one": 5.0}, velocity_scale=0.5)
    slow = timed(path, lowered).trajectory
    assert slow.duration > full.trajectory.duration
    assert keeps_limits(slow, lowered.limits(LIMITS, NAMES))
    speeds = np.abs(np.diff(slow(np.arange(0.0, slow.duration, RATE)), axis=0)).max(axis=0) / RATE
    assert speeds[1] <= 0.15 * (1.0 + 1e-6), "the scale comes on top"
    for options, error, said in (
        ({"max_velocity": {"four": 0.3}}, UnknownNameError, "unknown joint 'four'"),
        ({"max_velocity": {"two": 99.0}}, ParameterError, "max_velocity.two.*the robot's limit"),
        ({"max_jerk": {"two": -1.0}}, ParameterError, "max_jerk.two.*a positive number"),
        ({"max_acceleration": 1.0}, ParameterError, "max_acceleration.*by joint name"),
        ({"max_velocity": {"two": 10**400}}, ParameterError, "max_velocity.two: expected a positive number, got 1000"),
        ({"max_velocity": {5: 1.0}}, UnknownNameError, "unknown joint 5; known: one, three, two"),
        ({"method": []}, UnknownNameError, r"unknown timing method \[\]; known: ruckig, spline"),
        ({"method": 3}, UnknownNameError, "unknown timing method 3"),
    ):
        with pytest.raises(error, match=said):
            timed(path, Timing(**options))  # type: ignore[arg-type]
