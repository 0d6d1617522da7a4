"""Newton's method on the poses of tools, against forward kinematics by definition and the pseudoinverse of NumPy."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from random_robots import frames, pose, random_robot
from scipy.optimize import minimize

from apex_ompl.constraints.links import Links
from apex_ompl.errors import ParameterError
from apex_ompl.kernel.compiled.geometry.enclosing_ball import enclose
from apex_ompl.kernel.joint_tree import JointTree
from apex_ompl.kernel.tool_poses import ToolSolver
from apex_ompl.robot import Robot

Arm = tuple[ToolSolver, int, np.ndarray]


def test_tools_arrive_where_they_are_wanted_on_trees_with_mimic_joints() -> None:
    arrived = 0
    for seed in range(60):
        tables, specs, *_ = random_robot(seed)
        rng, joint, turns = np.random.default_rng(seed), len(specs) - 1, JointTree(specs).turns
        local = pose(rng, 0.1)
        solver = ToolSolver(tables, [joint], [turns[joint].T @ local], [np.arange(tables.dof)])
        goals = rng.uniform(-0.8, 0.8, (5, tables.dof))
        wanted = np.array([frames(specs, q)[joint] @ local for q in goals])
        starts = goals + rng.normal(0.0, 0.03, goals.shape)
        found, ok = solver.close(starts, wanted[:, None, :3, :3], wanted[:, None, :3, 3], 30)
        for q, target, there in zip(found, wanted, ok, strict=True):
            lacking = pin.log6(pin.SE3(target).actInv(pin.SE3(frames(specs, q)[joint] @ local))).vector
            assert (np.abs(lacking).max() < 1e-8) == there, seed
        arrived += int(ok.sum())
    assert arrived >= 285, "of 300 that are reachable and near"


@pytest.fixture(scope="module")
def arm(robot: Robot) -> Arm:
    """Newton's method for the left palm of the Pandas by its arm alone, and the palm's frame in Pinocchio's model."""
    links, hand = Links.of(robot), robot.hands["left_hand"]
    joint, placed = links.frame(hand.palm, pin.SE3.Identity())
    columns = np.array(robot.groups["left_arm"])
    return ToolSolver(links.tables, [joint], [placed.homogeneous], [columns]), robot.link_frame(hand.palm), columns


def palm(robot: Robot, frame: int, q: np.ndarray) -> tuple[pin.SE3, np.ndarray]:
    """Pose of a frame, and its Jacobian by planned joint with axes of the world, by Pinocchio."""
    data = robot.model.createData()
    full = pin.computeFrameJacobian(robot.model, data, robot.to_pinocchio(q), frame, pin.LOCAL_WORLD_ALIGNED)
    pin.framesForwardKinematics(robot.model, data, robot.to_pinocchio(q))
    return data.oMf[frame].copy(), full[:, np.argsort(robot.state_order)]


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10**6))
def test_a_step_is_that_of_the_pseudoinverse(robot: Robot, arm: Arm, seed: int) -> None:
    solver, frame, columns = arm
    rng = np.random.default_rng(seed)
    q = robot.random_state(rng)
    here, jacobian = palm(robot, frame, q)
    turn, shift = rng.normal(0.0, 0.01, 3), rng.normal(0.0, 0.01, 3)
    wanted = pin.exp3(turn) @ here.rotation
    found, _ = solver.close(q[None], wanted[None, None], (here.translation + shift)[None, None], 1)
    step = np.linalg.pinv(jacobian[:, columns]) @ np.append(shift, turn)
    step *= min(1.0, 0.4 / np.abs(step).max())
    assert np.allclose(found[0, columns], q[columns] + step, atol=2e-3 * np.abs(step).max() + 1e-6)
    others = np.setdiff1d(np.arange(robot.dof), columns)
    assert np.array_equal(found[0, others], q[others])


def test_what_is_not_finite_does_not_arrive_and_faults_are_named(robot: Robot, arm: Arm) -> None:
    solver, frame, columns = arm
    rng, q = np.random.default_rng(0), robot.home
    here, _ = palm(robot, frame, q)
    rotation, point = here.rotation[None, None], here.translation[None, None]
    start = q + 0.1 * rng.normal(size=robot.dof)
    found, ok = solver.close(
        np.array([start, np.full(robot.dof, np.nan)]), *(np.repeat(x, 2, 0) for x in (rotation, point)), 20
    )
    assert ok.tolist() == [True, False]
    assert np.allclose(palm(robot, frame, found[0])[0].homogeneous, here.homogeneous, atol=1e-9)
    with pytest.raises(ParameterError, match="states"):
        solver.close(q[None, :-1], rotation, point, 5)
    with pytest.raises(ParameterError, match="points"):
        solver.close(q[None], rotation, point[:, :, :2], 5)
    joints, poses = [1, 2], np.tile(np.eye(4), (2, 1, 1))
    with pytest.raises(ParameterError, match="one tool each"):
        ToolSolver(solver.robot, joints, poses, [columns, columns[:1]])
    with pytest.raises(ParameterError, match="joints of the tools"):
        ToolSolver(solver.robot, [999], poses[:1], [columns])
    with pytest.raises(ParameterError, match="poses of the tools"):
        ToolSolver(solver.robot, joints, poses[:1], [columns[:1], columns[1:]])


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10**6), st.integers(1, 9), st.integers(1, 12))
def test_balls_around_moving_balls_are_small(seed: int, places: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    points, radii = rng.normal(0.0, 0.1, (places, count, 3)), rng.uniform(0.0, 0.05, count)
    counted = np.flatnonzero(rng.random(count) < 0.7) if count > 1 else np.zeros(1, int)
    counted = counted if len(counted) else np.zeros(1, int)
    center, away = np.empty(3), np.empty(count)
    enclose(points, counted, radii[counted], center, away)
    assert np.allclose(away, np.linalg.norm(points - center, axis=2).max(axis=0), atol=1e-12)

    def radius(at: np.ndarray) -> float:
        return float((np.linalg.norm(points[:, counted] - at, axis=2) + radii[counted]).max())

    best = minimize(radius, center, method="Nelder-Mead", options={"xatol": 1e-6, "fatol": 1e-8, "maxiter": 2000})
    assert radius(center) <= 1.03 * best.fun + 1e-9
