"""Tasks from frames: what a drawn scene gives, and the sentence of each reason for which there is no task."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from apex_ompl.errors import ParameterError
from apex_ompl.goals.alignment import AlignmentGoal
from apex_ompl.perception.alignment import MOVED, AlignSettings, SeenTask, vect_align
from apex_ompl.perception.camera import look_at
from apex_ompl.perception.frames import Frame
from apex_ompl.perception.registration import RegistrationSettings, corrected
from apex_ompl.perception.surfaces import RobotSurface
from apex_ompl.perception.synthetic import SceneGenerator, SyntheticScene, SyntheticSettings
from apex_ompl.problems.objects import DATA
from apex_ompl.robot import Robot
from apex_ompl.scene.problem import Alignment, Tolerance, WorldVector

pytest.importorskip("cv2")

WIDE = Tolerance(lateral=0.02, axial=0.02, angle=0.3)


@pytest.fixture(scope="module")
def scene(robot: Robot) -> SyntheticScene:
    """Return a scene in which both objects and the obstacle are seen, and whose objects are of different kinds."""
    generator = SceneGenerator(robot, DATA)
    for seed in range(100):
        drawn = generator.draw(
            np.random.default_rng((9, seed)), SyntheticSettings(colors=True, obstacle="cube", frames=3)
        )
        seen = all(one.seen > 0.9 and one.in_image and one.kind != "ball" for one in drawn.objects)
        if seen and drawn.obstacle and drawn.obstacle.seen == 1.0 and drawn.objects[0].kind != drawn.objects[1].kind:
            return drawn
    raise AssertionError("no such scene")


def task(scene: SyntheticScene, robot: Robot, frames: Frame | list[Frame] | None = None, **changes: object) -> SeenTask:
    first, second = (one.kind for one in scene.objects)
    alignment = Alignment.model_validate(
        {"kind": "vertical", "first": first, "second": second, "tolerance": WIDE.model_dump(), **changes}
    )
    attached = [one.reported for one in scene.objects]
    return vect_align(scene.frames[0] if frames is None else frames, robot, attached, alignment)


def test_a_scene_gives_faces_objects_and_the_obstacle(scene: SyntheticScene, robot: Robot) -> None:
    found = task(scene, robot, list(scene.frames))
    assert found, found.reasons
    assert found.stamp == scene.frames[-1].stamp
    assert np.linalg.norm(found.camera[:3, 3] - scene.camera[:3, 3]) < 0.003
    state = scene.frames[0].state(robot.joint_names)
    for one, vector, body in zip(scene.objects, found.vectors, found.attached, strict=True):
        true = one.pose[:3, 3] + one.size[2] * one.pose[:3, 2]
        assert np.linalg.norm(np.array(vector.tip) - true) < 0.012
        along = np.subtract(vector.tip, vector.tail)
        assert along @ one.pose[:3, 2] / np.linalg.norm(along) > np.cos(np.radians(6.0))
        assert body.name == one.kind
        seen = robot.link_pose(state, body.link) @ body.pose
        assert np.linalg.norm(seen[:3, 3] - one.pose[:3, 3]) < 0.012
    assert scene.obstacle is not None
    apart = [np.linalg.norm(np.array(one.position) - scene.obstacle.pose[:3, 3]) for one in found.obstacles]
    assert min(apart) < 0.02
    goal = AlignmentGoal(robot, found.alignment, found.attached, state)
    assert goal.errors(state)["lateral"] > 0.02  # it can be planned for


def test_obstacles_grow_by_the_margin(scene: SyntheticScene, robot: Robot) -> None:
    found = task(scene, robot)
    for seen, grown in zip(found.seen, found.obstacles, strict=True):
        lengths = grown.box or (2.0 * grown.cylinder.radius, 2.0 * grown.cylinder.radius, grown.cylinder.length)  # type: ignore[union-attr]
        assert (np.array(lengths) > seen.size).all()


def test_what_is_not_seen_well_enough_is_no_task(scene: SyntheticScene, robot: Robot) -> None:
    tight = Tolerance(lateral=1e-4, axial=1e-4, angle=1e-4).model_dump()
    found = task(scene, robot, tolerance=tight)
    assert not found
    assert len(found.reasons) == 2
    assert all("the tolerance is 0.1 mm" in reason for reason in found.reasons)
    assert found.vectors == ()


def test_each_reason_is_a_sentence(scene: SyntheticScene, robot: Robot) -> None:
    frame = scene.frames[0]
    cases = {
        "measured no depth at all": replace(frame, depth=np.zeros_like(frame.depth)),
        "has moved since it was calibrated": replace(
            frame, camera=frame.camera.placed(frame.camera.pose @ look_at((0.03, 0.0, 0.0), (0.03, 0.0, 1.0), 0.05))
        ),
        "no colors": replace(frame, color=None),
    }
    for words, changed in cases.items():
        found = task(scene, robot, changed)
        assert not found
        assert any(words in reason for reason in found.reasons), (words, found.reasons)


def test_a_camera_elsewhere_has_moved(scene: SyntheticScene, robot: Robot) -> None:
    frame = scene.frames[0]
    for shift in (0.02, 0.1):
        pose = frame.camera.pose.copy()
        pose[:3, 3] += shift
        found = task(scene, robot, replace(frame, camera=frame.camera.placed(pose)))
        assert any("has moved" in reason for reason in found.reasons), shift


def test_corrections_of_a_camera_at_its_place_are_chi_squared(robot: Robot) -> None:
    generator, surface = SceneGenerator(robot, DATA), RobotSurface(robot)
    total, freedoms, off = 0.0, 0, []
    for seed in range(24):
        frame = generator.draw(np.random.default_rng((10, seed)), SyntheticSettings()).frames[0]
        found = corrected(frame, surface, RegistrationSettings()).registration
        total, freedoms = total + found.surprise, freedoms + found.freedoms
        pose = frame.camera.pose.copy()
        pose[:3, 3] += 0.015 * np.eye(3)[seed % 3]
        moved = replace(frame, camera=frame.camera.placed(pose))
        again = corrected(moved, surface, RegistrationSettings()).registration
        off.append(chi2.sf(again.surprise, again.freedoms))
    assert freedoms >= 24 * 6
    assert chi2.ppf(5e-4, freedoms) < total < chi2.ppf(1.0 - 5e-4, freedoms)
    assert np.mean(np.array(off) < 1e-3) > 0.9
    assert [chi2.ppf(0.999, n) for n in range(1, 8)] == pytest.approx(MOVED[1:], abs=0.01)


def test_a_hidden_object_is_named(scene: SyntheticScene, robot: Robot) -> None:
    frame, one = scene.frames[0], scene.objects[0]
    center = np.linalg.inv(frame.camera.pose) @ one.pose[:, 3]
    column, row = frame.camera.project(center[:3])
    rows, columns = np.mgrid[0:480, 0:640]
    depth = np.where((rows - row) ** 2 + (columns - column) ** 2 < 60.0**2, 0.4, frame.depth)
    found = task(scene, robot, replace(frame, depth=depth))
    assert any(repr(one.kind) in reason and "hidden" in reason for reason in found.reasons), found.reasons


def test_two_of_a_name_and_unknown_names_are_refused(scene: SyntheticScene, robot: Robot) -> None:
    first, second = (one.reported for one in scene.objects)
    alignment = Alignment(kind="vertical", first=first.name, second=second.name)
    twins = [first, second.model_copy(update={"name": first.name}), second]
    with pytest.raises(ParameterError, match="one object of that name, not 2"):
        vect_align(scene.frames[0], robot, twins, alignment)
    with pytest.raises(ParameterError, match="one of"):
        vect_align(scene.frames[0], robot, [first], alignment)
    vector = WorldVector(link=first.link, tail=(0.0, 0.0, 0.0), tip=(0.0, 0.0, 1.0))
    with pytest.raises(ParameterError, match="the camera is to find"):
        vect_align(scene.frames[0], robot, [first], Alignment(kind="vertical", first=first.name, second=vector))
    with pytest.raises(ParameterError):
        AlignSettings(deviations=0.0)
