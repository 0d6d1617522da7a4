from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from apex_ompl import PlanStatus, load_problem, plan
from apex_ompl.collision import CollisionChecker
from apex_ompl.constraints.links import Links, in_world
from apex_ompl.errors import ParameterError
from apex_ompl.goals.alignment import alignment_goal
from apex_ompl.goals.goal_sampling import sample
from apex_ompl.goals.pose_goal import PoseGoal
from apex_ompl.kernel import IKSolver, offset_target, opposition_target
from apex_ompl.ompl.setup import assemble
from apex_ompl.robot import Robot
from apex_ompl.robot.rest_to_rest import direct_durations
from apex_ompl.scene.constraints import PoseTolerance
from apex_ompl.scene.problem import Goal, PoseTarget, Problem
from apex_ompl.timing.duration import DurationOptimizer

ALIGNED = ("ball_in_cup", "peg_in_hole", "pour", "handover", "stack_boxes")


def checker_of(robot: Robot, problem: Problem) -> CollisionChecker:
    return CollisionChecker(robot, problem.scene, problem.attached, problem.allowed)


@pytest.mark.parametrize("name", ALIGNED)
def test_the_nearest_state_is_nearer_than_those_of_random_descents(name: str, robot: Robot) -> None:
    """Than the nearest free one of 200 descents from around home, by brute force."""
    problem = load_problem(name)
    goal, checker = alignment_goal(robot, problem), checker_of(robot, problem)
    assert goal is not None
    rng, hands = np.random.default_rng(1), robot.groups["hands"]
    first = robot.home + rng.normal(0.0, 0.6, (200, robot.dof))
    first[:, hands] = goal.start[hands]
    ends = goal.inverse.descend(first.clip(robot.limits.lower, robot.limits.upper)).states
    reached = [q for q in ends if goal.is_satisfied(q) and checker.is_free(q)]
    nearest = direct_durations(goal.start, np.array(reached), robot.limits).min()
    for seed in range(3):
        found = sample(goal, checker, np.random.default_rng(seed))
        assert direct_durations(goal.start, found.states, robot.limits).min() < nearest


def test_states_are_apart_free_and_the_same_for_a_seed(robot: Robot) -> None:
    problem = load_problem("ball_in_cup")
    goal, checker = alignment_goal(robot, problem), checker_of(robot, problem)
    assert goal is not None
    first, again = (sample(goal, checker, np.random.default_rng(5)) for _ in range(2))
    assert np.array_equal(first.states, again.states) and first.fault == ""
    for k, q in enumerate(first.states):
        assert goal.is_satisfied(q) and checker.is_free(q) and robot.limit_fault(q) is None
        assert all(np.abs(q - other).max() >= 0.1 for other in first.states[:k])
    for count in (1, 2, 3):
        assert len(sample(goal, checker, np.random.default_rng(0), count=count).states) == count


def pose_target(robot: Robot, q: np.ndarray, hand: str, **tolerance: float) -> PoseTarget:
    pose = robot.link_pose(q, robot.hands[hand].palm)
    return PoseTarget(
        frame=hand, position=tuple(pose[:3, :3] @ np.asarray(robot.hands[hand].point) + pose[:3, 3]),
        orientation=tuple(Rotation.from_matrix(pose[:3, :3]).as_quat()), tolerance=PoseTolerance(**tolerance),
    )  # fmt: skip


@settings(max_examples=8)
@given(st.integers(0, 1000), st.sampled_from([1e-4, 1e-3, 0.05]))
def test_states_reach_poses_by_pinocchio_and_leave_the_other_arm_alone(
    robot: Robot, seed: int, tolerance: float
) -> None:
    rng = np.random.default_rng(seed)
    q = (robot.home + rng.normal(0.0, 0.3, robot.dof)).clip(robot.limits.lower, robot.limits.upper)
    target = pose_target(robot, q, "left_hand", position=tolerance, angle=tolerance)
    goal = PoseGoal(robot, [target], (), robot.home)
    found = sample(goal, CollisionChecker(robot), rng, max_attempts=64)
    data, palm, hand = robot.model.createData(), robot.hands["left_hand"].palm, robot.hands["left_hand"]
    right = [k for k, name in enumerate(robot.joint_names) if name.startswith("right_")]
    for state in found.states:
        pin.framesForwardKinematics(robot.model, data, robot.to_pinocchio(state))
        pose = data.oMf[robot.model.getFrameId(palm)]
        assert np.linalg.norm(pose.act(np.asarray(hand.point)) - target.position) <= tolerance
        turned = Rotation.from_quat(target.orientation).inv() * Rotation.from_matrix(pose.rotation)
        assert turned.magnitude() <= tolerance
        assert np.array_equal(state[right], robot.home[right])


