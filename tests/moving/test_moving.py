"""Timed paths among moving obstacles, against dense samples of the meshes."""

from __future__ import annotations

import numpy as np
import pytest
from crossings import path_from_home, problem_with
from hypothesis import given, settings
from hypothesis import strategies as st

from apex_ompl.collision import CollisionChecker
from apex_ompl.errors import ParameterError
from apex_ompl.moving.timed_proof import check_timed_path, constant_velocity_times, inflated
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.scene.scripts import obstacle_at

SHAPES = [
    {"box": (0.12, 0.1, 0.08)}, {"sphere": {"radius": 0.06}}, {"cylinder": {"radius": 0.05, "length": 0.15}},
    {"capsule": {"radius": 0.05, "length": 0.1}},
]  # fmt: skip


@settings(max_examples=12)
@given(seed=st.integers(0, 2**32 - 1))
def test_valid_paths_are_free_at_all_times_and_invalid_ones_nearly_touch(robot: Robot, seed: int) -> None:
    rng = np.random.default_rng(seed)
    path, times = path_from_home(robot, rng)
    hand = robot.link_pose(path[2], "left_hand_palm")[:3, 3]
    velocity = rng.normal(0.0, 0.2, 3)
    at = hand + rng.normal(0.0, 0.12, 3) - velocity * times[2]
    dynamic_obstacle = Obstacle.model_validate(
        {
            "name": "dynamic_obstacle",
            "position": at.tolist(),
            "velocity": velocity.tolist(),
            **SHAPES[seed % len(SHAPES)],
        }
    )
    check = check_timed_path(robot, problem_with(robot, dynamic_obstacle), path, times)
    checker = CollisionChecker(robot, [dynamic_obstacle], proofs=False)
    nearest = np.inf
    for time in np.linspace(0.0, times[-1], 80):
        q = np.array([np.interp(time, times, column) for column in path.T])
        checker.move("dynamic_obstacle", obstacle_at(dynamic_obstacle, time).position)
        if check:
            assert checker.is_free(q), time
        elif checker.is_free(q):
            nearest = min(nearest, checker.clearance(q))
        else:
            nearest = 0.0
    assert check or nearest < 0.02  # the inflated obstacle was 2.5 mm larger, samples are some 10 mm apart


def test_without_dynamic_obstacles_it_is_the_full_check(robot: Robot, post: Obstacle) -> None:
    start, goal = robot.home.copy(), robot.home.copy()
    start[[0, 1, 3]], goal[[0, 1, 3]] = (0.1, 0.4, -1.6), (-1.3, 0.4, -1.6)
    path = np.stack([start, goal])
    blocked = check_timed_path(robot, problem_with(robot, post), path, [0.0, 5.0])
    assert not blocked and "post" in blocked.reason and blocked.time == 5.0
    assert check_timed_path(robot, problem_with(robot), path, [0.0, 5.0])


def test_waiting_lets_an_obstacle_pass(robot: Robot) -> None:
    q = robot.home.copy()
    path = np.stack([q, q + np.where(np.arange(robot.dof) == 0, -0.5, 0.0)])
    hand = robot.link_pose(path[1], "left_hand_palm")[:3, 3]
    velocity = np.array([0.8, 0.0, 0.0])
    box = Obstacle(name="box", box=(0.1, 0.1, 0.1), position=tuple(hand - velocity), velocity=tuple(velocity))
    moving = problem_with(robot, box)
    met = check_timed_path(robot, moving, path, [0.0, 1.0])
    assert not met and "box" in met.reason
    waited = np.stack([path[0], path[0], path[1]])
    assert check_timed_path(robot, moving, waited, [0.0, 3.0, 4.0])


@pytest.mark.parametrize("kind", SHAPES)
def test_inflated_obstacles_contain_all_points_within_the_distance(kind: dict[str, object]) -> None:
    import coal

    from apex_ompl.collision.shapes import world_geometry

    body = Obstacle.model_validate({"name": "body", "position": (0.1, -0.2, 0.3), **kind})
    (inner, pose), (outer, same) = world_geometry(body), world_geometry(inflated(body, 0.02))
    assert np.array_equal(pose, same)
    rng, probe = np.random.default_rng(0), coal.Sphere(1e-6)
    where = coal.Transform3s(pose[:3, :3], pose[:3, 3])
    for point in rng.uniform(-0.15, 0.15, (300, 3)) + pose[:3, 3]:
        at = coal.Transform3s(np.eye(3), point)
        apart = [
            coal.distance(s, where, probe, at, coal.DistanceRequest(), coal.DistanceResult()) for s in (inner, outer)
        ]
        if apart[0] < 0.02 - 1e-5:
            assert apart[1] <= 1e-5


def test_constant_velocity_times_keep_the_velocity_scale(robot: Robot) -> None:
    path, _ = path_from_home(robot, np.random.default_rng(3))
    times = constant_velocity_times(robot, path, 0.25)
    speeds = np.abs(np.diff(path, axis=0)) / np.diff(times)[:, None] / robot.limits.velocity
    assert times[0] == 0.0 and np.allclose(speeds.max(axis=1), 0.25)
    assert check_timed_path(robot, problem_with(robot), path, times * 0.26)
    fast = check_timed_path(robot, problem_with(robot), path, times * 0.24)
    assert not fast and "its limit is" in fast.reason


@pytest.mark.parametrize(
    ("path", "times", "name"),
    [
        (np.zeros((2, 3)), [0, 1], "path"), (np.zeros((1, 16)), [0], "path"), (np.zeros((2, 16)), [0, 0], "times"),
        (np.zeros((2, 16)), [1, 2], "times"), (np.zeros((2, 16)), [0, np.nan], "times"),
        (np.zeros((2, 16)), [0], "times"),
    ],
)  # fmt: skip
def test_wrong_arguments_are_named(robot: Robot, path: np.ndarray, times: list[float], name: str) -> None:
    with pytest.raises(ParameterError, match=name):
        check_timed_path(robot, problem_with(robot), path, times)


def test_long_durations_and_wrong_velocity_scales_are_named(robot: Robot) -> None:
    ball = Obstacle(name="ball", sphere={"radius": 0.1}, position=(2.0, 0.0, 0.5), velocity=(0.1, 0.0, 0.0))
    with pytest.raises(ParameterError, match="times"):
        check_timed_path(robot, problem_with(robot, ball), np.stack([robot.home, robot.home]), [0.0, 1e10])
    for scale in (0.0, -1.0, np.nan, 1.5):
        with pytest.raises(ParameterError, match="velocity_scale"):
            constant_velocity_times(robot, np.stack([robot.home, robot.home]), scale)


def test_limits_and_shapes_that_cannot_be_inflated_are_named(robot: Robot) -> None:
    path = np.stack([robot.home, robot.home])
    path[1, 3] = 0.5
    beyond = check_timed_path(robot, problem_with(robot), path, [0.0, 9.0])
    assert not beyond and "left_joint4" in beyond.reason
    floor = Obstacle(name="floor", half_space={"normal": (0, 0, 1)}, position=(0, 0, -2), velocity=(0, 0, 0.1))
    with pytest.raises(ParameterError, match="floor"):
        check_timed_path(robot, problem_with(robot, floor), np.stack([robot.home, robot.home]), [0.0, 1.0])
