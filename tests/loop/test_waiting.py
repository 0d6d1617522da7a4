"""What a robot does while no way to a goal is found: it waits near it, goes back, leaves, or searches by trees."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from loops import BLOCKED, FAR, PROBLEM, context_of, line_from

from apex_ompl.loop.replan import evasion
from apex_ompl.loop.replan.evasion import wait_nearer
from apex_ompl.loop.replan.portfolio import Portfolio
from apex_ompl.loop.replan.sources import WORK, Sprint
from apex_ompl.moving.compute_costs import ComputeBudget
from apex_ompl.moving.context import Following, RunContext
from apex_ompl.moving.dynamic_obstacles import DynamicObstacles
from apex_ompl.moving.replanner import Request
from apex_ompl.moving.search import Search
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.timing.timed_spline import Start


@pytest.fixture(scope="module")
def context() -> RunContext:
    return context_of(PROBLEM)


def cube(place: np.ndarray, edge: float = 0.1, velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Obstacle:
    return Obstacle(name="cube", box=(edge,) * 3, position=tuple(map(float, place)), velocity=velocity)


def palm(context: RunContext, q: np.ndarray) -> np.ndarray:
    return np.asarray(context.setup.robot.link_pose(q, "right_hand_palm")[:3, 3])


def search_of(
    context: RunContext,
    *obstacles: Obstacle,
    at: np.ndarray | None = None,
    conflict: float = np.inf,
    budget: float = 0.05,
) -> Search:
    """A replan of a robot that stands, at the start unless elsewhere, and for which none was found before."""
    standing = Following.resting(context.setup.start if at is None else at, 0.0, context.names)
    dynamic = DynamicObstacles(obstacles)
    request = Request(2, 0.0, 0.05, standing, None, dynamic, 0.0, obstacles, conflict, 0)
    return Search(context, request, ComputeBudget(budget))


def test_a_robot_waits_on_the_way_to_a_goal_that_is_blocked(context: RunContext) -> None:
    goal, start = context.goals[0], context.setup.start
    search = search_of(context, cube(palm(context, goal)))
    motion = wait_nearer(search)
    assert motion is not None and search.accepts(motion)
    end = motion.positions[-1]
    left = np.linalg.norm(context.goals - end, axis=1).min()
    assert 0.0 < left < np.linalg.norm(context.goals - start, axis=1).min() - 0.1
    share = (end - start) @ (goal - start) / ((goal - start) @ (goal - start))
    assert np.abs(start + share * (goal - start) - end).max() < 1e-9  # on the straight line
    assert not context.is_goal(end) and not motion.velocities[-1].any()
    farther = start + min(1.0, share + 0.15) * (goal - start)
    assert not clear_at(context, search, farther)


def clear_at(context: RunContext, search: Search, q: np.ndarray) -> bool:
    """Whether a robot may stand at a state for as long as is asked of it."""
    one = Following.resting(q, search.request.join, context.names)
    until = search.request.join + context.settings.rest_hold + 1.0
    return bool(np.isinf(context.first_conflict(search.request.predicted, one, search.request.join, until)))


def test_a_robot_that_can_come_no_nearer_stays(context: RunContext) -> None:
    goal = context.goals[0]
    near = goal + 0.05 * (context.setup.start - goal) / np.linalg.norm(context.setup.start - goal)
    assert wait_nearer(search_of(context, FAR, at=near)) is None  # nearer than where it may wait
    middle = 0.5 * (palm(context, goal) + palm(context, context.setup.start))
    assert wait_nearer(search_of(context, cube(middle, edge=1.5))) is None  # all is blocked
    assert wait_nearer(search_of(context, FAR, budget=0.0)) is None  # no time


@pytest.mark.parametrize("waits", [False, True])
def test_the_portfolio_waits_nearer_where_it_may(context: RunContext, waits: bool) -> None:
    search = search_of(context, cube(palm(context, context.goals[0])))
    answer = Portfolio([], waits=waits).replan(context, search.request, search.budget)
    assert (answer.found is not None) == waits and answer.part == ("wait" if waits else "")
    assert answer.found is None or not answer.found.to_goal
    moving = replace(search.request, following=replace(search.request.following, start_time=1.0))
    assert not moving.following.at_rest(moving.join)
    assert Portfolio([], waits=waits).replan(context, moving, ComputeBudget(0.05)).found is None


def test_a_robot_may_go_back_where_it_came_from(context: RunContext, monkeypatch: pytest.MonkeyPatch) -> None:
    """A cube comes down on a robot that stands near its goal, and of the states around none is tried."""
    goal, start = context.goals[0], context.setup.start
    at = start + 0.9 * (goal - start)
    coming = cube(palm(context, at) + [0.0, 0.0, 0.5], edge=0.4, velocity=(0.0, 0.0, -0.3))
    search = search_of(context, coming, at=at)
    conflict = context.first_conflict(search.request.predicted, search.request.following, 0.0, 3.0)
    assert 0.2 < conflict < 3.0
    search = search_of(context, coming, at=at, conflict=conflict, budget=1.0)
    monkeypatch.setattr(evasion, "STRAYS", (0.0, 0.0, 0.0))
    monkeypatch.setattr(evasion, "ASCENTS", 0)
    motion = evasion.step_aside(search)
    assert motion is not None and np.abs(motion.positions[-1] - start).max() < 1e-9
    assert np.isinf(context.first_conflict(search.request.predicted, search.following(motion), 0.05, 3.0))
    route = Following(line_from(context, Start.at_rest(start), at), -2.0)
    search = replace(search, request=replace(search.request, route=route))
    motion = evasion.step_aside(search)
    assert motion is not None
    states = route.motion(np.linspace(0.0, route.motion.duration, evasion.BACK))
    assert np.abs(motion.positions[-1] - states).max(axis=1).min() < 1e-9


def test_trees_find_a_way_around_what_stands_still() -> None:
    context = context_of(BLOCKED)
    search, sprint = search_of(context, FAR), Sprint()
    sprint.prepare(context)
    (initial,) = sprint.initial_motions(search)
    assert np.abs(initial.states[0] - context.setup.start).max() < 1e-9
    assert np.abs(initial.goal - initial.states[-1]).max() < 1e-9 and context.is_goal(initial.goal)
    assert search.budget.counts[WORK] > 100
    line = np.linspace(context.setup.start, initial.goal, 200)
    ends = np.concatenate([np.linspace(a, b, 20) for a, b in zip(initial.states, initial.states[1:], strict=False)])
    assert not context.checker.are_free(line).all()
    assert context.checker.are_free(ends).mean() > 0.97  # but for corners that even spacing cuts
    again = search_of(context, FAR)
    (same,) = sprint.initial_motions(again)
    assert np.array_equal(same.states, initial.states) and again.budget.counts == search.budget.counts


def test_trees_know_where_obstacles_will_be(context: RunContext) -> None:
    """A cube that will be in the way halfway, though it is not now; and one that will be where the robot begins."""
    goal, start = context.goals[0], context.setup.start
    sprint = Sprint()
    sprint.prepare(context)
    middle = palm(context, 0.5 * (start + goal))
    coming = cube(middle + np.array([0.0, 0.0, 0.6]), velocity=(0.0, 0.0, -1.0))
    (initial,) = sprint.initial_motions(search_of(context, coming))
    assert np.abs(initial.states - np.linspace(start, initial.goal, len(initial.states))).max() > 0.05
    assert not list(sprint.initial_motions(search_of(context, cube(palm(context, start)))))
    every = [cube(palm(context, one)).model_copy(update={"name": f"cube {k}"}) for k, one in enumerate(context.goals)]
    assert not list(sprint.initial_motions(search_of(context, *every)))


def test_trees_are_no_way_to_begin_a_run_or_to_go_on_from(context: RunContext) -> None:
    sprint = Sprint()
    sprint.prepare(context)
    search = search_of(context, FAR)
    first = replace(search.request, number=1)
    moving = replace(search.request, following=replace(search.request.following, start_time=1.0))
    for request in (first, moving):
        assert not list(sprint.initial_motions(Search(context, request, ComputeBudget(0.05))))
    assert list(sprint.initial_motions(search))


def test_trees_stop_when_time_is_up() -> None:
    context = context_of(BLOCKED)
    sprint = Sprint()
    sprint.prepare(context)
    search = search_of(context, FAR, budget=1e-4)
    assert not list(sprint.initial_motions(search)) and search.budget.over()


def test_a_robot_that_leaves_takes_only_what_the_guard_will_hardly_stop(
    context: RunContext, monkeypatch: pytest.MonkeyPatch
) -> None:
    for leaving, guardable in product((False, True), repeat=2):
        search = search_of(context, FAR)
        search = Search(context, replace(search.request, leaving=leaving), ComputeBudget(0.05))
        monkeypatch.setattr(search, "delay", lambda motion, answer=guardable: 0.0 if answer else 1.0)
        motion = search.direct(context.goals[0])
        assert motion is not None and search.take(motion, "direct") == (guardable or not leaving)
