"""States to look from: visibility against rays, predicted covariances against fits, free states, and bad input."""

from __future__ import annotations

import numpy as np
import pytest
from planning import cached_problem
from rays import Tracer
from support import benchmark_script

from apex_ompl.collision import CollisionChecker
from apex_ompl.constraints import ConstraintSet
from apex_ompl.errors import ApexError, ParameterError
from apex_ompl.perception import AlignSettings, Camera, HeldSettings, LookSettings, LookState, look_at, look_plan
from apex_ompl.perception import look_states as states_to_look_from
from apex_ompl.perception.frames import mean_frame
from apex_ompl.perception.rendering import ZBuffer
from apex_ompl.perception.surfaces import inverse
from apex_ompl.perception.synthetic import SceneGenerator, SyntheticSettings, default_camera
from apex_ompl.perception.visibility import POINTS, ViewPredictor, obstacle_surface, surface_points
from apex_ompl.problems.objects import DATA
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import AttachedObject, Obstacle
from apex_ompl.scene.problem import Problem
from apex_ompl.types import Array

QUICK = LookSettings(proposals=40, predicted=8, rounds=1)


@pytest.fixture(scope="module")
def problem() -> Problem:
    return cached_problem("stack_boxes")


@pytest.fixture(scope="module")
def start(problem: Problem, robot: Robot) -> Array:
    return problem.start_state(robot.joint_names)


@pytest.fixture(scope="module")
def camera() -> Camera:
    return default_camera(SyntheticSettings()).placed(look_at((1.5, 0.6, 0.9), (0.45, 0.0, 0.45)))


@pytest.fixture(scope="module")
def looks(problem: Problem, robot: Robot, start: Array, camera: Camera) -> tuple[LookState, ...]:
    return states_to_look_from(
        robot, problem.attached, ["lower", "upper"], camera, start, world=problem.scene, settings=QUICK
    )


def test_visible_shares_are_those_of_rays(problem: Problem, robot: Robot, start: Array, camera: Camera) -> None:
    predictor = ViewPredictor(robot, problem.attached, problem.scene)
    shares = predictor.visible(camera, start, 0.2)
    links = [robot.link_pose(start, one.link) for one in problem.attached]
    bodies = [(one, one.pose) for one in (*robot.fixtures, *problem.scene)]
    held = [(one, link @ one.pose) for one, link in zip(problem.attached, links, strict=True)]
    tracer, eye = Tracer(robot, start, [*bodies, *held]), camera.pose[:3, 3]
    for body, link, share in zip(problem.attached, links, shares, strict=True):
        points = surface_points(body, obstacle_surface(body), np.random.default_rng(1))  # type: ignore[arg-type]
        places = points.points[:POINTS] @ link[:3, :3].T + link[:3, 3]
        normals, rays = points.normals[:POINTS] @ link[:3, :3].T, places - eye
        turned = -(normals * rays).sum(axis=1) > 0.2 * np.linalg.norm(rays, axis=1)
        first = np.full(POINTS, np.inf)
        first[turned] = tracer.depths(eye, rays[turned])
        pixels = camera.project((places - eye) @ camera.pose[:3, :3])
        inside = ((pixels > 0.0) & (pixels < (camera.width - 1, camera.height - 1))).all(axis=1)
        expected = np.mean(turned & inside & (first > 0.99))
        assert share.surface == pytest.approx(expected, abs=0.06)
    assert max(share.surface for share in shares) > 0.1


def test_points_are_on_the_surface_and_those_of_the_face_on_the_contact_face() -> None:
    body = AttachedObject.model_validate(
        {
            "name": "can", "link": "palm", "cylinder": {"radius": 0.03, "length": 0.12},
            "position": (0.01, 0.02, -0.05), "orientation": (0.0, 0.5**0.5, 0.0, 0.5**0.5),
            "contact": {"point": (0.0, 0.0, 0.06), "axis": (0, 0, 1)},
        }
    )  # fmt: skip
    points = surface_points(body, obstacle_surface(body), np.random.default_rng(0))  # type: ignore[arg-type]
    own = (points.points - body.pose[:3, 3]) @ body.pose[:3, :3]
    radius, height = np.hypot(own[:, 0], own[:, 1]), np.abs(own[:, 2])
    assert np.allclose(np.maximum(radius / 0.03, height / 0.06), 1.0, atol=0.03)
    np.testing.assert_allclose(own[points.face, 2], 0.06, atol=1e-6)
    side = np.mean(height[:POINTS] < 0.0599)
    assert side == pytest.approx(0.12 / (0.12 + 0.03), abs=0.08)  # 2 pi r l of 2 pi r (l + r)


