"""Planners il and il-paper, and the policy in the closed loop: what they return is proved by others, and what not."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from imitations import config
from loops import PROBLEM, context_of, crossing, go, setup_of
from ompl import base as ob
from planning import cached_problem, within
from support import ROOT, needs

from apex_ompl import plan, planners
from apex_ompl.apex.models import make_query
from apex_ompl.baselines.imitation import policy as policies
from apex_ompl.baselines.imitation.checkpoint import save_policy
from apex_ompl.baselines.imitation.policy import shared_policy
from apex_ompl.baselines.imitation.replanner import ImitationReplanner
from apex_ompl.baselines.imitation.training import ImitationTrainer
from apex_ompl.collision import CollisionChecker
from apex_ompl.errors import ApexError, FileFormatError, MissingFileError, ParameterError
from apex_ompl.loop.control import RunRecord
from apex_ompl.loop.referee import RefereeReport
from apex_ompl.loop.replan.methods import named
from apex_ompl.loop.replanning import SHARE
from apex_ompl.moving.compute_costs import ComputeBudget, cost_table
from apex_ompl.moving.context import Following
from apex_ompl.moving.dynamic_obstacles import DynamicObstacles
from apex_ompl.moving.replanner import Request
from apex_ompl.ompl.setup import assemble
from apex_ompl.ompl.space import path_to_array
from apex_ompl.paths.path import FINE_RESOLUTION
from apex_ompl.problems.suite_robot import robot
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.scene.problem import Goal, Problem

BLOCKED = "posts/easy/800001"  # the straight line collides


@pytest.fixture(scope="module")
def straight(few: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A policy whose last layer is zero: it goes straight to the goal."""
    return _policy(few, tmp_path_factory.mktemp("straight"), lambda network: None)


