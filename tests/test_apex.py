"""APEX as a planner of OMPL's: what users of OMPL may do with any planner, its own stages, and what can go wrong."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from ompl import base as ob
from ompl import geometric as og
from ompl import tools as ot
from support import ROOT

import apex_ompl
from apex_ompl import plan, planners, problems
from apex_ompl.assembly import PlanningSetup, assemble
from apex_ompl.diffusion.proposals import TrajectoryModel
from apex_ompl.errors import ApexError, MissingFileError, ParameterError, UnknownNameError
from apex_ompl.ompl_globals import quiet_ompl
from apex_ompl.planners import APEX
from apex_ompl.planners.apex_parameters import ApexParameters
from apex_ompl.planners.judge import Judge
from apex_ompl.problem import Obstacle, Problem
from apex_ompl.problems.reach import robot
from apex_ompl.result import INSIDE, PlanStatus
from apex_ompl.space import path_length, path_to_array, state_space, to_state
from apex_ompl.validity import VerdictChecker, full_check

EXACT, TIMEOUT = ob.PlannerStatus.EXACT_SOLUTION, ob.PlannerStatus.TIMEOUT
HARD = "shelf/hard/800012"
EASY = "posts/easy/800001"


def within(seconds: float) -> ob.PlannerTerminationCondition:
    return ob.timedPlannerTerminationCondition(seconds)


@cache
def at_hand(name: str) -> Problem:
    return problems.load(name)


@pytest.fixture(autouse=True)
def _quiet() -> Iterator[None]:
    with quiet_ompl():
        yield


@pytest.fixture
def ready() -> PlanningSetup:
    """A hard problem, set up."""
    return assemble(at_hand(HARD), robot())


def states(setup: og.SimpleSetup) -> np.ndarray:
    return path_to_array(setup.getSolutionPath(), robot().dof)


def test_it_is_the_default_and_proves_what_it_finds() -> None:
    result = plan(at_hand(HARD), timeout=20.0)
    assert result and result.planner == "apex", result.reason
    verdict = assemble(at_hand(HARD), robot()).verdict
    assert full_check(verdict, result.path, result.path[0], [result.path[-1]], resolution=0.0005)
    inside = {name.removeprefix(INSIDE): seconds for name, seconds in result.times.items() if name.startswith(INSIDE)}
    assert {"query", "known", "polish"} <= inside.keys()
    assert sum(inside.values()) <= result.times["solve"]
    tree = plan(at_hand(HARD), "rrtconnect", timeout=20.0)
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
    assert full_check(ready.verdict, path, ready.start, ready.goals)
    assert setup.getProblemDefinition().getSolutionDifference() == 0.0


def test_ompls_benchmark_runs_it(ready: PlanningSetup) -> None:
    setup = ready.simple_setup
    benchmark = ot.Benchmark(setup, "hard")
    benchmark.addPlanner(APEX(setup.getSpaceInformation(), ApexParameters(seed=1)))
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
    planner = APEX(setup.getSpaceInformation(), ApexParameters(seed=0))
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
        pdef.setStartAndGoalStates(to_state(si.getStateSpace(), start), to_state(si.getStateSpace(), goal))
        planner.setProblemDefinition(pdef)
        assert planner.solve(within(20.0)).getStatus() == EXACT
        path = path_to_array(pdef.getSolutionPath(), robot().dof)
        assert full_check(ready.verdict, path, start, [goal])
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
    space, pdef = si.getStateSpace(), ob.ProblemDefinition(si)
    blocked = ready.start.copy()
    blocked[0] = 10.0  # out of limits
    for q in (blocked, ready.start):
        pdef.addStartState(to_state(space, q))
    if kind == "region":
        goal = Region(si, np.stack([ready.goals[0], ready.start]))
    else:
        goal = ob.GoalStates(si)
        far = ready.goals[0].copy()
        far[14] = 1.0 - far[14]
        for q in (blocked, far, blocked, ready.goals[0]):
            goal.addState(to_state(space, q))
    pdef.setGoal(goal)
    planner = APEX(si, ApexParameters(seed=0))
    planner.setProblemDefinition(pdef)
    planner.setup()
    assert planner.solve(within(20.0)).getStatus() == EXACT
    path = path_to_array(pdef.getSolutionPath(), robot().dof)
    wanted = ready.start if kind == "region" else ready.goals[0]  # the region holds the start itself, the nearest goal
    np.testing.assert_array_equal(path[[0, -1]], [ready.start, wanted])


def test_a_goal_that_cannot_be_sampled_is_refused(ready: PlanningSetup) -> None:
    class Somewhere(ob.GoalRegion):
        def distanceGoal(self, state: Any) -> float:  # noqa: N802
            return 1.0

    si = ready.simple_setup.getSpaceInformation()
    pdef = ob.ProblemDefinition(si)
    pdef.addStartState(to_state(si.getStateSpace(), ready.start))
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
    result = plan("stack_boxes", timeout=20.0, params={"line": False})
    assert result and result.planner == "apex"
    assert any(isinstance(query, list) and len(query) > 1 for query in asked)
    assert len({tuple(query.goal) for query in asked[-1]}) == len(asked[-1])


class Plain(ob.StateValidityChecker):
    """A checker that knows nothing of this project but its verdict, as that of a user's might."""

    def __init__(self, si: ob.SpaceInformation, free: Callable[[np.ndarray], bool]) -> None:
        super().__init__(si)
        self.free = free

    def isValid(self, state: Any) -> bool:  # noqa: N802
        return self.free(np.array(state[0:16]))


