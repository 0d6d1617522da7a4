"""Dynamic obstacles: proofs of timed motions against dense samples of the meshes, clearances in time, updates."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from apex_ompl.collision import CollisionChecker
from apex_ompl.errors import ApexError
from apex_ompl.goals.state_sampling import scene_kernel
from apex_ompl.moving.dynamic_obstacles import DynamicObstacles, allowed_rows, clearance_in_time, prove_motion
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.scene.scripts import obstacle_at
from apex_ompl.timing import Timing, Trajectory, time_path

SHAPES = [
    {"box": (0.12, 0.1, 0.08)}, {"sphere": {"radius": 0.06}}, {"cylinder": {"radius": 0.05, "length": 0.15}},
    {"capsule": {"radius": 0.05, "length": 0.1}},
]  # fmt: skip


@pytest.fixture(scope="module")
def bare(robot: Robot) -> CollisionChecker:
    return CollisionChecker(robot)


def motion_of(robot: Robot, rng: np.random.Generator) -> Trajectory:
    path = robot.home + np.cumsum(rng.normal(0.0, 0.3, (4, robot.dof)), axis=0)
    path = np.clip(path, robot.limits.lower + 0.01, robot.limits.upper - 0.01)
    return time_path(path, robot.limits, robot.joint_names, Timing(method="spline", velocity_scale=0.6)).trajectory


def dynamic_obstacle_near(
    robot: Robot, motion: Trajectory, rng: np.random.Generator, name: str = "dynamic_obstacle"
) -> Obstacle:
    time, velocity = rng.uniform(0.0, motion.duration), rng.normal(0.0, 0.3, 3)
    hand = robot.link_pose(motion(time), "left_hand_palm")[:3, 3]
    at = hand + rng.normal(0.0, 0.15, 3) - velocity * time
    shape = SHAPES[rng.integers(len(SHAPES))]
    return Obstacle.model_validate({"name": name, "position": at.tolist(), "velocity": velocity.tolist(), **shape})


@settings(max_examples=12)
@given(seed=st.integers(0, 2**32 - 1))
def test_a_motion_is_free_up_to_the_first_moment_that_is_not_proved(
    robot: Robot, bare: CollisionChecker, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    motion = motion_of(robot, rng)
    dynamic_obstacle = dynamic_obstacle_near(robot, motion, rng)
    conflict = prove_motion(bare.kernel, DynamicObstacles([dynamic_obstacle]), motion)
    exact = CollisionChecker(robot, [dynamic_obstacle], proofs=False)
    for time in np.linspace(0.0, motion.duration, 60):
        exact.move("dynamic_obstacle", obstacle_at(dynamic_obstacle, time).position)
        order = robot.to_pinocchio(motion(time))
        if time < conflict.time:
            assert not any("dynamic_obstacle" in (c.first, c.second) for c in exact.meshes.contacts(order)), time
    if conflict:
        exact.move("dynamic_obstacle", obstacle_at(dynamic_obstacle, conflict.time).position)
        alone = CollisionChecker(robot, [exact.obstacles["dynamic_obstacle"]])
        assert conflict.dynamic_obstacle == "dynamic_obstacle" and conflict.body
        assert alone.obstacle_distance(motion(conflict.time)[None]) < 0.03  # covers, and an interval of 1 ms


@settings(max_examples=15)
@given(seed=st.integers(0, 2**32 - 1))
def test_clearances_are_those_of_a_kernel_with_the_obstacle_there(
    robot: Robot, bare: CollisionChecker, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    motion = motion_of(robot, rng)
    obstacles = [dynamic_obstacle_near(robot, motion, rng, f"dynamic_obstacle{k}") for k in range(3)]
    dynamic = DynamicObstacles(obstacles, stamp=0.5)
    dynamic.update("dynamic_obstacle1", growth=(0.01, 0.02))
    fixtureless = replace(robot, fixtures=())
    times = np.sort(rng.uniform(0.5, 3.0, 4))
    states = motion(times)
    found, gradients = clearance_in_time(bare.kernel, dynamic, states, times)
    for q, time, value in zip(states, times, found, strict=True):
        margins = (0.0, 0.01 + 0.02 * (time - 0.5), 0.0)
        there = [scene_kernel(fixtureless, bare.kernel.robot, [obstacle_at(o, time - 0.5)]) for o in obstacles]
        single = [kernel.clearance(q)[0, 0] - margin for kernel, margin in zip(there, margins, strict=True)]
        assert value == pytest.approx(min(single), abs=1e-12)
    step = 1e-6
    for j in range(robot.dof + 1):
        dq, dt = np.zeros(robot.dof), 0.0
        if j < robot.dof:
            dq[j] = step
        else:
            dt = step
        ahead, _ = clearance_in_time(bare.kernel, dynamic, states + dq, times + dt)
        behind, _ = clearance_in_time(bare.kernel, dynamic, states - dq, times - dt)
        numeric = (ahead - behind) / (2.0 * step)
        assert np.median(np.abs(numeric - gradients[:, j])) < 1e-6  # at an edge of the distance they differ


def test_clocks_stamps_and_margins(robot: Robot, bare: CollisionChecker) -> None:
    rng = np.random.default_rng(4)
    motion, kernel = motion_of(robot, rng), bare.kernel
    dynamic_obstacle = dynamic_obstacle_near(robot, motion, rng)
    dynamic = DynamicObstacles([dynamic_obstacle], stamp=2.0)
    plain = prove_motion(kernel, DynamicObstacles([dynamic_obstacle]), motion)
    assert prove_motion(kernel, dynamic, motion, clock=2.0).time == pytest.approx(plain.time)
    dynamic.update("dynamic_obstacle", position=obstacle_at(dynamic_obstacle, 1.5).position, stamp=3.5)
    assert prove_motion(kernel, dynamic, motion, clock=2.0).time == pytest.approx(plain.time, abs=2e-3)
    assert np.allclose(dynamic.at(2.0)["dynamic_obstacle"], dynamic_obstacle.position)
    dynamic.update("dynamic_obstacle", growth=(0.5, 0.0))
    assert prove_motion(kernel, dynamic, motion, clock=2.0).time <= min(plain.time, motion.duration)
    dynamic.update("dynamic_obstacle", position=(5.0, 5.0, 5.0), velocity=(0.0, 0.0, 0.0))
    assert not prove_motion(kernel, dynamic, motion, clock=2.0)
    dynamic.update("dynamic_obstacle", growth=(0.0, 2.0), stamp=0.0)
    late = prove_motion(kernel, dynamic, motion, end=60.0)  # the robot stands, and the margin grows
    assert late and motion.duration < late.time < 60.0


def test_a_robot_at_rest_is_met_by_what_comes_near(robot: Robot, bare: CollisionChecker) -> None:
    still = np.zeros((1, robot.dof))
    rest = Trajectory(np.zeros(1), robot.home[None], still, still, robot.joint_names)
    hand = robot.link_pose(robot.home, "left_hand_palm")[:3, 3]
    ball = Obstacle(name="ball", sphere={"radius": 0.05}, position=tuple(hand + (1, 0, 0)), velocity=(-0.5, 0, 0))
    conflict = prove_motion(bare.kernel, DynamicObstacles([ball]), rest, end=3.0)
    assert 1.2 < conflict.time < 1.95 and conflict.dynamic_obstacle == "ball"
    assert not prove_motion(bare.kernel, DynamicObstacles([ball]), rest, end=1.0)
    touching = allowed_rows(bare.kernel, [(body, "ball") for body in bare.kernel.robot.body_names], ["ball"])
    assert not prove_motion(bare.kernel, DynamicObstacles([ball], touching), rest, end=3.0)


def test_clouds_move_as_grids(robot: Robot, bare: CollisionChecker, tmp_path: Path) -> None:
    np.save(tmp_path / "cloud.npy", np.random.default_rng(0).uniform(-0.05, 0.05, (300, 3)))
    hand = robot.link_pose(robot.home, "left_hand_palm")[:3, 3]
    cloud = Obstacle(
        name="cloud", points={"file": str(tmp_path / "cloud.npy"), "radius": 0.005},
        position=tuple(hand + (0.6, 0, 0)), velocity=(-0.2, 0, 0),
    )  # fmt: skip
    values, _ = clearance_in_time(
        bare.kernel, DynamicObstacles([cloud]), np.repeat(robot.home[None], 3, axis=0), [0.0, 1.0, 3.0]
    )
    assert values[0] > values[1] > 0.0 > values[2]
    assert values[0] - values[1] == pytest.approx(0.2, abs=0.02)


def test_bad_input_is_named(robot: Robot, bare: CollisionChecker) -> None:
    ball = Obstacle(name="ball", sphere={"radius": 0.1}, position=(2.0, 0.0, 0.5))
    floor = Obstacle(name="floor", half_space={"normal": (0, 0, 1)}, position=(0, 0, -2), velocity=(0, 0, 0.1))
    dynamic = DynamicObstacles([ball])
    still = np.zeros((1, 2))
    other = Trajectory(np.zeros(1), still, still, still, ("a", "b"))
    for call, named in (
        (lambda: DynamicObstacles([floor]), "floor"),
        (lambda: DynamicObstacles([ball, ball]), "ball"),
        (lambda: DynamicObstacles([ball], [(0, "bat")]), "bat"),
        (lambda: dynamic.update("bat"), "bat"),
        (lambda: dynamic.update("ball", position=(0, 0)), "position"),
        (lambda: dynamic.update("ball", velocity=(0, 0, np.nan)), "velocity"),
        (lambda: dynamic.update("ball", growth=(-0.1, 0)), "growth"),
        (lambda: dynamic.update("ball", stamp=np.nan), "stamp"),
        (lambda: prove_motion(bare.kernel, dynamic, other), "motion"),
        (lambda: clearance_in_time(bare.kernel, dynamic, robot.home[None], [0.0, 1.0]), "times"),
    ):
        with pytest.raises(ApexError, match=named):
            call()
