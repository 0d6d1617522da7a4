"""Straight lines of tools: kept by path and motion, at a speed, by two arms, with blends, and how far they get."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from apex_ompl import MotionPlanner, PlanStatus, PoseTarget, Timing
from apex_ompl.constraints.line_ends import LineEnd
from apex_ompl.errors import FileFormatError, ParameterError, UnknownNameError
from apex_ompl.planning.lines import ANGLE, POSITION, LineResult
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import pose_fields
from apex_ompl.timing import Trajectory
from apex_ompl.types import Array

POINT = (0.4, 0.4, 0.5)
TURN = (0.2, -0.3, 0.4)
CUP = {
    "name": "cup", "cylinder": {"radius": 0.03, "length": 0.1}, "position": (0.0, 0.12, 0.05),
    "contact": {"point": (0.0, 0.0, 0.05), "axis": (0.0, 0.0, 1.0)}, "link": "left_hand_palm",
}  # fmt: skip


@pytest.fixture(scope="module")
def kept(robot: Robot) -> MotionPlanner:
    return MotionPlanner(robot)


@pytest.fixture
def planner(kept: MotionPlanner) -> MotionPlanner:
    kept.world.clear()
    return kept


def hand_poses(robot: Robot, states: Array, name: str) -> Array:
    """Poses of a hand's grasp point, by Pinocchio, shape (N, 4, 4)."""
    data, frame = robot.model.createData(), robot.link_frame(robot.hands[name].palm)
    poses = np.empty((len(states), 4, 4))
    for pose, q in zip(poses, robot.to_pinocchio(states), strict=True):
        pin.framesForwardKinematics(robot.model, data, q)
        pose[:] = data.oMf[frame].homogeneous
        pose[:3, 3] += pose[:3, :3] @ robot.hands[name].point
    return poses


def hand_pose(robot: Robot, q: Array, name: str) -> Array:
    return hand_poses(robot, q[None], name)[0]


def moved(pose: Array, translation: tuple[float, ...], turn: tuple[float, ...] = (0.0, 0.0, 0.0)) -> Array:
    made = pose.copy()
    made[:3, 3] += translation
    made[:3, :3] = pose[:3, :3] @ pin.exp3(np.array(turn))
    return made


def follow(planner: MotionPlanner, start: Array, pose: Any, **options: Any) -> LineResult:
    """A plan with time enough on a busy machine."""
    return planner.plan_line(start, pose, **{"timeout": 120.0} | options)


def dense(motion: Trajectory | Array) -> Array:
    """States of a motion, or of straight lines between states, ten times as many as its own."""
    if isinstance(motion, Trajectory):
        return motion(np.linspace(0.0, motion.duration, 10 * len(motion.times)))
    shares = np.linspace(0.0, 1.0, 10, endpoint=False)[:, None]
    return np.concatenate([a + shares * (b - a) for a, b in zip(motion[:-1], motion[1:], strict=True)] + [motion[-1:]])


def errors(robot: Robot, states: Array, name: str, first: Array, last: Array) -> tuple[Array, Array, Array]:
    """Distances from the line between two poses, angles to the turn at the nearest point, and shares of the line."""
    direction, turn = last[:3, 3] - first[:3, 3], pin.log3(first[:3, :3].T @ last[:3, :3])
    distances, angles, shares = [], [], []
    for pose in hand_poses(robot, states, name):
        share = (pose[:3, 3] - first[:3, 3]) @ direction / (direction @ direction)
        distances.append(np.linalg.norm(pose[:3, 3] - first[:3, 3] - share * direction))
        angles.append(np.linalg.norm(pin.log3((first[:3, :3] @ pin.exp3(share * turn)).T @ pose[:3, :3])))
        shares.append(share)
    return np.array(distances), np.array(angles), np.array(shares)


def check(robot: Robot, states: Array, name: str, first: Array, last: Array) -> Array:
    """Check that all states keep the line, and return their shares of it."""
    distances, angles, shares = errors(robot, states, name, first, last)
    assert distances.max() < POSITION and angles.max() < ANGLE
    return shares


