"""OMPL's own planners, and APEX, in a projected state space over constraints along the path."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from ompl import base as ob
from ompl import geometric as og
from planning import EXACT, states, within

import apex_ompl
from apex_ompl import PlanResult, PlanStatus, planners
from apex_ompl.collision import CollisionChecker
from apex_ompl.constraints.constraint_set import ConstraintSet
from apex_ompl.errors import ConstraintError, ParameterError
from apex_ompl.ompl.constrained_space import ManifoldConstraint, constraint_of, projected_space
from apex_ompl.ompl.setup import PlanningSetup, assemble
from apex_ompl.ompl.simple_setup import SimpleSetup
from apex_ompl.ompl.space import bounds_of, motions_free, new_state, set_values, state_space, to_array, to_state
from apex_ompl.ompl.validity import ConstrainedMotionCheck, StateValidityChecker
from apex_ompl.planners import APEX
from apex_ompl.robot import Robot
from apex_ompl.scene import Obstacle, RelativePose, Upright
from apex_ompl.scene.problem import Goal, Problem

pytestmark = pytest.mark.usefixtures("quiet")

CHAIN = RelativePose(first="left_hand", second="right_hand")
TILT = 0.1
PALM = "left_hand_palm"


def placed(robot: Robot, q: np.ndarray, link: str) -> pin.SE3:
    """The pose of a link, by Pinocchio."""
    data = robot.model.createData()
    pin.framesForwardKinematics(robot.model, data, robot.to_pinocchio(q))
    return data.oMf[robot.model.getFrameId(link, pin.FrameType.BODY)]


def upright(robot: Robot) -> Upright:
    """The palm keeps the direction that is up at home."""
    up = placed(robot, robot.home, PALM).rotation[2]
    return Upright(frame=PALM, axis=tuple(up.tolist()), angle=TILT)


def problem_of(robot: Robot, constraint: Any, scene: Sequence[Obstacle] = (), seed: int = 0) -> Problem:
    """From home to a free state on the constraint, about a radian away."""
    rng, checker = np.random.default_rng(seed), CollisionChecker(robot, scene)
    constraints = ConstraintSet.of(robot, [constraint], (), robot.home)
    for _ in range(100):
        far = robot.home.copy()
        far[:14] += 0.4 * rng.normal(size=14)
        found = constraints.project(far)
        if found.ok[0] and np.linalg.norm(found.states[0] - robot.home) > 0.8 and checker.is_free(found.states[0]):
            start, goal = (dict(zip(robot.joint_names, q.tolist(), strict=True)) for q in (robot.home, found.states[0]))
            return Problem(
                name="constrained", robot=robot.name, scene=tuple(scene), start=start, goal=Goal(joints=(goal,)),
                constraints=(constraint,),
            )  # fmt: skip
    raise AssertionError


@pytest.fixture(scope="module")
def chain(robot: Robot) -> Problem:
    return problem_of(robot, CHAIN)


@pytest.fixture(scope="module")
def cup(robot: Robot) -> Problem:
    post = Obstacle(name="post", box=(0.06, 0.06, 0.5), position=(0.5, 0.0, 0.25))
    return problem_of(robot, upright(robot), [post], seed=1)


@pytest.fixture(scope="module")
def chained(chain: Problem) -> PlanningSetup:
    return assemble(chain)


def dense(path: np.ndarray, spacing: float = 0.004) -> np.ndarray:
    pieces = [path[:1]]
    for a, b in zip(path, path[1:], strict=False):
        count = max(1, int(np.ceil(np.abs(b - a).max() / spacing)))
        pieces.append(a + np.arange(1, count + 1)[:, None] / count * (b - a))
    return np.concatenate(pieces)


def drift(robot: Robot, path: np.ndarray) -> tuple[float, float]:
    """How far the right palm leaves its pose in the left one along a path [m, rad]."""
    first: list[pin.SE3] = []
    for q in path:
        left, right = placed(robot, q, PALM), placed(robot, q, "right_hand_palm")
        first.append(left.actInv(right))
    apart = [first[0].actInv(one) for one in first]
    # the hands' points are what is held; rotated by at most an angle, they are within their distance from the palm
    return (
        max(float(np.linalg.norm(one.translation)) for one in apart),
        max(float(np.linalg.norm(pin.log3(one.rotation))) for one in apart),
    )


def tilt(robot: Robot, path: np.ndarray) -> float:
    """Largest angle between the palm's axis that is up at home and the vertical [rad]."""
    axis = placed(robot, robot.home, PALM).rotation[2]
    return max(float(np.arccos(np.clip((placed(robot, q, PALM).rotation @ axis)[2], -1.0, 1.0))) for q in path)


