"""GPMP and GPMP2 as planners, as a replanner, and the clearance costs that they count."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from loops import PROBLEM, context_of, go, setup_of
from ompl import base as ob

from apex_ompl import MotionPlanner, plan, planners, problems, run
from apex_ompl.baselines.gpmp.planner import GaussianProcessPlanner
from apex_ompl.baselines.gpmp.replanner import IncrementalGPMP, IncrementalGPMP2
from apex_ompl.collision import CollisionChecker
from apex_ompl.errors import ParameterError, UnknownNameError
from apex_ompl.kernel.path import clearance_costs
from apex_ompl.loop.replan.methods import named
from apex_ompl.moving.compute_costs import ComputeBudget
from apex_ompl.moving.context import Following
from apex_ompl.moving.dynamic_obstacles import DynamicObstacles, clearance_in_time
from apex_ompl.moving.replanner import Request
from apex_ompl.ompl.setup import PlanningSetup, assemble
from apex_ompl.paths.optimizer import Optimizer, OptimizerSettings
from apex_ompl.paths.spline import Spline
from apex_ompl.result import PlanResult, PlanStatus
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.scene.problem import Goal, Problem

NAMES = ("gpmp", "gpmp2")
OPEN = ("vertical/small/800001", "horizontal/small/800002")
HOPELESS = "cage/easy/800000"


def check(result: PlanResult, problem: Problem, robot: Robot) -> None:
    """A path is free by the meshes alone, inside the limits, and has the given start and a goal."""
    assert result, result.reason
    path = result.path.states
    checker = CollisionChecker(robot, problem.scene, problem.attached, problem.allowed, proofs=False)
    assert checker.first_collision(path, 0.01) is None
    assert (path >= robot.limits.lower).all() and (path <= robot.limits.upper).all()
    setup = assemble(problem, robot)
    assert np.array_equal(path[0], setup.start) and (np.abs(setup.valid_goals - path[-1]).max(axis=1) == 0.0).any()


@pytest.fixture(scope="module")
def context(robot: Robot) -> PlanningSetup:
    return assemble(problems.load("wall/easy/5"), robot)


def test_the_cost_of_states_is_that_of_the_optimizer(context: PlanningSetup) -> None:
    spline, kernel = Spline(), context.checker.kernel
    settings = OptimizerSettings(samples=40, scene_margin=0.08, own_margin=0.03, stiffness=1e-12)
    line = spline.line(context.start, context.goals[0])
    about, _ = Optimizer(spline, settings).evaluate(kernel, line)
    found = clearance_costs(kernel, spline.basis((np.arange(40) + 0.5) / 40) @ line, 0.08, 0.03)
    assert found.cost.max() > 1.0 and found.cost.mean() == pytest.approx(about.clearance_cost[0], rel=1e-9)
    np.testing.assert_allclose(found.clearance.min(axis=0), about.clearance[0], atol=1e-12)
    np.testing.assert_allclose(found.gram, found.gram.transpose(0, 2, 1))
    assert np.linalg.eigvalsh(found.gram).min() > -1e-9


def test_gradients_of_states_are_those_of_finite_differences(context: PlanningSetup) -> None:
    """Among obstacles that stand, and one that comes by."""
    palm = context.robot.link_pose(context.start, "left_hand_palm")[:3, 3]
    box = Obstacle(name="box", box=(0.1,) * 3, position=tuple((palm + (0, 0.4, 0.1)).tolist()), velocity=(0, -0.3, 0))
    dynamic, kernel, rng = DynamicObstacles([box]), context.checker.kernel, np.random.default_rng(0)
    states = np.linspace(context.start, context.goals[0], 30) + 0.02 * rng.normal(size=(30, context.robot.dof))
    states = np.clip(states, context.robot.limits.lower + 1e-3, context.robot.limits.upper - 1e-3)
    times = np.linspace(0.0, 1.5, 30)

    def cost(q: np.ndarray) -> np.ndarray:
        return clearance_costs(kernel, q, 0.15, 0.05, times, dynamic.packed).cost

    found = clearance_costs(kernel, states, 0.15, 0.05, times, dynamic.packed)
    matching = 0
    for _ in range(5):
        way = rng.normal(size=states.shape)
        slope = (cost(states + 1e-6 * way) - cost(states - 1e-6 * way)) / 2e-6
        matching += int(np.isclose(slope, (found.gradient * way).sum(axis=1), rtol=1e-3, atol=1e-4).sum())
    assert matching >= 145 and (found.cost > 0.0).sum() > 20  # where two spheres are as near there is a kink
    alone = clearance_costs(kernel, states, 0.15, 0.05)
    assert (found.cost >= alone.cost).all() and (found.cost > alone.cost + 0.1).any()
    moving, _ = clearance_in_time(kernel, dynamic, states, times, 0.15)
    np.testing.assert_allclose(found.clearance[:, 0], np.minimum(alone.clearance[:, 0], moving), atol=1e-12)


def test_states_that_the_tables_do_not_hold_for_cost_everything(context: PlanningSetup) -> None:
    kernel, bad = context.checker.kernel, np.stack([context.start, context.start])
    bad[1, -1] = 1.7
    found = clearance_costs(kernel, bad, 0.05, 0.05)
    assert np.isfinite(found.cost[0]) and np.isinf(found.cost[1]) and not found.gradient[1].any()
    for arguments, name in ((((0.0, 0.1)), "scene_margin"), ((0.1, -1.0), "own_margin")):
        with pytest.raises(ParameterError, match=name):
            clearance_costs(kernel, bad, *arguments)
    with pytest.raises(ParameterError, match="times"):
        clearance_costs(kernel, bad, 0.1, 0.1, [0.0])


@pytest.mark.parametrize("level", OPEN)
@pytest.mark.parametrize("name", NAMES)
def test_open_scenes_are_solved_and_pass_an_independent_checker(name: str, level: str, robot: Robot) -> None:
    problem = problems.load(level)
    result = plan(problem, name, timeout=20.0)
    check(result, problem, robot)
    assert result.solved_by == name and result.planner == name and result.length < 12.0
    again = plan(problem, name, timeout=20.0, seed=5)
    assert np.array_equal(result.path, again.path), "nothing is random"


def planner_of(setup: PlanningSetup, name: str, **values: float) -> GaussianProcessPlanner:
    planner = planners.make(name, setup.simple_setup.getSpaceInformation(), **values)
    setup.simple_setup.setPlanner(planner)
    setup.simple_setup.setup()
    return planner


@pytest.mark.parametrize("name", NAMES)
def test_steps_lower_the_cost_and_the_report_tells(name: str, robot: Robot) -> None:
    setup = assemble(problems.load("shelf/easy/800001"), robot)
    planner = planner_of(setup, name)
    status = setup.simple_setup.solve(ob.timedPlannerTerminationCondition(20.0))
    exact = status.getStatus() == ob.PlannerStatus.EXACT_SOLUTION
    report = planner.report
    assert all(one.evaluation.cost < 0.5 * one.first_cost and one.iterations > 3 for one in planner.optima)
    assert report.steps == sum(one.evaluations for one in planner.optima) and report.candidates == len(planner.optima)
    assert exact == (report.solved_by == name) == bool(report.lengths) == (not report.reason)
    assert exact == bool(np.isfinite(report.first)) and report.first_verified == exact
    if exact:
        assert report.best_path.length == pytest.approx(setup.simple_setup.getSolutionPath().length(), rel=1e-6)


@pytest.mark.parametrize("name", NAMES)
def test_a_failure_says_what_is_in_the_way_and_how_deep(name: str) -> None:
    result = plan(HOPELESS, name, timeout=20.0)
    assert result.status is PlanStatus.TIMEOUT and result.path is None
    for word in (name, " <-> ", "mm deep", "% of the motion", "steps"):
        assert word in result.reason
    assert "converged" in result.reason and result.times["solve"] < 15.0, "it ends when nothing is left to begin from"


@pytest.mark.parametrize("name", NAMES)
def test_the_termination_condition_is_honored_inside_iterations(name: str, robot: Robot) -> None:
    setup = assemble(problems.load(HOPELESS), robot)
    planner = planner_of(setup, name)
    for most in (0, 1, 6):
        setup.simple_setup.clear()
        asked = itertools.count()
        condition = ob.PlannerTerminationCondition(lambda asked=asked, most=most: next(asked) >= most)
        assert setup.simple_setup.solve(condition).getStatus() == ob.PlannerStatus.TIMEOUT
        assert sum(one.iterations for one in planner.optima) <= max(most, 1) and planner.report.reason


def test_several_goals_are_tried_in_turn(problem: Problem, robot: Robot) -> None:
    """With a sigma that lets obstacles count for nothing the nearer goal, behind the post, is not reached."""
    far = dict(problem.start, right_joint1=problem.start["right_joint1"] - 1.5, right_joint6=1.0)
    for goals in ((*problem.goal.joints, far), (far, *problem.goal.joints)):
        setup = assemble(problem.model_copy(update={"goal": Goal(joints=goals)}), robot)
        planner = planner_of(setup, "gpmp2", obstacle_sigma=10.0)
        status = setup.simple_setup.solve(ob.timedPlannerTerminationCondition(20.0))
        assert status.getStatus() == ob.PlannerStatus.EXACT_SOLUTION and planner.report.candidates == 2
        ends = [one.supports[-1, 0] for one in planner.optima]
        assert np.linalg.norm(ends[0] - setup.start) < np.linalg.norm(ends[1] - setup.start)
        names = robot.joint_names
        assert planner.report.best_path.states[-1, names.index("right_joint1")] == far["right_joint1"]


def test_restarts_are_drawn_by_the_seed() -> None:
    found = [plan(HOPELESS, "gpmp2", timeout=30.0, seed=1, params={"restarts": 2, "seed": 3}) for _ in range(2)]
    assert found[0].reason == found[1].reason
    setup = assemble(problems.load(HOPELESS))
    planner = planner_of(setup, "gpmp2", restarts=2, seed=3, iterations=5)
    setup.simple_setup.solve(ob.timedPlannerTerminationCondition(30.0))
    first = [one.supports.copy() for one in planner.optima]
    setup.simple_setup.clear()
    setup.simple_setup.solve(ob.timedPlannerTerminationCondition(30.0))
    assert len(first) == 3 * len(setup.valid_goals[:8])
    assert all(np.array_equal(a, b.supports) for a, b in zip(first, planner.optima, strict=True))
    assert len({float(one[3, 0, 0]) for one in first}) == len(first)


def test_joints_that_are_not_planned_stay() -> None:
    with MotionPlanner() as planner:
        home = planner.robot.home
        planner.world.add(name="post", box=(0.1, 0.1, 0.6), position=(0.45, 0.0, 0.3))
        start, goal = home.copy(), home.copy()
        start[[0, 1, 3]], goal[[0, 1, 3]] = (0.1, 0.4, -1.6), (-1.3, 0.4, -1.6)
        result = planner.plan(start, goal, planner="gpmp2", group="left_arm", timeout=20.0)
        others = [k for k, name in enumerate(planner.robot.joint_names) if not name.startswith("left_joint")]
        assert np.array_equal(result.path.states[:, others], np.tile(start[others], (len(result.path), 1)))
        assert result and result.solved_by == "gpmp2"


@pytest.mark.parametrize(
    ("values", "error", "words"),
    [
        ({"intervals": 1}, ParameterError, ["'intervals'", "[2, 200]"]),
        ({"safety_distance": 0.0}, ParameterError, ["'safety_distance'"]),
        ({"obstacle_sigma": "narrow"}, ParameterError, ["'obstacle_sigma'", "a number"]),
        ({"epsilon": 0.1}, UnknownNameError, ["parameter 'epsilon'"]),
        ({}, ParameterError, ["state validity checker", "StateValidityChecker"]),
    ],
)
@pytest.mark.parametrize("name", NAMES)
def test_faults_name_the_thing(name: str, values: dict, error: type[Exception], words: list[str]) -> None:
    space = ob.RealVectorStateSpace(2)
    with pytest.raises(error) as caught:
        planners.make(name, ob.SpaceInformation(space), **values)
    for word in words:
        assert word in str(caught.value)


@pytest.mark.parametrize("kind", [IncrementalGPMP, IncrementalGPMP2])
def test_the_replanner_begins_as_the_robot_moves(kind: type[IncrementalGPMP2]) -> None:
    """From the middle of a motion: with its velocity and acceleration, proved, and charged by counts."""
    context = context_of(PROBLEM)
    replanner = kind()
    replanner.prepare(context)
    dynamic = DynamicObstacles([Obstacle(name="far", box=(0.1,) * 3, position=(2.0, 2.0, 1.0))])
    standing = Following.resting(context.setup.start, 0.0, context.names)

    def ask(following: Following, route: Following | None, join: float) -> tuple[Following, ComputeBudget]:
        budget = ComputeBudget(0.2)
        request = Request(1, join - 0.05, join, following, route, dynamic, 0.0, (), np.inf, 0)
        found = replanner.replan(context, request, budget).found
        assert found is not None and found.to_goal and context.clear_of_static(found.motion)
        return found, budget

    first, budget = ask(standing, None, 0.05)
    assert budget.spent > 0.0 and budget.counts["state of a factor graph"] % 40 == 0
    join = 0.05 + 0.4 * first.motion.duration
    second, _ = ask(first, first, join)
    behind = first.at(join)
    assert np.abs(behind.velocity).max() > 0.05
    for order in range(3):
        np.testing.assert_allclose(second.motion(0.0, order), behind[order], atol=1e-9)
    assert second.motion.duration < first.motion.duration
    assert replanner.replan(
        context, Request(1, 0.0, 0.05, standing, None, dynamic, 0.0, (), np.inf, 0), ComputeBudget(0.0)
    )


@pytest.mark.parametrize("name", ["gpmp", "gpmp2"])
def test_the_loop_reaches_its_goal_with_it(name: str) -> None:
    done, report = go(named(name).make(), timeout=6.0, **named(name).settings)
    assert done.reached and report.contact is None and max(report.limit_use.values()) <= 1.0 + 1e-9
    assert setup_of(PROBLEM).valid_goals.shape[1] == done.trajectory.dof
    moving = "vertical/moving-medium-0.1/800000"
    first = run(moving, name)
    assert {event.data["part"] for event in first.events if event.kind == "accepted"} <= {"line", "route"}
    assert run(moving, name).events == first.events
