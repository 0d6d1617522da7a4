"""Joints that turn without end: the shorter way, the other way where it is blocked, and what repeats after a turn."""

from __future__ import annotations

import math
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from ompl import base as ob
from small_arm import JOINT, write_endless

from apex_ompl import plan
from apex_ompl.collision import CollisionChecker
from apex_ompl.errors import ApexError
from apex_ompl.ompl.setup import TURNED_GOALS, assemble
from apex_ompl.result import PlanStatus
from apex_ompl.robot import Robot, load_robot
from apex_ompl.robot.rest_to_rest import direct_durations
from apex_ompl.scene.problem import Goal, Problem
from apex_ompl.types import Array

TURN = 2.0 * math.pi
DEGREE = math.pi / 180.0
WALL = {"name": "wall", "box": [0.9, 0.05, 3.0], "position": [0.6, 0.0, 0.5]}


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Robot:
    return load_robot(write_endless(tmp_path_factory.mktemp("endless"), ("turn", "elbow")))


def problem(robot: Robot, start: Array, goals: Array, scene: tuple[dict[str, object], ...] = ()) -> Problem:
    states = [dict(zip(robot.joint_names, map(float, q), strict=True)) for q in (start, *np.atleast_2d(goals))]
    file = str(next(path for path in robot.files if path.suffix == ".yaml"))
    return Problem(name="round", robot=file, scene=list(scene), start=states[0], goal={"joints": states[1:]})


def test_distances_and_lines_are_those_of_the_circle(robot: Robot) -> None:
    rng = np.random.default_rng(0)
    circle = ob.SO2StateSpace()
    a, b, between = (circle.allocState() for _ in range(3))
    for _ in range(200):
        q, other, share = *rng.uniform(-math.pi, math.pi, 2), rng.random()
        turns, more = TURN * rng.integers(-40, 41, 2)
        start, goal = (np.array([value, 0.4, 0.6]) for value in (q + turns, other + more))
        turned = robot.turned_to(goal, start)
        a.value, b.value = q, other
        assert abs(turned[0] - start[0]) == pytest.approx(circle.distance(a, b), abs=1e-9)
        circle.interpolate(a, b, share, between)
        line = start[0] + share * (turned[0] - start[0])
        assert math.remainder(line - between.value, TURN) == pytest.approx(0.0, abs=1e-9)
        assert np.array_equal(turned[1:], goal[1:])


def test_goals_are_all_those_within_a_turn_the_nearest_first(robot: Robot) -> None:
    rng, home = np.random.default_rng(1), np.array([0.0, 0.4, 0.6])
    for _ in range(5):
        start = np.array([rng.uniform(-30.0, 30.0), 0.4, 0.4 + TURN * rng.integers(-3, 4)])
        goal = home + [rng.uniform(-9.0, 9.0), 0.0, 0.3 + TURN * rng.integers(-3, 4)]
        setup = assemble(problem(robot, start, goal), robot)
        shifts = [TURN * np.array([i, 0.0, k]) for i, k in product(range(-9, 10), repeat=2)]
        alike = [goal + shift for shift in shifts if np.abs(goal + shift - start).max() <= TURN]
        alike.sort(key=lambda q: float(np.linalg.norm(q - start)))
        assert len(alike) <= TURNED_GOALS and np.allclose(setup.goals, alike, atol=1e-9)
        lower, upper = setup.bounds
        assert ((setup.goals >= lower) & (setup.goals <= upper)).all() and np.array_equal(setup.start, start)


def test_a_goal_over_the_seam_is_near(robot: Robot) -> None:
    for turns in (0, 7):
        start = np.array([-170 * DEGREE + TURN * turns, 0.4, 0.6])
        result = plan(problem(robot, start, [170 * DEGREE, 0.4, 0.6]), timeout=20.0)
        assert result.path is not None and result.trajectory is not None
        assert np.array_equal(result.path.states[0], start)
        assert result.path.states[-1, 0] == pytest.approx(start[0] - 20 * DEGREE, abs=1e-9)
        assert result.length == pytest.approx(20 * DEGREE, abs=1e-6)
        direct = direct_durations(start, result.path.states[-1:], robot.limits)[0]
        assert result.trajectory.duration == pytest.approx(direct, rel=0.05)
        poses = [robot.link_pose(q, "lower") for q in (result.path.states[-1], [170 * DEGREE, 0.4, 0.6])]
        assert np.allclose(*poses, atol=1e-9)


def test_the_other_way_round_is_taken_where_the_shorter_one_is_blocked(tmp_path: Path) -> None:
    file = write_endless(tmp_path, ("turn", "elbow"))
    file.write_text(file.read_text().replace("shoulder: {home: 0.4,", "shoulder: {home: 1.2, lower: 0.9, upper: 1.4,"))
    robot = load_robot(file)
    start, goal = np.array([0.5, 1.2, 0.3]), np.array([-0.5, 1.2, 0.3])
    checker = CollisionChecker(robot, problem(robot, start, goal, (WALL,)).scene)
    assert not any(checker.is_free(np.array([0.0, *q])) for q in product([0.9, 1.1, 1.4], np.linspace(-3, 3, 9)))
    for planner in ("apex", "rrtconnect"):
        result = plan(problem(robot, start, goal, (WALL,)), planner, timeout=20.0)
        assert result.path is not None, result.reason
        assert result.path.states[-1, 0] == pytest.approx(TURN - 0.5, abs=1e-9)
        assert np.abs(np.diff(result.path.sample(0.01)[:, 0])).max() < 0.02


