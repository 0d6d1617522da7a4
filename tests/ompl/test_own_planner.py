"""Planners of this package inside of OMPL: spaces, checkers and states of all kinds, planner data, objectives."""

from __future__ import annotations

import logging
import time
from collections import deque
from typing import Any

import numpy as np
import pytest
from ompl import base as ob
from ompl import geometric as og
from ompl import tools as ot
from planning import EXACT, cached_problem, states, within
from support import ROOT

import apex_ompl
from apex_ompl import planners
from apex_ompl.collision import CollisionChecker
from apex_ompl.errors import ParameterError, UnknownNameError
from apex_ompl.ompl.setup import PlanningSetup, assemble
from apex_ompl.ompl.space import new_state, state_space, to_state
from apex_ompl.ompl.validity import StateValidityChecker
from apex_ompl.planners import APEX
from apex_ompl.problems.suite_robot import robot
from apex_ompl.robot import load_robot
from apex_ompl.scene.problem import Problem

pytestmark = pytest.mark.usefixtures("quiet")


class Opposed(ob.Constraint):
    """The first joints of both arms turn alike."""

    def __init__(self) -> None:
        super().__init__(16, 1)

    def function(self, x: np.ndarray, out: np.ndarray) -> None:
        out[0] = x[0] - x[7]


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("apex", "constraint of the state space: expected .*ManifoldConstraint, got 'Opposed'"),
        ("drrt", "state space: expected an ob.RealVectorStateSpace.*'ProjectedStateSpace'"),
    ],
)
def test_a_space_that_is_no_vector_space_is_refused(name: str, expected: str) -> None:
    si = ob.ConstrainedSpaceInformation(ob.ProjectedStateSpace(state_space(robot()), Opposed()))
    si.setStateValidityChecker(lambda state: True)
    with pytest.raises(ParameterError, match=expected):
        planners.make(name, si)


def test_a_space_of_another_robot_is_refused_and_the_robot_can_be_named() -> None:
    si = og.SimpleSetup(ob.RealVectorStateSpace(7)).getSpaceInformation()
    si.setStateValidityChecker(lambda state: True)
    with pytest.raises(ParameterError, match="expected 16 dimensions, those of dual_panda_softhand, or .* robot=..."):
        APEX(si)
    baxter = load_robot("baxter")
    planner = APEX(og.SimpleSetup(state_space(baxter)).getSpaceInformation(), robot="baxter", seed=3)
    assert planner.validator.checker.robot.name == "baxter" and planner.parameters.seed == 3
    with pytest.raises(UnknownNameError, match="unknown parameter 'robto', did you mean 'robot'"):
        APEX(si, robto="baxter")
    ready = assemble(Problem.load(ROOT / "examples" / "baxter_table.yaml"))
    ready.simple_setup.setStateValidityChecker(lambda state: True)
    assert APEX(ready.simple_setup.getSpaceInformation()).validator.checker.robot.name == "baxter", "that of the setup"


def crossing(setup: og.SimpleSetup) -> None:
    """Start and goal with the first joint at -0.8 and 0.8."""
    start, goal = robot().home.copy(), robot().home.copy()
    start[0], goal[0] = -0.8, 0.8
    si = setup.getSpaceInformation()
    setup.setStartAndGoalStates(to_state(si, start), to_state(si, goal))


def test_a_planner_may_be_made_before_the_checker_is_set() -> None:
    setup = og.SimpleSetup(state_space(robot()))
    crossing(setup)
    setup.setPlanner(APEX(setup.getSpaceInformation(), seed=0))
    setup.setStateValidityChecker(lambda state: not -0.3 < state[0] < 0.3 or state[1] < -0.9)
    assert setup.solve(within(20.0)).getStatus() == EXACT
    assert all(not -0.3 < q[0] < 0.3 or q[1] < -0.9 for q in states(setup))


@pytest.mark.parametrize("kind", ["function", "object"])
def test_answers_that_ompl_does_not_take_are_named(kind: str, caplog: pytest.LogCaptureFixture) -> None:
    """In a plain setup of OMPL's; those of this package take them."""
    setup = og.SimpleSetup(state_space(robot()))
    crossing(setup)
    si = setup.getSpaceInformation()
    free = lambda state: np.all(np.array(state[0:16]) < 4.0)  # noqa: E731

    class Free(ob.StateValidityChecker):
        def isValid(self, state: Any) -> Any:  # noqa: N802
            return free(state)

    setup.setStateValidityChecker(free if kind == "function" else Free(si))
    planner = APEX(si)
    setup.setPlanner(planner)
    assert setup.solve(within(5.0)).getStatus() == ob.PlannerStatus.ABORT
    assert "must return True or False (OMPL takes no numpy.bool_)" in planner.report.reason
    assert not any(record.exc_info for record in caplog.records)


def test_a_checker_that_no_longer_fits_ends_a_solve_with_its_reason(ready: PlanningSetup) -> None:
    setup = ready.simple_setup
    si = setup.getSpaceInformation()
    planner = APEX(si)
    setup.setPlanner(planner)
    setup.setup()
    setup.setStateValidityChecker(StateValidityChecker(si, CollisionChecker(load_robot("baxter"))))
    assert setup.solve(within(5.0)).getStatus() == ob.PlannerStatus.ABORT
    assert "expected 14 dimensions, those of baxter" in planner.report.reason