@pytest.mark.parametrize("seed", range(4))
def test_poses_of_two_hands_are_as_near_as_the_farther_of_them_alone(robot: Robot, seed: int) -> None:
    rng = np.random.default_rng([seed, 3])
    q = (robot.home + rng.normal(0.0, 0.4, robot.dof)).clip(robot.limits.lower, robot.limits.upper)
    targets = [pose_target(robot, q, hand) for hand in ("left_hand", "right_hand")]
    checker, nearest = CollisionChecker(robot), list[float]()
    for some in ([targets[0]], [targets[1]], targets):
        found = sample(PoseGoal(robot, some, (), robot.home), checker, np.random.default_rng(seed))
        nearest.append(float(direct_durations(robot.home, found.states, robot.limits).min()))
    assert nearest[2] <= 1.03 * max(nearest[:2])


def test_descents_of_which_the_last_arrive_nowhere(robot: Robot) -> None:
    """The 33rd descends from the start alone, and ends elsewhere."""
    rng, tried = np.random.default_rng(4), 0
    for _ in range(40):
        q = robot.random_state(rng)
        goal = PoseGoal(robot, [pose_target(robot, q, "left_hand")], (), robot.home)
        if goal.inverse.descend(robot.home, tolerance=1e-6, max_steps=40).errors[0] < 1e-2:
            continue
        found = sample(goal, CollisionChecker(robot), np.random.default_rng(0), max_attempts=33)
        assert found.attempts == 33
        tried += len(found.states) > 0
    assert tried > 2


def test_a_start_that_reaches_the_goal_is_returned_first(robot: Robot) -> None:
    goal = PoseGoal(robot, [pose_target(robot, robot.home, "right_hand")], (), robot.home)
    found = sample(goal, CollisionChecker(robot), np.random.default_rng(0))
    np.testing.assert_allclose(found.states[0], robot.home, atol=1e-6)


def test_a_pose_out_of_reach_keeps_its_reason(robot: Robot) -> None:
    problem = load_problem("ball_in_cup")
    goal = Goal(poses=(PoseTarget(frame="left_hand", position=(3.0, 0.0, 0.5)),))
    result = plan(problem.model_copy(update={"goal": goal}))
    assert result.status is PlanStatus.INVALID_GOAL
    assert result.reason.startswith("left_hand is out of reach: left_hand has to be ")


def test_what_is_not_shown_to_be_out_of_reach_is_not_said_to_be(robot: Robot) -> None:
    pose = pose_target(robot, robot.home, "left_hand")
    near = (robot.link_pose(robot.home, "left_link1")[:3, 3] + [0.02, 0.0, 0.0]).tolist()  # inside of the arm
    goal = PoseGoal(robot, [pose.model_copy(update={"position": tuple(near)})], (), robot.home)
    found = sample(goal, CollisionChecker(robot), np.random.default_rng(0))
    assert not len(found.states) and found.fault.startswith("none found in 200 descents")
    assert "out of reach" not in found.fault and not goal.out_of_reach()


def test_held_joints_stay(robot: Robot) -> None:
    problem = load_problem("ball_in_cup")
    moving = [name for name in robot.joint_names if name != "left_joint3"]
    ready = assemble(problem, robot, moving=moving)
    held = robot.joint_names.index("left_joint3")
    assert len(ready.valid_goals) and (ready.valid_goals[:, held] == ready.start[held]).all()


def inverse_of(robot: Robot, q: np.ndarray) -> IKSolver:
    links = Links.of(robot)
    pose = robot.link_pose(q, "left_hand_palm")
    targets = [
        offset_target(in_world(pose[:3, 3]), links.point("left_hand_palm", (0.0, 0.0, 0.0))),
        opposition_target(links.direction("left_hand_palm", (0.0, 0.0, 1.0)), in_world(pose[:3, 2]), -1.0),
    ]
    return links.inverse(targets, robot.groups["hands"])