def foreign(name: str) -> tuple[PlanningSetup, og.SimpleSetup]:
    ready = assemble(at_hand(name), robot())
    space = state_space(robot())
    setup = og.SimpleSetup(space)
    setup.setStateValidityChecker(Plain(setup.getSpaceInformation(), ready.verdict.is_free))
    setup.setStartAndGoalStates(to_state(space, ready.start), to_state(space, ready.goals[0]))
    return ready, setup


def test_another_checker_judges_and_is_told_of_once(caplog: pytest.LogCaptureFixture) -> None:
    ready, setup = foreign(EASY)
    caplog.set_level(logging.INFO, logger="apex_ompl")
    planner = APEX(setup.getSpaceInformation())
    setup.setPlanner(planner)
    assert setup.solve(within(30.0)).getStatus() == EXACT
    assert full_check(ready.verdict, states(setup), ready.start, ready.goals, resolution=0.02)
    assert setup.solve(within(30.0)).getStatus() == EXACT
    assert sum("is not apex_ompl's" in record.message for record in caplog.records) == 1


def test_the_example_with_a_checker_of_its_own_runs(capsys: pytest.CaptureFixture[str]) -> None:
    text = (ROOT / "examples" / "own_checker.py").read_text()
    exec(compile(text, "own_checker.py", "exec"), {"__name__": "__main__"})  # noqa: S102
    assert "EXACT_SOLUTION" in capsys.readouterr().out


def test_the_checkers_of_the_moment_judge(ready: PlanningSetup) -> None:
    """One that says more than the verdict is asked, and one that is set later on takes the place of the first."""

    class Wary(VerdictChecker):
        def isValid(self, state: Any) -> bool:  # noqa: N802
            return super().isValid(state) and state[14] < 0.9

    setup = ready.simple_setup
    si = setup.getSpaceInformation()
    planner = APEX(si, ApexParameters(seed=0))
    setup.setPlanner(planner)
    assert setup.solve(within(20.0)).getStatus() == EXACT and planner.judge.alone
    setup.clear()
    wary = Wary(si, ready.verdict)
    setup.setStateValidityChecker(wary)
    assert setup.solve(within(20.0)).getStatus() == EXACT
    assert planner.judge.knows_obstacles and not planner.judge.alone
    path = setup.getSolutionPath()
    assert all(wary.isValid(path.getState(k)) for k in range(path.getStateCount()))
    setup.clear()
    setup.setStateValidityChecker(Plain(si, lambda q: False))
    assert setup.solve(within(0.5)).getStatus() == ob.PlannerStatus.INVALID_START


