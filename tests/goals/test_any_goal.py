"""Goals of which any will do, and poses with free turns, boxes and ranges of angles, against Pinocchio and SciPy."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from scipy.spatial.transform import Rotation
from small_arm import write_arm

from apex_ompl import (
    AnyOf,
    ApexError,
    MotionPlanner,
    PlanStatus,
    PoseTarget,
    Problem,
    Robot,
    load_robot,
    plan,
    plan_task,
)
from apex_ompl.collision import CollisionChecker
from apex_ompl.goals.any_goal import AnyGoal
from apex_ompl.goals.goal_sampling import sample
from apex_ompl.goals.pose_goal import PoseGoal, pose_goals
from apex_ompl.loop.referee import is_at_goal
from apex_ompl.ompl.setup import workspace_goal
from apex_ompl.planning.task_problem import with_lines
from apex_ompl.robot.rest_to_rest import direct_durations
from apex_ompl.scene import OnPlane
from apex_ompl.scene.constraints import PoseTolerance
from apex_ompl.scene.problem import Goal


def hand_pose(robot: Robot, q: np.ndarray, hand: str = "left_hand") -> pin.SE3:
    """The pose of a hand, by Pinocchio alone."""
    data, record = robot.model.createData(), robot.hands[hand]
    pin.framesForwardKinematics(robot.model, data, robot.to_pinocchio(q))
    return data.oMf[robot.model.getFrameId(record.palm)] * pin.SE3(np.eye(3), np.array(record.point))


def target(pose: pin.SE3, frame: str = "left_hand", **fields: Any) -> PoseTarget:
    xyzw = tuple(pin.Quaternion(pose.rotation).coeffs())
    return PoseTarget(frame=frame, position=tuple(pose.translation), orientation=xyzw, **fields)


def wanted_pose(pose: PoseTarget) -> pin.SE3:
    return pin.SE3(pin.Quaternion(np.array(pose.orientation)), np.array(pose.position))


def near_home(robot: Robot, seed: int, count: int, spread: float = 0.3) -> list[PoseTarget]:
    rng = np.random.default_rng(seed)
    states = robot.home + rng.normal(0.0, spread, (count, robot.dof))
    return [target(hand_pose(robot, q)) for q in states.clip(robot.limits.lower, robot.limits.upper)]


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_nearest_of_many_poses_is_about_as_near_as_the_best_of_them_alone(robot: Robot, seed: int) -> None:
    poses, checker = near_home(robot, seed, 12), CollisionChecker(robot)
    goals = [PoseGoal(robot, [pose], (), robot.home) for pose in poses]
    together = AnyGoal(robot, goals, np.empty((0, robot.dof)), robot.home)
    found = sample(together, checker, np.random.default_rng(0)).states
    assert 0 < len(found) <= 16 and checker.are_free(found).all()
    for q in found:  # each reaches one of the poses
        off = [pin.log6(wanted_pose(pose).actInv(hand_pose(robot, q))) for pose in poses]
        assert min(np.abs(one.vector).max() for one in off) < 1e-3
        assert together.errors(q) == {"goal": 0.0}
    assert together.errors(robot.home)["goal"] > 0.0
    alone = [sample(goal, checker, np.random.default_rng(0)).states for goal in goals]
    best = min(direct_durations(robot.home, one, robot.limits).min() for one in alone if len(one))
    assert direct_durations(robot.home, found, robot.limits).min() < 1.2 * best


def test_pairs_of_poses_of_two_arms_are_reached_by_descents_of_each(robot: Robot) -> None:
    rng = np.random.default_rng(7)
    states = (robot.home + rng.normal(0.0, 0.4, (12, robot.dof))).clip(robot.limits.lower, robot.limits.upper)
    hands = {name: [hand_pose(robot, q, name) for q in states] for name in ("left_hand", "right_hand")}
    pairs = [(a, b) for a in range(12) for b in range(12)]
    poses = [[target(hands[name][k], name) for name, k in zip(hands, pair, strict=True)] for pair in pairs]
    goal = AnyGoal(robot, [PoseGoal(robot, pair, (), robot.home) for pair in poses], np.empty((0, 16)), robot.home)
    checker = CollisionChecker(robot, proofs=False)
    found = goal._first(checker, np.random.default_rng(0))
    assert found.attempts <= 24 * 32  # and not some for each of the 144 pairs
    assert len({*found.members.tolist()}) > 72 and checker.are_free(found.states).all()
    for q, k in zip(found.states, found.members, strict=True):
        for name, number in zip(hands, pairs[k], strict=True):
            off = pin.log6(hands[name][number].actInv(hand_pose(robot, q, name)))
            assert np.abs(off.vector).max() < 1e-3
        assert np.array_equal(q[14:], robot.home[14:])
    assert goal.member_of(found.states[0]) == found.members[0]


def test_the_goal_that_a_state_reaches_is_found_among_poses_and_regions(robot: Robot) -> None:
    poses = near_home(robot, 5, 10, 0.1)
    boxes = [one.model_copy(update={"lower": (-0.03, 0.0, 0.0), "upper": (0.02, 0.01, 0.0)}) for one in poses[:4]]
    goals = [PoseGoal(robot, [pose], (), robot.home) for pose in (*poses[4:], *boxes, *poses)]
    goal, rng = AnyGoal(robot, goals, np.empty((0, robot.dof)), robot.home), np.random.default_rng(0)
    reached = set()
    for k, one in enumerate(goals * 3):
        offset = rng.uniform((-0.04, -0.01, 0.0), (0.03, 0.02, 0.0)) if k % 3 else np.zeros(3)
        at = wanted_pose(one.poses[0]) * pin.SE3(np.eye(3), offset)
        q = PoseGoal(robot, [target(at)], (), robot.home).inverse.descend(robot.home, tolerance=1e-9).states[0]
        inside = [n for n, g in enumerate(goals) if all(g.errors(q)[name] <= g.bounds[name] for name in g.bounds)]
        assert goal.member_of(q) == (inside or [-1])[0]
        reached.add(goal.member_of(q))
    assert -1 in reached and len(reached) > 6
    exact = goals[3].inverse.descend(robot.home, tolerance=1e-9).states[0]
    assert goal.nearest_members(exact)[0] is goals[3] and len(goal.nearest_members(exact)) == 3


def test_two_poses_of_one_arm_are_reached_together(robot: Robot) -> None:
    states = (robot.home + np.random.default_rng(3).normal(0.0, 0.2, (4, robot.dof))).clip(
        robot.limits.lower, robot.limits.upper
    )
    goals = []
    for q in states:
        at = robot.link_pose(q, "left_link4")[:3, 3]
        poses = [target(hand_pose(robot, q)), PoseTarget(frame="left_link4", position=tuple(at))]
        goals.append(PoseGoal(robot, poses, (), robot.home))
    found = AnyGoal(robot, goals, np.empty((0, 16)), robot.home)._first(
        CollisionChecker(robot), np.random.default_rng(0)
    )
    assert {*found.members.tolist()} == {0, 1, 2, 3}
    for q, k in zip(found.states, found.members, strict=True):
        for link in ("left_hand_palm", "left_link4"):
            wanted, reached = (robot.link_pose(one, link)[:3, 3] for one in (states[k], q))
            assert np.abs(wanted - reached).max() < 1e-3


def test_poses_and_joint_configurations_are_mixed(robot: Robot, tmp_path: Path) -> None:
    near, far = robot.home.copy(), robot.home.copy()
    near[0] += 0.5
    far[0] -= 1.3
    pose = near_home(robot, 5, 1, 0.5)[0]
    with MotionPlanner(robot) as planner:
        planner.world.add(name="ball", sphere={"radius": 0.02}, position=(0.5, 0.0, 1.2))
        result = planner.plan("home", AnyOf([far, pose, near]), timeout=20.0)
        assert result and np.array_equal(result.path.states[-1], near)
        problem = planner.problem("home", AnyOf([far, pose, near]))
        blocked = robot.link_pose(near, "left_hand_palm")[:3, 3]
        planner.world.move("ball", tuple(blocked))
        other = planner.plan("home", AnyOf([far, pose, near]), timeout=20.0, group="left_arm")
        assert other and not np.array_equal(other.path.states[-1], near)
        assert np.array_equal(other.path.states[-1][7:], robot.home[7:])
        refused = planner.plan("home", AnyOf([near]), timeout=20.0)
        assert refused.status is PlanStatus.INVALID_GOAL and "ball" in refused.reason
        outside = near.copy()
        outside[8] += 0.3
        refused = planner.plan("home", AnyOf([outside]), timeout=20.0, group="left_arm")
        assert refused.status is PlanStatus.INVALID_GOAL and "not planned" in refused.reason
    problem.save(tmp_path / "any.yaml")
    again = Problem.load(tmp_path / "any.yaml")
    assert again == problem and [*again.as_dict()["goal"]] == ["any_of"]
    assert is_at_goal(robot, again, near) and is_at_goal(robot, again, far) and not is_at_goal(robot, again, robot.home)
    read = plan(tmp_path / "any.yaml", timeout=20.0)
    assert read and np.array_equal(read.path.states[-1], near)


def test_constraints_hold_at_the_goal_that_is_chosen(robot: Robot) -> None:
    pose = hand_pose(robot, robot.home)
    up, aside = pose.copy(), pose.copy()
    up.translation[2] += 0.1
    aside.translation[0] += 0.05
    plane = OnPlane(frame="left_hand", normal=(1.0, 0.0, 0.0))
    with MotionPlanner(robot) as planner:
        result = planner.plan("home", AnyOf([target(aside), target(up)]), timeout=20.0, constraints=[plane])
    assert result and np.allclose(hand_pose(robot, result.path.states[-1]).translation, up.translation, atol=2e-3)


@pytest.mark.parametrize("axis", ["x", "y", "z"])
def test_a_frame_with_a_free_turn_is_turned_about_that_axis_alone(robot: Robot, axis: str) -> None:
    k, checker = "xyz".index(axis), CollisionChecker(robot)
    wanted = hand_pose(robot, robot.home + 0.1 * np.sin(np.arange(robot.dof)))
    goal = PoseGoal(robot, [target(wanted, free_turn=axis)], (), robot.home)
    found = sample(goal, checker, np.random.default_rng(0)).states
    turns = list[float]()
    for q in found:
        off = wanted.actInv(hand_pose(robot, q))
        vector = Rotation.from_matrix(off.rotation).as_rotvec()
        turns.append(vector[k])
        assert np.linalg.norm(off.translation) < 1e-3 and np.abs(np.delete(vector, k)).max() < 1e-2
    assert len(found) > 1 and np.ptp(turns) > 0.01


def test_a_box_and_a_range_of_angles_bound_the_pose_in_its_own_frame(robot: Robot) -> None:
    wanted = hand_pose(robot, robot.home + 0.1 * np.sin(np.arange(robot.dof)))
    region = target(
        wanted, lower=(-0.05, 0.0, -0.02), upper=(0.05, 0.0, 0.1), free_turn="z", turn=(-0.3, 0.2),
        tolerance=PoseTolerance(position=1e-3, angle=1e-2),
    )  # fmt: skip
    members = pose_goals(robot, [region], (), robot.home)
    goal = AnyGoal(robot, members, np.empty((0, robot.dof)), robot.home)
    found = sample(goal, CollisionChecker(robot), np.random.default_rng(0)).states
    low, high = np.array(region.lower) - 1e-3, np.array(region.upper) + 1e-3
    assert len(found) > 4
    for q in found:
        off = wanted.actInv(hand_pose(robot, q))
        assert (off.translation >= low).all() and (off.translation <= high).all()
        x, y, turn = Rotation.from_matrix(off.rotation).as_rotvec()
        assert abs(x) < 1e-2 and abs(y) < 1e-2 and -0.31 <= turn <= 0.21
    for by, turn, error in (((0.0, 0.0, 0.0), 0.1, 0.0), ((0.07, 0.0, 0.0), 0.0, 0.02), ((0.0, 0.0, 0.0), 0.5, 0.3)):
        moved = wanted * pin.SE3(pin.exp3(np.array([0.0, 0.0, turn])), np.array(by))
        q = PoseGoal(robot, [target(moved)], (), robot.home).nearest(robot.home)
        assert max(members[0].errors(q).values()) == pytest.approx(error, abs=1e-5)


def test_an_arm_of_few_joints_reaches_ranges_of_angles(tmp_path: Path) -> None:
    robot = load_robot(write_arm(tmp_path))
    q = np.array([0.7, 0.4, 0.6])
    at = robot.link_pose(q, "lower")
    by = pin.Quaternion(at[:3, :3] @ pin.exp3(np.array([0.0, 0.0, -0.2])))  # the wanted turn is 0.2
    wanted = PoseTarget(frame="lower", position=tuple(at[:3, 3]), orientation=tuple(by.coeffs()), free_turn="z")
    inside, outside = (wanted.model_copy(update={"turn": turn}) for turn in ((0.0, 0.3), (-0.3, 0.0)))
    with MotionPlanner(robot) as planner:
        found = planner.plan("home", inside, timeout=20.0)
        assert found and np.allclose(found.path.states[-1], q, atol=1e-4)
        assert np.allclose(planner.ik(inside).states, q, atol=1e-4) and len(planner.ik(inside)) == 1
        assert planner.plan("home", outside, timeout=20.0).status is PlanStatus.INVALID_GOAL
        assert not planner.ik(outside)


def test_a_region_near_the_start_needs_a_shorter_motion_than_its_middle(robot: Robot) -> None:
    away = hand_pose(robot, robot.home)
    away.translation[:] += (0.1, 0.0, -0.1)
    size = 0.09
    with MotionPlanner(robot) as planner:
        one = planner.plan("home", target(away), timeout=20.0)
        region = planner.plan("home", target(away, lower=(-size,) * 3, upper=(size,) * 3), timeout=20.0)
    assert one and region and region.trajectory.duration < one.trajectory.duration


@pytest.mark.parametrize(
    ("turn", "by", "error"),
    [
        ((3.0, np.pi), np.pi + 0.01, 0.01), ((3.0, np.pi), -np.pi, 0.0), ((-np.pi, -3.0), np.pi - 0.01, 0.01),
        ((2.6, 3.6), -2.9, 0.0), ((2.6, 3.6), -2.4, 2.0 * np.pi - 6.0), ((2.6, 3.6), 2.5, 0.1),
        ((-3.6, -2.6), 3.0, 0.0), ((5.0, 6.0), -1.0, 0.0), ((-np.pi, np.pi), 3.0, 0.0), ((0.0, 2.0 * np.pi), -1.0, 0.0),
        ((np.pi, np.pi), -np.pi + 0.002, 0.002), ((-0.2, 0.2), np.pi, np.pi - 0.2),
    ],
)  # fmt: skip
def test_ranges_of_angles_go_on_beyond_half_a_turn(
    robot: Robot, turn: tuple[float, float], by: float, error: float
) -> None:
    wanted = hand_pose(robot, robot.home) * pin.SE3(pin.exp3(np.array([0.0, 0.0, -by])), np.zeros(3))
    goal = PoseGoal(robot, [target(wanted, free_turn="z", turn=turn)], (), robot.home)
    assert goal.errors(robot.home)["angle of left_hand"] == pytest.approx(error, abs=1e-6)
    first = pose_goals(robot, goal.poses, (), robot.home)[0]  # of the nearest pose to the start
    (drawn,) = first._drawn
    there = target(hand_pose(robot, robot.home))
    off = Rotation.from_quat(drawn.orientation).inv() * Rotation.from_quat(there.orientation)
    assert off.magnitude() == pytest.approx(error, abs=1e-6)


def test_goals_that_all_fail_say_so_in_a_sentence(robot: Robot) -> None:
    far = [PoseTarget(frame="left_hand", position=(3.0 + k, 0.0, 0.5)) for k in range(3)]
    with MotionPlanner(robot) as planner:
        refused = planner.plan("home", AnyOf(far), timeout=5.0)
    assert refused.status is PlanStatus.INVALID_GOAL and "left_hand is out of reach" in refused.reason
    near = [*far, PoseTarget(frame="left_hand", position=(0.0, 0.5, 0.2))]  # inside of the arm's first links
    with MotionPlanner(robot) as planner:
        refused = planner.plan("home", AnyOf(near), timeout=5.0)
    assert refused.status is PlanStatus.INVALID_GOAL and refused.reason.startswith("none found in ")


def test_goals_are_mappings_as_in_files_too(robot: Robot) -> None:
    place = tuple(hand_pose(robot, robot.home).translation.tolist())
    grasp, grasps = {"object": "box", "hand": "left_hand"}, [{"position": (0, 0, 0), "orientation": (0, 0, 0, 1)}]
    with MotionPlanner(robot) as planner:
        planner.world.add(name="box", box=(0.02, 0.02, 0.02), position=place, grasps=grasps)
        for mapping, same in (
            ({"grasp": grasp}, Goal(grasp=grasp)),
            ({"poses": [{"frame": "left_hand", "position": place}]}, PoseTarget(frame="left_hand", position=place)),
            ({"joints": "home"}, "home"),
            ({"joints": ["home", robot.home]}, ["home", dict(zip(robot.joint_names, robot.home, strict=True))]),
            ({"any_of": [{"grasp": grasp}, "home"]}, AnyOf([Goal(grasp=grasp), "home"])),
            (AnyOf([{"grasp": grasp}, {"joints": "home"}]), AnyOf([Goal(grasp=grasp), "home"])),
        ):
            assert planner.problem("home", mapping).goal == planner.problem("home", same).goal


def test_a_frame_that_the_group_does_not_move_is_named(robot: Robot) -> None:
    left, right = (
        PoseTarget(frame=f"{side}_hand", position=(0.5, y, 0.4)) for side, y in (("left", 0.2), ("right", -0.2))
    )
    at_home = PoseTarget(
        frame="right_hand", position=tuple(hand_pose(robot, robot.home, "right_hand").translation.tolist())
    )
    with MotionPlanner(robot) as planner:
        for goal in (right, [left, right], AnyOf([right, right])):
            refused = planner.plan("home", goal, group="left_arm")
            assert refused.reason == "right_hand is moved by none of the joints that are planned"
        assert planner.plan("home", AnyOf([right, left]), group="left_arm")
        assert planner.plan("home", [left, at_home], group="left_arm")


@pytest.mark.parametrize(
    ("goal", "message"),
    [
        (lambda: AnyOf([]), "any_of"),
        (lambda: AnyOf("home"), "several goals"),
        (lambda: AnyOf(3), "several goals"),
        (lambda: AnyOf([AnyOf(["home"])]), "no any_of inside"),
        (lambda: AnyOf([PoseTarget(frame="hnd", position=(0.5, 0.0, 0.5))]), "unknown frame of a pose 'hnd'"),
        (lambda: AnyOf(["hme"]), "unknown pose"),
        (lambda: AnyOf([[1.0, 2.0]]), "goal: expected a state of shape"),
        (lambda: {"grasp": {"object": "box"}}, "goal: grasp.hand: required key is missing"),
        (lambda: {"grasp": {"object": "box", "hand": "left_hand"}}, "object"),
        (lambda: {"grasp": {}, "left_joint1": 0.1}, "unknown key"),
        (lambda: {"joints": {"left_joint1": 0.1}}, "joint .* is missing"),
        (lambda: [{"grasp": {"object": "box", "hand": "left_hand"}}, "home"], "AnyOf of both"),
        (lambda: {"left_joint1": 0.1}, "joint .* is missing"),
        (lambda: AnyOf([{"left_joint1": 0.1}]), "joint .* is missing"),
    ],
)
def test_faulty_goals_are_named(robot: Robot, goal: Any, message: str) -> None:
    with MotionPlanner(robot) as planner, pytest.raises(ApexError, match=message):
        planner.plan("home", goal())


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"free_turn": "z"}, "an orientation beside free_turn"),
        ({"turn": (0.0, 1.0)}, "beside a free_turn"),
        ({"orientation": (0, 0, 0, 1), "free_turn": "z", "turn": (1.0, 0.0)}, "least, largest"),
        ({"orientation": (0, 0, 0, 1), "free_turn": "z", "turn": (-3.2, 3.2)}, "at most 6.2832 apart"),
        ({"orientation": (0, 0, 0, 1), "free_turn": "z", "turn": (6.0, 6.3)}, "inside .-6.2832, 6.2832"),
        ({"turn": (-90.0, 90.0)}, "beside a free_turn; in degrees it would be inside"),
        ({"orientation": (0, 0, 0, 1), "free_turn": "z", "turn": (-90, 90)}, "in degrees it would be inside"),
        ({"tolerance": {"angle": 180.0}}, "tolerance.angle: expected an angle of at most 6.2832; angles are radians"),
        ({"lower": (0.1, 0.0, 0.0)}, "a lower of 0 or less"),
        ({"approach": (0.0, 0.0, 0.1)}, "an orientation beside an approach"),
        ({"orientation": (0, 0, 0, 1), "approach": (0.0, 0.0, 0.0)}, "an approach that is not zero"),
        ({"orientation": (0, 0, 0, 1), "approach": (0, 0, 100)}, "approach: expected .* less than 10 m.* are meters"),
        ({"orientation": (0, 0, 0, 1), "free_turn": "x", "approach": (0, 0, 0.1)}, "along the axis of the free turn"),
        ({"orientation": (0, 0, 0, 1), "free_turn": "w"}, "'x', 'y' or 'z'"),
    ],
)
def test_faulty_regions_are_named(robot: Robot, fields: dict[str, Any], message: str) -> None:
    goal = {"poses": [{"frame": "left_hand", "position": (0.5, 0.0, 0.5), **fields}]}
    start = dict(zip(robot.joint_names, robot.home.tolist(), strict=True))
    with pytest.raises(ApexError, match=message):
        Problem.parse({"name": "faulty", "robot": robot.name, "start": start, "goal": goal}, "faulty")


def test_a_line_goes_to_one_pose(robot: Robot) -> None:
    with MotionPlanner(robot) as planner, pytest.raises(ApexError, match="without free_turn"):
        planner.plan_line("home", target(hand_pose(robot, robot.home), free_turn="z"))


def test_a_region_of_a_problem_is_any_of_the_drawn_poses(robot: Robot) -> None:
    with MotionPlanner(robot) as planner:
        problem = planner.problem("home", target(hand_pose(robot, robot.home), upper=(0.1, 0.0, 0.0)))
    goal = workspace_goal(robot, problem)
    assert isinstance(goal, AnyGoal) and len(goal.members) > 1 and goal.errors(robot.home) == {"goal": 0.0}


def test_an_approach_ends_straight_along_an_axis_of_the_hand(robot: Robot, tmp_path: Path) -> None:
    at = hand_pose(robot, robot.home + 0.1 * np.sin(np.arange(robot.dof)))
    lower = at.copy()
    lower.translation[2] -= 0.03
    by = np.array([0.0, 0.05, 0.0])
    goals = AnyOf([target(at, approach=tuple(by)), target(lower, approach=tuple(by))])
    with MotionPlanner(robot) as planner:
        problem = planner.problem("home", goals)
        with pytest.raises(ApexError, match="a plan by plan_task"):
            planner.plan("home", goals)
        with pytest.raises(ApexError, match="a plan by plan_task"):
            planner.plan_problem(problem)
        both = planner.problem("home", AnyOf([target(at, approach=tuple(by)), target(lower)]))
        with pytest.raises(ApexError, match="the same frames and approaches"):
            planner.plan_task(both)
    assert problem.goal.approaches and not with_lines(problem).goal.approaches
    problem.save(tmp_path / "approach.yaml")
    task = plan_task(tmp_path / "approach.yaml", timeout=20.0)
    assert task and [step.title for step in task.steps] == ["goal", "line left_hand"]
    line = task.steps[-1].path.states
    ends = [hand_pose(robot, q) for q in (line[0], line[-1])]
    offs = [min(np.abs(pin.log6(pose.actInv(ends[1])).vector).max() for pose in (at, lower))]
    assert offs[0] < 2e-3
    assert np.allclose(ends[0].actInv(ends[1]).translation, by, atol=1e-3)
    for q in line:
        off = ends[0].actInv(hand_pose(robot, q))
        assert np.linalg.norm(np.delete(off.translation, 1)) < 3e-4 and np.linalg.norm(pin.log3(off.rotation)) < 3e-3
