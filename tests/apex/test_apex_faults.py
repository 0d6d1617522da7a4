"""What can go wrong with APEX: a status and a reason each time."""

from __future__ import annotations

import logging
import time
import traceback
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ompl import base as ob
from ompl import geometric as og
from planning import DIFFUSION_ONLY, EXACT, HARD, TIMEOUT, UserValidityChecker, cached_problem, states, within
from support import ROOT

import apex_ompl
from apex_ompl import plan, planners
from apex_ompl.apex.parameters import ApexParameters
from apex_ompl.errors import ApexError, MissingFileError, ParameterError, UnknownNameError
from apex_ompl.ompl.setup import PlanningSetup, assemble
from apex_ompl.ompl.space import state_space, to_state
from apex_ompl.ompl.validity import StateValidityChecker, full_check
from apex_ompl.planners import APEX
from apex_ompl.problems.suite_robot import robot
from apex_ompl.result import PlanStatus
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.scene.problem import Problem

pytestmark = pytest.mark.usefixtures("quiet")


def test_faulty_parameters_are_named(tmp_path: Path) -> None:
    for values, error, said in (
        ({"gamma": float("nan")}, ParameterError, "'gamma'"),
        ({"sampler": "euler"}, ParameterError, "one of model, ddim, dpm_solver, ddpm"),
        ({"model": ""}, ParameterError, "'model'"),
        ({"first": 1.5}, ParameterError, "a whole number"),
        ({"lambda_obs": -1.0}, ParameterError, "'lambda_obs'"),
    ):
        with pytest.raises(error, match=said):
            ApexParameters(**values)
    with pytest.raises(UnknownNameError, match="unknown checkpoint 'nope'"):
        plan(cached_problem(HARD), params={"model": "nope"})
    with pytest.raises(ParameterError, match="'denoising_steps'.*at most 256"):
        plan(cached_problem(HARD), params={"denoising_steps": 500})
    (tmp_path / "empty").mkdir()
    with pytest.raises(MissingFileError, match="config.json"):
        plan(cached_problem(HARD), params={"model": str(tmp_path / "empty")})
    with pytest.raises(ApexError, match="expected 'baxter'"):
        setup = apex_ompl.setup(Problem.load(ROOT / "examples" / "baxter_table.yaml"))
        APEX(setup.getSpaceInformation(), ApexParameters(model="apex"))


def test_start_at_the_goal_is_a_path(ready: PlanningSetup) -> None:
    si = ready.simple_setup.getSpaceInformation()
    state = to_state(si, ready.start)
    ready.simple_setup.setStartAndGoalStates(state, state)
    ready.simple_setup.setPlanner(APEX(si))
    assert ready.simple_setup.solve(within(5.0)).getStatus() == EXACT
    np.testing.assert_array_equal(states(ready.simple_setup), np.tile(ready.start, (256, 1)))


def test_without_a_goal_there_is_a_status(ready: PlanningSetup) -> None:
    si = ready.simple_setup.getSpaceInformation()
    pdef = ob.ProblemDefinition(si)
    pdef.addStartState(to_state(si, ready.start))
    planner = APEX(si)
    planner.setProblemDefinition(pdef)
    assert planner.solve(within(1.0)).getStatus() == ob.PlannerStatus.INVALID_GOAL


def _outcome(ready: PlanningSetup, start: np.ndarray, goal: np.ndarray, **values: Any) -> tuple[str, str]:
    si = ready.simple_setup.getSpaceInformation()
    pdef = ob.ProblemDefinition(si)
    pdef.setStartAndGoalStates(to_state(si, start), to_state(si, goal))
    planner = APEX(si, ApexParameters(seed=0, **values))
    planner.setup()
    planner.setProblemDefinition(pdef)
    begin = time.perf_counter()
    status = PlanStatus.of(planner.solve(within(0.5)))
    assert time.perf_counter() - begin < 3.0
    return str(status), planner.report.reason


def test_faulty_starts_and_goals_get_a_status_and_a_reason(ready: PlanningSetup) -> None:
    start, goal = ready.start, ready.goals[0]
    limits, rng = robot().limits, np.random.default_rng(0)
    drawn = (rng.uniform(limits.lower, limits.upper) for _ in range(1000))
    crossed = next(q for q in drawn if not ready.checker.is_free(q))
    wild, nan = goal.copy(), start.copy()
    wild[3], nan[2] = 5.0, np.nan
    assert _outcome(ready, crossed, goal) == ("INVALID_START", "no start state is valid")
    assert _outcome(ready, nan, goal) == ("INVALID_START", "no start state is valid")
    for faulty in (crossed, wild, nan):
        status, reason = _outcome(ready, start, faulty)
        assert status in ("INVALID_GOAL", "TIMEOUT") and reason