def test_paths_of_trees_pass_the_full_check_too() -> None:
    """RRTConnect and OMPL's shortcuts look less closely."""
    alone = {"line": False, "first": 0, "second": 0, "third": 0, "bridge": False}
    for number in range(800_000, 800_004):
        ready = assemble(at_hand(f"bins/hard/{number}"), robot())
        setup = ready.simple_setup
        setup.setPlanner(planners.make("apex", setup.getSpaceInformation(), seed=3, **alone))
        if setup.solve(within(8.0)).getStatus() == EXACT:
            assert full_check(ready.verdict, states(setup), ready.start, ready.goals)


# Stages

ALONE = {"bridge": False, "fallback": False, "polish": False}


@pytest.mark.parametrize(
    ("changes", "by"),
    [
        ({"line": False, "third": 0}, ("apex", "apex+repair", "apex+resample", "apex+resample+repair")),
        ({"first": 0, "second": 0, "third": 0, "resample": 0}, ("line+repair",)),
        ({"repair": False, "line": False, "first": 32}, ("apex", "apex+resample", "")),
        (
            {"repair": False, "line": False, "first": 8, "second": 0, "third": 0, "resample": 0, "bridge": True},
            ("apex", "apex+bridge"),
        ),
        (
            {"line": False, "first": 0, "second": 0, "third": 0, "bridge": False, "fallback": True},
            ("rrtconnect",),
        ),
    ],
)
def test_stages_can_be_left_out(changes: dict[str, Any], by: tuple[str, ...]) -> None:
    result = plan(at_hand("swap/hard/800000"), timeout=4.0, params={**ALONE, **changes})
    assert result.solved_by in by and bool(result) == bool(result.solved_by), (result.solved_by, result.reason)
    names = {name.removeprefix(INSIDE) for name in result.times if name.startswith(INSIDE)}
    assert "polish" not in names
    assert ("repair" in names) <= changes.get("repair", True)
    assert ("rrtconnect" in names) <= changes.get("fallback", False)


def test_the_algorithm_of_the_paper_alone_runs(ready: PlanningSetup) -> None:
    """Guided ancestral sampling in all steps, resampling on collision or nearness, nothing else."""
    paper = {
        "sampler": "ddpm", "denoising_steps": 64, "guidance": True, "gamma": 1.0, "lambda_obs": 0.02, "line": False,
        "repair": False, "first": 8, "second": 0, "third": 0, "resample": 2, **ALONE,
    }  # fmt: skip
    setup = ready.simple_setup
    planner = planners.make("apex", setup.getSpaceInformation(), **paper)
    setup.setPlanner(planner)
    setup.setup()  # the kernel may have to be compiled
    status = setup.solve(within(6.0)).getStatus()
    assert status in (EXACT, TIMEOUT)
    assert planner.report.times.keys() >= {"propose", "judge"}
    assert planner.report.candidates >= 8
    if status == EXACT:
        assert full_check(ready.verdict, states(setup), ready.start, ready.goals)


def test_valid_paths_that_pass_too_near_are_resampled(ready: PlanningSetup) -> None:
    judge = Judge(ready.simple_setup.getSpaceInformation(), "")
    plain = plan(at_hand(HARD), timeout=20.0, params={"polish": False})
    wary = plan(at_hand(HARD), timeout=20.0, params={"polish": False, "lambda_obs": 0.5})
    assert plain and wary
    gaps = [judge.gap(result.path) for result in (plain, wary)]
    assert gaps[1] >= gaps[0] - 1e-9, "nothing is half a metre off, so the one that keeps most distance stands"
    assert wary.times[INSIDE + "resample"] > plain.times.get(INSIDE + "resample", 0.0)
    by_hand = min(ready.verdict.distance(q).value for q in wary.path[::4])
    assert gaps[1] == pytest.approx(min(by_hand, ready.verdict.distance(wary.path[-1]).value))


