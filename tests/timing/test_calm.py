"""Ruckig's motions at the least jerk, and motions with other knots."""

from __future__ import annotations

import numpy as np
import pytest
import ruckig
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import make_interp_spline
from timings import LIMITS, NAMES, paths, timed

from apex_ompl.errors import ParameterError
from apex_ompl.robot import Limits
from apex_ompl.timing import Timing, Trajectory, joined, ruckig_method
from apex_ompl.timing.curve import Polyline
from apex_ompl.timing.ruckig_method import between, calm
from apex_ompl.timing.spline_method import blend
from apex_ompl.timing.timed_spline import Start, TimedSpline


def random_spline(seed: int, knots: int = 12, joints: int = 16) -> Trajectory:
    """A clamped cubic spline in time through random states, at rest at both ends except for the acceleration."""
    rng = np.random.default_rng(seed)
    times = np.round(np.linspace(0.0, 0.1 * (knots - 1), knots), 9)
    spline = make_interp_spline(times, np.cumsum(rng.normal(0.0, 0.02, (knots, joints)), 0), k=3, bc_type="clamped")
    made = np.unique(spline.t)
    states = np.stack([spline(made), spline(made, 1), spline(made, 2)])
    return Trajectory(made, *states, tuple(f"joint{k}" for k in range(joints)))


def limits_of(motion: Trajectory, room: float = 1.0) -> Limits:
    ones, times = np.ones(motion.dof), np.linspace(0.0, motion.duration, 20_001)
    largest = [np.full(motion.dof, room * 1.001 * np.abs(motion(times, order)).max()) for order in (1, 2, 3)]
    return Limits(-9.0 * ones, 9.0 * ones, *largest)


def pulses(motion: Trajectory, limits: Limits, share: float = 0.3) -> np.ndarray:
    """Intervals a second in which the acceleration is over a share of the limit, by joint."""
    over = np.abs(motion(np.linspace(0.0, motion.duration, 20_001), 2)) > share * limits.acceleration
    return ((over[1:] & ~over[:-1]).sum(axis=0) + over[0]) / motion.duration


@pytest.mark.parametrize("seed", range(6))
def test_ruckig_finds_splines_again(seed: int) -> None:
    """Its own ``at_time`` in each span, with the jerk limit of the span, is the motion that is handed out."""
    guide = random_spline(seed)
    made = calm(guide, limits_of(guide))
    assert made is not None and made.problems == len(made.trajectory.times) - 1
    motion = made.trajectory
    assert made.solved >= 0.9 * made.problems and made.method.startswith("ruckig")
    assert motion.deviation(guide) < 1e-4 and motion.duration == pytest.approx(guide.duration, abs=1e-9)
    query, solution = ruckig.InputParameter(16), ruckig.Trajectory(16)
    query.max_velocity, query.max_acceleration = [1e4] * 16, [1e4] * 16
    found = 0
    for k, length in enumerate(np.diff(motion.times).tolist()):
        for which, at in (("current", k), ("target", k + 1)):
            for name in ("position", "velocity", "acceleration"):
                setattr(query, f"{which}_{name}", getattr(motion, f"{name.replace('y', 'ie')}s"
                        if name == "velocity" else f"{name}s")[at].tolist())  # fmt: skip
        query.max_jerk = (1.0001 * np.abs(motion.jerks[k]) + 1e-5 / length**3).tolist()
        query.minimum_duration = length
        try:
            ruckig.Ruckig(16).calculate(query, solution)
        except ruckig.RuckigError:
            continue
        found += 1
        for since in np.linspace(0.0, solution.duration, 9):
            own = np.array(solution.at_time(float(since))[0])
            np.testing.assert_allclose(motion(motion.times[k] + since), own, atol=3e-6)
    assert found >= 0.9 * made.problems


