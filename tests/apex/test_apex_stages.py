"""The stages of APEX: alone, in the paper's order, by seed, and with time left."""

from __future__ import annotations

import time
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest
import torch
from ompl import base as ob
from planning import DIFFUSION_ONLY, EXACT, HARD, TIMEOUT, cached_problem, states, within

from apex_ompl import plan, planners
from apex_ompl.apex.parameters import ApexParameters
from apex_ompl.apex.path_validator import PathValidator
from apex_ompl.apex.stages import Propose, Solution, Sprint, TakeTurns, shorten
from apex_ompl.apex.stages.trees import ITERATIONS
from apex_ompl.ompl.setup import PlanningSetup
from apex_ompl.ompl.validity import full_check
from apex_ompl.paths.path import Path, path_length, resample
from apex_ompl.planners import APEX
from apex_ompl.result import INSIDE

pytestmark = pytest.mark.usefixtures("quiet")


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
            {"line": False, "first": 0, "second": 0, "third": 0, "bridge": False, "fallback": True, "sprint": 1},
            ("rrtconnect",),
        ),
    ],
)
def test_stages_can_be_left_out(changes: dict[str, Any], by: tuple[str, ...]) -> None:
    timeout = 30.0 if changes.get("fallback") else 4.0
    result = plan(cached_problem("swap/hard/800000"), timeout=timeout, params={**DIFFUSION_ONLY, **changes})
    assert result.solved_by in by and bool(result) == bool(result.solved_by), (result.solved_by, result.reason)
    names = {name.removeprefix(INSIDE) for name in result.times if name.startswith(INSIDE)}
    assert "polish" not in names
    assert ("repair" in names) <= changes.get("repair", True)
    assert ("rrtconnect" in names) <= changes.get("fallback", False)


def test_open_scenes_take_a_sprint_of_a_tree() -> None:
    problem = cached_problem("vertical/small/800000")
    quick = plan(problem, timeout=10.0)
    assert quick.solved_by == "sprint" and not {INSIDE + "propose", INSIDE + "rrtconnect"} & quick.times.keys()
    for params in ({"sprint": 0}, {"fallback": False}, {"lambda_obs": 0.001}):
        other = plan(problem, timeout=10.0, params=params)
        assert other and other.solved_by != "sprint" and INSIDE + "sprint" not in other.times


@pytest.mark.parametrize(("model", "by"), [("none", "sprint"), (None, "")])
def test_where_no_model_is_trained_ompls_trees_sprint_where_spheres_prove_no_way(
    model: str | None, by: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Sprint, "_compiled", lambda *_: None)  # the spheres prove no way
    monkeypatch.setattr(Propose, "run", lambda *_: None)
    monkeypatch.setattr(TakeTurns, "run", lambda *_: None)
    params = {"line": False, "bridge": False} | ({} if model is None else {"model": model})
    result = plan("reach_past_post", timeout=20.0, seed=1, params=params)
    assert result.solved_by == by, result.reason
    assert bool(result) == bool(by)


def test_a_sprint_that_is_not_enough_is_the_beginning_of_the_fallback() -> None:
    unaided = {"line": False, "first": 0, "second": 0, "third": 0, "repair": False, "bridge": False, "polish": False}
    lengths = []
    for sprint in (0, 1):
        result = plan(cached_problem("swap/hard/800000"), timeout=20.0, seed=1, params={**unaided, "sprint": sprint})
        assert result.solved_by == "rrtconnect" and (INSIDE + "sprint" in result.times) == bool(sprint)
        lengths.append(result.length)
    assert lengths[0] == lengths[1], "one iteration more or less in the sprint changes nothing about the tree"


