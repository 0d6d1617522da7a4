"""Errors of single observations, and clouds of points: where obstacles may be, and what robots do among them."""

from __future__ import annotations

import threading
import time
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from commanded import SETTINGS, ZERO, Robot, judged
from hypothesis import given, settings
from hypothesis import strategies as st
from loops import FAR, PROBLEM, ByHand, crossing, line, setup_of, world_of

from apex_ompl import Loop, problems
from apex_ompl.collision import CollisionChecker
from apex_ompl.errors import ParameterError
from apex_ompl.loop.environment import Observation
from apex_ompl.loop.result import Outcome
from apex_ompl.loop.tracking import Tracker, TrackSettings, error_fault, largest_error
from apex_ompl.moving.dynamic_obstacles import clearance_in_time
from apex_ompl.problems.suite_robot import robot as suite_robot
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.scene.scripts import standing
from apex_ompl.timing.rests import is_at_rest
from apex_ompl.types import Array

NAN = float("nan")
KERNEL = CollisionChecker(suite_robot()).kernel
BALL = Obstacle(name="ball", sphere={"radius": 0.05}, position=(1.0, 0.0, 0.5))


def look(stamp: float, place: Any, error: Any = None) -> Observation:
    body = BALL.model_copy(update={"position": tuple(map(float, place))})
    return Observation(stamp, stamp, (body,), {} if error is None else {"ball": error})


def bounded() -> Tracker:
    return Tracker(KERNEL, TrackSettings(), error=0.02, fastest=0.4, memory=3.0)