def test_the_same_seed_gives_the_same_path_also_in_threads() -> None:
    def length(_: int) -> list[float]:
        result = plan(at_hand(HARD), timeout=60.0, params={"seed": 5})
        return [result.length, *result.path[100]]

    threads = torch.get_num_threads()
    alone = length(0)
    with ThreadPoolExecutor(2) as pool:
        assert all(found == alone for found in pool.map(length, range(2)))
    assert torch.get_num_threads() == threads
    assert plan(at_hand(HARD), timeout=60.0, params={"seed": 6}).length != alone[0]


def test_with_time_left_paths_only_get_shorter(ready: PlanningSetup) -> None:
    setup = ready.simple_setup
    si = setup.getSpaceInformation()
    setup.setOptimizationObjective(ob.PathLengthOptimizationObjective(si))
    planner = APEX(si, ApexParameters(seed=0))
    setup.setPlanner(planner)
    setup.setup()
    assert setup.solve(within(3.0)).getStatus() == EXACT
    found = setup.getProblemDefinition().getSolutionCount()
    assert "improve" in planner.report.times
    once = plan(at_hand(HARD), timeout=20.0, params={"seed": 0})
    assert found >= 1 + planner.report.improved
    assert path_length(states(setup)) <= once.length + 1e-9
    assert full_check(ready.verdict, states(setup), ready.start, ready.goals)
    objective = ob.PathLengthOptimizationObjective(si)
    objective.setCostThreshold(ob.Cost(100.0))
    setup.clear()
    setup.setOptimizationObjective(objective)
    begin = time.perf_counter()
    assert setup.solve(within(30.0)).getStatus() == EXACT
    assert time.perf_counter() - begin < 20.0, "a path under the threshold is enough"


# What can go wrong


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
        plan(at_hand(HARD), params={"model": "nope"})
    with pytest.raises(ParameterError, match="'denoising_steps'.*at most 256"):
        plan(at_hand(HARD), params={"denoising_steps": 500})
    (tmp_path / "empty").mkdir()
    with pytest.raises(MissingFileError, match="config.json"):
        plan(at_hand(HARD), params={"model": str(tmp_path / "empty")})
    with pytest.raises(ApexError, match="expected 'baxter'"):
        setup = apex_ompl.setup(Problem.load(ROOT / "examples" / "baxter_table.yaml"))
        APEX(setup.getSpaceInformation())


def test_start_at_the_goal_is_a_path(ready: PlanningSetup) -> None:
    si = ready.simple_setup.getSpaceInformation()
    state = to_state(si.getStateSpace(), ready.start)
    ready.simple_setup.setStartAndGoalStates(state, state)
    ready.simple_setup.setPlanner(APEX(si))
    assert ready.simple_setup.solve(within(5.0)).getStatus() == EXACT
    np.testing.assert_array_equal(states(ready.simple_setup), np.tile(ready.start, (256, 1)))


def test_without_a_goal_there_is_a_status(ready: PlanningSetup) -> None:
    si = ready.simple_setup.getSpaceInformation()
    pdef = ob.ProblemDefinition(si)
    pdef.addStartState(to_state(si.getStateSpace(), ready.start))
    planner = APEX(si)
    planner.setProblemDefinition(pdef)
    assert planner.solve(within(1.0)).getStatus() == ob.PlannerStatus.INVALID_GOAL


def _outcome(ready: PlanningSetup, start: np.ndarray, goal: np.ndarray, **values: Any) -> tuple[str, str]:
    si = ready.simple_setup.getSpaceInformation()
    space, pdef = si.getStateSpace(), ob.ProblemDefinition(si)
    pdef.setStartAndGoalStates(to_state(space, start), to_state(space, goal))
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
    crossed = next(q for q in drawn if not ready.verdict.is_free(q))
    wild, nan = goal.copy(), start.copy()
    wild[3], nan[2] = 5.0, np.nan
    assert _outcome(ready, crossed, goal) == ("INVALID_START", "no start state is valid")
    assert _outcome(ready, nan, goal) == ("INVALID_START", "no start state is valid")
    for faulty in (crossed, wild, nan):
        status, reason = _outcome(ready, start, faulty)
        assert status in ("INVALID_GOAL", "TIMEOUT") and reason