@pytest.fixture(scope="module")
def bent(few: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A policy that is off by the same amount at every step, so that it stops short of the goal."""

    def bend(network: Any) -> None:
        with torch.no_grad():
            network.head.bias.fill_(0.8)

    return _policy(few, tmp_path_factory.mktemp("bent"), bend)


def _policy(few: Path, folder: Path, change: Any) -> Path:
    (folder / "run").mkdir()
    trainer = ImitationTrainer(config(few), folder / "run")
    network = trainer.network
    change(network)
    save_policy(folder / "policy", network, trainer.robot, trainer.data.joints, {}, bits=32)
    return folder / "policy"


@pytest.fixture
def free(problem: Problem) -> Problem:
    """The problem without its post."""
    return problem.model_copy(update={"scene": ()})


def solved(problem: Problem, params: dict[str, Any], seconds: float = 20.0) -> tuple[Any, np.ndarray | None, Any]:
    """Status, path and report of a planner inside OMPL, where straight lines are not tried before."""
    context = assemble(problem)
    planner = planners.make("il", context.simple_setup.getSpaceInformation(), **params)
    context.simple_setup.setPlanner(planner)
    status = context.simple_setup.solve(within(seconds)).getStatus()
    exact = status == ob.PlannerStatus.EXACT_SOLUTION
    path = path_to_array(context.simple_setup.getSolutionPath(), 16) if exact else None
    report = planner.report
    context.simple_setup.clear()
    return status, path, report


def densely_free(problem: Problem, path: np.ndarray) -> bool:
    """By the meshes at a spacing of 0.0031 rad, without proofs."""
    checker = CollisionChecker(robot(), problem.scene, problem.attached, problem.allowed)
    dense = [path[:1]]
    for a, b in zip(path[:-1], path[1:], strict=True):
        count = max(1, int(np.ceil(np.abs(b - a).max() / FINE_RESOLUTION)))
        dense.append(a + np.linspace(0, 1, count + 1)[1:, None] * (b - a))
    return all(not checker.contacts(q) for q in np.concatenate(dense))


def test_a_path_is_the_policys_own_with_the_goal_behind_it(straight: Path, free: Problem) -> None:
    status, path, report = solved(free, {"model": str(straight)})
    assert status == ob.PlannerStatus.EXACT_SOLUTION and path is not None
    names = robot().joint_names
    start, goal = free.start_state(names), free.goal_states(names)[0]
    np.testing.assert_array_equal(path[0], start)
    np.testing.assert_array_equal(path[-1], goal)
    assert len(path) in (64, 65) and report.solved_by == "il" and report.first_verified
    line = start + np.linspace(0, 1, 64)[:, None] * (goal - start)
    np.testing.assert_allclose(path[:64], line, atol=1e-5)
    assert densely_free(free, path)
    _, again, _ = solved(free, {"model": str(straight)})
    np.testing.assert_array_equal(again, path)


def test_a_path_that_collides_is_no_solution_and_says_where(straight: Path, problem: Problem) -> None:
    status, path, report = solved(problem, {"model": str(straight)})
    assert path is None and status == ob.PlannerStatus.ABORT
    assert "post" in report.reason and "mm deep" in report.reason and report.proposed == 1
    names = robot().joint_names
    line = np.stack([problem.start_state(names), problem.goal_states(names)[0]])
    assert not densely_free(problem, line)
    result = plan(problem, "il", params={"model": str(straight)}, timeout=20.0)
    assert not result and "post" in result.reason


def test_repair_is_a_control_that_finds_what_the_policy_did_not(straight: Path, problem: Problem) -> None:
    status, path, report = solved(problem, {"model": str(straight), "repair": True})
    assert status == ob.PlannerStatus.EXACT_SOLUTION and report.solved_by == "il+repair" and path is not None
    names = robot().joint_names
    np.testing.assert_array_equal(path[0], problem.start_state(names))
    np.testing.assert_array_equal(path[-1], problem.goal_states(names)[0])
    assert densely_free(problem, path)


def test_a_path_that_stops_short_is_no_solution_unless_it_is_within_reach(bent: Path, free: Problem) -> None:
    context = assemble(free)
    query = make_query(context.checker, context.start, context.goals[0])
    rolled = shared_policy(bent).roll_out([query], context.checker.kernel)
    assert rolled is not None
    off = float(np.abs(rolled[0, -1] - context.goals[0]).max())
    assert off > 1e-3
    status, path, report = solved(free, {"model": str(bent), "reach": 0.99 * off})
    assert path is None and status == ob.PlannerStatus.ABORT
    assert f"the path stops {off:.3g} rad short of the goal" in report.reason
    status, path, _ = solved(free, {"model": str(bent), "reach": 1.01 * off})
    assert path is not None and len(path) == 65
    np.testing.assert_array_equal(path[-1], context.goals[0])
    np.testing.assert_array_equal(path[:-1], rolled[0])
    assert densely_free(free, path)
    status, path, _ = solved(free, {"model": str(bent), "reach": 0.0, "pin": True})
    assert path is not None and len(path) == 64
    np.testing.assert_array_equal(path[-1], context.goals[0])


def test_the_nearest_goal_comes_first_and_then_each_in_turn(straight: Path, problem: Problem) -> None:
    """The nearest goal lies behind the post, another one does not."""
    names = robot().joint_names
    other = dict(problem.start, right_joint1=problem.start["right_joint1"] + 2.0)
    both = problem.model_copy(update={"goal": Goal(joints=(other, problem.goal.joints[0]))})
    status, path, report = solved(both, {"model": str(straight)})
    assert status == ob.PlannerStatus.EXACT_SOLUTION and path is not None
    goals = both.goal_states(names)
    distances = np.linalg.norm(goals - both.start_state(names), axis=1)
    assert distances[1] < distances[0], "the blocked goal is the nearer one"
    np.testing.assert_array_equal(path[-1], goals[0])
    assert report.candidates == 2


def test_it_stops_with_its_condition(straight: Path, free: Problem) -> None:
    context = assemble(free)
    planner = planners.make("il", context.simple_setup.getSpaceInformation(), model=str(straight))
    context.simple_setup.setPlanner(planner)
    context.simple_setup.setup()
    calls = iter(range(10_000))
    status = context.simple_setup.solve(ob.PlannerTerminationCondition(lambda: next(calls) > 4))
    assert status.getStatus() == ob.PlannerStatus.TIMEOUT and planner.report.proposed == 0
    begin = time.perf_counter()
    assert plan(cached_problem(BLOCKED), "il", params={"model": str(straight)}, timeout=0.01).path is None
    assert time.perf_counter() - begin < 30.0


@pytest.mark.parametrize("seed", range(2))
def test_no_path_that_is_returned_collides(seed: int, few: Path, tmp_path: Path) -> None:
    """Whatever the weights are: paths that count as solutions are free by a check of their own."""

    def shake(network: Any) -> None:
        generator = torch.Generator().manual_seed(seed)
        with torch.no_grad():
            network.head.weight.copy_(0.02 * torch.randn(network.head.weight.shape, generator=generator))

    model = str(_policy(few, tmp_path, shake))
    for name in ("vertical/free/800001", "vertical/small/800002", "posts/easy/800003"):
        problem = cached_problem(name)
        status, path, report = solved(problem, {"model": model, "reach": 1.0})
        assert (path is None) == bool(report.reason)
        if path is not None:
            assert densely_free(problem, path)
            goals = assemble(problem).valid_goals
            assert any(np.array_equal(path[-1], goal) for goal in goals)


def test_what_is_missing_or_wrong_is_named(straight: Path, problem: Problem, monkeypatch: pytest.MonkeyPatch) -> None:
    si = assemble(problem).simple_setup.getSpaceInformation()
    monkeypatch.setattr(policies, "weights_folder", Path("/no/such/place").joinpath)
    for name in ("il", "il-paper"):
        with pytest.raises(
            MissingFileError, match=f"imitation policy '/no/such/place/{name}'.*{name}.yaml --save makes"
        ):
            planners.make(name, si)
        with pytest.raises(ApexError, match="imitation policy"):
            plan(problem, name)
    with pytest.raises(ParameterError, match="state validity checker for il-paper"):
        planners.make("il-paper", ob.SpaceInformation(ob.RealVectorStateSpace(3)))
    with pytest.raises(FileFormatError, match="schema: expected 'apex-ompl/imitation/1'"):
        planners.make("il", si, model=str(ROOT / "apex_ompl" / "model" / "checkpoints" / "apex"))
    for values, word in (({"reach": -1.0}, "reach"), ({"executed": 0}, "executed"), ({"pin": 3}, "pin")):
        with pytest.raises(ParameterError, match=word):
            planners.parameters("il", **values)


# Closed loop


def looped(model: Path, *obstacles: Obstacle, **settings: Any) -> tuple[RunRecord, RefereeReport]:
    method = ImitationReplanner(str(model), steps=32)
    method.prepare(context_of(PROBLEM, **settings))
    return go(method, *obstacles, **settings)


@pytest.fixture
def loop_settings() -> Iterator[dict[str, Any]]:
    yield {"timeout": 6.0, **named("il").settings}


def test_the_loop_reaches_the_goal_where_nothing_is_in_the_way(straight: Path, loop_settings: dict[str, Any]) -> None:
    done, report = looped(straight, **loop_settings)
    assert done.reached and report.contact is None
    assert max(report.limit_use.values()) <= 1.0 + 1e-9
    accepted = [event for event in done.events if event.kind == "accepted"]
    assert len(accepted) > 2, "it is asked again while the robot moves"
    again, _ = looped(straight, **loop_settings)
    assert again.events == done.events
    np.testing.assert_array_equal(again.trajectory.positions, done.trajectory.positions)


def test_the_loop_follows_the_policy_unproved_into_what_it_does_not_avoid(
    straight: Path, loop_settings: dict[str, Any]
) -> None:
    """A straight policy runs into a box that comes into the straight line: nothing but the policy keeps it clear."""
    done, report = looped(straight, crossing(setup_of(PROBLEM)), fastest=0.5, **loop_settings)
    assert report.contact is not None and not [event for event in done.events if event.kind == "stop"]


def test_a_replan_begins_as_the_robot_moves_and_is_charged_by_chunks(straight: Path) -> None:
    context = context_of(PROBLEM, **named("il").settings)
    method = ImitationReplanner(str(straight), steps=16)
    method.prepare(context)
    begin, moving = 0.0, Following.resting(context.setup.start, 0.0, context.names)
    for number in range(1, 5):
        join, budget = begin + 0.1, ComputeBudget(SHARE * context.settings.budget)
        nothing = DynamicObstacles(())
        request = Request(number, begin, join, moving, None, nothing, 0.0, (), np.inf, 0)
        answer = method.replan(context, request, budget)
        assert answer.found is not None
        motion, expected = answer.found.motion, moving.at(join)
        for order in range(3):
            np.testing.assert_allclose(motion(0.0, order), expected[order], atol=1e-9)
        assert max(motion.use(context.limits).values()) <= 1.0 + 1e-9
        assert not motion.velocities[-1].any()
        chunks = budget.counts["chunk of a policy"]
        assert chunks == -(-16 // 8)
        seconds = cost_table()["seconds"]
        assert budget.spent == pytest.approx(chunks * seconds["chunk of a policy"] + seconds["straight motion"])
        begin, moving = join, answer.found


@needs("benchmarks/baselines/il")
@pytest.mark.parametrize("name", ["il", "il-paper"])
def test_the_policies_of_a_clone_are_there_and_small(name: str, free: Problem) -> None:
    folder = ROOT / "benchmarks" / "baselines" / name
    assert sum(file.stat().st_size for file in folder.iterdir()) < 5 * 2**20
    policy = shared_policy(name, robot="dual_panda_softhand")
    trained = policy.config.trained
    assert trained["held_out"] < 0.6 * trained["line"], "a third better than the straight line and more"
    assert trained["step"] > 0.95 * trained["steps"], "its learning rate had all but come to 0"
    assert policy.sees_point == (name == "il-paper")
    result = plan(free, name, timeout=20.0)
    assert result.solved_by in ("straight line", name)
