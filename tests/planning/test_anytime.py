"""Anytime plans that improve their motion: other paths and goals, and the best proved motion at each moment."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import islice
from typing import Any

import numpy as np
import pytest
from planning import cached_problem

from apex_ompl import MotionPlanner, load_problem, plan
from apex_ompl.apex.stages import Anytime
from apex_ompl.goals.alignment import alignment_goal
from apex_ompl.ompl.setup import assemble
from apex_ompl.planning import PlanQuery, check, prove, solve
from apex_ompl.planning import time as time_step
from apex_ompl.planning.anytime import OtherPaths
from apex_ompl.problems.suite_robot import robot
from apex_ompl.result import PlanResult
from apex_ompl.robot.rest_to_rest import direct_durations
from apex_ompl.timing import Timing
from apex_ompl.types import Array

NAME = "swap/hard/800022"
ANYTIME = {"anytime": True}
Limited = Callable[[int], list[tuple[PlanQuery, Array]]]


@pytest.fixture
def limited(monkeypatch: pytest.MonkeyPatch) -> Limited:
    """Ends the search after a number of paths, and returns the list of those that were tried."""
    tried, paths = list[tuple[PlanQuery, Array]](), OtherPaths.paths

    def limit(count: int) -> list[tuple[PlanQuery, Array]]:
        def some(self: OtherPaths) -> Iterator[Array]:
            for path in islice(paths(self), count):
                tried.append((self.query, path))
                yield path

        monkeypatch.setattr(OtherPaths, "paths", some)
        return tried

    return limit


def planned(name: str = NAME, **options: Any) -> PlanResult:
    return plan(cached_problem(name), timeout=options.pop("timeout", 60.0), **options)


def duration(result: PlanResult) -> float:
    assert result and result.trajectory is not None
    return result.trajectory.duration


def test_the_motion_is_improved_in_place_of_the_path(limited: Limited) -> None:
    plain, tried = planned(), limited(4)
    found, again = (planned(params=ANYTIME) for _ in range(2))
    assert len(tried) == 8 and duration(found) < 0.97 * duration(plain)
    assert found.trajectory is not None and again.trajectory is not None and found.path is not None
    for knots in ("times", "positions", "velocities", "accelerations"):
        np.testing.assert_array_equal(getattr(found.trajectory, knots), getattr(again.trajectory, knots))
    times = np.linspace(0.0, found.trajectory.duration, len(found.path.states))
    np.testing.assert_allclose(found.trajectory(times), found.path.states, atol=1e-9)
    assert found.limit_use["torque"] <= 1.0 and found.limit_use["velocity"] <= 1.0 + 1e-9
    assert "solve: improve" not in found.times


def test_paths_are_improved_for_a_length_or_without_a_motion(limited: Limited, monkeypatch: pytest.MonkeyPatch) -> None:
    asked, tried = list[bool](), limited(2)
    monkeypatch.setattr(Anytime, "run", lambda self, context: asked.append(self.asked))
    moving = Timing(start_velocity=[0.05, *[0.0] * 15])
    cases: tuple[dict[str, Any], ...] = ({"objective": "length"}, {"timing": False}, {"timing": moving})
    for options in cases:
        assert planned(params=ANYTIME, **options)
    assert asked == [True] * 3 and not tried
    assert planned() and asked == [True] * 3 + [False] and not tried
    assert planned(params=ANYTIME) and asked[4:] and not any(asked[4:]) and len(tried) == 2


def test_calm_and_long_motions(limited: Limited) -> None:
    plain, tried = planned(objective="calm"), limited(4)
    calm = planned(params=ANYTIME, objective="calm")
    assert duration(calm) < 0.99 * duration(plain) and len(tried) == 4
    long = planned(params=ANYTIME, timing=Timing(minimum_duration=4.0))
    assert duration(long) == pytest.approx(4.0, abs=1e-6) and len(tried) == 5


def test_nothing_is_tried_where_the_motion_is_as_fast_as_a_direct_one(limited: Limited) -> None:
    tried, result = limited(10), planned("wall/easy/800000", params=ANYTIME)
    problem, machine = cached_problem("wall/easy/800000"), robot()
    start, goals = problem.start_state(machine.joint_names), problem.goal_states(machine.joint_names)
    least = direct_durations(start, goals, machine.limits).min()
    assert least < duration(result) < least + 0.025 and not tried


def test_paths_join_the_start_and_goals_and_joints_that_stay_do_so(limited: Limited) -> None:
    tried, machine = limited(8), robot()
    setup = assemble(cached_problem(NAME), machine)
    start, goal = setup.start, setup.goals[0].copy()
    goal[[14, 15]] = start[[14, 15]]
    with MotionPlanner() as planner:
        planner.world.load(cached_problem(NAME))
        result = planner.plan(start, goal, timeout=60.0, params=ANYTIME, group=["left_arm", "right_arm"])
    assert result and result.trajectory is not None and len(tried) == 8
    limits, hands = machine.limits, [14, 15]
    for query, path in tried:
        goals = query.setup.valid_goals
        assert np.array_equal(path[0], query.setup.start) and (goals == path[-1]).all(axis=1).any()
        assert (path >= limits.lower).all() and (path <= limits.upper).all()
        assert (path[:, hands] == query.setup.start[hands]).all()
    assert len({path.tobytes() for _, path in tried}) == 8
    np.testing.assert_allclose(
        result.trajectory.positions[:, hands], np.tile(start[hands], (len(result.trajectory.times), 1))
    )
    assert result.path is not None and (result.path.states[:, hands] == start[hands]).all()


def test_goals_in_the_workspace_are_sampled_again(limited: Limited) -> None:
    problem, tried = load_problem("peg_in_hole"), limited(6)
    setup = assemble(problem, robot(), seed=1)
    query = check(setup, "apex", params=ANYTIME, timeout=60.0, timing=True)
    result = time_step(prove(solve(query)))
    goal = alignment_goal(robot(), problem)
    assert goal is not None and result and result.trajectory is not None
    assert tried and len(query.setup.goals) > len(setup.goals)
    assert all(goal.is_satisfied(q) and setup.checker.is_free(q) for q in query.setup.goals)
    assert goal.is_satisfied(result.trajectory.positions[-1])


def test_the_best_motion_is_kept_when_the_plan_is_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    durations, paths = list[float](), OtherPaths.paths

    def ended(self: OtherPaths) -> Iterator[Array]:
        for path in paths(self):
            yield path
            assert self.best is not None
            durations.append(self.best.duration)
            if len(durations) == 4:
                self.query.interrupt.end()

    monkeypatch.setattr(OtherPaths, "paths", ended)
    query = check(assemble(cached_problem(NAME), robot()), "apex", params=ANYTIME, timeout=60.0, timing=True)
    result = time_step(prove(solve(query)))
    assert len(durations) == 4 and durations == sorted(durations, reverse=True)
    assert duration(result) == durations[-1] < durations[0]
