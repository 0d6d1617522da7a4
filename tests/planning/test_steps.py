"""The steps of a plan one by one, and users' own planners, stages and goals."""

from __future__ import annotations

import traceback
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from ompl import base as ob
from ompl import geometric as og
from planning import HARD, cached_problem

from apex_ompl import MotionPlanner, PlanStatus, PoseTarget, plan, planners
from apex_ompl.apex import ApexParameters
from apex_ompl.errors import ParameterError, UnknownNameError
from apex_ompl.planners import APEX
from apex_ompl.planning import assemble, check, prove, solve, time
from apex_ompl.planning.step_records import PlanQuery
from apex_ompl.planning.steps import execute

pytestmark = pytest.mark.usefixtures("quiet")

PROBLEM = "reach_past_post"


def test_the_steps_give_what_a_plan_gives() -> None:
    setup = assemble(cached_problem(HARD), seed=3)
    query = check(setup, "apex", timeout=20.0)
    found = solve(query)
    assert query and found and found.path is not None and found.proof is None
    proved = prove(found)
    assert proved and proved.path is not None and proved.proof is not None
    assert proved.path.spline is found.path.spline is not None, "the planner's spline"
    result, whole = time(proved), plan(cached_problem(HARD), seed=3, timeout=20.0)
    assert result and whole and result.solved_by == whole.solved_by == found.solved_by
    np.testing.assert_array_equal(np.asarray(result.path), np.asarray(whole.path))
    assert result.trajectory is not None and result.length == result.path.length  # type: ignore[union-attr]
    assert time(proved, timing=False).trajectory is None


def test_two_planners_on_one_setup() -> None:
    setup = assemble(cached_problem(PROBLEM), seed=3)
    for name in ("rrtconnect", "apex", "rrtconnect+polish"):
        result = time(prove(solve(check(setup, name, timeout=20.0, objective="length"))))
        assert result and result.planner == name and (result.path.spline is None) == (name == "rrtconnect")  # type: ignore[union-attr]


def test_failures_are_handed_on() -> None:
    problem = cached_problem(PROBLEM)
    inside = problem.model_copy(update={"start": dict(problem.start, left_joint4=0.5)})
    query = check(assemble(inside))
    assert not query and query.status is PlanStatus.INVALID_START and query.reason
    found = solve(query)
    proved = prove(found)
    result = time(proved)
    assert not found and not proved and not result
    assert result.status is PlanStatus.INVALID_START and result.reason == query.reason and result.path is None
    assert "solve" not in result.times
    with pytest.raises(UnknownNameError, match="unknown planner"):
        check(assemble(problem), "rrtconect")
    with pytest.raises(ParameterError, match="timeout"):
        check(assemble(problem), timeout=0.0)


def test_more_goals_are_drawn_where_the_first_ones_are_not_reached() -> None:
    with MotionPlanner("panda") as planner:
        planner.world.add(name="post", box=(0.05, 0.05, 0.6), position=(0.5, 0.0, 0.3))
        pose = PoseTarget(frame="hand", position=(0.5, 0.3, 0.4), orientation=(1.0, 0.0, 0.0, 0.0))
        problem = planner.problem("home", pose)
    times, goals = list[float](), list[int]()

    def fails_first(query: PlanQuery, ompl: ob.Planner, timeout: float) -> PlanStatus:
        times.append(timeout)
        goals.append(len(query.setup.valid_goals))
        return PlanStatus.TIMEOUT if len(times) == 1 else execute(query, ompl, timeout)

    setup = assemble(problem, seed=2)
    found = solve(check(setup, timeout=20.0), lines=False, execute=fails_first)
    assert found and found.path is not None
    assert times[0] == pytest.approx(0.5 * 19.5, abs=0.1) and times[1] > 19.0  # all that is left
    assert 0 < goals[0] == len(setup.valid_goals) < goals[1] == len(found.query.setup.valid_goals)
    goal, data = pin.SE3(pin.Quaternion(0.0, 1.0, 0.0, 0.0), np.array(pose.position)), setup.robot.model.createData()
    for q in found.query.setup.valid_goals:  # by Pinocchio, all of them reach the pose
        pin.framesForwardKinematics(setup.robot.model, data, setup.robot.to_pinocchio(q))
        hand = data.oMf[setup.robot.link_frame("panda_hand")] * pin.SE3(np.eye(3), np.array([0.0, 0.0, 0.1034]))
        assert np.abs(pin.log6(goal.actInv(hand)).vector).max() < 2e-3 and setup.checker.is_free(q)
    assert (np.abs(found.query.setup.valid_goals - found.path.states[-1]).max(axis=1) == 0.0).any()