@pytest.mark.parametrize("keep", [1, 50])
def test_a_checker_may_keep_states(keep: int) -> None:
    """OMPL frees them, and its bindings would hand out the same objects for new states."""
    kept = deque[Any](maxlen=keep)

    def free(state: Any) -> bool:
        kept.append(state)
        return not -0.3 < state[0] < 0.3 or state[1] < -1.0

    for seed in range(3):
        setup = og.SimpleSetup(state_space(robot()))
        setup.setStateValidityChecker(free)
        crossing(setup)
        setup.setPlanner(APEX(setup.getSpaceInformation(), seed=seed))
        assert setup.solve(within(20.0)).getStatus() == EXACT
        assert all(not -0.3 < q[0] < 0.3 or q[1] < -1.0 for q in states(setup))


def test_new_states_are_new_where_python_holds_objects_of_freed_ones() -> None:
    si = ob.SpaceInformation(state_space(robot()))
    kept: list[Any] = []
    for _ in range(20):
        path = og.PathGeometric(si)
        path.append(new_state(si))
        kept.append(path.getState(0))
        del path  # and its states
    made = [new_state(si) for _ in range(100)]
    assert len({id(state) for state in made} | {id(state) for state in kept}) == 120
    for k, state in enumerate(made):
        state[0:16] = [float(k)] * 16
    assert [state[15] for state in made] == [float(k) for k in range(100)]


def assert_joined(data: ob.PlannerData, path: np.ndarray) -> None:
    """The states of a path are among the data, and joined one by one; its ends are marked."""
    numbers = {tuple(data.getVertex(k).getState()[0:16]): k for k in range(data.numVertices())}
    along = [numbers[tuple(q)] for q in path.tolist()]
    assert all(data.edgeExists(a, b) for a, b in zip(along, along[1:], strict=False))
    assert data.isStartVertex(along[0]) and data.isGoalVertex(along[-1])


@pytest.mark.parametrize(("name", "values"), [("apex", {"line": False}), ("rrtconnect+polish", {}), ("drrt", {})])
def test_planner_data_are_trees_and_the_path(name: str, values: dict[str, Any], problem: Problem) -> None:
    ready = assemble(problem)
    setup = ready.simple_setup
    setup.setPlanner(planners.make(name, setup.getSpaceInformation(), **values))
    before = ob.PlannerData(setup.getSpaceInformation())
    setup.getPlannerData(before)
    assert before.numVertices() == 0
    assert setup.solve(within(20.0)).getStatus() == EXACT
    data = ob.PlannerData(setup.getSpaceInformation())
    setup.getPlannerData(data)
    path = states(setup)
    assert data.numVertices() >= len(path) and data.numEdges() >= data.numVertices() // 2
    assert_joined(data, path)
    setup.setPlanner(og.RRTConnect(setup.getSpaceInformation()))
    assert setup.solve(within(20.0)).getStatus() == EXACT
    data = ob.PlannerData(setup.getSpaceInformation())
    setup.getPlannerData(data)
    assert data.numVertices() > 2, "of OMPL's planners as before"


def test_planner_data_with_another_checker_are_those_of_ompls_trees() -> None:
    setup = og.SimpleSetup(state_space(robot()))
    crossing(setup)
    setup.setStateValidityChecker(lambda state: not -0.3 < state[0] < 0.3 or state[1] < -1.0)
    planner = APEX(setup.getSpaceInformation(), seed=0)
    setup.setPlanner(planner)
    assert setup.solve(within(20.0)).getStatus() == EXACT
    data = ob.PlannerData(setup.getSpaceInformation())
    planner.fill_data(data)
    assert data.numStartVertices() > 0 and data.numGoalVertices() > 0
    assert_joined(data, states(setup))


def test_an_objective_that_another_planner_left_is_not_pursued(caplog: pytest.LogCaptureFixture) -> None:
    """BIT* of OMPL sets one where there is none, in a Benchmark in the problem definition of all planners."""
    setup = apex_ompl.setup(cached_problem("posts/easy/800001"))
    si, experiment = setup.getSpaceInformation(), ot.Benchmark(setup, "shared")
    planner = APEX(si, seed=0)
    experiment.addPlanner(og.BITstar(si))
    experiment.addPlanner(planner)
    with caplog.at_level(logging.INFO, "apex_ompl"):
        experiment.benchmark(ot.Request(1.0, 4096.0, 1, 0.05, False, False, False))
    runs = [one.runs[0].to_dict() for one in experiment.getRecordedExperimentData().planners]
    assert setup.getProblemDefinition().hasOptimizationObjective()
    assert "improve" not in planner.report.times and float(runs[1]["time REAL"]) < 1.0
    assert "not optimized without anytime=true" in caplog.text


def test_lazily_sampled_goals_may_be_slow() -> None:
    """A sampler in Python, in a thread of OMPL's that needs the interpreter's lock."""
    ready = assemble(cached_problem("posts/easy/800001"))
    for name in ("apex", "rrtconnect", "rrtconnect+polish"):
        made = assemble(ready.problem, ready.robot, checker=ready.checker)
        setup, si = made.simple_setup, made.simple_setup.getSpaceInformation()
        sampled = iter([ready.goals[0]])

        def sample(goal: Any, state: Any, sampled: Any = sampled) -> bool:
            time.sleep(0.2)
            q = next(sampled, None)
            if q is not None:
                state[0:16] = q.tolist()
            return q is not None

        goal = ob.GoalLazySamples(si, sample, True, 1e-3)
        setup.setGoal(goal)
        setup.setPlanner(planners.make(name, si, **planners.TUNED.get(name, {})))
        status = setup.solve(within(20.0)).getStatus()
        while goal.isSampling():
            time.sleep(0.01)
        assert status == EXACT, name
        assert np.array_equal(states(setup)[-1], ready.goals[0])
