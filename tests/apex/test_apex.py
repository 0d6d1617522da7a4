"""APEX as a planner of OMPL's: what users of OMPL may do with any planner."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ompl import base as ob
from ompl import geometric as og
from ompl import tools as ot
from planning import EASY, EXACT, HARD, UserValidityChecker, cached_problem, states, within
from support import ROOT

from apex_ompl import plan, planners
from apex_ompl.apex.parameters import ApexParameters
from apex_ompl.model.proposals import TrajectoryModel
from apex_ompl.ompl.own_planner import read_goals
from apex_ompl.ompl.setup import PlanningSetup, assemble
from apex_ompl.ompl.space import path_to_array, state_space, to_state
from apex_ompl.ompl.validity import StateValidityChecker, full_check
from apex_ompl.paths.path import path_length
from apex_ompl.planners import APEX
from apex_ompl.problems.suite_robot import robot
from apex_ompl.result import INSIDE

pytestmark = pytest.mark.usefixtures("quiet")


def test_it_is_the_default_and_proves_what_it_finds() -> None:
    result = plan(cached_problem(HARD), timeout=20.0, objective="length")
    assert result and result.planner == "apex", result.reason
    checker = assemble(cached_problem(HARD), robot()).checker
    assert full_check(checker, result.path, result.path[0], [result.path[-1]])
    inside = {name.removeprefix(INSIDE): seconds for name, seconds in result.times.items() if name.startswith(INSIDE)}
    assert 0.0 < inside.pop("first") < result.times["solve"]
    assert {"query", "known", "polish"} <= inside.keys()
    assert sum(inside.values()) <= result.times["solve"]
    tree = plan(cached_problem(HARD), "rrtconnect", timeout=20.0, objective="length")
    assert result.length < tree.length


@pytest.mark.parametrize("how", ["setPlanner", "setPlannerAllocator"])
def test_simple_setup_takes_it(how: str, ready: PlanningSetup) -> None:
    setup = ready.simple_setup
    if how == "setPlanner":
        setup.setPlanner(APEX(setup.getSpaceInformation()))
    else:
        setup.setPlannerAllocator(planners.allocator("apex", seed=3))
    assert setup.solve(within(20.0)).getStatus() == EXACT
    path = states(setup)
    assert full_check(ready.checker, path, ready.start, ready.goals)
    assert setup.getProblemDefinition().getSolutionDifference() == 0.0


def test_ompls_benchmark_runs_it(ready: PlanningSetup, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)  # OMPL writes a console file there
    setup = ready.simple_setup
    benchmark = ot.Benchmark(setup, "hard")
    benchmark.addPlanner(APEX(setup.getSpaceInformation(), ApexParameters(seed=1, sprint=0)))
    request = ot.Request(20.0, 4096.0, 3)
    request.displayProgress = False
    benchmark.benchmark(request)
    (planner,) = benchmark.getRecordedExperimentData().planners
    assert planner.name == "geometric_apex"
    assert [run["solved BOOLEAN"] for run in planner.runs] == ["1"] * 3
    lengths = {run["solution length REAL"] for run in planner.runs}
    assert len(lengths) == 1, "clear() between the runs begins the seeds anew"


def test_it_solves_again_and_keeps_what_is_shorter(ready: PlanningSetup) -> None:
    setup = ready.simple_setup
    planner = APEX(setup.getSpaceInformation(), ApexParameters(seed=0, sprint=0))
    setup.setPlanner(planner)
    assert setup.solve(within(20.0)).getStatus() == EXACT
    first, by = states(setup), planner.report.solved_by
    assert by.startswith("apex")
    setup.getProblemDefinition().clearSolutionPaths()
    assert setup.solve(within(20.0)).getStatus() == EXACT
    assert planner.report.solved_by == "experience", "the path that was found is a candidate"
    assert path_length(states(setup)) <= path_length(first) + 1e-9
    setup.clear()
    assert not setup.haveSolutionPath()
    assert setup.solve(within(20.0)).getStatus() == EXACT
    assert planner.report.solved_by == by
    np.testing.assert_array_equal(states(setup), first)


def test_a_new_problem_definition_is_taken_and_experience_helps(ready: PlanningSetup) -> None:
    si = ready.simple_setup.getSpaceInformation()
    planner = APEX(si, ApexParameters(seed=0))
    planner.setup()
    found = []
    for start, goal in ((ready.start, ready.goals[0]), (ready.goals[0], ready.start), (ready.start, ready.goals[0])):
        pdef = ob.ProblemDefinition(si)
        pdef.setStartAndGoalStates(to_state(si, start), to_state(si, goal))
        planner.setProblemDefinition(pdef)
        assert planner.solve(within(20.0)).getStatus() == EXACT
        path = path_to_array(pdef.getSolutionPath(), robot().dof)
        assert full_check(ready.checker, path, start, [goal])
        found.append(planner.report.solved_by)
        planner.clearQuery()
    assert found[2] == "experience"


class Region(ob.GoalSampleableRegion):
    """A region of goals around some states."""

    def __init__(self, si: ob.SpaceInformation, around: np.ndarray) -> None:
        super().__init__(si)
        self.around, self.count = around, 0
        self.setThreshold(1e-3)

    def distanceGoal(self, state: Any) -> float:  # noqa: N802
        return float(np.linalg.norm(np.array(state[0 : len(self.around[0])]) - self.around, axis=1).min())

    def sampleGoal(self, state: Any) -> None:  # noqa: N802
        state[0 : len(self.around[0])] = [float(v) for v in self.around[self.count % len(self.around)]]
        self.count += 1

    def maxSampleCount(self) -> int:  # noqa: N802
        return 2**31


@pytest.mark.parametrize("kind", ["states", "region"])
def test_several_starts_and_goals_of_all_kinds(kind: str, ready: PlanningSetup) -> None:
    si = ready.simple_setup.getSpaceInformation()
    pdef = ob.ProblemDefinition(si)
    blocked = ready.start.copy()
    blocked[0] = 10.0  # out of limits
    for q in (blocked, ready.start):
        pdef.addStartState(to_state(si, q))
    if kind == "region":
        goal = Region(si, np.stack([ready.goals[0], ready.start]))
    else:
        goal = ob.GoalStates(si)
        far = ready.goals[0].copy()
        far[14] = 1.0 - far[14]
        for q in (blocked, far, blocked, ready.goals[0]):
            goal.addState(to_state(si, q))
    pdef.setGoal(goal)
    planner = APEX(si, ApexParameters(seed=0))
    planner.setProblemDefinition(pdef)
    planner.setup()
    assert planner.solve(within(20.0)).getStatus() == EXACT
    path = path_to_array(pdef.getSolutionPath(), robot().dof)
    np.testing.assert_array_equal(path[0], ready.start)
    wanted = [ready.start] if kind == "region" else [ready.goals[0], far]  # the region holds the start itself
    assert any(np.array_equal(path[-1], one) for one in wanted)
    assert full_check(ready.checker, path)


def test_all_states_of_a_goal_are_read_and_a_few_of_a_region(ready: PlanningSetup) -> None:
    si, rng = ready.simple_setup.getSpaceInformation(), np.random.default_rng(0)
    around = ready.goals[0] + np.append(0.002 * rng.normal(size=(40, 14)), np.zeros((40, 2)), axis=1)
    around = around[[ready.checker.is_free(q) for q in around]]
    assert len(around) > 8
    found = []
    for goal in (ob.GoalStates(si), Region(si, around)):
        if isinstance(goal, ob.GoalStates):
            for q in around:
                goal.addState(to_state(si, q))
        pdef = ob.ProblemDefinition(si)
        pdef.addStartState(to_state(si, ready.start))
        pdef.setGoal(goal)
        planner = APEX(si, ApexParameters(seed=0))
        planner.setProblemDefinition(pdef)
        found.append(read_goals(planner.getPlannerInputStates(), len(ready.start), within(1.0), goal))
    assert np.array_equal(np.stack(found[0]), around) and len(found[1]) == 8


def test_more_of_a_region_is_drawn_where_the_first_goal_cannot_be_reached() -> None:
    """With a checker of the user's: one that lets nobody through between two halves of the first joint."""
    ready = assemble(cached_problem(EASY), robot())
    setup = og.SimpleSetup(state_space(robot()))
    si, beyond = setup.getSpaceInformation(), ready.goals[0].copy()
    beyond[0] = 2.0
    setup.setStateValidityChecker(UserValidityChecker(si, lambda q: not 1.4 < q[0] < 1.6))
    setup.setStartState(to_state(si, ready.start))
    goal = Region(si, np.stack([*[beyond] * 12, ready.goals[0]]))
    setup.setGoal(goal)
    setup.setPlanner(APEX(si, ApexParameters(seed=0, line=False, model="none")))
    assert setup.solve(within(20.0)).getStatus() == EXACT
    assert np.array_equal(states(setup)[-1], ready.goals[0]) and goal.count > 12


