from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import ruckig
from timings import LIMITS, NAMES

from apex_ompl.collision import CollisionChecker
from apex_ompl.errors import ParameterError
from apex_ompl.moving import DynamicObstacles
from apex_ompl.moving.retime import retime
from apex_ompl.moving.stopping import stop, stop_along
from apex_ompl.robot import Robot
from apex_ompl.robot.model import Limits
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.timing import Timing, Trajectory, time_path
from apex_ompl.timing.combination import rest
from apex_ompl.timing.trajectory import STOP_DEVIATION

WIDE = 100.0  # rad, by which position limits are moved out of the way
SAMPLES = 400


def random_rates(limits: Limits, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Velocities and accelerations within limits, many of them at limits or 0, that a motion within them may have."""
    dof = len(limits.velocity)
    v, a = (
        x * rng.choice([-1.0, 0.0, 1.0, 2.0], dof, p=[0.15, 0.05, 0.2, 0.6])
        for x in (limits.velocity, limits.acceleration)
    )
    v = np.where(np.abs(v) > limits.velocity, rng.uniform(-1.0, 1.0, dof) * limits.velocity, v)
    a = np.where(np.abs(a) > limits.acceleration, rng.uniform(-1.0, 1.0, dof) * limits.acceleration, a)
    for sign in (1.0, -1.0):  # no motion within the limits has a velocity that must still grow beyond them
        over = sign * v + np.maximum(sign * a, 0.0) ** 2 / (2.0 * limits.jerk) > limits.velocity
        most = np.sqrt(np.maximum(2.0 * limits.jerk * (limits.velocity - sign * v), 0.0))
        a = np.where(over, sign * np.minimum(sign * a, most), a)
    return v, a


def checked(motion: Trajectory) -> Trajectory:
    """The same motion, made with all checks."""
    return Trajectory(motion.times, motion.positions, motion.velocities, motion.accelerations, motion.joint_names)


class VelocityInterface:
    """Ruckig's soonest stops, joint by joint."""

    def __init__(self, limits: Limits) -> None:
        dof = len(limits.velocity)
        self.solver, self.query, self.found = ruckig.Ruckig(dof), ruckig.InputParameter(dof), ruckig.Trajectory(dof)
        self.query.control_interface = ruckig.ControlInterface.Velocity
        self.query.synchronization = ruckig.Synchronization.No
        self.query.max_acceleration, self.query.max_jerk = limits.acceleration.tolist(), limits.jerk.tolist()
        self.query.target_velocity = self.query.target_acceleration = [0.0] * dof

    def durations(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        self.query.current_position, self.query.current_velocity = q.tolist(), v.tolist()
        self.query.current_acceleration = a.tolist()
        assert self.solver.calculate(self.query, self.found) == ruckig.Result.Working
        return np.array(self.found.independent_min_durations)


def test_stops_are_as_soon_as_ruckigs_and_within_limits(robot: Robot) -> None:
    rng, limits = np.random.default_rng(0), robot.limits
    free = replace(limits, lower=limits.lower - WIDE, upper=limits.upper + WIDE)
    reference = VelocityInterface(limits)
    for k in range(4_000):
        q = rng.uniform(limits.lower, limits.upper)
        v, a = random_rates(limits, rng)
        found = stop(free, robot.joint_names, q, v, a)
        motion = found.trajectory
        assert found.within_limits and motion.duration == pytest.approx(reference.durations(q, v, a).max(), abs=1e-6)
        for order, given in enumerate((q, v, a)):
            np.testing.assert_array_equal((motion.positions, motion.velocities, motion.accelerations)[order][0], given)
        assert not motion.velocities[-1].any() and not motion.accelerations[-1].any()
        use = motion.use(limits)
        assert max(use[name] for name in ("velocity", "acceleration", "jerk")) <= 1.0 + 1e-8
        if k % 100 == 0:
            sampled = checked(motion)(np.linspace(0.0, motion.duration, SAMPLES), 1)
            assert np.all(np.abs(sampled) <= limits.velocity * (1.0 + 1e-9))
            change = np.diff(sampled, axis=0) / (motion.duration / (SAMPLES - 1))
            assert np.all(np.abs(change) <= limits.acceleration * (1.0 + 1e-6))


def test_every_joint_stops_as_soon_as_it_can(robot: Robot) -> None:
    rng, limits = np.random.default_rng(1), robot.limits
    free = replace(limits, lower=limits.lower - WIDE, upper=limits.upper + WIDE)
    for _ in range(100):
        v, a = random_rates(limits, rng)
        durations = VelocityInterface(limits).durations(robot.home, v, a)
        motion = checked(stop(free, robot.joint_names, robot.home, v, a).trajectory)
        for joint, duration in enumerate(durations):
            assert all(abs(motion(duration + 1e-6, order)[joint]) < 1e-9 for order in (1, 2))


def test_a_joint_brakes_for_longer_where_its_soonest_stop_would_pass_a_limit() -> None:
    limits = Limits(*(np.array([x]) for x in (-10.0, 1.0, 2.0, 5.0, 20.0)))
    q, v, a = np.array([0.9725]), np.array([0.5]), np.array([-5.0])
    free = replace(limits, upper=limits.upper + WIDE)
    soonest = stop(free, ("joint",), q, v, a).trajectory
    assert soonest.use(free)["position"] <= 1.0 and soonest(np.linspace(0.0, 1.0, 1000)).max() > 1.0
    found = stop(limits, ("joint",), q, v, a)
    assert found.within_limits and found.trajectory.duration > soonest.duration
    assert max(checked(found.trajectory).use(limits).values()) <= 1.0 + 1e-9
    assert not found.trajectory.velocities[-1].any() and not found.trajectory.accelerations[-1].any()


def test_a_state_that_cannot_stop_within_its_position_limits_is_named() -> None:
    limits = Limits(*(np.array([x, x]) for x in (-10.0, 1.0, 2.0, 5.0, 20.0)))
    found = stop(limits, ("a", "b"), np.array([0.9, 0.0]), np.array([1.5, 1.5]), np.zeros(2))
    assert not found.within_limits and found.beyond[0] > 0.0 and found.beyond[1] == 0.0
    positions = found.trajectory(np.linspace(0.0, found.trajectory.duration, 2000))
    assert positions[:, 0].max() - 1.0 == pytest.approx(found.beyond[0], abs=1e-6)


def test_stops_from_states_of_motions_keep_the_position_limits(robot: Robot) -> None:
    rng, limits = np.random.default_rng(2), robot.limits
    for _ in range(10):
        path = rng.uniform(limits.lower, limits.upper, (3, robot.dof))
        motion = time_path(path, limits, robot.joint_names).trajectory
        for time in rng.uniform(0.0, motion.duration, 50):
            found = stop(limits, robot.joint_names, motion(time), motion(time, 1), motion(time, 2))
            assert found.within_limits and max(found.trajectory.use(limits).values()) <= 1.0 + 1e-8


def test_a_robot_at_rest_is_stopped() -> None:
    found = stop(LIMITS, NAMES, np.zeros(3), np.zeros(3), np.zeros(3))
    assert found.trajectory.duration == 0.0 and found.within_limits
    assert not checked(found.trajectory)(1.0).any()


@pytest.mark.parametrize("timing", [Timing(), Timing(method="spline"), Timing(velocity_scale=0.25)])
def test_stops_along_a_path(robot: Robot, timing: Timing) -> None:
    rng, limits = np.random.default_rng(3), robot.limits
    sooner = 0
    for _ in range(3):
        path = robot.home + np.cumsum(rng.normal(0.0, 0.5, (4, robot.dof)), axis=0)
        motion = time_path(np.clip(path, limits.lower, limits.upper), limits, robot.joint_names, timing).trajectory
        for time in rng.uniform(0.0, motion.duration, 8):
            found = stop_along(motion, time, limits)
            made = checked(found.trajectory)
            for order in range(3):
                np.testing.assert_allclose(made(0.0, order), motion(time, order), rtol=0.0, atol=1e-9)
            assert not made.velocities[-1].any() and not made.accelerations[-1].any()
            assert max(made.use(limits).values()) <= 1.0 + 1e-8
            assert found.within_limits and found.deviation <= STOP_DEVIATION
            assert made.duration <= motion.duration - time + 1e-9
            sooner += made.duration < motion.duration - time - 1e-6
            points = made(np.linspace(0.0, made.duration, 60))
            dense = motion(np.linspace(time, time + made.duration, 3000))
            off = np.abs(points[:, None] - dense).max(axis=2).min(axis=1).max()
            assert off <= found.deviation + np.abs(np.diff(dense, axis=0)).max()
    assert sooner > 9


@pytest.mark.parametrize("speed", [0.1, 0.25, 0.6])
def test_a_stop_along_a_line_takes_little_longer_than_one_joint_by_joint(robot: Robot, speed: float) -> None:
    goal = robot.home + np.linspace(-0.9, 0.9, robot.dof)
    goal = np.clip(goal, robot.limits.lower, robot.limits.upper)
    limits = robot.limits
    motion = time_path(np.stack([robot.home, goal]), limits, robot.joint_names, Timing(velocity_scale=speed)).trajectory
    middle = motion.duration / 2.0
    along = stop_along(motion, middle, limits).trajectory
    apart = stop(limits, robot.joint_names, *(motion(middle, order) for order in range(3))).trajectory
    assert along.duration <= 1.6 * apart.duration + 0.02
    assert along.positions[-1] @ (goal - robot.home) >= motion(middle) @ (goal - robot.home)


def test_a_stop_along_a_motion_that_has_ended_is_rest() -> None:
    motion = time_path(np.array([[0.0, 0.0, 0.0], [1.0, 0.5, 0.0]]), LIMITS, NAMES).trajectory
    found = stop_along(motion, motion.duration, LIMITS)
    np.testing.assert_array_equal(found.trajectory(1.0), motion.positions[-1])


def test_faulty_arguments_of_stops_and_obstacles_are_named(robot: Robot) -> None:
    limits, names, still = robot.limits, robot.joint_names, np.zeros(robot.dof)
    motion = rest(robot.home, 1.0, names)
    ball = Obstacle(name="ball", sphere={"radius": 0.1}, position=(0.5, 0.0, 0.5))
    kernel = CollisionChecker(robot).kernel
    for call, words in (
        (lambda: stop(limits, names, robot.home[:3], still, still), "position: expected finite numbers of shape"),
        (lambda: stop(limits, names, robot.home, still[:3], still), "velocity: expected finite numbers of shape"),
        (lambda: stop(limits, names, robot.home, still, still * np.nan), "acceleration: expected finite numbers"),
        (lambda: stop_along(motion, "x", limits), "time: expected a number, got 'x'"),
        (lambda: retime(kernel, DynamicObstacles([]), motion, limits, hold=-1.0), "hold: expected a number, 0 or more"),
        (lambda: DynamicObstacles(ball), "obstacles: expected a list of obstacles"),
        (lambda: DynamicObstacles(["ball"]), "obstacles: expected a list of obstacles"),
        (lambda: DynamicObstacles(None), "obstacles: expected a list of obstacles, got None"),
    ):
        with pytest.raises(ParameterError, match=words):
            call()  # type: ignore[no-untyped-call]
