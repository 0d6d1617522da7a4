"""Parts of motions that are brought to rest: within the limits, along the path, against the motion itself."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from apex_ompl.errors import ParameterError
from apex_ompl.paths.path import Path
from apex_ompl.robot import load_robot
from apex_ompl.timing import Trajectory, time_path
from apex_ompl.timing.rests import AT_REST, from_rest_to_rest, rests

ROBOT = load_robot("panda")


@cache
def motion(seed: int) -> Trajectory:
    """A motion through random states, at rest at its ends alone."""
    states = ROBOT.random_state(np.random.default_rng(seed), 4)
    timed = time_path(Path(states), ROBOT.limits, ROBOT.joint_names).trajectory
    assert len(rests(timed)) == 2
    return timed


@settings(max_examples=40, deadline=None)
@example(0, 0.4, 0.002)  # some milliseconds
@given(st.integers(0, 3), st.floats(0.0, 0.9), st.floats(0.02, 1.0))
def test_a_part_is_at_rest_at_its_ends_within_the_limits_and_on_the_path(seed: int, start: float, share: float) -> None:
    whole = motion(seed)
    first = start * whole.duration
    last = first + share * (whole.duration - first)
    part, there, times = from_rest_to_rest(whole, first, last, ROBOT.limits)
    for k, time in ((0, first), (-1, last)):
        assert np.abs(part.velocities[k]).max() <= AT_REST
        np.testing.assert_allclose(part.positions[k], whole(time), atol=1e-9)
    assert max(part.use(ROBOT.limits).values()) <= max(1.0, *whole.use(ROBOT.limits).values()) + 1e-6
    assert (np.diff(there) >= -1e-9).all() and there[0] == pytest.approx(first) and there[-1] == pytest.approx(last)
    assert (np.diff(times) >= 0.0).all() and times[-1] == pytest.approx(part.duration)
    dense = np.linspace(0.0, part.duration, 500)
    off = np.abs(part(dense) - whole(np.interp(dense, times, there))).max()
    assert off < 4e-3
    assert part.duration >= last - first - 1e-9


def test_a_part_that_rests_by_itself_is_not_changed() -> None:
    whole = motion(0)
    part, there, times = from_rest_to_rest(whole, 0.0, whole.duration, ROBOT.limits)
    np.testing.assert_array_equal(part.positions, whole.positions)
    assert there.tolist() == [0.0, whole.duration] and times.tolist() == [0.0, part.duration]


def test_what_exceeds_the_limits_is_named() -> None:
    whole = motion(0)
    tight = replace(ROBOT.limits, acceleration=1e-4 * ROBOT.limits.acceleration)
    with pytest.raises(ParameterError, match="come to rest within the limits"):
        from_rest_to_rest(whole, 0.4 * whole.duration, 0.6 * whole.duration, tight)
