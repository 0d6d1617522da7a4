"""Splines in time among dynamic obstacles: costs, gradients, exact starts, limits, and motions that give way."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from apex_ompl.collision import CollisionChecker
from apex_ompl.errors import ParameterError
from apex_ompl.moving.dynamic_obstacles import DynamicObstacles, curve_of, prove_motion
from apex_ompl.moving.motion_optimizer import MotionOptimizer, MotionSettings, _grid, shortest_duration
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.timing import Trajectory
from apex_ompl.timing.timed_spline import Start, TimedSpline


@pytest.fixture(scope="module")
def bare(robot: Robot) -> CollisionChecker:
    return CollisionChecker(robot)


def test_shortest_duration_of_a_detour_and_at_an_even_pace(robot: Robot) -> None:
    """Joint 0 goes 0.6 rad ahead in two steps and 0.2 rad back in one."""
    states = np.tile(robot.home, (4, 1))
    states[:, 0] = 0.0, 0.5, 0.6, 0.4
    speed, acceleration = robot.limits.velocity[0], robot.limits.acceleration[0]
    ramps = 2.0 * np.sqrt(0.4 / acceleration)
    assert shortest_duration(states, robot.limits) == pytest.approx(max(0.8 / speed, ramps, 0.1))
    assert shortest_duration(states, robot.limits, even=True) == pytest.approx(max(3 * 0.5 / speed, ramps, 0.1))
    assert shortest_duration(states[:1].repeat(2, axis=0), robot.limits) == 0.1


def ends(robot: Robot) -> tuple[np.ndarray, np.ndarray]:
    start, goal = robot.home.copy(), robot.home.copy()
    start[[0, 1, 3]], goal[[0, 1, 3]] = (0.1, 0.4, -1.6), (-1.0, 0.4, -1.6)
    return start, goal


def line(start: np.ndarray, goal: np.ndarray, duration: float) -> TimedSpline:
    states = start + (np.linspace(0.0, 1.0, 101) ** 2)[:, None] * (goal - start)
    return TimedSpline.along(states, duration, Start.at_rest(start), goal)


def crossing(robot: Robot, when: float) -> Obstacle:
    """A box that is where the hand passes half-way at a time."""
    start, goal = ends(robot)
    there = robot.link_pose(0.5 * (start + goal), "left_hand_palm")[:3, 3]
    velocity = np.array([0.0, 0.0, -0.3])
    place = tuple((there - when * velocity).tolist())
    return Obstacle(name="box", box=(0.12, 0.12, 0.12), position=place, velocity=tuple(velocity))


def random_start(robot: Robot, rng: np.random.Generator) -> Start:
    limits = robot.limits
    q = rng.uniform(limits.lower, limits.upper)
    return Start(
        q, rng.uniform(-1, 1, robot.dof) * limits.velocity, rng.uniform(-1, 1, robot.dof) * limits.acceleration
    )


@settings(max_examples=20)
@given(seed=st.integers(0, 2**32 - 1))
def test_motions_begin_exactly_and_end_at_rest(robot: Robot, seed: int) -> None:
    rng = np.random.default_rng(seed)
    start, goal = random_start(robot, rng), rng.uniform(robot.limits.lower, robot.limits.upper)
    duration = rng.uniform(0.5, 4.0)
    spline = TimedSpline.along(np.stack([start.position, goal]), duration, start, goal)
    motion = spline.trajectory(robot.joint_names)  # which checks that constant jerk joins its knots
    assert motion.duration == pytest.approx(spline.duration)
    for order, value in enumerate(start):
        assert np.array_equal(motion(0.0, order), value)
    assert np.array_equal(motion(motion.duration), goal)
    assert not motion.velocities[-1].any() and not motion.accelerations[-1].any()
    slower = spline.lasting(2.0 * spline.spacing).trajectory(robot.joint_names)
    assert np.array_equal(slower.velocities[0], start.velocity)


def test_samples_and_speeds_are_those_of_the_motion(robot: Robot) -> None:
    rng = np.random.default_rng(0)
    spline = line(*ends(robot), 1.5)
    spline.control[3:-3] += rng.normal(0.0, 0.1, spline.control[3:-3].shape)
    motion, samples = spline.trajectory(robot.joint_names), 4
    weights, first, gram = _grid(len(spline.control), samples)
    times = (np.arange(len(weights)) + 0.5) / len(weights) * spline.duration
    states = np.stack([w @ spline.control[k : k + 4] for w, k in zip(weights, first, strict=True)])
    assert np.allclose(states, motion(times), atol=1e-12)
    fine = np.linspace(0.0, spline.duration, 20001)
    squares = (motion(fine, 1) ** 2).sum(axis=1) * spline.duration**2
    integral = np.trapezoid(squares, fine / spline.duration)
    assert np.einsum("id,ij,jd->", spline.control, gram, spline.control) == pytest.approx(integral, rel=1e-6)


def test_gradients_by_finite_differences(robot: Robot, bare: CollisionChecker) -> None:
    rng = np.random.default_rng(1)
    start, goal = ends(robot)
    spline = line(start, goal, 0.6)  # over its limits
    spline.control[3:-3] += rng.normal(0.0, 0.03, spline.control[3:-3].shape) * (np.arange(robot.dof) < 7)
    dynamic = DynamicObstacles([crossing(robot, 1.3)])
    dynamic.update("box", growth=(0.005, 0.01))
    optimizer = MotionOptimizer(bare.kernel, dynamic, robot.limits)
    report, gradient = optimizer.evaluate(spline, clock=1.0)
    without, _ = MotionOptimizer(bare.kernel, DynamicObstacles([]), robot.limits).evaluate(spline, clock=1.0)
    assert report.clearance_cost > without.clearance_cost and report.scene_clearance < without.scene_clearance
    step, relative = 1e-6, []
    for i, d in zip(rng.integers(0, len(gradient), 25), rng.integers(0, 7, 25), strict=True):
        costs = []
        for sign in (1.0, -1.0):
            moved = spline.control.copy()
            moved[3 + i, d] += sign * step
            costs.append(optimizer.evaluate(spline._replace(control=moved), clock=1.0)[0].cost)
        numeric = (costs[0] - costs[1]) / (2.0 * step)
        relative.append(abs(numeric - gradient[i, d]) / max(abs(numeric), 1e-3))
    assert np.median(relative) < 1e-6 and np.max(relative) < 1e-2  # edges of distances


@pytest.mark.parametrize("moving", [False, True])
def test_a_motion_gives_way_within_its_limits(robot: Robot, bare: CollisionChecker, moving: bool) -> None:
    q, goal = ends(robot)
    spline = line(q, goal, 1.2)
    box = crossing(robot, 0.5 * spline.duration)
    dynamic = DynamicObstacles([box])
    assert prove_motion(bare.kernel, dynamic, spline.trajectory(robot.joint_names))
    start = Start(q, np.where(np.arange(robot.dof) == 1, 0.3, 0.0), np.zeros(robot.dof)) if moving else spline.start

    def accepts(motion: Trajectory) -> bool:
        return not prove_motion(bare.kernel, dynamic, motion) and bool(bare.prove(curve_of(motion), tolerance=0.0))

    optimizer = MotionOptimizer(bare.kernel, dynamic, robot.limits)
    motion = optimizer.repair(spline._replace(start=start).lasting(spline.spacing), accepts)
    assert motion is not None and accepts(motion)
    assert max(motion.use(robot.limits).values()) <= 1.0 + 1e-9
    assert np.array_equal(motion.velocities[0], start.velocity) and np.array_equal(motion(motion.duration), goal)
    exact = CollisionChecker(robot, [box], proofs=False)
    for time in np.linspace(0.0, motion.duration, 100):
        exact.move("box", DynamicObstacles([box]).at(time)["box"])
        assert exact.is_free(motion(time))
    assert optimizer.repair(spline, lambda motion: False) is None
    assert optimizer.repair(spline, accepts, stop=lambda: True) is None


def test_bad_input_is_named(robot: Robot, bare: CollisionChecker) -> None:
    start, goal = ends(robot)
    with pytest.raises(ParameterError, match="duration"):
        line(start, goal, -1.0)
    with pytest.raises(ParameterError, match="states"):
        TimedSpline.along(start[None], 1.0, Start.at_rest(start), goal)
    optimizer = MotionOptimizer(bare.kernel, DynamicObstacles([]), robot.limits, MotionSettings(steps=2))
    spline = line(start, goal, 1.0)
    with pytest.raises(ParameterError, match="control points"):
        optimizer.improve(spline._replace(control=spline.control[:6]))
    with pytest.raises(ParameterError, match="control points"):
        optimizer.improve(spline._replace(control=spline.control[:, :5]))
