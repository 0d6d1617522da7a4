"""Estimates of obstacles that move: the filter against matrices written out, and where obstacles may be."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from apex_ompl.collision import CollisionChecker
from apex_ompl.loop.environment import Observation
from apex_ompl.loop.tracking import LEAST, MOST_DOUBTED, MOST_TRACKS, Track, Tracker, TrackSettings
from apex_ompl.moving.dynamic_obstacles import DynamicObstacles, allowed_rows, clearance_in_time
from apex_ompl.problems.suite_robot import robot as suite_robot
from apex_ompl.scene.bodies import Obstacle

RATE = 30.0
NAN, INF = float("nan"), float("inf")
BOX = Obstacle(name="box", box=(0.1, 0.1, 0.1), position=(0.0, 0.0, 0.0))
KERNEL = CollisionChecker(suite_robot()).kernel
seeds = st.integers(0, 10**6)


def at(place: Any, name: str = "box") -> Obstacle:
    return BOX.model_copy(update={"name": name, "position": tuple(map(float, place))})


def look(stamp: float, place: Any, late: float = 0.05) -> Observation:
    return Observation(stamp, stamp + late, (at(place),))


def tracked(*looks: Observation, **parameters: float) -> Tracker:
    tracker = Tracker(KERNEL, TrackSettings(**parameters))
    for one in looks:
        tracker.take(one)
    return tracker


def drawn(seed: int, count: int = 25) -> tuple[np.ndarray, np.ndarray]:
    """Stamps and places of an obstacle at constant velocity, some looks missed."""
    rng = np.random.default_rng(seed)
    stamps = np.sort(rng.choice(3 * count, count, replace=False)) / RATE
    velocity, error = rng.uniform(-0.15, 0.15, 3), np.clip(rng.normal(size=(count, 3)), -1.5, 1.5)
    return stamps, rng.uniform(-1, 1, 3) + stamps[:, None] * velocity + 0.008 * error


def same(one: Track, other: Track) -> bool:
    values = [(t.shape, t.stamp, t.seen, *t.place, *t.velocity, *t.covariance.ravel()) for t in (one, other)]
    return values[0] == values[1]


@settings(max_examples=20)
@given(seeds)
def test_filters_are_those_of_six_dimensions(seed: int) -> None:
    stamps, places = drawn(seed)
    given_ = TrackSettings()
    eye, none = np.eye(3), np.zeros((3, 3))
    observe, spread = np.block([eye, none]), (given_.noise**2 + 1e-12) * eye
    x = np.append(places[0], np.zeros(3))
    cov = np.block([[given_.noise**2 * eye, none], [none, given_.speed**2 * eye]])
    for dt, z in zip(np.diff(stamps), places[1:], strict=True):
        forward = np.block([[eye, dt * eye], [none, eye]])
        push = given_.power * np.block([[dt**3 / 3 * eye, dt**2 / 2 * eye], [dt**2 / 2 * eye, dt * eye]])
        x, cov = forward @ x, forward @ cov @ forward.T + push
        gain = cov @ observe.T @ np.linalg.inv(observe @ cov @ observe.T + spread)
        x = x + gain @ (z - observe @ x)
        rest = np.eye(6) - gain @ observe
        cov = rest @ cov @ rest.T + gain @ spread @ gain.T  # Joseph's form, which is not the one of the filter
    track = tracked(*map(look, stamps, places)).tracks["box"]
    assert track.seen == len(stamps) and track.stamp == stamps[-1]
    np.testing.assert_allclose(np.append(track.place, track.velocity), x, rtol=0, atol=1e-9)
    np.testing.assert_allclose(np.kron(track.covariance, eye), cov, rtol=1e-7, atol=1e-12)


@settings(max_examples=20)
@given(seeds)
def test_without_noise_of_the_acceleration_filters_are_least_squares(seed: int) -> None:
    stamps, places = drawn(seed)
    track = tracked(*map(look, stamps, places), power=0.0).tracks["box"]
    since, noise = stamps - stamps[-1], TrackSettings.noise
    rows = np.stack([np.ones_like(since), since], axis=1) / noise
    prior = np.array([[0.0, 1.0 / TrackSettings.speed]])
    found = np.linalg.lstsq(np.vstack([rows, prior]), np.vstack([places / noise, np.zeros((1, 3))]), rcond=None)[0]
    np.testing.assert_allclose([track.place, track.velocity], found, atol=1e-6)


@pytest.mark.parametrize("velocity", [(0.2, 0.0, 0.0), (-0.2, 0.2, 0.1), (0.0, 0.0, 0.0)])
def test_constant_velocities_are_found(velocity: tuple[float, ...]) -> None:
    stamps = np.arange(60) / RATE
    tracker = tracked(*(look(t, np.multiply(velocity, t)) for t in stamps))
    track = tracker.tracks["box"]
    assert np.abs(track.velocity - velocity).max() < 2e-3 and track.seen == 60
    then = tracker.predicted(0.0).at(stamps[-1] + 1.0)["box"]
    np.testing.assert_allclose(then, np.multiply(velocity, stamps[-1] + 1.0), atol=5e-3)
    np.testing.assert_allclose(tracker.predicted(0.0, "still").at(9.0)["box"], np.multiply(velocity, stamps[-1]))
    grown, growing = track.growth(tracker.settings)
    assert 0.0 < grown < 2.0 * TrackSettings.noise and 0.0 < growing <= TrackSettings.most


def test_turns_begin_the_velocity_anew() -> None:
    before = [look(k / RATE, (0.3 * k / RATE, 0.0, 0.0)) for k in range(30)]
    tracker = tracked(*before, look(1.0, (0.3, 0.5, 0.0)))
    fresh = Track.new(at((0.3, 0.5, 0.0)), 1.0, tracker.settings)
    assert same(tracker.tracks["box"], fresh) and not fresh.velocity.any()
    for k in range(1, 31):
        tracker.take(look(1.0 + k / RATE, (0.3, 0.5 - 0.3 * k / RATE, 0.0)))
    assert np.abs(tracker.tracks["box"].velocity - (0.0, -0.3, 0.0)).max() < 0.02
    assert tracker.tracks["box"].seen == 31


@given(st.lists(st.integers(0, 20), min_size=1, max_size=25), seeds)
def test_what_is_older_says_nothing(order: list[int], seed: int) -> None:
    stamps, places = drawn(seed)
    looks = [look(stamps[k], places[k]) for k in order]
    newer = [k for n, k in enumerate(order) if k > max(order[:n], default=-1)]
    one, other = tracked(*looks), tracked(*(look(stamps[k], places[k]) for k in newer))
    assert same(one.tracks["box"], other.tracks["box"]) and one.last == other.last == stamps[max(order)]


def test_how_late_an_observation_is_received_does_not_matter() -> None:
    stamps, places = drawn(3)
    soon, late = (tracked(*(look(t, p, by) for t, p in zip(stamps, places, strict=True))) for by in (0.0, 0.7))
    assert same(soon.tracks["box"], late.tracks["box"])


@pytest.mark.parametrize("bad", [(NAN, 0.0, 0.0), (0.0, INF, 0.0), (0.0, 0.0, -INF)])
def test_looks_with_places_that_are_not_finite_are_refused_whole(bad: tuple[float, ...]) -> None:
    stamps, places = drawn(1)
    good = list(map(look, stamps, places))
    one = tracked(*good[:5], look(stamps[4] + 0.01, bad), *good[5:])
    assert same(one.tracks["box"], tracked(*good).tracks["box"])
    tracker = Tracker(KERNEL, awaited={"box", "other"})
    taken = tracker.take(Observation(0.0, 0.0, (at(bad), at((1.0, 0.0, 0.0), "other"))))
    assert taken.refused == "the place of box is not finite"
    assert not tracker.tracks and tracker.last == -INF and tracker.awaited == {"box", "other"}


@pytest.mark.parametrize(
    ("seen", "stamp", "words"),
    [((BOX, BOX), 1.0, "a name twice"), ((BOX,), 1.2, "0.2 s in the future"),
     (tuple(at((0, 0, 0), f"box_{k}") for k in range(MOST_TRACKS + 1)), 1.0, f"more than {MOST_TRACKS} obstacles"),
     ((Obstacle(name="floor", half_space={"normal": (0, 0, 1)}),), 1.0, "no bounds")],
)  # fmt: skip
def test_looks_that_cannot_be_true_are_refused(seen: tuple[Obstacle, ...], stamp: float, words: str) -> None:
    tracker = tracked(look(0.9, (1.0, 0.0, 0.0)))
    before = (dict(tracker.tracks), tracker.last)
    assert words in tracker.take(Observation(stamp, stamp, seen), now=1.0).refused
    assert (dict(tracker.tracks), tracker.last) == before
    assert not tracker.take(look(0.95, (1.0, 0.0, 0.0)), now=1.0).refused, "later looks are taken"


def bounded(fastest: float = 0.4, error: float = 0.024, memory: float = 3.0) -> Tracker:
    return Tracker(KERNEL, error=error, fastest=fastest, memory=memory)


def test_a_place_that_cannot_be_does_not_replace_the_last_one() -> None:
    """Both count until a later look tells, whichever of them it confirms."""
    for true in ((0.0, 0.0, 0.0), (1e9, 0.0, 0.0)):
        tracker = bounded()
        for k in range(5):
            assert not tracker.take(look(k / RATE, (0.0, 0.0, 0.0))).doubted
        assert "box was 1e+09 m away" in tracker.take(look(5 / RATE, (1e9, 0.0, 0.0))).doubted[0]
        places = [place[0] for place in tracker.reachable(0.024, 0.4).at(5 / RATE).values()]
        assert sorted(places) == [0.0, 1e9]
        assert not tracker.take(look(6 / RATE, true)).doubted
        assert not tracker.doubted and tracker.tracks["box"].shape.position == true
        assert tracker.reachable(0.024, 0.4).names == ("box",)


def test_places_that_jump_for_ever_are_few() -> None:
    tracker = bounded()
    for k in range(100):
        assert len(tracker.take(look(k / RATE, (10.0 * k, 0.0, 0.0))).doubted) == (k > 0)
    kept = [track.shape.position[0] for track in tracker.doubted]
    assert len(kept) == MOST_DOUBTED and kept[0] == 0.0 and kept[-1] == 980.0


def test_obstacles_are_forgotten_that_were_looked_for_and_not_seen() -> None:
    """And no others: a sensor that is silent forgets nothing."""
    tracker = bounded(memory=0.5)
    tracker.take(look(0.0, (0.0, 0.0, 0.0)))
    tracker.take(Observation(9.0, 9.0, ()))
    assert set(tracker.tracks) == {"box"}, "silence for 9 s"
    stamps = 9.0 + np.arange(1, 31) / RATE
    known = []
    for stamp in stamps:
        tracker.take(Observation(stamp, stamp, ()))
        known.append("box" in tracker.tracks)
    gone = stamps[known.index(False)] - 9.0
    assert gone == pytest.approx(0.5 - 0.1, abs=1.5 / RATE)


def test_a_new_name_at_each_look_does_not_fill_the_memory() -> None:
    tracker, most = bounded(memory=1.0), 0
    for k in range(200):
        tracker.take(Observation(k / RATE, k / RATE, (at((1.0, 0.0, 0.0), f"box_{k}"),)))
        most = max(most, len(tracker.tracks))
    assert most <= 1.0 * RATE + 2


def test_a_ball_around_an_earlier_look_counts_only_for_the_same_shape() -> None:
    q, palm = suite_robot().home, suite_robot().link_pose(suite_robot().home, "left_hand_palm")[:3, 3]
    away = palm + (0.0, 0.0, 0.3)
    turned = at(away - (0.0, 0.0, 0.05)).model_copy(update={"orientation": (0.0, 0.0, 0.5**0.5, 0.5**0.5)})
    for second, room in ((at(away - (0.0, 0.0, 0.05)), 0.3), (turned, 0.25)):
        tracker = tracked(look(0.0, away))
        tracker.take(Observation(0.1, 0.1, (second,)))
        assert tracker.reachable(0.024, 0.1, q=q).at(0.1)["box"][2] - palm[2] == pytest.approx(room)


@pytest.mark.parametrize("stamp", [NAN, INF, -INF])
def test_stamps_that_are_not_finite_are_left_out(stamp: float) -> None:
    stamps, places = drawn(1)
    good = list(map(look, stamps, places))
    for looks in ([look(stamp, (1.0, 0.0, 0.0)), *good], [*good, look(stamp, (1.0, 0.0, 0.0))]):
        one = tracked(*looks)
        assert same(one.tracks["box"], tracked(*good).tracks["box"]) and one.last == stamps[-1]


@settings(max_examples=25)
@given(seeds, st.floats(0.0, 0.1), st.floats(0.0, 1.0), st.floats(0.0, 0.05))
def test_obstacles_are_within_what_they_can_reach(seed: int, error: float, fastest: float, margin: float) -> None:
    rng = np.random.default_rng(seed)
    times = np.arange(0, 201) * 0.01
    ways = rng.normal(size=(200, 3))
    ways *= rng.choice([0.3, 1.0], (200, 1)) * 0.01 * fastest / np.linalg.norm(ways, axis=1, keepdims=True)
    ways = np.repeat(ways[::10], 10, axis=0) if seed % 2 else ways  # turns at every step, or seldom
    truth = rng.uniform(-1, 1, 3) + np.vstack([np.zeros(3), np.cumsum(ways, axis=0)])
    tracker = Tracker(KERNEL)
    for k in range(0, 201, 3):
        if k and rng.random() < 0.3:
            continue
        off = rng.normal(size=3)
        tracker.take(look(times[k], truth[k] + error * rng.random() * off / np.linalg.norm(off)))
        dynamic = tracker.reachable(error, fastest, margin, suite_robot().home if rng.random() < 0.7 else None)
        a = dynamic.arrays
        for j in range(k, min(k + 40, 201)):
            allowed = a.growth[0, 0] + a.growth[0, 1] * (times[j] - a.stamp[0])
            assert np.linalg.norm(truth[j] - dynamic.at(times[j])["box"]) <= allowed - margin + 1e-9


@settings(max_examples=40)
@given(seeds, st.floats(0.0, 0.1), st.floats(0.0, 0.03))
def test_margins_are_eased_where_the_robot_stands(seed: int, margin: float, gap: float) -> None:
    rng, q = np.random.default_rng(seed), suite_robot().home
    direction = rng.normal(size=3)
    direction /= np.linalg.norm(direction)
    low, high = 0.0, 3.0
    alone = DynamicObstacles([at((0, 0, 0))])
    for _ in range(40):  # as near in that direction as leaves the gap
        middle = 0.5 * (low + high)
        alone.update("box", np.array((0.4, 0.0, 0.6)) + middle * direction)
        clear = clearance_in_time(KERNEL, alone, q[None], np.zeros(1), 1.0)[0][0]
        low, high = (low, middle) if clear > LEAST + gap else (middle, high)
    place = np.array((0.4, 0.0, 0.6)) + high * direction
    tracker = tracked(look(0.0, place))
    raw = tracker.predicted(margin, "still")
    before = raw.arrays.growth.copy()
    eased = tracker.ease_margins(raw, q, [0.0, 0.1])
    clear = clearance_in_time(KERNEL, eased, np.stack([q, q]), np.array([0.0, 0.1]), 1.0)[0]
    assert clear.min() >= LEAST - 1e-9, "what stands clear stays clear"
    assert (eased.arrays.growth >= 0.0).all() and (eased.arrays.growth <= before).all()
    if margin < gap:
        assert np.array_equal(eased.arrays.growth, before), "no more is taken than is missing"


def test_no_margin_is_left_where_an_obstacle_touches_the_robot() -> None:
    q = suite_robot().home
    palm = suite_robot().link_pose(q, "left_hand_palm")[:3, 3]
    tracker = tracked(look(0.0, palm))
    eased = tracker.ease_margins(tracker.predicted(0.05), q, [0.0])
    assert (eased.arrays.growth[:, 0] == 0.0).all() and (eased.arrays.growth[:, 1] > 0.0).all()


def test_obstacles_whose_shapes_change_or_appear_are_as_if_made_anew(tmp_path: Path) -> None:
    """Solids are kept from call to call: after each look all is as in obstacles that were never there before."""
    trimesh.creation.box((0.1, 0.2, 0.1)).export(tmp_path / "m.stl")
    block = Obstacle(name="block", mesh={"file": str(tmp_path / "m.stl")}, position=(0.5, 0.0, 0.5))
    turned = block.model_copy(update={"orientation": (0.0, 0.0, 0.5**0.5, 0.5**0.5)})
    larger = BOX.model_copy(update={"box": (0.2, 0.1, 0.1), "position": (0.1, 0.0, 0.0)})
    tracker = Tracker(KERNEL, allowed=(("box", "left_link7"),))
    for k, seen in enumerate(
        [(BOX,), (at((0.1, 0, 0)),), (at((0.2, 0, 0)), block), (larger, block), (turned,), (turned,)]
    ):
        tracker.take(Observation(k / RATE, k / RATE, seen))
        found = tracker.predicted(0.02), tracker.predicted(0.02, "still"), tracker.reachable(0.01, 0.4, 0.005)
        shapes = [track.shape for track in tracker.tracks.values()]
        for one, kind in zip(found, ("cv", "still", "reach"), strict=True):
            made = DynamicObstacles(shapes, allowed_rows(KERNEL, tracker.allowed, list(tracker.tracks)))
            for name, track in tracker.tracks.items():
                first, later = track.growth(tracker.settings)
                growth = {"cv": (0.02 + first, later), "still": (0.02, 0.0), "reach": (0.015, 0.4)}[kind]
                place, velocity = (track.place, track.velocity) if kind == "cv" else (track.shape.position, np.zeros(3))
                made.update(name, place, velocity, stamp=track.stamp, growth=growth)
            assert one.names == made.names
            for mine, wanted in zip(one.arrays, made.arrays, strict=True):
                np.testing.assert_allclose(mine, wanted, atol=1e-12)
