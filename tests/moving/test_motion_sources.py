"""Where motions to start from come from, and how they are made faster."""

from __future__ import annotations

import math

import numpy as np
import pytest
from loops import FAR, PROBLEM, context_of, line_from

from apex_ompl.loop.replan.portfolio import faster_motions
from apex_ompl.loop.replan.sources import Renoised
from apex_ompl.moving.compute_costs import ComputeBudget
from apex_ompl.moving.context import Following, RunContext
from apex_ompl.moving.dynamic_obstacles import DynamicObstacles
from apex_ompl.moving.replanner import Request
from apex_ompl.moving.search import EARLIER, Search
from apex_ompl.timing.spline_method import least_knot_spacing
from apex_ompl.timing.timed_spline import Start, TimedSpline


@pytest.fixture(scope="module")
def context() -> RunContext:
    return context_of(PROBLEM, hastens=True)


def search_of(context: RunContext, *, slower: float = 1.5, conflict: float = np.inf) -> Search:
    """A replan 0.3 s after the start of the straight motion to the goal, made slower."""
    motion = line_from(context, Start.at_rest(context.setup.start), context.goals[0]).slower(slower)
    one, dynamic = Following(motion, 0.0, to_goal=True), DynamicObstacles([FAR])
    request = Request(1, 0.25, 0.3, one, one, dynamic, 0.0, (FAR,), conflict, 0)
    return Search(context, request, ComputeBudget(0.05))


def test_direct_motions_begin_as_the_robot_moves_and_are_the_fastest(context: RunContext) -> None:
    search = search_of(context)
    motion = search.direct(context.goals[0])
    assert motion is not None
    for order, (given, rows) in enumerate(
        zip(search.start, (motion.positions, motion.velocities, motion.accelerations), strict=True)
    ):
        assert np.abs(rows[0] - given).max() < 1e-9, order
    assert np.array_equal(motion.positions[-1], context.goals[0]) and not motion.velocities[-1].any()
    use = motion.use(context.limits)
    assert 0.99 < max(use[name] for name in ("velocity", "acceleration", "jerk")) <= 1.0 + 1e-9
    assert motion.duration < search.request.following.end - search.request.join
    slow = search.direct(context.goals[0], 2.0 * motion.duration)
    assert slow is not None and slow.duration >= 2.0 * motion.duration - 1e-9


def test_a_path_along_which_nothing_strays_is_the_direct_motion(context: RunContext) -> None:
    search, goal = search_of(context), context.goals[0]
    line = np.linspace(search.start.position, goal, 20)
    made, direct = search.shaped(line, goal, 0.0), search.direct(goal)
    assert made is not None and direct is not None and made[1] == direct.duration
    assert np.abs(made[0] - direct(np.linspace(0.0, direct.duration, len(made[0])))).max() < 1e-9
    bent = line + 0.2 * np.sin(np.pi * np.linspace(0.0, 1.0, 20))[:, None]
    strays = search.shaped(bent, goal, 0.0)
    assert strays is not None and 0.15 < np.abs(strays[0] - made[0]).max() < 0.25
    assert np.abs(strays[0][[0, -1]] - made[0][[0, -1]]).max() < 1e-6


def test_splines_from_a_moving_start_need_little_more_time_than_the_direct_motion(context: RunContext) -> None:
    """With states at even times as control points one knot spacing apart, from the start; 4 times it otherwise."""
    search, goal = search_of(context), context.goals[0]
    direct = search.direct(goal)
    assert direct is not None
    states = direct(np.linspace(0.0, direct.duration, 64))
    spline = TimedSpline.along(states, direct.duration, search.start, goal)
    for _ in range(20):
        least = least_knot_spacing(spline.control, context.limits)
        if least <= spline.spacing:
            break
        spline = spline.lasting(max(least, 1.01 * spline.spacing))
    assert direct.duration < spline.duration < 1.6 * direct.duration


def test_faster_motions_go_through_states_of_the_given_one(context: RunContext) -> None:
    search = search_of(context)
    rest = search.request.following.piece(search.request.join, search.request.following.end)
    found = list(faster_motions(search, rest))
    assert found
    for motion in found:
        assert motion.duration <= rest.duration - EARLIER and context.keeps_limits(motion)
        assert np.abs(motion.positions[0] - search.start.position).max() < 1e-9
        assert np.array_equal(motion.positions[-1], context.goals[0])
        middle = rest(np.linspace(0.0, rest.duration, 13)[1:-1])  # halves, thirds and quarters
        away = np.abs(motion.positions[:, None] - middle).max(axis=2).min(axis=0)
        assert away.min() < 1e-9


def test_only_faster_motions_are_wanted_where_there_is_no_conflict(context: RunContext) -> None:
    search, urgent = search_of(context), search_of(context, conflict=0.6)
    left = search.request.following.end - search.request.join
    assert search.wanted() == pytest.approx(left - EARLIER) and urgent.wanted() == np.inf
    assert not search.take(search.request.following.piece(0.3, 0.3 + left), "same") and search.best is None


def test_the_rest_of_the_motion_noised_and_denoised_again_strays_from_it(context: RunContext) -> None:
    source, search = Renoised(), search_of(context, conflict=0.6)
    source.prepare(context)
    initial_motions = list(source.initial_motions(search))
    assert len(initial_motions) == source.count and search.budget.counts["proposal"] == source.count
    for initial in initial_motions:
        assert np.abs(initial.states[0] - search.start.position).max() < 1e-6
        assert np.abs(initial.states[-1] - context.goals[0]).max() < 1e-6
    assert np.abs(initial_motions[0].states - initial_motions[1].states).max() > 1e-3
    again = list(source.initial_motions(search_of(context, conflict=0.6)))
    assert all(np.array_equal(one.states, other.states) for one, other in zip(initial_motions, again, strict=True))


def test_looking_at_stops_ends_with_the_time(context: RunContext) -> None:
    """Of a long motion it would take more than the budget, and the answer would come too late each time."""
    short, long = search_of(context), search_of(context, slower=60.0)
    for search in (short, long):
        rest = search.request.following.piece(search.request.join, search.request.following.end)
        assert math.isinf(search.unguarded_from(rest)) == (search is short)
    assert long.budget.limit <= long.budget.spent < long.budget.limit + 1e-3
