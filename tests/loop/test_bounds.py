"""Bounds that contain obstacles: distances against points drawn in both bodies, and what contradicts a bound."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from commanded import SETTINGS, ZERO
from hypothesis import given, settings
from hypothesis import strategies as st
from loops import PROBLEM, ByHand, line

from apex_ompl import Loop, problems
from apex_ompl.collision import CollisionChecker
from apex_ompl.loop.bounds import change, gap, protrusion
from apex_ompl.loop.cycle import unexpected
from apex_ompl.loop.environment import Observation
from apex_ompl.loop.tracking import Tracker, TrackSettings
from apex_ompl.problems.suite_robot import robot as suite_robot
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.types import Array

KERNEL = CollisionChecker(suite_robot()).kernel
SHAPES = (
    {"box": (0.2, 0.1, 0.3)},
    {"sphere": {"radius": 0.1}},
    {"cylinder": {"radius": 0.1, "length": 0.3}},
    {"capsule": {"radius": 0.06, "length": 0.2}},
)


def body(rng: np.random.Generator, at: Any = (0.0, 0.0, 0.0)) -> Obstacle:
    turn = pin.Quaternion(pin.exp3(rng.uniform(-1.5, 1.5, 3)))
    x, y, z, w = turn.coeffs()
    place = tuple(map(float, np.add(at, rng.uniform(-0.05, 0.05, 3))))
    shape = SHAPES[rng.integers(len(SHAPES))]
    return Obstacle.model_validate({"name": "one", **shape, "position": place, "orientation": (x, y, z, w)})


def inside(one: Obstacle, points: Array) -> Array:
    """Whether points in the frame of a body are in it, by its definition."""
    if one.box is not None:
        return np.asarray((np.abs(points) <= np.array(one.box) / 2.0).all(axis=1))
    radial = np.linalg.norm(points[:, :2], axis=1)
    if one.sphere is not None:
        return np.asarray(np.linalg.norm(points, axis=1) <= one.sphere.radius)
    if one.cylinder is not None:
        return np.asarray((radial <= one.cylinder.radius) & (np.abs(points[:, 2]) <= one.cylinder.length / 2.0))
    assert one.capsule is not None
    above = np.maximum(np.abs(points[:, 2]) - one.capsule.length / 2.0, 0.0)
    return np.asarray(np.hypot(radial, above) <= one.capsule.radius)


def drawn(one: Obstacle, rng: np.random.Generator, count: int = 4000) -> Array:
    """Points in a body, in the world."""
    points = rng.uniform(-0.25, 0.25, (40 * count, 3))
    points = points[inside(one, points)][:count]
    return np.asarray(points @ one.pose[:3, :3].T + one.pose[:3, 3])


@settings(max_examples=15)
@given(st.integers(0, 10**6))
def test_distances_are_those_of_points_in_both_bodies(seed: int) -> None:
    rng = np.random.default_rng(seed)
    first, second = body(rng), body(rng, (0.6, 0.0, 0.0))
    a, b = drawn(first, rng), drawn(second, rng)
    nearest = min(np.linalg.norm(b - point, axis=1).min() for point in a)
    assert gap(first, second) <= nearest + 1e-6 and gap(first, second) == pytest.approx(nearest, abs=0.05)
    far = max(np.linalg.norm(b - point, axis=1).min() for point in a)
    assert protrusion(first, second) == pytest.approx(far, abs=0.05)
    assert gap(first, first) == 0.0 and protrusion(first, first) < 1e-3


@settings(max_examples=15)
@given(st.integers(0, 10**6))
def test_a_body_protrudes_no_less_than_its_points(seed: int) -> None:
    rng = np.random.default_rng(seed)
    inner, bound = body(rng), body(rng)
    local = (drawn(inner, rng) - bound.pose[:3, 3]) @ bound.pose[:3, :3]
    outside = local[~inside(bound, local)]
    assert (protrusion(inner, bound) > 0.0) or not len(outside)
    if bound.box is not None and len(outside):
        beyond = np.linalg.norm(np.maximum(np.abs(outside) - np.array(bound.box) / 2.0, 0.0), axis=1)
        assert protrusion(inner, bound) >= beyond.max() - 1e-6


def wall(depth: float, stamp: float, *, bounds: bool = True, x: float = 0.5) -> Observation:
    """A bound whose front is at x, and which is so deep."""
    one = Obstacle(name="seen", box=(depth, 0.2, 0.2), position=(x + depth / 2.0, 0.0, 0.5))
    return Observation(stamp, stamp, (one,), {"seen": 0.003}, bounds=bounds)


def tracker() -> Tracker:
    return Tracker(KERNEL, TrackSettings(), error=0.003, fastest=0.2)


@pytest.mark.parametrize("bounds", [True, False])
def test_a_bound_that_shrinks_as_more_is_seen_contradicts_nothing(bounds: bool) -> None:
    known = tracker()
    for k in range(20):
        assert not known.take(wall(0.3, k / 30.0, bounds=bounds)).doubted
    speed = np.abs(known.tracks["seen"].velocity).max()
    assert bool(known.take(wall(0.12, 20 / 30.0, bounds=bounds)).doubted) is not bounds
    if bounds:
        assert np.abs(known.tracks["seen"].velocity).max() == speed and known.tracks["seen"].seen == 21
        cube = Obstacle(name="cube", box=(0.1, 0.1, 0.1), position=(0.56, 0.0, 0.5))
        assert not unexpected(known, [cube], 20 / 30.0, named=False)
        assert unexpected(known, [cube.model_copy(update={"position": (0.45, 0.0, 0.5)})], 20 / 30.0, named=False)
        assert not unexpected(known, [cube.model_copy(update={"position": (0.45, 0.0, 0.5)})], 1.2, named=False)


def test_bounds_that_are_apart_contradict_each_other() -> None:
    known = tracker()
    known.take(wall(0.1, 0.0))
    assert not known.take(wall(0.1, 0.1, x=0.62)).doubted  # 20 mm can be gone, and 6 mm are errors
    known = tracker()
    known.take(wall(0.1, 0.0))
    assert known.take(wall(0.1, 0.1, x=0.63)).doubted and len(known.doubted) == 1
    assert known.tracks["seen"].bounds and known.doubted[0].bounds


def test_a_bound_that_moves_has_a_velocity() -> None:
    known = tracker()
    for k in range(40):
        known.take(wall(0.1, k / 30.0, x=0.5 + 0.15 * k / 30.0))
    assert known.tracks["seen"].velocity == pytest.approx([0.15, 0.0, 0.0], abs=1e-3)


def test_a_bound_that_moves_while_it_shrinks_has_a_velocity_that_its_deviation_holds() -> None:
    rng, off = np.random.default_rng(3), []
    for _ in range(40):
        known, speed = tracker(), rng.uniform(-0.15, 0.15)
        for k in range(8):
            depth, x = 0.1 + 0.05 * 0.5**k, 0.5 + speed * k / 30.0 + rng.normal(0.0, 0.001)
            known.take(wall(depth, k / 30.0, x=x))
        track = known.tracks["seen"]
        off.append((track.velocity[0] - speed) / np.sqrt(track.covariance[1, 1]))
    assert np.abs(off).max() < 3.0 and np.sqrt(track.covariance[1, 1]) < 0.06  # of .2 when it was new


@settings(max_examples=15)
@given(st.integers(0, 10**6))
def test_centers_of_bounds_of_one_body_differ_by_no_more_than_their_change_where_an_end_is_shared(seed: int) -> None:
    rng = np.random.default_rng(seed)
    first = rng.uniform(0.05, 0.5, 3)
    second = first * rng.uniform(0.5, 1.0, 3)
    side = rng.choice([-1.0, 1.0], 3)
    boxes = [Obstacle(name="box", box=tuple(size), position=tuple(side * size / 2.0)) for size in (first, second)]
    shift = np.abs(np.subtract(boxes[0].position, boxes[1].position)).max()
    assert change(*boxes) == pytest.approx(shift) and change(boxes[0], boxes[0]) == 0.0


def test_a_loop_takes_bounds() -> None:
    def doubted(loop: Loop) -> int:
        return sum(event.kind == "place doubted" for event in loop.events)

    with Loop(problems.load(PROBLEM), ByHand(line), settings=SETTINGS, process=False) as loop:
        for k, (seen, more) in enumerate(((wall(0.3, 0.0), 0), (wall(0.12, 0.0), 0), (wall(0.12, 0.0, x=0.9), 1))):
            loop.observe(ZERO + 0.01 * k, seen.seen, bounds=True)
            loop.step(ZERO + 0.01 * k)
            assert doubted(loop) == more