def test_why_a_goal_is_invalid_is_said_once(robot: Robot) -> None:
    """A goal in collision is so after each of its turns."""
    blocked = np.array([0.0, 1.2, 0.3])
    setup = assemble(problem(robot, np.array([1.5, 0.4, 0.6]), blocked, (WALL,)), robot)
    assert len(setup.goal_faults) >= 4 and all(setup.goal_faults)
    result = plan(problem(robot, np.array([1.5, 0.4, 0.6]), blocked, (WALL,)))
    assert result.status is PlanStatus.INVALID_GOAL and result.reason.count("<->") == 1


def test_states_after_whole_turns_are_checked_alike(robot: Robot) -> None:
    rng = np.random.default_rng(2)
    checker = CollisionChecker(robot, problem(robot, np.zeros(3), np.zeros(3), (WALL,)).scene)
    states = robot.random_state(rng, 400)
    assert (np.abs(states[:, [0, 2]]) <= math.pi).all()
    turned = states + TURN * rng.integers(-500, 501, (400, 3)) * robot.continuous
    free = checker.are_free(states)
    assert 20 < free.sum() < 380 and np.array_equal(checker.are_free(turned), free)
    clearances = [checker.kernel.clearance(some, 0.5) for some in (states, turned)]
    assert np.allclose(*clearances, atol=1e-9)


def test_a_pose_is_reached_by_the_nearest_turn(robot: Robot) -> None:
    start = np.array([20.0, 0.4, 0.6])
    pose = robot.link_pose(np.array([20.6, 0.7, 0.9]), "lower")
    goal = {"poses": [{"frame": "lower", "position": pose[:3, 3].tolist(), "tolerance": {"position": 1e-3}}]}
    setup = assemble(problem(robot, start, start).model_copy(update={"goal": Goal.model_validate(goal)}), robot)
    assert len(setup.goals) and (np.abs(setup.goals[0] - start)[[0, 2]] <= math.pi).all()
    assert all(np.allclose(robot.link_pose(q, "lower")[:3, 3], pose[:3, 3], atol=2e-3) for q in setup.goals)


def test_joints_that_mimic_an_endless_one_turn_with_it_or_are_refused(tmp_path: Path) -> None:
    pointer = '<link name="pointer"/>' + JOINT.format(
        name="follow", axis="0 0 1", at=0.1, above="base", below="pointer"
    ).replace('type="revolute"', 'type="continuous"')
    # "follow" comes before "turn" by name, and joints that mimic others come after them in Pinocchio's models
    for multiplier, fault in (("-2", ""), ("0.5", "mimics 'turn', which turns without end")):
        mimic = f'<mimic joint="turn" multiplier="{multiplier}"/></joint>'
        file = write_endless(tmp_path, more=pointer.replace("</joint>", mimic))
        if fault:
            with pytest.raises(ApexError, match=fault):
                load_robot(file)
            continue
        found = load_robot(file)
        assert {"turn", "follow"} <= {*found.model.names} and found.model.existJointName("follow")
        angle = found.link_pose(np.array([0.3, 0.0, 0.0]), "pointer")
        assert math.atan2(angle[1, 0], angle[0, 0]) == pytest.approx(-0.6)
        assert list(found.continuous) == [True, False, False]
        assert np.allclose(*(found.link_pose(np.array([q, 0, 0]), "pointer") for q in (0.3, 0.3 + TURN)), atol=1e-9)


def test_half_a_range_is_refused(tmp_path: Path) -> None:
    file = write_endless(tmp_path)
    file.write_text(file.read_text().replace("turn: {home: 0.0,", "turn: {home: 0.0, lower: -1,"))
    with pytest.raises(ApexError, match="'turn' is continuous and has lower alone"):
        load_robot(file)


def test_a_base_drives_in_the_plane_by_one_line(tmp_path: Path) -> None:
    file = write_endless(tmp_path, ())
    text = file.read_text()
    file.write_text(text.replace("urdf: small_arm.urdf}", "urdf: small_arm.urdf, planar: {x: [-2, 3], y: [1, 4]}}"))
    robot = load_robot(file)
    file.write_text(text)
    fixed = load_robot(file)
    assert robot.joint_names == ("arm_x", "arm_y", "arm_yaw", *fixed.joint_names)
    assert list(robot.continuous) == [False, False, True, False, False, False]
    assert list(robot.groups["arm_base"]) == [0, 1, 2] and list(robot.home[:3]) == [0.0, 1.0, 0.0]
    assert np.allclose(robot.limits.lower[:2], [-2, 1]) and np.allclose(robot.limits.velocity[:3], [0.5, 0.5, 1.0])
    x, y, yaw = 1.5, 2.5, 2.0
    pose = np.eye(4)
    pose[:2, :2], pose[:2, 3] = [[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]], [x, y]
    q = np.array([0.3, 0.2, 0.1])
    assert np.allclose(robot.link_pose(np.array([x, y, yaw, *q]), "lower"), pose @ fixed.link_pose(q, "lower"))