def speeds(robot: Robot, motion: Trajectory, name: str) -> Array:
    """Speeds of a hand's grasp point, by finite differences of Pinocchio's poses [m/s]."""
    times = np.linspace(0.0, motion.duration, 1000)
    points = hand_poses(robot, motion(times), name)[:, :3, 3]
    return np.linalg.norm(np.diff(points, axis=0), axis=1) / np.diff(times)


def test_path_and_motion_keep_the_line(planner: MotionPlanner, robot: Robot) -> None:
    start = hand_pose(robot, robot.home, "left_hand")
    goal = moved(start, (0.1, 0.15, -0.1), TURN)
    result = follow(planner, robot.home, goal, frame="left_hand")
    assert result and result.share == 1.0 and result.end is LineEnd.REACHED and result.partial_motion is None
    assert result.path is not None and result.trajectory is not None
    assert np.array_equal(result.path.states[0], robot.home)
    for part in (result.path.states, result.trajectory):
        shares = check(robot, dense(part), "left_hand", start, goal)
        assert (np.diff(shares) > -1e-6).all() and shares[-1] == pytest.approx(1.0, abs=1e-6)
    assert result.line_distance <= POSITION and result.line_angle <= ANGLE
    assert (result.path.states[:, 7:] == robot.home[7:]).all()  # the left arm alone moves
    assert np.abs(result.trajectory.positions[:, 7:] - robot.home[7:]).max() < 1e-12
    assert max(result.trajectory.use(robot.limits).values()) <= 1.0 + 1e-9
    assert result.problem.goal.poses is not None and result.problem.goal.poses[0].frame == "left_hand"
    assert "100 % of the line" in repr(result)


def test_the_same_line_gives_the_same_path(planner: MotionPlanner, robot: Robot) -> None:
    goal = hand_pose(robot, robot.home, "left_hand")[:3, 3] + (0.1, 0.0, 0.1)
    first, second = (follow(planner, robot.home, goal, frame="left_hand", timing=False) for _ in range(2))
    assert first.path is not None and second.path is not None and first.trajectory is None
    assert np.array_equal(first.path.states, second.path.states)


def test_the_tool_is_never_faster_than_its_speed(planner: MotionPlanner, robot: Robot) -> None:
    start = hand_pose(robot, robot.home, "right_hand")
    goal = PoseTarget(frame="right_hand", position=tuple(start[:3, 3] + (0.0, -0.2, 0.1)))
    for timing in (True, Timing(max_tool_speed=0.5), Timing(max_tool_speed={"right_hand": 0.3})):
        result = follow(planner, robot.home, goal, speed=0.1, timing=timing)
        assert result.trajectory is not None
        assert 0.098 < speeds(robot, result.trajectory, "right_hand").max() <= 0.1


def test_a_held_object_goes_along_the_line_by_its_face(planner: MotionPlanner, robot: Robot) -> None:
    planner.world.attach(CUP)
    face = robot.link_pose(robot.home, "left_hand_palm") @ np.array([0.0, 0.12, 0.1, 1.0])
    goal = PoseTarget(frame="cup", position=tuple(face[:3] + (0.0, 0.0, 0.15)), orientation=(0.0, 0.0, 0.0, 1.0))
    result = follow(planner, robot.home, goal, speed=0.1)
    assert result and result.trajectory is not None
    times = np.linspace(0.0, result.trajectory.duration, 200)
    palms = [robot.link_pose(q, "left_hand_palm") for q in result.trajectory(times)]
    points = np.array([palm @ np.array([0.0, 0.12, 0.1, 1.0]) for palm in palms])[:, :3]
    assert np.abs(points[:, :2] - face[:2]).max() < POSITION
    assert np.linalg.norm(np.diff(points, axis=0), axis=1).max() <= 0.1 * times[1]
    assert math.acos(min(1.0, palms[-1][2, 2])) < ANGLE  # the axis of the face is up


def test_turns_on_the_spot(planner: MotionPlanner, robot: Robot) -> None:
    start = hand_pose(robot, robot.home, "left_hand")
    result = follow(planner, robot.home, moved(start, (0.0, 0.0, 0.0), (0.0, 0.0, 0.5)), frame="left_hand")
    assert result.trajectory is not None
    poses = hand_poses(robot, dense(result.trajectory), "left_hand")
    assert max(np.linalg.norm(pose[:3, 3] - start[:3, 3]) for pose in poses) < POSITION
    turns = np.array([pin.log3(start[:3, :3].T @ pose[:3, :3]) for pose in poses])
    assert np.linalg.norm(turns[:, :2], axis=1).max() < ANGLE and turns[-1, 2] == pytest.approx(0.5, abs=1e-6)