def test_a_goal_that_cannot_be_sampled_is_refused(ready: PlanningSetup) -> None:
    class Somewhere(ob.GoalRegion):
        def distanceGoal(self, state: Any) -> float:  # noqa: N802
            return 1.0

    si = ready.simple_setup.getSpaceInformation()
    pdef = ob.ProblemDefinition(si)
    pdef.addStartState(to_state(si, ready.start))
    pdef.setGoal(Somewhere(si))
    planner = APEX(si)
    planner.setProblemDefinition(pdef)
    assert planner.solve(within(1.0)).getStatus() == ob.PlannerStatus.UNRECOGNIZED_GOAL_TYPE
    assert "expected a goal state" in planner.report.reason


def test_alignment_goals_are_proposed_for_in_one_batch(monkeypatch: pytest.MonkeyPatch) -> None:
    asked, honest = [], TrajectoryModel.propose

    def noted(self: TrajectoryModel, query: Any, *given: Any, **more: Any) -> Any:
        asked.append(query)
        return honest(self, query, *given, **more)

    monkeypatch.setattr(TrajectoryModel, "propose", noted)
    result = plan("stack_boxes", timeout=20.0, params={"line": False, "sprint": 0})
    assert result and result.planner == "apex"
    assert any(isinstance(query, list) and len(query) > 1 for query in asked)
    assert len({tuple(query.goal) for query in asked[-1]}) == len(asked[-1])