@pytest.mark.parametrize("seed", range(4))
def test_an_approach_agrees_with_a_general_optimizer(robot: Robot, seed: int) -> None:
    """The largest distance is at most 5 % above that of scipy's SLSQP, from the same state, with the same targets."""
    rng = np.random.default_rng(seed)
    start = robot.home
    q = (start + rng.normal(0.0, 0.4, robot.dof)).clip(robot.limits.lower, robot.limits.upper)
    inverse, reach = inverse_of(robot, q), robot.limits.velocity * rng.uniform(0.5, 1.5, robot.dof)
    state, free = q, inverse.free
    for power in (2, 4, 8, 16, 32):
        ends = inverse.approach(state, start, reach, power, weight=1e3 * power, max_steps=100)
        state = inverse.descend(ends.states, tolerance=1e-8).states[0]
    assert np.linalg.norm(inverse.residual(state)[0]) < 1e-6 and robot.limit_fault(state) is None
    assert np.array_equal(np.delete(state, free), np.delete(q, free))

    def full(x: np.ndarray) -> np.ndarray:
        whole = q.copy()
        whole[free] = x[:-1]
        return whole

    unit = (reach[free], start[free])
    best = minimize(
        lambda x: x[-1], np.append(q[free], np.abs((q[free] - unit[1]) / unit[0]).max()), method="SLSQP",
        bounds=[*zip(robot.limits.lower[free], robot.limits.upper[free], strict=True), (0.0, None)],
        constraints=[
            {"type": "eq", "fun": lambda x: inverse.residual(full(x))[0][:5]},  # five are independent
            {"type": "ineq", "fun": lambda x: x[-1] - (x[:-1] - unit[1]) / unit[0]},
            {"type": "ineq", "fun": lambda x: x[-1] + (x[:-1] - unit[1]) / unit[0]},
        ], options={"maxiter": 300},
    )  # fmt: skip
    largest = np.abs((state - start)[free] / reach[free]).max()
    assert largest <= 1.05 * best.x[-1] or not best.success
    assert largest <= np.abs((q - start)[free] / reach[free]).max()


def test_faulty_approaches_are_named(robot: Robot) -> None:
    inverse, reach = inverse_of(robot, robot.home), np.ones(robot.dof)
    for name, arguments in {
        "states": (np.zeros(3), robot.home, reach, 2),
        "start": (robot.home, np.zeros(3), reach, 2),
        "reach": (robot.home, robot.home, 0.0 * reach, 2),
        "power": (robot.home, robot.home, reach, 3),
    }.items():
        with pytest.raises(ParameterError, match=name):
            inverse.approach(*arguments)


def test_a_motion_that_does_not_undercut_a_duration_is_left(robot: Robot, checker: CollisionChecker) -> None:
    goal = robot.home.copy()
    goal[3] += 0.8
    optimizer = DurationOptimizer(checker.kernel, robot.limits)
    line = np.stack([robot.home, goal])
    fastest, undercut = optimizer.fastest(line), optimizer.fastest(line, most=10.0)
    assert fastest is not None and undercut is not None
    assert fastest.duration == undercut.duration and np.array_equal(fastest.control, undercut.control)
    assert optimizer.fastest(line, most=0.8 * fastest.duration) is None


def test_straight_lines_to_goals_are_tried_by_the_objective(robot: Robot, problem: Problem) -> None:
    """One goal is nearer in length, the other in time, since several joints share its distance."""
    start = problem.start_state(robot.joint_names)
    one, several = start.copy(), start.copy()
    one[3] += 0.6
    several[[3, 10]] += 0.5, 0.45
    joints = [dict(zip(robot.joint_names, goal.tolist(), strict=True)) for goal in (one, several)]
    both = problem.model_copy(update={"scene": (), "goal": Goal(joints=tuple(joints))})
    for objective, goal in (("length", one), ("time", several)):
        result = plan(both, objective=objective)
        np.testing.assert_allclose(result.path[-1], goal)
