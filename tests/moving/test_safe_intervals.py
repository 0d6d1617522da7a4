"""Blocked intervals of time against samples of the distances between spheres and dynamic obstacles."""

from __future__ import annotations

import numpy as np
import pytest
from crossings import arm_motion, crossing, crossing_obstacle

from apex_ompl.collision import CollisionChecker
from apex_ompl.kernel import Kernel
from apex_ompl.kernel.compiled.moving.blocked_intervals import MOST_SPANS
from apex_ompl.moving.dynamic_obstacles import DynamicObstacles, clearance_in_time
from apex_ompl.moving.retime import Blocked, blocked
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.scene.scripts import obstacle_at
from apex_ompl.timing import Trajectory

HORIZON = 6.0
SAMPLING = 1e-3  # [s]
OVERHANG = 2e-3  # of leaves over the spheres above them, which contain the solid as well [m]
CORNER = np.sqrt(3.0) - 1.0  # what a box grown by a radius reaches beyond the points within the radius, at corners
KINDS = ("box", "sphere", "cylinder", "capsule")


@pytest.fixture(scope="module")
def kernel(robot: Robot) -> Kernel:
    return CollisionChecker(robot).kernel


def is_blocked(blocks: Blocked, place: int, times: np.ndarray) -> np.ndarray:
    spans = blocks.spans[place, : blocks.counts[place]]
    return ((times[:, None] >= spans[:, 0]) & (times[:, None] <= spans[:, 1])).any(axis=1)


def largest_leaf(kernel: Kernel) -> float:
    arrays = kernel.robot.arrays
    return float(arrays.node_radius[arrays.node_count == 0].max())


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("growth", [(0.0, 0.0), (0.01, 0.03), (0.0, 0.6)])
def test_states_are_blocked_when_spheres_meet_dynamic_obstacles(
    kernel: Kernel, robot: Robot, kind: str, growth: tuple[float, float]
) -> None:
    rng, times = np.random.default_rng(0), np.arange(0.0, HORIZON, SAMPLING)
    blocked_ones = 0
    for _ in range(4):
        motion = arm_motion(robot, rng, 0.25)
        dynamic = crossing(kernel, motion, rng, kind, growth)
        if dynamic is None:
            continue
        dynamic.update("dynamic_obstacle", stamp=float(rng.choice([-0.5, 0.0, 2.0])))
        where = np.sort(rng.uniform(0.0, motion.duration, 3))
        found = blocked(kernel, dynamic, motion, np.stack([where, where], axis=1), start=0.0, end=HORIZON)
        for place, state in enumerate(motion(where)):
            clearance = clearance_in_time(kernel, dynamic, np.tile(state, (len(times), 1)), times)[0]
            inside = is_blocked(found, place, times)
            assert inside[clearance <= -OVERHANG].all()
            blocked_ones += inside.any()
            if found.counts[place] < MOST_SPANS:  # else intervals near each other became one
                margin = growth[0] + growth[1] * HORIZON
                beyond = CORNER * (largest_leaf(kernel) + margin) if kind in ("box", "cylinder") else 0.0
                assert clearance[inside].max(initial=0.0) <= beyond + 2e-3  # 1 ms at the fastest that it may close in
    assert blocked_ones >= 3


@pytest.mark.parametrize("kind", KINDS)
def test_pieces_are_blocked_when_any_of_their_states_is(kernel: Kernel, robot: Robot, kind: str) -> None:
    rng, slack = np.random.default_rng(1), 1e-3
    touched = 0
    for _ in range(10):
        motion = arm_motion(robot, rng, 0.25)
        dynamic = crossing(kernel, motion, rng, kind, (0.005, 0.01))
        if dynamic is None:
            continue
        edges = np.linspace(0.0, motion.duration, 65)
        places = np.stack([edges[:-1], edges[1:]], axis=1)
        found = blocked(kernel, dynamic, motion, places, start=0.0, end=HORIZON, slack=slack)
        count = 4000
        where, times = rng.uniform(0.0, motion.duration, count), rng.uniform(0.0, HORIZON, count)
        states = motion(where) + rng.uniform(-slack, slack, (count, robot.dof))
        states = np.clip(states, robot.limits.lower, robot.limits.upper)
        meets = clearance_in_time(kernel, dynamic, states, times)[0] <= -OVERHANG
        piece = np.clip(np.searchsorted(edges, where, side="right") - 1, 0, 63)
        for k in np.flatnonzero(meets):
            assert found.meets(int(piece[k]), times[k], times[k])
        touched += meets.sum()
    assert touched > 20


def test_a_piece_adds_little_to_the_intervals_of_its_states(kernel: Kernel, robot: Robot) -> None:
    rng, excess = np.random.default_rng(2), []
    for _ in range(20):
        motion = arm_motion(robot, rng, 0.25)
        dynamic = crossing(kernel, motion, rng)
        if dynamic is None:
            continue
        edges = np.linspace(0.0, motion.duration, 257)
        found = blocked(kernel, dynamic, motion, np.stack([edges[:-1], edges[1:]], axis=1), start=0.0, end=HORIZON)
        middles = (edges[:-1] + edges[1:]) / 2.0
        states = blocked(kernel, dynamic, motion, np.stack([middles, middles], axis=1), start=0.0, end=HORIZON)
        long, short = (
            np.array([np.diff(b.spans[p, : b.counts[p]], axis=1).sum() for p in range(256)]) for b in (found, states)
        )
        excess.append((long - short).sum() / 256.0)
    assert np.mean(excess) < 0.1 * HORIZON / 4.0


@pytest.mark.parametrize("kind", KINDS)
def test_states_are_blocked_when_meshes_touch_dynamic_obstacles(kernel: Kernel, robot: Robot, kind: str) -> None:
    rng, times, contacts = np.random.default_rng(3), np.arange(0.0, HORIZON, SAMPLING), 0
    for _ in range(4):
        motion = arm_motion(robot, rng, 0.25)
        dynamic_obstacle = crossing_obstacle(kernel, motion, rng, kind)
        if dynamic_obstacle is None:
            continue
        dynamic, place = DynamicObstacles([dynamic_obstacle]), np.full((1, 2), rng.uniform(0.3, 0.8) * motion.duration)
        found, state = blocked(kernel, dynamic, motion, place, start=0.0, end=HORIZON), motion(place[0, 0])
        checker = CollisionChecker(robot, [dynamic_obstacle])
        near = clearance_in_time(kernel, dynamic, np.tile(state, (len(times), 1)), times)[0] <= 0.0
        for time in rng.permutation(times[near])[:100]:
            checker.move("dynamic_obstacle", obstacle_at(dynamic_obstacle, time).position)
            if not checker.is_free(state):
                contacts += 1
                assert found.meets(0, time, time)
    assert contacts > 20


def test_far_dynamic_obstacles_block_nothing(kernel: Kernel, robot: Robot) -> None:
    motion: Trajectory = arm_motion(robot, np.random.default_rng(4), 0.25)
    dynamic = DynamicObstacles(
        [Obstacle(name="dynamic_obstacle", box=(0.1, 0.1, 0.1), position=(0.0, 0.0, 5.0), velocity=(0.0, 0.2, 0.0))]
    )
    edges = np.linspace(0.0, motion.duration, 33)
    found = blocked(kernel, dynamic, motion, np.stack([edges[:-1], edges[1:]], axis=1), start=0.0, end=HORIZON)
    assert not found.counts.any()
