from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from ruckig import InputParameter, Result, Ruckig, Trajectory

from apex_ompl.robot import Robot
from apex_ompl.robot.model import Limits
from apex_ompl.robot.rest_to_rest import direct_durations, direct_reach

largest = st.floats(0.1, 100.0)


@given(st.floats(1e-3, 20.0), largest, largest, largest)
def test_durations_are_ruckigs_and_the_reach_is_their_inverse(distance: float, v: float, a: float, j: float) -> None:
    one = np.ones(1)
    limits = Limits(-30 * one, 30 * one, v * one, a * one, j * one)
    duration = direct_durations(np.zeros(1), np.array([[distance], [-distance]]), limits)
    assert duration[0] == duration[1]
    asked, found = InputParameter(1), Trajectory(1)
    asked.target_position, asked.max_velocity = [distance], [v]
    asked.max_acceleration, asked.max_jerk = [a], limits.jerk.tolist()
    assert Ruckig(1).calculate(asked, found) == Result.Working
    assert duration[0] == pytest.approx(found.duration, rel=1e-6)
    assert direct_reach(float(duration[0]), limits)[0] == pytest.approx(distance, rel=1e-9)


def test_the_slowest_joint_counts(robot: Robot) -> None:
    limits = replace(robot.limits)
    reach = direct_reach(0.7, limits)
    assert direct_durations(np.zeros(robot.dof), reach[None], limits)[0] == pytest.approx(0.7)
    reach[3] *= 1.1
    assert direct_durations(np.zeros(robot.dof), reach[None], limits)[0] > 0.7
