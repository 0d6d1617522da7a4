from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from timings import LIMITS, NAMES, RATE, paths, timed

from apex_ompl.errors import TimingError
from apex_ompl.timing import Timing, time_path
from apex_ompl.timing.ruckig_method import between, through
from apex_ompl.timing.trajectory import joined


@settings(max_examples=30)
@given(path=paths(), seed=st.integers(0, 999), share=st.sampled_from([0.1, 0.6, 0.95]))
def test_motions_begin_with_a_velocity(path: np.ndarray, seed: int, share: float) -> None:
    rng = np.random.default_rng(seed)
    path = np.clip(path, -2.0, 2.0)
    velocity = share * LIMITS.velocity * rng.uniform(-1.0, 1.0, 3)
    acceleration = LIMITS.acceleration * rng.uniform(-1.0, 1.0, 3)
    start = Timing(start_velocity=velocity, start_acceleration=acceleration)
    try:
        made = time_path(path, LIMITS, NAMES, start)
    except TimingError as error:  # it cannot even brake within the limits
        assert "velocity at the start" in str(error)
        assert np.any(np.abs(velocity) + acceleration**2 / (2.0 * LIMITS.jerk) > LIMITS.velocity)
        return
    motion = made.trajectory
    assert made.form.startswith("moving start")
    np.testing.assert_allclose(motion(0.0, 1), velocity, atol=1e-9)
    np.testing.assert_allclose(motion(0.0, 2), acceleration, atol=1e-9)
    np.testing.assert_array_equal(motion.positions[[0, -1]], path[[0, -1]])
    assert not motion.velocities[-1].any() and max(motion.use(LIMITS).values()) <= 1.0 + 1e-9
    times = np.arange(0.0, motion.duration, RATE)
    change = motion(times)
    for order, limit in enumerate((LIMITS.velocity, LIMITS.acceleration, LIMITS.jerk), 1):
        change = np.diff(change, axis=0)
        assert np.all(np.abs(change) / RATE**order <= limit * (1.0 + 1e-6) + 1e-4)


def test_a_moving_start_is_no_slower_than_rest_where_the_path_goes_its_way() -> None:
    path = np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
    moving = timed(path, Timing(start_velocity=(1.5, 0.0, 0.0))).trajectory
    assert moving.duration < timed(path).trajectory.duration - 0.05
    late = timed(path, Timing(start_velocity=(1.5, 0.0, 0.0), minimum_duration=4.0)).trajectory
    assert late.duration >= 4.0 - 1e-6 and late(0.0, 1)[0] == pytest.approx(1.5)


@settings(max_examples=30)
@given(seed=st.integers(0, 9999), pieces=st.integers(1, 4))
def test_motions_through_states_are_the_motions_between_them(seed: int, pieces: int) -> None:
    rng = np.random.default_rng(seed)
    states = rng.uniform(-1.0, 1.0, (3, pieces + 1, 3)) * np.array([1.5, 0.3, 0.1])[:, None, None]
    states[1:, -1] = 0.0
    each, solved = [between(states[:, k : k + 2], LIMITS, NAMES) for k in range(pieces)], list[int]()
    made = through(states, LIMITS, NAMES, solving=lambda: solved.append(1))
    if made is None:
        assert any(one is None for one in each)
        return
    wanted = joined([one for one in each if one is not None])
    assert len(solved) == pieces and made.duration == pytest.approx(wanted.duration, abs=1e-8)
    np.testing.assert_allclose(made.states(wanted.times), wanted.states(wanted.times), atol=1e-4)
    np.testing.assert_array_equal(made.positions[-1], states[0, -1])
    assert through(states, LIMITS, NAMES, 0.999 * made.duration) is None, "it is too long"
    assert through(states, LIMITS, NAMES, 1.001 * made.duration) is not None