def test_balls_of_a_cloud_hide_what_is_behind_them(
    problem: Problem, robot: Robot, start: Array, camera: Camera, tmp_path: object
) -> None:
    np.save(f"{tmp_path}/cloud.npy", camera.pose[:3, 3] + 0.5 * camera.pose[:3, 2] + np.zeros((1, 3)))
    cloud = Obstacle.model_validate({"name": "cloud", "points": {"file": f"{tmp_path}/cloud.npy", "radius": 0.25}})
    ground = Obstacle.model_validate({"name": "ground", "half_space": {"normal": (0, 0, 1)}, "position": (0, 0, -1)})
    predictor = ViewPredictor(robot, problem.attached, [cloud, ground])
    assert [share.surface for share in predictor.visible(camera, start, 0.2)] == [0.0, 0.0]
    assert all(one.reason for one in predictor.predicted(camera, start, 9))
    assert not any(one.reason for one in ViewPredictor(robot, problem.attached).predicted(camera, start, 9))


def test_predicted_deviations_are_those_of_fits_to_frames(robot: Robot) -> None:
    generator, ratios = SceneGenerator(robot, DATA), []
    for seed in range(3):
        scene = generator.draw(np.random.default_rng((31, seed)), SyntheticSettings(frames=9))
        predictor = ViewPredictor(robot, [one.reported for one in scene.objects])
        frame = scene.frames[0]
        expected = predictor.predicted(frame.camera, frame.state(robot.joint_names), 9)
        found = predictor.finder.find(mean_frame(scene.frames), 9)
        for one, before, after in zip(scene.objects, expected, found, strict=True):
            if one.seen > 0.85 and one.in_image and not after.reason:
                ratios.append(before.place_spread / after.place_spread)
    assert len(ratios) >= 3
    assert 0.5 < np.median(ratios) < 1.5


def test_states_are_free_near_and_show_both_objects(
    looks: tuple[LookState, ...], problem: Problem, robot: Robot, start: Array
) -> None:
    exact = CollisionChecker(robot, problem.scene, problem.attached, proofs=False)
    margin = np.minimum(QUICK.joint_margin, (robot.limits.upper - robot.limits.lower) / 4.0)
    hands = robot.groups["hands"]
    margin[hands] = 0.0
    assert looks[0].names == ("lower", "upper")
    for one in looks:
        assert exact.is_free(one.state)
        assert (one.state >= robot.limits.lower + margin - 1e-9).all()
        assert (one.state <= robot.limits.upper - margin + 1e-9).all()
        np.testing.assert_array_equal(one.state[hands], start[hands])
        assert one.duration == pytest.approx(np.max(np.abs(one.state - start) / robot.limits.velocity))
    for k, one in enumerate(looks):
        assert all(np.abs(one.state - other.state).max() >= QUICK.apart for other in looks[:k])
    counts = [len(one.names) for one in looks]
    assert counts == sorted(counts, reverse=True)


def test_faces_are_before_the_camera_at_the_distance_that_was_asked_for(
    problem: Problem, robot: Robot, start: Array, camera: Camera
) -> None:
    camera = camera.placed(look_at((1.2, 0.1, 0.8), (0.45, 0.0, 0.45)))
    settings = LookSettings(proposals=24, predicted=6, distance=(0.7, 0.9), face_angle=0.6)
    found = states_to_look_from(robot, problem.attached, "upper", camera, start, settings=settings)
    upper = next(one for one in problem.attached if one.name == "upper")
    good = 0
    for one in found:
        pose = inverse(camera.pose) @ robot.link_pose(one.state, upper.link) @ upper.pose
        point, axis = pose[:3, :3] @ upper.contact.point + pose[:3, 3], pose[:3, 2]  # type: ignore[union-attr]
        away = float(np.linalg.norm(point))
        good += 0.65 < away < 0.95 and float(axis @ point) / away < -np.cos(0.7)
    assert good >= len(found) / 2 > 0


def test_the_same_seed_gives_the_same_states(
    looks: tuple[LookState, ...], problem: Problem, robot: Robot, start: Array, camera: Camera
) -> None:
    again = states_to_look_from(
        robot, problem.attached, ("lower", "upper"), [camera], start,
        world=CollisionChecker(robot, problem.scene, problem.attached), settings=QUICK,
    )  # fmt: skip
    assert [one.objects for one in again] == [one.objects for one in looks]
    np.testing.assert_array_equal([one.state for one in again], [one.state for one in looks])
    away = states_to_look_from(
        robot, problem.attached, ("lower", "upper"), [camera], start, world=problem.scene, settings=QUICK,
        avoided=[looks[0].state],
    )  # fmt: skip
    assert all(np.abs(one.state - looks[0].state).max() >= QUICK.avoid for one in away)