def test_behind_a_wall_there_is_no_way(ready: PlanningSetup) -> None:
    """The wall begins 12 cm from the first axis of the left arm, whose first link cannot pass, and must."""
    checker = assemble(cached_problem(HARD).model_copy(update={"scene": ()}), robot())
    start, goal = robot().home.copy(), robot().home.copy()
    start[0], goal[0] = 0.6, 2.12
    checker.checker.add(Obstacle(name="wall", box=(2.0, 0.04, 3.0), position=(1.12, 0.5, 1.5)))
    for q0 in np.linspace(1.15, 2.0, 20):
        between = start.copy()
        between[0] = q0
        assert any("left_link1" in str(contact) for contact in checker.checker.contacts(between))
    assert _outcome(checker, start, goal)[0] == "TIMEOUT"


def test_without_a_way_there_is_none_in_time() -> None:
    """The first joint may not cross zero, and the goal is on the other side."""
    panda, setup = robot(), og.SimpleSetup(state_space(robot()))
    si = setup.getSpaceInformation()
    setup.setStateValidityChecker(UserValidityChecker(si, lambda q: bool(abs(q[0]) > 0.05)))
    start, goal = panda.home.copy(), panda.home.copy()
    start[0], goal[0] = -0.5, 0.5
    setup.setStartAndGoalStates(to_state(si, start), to_state(si, goal))
    planner = APEX(si, ApexParameters(seed=0, third=0))
    setup.setPlanner(planner)
    setup.setup()
    begin = time.perf_counter()
    assert setup.solve(within(1.0)).getStatus() == TIMEOUT
    assert 0.9 < time.perf_counter() - begin < 3.0
    assert "no path among" in planner.report.reason and not setup.haveSolutionPath()


def test_approximate_solutions_come_with_their_difference(ready: PlanningSetup) -> None:
    setup = ready.simple_setup
    si = setup.getSpaceInformation()
    nothing = {"line": True, "first": 1, "second": 0, "third": 0, "repair": False, "resample": 0, **DIFFUSION_ONLY}
    setup.setPlanner(planners.make("apex", si, approximate=True, seed=0, **nothing))
    setup.setup()
    status = setup.solve(within(1.0)).getStatus()
    assert status == ob.PlannerStatus.APPROXIMATE_SOLUTION
    path = states(setup)
    gap = np.linalg.norm(path[-1] - ready.goals[0])
    assert gap > 0.0 and setup.getProblemDefinition().getSolutionDifference() == pytest.approx(gap)
    assert full_check(ready.checker, path, ready.start)
    setup.clear()
    setup.setPlanner(planners.make("apex", si, seed=0, **nothing))
    assert setup.solve(within(1.0)).getStatus() == TIMEOUT and not setup.haveSolutionPath()


def test_no_exception_leaves_solve(
    ready: PlanningSetup, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    si = ready.simple_setup.getSpaceInformation()
    planner = APEX(si)
    planner.setup()

    def fail(*_: object, **__: object) -> None:
        raise ZeroDivisionError("of the test")

    monkeypatch.setattr(planner.validator, "is_valid", fail)
    ready.simple_setup.setPlanner(planner)
    assert ready.simple_setup.solve(within(1.0)).getStatus() == ob.PlannerStatus.CRASH
    assert "ZeroDivisionError" in planner.report.reason
    assert any(record.exc_info for record in caplog.records)


@pytest.mark.parametrize("count", [0, 300])
def test_no_obstacles_and_very_many(count: int) -> None:
    base = cached_problem(HARD)
    rng = np.random.default_rng(0)
    scene = []
    for k in range(count):
        place = (float(rng.uniform(-1.5, -0.9)), float(rng.uniform(-1, 1)), float(rng.uniform(0, 1.5)))
        scene.append(Obstacle(name=f"piece{k}", box=(0.03, 0.03, 0.03), position=place))
    problem = base.model_copy(update={"scene": (*scene, *base.scene) if count else ()})
    result = plan(problem, timeout=20.0)
    assert result, result.reason


@pytest.mark.parametrize("name", ["apex", "rrtconnect+polish"])
def test_a_fault_of_a_users_checker_keeps_no_state(
    name: str, ready: PlanningSetup, caplog: pytest.LogCaptureFixture
) -> None:
    """OMPL frees its states, and the bindings would hand out the old object of one for the next at its address."""

    class Breaks(StateValidityChecker):
        def isValid(self, state: Any) -> bool:  # noqa: N802
            raise RuntimeError(f"broken on purpose at {state[0]}")

    setup = ready.simple_setup
    si = setup.getSpaceInformation()
    planner = planners.make(name, si)
    setup.setStateValidityChecker(Breaks(si, ready.checker))
    setup.setPlanner(planner)
    with caplog.at_level(logging.ERROR, "apex_ompl"):
        assert setup.solve(within(5.0)).getStatus() == ob.PlannerStatus.CRASH
    assert "broken on purpose" in planner.report.reason
    error = caplog.records[-1].exc_info[1]
    frames = [frame for frame, _ in traceback.walk_tb(error.__traceback__)]
    assert any(frame.f_code.co_name == "isValid" for frame in frames)
    held = [value for frame in frames for value in frame.f_locals.values() if isinstance(value, ob.State)]
    assert not held, "the log keeps a state of OMPL"
