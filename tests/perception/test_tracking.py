"""Tracked obstacles: names, fused sizes, covariances, births and deaths, against closed forms and simulations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

from apex_ompl.errors import ParameterError
from apex_ompl.perception.box_axes import ORDERS, TURNS
from apex_ompl.perception.camera import Camera, DepthErrors, look_at
from apex_ompl.perception.obstacles import SeenObstacle
from apex_ompl.perception.registration import CorrectedFrame, Registration
from apex_ompl.perception.solid_starts import Kind
from apex_ompl.perception.surfaces import inverse
from apex_ompl.perception.tracked_solid import held_back
from apex_ompl.scene.bodies import Obstacle

pytest.importorskip("scipy")

from apex_ompl.perception.tracking import ObstacleTracker, TrackerSettings  # noqa: E402

SIZE = np.array([0.1, 0.15, 0.2])
TURN = pin.exp3(np.array([0.1, 0.3, 0.5]))
COVARIANCE = np.diag([0.02] * 3 + [0.004] * 3 + [0.006] * 3) ** 2
RATE = 30.0


def seen(
    place: np.ndarray, rng: np.random.Generator, *, size: np.ndarray = SIZE, covariance: np.ndarray = COVARIANCE,
    kind: Kind = "box", error: np.ndarray | None = None,
) -> SeenObstacle:  # fmt: skip
    """Return an observation with errors of its covariance, or with given ones."""
    off = rng.multivariate_normal(np.zeros(9), covariance) if error is None else error
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = pin.exp3(off[:3]) @ TURN, place + off[3:6]
    return SeenObstacle(kind, pose, size + off[6:], covariance, False, 500)


def frame_of(
    depth: np.ndarray, eye: tuple[float, float, float] = (1.2, 0.0, 0.5), name: str = "front"
) -> CorrectedFrame:
    camera = Camera(name=name, width=160, height=120, focal=(116.0, 116.0), center=(79.5, 59.5), depth=DepthErrors())
    pose = look_at(eye, (0.2, 0.0, 0.3))
    return CorrectedFrame(camera, depth, Registration(pose, 1.0, np.zeros(0), np.zeros((7, 7)), 0, 0), 0.0038)


def still(**fields: float) -> TrackerSettings:
    """Return settings of obstacles that do not move."""
    return replace(TrackerSettings(births=1, of=1, power=0.0, spin=0.0, speed=1e-6, common=0.0), **fields)  # type: ignore[arg-type]


def test_covariances_of_what_stands_still_fall_as_one_over_n() -> None:
    rng, tracker, n = np.random.default_rng(1), ObstacleTracker(still()), 25
    for k in range(n):
        (found,) = tracker.update(k / RATE, [seen(np.array([0.2, 0.0, 0.3]), rng)])
    np.testing.assert_allclose(found.covariance[:9, :9], COVARIANCE / n, rtol=0.01, atol=1e-9)
    assert found.frames == n


def test_shared_errors_of_a_view_stay_and_a_second_camera_halves_them() -> None:
    rng, share, n = np.random.default_rng(1), 0.8, 100
    tracker = ObstacleTracker(still(common=share))
    front, side = frame_of(np.zeros((120, 160))), frame_of(np.zeros((120, 160)), (0.2, 1.0, 0.4), "side")
    here = np.array([0.2, 0.0, 0.3])
    for k in range(n):
        (found,) = tracker.update(k / RATE, [seen(here, rng, error=np.zeros(9))], front)
    expected = share + (1.0 - share) / n
    np.testing.assert_allclose(np.diag(found.covariance)[3:9], expected * np.diag(COVARIANCE)[3:9], rtol=1e-3)
    for k in range(n):
        (found,) = tracker.update((n + k) / RATE, [seen(here, rng, error=np.zeros(9))], side)
    np.testing.assert_allclose(np.diag(found.covariance)[3:9], expected / 2.0 * np.diag(COVARIANCE)[3:9], rtol=1e-3)


def test_two_views_know_the_depth_that_each_does_not() -> None:
    """A box of known front and unknown back, from two sides: center and length along each sight are correlated."""
    rng, tracker = np.random.default_rng(2), ObstacleTracker(still())
    here = np.array([0.2, 0.0, 0.3])
    for k in range(2):
        covariance = COVARIANCE.copy()
        away = TURN[:, k]
        lever = np.concatenate([np.zeros(3), away / 2.0, np.eye(3)[k]])
        covariance += 0.1**2 * np.outer(lever, lever)
        error = rng.normal() * 0.1 * lever
        (found,) = tracker.update(k / RATE, [seen(here, rng, covariance=covariance, error=error)])
    assert np.linalg.norm(found.pose[:3, 3] - here) < 0.002
    assert np.abs(found.size - SIZE).max() < 0.003
    assert np.sqrt(np.diag(found.covariance)[3:9].max()) < 0.01


def test_normalized_errors_of_moving_obstacles_are_chi_squared() -> None:
    """Runs with the errors that the filter assumes: shared and own parts, white acceleration."""
    rng, squares, settings = np.random.default_rng(3), [], TrackerSettings(births=1, of=1, common=0.5, spin=0.0)
    root, frame = np.sqrt(COVARIANCE), frame_of(np.zeros((120, 160)))
    dt = 1.0 / RATE
    drift = settings.power * np.array([[dt**3 / 3.0, dt**2 / 2.0], [dt**2 / 2.0, dt]])
    for _ in range(40):
        tracker = ObstacleTracker(settings)
        place, velocity = np.array([0.2, 0.0, 0.3]), rng.normal(0.0, settings.speed, 3)
        shared = rng.normal(size=9)
        eye = frame.registration.pose[:3, 3]
        for k in range(12):
            view = TURN.T @ (eye - place)
            error = root @ (np.sqrt(0.5) * shared + np.sqrt(0.5) * rng.normal(size=9))
            (found,) = tracker.update(k * dt, [seen(place, rng, error=error)], frame)
            noise = rng.multivariate_normal(np.zeros(2), drift, 3)
            place, velocity = place + dt * velocity + noise[:, 0], velocity + noise[:, 1]
            change = np.linalg.norm(TURN.T @ (eye - place) - view) / np.linalg.norm(view)
            kept = np.exp(-change / settings.view)
            shared = kept * shared + np.sqrt(1.0 - kept**2) * rng.normal(size=9)
            last = place - dt * velocity
        off = np.concatenate([last - found.pose[:3, 3], SIZE - found.size, velocity - found.velocity])
        assert found.speed_deviation == pytest.approx(np.linalg.norm(found.covariance[9:, 9:], 2) ** 0.5)
        squares.append(float(off @ np.linalg.solve(found.covariance[3:, 3:], off)) / 9.0)
    band = 1.96 * np.sqrt(2.0 / (9 * len(squares)))
    assert abs(np.mean(squares) - 1.0) < band + 0.05  # the place moved on by a step of noise


def test_names_stay_where_two_cross_at_a_distance_in_any_order_and_with_any_axes() -> None:
    rng, tracker = np.random.default_rng(4), ObstacleTracker()
    names = set()
    for k in range(60):
        t = k / RATE
        first, second = np.array([0.6 - 0.3 * t, 0.0, 0.3]), np.array([0.3 * t, 0.12, 0.3])
        order, turn = ORDERS[k % 24], TURNS[k % 24]
        one, other = seen(first, rng), seen(second, rng, size=np.array([0.1, 0.12, 0.2]))
        pose = one.pose.copy()
        pose[:3, :3] = pose[:3, :3] @ turn
        one = replace(one, pose=pose, size=one.size[order])
        found = tracker.update(t, [one, other] if k % 2 else [other, one])
        names.add(tuple(sorted(track.name for track in found)))
    assert names == {(), ("seen_1", "seen_2")}
    by_size = sorted(found, key=lambda track: track.size[1])
    np.testing.assert_allclose(by_size[1].pose[:3, 3], first, atol=0.01)
    np.testing.assert_allclose(by_size[1].velocity, (-0.3, 0.0, 0.0), atol=0.08)
    np.testing.assert_allclose(np.sort(by_size[1].size), SIZE, atol=0.005)
    np.testing.assert_allclose(by_size[0].pose[:3, 3], second, atol=0.01)


def test_a_cylinder_may_be_turned_over() -> None:
    rng, tracker, here = np.random.default_rng(5), ObstacleTracker(still()), np.array([0.2, 0.0, 0.3])
    size = np.array([0.1, 0.1, 0.2])
    for k in range(10):
        one = seen(here, rng, size=size, kind="cylinder")
        pose = one.pose.copy()
        pose[:3, :3] = (
            pose[:3, :3] @ pin.exp3(np.array([np.pi * (k % 2), 0.0, 0.0])) @ pin.exp3(np.array([0, 0, 0.7 * k]))
        )
        (found,) = tracker.update(k / RATE, [replace(one, pose=pose)])
    assert abs(found.pose[:3, 2] @ TURN[:, 2]) > 0.9995
    np.testing.assert_allclose(found.size, size, atol=0.006)


def test_births_take_k_of_n_frames() -> None:
    rng, tracker, here = np.random.default_rng(6), ObstacleTracker(TrackerSettings(births=2, of=3)), np.zeros(3)
    assert tracker.update(0.0, [seen(here, rng)]) == ()
    assert tracker.update(0.1, []) == ()
    assert [one.name for one in tracker.update(0.2, [seen(here, rng)])] == ["seen_1"]
    flashes = ObstacleTracker(TrackerSettings(births=2, of=3))
    for k in range(9):
        assert flashes.update(0.1 * k, [seen(here, rng)] if k % 3 == 0 else []) == ()


@pytest.mark.parametrize("case", ["through", "occluded", "robot", "same depth", "no depth"])
def test_only_a_place_that_is_seen_through_is_empty(case: str) -> None:
    rng, tracker, here = (
        np.random.default_rng(7),
        ObstacleTracker(TrackerSettings(memory=0.3)),
        np.array([0.2, 0.0, 0.3]),
    )
    depth = {"occluded": 0.5, "same depth": 0.95, "no depth": 0.0}.get(case, 2.5)
    frame = frame_of(np.full((120, 160), depth))
    at = (inverse(frame.registration.pose) @ np.append(here, 1.0))[2]
    assert abs(at - 1.02) < 0.01
    for k in range(3):
        tracker.update(0.1 * k, [seen(here, rng)], frame)
    robot = np.full((120, 160), True) if case == "robot" else None
    alive = [bool(tracker.update(0.3 + 0.1 * k, [], frame, robot)) for k in range(8)]
    assert alive == ([True] * 3 + [False] * 5 if case == "through" else [True] * 8)


def test_what_is_gone_is_named_once_and_hidden_ones_are_not_kept_for_ever() -> None:
    rng, here = np.random.default_rng(8), np.array([0.2, 0.0, 0.3])
    tracker, frame = ObstacleTracker(TrackerSettings(longest=1.0)), frame_of(np.zeros((120, 160)))
    for k in range(3):
        tracker.update(0.1 * k, [seen(here, rng)], frame)
    assert tracker.update(1.1, [], frame)
    assert tracker.update(1.3, [], frame) == ()
    assert tracker.gone == ("seen_1",)
    tracker.update(1.4, [], frame)
    assert tracker.gone == ()


def test_outliers_count_less_and_another_kind_needs_most_votes() -> None:
    rng, tracker, here = np.random.default_rng(9), ObstacleTracker(still()), np.array([0.2, 0.0, 0.3])
    for k in range(10):
        tracker.update(k / RATE, [seen(here, rng)])
    wrong = np.zeros(9)
    wrong[3], wrong[6] = 0.04, 0.08
    (found,) = tracker.update(0.5, [seen(here, rng, error=wrong)])
    assert np.abs(found.size - SIZE).max() < 0.012
    for k in range(25):
        (found,) = tracker.update(1.0 + k / RATE, [seen(here, rng, size=np.array([0.12, 0.12, 0.2]), kind="cylinder")])
        assert found.kind == ("box" if k < 11 else "cylinder")
    np.testing.assert_allclose(found.size, (0.12, 0.12, 0.2), atol=0.006)


def test_the_solid_for_planners_holds_the_obstacle_and_seldom_changes() -> None:
    rng, tracker, solids = np.random.default_rng(10), ObstacleTracker(TrackerSettings(births=1, of=1)), []
    for k in range(60):
        place = np.array([0.2 + 0.2 * k / RATE, 0.0, 0.3])
        (found,) = tracker.update(k / RATE, [seen(place, rng)])
        solids.append(found.solid)
        corners = np.array(np.meshgrid(*[[-0.5, 0.5]] * 3)).reshape(3, -1).T * SIZE @ TURN.T + place
        own = (corners - found.solid.position) @ found.solid.pose[:3, :3]
        assert found.solid.box is not None
        assert (np.abs(own) <= np.array(found.solid.box) / 2.0).all()
    assert len({(solid.box, solid.orientation) for solid in solids[10:]}) <= 3
    assert max(solids[-1].box or ()) < 0.2 + 0.1


def contains(solid: Obstacle, place: np.ndarray, size: np.ndarray, turn: np.ndarray) -> bool:
    corners = np.array(np.meshgrid(*[[-0.5, 0.5]] * 3)).reshape(3, -1).T * size @ turn.T + place
    assert solid.box is not None
    own = (corners - solid.position) @ solid.pose[:3, :3]
    return bool((np.abs(own) <= np.array(solid.box) / 2.0 + 1e-9).all())


def test_the_solid_of_what_stands_does_not_move_and_shrinks_as_the_size_is_known() -> None:
    rng, tracker = np.random.default_rng(11), ObstacleTracker(TrackerSettings(births=1, of=1, power=0.2))
    solids, estimates = [], []
    little, here = np.diag([0.002] * 3 + [0.002] * 3 + [0.001] * 3) ** 2, np.array([0.2, 0.0, 0.3])
    unsure = COVARIANCE.copy()
    unsure[6:, 6:] *= 9.0
    for k in range(80):
        (found,) = tracker.update(k / RATE, [seen(here, rng, covariance=unsure if k < 3 else little)])
        solids.append(found.solid)
        estimates.append(found.pose[:3, 3])
        assert contains(found.solid, here, SIZE, TURN)
    assert np.subtract(solids[0].box, SIZE).min() > 0.03 and np.subtract(solids[-1].box, SIZE).max() < 0.03
    ways = [
        np.linalg.norm(np.diff(rows, axis=0), axis=1).sum()
        for rows in (estimates[40:], [o.position for o in solids[40:]])
    ]
    assert ways[1] < 0.3 * ways[0]


def test_a_solid_is_held_back_no_further_than_what_it_needs() -> None:
    rng = np.random.default_rng(12)
    for shape in ({"box": (0.1, 0.2, 0.3)}, {"cylinder": {"radius": 0.1, "length": 0.3}}):
        turn = pin.exp3(rng.normal(size=3))
        x, y, z, w = pin.Quaternion(turn).coeffs()
        before = Obstacle.model_validate({"name": "seen", **shape, "orientation": (x, y, z, w)})
        for _ in range(50):
            needed = before.model_copy(update={"position": tuple(rng.normal(0.0, 0.02, 3))})
            spare = np.array([0.01, 0.01, 0.02]) if "cylinder" in shape else rng.uniform(0.0, 0.03, 3)
            off = turn.T @ np.subtract(held_back(before, needed, spare), needed.position)
            round_ = np.hypot(off[0], off[1]) <= spare[0] + 1e-9
            assert (
                (round_ and abs(off[2]) <= spare[2] + 1e-9) if "cylinder" in shape else (abs(off) <= spare + 1e-9).all()
            )
            if (np.abs(needed.position) < 0.004).all() and spare.min() > 0.007:
                assert held_back(before, needed, spare) == before.position


def test_a_piece_of_an_obstacle_is_no_other_one() -> None:
    rng, tracker = np.random.default_rng(13), ObstacleTracker(TrackerSettings(births=1, of=1))
    here, size = np.array([0.2, 0.0, 0.3]), np.array([0.2, 0.2, 0.2])
    for k in range(10):
        tracker.update(k / RATE, [seen(here, rng, size=size)])
    piece = seen(here + TURN @ (0.06, 0.05, 0.0), rng, size=np.array([0.06, 0.08, 0.18]))
    beside = seen(here + TURN @ (0.16, 0.0, 0.0), rng, size=np.array([0.06, 0.08, 0.18]))
    assert len(tracker.update(10 / RATE, [seen(here, rng, size=size), piece])) == 1
    assert len(tracker.update(11 / RATE, [seen(here, rng, size=size), beside])) == 2


def test_a_piece_that_one_camera_sees_is_of_what_the_other_one_saw_just_before() -> None:
    """A cube behind another one: each camera sees another side of it, one of them only a sliver."""
    rng, tracker = np.random.default_rng(14), ObstacleTracker(TrackerSettings(births=1, of=1))
    front, above = (frame_of(np.zeros((120, 160)), name=name) for name in ("front", "above"))
    here, size = np.array([0.2, 0.0, 0.3]), np.array([0.2, 0.2, 0.2])
    sliver, tight = np.array([0.02, 0.18, 0.18]), np.diag([0.02] * 3 + [0.002] * 3 + [0.004] * 3) ** 2
    for k in range(20):
        tracker.update(k / RATE, [seen(here, rng, size=size, covariance=tight)], above)
        piece = seen(here + TURN @ (0.08, 0.0, 0.0), rng, size=sliver, covariance=tight)
        (found,) = tracker.update(k / RATE, [piece], front)
    assert np.linalg.norm(found.pose[:3, 3] - here) < 0.1 and found.frames > 20


def test_an_obstacle_that_was_a_piece_is_gone_when_the_whole_is_seen() -> None:
    rng, tracker = np.random.default_rng(15), ObstacleTracker(still(births=1, of=1, gate=9.0))
    here, size = np.array([0.2, 0.0, 0.3]), np.array([0.2, 0.2, 0.2])
    ends = [here + TURN @ (side * 0.08, 0.0, 0.0) for side in (-1.0, 1.0)]
    slivers = [seen(end, rng, size=np.array([0.03, 0.18, 0.18]), error=np.zeros(9)) for end in ends]
    assert len(tracker.update(0.0, slivers)) == 2  # both sides of a thing that hides its middle
    for k in range(1, 40):
        found = tracker.update(k / RATE, [seen(here, rng, size=size)], frame_of(np.full((120, 160), 0.3)))
    (one,) = found
    assert one.size == pytest.approx(size, abs=0.02) and np.linalg.norm(one.pose[:3, 3] - here) < 0.02


def test_bad_input_is_refused() -> None:
    rng, tracker = np.random.default_rng(0), ObstacleTracker()
    tracker.update(1.0, [])
    with pytest.raises(ParameterError, match="stamp"):
        tracker.update(0.5, [])
    with pytest.raises(ParameterError, match="stamp"):
        tracker.update(float("nan"), [])
    bad = replace(seen(np.zeros(3), rng), size=np.full(3, np.nan))
    with pytest.raises(ParameterError, match="size"):
        tracker.update(2.0, [bad])
    with pytest.raises(ParameterError, match="frame"):
        tracker.update(2.0, [], None, np.zeros((2, 2), bool))
    with pytest.raises(ParameterError, match="births"):
        TrackerSettings(births=4, of=3)
    with pytest.raises(ParameterError, match="of"):
        TrackerSettings(of=2.5)  # type: ignore[arg-type]