def test_rows_vanish_in_dead_zones_and_have_the_jacobian_of_finite_differences(robot: Robot) -> None:
    both = ConstraintSet.of(robot, [CHAIN, upright(robot)], (), robot.home)
    constraint, rng = ManifoldConstraint(both), np.random.default_rng(3)
    assert (constraint.getAmbientDimension(), constraint.getCoDimension()) == (16, 7)
    value = np.empty(7)
    constraint.function(robot.home, value)
    assert np.abs(value).max() < 1e-9
    for q in robot.home + 0.2 * rng.normal(size=(4, 16)):
        slope, numeric = np.empty((7, 16)), np.zeros((7, 16))
        constraint.jacobian(q, slope)
        for k in range(14):
            ends = np.empty((2, 7))
            for end, sign in zip(ends, (1.0, -1.0), strict=True):
                constraint.function(q + sign * 1e-6 * np.eye(16)[k], end)
            numeric[:, k] = (ends[0] - ends[1]) / 2e-6
        assert np.abs(slope - numeric).max() < 1e-5
        constraint.function(q, value)
        assert value[6] == pytest.approx(max(0.0, tilt(robot, q[None]) - 0.8 * TILT), abs=1e-7)


def test_samples_and_interpolation_are_on_the_manifold(robot: Robot, chained: PlanningSetup) -> None:
    si = chained.simple_setup.getSpaceInformation()
    space = si.getStateSpace()
    assert isinstance(space, ob.ProjectedStateSpace) and constraint_of(space) is si.constraint
    sampler, state, kept = space.allocStateSampler(), new_state(si), 0
    for _ in range(20):
        sampler.sampleUniform(state)
        q = to_array(state, 16)
        if chained.constraints.is_satisfied(q):
            far, angle = drift(robot, np.stack([robot.home, q]))
            assert far < 3e-3 and angle <= 0.01
            kept += 1
        assert np.abs(q[14:] - robot.home[14:]).max() < 1e-8, "the hands stay as they are at both ends"
    assert kept >= 5
    space.interpolate(to_state(si, chained.start), to_state(si, chained.goals[0]), 0.5, state)
    assert si.constraint.isSatisfied(state) and si.constraint.isSatisfied(to_array(state, 16))


def test_states_are_written_and_read(chained: PlanningSetup) -> None:
    si = chained.simple_setup.getSpaceInformation()
    state = to_state(si, chained.start)
    assert np.array_equal(to_array(state, 16), chained.start)
    set_values(state, chained.goals[0])
    assert np.array_equal(to_array(state, 16), chained.goals[0])
    low, high = bounds_of(si, chained.robot)
    assert (low[:14] == chained.robot.limits.lower[:14]).all() and (high[14:] - low[14:] < 1e-8).all()
    start, goal = chained.start[None], chained.goals[:1]
    check = ConstrainedMotionCheck(chained.checker, chained.constraints)
    assert motions_free(si, start, goal)[0] == check(start[0], goal[0])


