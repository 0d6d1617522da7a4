"""Motions along a path, retimed among obstacles that move."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from crossings import arm_motion, crossing

from apex_ompl.collision import CollisionChecker
from apex_ompl.errors import ParameterError
from apex_ompl.kernel import Kernel
from apex_ompl.moving.dynamic_obstacles import DynamicObstacles, prove_motion
from apex_ompl.moving.retime import Blocked, blocked, retime
from apex_ompl.robot import Robot
from apex_ompl.robot.model import Limits
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.timing import Timing, Trajectory, time_path

HOLD, HORIZON, TICK, PIECES = 1.0, 20.0, 0.01, 256


@pytest.fixture(scope="module")
def kernel(robot: Robot) -> Kernel:
    return CollisionChecker(robot).kernel


@pytest.fixture(scope="module")
def quarter(robot: Robot) -> Limits:
    return replace(robot.limits, velocity=0.25 * robot.limits.velocity)


@pytest.fixture(scope="module")
def swing(robot: Robot) -> Trajectory:
    """The left arm turns about its first joint, at a quarter of its speed."""
    path = np.repeat(robot.home[None], 2, axis=0)
    path[:, 0] = 0.6, -0.6
    return time_path(path, robot.limits, robot.joint_names, Timing(velocity_scale=0.25)).trajectory


def hand(kernel: Kernel, motion: Trajectory, time: float) -> np.ndarray:
    """Origin of the left arm's farthest joint [m]."""
    origins = kernel.joint_frames(motion(time)[None])[1][0]
    swung = kernel.joint_frames(motion(motion.duration)[None])[1][0]
    return origins[np.linalg.norm(origins - swung, axis=1).argmax()] if time < motion.duration else swung[-1]


def checked(motion: Trajectory) -> Trajectory:
    """The same motion, made with all checks."""
    return Trajectory(motion.times, motion.positions, motion.velocities, motion.accelerations, motion.joint_names)