def test_the_algorithm_of_the_paper_alone_runs(ready: PlanningSetup) -> None:
    """Guided ancestral sampling in all steps, resampling on collision or nearness, nothing else."""
    paper = {
        "sampler": "ddpm", "denoising_steps": 64, "guidance": True, "gamma": 1.0, "lambda_obs": 0.02, "line": False,
        "repair": False, "first": 8, "second": 0, "third": 0, "resample": 2, **DIFFUSION_ONLY,
    }  # fmt: skip
    setup = ready.simple_setup
    planner = planners.make("apex", setup.getSpaceInformation(), **paper)
    setup.setPlanner(planner)
    setup.setup()  # the kernel may have to be compiled
    status = setup.solve(within(6.0)).getStatus()
    assert status in (EXACT, TIMEOUT)
    assert planner.report.times.keys() >= {"propose", "check"}
    assert planner.report.candidates >= 8
    if status == EXACT:
        assert full_check(ready.checker, states(setup), ready.start, ready.goals)


def test_valid_paths_that_pass_too_near_are_resampled(ready: PlanningSetup) -> None:
    validator = PathValidator(ready.simple_setup.getSpaceInformation(), "")
    plain = plan(cached_problem(HARD), timeout=20.0, params={"polish": False, "sprint": 0})
    wary = plan(cached_problem(HARD), timeout=20.0, params={"polish": False, "lambda_obs": 0.5})
    assert plain and wary
    gaps = [validator.obstacle_distance(result.path.states) for result in (plain, wary)]
    assert gaps[1] >= gaps[0] - 1e-9, "nothing is half a meter off, so the one that keeps most distance stands"
    assert wary.times[INSIDE + "resample"] > plain.times.get(INSIDE + "resample", 0.0)
    by_hand = min(ready.checker.distance(q).value for q in resample(wary.path.states, 1500))
    assert by_hand - 2e-3 < gaps[1] <= min(by_hand, ready.checker.distance(wary.path[-1]).value) + 1e-5


def test_paths_of_trees_are_not_cut_nearer_to_obstacles_than_is_wanted(ready: PlanningSetup) -> None:
    validator, cut = PathValidator(ready.simple_setup.getSpaceInformation(), ""), 0
    for seed in range(4):
        params = {"lambda_obs": 0.05, "line": False, "first": 0, "second": 0, "third": 0}
        found = [
            plan(cached_problem(HARD), timeout=20.0, seed=seed, simplify=False, params={**params, "polish": polish})
            for polish in (False, True)
        ]
        first, last = (validator.obstacle_distance(result.path.states) for result in found)
        assert last >= min(0.05, first) - 5e-3  # the first one's is taken at states 0.1 rad apart
        cut += found[1].length < found[0].length
    assert cut >= 2


@pytest.mark.parametrize(("sprint", "by"), [(0, "apex"), (ApexParameters().sprint, "sprint")])
def test_the_same_seed_gives_the_same_path_also_in_threads(sprint: int, by: str) -> None:
    def length(_: int) -> list[float]:
        result = plan(cached_problem(HARD), timeout=60.0, params={"seed": 7, "sprint": sprint})
        assert result.solved_by.startswith(by)
        return [result.length, *result.path[100]]

    threads = torch.get_num_threads()
    alone = length(0)
    with ThreadPoolExecutor(2) as pool:
        assert all(found == alone for found in pool.map(length, range(2)))
    assert torch.get_num_threads() == threads
    assert plan(cached_problem(HARD), timeout=60.0, params={"seed": 6, "sprint": sprint}).length != alone[0]


def test_a_long_way_round_is_taken_where_other_trees_find_no_shorter_one(monkeypatch: pytest.MonkeyPatch) -> None:
    def lengths(others: int) -> list[float]:
        monkeypatch.setattr(shorten, "OTHERS", others)
        found = []
        for seed in range(4):
            params = {"model": "none", "line": False, "seed": seed, "polish": True}
            result = plan(cached_problem("cage/hard/800000"), timeout=20.0, params=params)
            assert result and result.solved_by == "sprint"
            found.append(result.length)
        return found

    monkeypatch.setattr(shorten, "DETOUR", 1.2)
    once, again = lengths(0), lengths(3)
    assert sum(again) < 0.97 * sum(once)
    assert once == lengths(0), "the same seeds, the same paths"