def test_spans_that_ruckig_cannot_solve_stay_as_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    guide, asked = random_spline(0), list[float]()

    def calculate(solver: ruckig.Ruckig, query: ruckig.InputParameter, solution: ruckig.Trajectory) -> None:
        asked.append(query.minimum_duration)
        if len(asked) <= 4:
            raise ruckig.RuckigError("no solution")
        solver.calculate(query, solution)

    monkeypatch.setattr(ruckig_method, "calculate", calculate)
    made = calm(guide, limits_of(guide))
    assert made is not None and made.solved == made.problems - 2
    assert made.method == f"ruckig in {made.solved} of {made.problems} spans"
    assert made.trajectory.deviation(guide) < 1e-4


@settings(max_examples=25)
@given(seed=st.integers(0, 999))
def test_motions_along_curves_are_calm_and_have_few_knots(seed: int) -> None:
    rng = np.random.default_rng(seed)
    t = np.linspace(0.0, 1.0, 256)[:, None]
    path = np.sin(2.0 * np.pi * t * rng.uniform(0.1, 1.0, 3) + rng.uniform(0.0, 6.0, 3)) * rng.uniform(0.5, 2.5, 3)
    wide = Limits(LIMITS.lower, LIMITS.upper, LIMITS.velocity, LIMITS.acceleration, 500.0 * LIMITS.acceleration)
    made, spline = timed(path, limits=wide), timed(path, Timing("spline"), limits=wide).trajectory
    motion = made.trajectory
    assert made.method == "ruckig" and motion.duration <= 1.0001 * spline.duration
    assert np.diff(motion.times).min() >= 1.0 / 60.0 - 1e-9
    found, dense = motion.smoothness(wide), np.linspace(0.0, motion.duration, 100_001)[:-1]
    np.testing.assert_allclose(found.pulses, pulses(motion, wide), atol=1e-9)
    np.testing.assert_allclose(found.jerk, np.sqrt((motion(dense, 3) ** 2).mean(axis=0)) / wide.jerk, rtol=1e-2)
    assert np.median(found.pulses) <= 6.0 and found.jerk.max() <= 0.15


def test_spans_of_nearly_the_same_jerk_are_one_problem() -> None:
    t = np.linspace(0.0, 1.0, 256)[:, None]
    guide = blend(Polyline.through(np.hstack([t, t**2, 0.3 * np.sin(3.0 * t)])), LIMITS, NAMES, 0.05)
    assert guide is not None
    made = calm(guide.trajectory, LIMITS)
    assert made is not None and made.problems < len(guide.trajectory.times) - 1
    assert (
        max(made.trajectory.use(LIMITS).values()) <= 1.0 + 1e-9 and made.trajectory.deviation(guide.trajectory) < 1e-3
    )
    assert calm(guide.trajectory, LIMITS, lambda: True) is None


@settings(max_examples=40)
@given(seed=st.integers(0, 9999))
def test_knots_that_are_too_near_are_merged(seed: int) -> None:
    """Of a motion of Ruckig's from one moving state to another, whose joints switch at times of their own."""
    rng = np.random.default_rng(seed)
    dof = 8
    ones = np.ones(dof)
    limits = Limits(-9.0 * ones, 9.0 * ones, 2.0 * ones, 10.0 * ones, 5000.0 * ones)
    names = tuple(f"joint{k}" for k in range(dof))
    states = rng.uniform(-1.0, 1.0, (3, 2, dof)) * np.array([1.0, 0.5, 2.0])[:, None, None]
    motion = between(states, limits, names)
    assert motion is not None
    merged = motion.merged()
    assert np.diff(motion.times).min() < 1e-3 <= np.diff(merged.times).min() + 1e-9
    ticks = merged.times * 1e9
    np.testing.assert_allclose(ticks, np.round(ticks), atol=1e-5)
    for k in (0, -1):
        np.testing.assert_array_equal(merged.states(merged.times)[:, k], states[:, k])
    assert Trajectory(*merged.knots, names).merged() is not merged, "its knots join to a motion of constant jerk"
    assert merged.merged() is merged
    assert merged.deviation(motion) < 5e-4
    use = merged.use(limits)
    assert all(share <= 1.005 * max(motion.use(limits)[name], 0.05) for name, share in use.items())