def test_a_motion_follows_the_projection_of_the_straight_line(robot: Robot, chained: PlanningSetup) -> None:
    check = ConstrainedMotionCheck(chained.checker, chained.constraints)
    near = chained.constraints.project(chained.start + 0.1 * (chained.goals[0] - chained.start)).states[0]
    found = check.states(chained.start, near)
    assert found is not None and np.array_equal(found[[0, -1]], [chained.start, near])
    assert np.abs(np.diff(found, axis=0)).max() <= 2.0 * check.resolution
    assert drift(robot, found)[1] < 1e-6
    off = near + np.eye(16)[0]
    assert not check(chained.start, off), "the way there jumps"
    assert check(chained.start, near) and not check(near, near), "where OMPL's interpolation fails"


NAMES = ["rrtconnect", "rrtconnect+polish", "rrt", "prm", "bitstar", "lbkpiece1"]


def solved(problem: Problem, planner: Any, **options: Any) -> PlanResult:
    return apex_ompl.plan(problem, planner, timing=False, timeout=20.0, **options)


@pytest.mark.parametrize("name", NAMES)
def test_planners_by_name_keep_a_closed_chain(robot: Robot, chain: Problem, name: str) -> None:
    result = solved(chain, name, params={"stop_on_soln_improvement": True} if name == "bitstar" else None)
    assert result.status is PlanStatus.EXACT_SOLUTION, result.reason
    assert np.array_equal(result.path.states[0], robot.home) and result.constraint_bound
    far, angle = drift(robot, dense(result.path.states))
    assert far < 3e-3 and angle <= 0.01


@pytest.mark.parametrize("name", ["rrtconnect", "rrtconnect+polish"])
def test_planners_by_name_keep_a_cup_upright(robot: Robot, cup: Problem, name: str) -> None:
    result = solved(cup, name)
    assert result.status is PlanStatus.EXACT_SOLUTION, result.reason
    assert tilt(robot, dense(result.path.states)) <= TILT


def test_the_same_seed_gives_the_same_path(chain: Problem) -> None:
    first, again, other = (solved(chain, "rrtconnect", seed=seed, simplify=False).path.states for seed in (3, 3, 4))
    assert np.array_equal(first, again) and not np.array_equal(first, other)


@pytest.mark.parametrize("name", ["gpmp", "gpmp2", "damon", "drrt", "aorrtc", "il"])
def test_planners_that_know_no_constraints_are_refused(chain: Problem, chained: PlanningSetup, name: str) -> None:
    with pytest.raises(ParameterError, match=f"planner: expected one that plans under constraints.*'{name}'"):
        apex_ompl.plan(chain, name)
    with pytest.raises(ParameterError, match="constraints along the path"):
        planners.make(name, chained.simple_setup.getSpaceInformation())


class Failing:
    """A constraint of a user's own that raises away from the start."""

    name, tolerance = "failing", 1e-3

    def __init__(self, start: np.ndarray) -> None:
        self.start = start

    def residual(self, q: np.ndarray) -> np.ndarray:
        if np.abs(q - self.start).max() > 0.05 and np.abs(q[0] - self.start[0] - 0.4) > 1e-9:
            raise ValueError("no such state")
        return np.zeros(1)

    def jacobian(self, q: np.ndarray) -> np.ndarray:
        return np.zeros((1, len(q)))

    def bound(self, q: np.ndarray, step: np.ndarray) -> float:
        return float("inf")


@pytest.mark.parametrize("name", ["rrtconnect", "prm"])
def test_an_exception_of_a_users_constraint_is_the_reason(robot: Robot, chain: Problem, name: str) -> None:
    goal = robot.home.copy()
    goal[0] += 0.4
    joints = dict(zip(robot.joint_names, goal.tolist(), strict=True))
    problem = chain.model_copy(update={"goal": Goal(joints=(joints,)), "constraints": ()})
    result = solved(problem, name, constraints=[Failing(robot.home)])
    assert result.status is PlanStatus.CRASH and result.reason == f"{name} failed, ValueError('no such state')"


def test_more_rows_than_joints_are_refused(robot: Robot) -> None:
    class Many(Failing):
        name = "many"

        def residual(self, q: np.ndarray) -> np.ndarray:
            return np.zeros(16)

        def jacobian(self, q: np.ndarray) -> np.ndarray:
            return np.zeros((16, 16))

    with pytest.raises(ConstraintError, match="many: 16 rows, expected fewer than 16 joints"):
        projected_space(state_space(robot), ConstraintSet.of(robot, [Many(robot.home)], (), robot.home))