def test_with_time_left_paths_only_get_shorter(ready: PlanningSetup) -> None:
    setup = ready.simple_setup
    si = setup.getSpaceInformation()
    setup.setOptimizationObjective(ob.PathLengthOptimizationObjective(si))
    planner = APEX(si, seed=0, sprint=0, anytime=True)
    setup.setPlanner(planner)
    setup.setup()
    assert setup.solve(within(2.0)).getStatus() == EXACT
    found = setup.getProblemDefinition().getSolutionCount()
    assert "improve" in planner.report.times
    once = plan(cached_problem(HARD), timeout=20.0, params={"seed": 0, "sprint": 0})
    assert found >= 1 + planner.report.improved
    assert path_length(states(setup)) <= once.length + 1e-9
    assert full_check(ready.checker, states(setup), ready.start, ready.goals)
    objective = ob.PathLengthOptimizationObjective(si)
    objective.setCostThreshold(ob.Cost(100.0))
    setup.clear()
    setup.setOptimizationObjective(objective)
    begin = time.perf_counter()
    assert setup.solve(within(30.0)).getStatus() == EXACT
    assert time.perf_counter() - begin < 20.0, "a path under the threshold is enough"


class Told:
    """What :class:`TakeTurns` asks of a context, for some calls of ``stop``."""

    def __init__(self, calls: int) -> None:
        self.calls, self.done, self.pool = calls, list[Any](), None

    def stop(self) -> bool:
        self.calls -= 1
        return self.calls < 0

    def new_pool(self) -> None:
        self.done.append("pool")

    def farthest(self) -> None:
        self.done.append("farthest")


class Noted:
    """Stage or trees that note their turn, and find a path in one of them."""

    def __init__(self, name: str, on: int = 99) -> None:
        self.name, self.on, self.count = name, on, 0

    def run(self, context: Told, *iterations: int) -> Solution | None:
        self.count += 1
        context.done.append((self.name, *iterations))
        return Solution(Path(np.zeros((2, 1))), self.name) if self.count == self.on else None


def test_trees_and_rounds_take_turns_by_counts() -> None:
    trees, cold, hot = Noted("trees"), Noted("cold"), Noted("hot", on=2)
    told = Told(100)
    assert TakeTurns(trees, ((cold,), (hot,))).run(told).stage == "hot"  # type: ignore[arg-type, union-attr]
    stages = [one for one in told.done if one != "pool"]
    assert [one[0] for one in stages] == ["trees", "cold", "trees", "hot"] * 2
    lengths = [one[1] for one in stages if one[0] == "trees"]
    assert lengths[0] == ITERATIONS and all(b > a for a, b in zip(lengths, lengths[1:], strict=False))
    told = Told(100)
    assert TakeTurns(Noted("trees", on=3), ()).run(told).stage == "trees"  # type: ignore[arg-type, union-attr]
    told = Told(5)
    assert TakeTurns(None, ((Noted("x"),),)).run(told) is None and told.done[-1] == "farthest"  # type: ignore[arg-type]
    told = Told(100)
    assert TakeTurns(None, ()).run(told) is None and told.done == ["farthest"]  # type: ignore[arg-type]


def test_later_rounds_are_hotter() -> None:
    turns = ApexParameters().stages()[-1]
    assert isinstance(turns, TakeTurns) and turns.trees is not None
    hot = [next(stage for stage in one if isinstance(stage, Propose)).temperature for one in turns.rounds]
    assert all(one > 1.0 for one in hot) and len(set(hot)) == len(hot)
    first = [stage for stage in ApexParameters().stages() if isinstance(stage, Propose)]
    assert {stage.temperature for stage in first} == {1.0}
    assert ApexParameters(fallback=False).stages()[-1].trees is None  # type: ignore[attr-defined]