def test_motions_at_a_rate_meet_the_motion_and_keep_its_limits() -> None:
    motion = timed(np.array([[0.0, 0.0, 0.0], [1.0, 0.5, 0.0], [1.0, 1.0, 1.0]])).trajectory
    for rate in (400.0, 1000.0):
        made = motion.resampled(rate)
        gaps = np.diff(made.times)
        np.testing.assert_allclose(gaps[:-1], 1.0 / rate, atol=1e-9)
        assert 1.0 / rate - 1e-9 <= gaps[-1] <= 2.0 / rate
        np.testing.assert_array_equal(made.positions[[0, -1]], motion.positions[[0, -1]])
        assert made.deviation(motion) < 1e-4 and motion.deviation(made) == made.deviation(motion)
        dense = np.linspace(0.0, motion.duration, 5001)
        assert made.deviation(motion) == pytest.approx(np.abs(made(dense) - motion(dense)).max(), rel=1e-2)
        for name, share in made.use(LIMITS).items():
            assert share <= 1.001 * motion.use(LIMITS)[name] + 1e-6
    with pytest.raises(ParameterError, match=r"rate: expected at least \d+ Hz, at which .*, got 10"):
        motion.resampled(10.0)
    for wrong in (0.0, -5.0, np.nan, "x", 1e9):
        with pytest.raises(ParameterError, match="rate"):
            motion.resampled(wrong)  # type: ignore[arg-type]
    still = Trajectory(np.zeros(1), np.ones((1, 2)), np.zeros((1, 2)), np.zeros((1, 2)), ("a", "b"))
    assert still.resampled(100.0) is still and still.merged() is still


@settings(max_examples=30)
@given(path=paths(), share=st.floats(0.0, 1.0))
def test_motions_stop_and_go_on(path: np.ndarray, share: float) -> None:
    motion = timed(np.clip(path, -2.9, 2.9)).trajectory
    time = share * motion.duration
    stopped = motion.stop_at(time, LIMITS)
    assert max(stopped.use(LIMITS).values()) <= 1.001 and stopped.duration <= motion.duration + 1e-9
    rest = motion.after(time).stop_at(0.0, LIMITS)
    for order in range(3):
        np.testing.assert_allclose(rest(0.0, order), motion(time, order), rtol=0.0, atol=1e-9)
    before = np.linspace(0.0, time, 101)
    assert np.abs(stopped(before) - motion(before)).max() < 2e-4
    np.testing.assert_allclose(stopped.velocities[-1], 0.0, atol=1e-9)
    np.testing.assert_array_equal(stopped.positions[0], motion.positions[0])
    end = time + (stopped.duration - time) + 0.01
    dense, near = motion(np.linspace(time, end, 4001)), stopped(np.linspace(time, stopped.duration, 41))
    apart = np.abs(near[:, None] - dense[None]).max(axis=2).min(axis=1)
    assert apart.max() <= 2e-3 + np.abs(np.diff(dense, axis=0)).max(), "it stops on its path"
    rest = stopped.positions[-1]
    if np.linalg.norm(rest - motion.positions[-1]) > 1e-6:
        on = timed(np.stack([rest, motion.positions[-1]])).trajectory
        whole = joined([stopped, on])
        np.testing.assert_array_equal(whole.positions[-1], motion.positions[-1])
        assert max(whole.use(LIMITS).values()) <= 1.001