def test_a_users_setup_runs_planners_of_both_kinds(robot: Robot, chain: Problem) -> None:
    with apex_ompl.MotionPlanner(robot) as planner:
        goal = chain.goal.joints[0]
        setup = planner.simple_setup(chain.start, goal, constraints=[CHAIN])
    si = setup.getSpaceInformation()
    for one in (og.RRTConnect(si), APEX(si, seed=0)):
        setup.clear()
        if isinstance(one, og.RRTConnect):
            one.setRange(0.5)
        setup.setPlanner(one)
        assert setup.solve(within(20.0)).getStatus() == EXACT
        found = states(setup)
        assert drift(robot, found)[1] <= 0.01
    assert drift(robot, dense(found))[1] <= 0.01, "apex gives states between which straight lines keep it"


def own_setup(robot: Robot, problem: Problem, kind: type, checker: bool) -> tuple[og.SimpleSetup, ConstraintSet]:
    """A setup as a user writes it, with OMPL's classes."""
    constraints = ConstraintSet.of(robot, [CHAIN], (), robot.home)
    space = kind(state_space(robot), ManifoldConstraint(constraints))
    bundle = kind is ob.TangentBundleStateSpace
    si = (ob.TangentBundleSpaceInformation if bundle else ob.ConstrainedSpaceInformation)(space)
    setup = og.SimpleSetup(si)
    free = CollisionChecker(robot)
    if checker:
        setup.setStateValidityChecker(StateValidityChecker(si, free))
    else:
        setup.setStateValidityChecker(lambda state: bool(free.is_free(to_array(state, 16))))
    ends = robot.home, problem.goal_states(robot.joint_names)[0]
    setup.setStartAndGoalStates(*(to_state(si, q) for q in ends))
    return setup, constraints


@pytest.mark.parametrize("checker", [True, False])
@pytest.mark.parametrize("kind", [ob.ProjectedStateSpace, ob.AtlasStateSpace, ob.TangentBundleStateSpace])
def test_apex_in_a_space_of_a_users_own(robot: Robot, chain: Problem, kind: type, checker: bool) -> None:
    setup, _ = own_setup(robot, chain, kind, checker)
    planner = APEX(setup.getSpaceInformation(), seed=0)
    setup.setPlanner(planner)
    assert setup.solve(within(20.0)).getStatus() == EXACT, planner.report.reason
    assert drift(robot, dense(states(setup)))[1] <= 0.01


def test_another_checker_decides_at_states_on_the_manifold(robot: Robot, chain: Problem) -> None:
    ready = assemble(chain)
    seen: list[np.ndarray] = []
    ready.simple_setup.setStateValidityChecker(lambda state: seen.append(to_array(state, 16)) or True)
    si = ready.simple_setup.getSpaceInformation()
    near = ready.constraints.project(ready.start + 0.3 * (ready.goals[0] - ready.start)).states[0]
    assert motions_free(si, ready.start[None], near[None]).all()
    assert len(seen) >= 3 and ready.constraints.violations(np.array(seen)).max() < 1e-3


def test_constraints_of_ompl_alone_are_refused(robot: Robot) -> None:
    class Opposed(ob.Constraint):
        def function(self, x: np.ndarray, out: np.ndarray) -> None:
            out[0] = x[0] - x[7]

    si = ob.ConstrainedSpaceInformation(ob.ProjectedStateSpace(state_space(robot), Opposed(16, 1)))
    si.setStateValidityChecker(StateValidityChecker(si, CollisionChecker(robot)))
    with pytest.raises(ParameterError, match="constraint of the state space: expected .*ManifoldConstraint"):
        APEX(si)


def test_a_setup_without_constraints_has_vectors(robot: Robot) -> None:
    assert constraint_of(SimpleSetup(robot).getStateSpace()) is None