def test_constraints_hold_in_the_states(robot: Robot, camera: Camera) -> None:
    problem = cached_problem("pour_upright")
    q = problem.start_state(robot.joint_names)
    found = states_to_look_from(
        robot, problem.attached, ["left_cup"], camera, q, world=problem.scene, settings=QUICK,
        constraints=problem.constraints,
    )  # fmt: skip
    kept = ConstraintSet.of(robot, problem.constraints, problem.attached, q)
    assert found and all(kept.is_satisfied(one.state) for one in found)


def test_a_camera_that_sees_nothing_gives_no_state_and_another_one_is_chosen(
    problem: Problem, robot: Robot, start: Array, camera: Camera
) -> None:
    box = Obstacle.model_validate({"name": "lid", "box": (0.2, 0.2, 0.02), "position": camera.pose[:3, 3].tolist()})
    blind = camera.placed(look_at(camera.pose[:3, 3] + (0.0, 0.0, 0.02), camera.pose[:3, 3] - (0.0, 0.0, 1.0)))
    assert states_to_look_from(robot, problem.attached, "upper", blind, start, world=[box], settings=QUICK) == ()
    other = camera.model_copy(update={"name": "other"})
    found = states_to_look_from(robot, problem.attached, "upper", [blind, other], start, settings=QUICK)
    assert found and {one.camera for one in found} == {"other"}


def test_a_camera_on_a_hand_sees_what_the_other_hand_holds(problem: Problem, robot: Robot, start: Array) -> None:
    pose = look_at((0.06, 0.0, 0.0), (0.06, 0.0, 1.0))
    own = default_camera(SyntheticSettings()).placed(pose).model_copy(update={"link": "left_link7"})
    settings = LookSettings(proposals=40, predicted=8, distance=(0.4, 0.8))
    found = states_to_look_from(robot, problem.attached, "upper", own, start, settings=settings)
    assert found and found[0].names == ("upper",)
    predictor = ViewPredictor(robot, problem.attached)
    seen = predictor.visible(own, found[0].state, settings.least_cosine)[1]
    assert (seen.surface, seen.face) == (found[0].objects[0].share, found[0].objects[0].face)
    assert seen.surface > 0.1


def test_a_plan_of_looks_covers_all_objects_with_few_states(looks: tuple[LookState, ...]) -> None:
    assert look_plan(looks) == looks[:1]

    def only(look: LookState, *names: str) -> LookState:
        views = tuple(view.__class__(**{**vars(view), "enough": view.name in names}) for view in look.objects)
        return LookState(look.state, look.camera, views, look.duration)

    apart = [only(looks[0]), only(looks[0], "upper"), only(looks[1], "upper"), only(looks[1], "lower")]
    assert look_plan(apart) == (apart[1], apart[3])
    assert look_plan([only(looks[0])]) == ()


def test_after_looking_a_task_is_known_within_its_tolerance() -> None:
    script, rng = benchmark_script("perception.looking"), np.random.default_rng((2001, 34))
    found = script.run_task(34, rng, ZBuffer())  # whose object is hidden at the start
    assert found[0].looks >= 1 and found[0].answered and not found[0].off
    assert found[0].face < 0.006
    assert found[0].squared < 22.5  # exceeded once in 1000


def test_bad_input_is_named(problem: Problem, robot: Robot, start: Array, camera: Camera) -> None:
    held = problem.attached

    def refused(match: str, **changes: object) -> None:
        given = {"attached": held, "names": "upper", "cameras": camera, "state": start} | changes
        with pytest.raises(ApexError, match=match):
            states_to_look_from(robot, settings=QUICK, **given)  # type: ignore[arg-type]

    refused("unknown held object 'uper'", names=["uper"])
    refused("the name of a held object", names=[])
    refused("one object of that name, not 2", attached=[*held, held[1]])
    refused("an object with a contact face", attached=[held[0], held[1].model_copy(update={"contact": None})])
    refused("one camera or more", cameras=[])
    refused("cameras with a pose", cameras=default_camera(SyntheticSettings()))
    refused("a Camera", cameras=["front"])
    refused("different names", cameras=[camera, camera])
    refused("link", cameras=camera.model_copy(update={"link": "nowhere"}))
    refused("state", state=np.full(len(start), np.nan))
    refused("state", state=start[:-1])
    refused("obstacles", world="here")
    faulty = {"proposals": 0, "place": -1.0, "border": 0.6, "seed": -1}
    for name, value in (("distance", (0.9, 0.7)), ("distance", (0.9,)), *faulty.items()):
        with pytest.raises(ParameterError, match=name):
            LookSettings(**{name: value})  # type: ignore[arg-type]
    assert AlignSettings().look == LookSettings() and HeldSettings()