def assert_kept(robot: Robot, given: Trajectory, time: float, made: Trajectory, deviation: float) -> None:
    """Check start, end, limits, and distance from the path."""
    made = checked(made)
    for order in range(3):
        np.testing.assert_allclose(made(0.0, order), given(time, order), rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(made.positions[-1], given.positions[-1], rtol=0.0, atol=1e-9)
    assert not made.velocities[-1].any() and not made.accelerations[-1].any()
    assert max(made.use(robot.limits).values()) <= 1.0 + 1e-8
    dense = given(np.linspace(time, given.duration, 5000))
    points = made(np.linspace(0.0, made.duration, 150))
    off = np.abs(points[:, None] - dense).max(axis=2).min(axis=1).max()
    assert off <= deviation + np.abs(np.diff(dense, axis=0)).max()


def earliest(blocks: Blocked, start: Blocked, end: Blocked, clock: float, most: float) -> float:
    """Least duration by a grid of places and times, at most ``most`` pieces a tick, without bounds on acceleration."""
    ticks = clock + TICK * np.arange(round((HORIZON + HOLD) / TICK))
    free = np.ones((len(ticks), PIECES + 2), bool)
    for column, (block, row) in enumerate([(start, 0), *((blocks, p) for p in range(PIECES)), (end, 0)]):
        for first, last in block.spans[row, : block.counts[row]]:
            free[(ticks + TICK >= first) & (ticks <= last), column] = False
    reached, budget, hold = np.zeros(PIECES + 2, bool), 0.0, round(HOLD / TICK)
    reached[0] = True
    for k in range(len(ticks) - hold):
        reached &= free[k]
        if reached[-1] and free[k : k + hold, -1].all():
            return float(ticks[k] - clock)
        budget += most
        while budget >= 1.0:
            budget -= 1.0
            reached[1:] |= reached[:-1]
            reached &= free[k]
    return math.inf


@pytest.mark.parametrize(("speed", "seed"), [(1.0, 0), (1.0, 1), (0.25, 2)])
def test_random_crossings(kernel: Kernel, robot: Robot, speed: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    ratios, found, possible, open_ones = [], 0, 0, 0
    while possible < 5:
        motion = arm_motion(robot, rng, speed)
        dynamic = crossing(kernel, motion, rng)
        time = float(rng.choice([0.0, 0.1]) * motion.duration)
        if dynamic is None or not prove_motion(kernel, dynamic, motion, time, motion.duration + HOLD):
            continue
        edges = np.linspace(time, motion.duration, PIECES + 1)
        within = {"start": time, "end": time + HORIZON + HOLD}
        ends = (np.full((1, 2), t) for t in (time, motion.duration))
        start, end = (blocked(kernel, dynamic, motion, place, **within) for place in ends)
        pieces = blocked(kernel, dynamic, motion, np.stack([edges[:-1], edges[1:]], axis=1), **within)
        least = earliest(pieces, start, end, time, TICK * PIECES / (motion.duration - time))
        made = retime(kernel, dynamic, motion, robot.limits, time=time, clock=time, hold=HOLD, horizon=HORIZON)
        assert (made.trajectory is None) == bool(made.reason)
        if made.trajectory is not None:
            assert_kept(robot, motion, time, made.trajectory, made.deviation)
            until = made.trajectory.duration + HOLD
            open_ones += bool(prove_motion(kernel, dynamic, made.trajectory, 0.0, until, clock=time))
        if math.isinf(least):
            continue
        possible += 1
        if made.trajectory is not None:
            found += 1
            ratios.append(made.trajectory.duration / max(least, motion.duration - time))
    assert found >= 4 and open_ones == 0  # the grid knows no accelerations: some of its ways there are not
    assert np.median(ratios) <= 1.15
    if speed == 1.0:  # else it may hurry, and the grid may not
        assert min(ratios) >= 0.98


def test_a_motion_that_meets_nothing_stays_as_it_is(
    kernel: Kernel, robot: Robot, swing: Trajectory, quarter: Limits
) -> None:
    dynamic = DynamicObstacles(
        [Obstacle(name="dynamic_obstacle", box=(0.1, 0.1, 0.1), position=(0.0, 0.0, 3.0), velocity=(0.1, 0.0, 0.0))]
    )
    for time in (0.0, 0.7):
        made = retime(kernel, dynamic, swing, quarter, time=time)
        assert made.trajectory is not None and made.deviation == 0.0
        assert made.trajectory.duration == pytest.approx(swing.duration - time, abs=1e-9)
        assert_kept(robot, swing, time, made.trajectory, 0.0)


def test_a_place_next_to_a_knot_gives_one_knot(
    kernel: Kernel, robot: Robot, swing: Trajectory, quarter: Limits
) -> None:
    dynamic = DynamicObstacles(
        [Obstacle(name="dynamic_obstacle", box=(0.1, 0.1, 0.1), position=(0.0, 0.0, 3.0), velocity=(0.1, 0.0, 0.0))]
    )
    for knot in swing.times[1:-1]:
        made = retime(kernel, dynamic, swing, quarter, time=float(np.nextafter(knot, 0.0)))
        assert made.trajectory is not None and np.diff(made.trajectory.times).min() > 1e-9
        assert_kept(robot, swing, float(knot), checked(made.trajectory), max(made.deviation, 1e-9))


@pytest.mark.parametrize("time", [0.0, 0.3])
def test_it_waits_for_a_dynamic_obstacle_that_crosses(
    kernel: Kernel, robot: Robot, swing: Trajectory, quarter: Limits, time: float
) -> None:
    middle = hand(kernel, swing, swing.duration / 2.0)
    slow = np.array([0.0, 0.0, 0.15])
    dynamic = DynamicObstacles(
        [
            Obstacle(
                name="dynamic_obstacle", box=(0.1, 0.1, 0.1), position=tuple(middle - slow * 1.2), velocity=tuple(slow)
            )
        ]
    )
    assert prove_motion(kernel, dynamic, swing)
    made = retime(kernel, dynamic, swing, quarter, time=time, clock=time)
    assert made.trajectory is not None and made.trajectory.duration > swing.duration - time + 0.2
    assert_kept(robot, swing, time, made.trajectory, made.deviation)
    assert checked(made.trajectory).use(quarter)["velocity"] <= 1.0 + 1e-9
    assert not prove_motion(kernel, dynamic, made.trajectory, 0.0, made.trajectory.duration + 1.0, clock=time)


@pytest.mark.parametrize("time", [0.0, 0.5])
def test_without_dynamic_obstacles_a_slow_motion_hurries(
    kernel: Kernel, robot: Robot, swing: Trajectory, time: float
) -> None:
    made = retime(kernel, DynamicObstacles([]), swing, robot.limits, time=time)
    assert made.trajectory is not None and made.trajectory.duration < 0.6 * (swing.duration - time)
    assert_kept(robot, swing, time, made.trajectory, made.deviation)


def test_it_hurries_before_a_dynamic_obstacle(kernel: Kernel, robot: Robot, swing: Trajectory) -> None:
    late = 0.75 * swing.duration
    there = hand(kernel, swing, late)
    base = kernel.joint_frames(swing(late)[None])[1][0][1]
    inwards = -0.3 * (there - base) * np.array([1.0, 1.0, 0.0]) / np.linalg.norm((there - base)[:2])
    dynamic = DynamicObstacles(
        [
            Obstacle(
                name="dynamic_obstacle",
                box=(0.1, 0.1, 0.1),
                position=tuple(there - inwards * late),
                velocity=tuple(inwards),
            )
        ]
    )
    assert prove_motion(kernel, dynamic, swing)
    made = retime(kernel, dynamic, swing, robot.limits, time=0.2, clock=0.2, hold=0.1)
    assert made.trajectory is not None and made.trajectory.duration < swing.duration - 0.2
    assert_kept(robot, swing, 0.2, made.trajectory, made.deviation)
    assert not prove_motion(kernel, dynamic, made.trajectory, clock=0.2)


def test_reasons(kernel: Kernel, robot: Robot, swing: Trajectory) -> None:
    def among(place: np.ndarray, **more: float) -> str:
        dynamic = DynamicObstacles([Obstacle(name="dynamic_obstacle", box=(0.1, 0.1, 0.1), position=tuple(place))])
        made = retime(kernel, dynamic, swing, robot.limits, **more)
        assert made.trajectory is None
        return made.reason

    ends = [kernel.joint_frames(q[None])[1][0] for q in swing.positions[[0, -1]]]
    farthest = np.linalg.norm(ends[0] - ends[1], axis=1).argmax()
    assert "the end is not free" in among(ends[1][farthest])
    assert "the start is blocked" in among(ends[0][farthest])
    assert "no speed along the path" in among(hand(kernel, swing, swing.duration / 2.0))
    with pytest.raises(ParameterError, match="time"):
        among(np.zeros(3), time=math.nan)
    short = Trajectory(np.zeros(1), np.zeros((1, 2)), np.zeros((1, 2)), np.zeros((1, 2)), ("a", "b"))
    with pytest.raises(ParameterError, match="joints"):
        retime(kernel, DynamicObstacles([]), short, robot.limits)


def test_no_dynamic_obstacles_and_a_motion_that_has_ended(
    kernel: Kernel, robot: Robot, swing: Trajectory, quarter: Limits
) -> None:
    made = retime(kernel, DynamicObstacles([]), swing, quarter)
    assert made.trajectory is not None and made.trajectory.duration == pytest.approx(swing.duration)
    ended = retime(kernel, DynamicObstacles([]), swing, robot.limits, time=swing.duration)
    assert ended.trajectory is not None and ended.trajectory.duration == 0.0