@settings(max_examples=30)
@given(st.integers(0, 10**6))
def test_the_error_of_a_covariance_is_three_standard_deviations_of_its_longest_axis(seed: int) -> None:
    rng = np.random.default_rng(seed)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    sigma = rng.uniform(0.0, 0.05, 3)
    covariance = turn @ np.diag(sigma**2) @ turn.T
    assert error_fault(covariance) == "" and largest_error(covariance) == pytest.approx(3.0 * sigma.max())
    directions = rng.normal(size=(200, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    widths = 3.0 * np.sqrt(np.einsum("ni,ij,nj->n", directions, covariance, directions))
    assert widths.max() <= largest_error(covariance) + 1e-12


def test_a_velocity_counts_where_it_is_known_better_than_by_places() -> None:
    known, told = bounded(), (0.02, -0.04, 0.03)
    known.take(replace(look(0.0, (1.0, 0.0, 0.5)), velocities={"ball": (told, 0.5)}))
    assert not known.tracks["ball"].velocity.any()  # a new one has .2 m/s
    known.take(replace(look(0.05, (1.0, 0.0, 0.5)), velocities={"ball": (told, 0.03)}))
    track = known.tracks["ball"]
    assert track.velocity == pytest.approx(told) and track.growth(known.settings)[1] == pytest.approx(0.03)
    for k in range(2, 40):
        known.take(replace(look(0.05 * k, (1.0, 0.0, 0.5), 0.001), velocities={"ball": (told, 0.03)}))
    assert np.abs(known.tracks["ball"].velocity).max() < 0.02  # the places say that it stands


@pytest.mark.parametrize(
    ("velocity", "words"),
    [
        (0.1, "is no velocity"), (((0.1, 0.0), 0.1), "the shape"), (((NAN, 0.0, 0.0), 0.1), "not finite"),
        (((0.1, 0.0, 0.0), -0.1), "negative"), (((0.1, 0.0, 0.0), "fast"), "is no velocity"),
    ],
)  # fmt: skip
def test_a_velocity_that_is_none_refuses_an_observation(velocity: Any, words: str) -> None:
    known = bounded()
    refused = known.take(replace(look(0.0, (1.0, 0.0, 0.5)), velocities={"ball": velocity})).refused
    assert refused.startswith("the velocity of ball") and words in refused and not known.tracks
    assert "has no obstacle" in known.take(Observation(0.0, 0.0, (), velocities={"ball": ((0, 0, 0), 0.1)})).refused


@pytest.mark.parametrize(
    ("error", "words"),
    [(NAN, "not finite"), (-0.01, "negative"), (np.full((3, 3), NAN), "not finite"),
     (np.diag([1e-4, 1e-4, -1e-5]), "semidefinite"), (np.array([[1, 2, 0], [0, 1, 0], [0, 0, 1]]), "symmetric"),
     (np.zeros(2), "shape"), ("wide", "no number")],
)  # fmt: skip
def test_an_observation_with_an_error_that_is_none_is_refused(error: Any, words: str) -> None:
    tracker = bounded()
    assert words in tracker.take(look(0.0, (0.0, 0.0, 0.0), error)).refused and not tracker.tracks
    assert tracker.take(Observation(0.0, 0.0, (), {"ball": 0.01})).refused == "the error of ball has no obstacle"


def test_the_error_of_an_observation_counts_in_place_of_the_assumed_one() -> None:
    tracker = bounded()
    tracker.take(look(0.0, (1.0, 0.0, 0.0), 0.1))
    assert tracker.reachable(0.02, 0.4, 0.005).arrays.growth[0] == pytest.approx((0.105, 0.4))
    tracker.take(look(0.1, (1.0, 0.0, 0.0), np.diag([1e-4, 4e-4, 1e-4])))
    assert tracker.reachable(0.02, 0.4).arrays.growth[0, 0] == pytest.approx(0.06)
    tracker.take(look(0.2, (1.0, 0.0, 0.0)))
    assert tracker.reachable(0.02, 0.4).arrays.growth.tolist() == [[0.02, 0.4]]
    assert tracker.predicted(0.0).arrays.growth[0, 0] > bounded_after(0.001).predicted(0.0).arrays.growth[0, 0]


def bounded_after(error: float) -> Tracker:
    tracker = bounded()
    for stamp in (0.0, 0.1, 0.2):
        tracker.take(look(stamp, (1.0, 0.0, 0.0), error))
    return tracker


def test_the_look_that_leaves_most_room_may_be_an_old_one_with_a_small_error() -> None:
    tracker, q = bounded(), suite_robot().home
    tracker.take(look(0.0, (1.0, 0.0, 0.5), 0.001))
    tracker.take(look(0.05, (1.0, 0.0, 0.5), 0.1))
    found = tracker.reachable(0.02, 0.4, q=q).arrays
    assert found.growth[0, 0] == 0.001 and found.stamp[0] == 0.0
    tracker.take(look(0.06, (1.0, 0.0, 0.5), 0.002))
    assert tracker.reachable(0.02, 0.4, q=q).arrays.stamp[0] == 0.06


def test_a_place_is_doubted_by_the_errors_of_both_looks() -> None:
    for error, doubted in ((0.05, False), (0.01, True)):
        tracker = bounded()
        tracker.take(look(0.0, (1.0, 0.0, 0.0), error))
        assert bool(tracker.take(look(0.1, (1.0, 0.1, 0.0), error)).doubted) is doubted  # 0.04 m can be gone


@settings(max_examples=25)
@given(st.integers(0, 10**6))
def test_obstacles_are_within_what_they_can_reach_from_looks_with_errors_of_their_own(seed: int) -> None:
    rng = np.random.default_rng(seed)
    ways = rng.normal(size=(100, 3))
    ways *= 0.01 * 0.4 / np.linalg.norm(ways, axis=1, keepdims=True)
    truth = (1.0, 0.0, 0.5) + np.vstack([np.zeros(3), np.cumsum(ways, axis=0)])
    tracker = bounded()
    for k in range(0, 101, 3):
        error = rng.choice([0.0, 0.01, 0.1])
        off = rng.normal(size=3)
        own = error if rng.random() < 0.5 else np.eye(3) * (error / 3.0) ** 2
        place = truth[k] + error * rng.random() * off / np.linalg.norm(off)
        assert not tracker.take(look(0.01 * k, place, own)).doubted
        a = tracker.reachable(0.02, 0.4, q=suite_robot().home).arrays
        for j in range(k, min(k + 20, 101)):
            reach = a.growth[0, 0] + a.growth[0, 1] * (0.01 * j - a.stamp[0])
            assert np.linalg.norm(a.place[0] - truth[j]) <= reach + 1e-9


def surface(box: Obstacle, spacing: float = 0.02) -> Array:
    """Points on the faces of a box, of which each is within half of the spacing times the root of two."""
    assert box.box is not None
    half = np.array(box.box) / 2.0
    rows = []
    for axis in range(3):
        first, second = (np.linspace(-half[k], half[k], int(2 * half[k] / spacing) + 2) for k in range(3) if k != axis)
        for side in (-half[axis], half[axis]):
            plane = np.stack(np.meshgrid(first, second), axis=-1).reshape(-1, 2)
            rows.append(np.insert(plane, axis, side, axis=1))
    return np.vstack(rows) + box.position


def followed(loop: Loop, world: Any, robot: Robot, look: Any) -> None:
    """Steps of a loop; ``look`` observes at each third of them."""
    for k in range(600):
        time = k * loop.settings.period
        world.advance(time, robot.state(ZERO + time))
        if k % 3 == 0:
            look(time)
        command = loop.step(ZERO + time, robot.state(ZERO + time))
        if command is not None:
            robot.send(command)
        if loop.outcome is not None:
            return


def robot_at_start() -> Robot:
    setup = setup_of(PROBLEM)
    return Robot(setup.start.copy(), setup.robot.joint_names)


def test_the_reachable_set_of_a_cloud_is_its_points_inflated() -> None:
    """Distances beside those to each ball by itself."""
    problem, rng = problems.load(PROBLEM), np.random.default_rng(2)
    with Loop(problem, ByHand(line), settings=SETTINGS, process=False) as loop:
        start = problem.start_state(loop.joint_names)
        points = (
            suite_robot().link_pose(start, "left_hand_palm")[:3, 3] + (0.0, 0.0, 0.5) + rng.uniform(-0.1, 0.1, (60, 3))
        )
        loop.observe(ZERO, clouds={"camera": points}, radius=0.01)
        loop.step(ZERO, start)
        tracker = loop._control.tracker
        reach = tracker.reachable(*loop.settings.assumed)
        kernel = loop._control.context.kernel
        for age in (0.0, 0.3):
            found = clearance_in_time(kernel, reach, start[None], [age])[0][0]
            balls = Tracker(kernel, error=0.024, fastest=0.4)
            each = []
            for point in points:
                balls.tracks.clear()
                body = Obstacle(name="ball", sphere={"radius": 0.01}, position=tuple(point.tolist()))
                balls.take(Observation(0.0, 0.0, (body,)))
                each.append(clearance_in_time(kernel, balls.reachable(0.024, 0.4), start[None], [age])[0][0])
            assert min(each) - 0.02 <= found <= min(each) + 1e-6, "sound, and not far off"


def test_a_cloud_replaces_the_last_one_of_its_camera_and_no_other() -> None:
    problem = problems.load(PROBLEM)
    with Loop(problem, ByHand(line), settings=SETTINGS, process=False) as loop:
        tracker, start = loop._control.tracker, problem.start_state(loop.joint_names)

        def step(k: int, **given: Any) -> set[str]:
            loop.observe(ZERO + 0.01 * k, **given)
            loop.step(ZERO + 0.01 * k, start)
            return set(tracker.tracks)

        far = np.full((3, 3), 2.0)
        assert step(0, clouds={"left": far, "right": far}) == {"left", "right"}
        first = tracker.tracks["left"].shape
        assert step(1, clouds={"left": far + 0.5}, objects=[standing(FAR)]) == {"left", "right", "far"}
        assert tracker.tracks["left"].shape != first and len(tracker.tracks["left"].looks) == 1
        assert step(2, clouds={"left": np.empty((0, 3))}) == {"right", "far"}
        assert step(3, clouds={"right": np.full((2, 3), NAN)}) == {"right", "far"}
        refused = [event.data["why"] for event in loop.events if event.kind == "observation refused"]
        assert refused == ["the place of right is not finite"]
        assert step(4, clouds={"right": np.empty((0, 3))}, errors={"right": 0.01}) == {"far"}
        for bad, why in (
            ({"clouds": {"left": np.zeros((2, 2))}}, r"clouds: expected an array of shape \(N, 3\) for left"),
            ({"clouds": far}, "clouds: expected a mapping by names"), ({"errors": 0.01}, "errors: expected a mapping"),
        ):  # fmt: skip
            with pytest.raises(ParameterError, match=why):
                loop.observe(ZERO, **bad)


def test_a_cloud_is_not_forgotten() -> None:
    """An obstacle that is not seen any more is, while a camera that falls silent leaves what it saw."""
    problem = problems.load(PROBLEM)
    with Loop(problem, ByHand(line), settings=replace(SETTINGS, memory=0.5), process=False) as loop:
        start, tracker = problem.start_state(loop.joint_names), loop._control.tracker
        loop.observe(ZERO, [BALL], clouds={"camera": np.full((3, 3), 2.0)})
        loop.step(ZERO, start)
        assert set(tracker.tracks) == {"ball", "camera"}
        for k in range(1, 10):
            loop.observe(ZERO + 0.1 * k, [standing(FAR)])
            loop.step(ZERO + 0.1 * k, start)
        assert set(tracker.tracks) == {"far", "camera"}


def test_observations_come_from_any_thread() -> None:
    """Two cameras of their own threads lose no cloud, and no file of a cloud that is tracked."""
    problem, count, started = problems.load(PROBLEM), 30, threading.Barrier(3)
    with Loop(problem, ByHand(line), settings=SETTINGS, process=False) as loop:
        start, rng = problem.start_state(loop.joint_names), np.random.default_rng(0)
        clouds = rng.uniform(2.0, 2.2, (2, count, 5, 3))

        def look(k: int) -> None:
            started.wait()
            for n, cloud in enumerate(clouds[k]):
                loop.observe(ZERO + 1e-3 * n, clouds={f"camera{k}": cloud})

        cameras = [threading.Thread(target=look, args=(k,)) for k in range(2)]
        for camera in cameras:
            camera.start()
        started.wait()
        for k in range(3, 20):
            loop.step(ZERO + 0.01 * k, start)
            time.sleep(0.002)
        for camera in cameras:
            camera.join()
        loop.step(ZERO + 0.2, start)
        tracks = loop._control.tracker.tracks
        assert {name: len(track.looks) for name, track in tracks.items()} == {"camera0": 1, "camera1": 1}
        for name, track in tracks.items():
            assert track.shape.points is not None
            assert np.allclose(np.load(track.shape.points.file), clouds[int(name[-1]), -1])
        assert not [event for event in loop.events if event.kind == "observation refused"]


@pytest.mark.parametrize("method", ["no-network", "rrtconnect"])
def test_a_robot_among_clouds_is_at_rest_when_touched(method: str) -> None:
    """A depth camera sees the faces of a box that comes into the way."""
    world, robot = world_of(PROBLEM, crossing(setup_of(PROBLEM))), robot_at_start()
    limits = replace(SETTINGS, error=0.0, fastest=0.5, timeout=2.5)
    with Loop(problems.load(PROBLEM), method, settings=limits, process=False) as loop:

        def look(time: float) -> None:
            loop.observe(ZERO + time, clouds={"camera": surface(world.present(time)[0])}, radius=0.015)

        followed(loop, world, robot, look)
    report = judged(world, robot)
    assert report.contact is None or not report.contact.moved
    assert report.still_contact is None and max(report.limit_use.values()) <= 1.0 + 1e-9
    assert loop.record is not None and loop.record.unguarded == 0 and loop.record.refused == 0
    assert loop.outcome in (Outcome.REACHED, Outcome.TIMEOUT, Outcome.STUCK)


def test_a_robot_is_faster_where_observations_are_better() -> None:
    """Beside a ball whose place is known to a meter it does not start; known to a centimeter it goes."""
    found = {}
    for error in (1.0, np.eye(3) * 1e-5):
        world, robot = world_of(PROBLEM), robot_at_start()
        with Loop(problems.load(PROBLEM), ByHand(line), settings=replace(SETTINGS, timeout=1.5), process=False) as loop:
            followed(
                loop, world, robot, lambda time, e=error, to=loop: to.observe(ZERO + time, [BALL], errors={"ball": e})
            )
        found[np.ndim(error)] = loop.outcome
        assert is_at_rest(robot.done(), robot.done().duration)
    assert found == {0: Outcome.TIMEOUT, 2: Outcome.REACHED}


def test_a_covariance_that_is_none_is_refused_and_counted() -> None:
    problem = problems.load(PROBLEM)
    with Loop(problem, ByHand(line), settings=SETTINGS, process=False) as loop:
        loop.observe(ZERO, [BALL], errors={"ball": np.full((3, 3), NAN)})
        loop.step(ZERO, problem.start_state(loop.joint_names))
        loop.abort("enough")
        loop.step(ZERO + 0.01)
    assert loop.record is not None and loop.record.refused == 1
    assert any("the error of ball is not finite" in event.data.get("why", "") for event in loop.events)