def foreign(name: str) -> tuple[PlanningSetup, og.SimpleSetup]:
    ready = assemble(cached_problem(name), robot())
    setup = og.SimpleSetup(state_space(robot()))
    si = setup.getSpaceInformation()
    setup.setStateValidityChecker(UserValidityChecker(si, ready.checker.is_free))
    setup.setStartAndGoalStates(to_state(si, ready.start), to_state(si, ready.goals[0]))
    return ready, setup


def test_another_checker_decides_and_is_reported_once(caplog: pytest.LogCaptureFixture) -> None:
    ready, setup = foreign(EASY)
    caplog.set_level(logging.INFO, logger="apex_ompl")
    planner = APEX(setup.getSpaceInformation())
    setup.setPlanner(planner)
    assert setup.solve(within(30.0)).getStatus() == EXACT
    assert full_check(ready.checker, states(setup), ready.start, ready.goals)
    assert setup.solve(within(30.0)).getStatus() == EXACT
    assert sum("is not apex_ompl's" in record.message for record in caplog.records) == 1
    crossed = np.stack([ready.start, np.zeros_like(ready.start), ready.goals[0]])
    assert ready.checker.collides_along(crossed) and not planner.validator.collides(crossed)


def test_the_example_with_a_checker_of_its_own_runs(capsys: pytest.CaptureFixture[str]) -> None:
    text = (ROOT / "examples" / "01_own_checker.py").read_text()
    exec(compile(text, "01_own_checker.py", "exec"), {"__name__": "__main__"})  # noqa: S102
    assert "EXACT_SOLUTION" in capsys.readouterr().out


def test_the_checkers_of_the_moment_decide(ready: PlanningSetup) -> None:
    """One that says more than the checker is asked, and one that is set later on takes the place of the first."""

    class Wary(StateValidityChecker):
        def isValid(self, state: Any) -> bool:  # noqa: N802
            return super().isValid(state) and state[14] < 0.9

    setup = ready.simple_setup
    si = setup.getSpaceInformation()
    planner = APEX(si, ApexParameters(seed=0))
    setup.setPlanner(planner)
    assert setup.solve(within(20.0)).getStatus() == EXACT and planner.validator.exclusive
    setup.clear()
    wary = Wary(si, ready.checker)
    setup.setStateValidityChecker(wary)
    assert setup.solve(within(20.0)).getStatus() == EXACT
    assert planner.validator.knows_obstacles and not planner.validator.exclusive
    path = setup.getSolutionPath()
    assert all(wary.isValid(path.getState(k)) for k in range(path.getStateCount()))
    setup.clear()
    setup.setStateValidityChecker(UserValidityChecker(si, lambda q: False))
    assert setup.solve(within(0.5)).getStatus() == ob.PlannerStatus.INVALID_START


def test_paths_of_trees_pass_the_full_check_too() -> None:
    """RRTConnect and OMPL's shortcuts look less closely."""
    alone = {"line": False, "first": 0, "second": 0, "third": 0, "bridge": False}
    for number in range(800_000, 800_004):
        ready = assemble(cached_problem(f"bins/hard/{number}"), robot())
        setup = ready.simple_setup
        setup.setPlanner(planners.make("apex", setup.getSpaceInformation(), seed=3, **alone))
        if setup.solve(within(8.0)).getStatus() == EXACT:
            assert full_check(ready.checker, states(setup), ready.start, ready.goals)