def test_two_arms_go_in_step(planner: MotionPlanner, robot: Robot) -> None:
    first = {name: hand_pose(robot, robot.home, name) for name in robot.hands}
    last = {name: moved(pose, (0.1, 0.0, 0.1), TURN) for name, pose in first.items()}
    last["right_hand"] = moved(first["right_hand"], (0.05, -0.1, 0.0))
    result = follow(planner, robot.home, last)
    assert result.trajectory is not None
    shares = [check(robot, dense(result.trajectory), name, first[name], last[name]) for name in robot.hands]
    assert np.abs(shares[0] - shares[1]).max() < 2e-3


def test_two_hands_carry_one_object(planner: MotionPlanner, robot: Robot) -> None:
    palms = [robot.link_pose(robot.home, f"{side}_hand_palm") for side in ("left", "right")]
    middle = np.eye(4)
    middle[:3, 3] = 0.5 * (palms[0] + palms[1])[:3, 3]
    bar = {"name": "bar", "box": (0.05, 0.5, 0.03), "links": ("left_hand_palm", "right_hand_palm")}
    planner.world.attach(bar | pose_fields(np.linalg.inv(palms[0]) @ middle))
    goal = moved(middle, (0.1, 0.05, 0.1), (0.0, 0.1, 0.2))
    result = follow(planner, robot.home, goal, frame="bar", speed=0.2)
    assert result and result.trajectory is not None
    for q in result.trajectory(np.linspace(0.0, result.trajectory.duration, 50)):
        left, right = (robot.link_pose(q, f"{side}_hand_palm") for side in ("left", "right"))
        apart = pin.log6(pin.SE3(np.linalg.inv(palms[0]) @ palms[1]).actInv(pin.SE3(np.linalg.inv(left) @ right)))
        assert np.linalg.norm(apart.linear) < 1e-3 and np.linalg.norm(apart.angular) < 2.0 * ANGLE
    assert np.allclose(left @ np.linalg.inv(palms[0]) @ middle, goal, atol=1e-6)
    with pytest.raises(
        ParameterError, match="expected one frame, as two links hold 'bar', got 'poses of left_hand and"
    ):
        follow(planner, robot.home, {"left_hand": POINT, "right_hand": POINT})


def test_blends_stay_inside_their_radius_and_are_faster(planner: MotionPlanner, robot: Robot) -> None:
    start = hand_pose(robot, robot.home, "left_hand")
    corner = moved(start, (0.15, 0.0, -0.1), TURN)
    goal = moved(corner, (0.0, 0.2, 0.0))
    stopping = follow(planner, robot.home, [corner, goal], frame="left_hand")
    blended = follow(planner, robot.home, [corner, goal], frame="left_hand", blend=0.05)
    assert stopping.trajectory is not None and blended.trajectory is not None
    assert blended.trajectory.duration < stopping.trajectory.duration
    for result, radius in ((stopping, 0.0), (blended, 0.05)):
        assert result.trajectory is not None
        states = dense(result.trajectory)
        points = hand_poses(robot, states, "left_hand")[:, :3, 3]
        away = np.linalg.norm(points - corner[:3, 3], axis=1)
        turn = int(away.argmin())
        inside = away <= radius + 1e-6
        assert inside.any() or not radius
        for part, ends in ((slice(0, turn), (start, corner)), (slice(turn, None), (corner, goal))):
            check(robot, states[part][~inside[part]], "left_hand", *ends)
        assert (away[turn] < 1e-5) == (radius == 0.0)
    assert np.abs(stopping.trajectory.velocities[1:-1]).max(axis=1).min() < 1e-6  # it stops at the corner