def test_accelerations_of_merged_stops_keep_the_limits() -> None:
    rng = np.random.default_rng(9)
    for _ in range(60):
        motion = timed(np.stack([np.zeros(3), rng.uniform(-2.0, 2.0, 3)])).trajectory
        k = rng.integers(1, len(motion.times) // 2)
        time = motion.times[k] + rng.choice([-1.0, 1.0]) * rng.uniform(1e-4, 9e-4)  # so that knots are merged
        made = motion.stop_at(time, LIMITS)
        assert np.diff(made.times).min() >= 1e-3 - 1e-9
        assert made.use(LIMITS)["acceleration"] <= 1.0 + 5e-5


def test_a_motion_that_goes_on_stops_joint_by_joint() -> None:
    motion = timed(np.array([[0.0, 0.0, 0.0], [2.0, 1.0, 0.5]])).trajectory.before(0.5)
    assert motion.velocities[-1].any()
    stopped = motion.stop_at(0.4, LIMITS)
    assert max(stopped.use(LIMITS).values()) <= 1.001 and not stopped.velocities[-1].any()
    assert np.diff(stopped.times).min() >= 1e-3 - 1e-9
    brake = np.abs(motion(0.4, 1) / LIMITS.acceleration).max()
    assert stopped.duration - 0.4 <= brake + 2.0 * (LIMITS.acceleration / LIMITS.jerk).max() + 0.01
    for wrong in (-0.1, 0.6, np.nan):
        with pytest.raises(ParameterError, match="time"):
            motion.stop_at(wrong, LIMITS)
    slow = Limits(LIMITS.lower, LIMITS.upper, 0.1 * LIMITS.velocity, LIMITS.acceleration, LIMITS.jerk)
    with pytest.raises(ParameterError, match="velocity limit is used"):
        motion.stop_at(0.4, slow)
    tight = Limits(LIMITS.lower, motion(0.4) + 0.001, LIMITS.velocity, LIMITS.acceleration, LIMITS.jerk)
    with pytest.raises(ParameterError, match="limit"):
        motion.stop_at(0.4, tight)


def test_motions_are_joined_where_they_meet() -> None:
    one = timed(np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])).trajectory
    back = timed(np.array([[1.0, 0.0, 0.0], [0.0, 0.5, 0.0]])).trajectory
    whole = joined([one, back])
    assert whole.duration == pytest.approx(one.duration + back.duration) and whole.merged() is whole
    np.testing.assert_allclose(whole.before(one.duration).positions, one.positions)
    np.testing.assert_allclose(whole.after(one.duration)(0.2), back(0.2), atol=1e-12)
    for parts, words in (
        ([], "one motion or more"), ([one, one], r"parts\[1\].*last state"), ([back.selected(["two"]), back], "joints"),
    ):  # fmt: skip
        with pytest.raises(ParameterError, match=words):
            joined(parts)
    part = whole.selected(("three", "one"))
    assert part.joint_names == ("three", "one")
    np.testing.assert_array_equal(part(0.3), whole(0.3)[[2, 0]])
    for wrong in ((), ("one", "one"), ("four",), "one"):
        with pytest.raises(ParameterError, match="joints"):
            whole.selected(wrong)
    with pytest.raises(ParameterError, match="other"):
        whole.deviation(part)


def test_joints_that_turn_in_the_middle_of_a_span_are_solved() -> None:
    """Positions and accelerations are equal and velocities opposite at both ends: Ruckig 0.19.4 crashes on these."""
    control = np.array([0.0, 0.0, 0.0, 0.1, 0.2, 0.2, 0.1, 0.0, 0.0, 0.0])[:, None]
    motion = TimedSpline(control, 0.1, Start.at_rest(np.zeros(1))).trajectory(["joint"])
    middle = len(motion.times) // 2 - 1
    assert motion.positions[middle] == motion.positions[middle + 1]
    assert motion.velocities[middle] == -motion.velocities[middle + 1] != 0.0
    limits = Limits(*(np.full(1, bound) for bound in (-10.0, 10.0, 10.0, 100.0, 1e4)))
    made = calm(motion, limits, tolerance=0.0)
    assert made is not None and made.solved == made.problems
    np.testing.assert_allclose(made.trajectory(motion.times), motion.positions, atol=1e-12)