def test_behind_a_wall_there_is_no_way(ready: PlanningSetup) -> None:
    """The wall begins 12 cm from the first axis of the left arm, whose first link cannot pass, and must."""
    verdict = assemble(at_hand(HARD).model_copy(update={"scene": ()}), robot())
    start, goal = robot().home.copy(), robot().home.copy()
    start[0], goal[0] = 0.6, 2.12
    verdict.verdict.add(Obstacle(name="wall", box=(2.0, 0.04, 3.0), position=(1.12, 0.5, 1.5)))
    for q0 in np.linspace(1.15, 2.0, 20):
        between = start.copy()
        between[0] = q0
        assert any("left_link1" in str(contact) for contact in verdict.verdict.contacts(between))
    assert _outcome(verdict, start, goal)[0] == "TIMEOUT"


def test_without_a_way_there_is_none_in_time() -> None:
    """The first joint may not cross zero, and the goal is on the other side."""
    panda, space = robot(), state_space(robot())
    setup = og.SimpleSetup(space)
    setup.setStateValidityChecker(Plain(setup.getSpaceInformation(), lambda q: bool(abs(q[0]) > 0.05)))
    start, goal = panda.home.copy(), panda.home.copy()
    start[0], goal[0] = -0.5, 0.5
    setup.setStartAndGoalStates(to_state(space, start), to_state(space, goal))
    planner = APEX(setup.getSpaceInformation(), ApexParameters(seed=0, third=0))
    setup.setPlanner(planner)
    setup.setup()
    begin = time.perf_counter()
    assert setup.solve(within(1.0)).getStatus() == TIMEOUT
    assert 0.9 < time.perf_counter() - begin < 3.0
    assert "no path among" in planner.report.reason and not setup.haveSolutionPath()


def test_approximate_solutions_come_with_their_difference(ready: PlanningSetup) -> None:
    setup = ready.simple_setup
    si = setup.getSpaceInformation()
    nothing = {"line": True, "first": 1, "second": 0, "third": 0, "repair": False, "resample": 0, **ALONE}
    setup.setPlanner(planners.make("apex", si, approximate=True, seed=0, **nothing))
    setup.setup()
    status = setup.solve(within(1.0)).getStatus()
    assert status == ob.PlannerStatus.APPROXIMATE_SOLUTION
    path = states(setup)
    gap = np.linalg.norm(path[-1] - ready.goals[0])
    assert gap > 0.0 and setup.getProblemDefinition().getSolutionDifference() == pytest.approx(gap)
    assert full_check(ready.verdict, path, ready.start)
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

    monkeypatch.setattr(planner.judge, "is_valid", fail)
    ready.simple_setup.setPlanner(planner)
    assert ready.simple_setup.solve(within(1.0)).getStatus() == ob.PlannerStatus.CRASH
    assert "ZeroDivisionError" in planner.report.reason
    assert any(record.exc_info for record in caplog.records)


@pytest.mark.parametrize("count", [0, 300])
def test_no_obstacles_and_very_many(count: int) -> None:
    base = at_hand(HARD)
    rng = np.random.default_rng(0)
    scene = []
    for k in range(count):
        place = (float(rng.uniform(-1.5, -0.9)), float(rng.uniform(-1, 1)), float(rng.uniform(0, 1.5)))
        scene.append(Obstacle(name=f"piece{k}", box=(0.03, 0.03, 0.03), position=place))
    problem = base.model_copy(update={"scene": (*scene, *base.scene) if count else ()})
    result = plan(problem, timeout=20.0)
    assert result, result.reason