def test_a_blocked_line_ends_at_the_bodies(planner: MotionPlanner, robot: Robot, tmp_path: Path) -> None:
    start = hand_pose(robot, robot.home, "left_hand")
    planner.world.add(name="wall", box=(0.05, 1.0, 1.0), position=(start[0, 3] + 0.3, start[1, 3], start[2, 3]))
    goal = moved(start, (0.3, 0.0, 0.0))
    result = follow(planner, robot.home, goal, frame="left_hand")
    assert not result and result.status is PlanStatus.APPROXIMATE_SOLUTION and 0.1 < result.share < 0.9
    assert result.end is LineEnd.COLLISION and result.blocked_by[1] == "wall" and "wall" in result.reason
    assert result.trajectory is None and result.partial_motion is not None and result.path is not None
    shares = check(robot, dense(result.partial_motion), "left_hand", start, goal)
    assert shares[-1] == pytest.approx(result.share, abs=1e-6)
    assert all(planner.is_free(q) for q in result.path.states)
    assert np.array_equal(result.partial_motion.positions[-1], result.path.states[-1])
    for suffix in (".json", ".npz", ".yaml"):
        result.save(tmp_path / f"line{suffix}")
        loaded = LineResult.load(tmp_path / f"line{suffix}")
        assert (loaded.share, loaded.end, loaded.blocked_by) == (result.share, result.end, result.blocked_by)
        assert loaded.line_distance == result.line_distance and loaded.status is result.status
    planner.plan(robot.home, robot.home).save(tmp_path / "plan.json")
    with pytest.raises(FileFormatError, match="expected the result of a line"):
        LineResult.load(tmp_path / "plan.json")


def test_a_line_beyond_reach_says_how_far_it_gets(planner: MotionPlanner, robot: Robot) -> None:
    start = hand_pose(robot, robot.home, "left_hand")
    goal = moved(start, (0.8, 0.0, 0.0))
    result = follow(planner, robot.home, goal, frame="left_hand", timing=False)
    assert result.end is LineEnd.UNREACHABLE and "left_hand cannot reach" in result.reason
    assert result.path is not None and 0.2 < result.share < 1.0
    assert check(robot, dense(result.path.states), "left_hand", start, goal)[-1] == pytest.approx(result.share)
    near = moved(start, (0.8 * result.share - 2e-3, 0.0, 0.0))
    assert follow(planner, robot.home, near, frame="left_hand", timing=False)


def test_redundancy_avoids_a_limit_that_the_pseudoinverse_meets(planner: MotionPlanner, robot: Robot) -> None:
    start = robot.home.copy()
    start[6] = robot.limits.upper[6] - 0.05
    goal = moved(hand_pose(robot, start, "left_hand"), (0.0, 0.15, 0.0))
    result = follow(planner, start, goal, frame="left_hand", timing=False)
    assert result and result.path is not None and (result.path.states <= robot.limits.upper).all()
    state, frame = robot.to_pinocchio(start), robot.link_frame("left_hand_palm")
    data, tool = robot.model.createData(), pin.SE3(np.eye(3), np.asarray(robot.hands["left_hand"].point))
    arm, wanted = robot.state_order < 7, hand_pose(robot, start, "left_hand")
    for share in np.linspace(0.0, 1.0, 151):  # Pinocchio's Jacobian and the plain pseudoinverse
        jacobian = pin.computeFrameJacobian(robot.model, data, state, frame, pin.LOCAL)
        pin.framesForwardKinematics(robot.model, data, state)
        target = pin.SE3(wanted[:3, :3], wanted[:3, 3] + share * np.array([0.0, 0.15, 0.0]))
        twist = pin.log6((data.oMf[frame] * tool).actInv(target)).vector
        state[arm] += np.linalg.pinv((tool.inverse().action @ jacobian)[:, arm]) @ twist
    assert (state[arm] > robot.to_pinocchio(robot.limits.upper)[arm]).any()


def test_a_line_to_where_the_tool_is(planner: MotionPlanner, robot: Robot) -> None:
    result = follow(planner, robot.home, hand_pose(robot, robot.home, "left_hand"), frame="left_hand")
    assert result and result.share == 1.0 and result.trajectory is not None and result.path is not None
    assert np.array_equal(result.path.states, robot.home[None])