@pytest.mark.parametrize("more", [True, False])
def test_goals_that_are_states_are_searched_for_once(more: bool) -> None:
    calls = list[float]()

    def fails(query: PlanQuery, ompl: ob.Planner, timeout: float) -> PlanStatus:
        calls.append(timeout)
        return PlanStatus.TIMEOUT

    problem = cached_problem(PROBLEM if more else "handover")
    assert (problem.goal.joints is None) != more
    assert not solve(check(assemble(problem), timeout=5.0), lines=False, more=more, execute=fails) and len(calls) == 1


def test_planners_are_given_by_name_parameters_or_function() -> None:
    tuned = planners.parameters("rrtconnect", range=1.0)
    for given, name in ((tuned, "rrtconnect"), (tuned.build, "rrtconnect"), (og.RRTConnect, "RRTConnect")):
        result = plan(PROBLEM, given, timeout=20.0)
        assert result and result.planner == name
    smooth = plan(PROBLEM, lambda si: APEX(si, seed=1), timeout=20.0, objective="length")
    assert smooth and smooth.planner == "apex" and smooth.path is not None and smooth.path.spline is not None
    with pytest.raises(UnknownNameError, match="range"):
        plan(PROBLEM, og.RRTConnect, params={"range": 1.0})


class Returns:
    """Stage that returns something."""

    def __init__(self, what: Any) -> None:
        self.what, self.calls = what, 0

    def run(self, context: Any) -> Any:
        self.calls += 1
        return self.what(context) if callable(self.what) else self.what


def test_a_plan_reaches_a_stage_in_ten_calls() -> None:
    seen: list[str] = []

    class Watching:
        def run(self, context: Any) -> None:
            frames = traceback.walk_stack(None)
            own = [str(frame.f_globals["__name__"]) for frame, _ in frames]
            seen.extend(name for name in own if name.startswith("apex_ompl."))

    plan(PROBLEM, lambda si: APEX(si, stages=[Watching(), *ApexParameters().stages()]), timeout=20.0)
    assert 0 < len(seen) <= 10 and seen[-1] == "apex_ompl.api", seen


def test_paths_of_a_users_stage_are_checked() -> None:
    line, elsewhere = Returns(lambda c: np.stack(c.pairs[0])), Returns(lambda c: np.stack([c.starts[0]] * 2))
    nothing, stages = Returns(None), ApexParameters().stages()
    own = [line, elsewhere, nothing, *stages]
    result = plan(PROBLEM, lambda si: APEX(si, stages=own), timeout=20.0)
    assert result and result.solved_by not in ("", "Returns"), "the line is blocked, the other is no way to the goal"
    assert line.calls == elsewhere.calls == nothing.calls == 1
    wrong = plan(PROBLEM, lambda si: APEX(si, stages=[Returns(np.zeros((2, 3)))]), timeout=20.0)
    assert wrong.status is PlanStatus.ABORT and "path of stage Returns" in wrong.reason
    none = plan(PROBLEM, lambda si: APEX(si, stages=[]), timeout=20.0)
    assert none.status is PlanStatus.TIMEOUT and "no path among 0 candidates" in none.reason


class Draws:
    """Goal sampler that returns a state."""

    def __init__(self, state: np.ndarray | None) -> None:
        self.state = state

    def sample(self, rng: np.random.Generator) -> np.ndarray | None:
        return None if self.state is None or rng.random() < 0.5 else self.state


def test_goals_of_a_users_sampler() -> None:
    with MotionPlanner() as planner:
        home = planner.robot.home
        goal = home.copy()
        goal[0] -= 0.3
        result = planner.plan(home, Draws(goal), timeout=20.0, seed=2)
        assert result and result.path is not None and np.array_equal(result.path.states[-1], goal)
        assert result.problem.goal.joints is not None and len(result.problem.goal.joints) == 8
        hand = planner.robot.link_pose(goal, "left_hand_palm")[:3, 3]
        planner.world.add(name="ball", sphere={"radius": 0.05}, position=hand)
        assert planner.plan(home, Draws(goal), timeout=20.0).status is PlanStatus.INVALID_GOAL
        with pytest.raises(ParameterError, match="a sampler that returns a state in 200 draws"):
            planner.plan(home, Draws(None))
        with pytest.raises(ParameterError, match="seed"):
            planner.plan(home, Draws(goal), seed=-1)
