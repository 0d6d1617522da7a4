"""Stops that are proved in advance, against the proofs that the guard makes one by one."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest
from loops import boxes, context_of

from apex_ompl.moving.context import Following, RunContext
from apex_ompl.moving.dynamic_obstacles import DynamicObstacles
from apex_ompl.moving.search import SPREAD
from apex_ompl.moving.stopping import stops_proved
from apex_ompl.timing import time_path

AGE, FASTEST = 0.08, 0.4
PROBLEM = "vertical/free/800000"


class Case(NamedTuple):
    context: RunContext
    dynamic: DynamicObstacles
    following: Following
    moments: np.ndarray


def case(seed: int) -> Case:
    """A motion that is clear of the robot itself, among boxes that go to where it may pass by."""
    rng = np.random.default_rng(seed)
    context = context_of(PROBLEM, speed=float(rng.choice([0.5, 1.0])), fastest=FASTEST)
    start, limits = context.setup.start, context.limits
    while True:
        goal = np.clip(start + rng.normal(0.0, 0.5, len(start)), limits.lower, limits.upper)
        motion = time_path(np.stack([start, goal]), limits, context.names).trajectory
        if context.clear_of_static(motion):
            break
    following = Following(motion, float(rng.uniform(0.0, 2.0)))
    dynamic = DynamicObstacles(
        boxes(seed, FASTEST)[: 1 + seed % 2], stamp=following.start_time - float(rng.uniform(0.0, 0.1))
    )
    return Case(context, dynamic, following, np.arange(following.start_time, following.end, 0.02))


def proved(one: Case, time: float) -> Following | None:
    """The stop that the guard would prove at a time, by what is known then."""
    settings, seen = one.context.settings, one.dynamic.larger(0.0)
    for name, place in one.dynamic.at(time - AGE).items():
        growth = settings.error + SPREAD, settings.fastest
        seen.update(name, place, (0.0, 0.0, 0.0), stamp=time - AGE, growth=growth)
    return one.context.proved_stop(seen, one.following, time, time + settings.period)


@pytest.mark.parametrize("seed", range(12))
def test_stops_are_foreseen_where_the_guard_proves_them(seed: int) -> None:
    one = case(seed)
    count, by_joints = one.context.foreseen_stops(one.dynamic, one.following, one.moments, AGE, SPREAD)
    stops = [proved(one, float(time)) for time in one.moments[: count + 1]]
    assert all(stop is not None for stop in stops[:count])
    assert count == len(one.moments) or stops[count] is None
    assert 0 <= by_joints <= len(stops)


def test_of_both_kinds_there_are_some_and_some_are_not_proved() -> None:
    ends = [
        one.context.foreseen_stops(one.dynamic, one.following, one.moments, AGE, SPREAD) for one in map(case, range(12))
    ]
    lengths = [len(case(seed).moments) for seed in range(12)]
    assert any(count == most for (count, _), most in zip(ends, lengths, strict=True))
    assert any(0 < count < most for (count, _), most in zip(ends, lengths, strict=True))
    assert any(by_joints for _, by_joints in ends)


def test_what_is_expected_is_left_as_it_was_and_without_obstacles_all_are_proved() -> None:
    one = case(1)
    before = [array.copy() for array in one.dynamic.packed]
    zero = one.following.start_time
    options: dict = {"clock": zero, "age": AGE, "growth": (0.03, FASTEST), "period": 0.01}
    some = one.context.kernel, one.dynamic, one.following.motion, one.context.stopping, one.moments - zero
    stops_proved(*some, **options)
    assert all(np.array_equal(a, b) for a, b in zip(before, one.dynamic.packed, strict=True))
    count, by_joints = stops_proved(some[0], DynamicObstacles([]), *some[2:], **options)
    assert count == len(one.moments) and not by_joints.any()