def test_invalid_starts_and_spent_time_are_statuses(planner: MotionPlanner, robot: Robot) -> None:
    goal, outside = hand_pose(robot, robot.home, "left_hand")[:3, 3] + 0.1, robot.home.copy()
    outside[3] = 1.0
    result = follow(planner, outside, goal, frame="left_hand")
    assert result.status is PlanStatus.INVALID_START and result.end is LineEnd.JOINT_LIMIT and result.path is None
    planner.world.add(name="wall", box=(0.2, 0.2, 0.2), position=hand_pose(robot, robot.home, "left_hand")[:3, 3])
    result = follow(planner, robot.home, goal, frame="left_hand")
    assert result.status is PlanStatus.INVALID_START and result.end is LineEnd.COLLISION
    planner.world.clear()
    result = planner.plan_line(robot.home, goal, frame="left_hand", timeout=1e-4)
    assert result.status is PlanStatus.TIMEOUT and result.end is LineEnd.TIMEOUT and result.share == 0.0


FAULTY = [
    (POINT, {"frame": "left_hnd"}, UnknownNameError, "unknown frame of a line 'left_hnd', did you mean 'left_hand'"),
    (POINT, {}, ParameterError, "frame: expected the name of a hand, a link or a held object, got None"),
    ((0.4, math.nan, 0.5), {"frame": "left_hand"}, ParameterError, "pose: expected finite numbers, got nan"),
    ((0.4, 0.5), {"frame": "left_hand"}, ParameterError, "pose: expected poses of shape"),
    ([], {"frame": "left_hand"}, ParameterError, "pose: expected poses of shape"),
    (2.0 * np.eye(4), {"frame": "left_hand"}, ParameterError, "pose of left_hand: expected a rigid pose"),
    ({}, {}, ParameterError, "pose: expected a pose for a frame"),
    (POINT, {"frame": "left_hand", "blend": -0.01}, ParameterError, "blend: expected a number, 0 or more, got -0.01"),
    (POINT, {"frame": "left_hand", "blend": math.nan}, ParameterError, "blend: expected a number"),
    ([POINT, (0.4, 0.4, 0.6)], {"frame": "left_hand", "blend": 0.06}, ParameterError, "blend: expected at most half"),
    (POINT, {"frame": "left_hand", "speed": 0.0}, ParameterError, "speed: expected a positive number of m/s"),
    (POINT, {"frame": "left_hand", "timing": 1}, ParameterError, "timing: expected True, False or a Timing"),
    (POINT, {"frame": "left_hand", "timeout": 0}, ParameterError, "timeout: expected a positive number"),
    (
        POINT, {"frame": "left_hand", "timing": Timing(start_velocity=[0.1] * 16)}, ParameterError,
        "timing: expected a start at rest",
    ),
    (POINT, {"frame": "left_link3"}, ParameterError, "frame: expected one that 6 joints or more move, not 3"),
    (
        {"left_hand": POINT, "left_link7": POINT}, {}, ParameterError,
        "frame: expected frames of arms that share no joint .left_joint1 moves left_hand too., got 'left_link7'",
    ),
    (
        [{"left_hand": POINT}, {"right_hand": POINT}], {}, ParameterError,
        r"pose\[1\]: expected poses of left_hand, got 'right_hand'",
    ),
    (
        PoseTarget(frame="left_hand", position=POINT), {"frame": "right_hand"}, ParameterError,
        "frame: expected 'left_hand', the frame of the pose, got 'right_hand'",
    ),
    (
        {"right_hand": PoseTarget(frame="left_hand", position=POINT)}, {}, ParameterError,
        "pose of right_hand: expected a pose of that frame, got 'left_hand'",
    ),
]  # fmt: skip


@pytest.mark.parametrize("case", FAULTY, ids=[message for *_, message in FAULTY])
def test_bad_input_is_refused_in_one_sentence(planner: MotionPlanner, robot: Robot, case: tuple[Any, ...]) -> None:
    pose, options, kind, message = case
    with pytest.raises(kind, match=message) as caught:
        follow(planner, robot.home, pose, **options)
    assert "\n" not in str(caught.value)


def test_obstacles_that_move_are_refused(planner: MotionPlanner, robot: Robot) -> None:
    planner.world.add(name="ball", sphere={"radius": 0.05}, position=(2.0, 0.0, 0.5), velocity=(-0.1, 0.0, 0.0))
    with pytest.raises(ParameterError, match='world: expected obstacles that stand still, got "the moving obstacle'):
        follow(planner, robot.home, POINT, frame="left_hand")
