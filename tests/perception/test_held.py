"""Held objects found by fit in drawn frames, against the truth."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from support import benchmark_script

from apex_ompl.collision.shapes import coal_geometry
from apex_ompl.errors import ApexError
from apex_ompl.perception.camera import look_at
from apex_ompl.perception.frames import Frame, mean_frame
from apex_ompl.perception.held import HeldObject, HeldObjectFinder
from apex_ompl.perception.held_settings import HeldSettings
from apex_ompl.perception.rendering import DepthSensor, ZBuffer
from apex_ompl.perception.synthetic import (
    SceneGenerator,
    SyntheticScene,
    SyntheticSettings,
    TrueObject,
    default_camera,
    solid_part,
)
from apex_ompl.problems.objects import DATA
from apex_ompl.robot import Robot, load_robot
from apex_ompl.scene.bodies import AttachedObject


@pytest.fixture(scope="module")
def generator(robot: Robot) -> SceneGenerator:
    return SceneGenerator(robot, DATA)


def found_in(scene: SyntheticScene, robot: Robot, settings: HeldSettings | None = None) -> tuple[HeldObject, ...]:
    return HeldObjectFinder(robot, [one.reported for one in scene.objects], settings).find(scene.frames[0])


def squared(one: TrueObject, found: HeldObject) -> float:
    off = np.concatenate([pin.log3(one.pose[:3, :3] @ found.pose[:3, :3].T), one.pose[:3, 3] - found.pose[:3, 3]])
    return float(off @ np.linalg.solve(found.covariance, off))


def test_objects_are_found_within_their_covariance(generator: SceneGenerator, robot: Robot) -> None:
    face, prior, errors, kinds = [], [], [], set()
    for seed in range(16):
        scene = generator.draw(np.random.default_rng((5, seed)))
        finder = HeldObjectFinder(robot, [one.reported for one in scene.objects])
        guessed = finder.by_grasp(scene.frames[0])
        for one, found, before in zip(scene.objects, finder.find(scene.frames[0]), guessed, strict=True):
            if one.seen < 0.85 or not one.in_image or found.reason:
                continue
            true = one.pose[:3, 3] + one.size[2] * one.pose[:3, 2]
            if one.kind != "ball":
                face.append(np.linalg.norm(found.face - true))
                prior.append(np.linalg.norm(before.face - true))
            errors.append(squared(one, found))
            kinds.add(one.kind)
    assert len(errors) >= 8
    assert len(kinds) >= 4
    assert np.median(face) < 0.004 < 0.3 * np.median(prior) + 0.002
    assert np.median(errors) < 10.6  # 90 % of chi-squared of 6 dimensions
    assert np.mean(np.array(errors) < 16.8) > 0.85  # 99 %


def test_a_robot_that_reports_the_truth_is_found_exactly(generator: SceneGenerator, robot: Robot) -> None:
    quiet = SyntheticSettings(
        camera_shift=0.0,
        camera_turn=0.0,
        synergy_spread=0.0,
        scale_spread=0.0,
        frames=9,
        sensor=DepthSensor(gain=0.02, holes=0.0),
    )
    scene = generator.draw(np.random.default_rng((5, 3)), quiet)
    finder = HeldObjectFinder(robot, [one.reported for one in scene.objects])
    for one, found in zip(scene.objects, finder.find(mean_frame(scene.frames), 9), strict=True):
        if one.seen > 0.85 and one.kind != "ball":
            assert np.linalg.norm(found.face - one.pose[:3, 3] - one.size[2] * one.pose[:3, 2]) < 1e-3


def test_unknown_sizes_are_found_within_their_spread(generator: SceneGenerator, robot: Robot) -> None:
    settings = SyntheticSettings(size_spread=0.15, sensor=DepthSensor(gain=0.3, holes=0.0))
    spreads, errors = [], []
    for seed in range(6):
        scene = generator.draw(np.random.default_rng((6, seed)), settings)
        for one, found in zip(scene.objects, found_in(scene, robot, HeldSettings(size_spread=0.15)), strict=True):
            if one.seen > 0.9 and not found.reason and one.reported.mesh is None:
                off = np.log(np.array(lengths(one.reported)) * found.scale / lengths(one.body))
                errors += list(off / found.size_spread)
                spreads += list(found.size_spread)
    assert len(errors) >= 12
    assert np.mean(np.square(errors)) < 2.0
    assert np.median(spreads) < 0.075  # 0.15 before


def lengths(body: AttachedObject) -> tuple[float, float, float]:
    if body.box is not None:
        return body.box
    if body.sphere is not None:
        return (body.sphere.radius,) * 3
    assert body.cylinder is not None
    return (body.cylinder.radius, body.cylinder.radius, body.cylinder.length)


def test_a_ball_s_turn_stays_that_of_the_grasp(generator: SceneGenerator, robot: Robot) -> None:
    for seed in range(40):
        scene = generator.draw(np.random.default_rng((5, seed)), SyntheticSettings())
        if scene.objects[0].kind == "ball" and scene.objects[0].seen > 0.5:
            break
    found = found_in(scene, robot)[0]
    turn = np.sort(np.sqrt(np.linalg.eigvalsh(found.covariance[:3, :3])))
    np.testing.assert_allclose(np.degrees(turn), [4.0, 4.0, 10.0], rtol=1e-3)


def answers(scene: SyntheticScene, robot: Robot, **changes: object) -> list[str]:
    frame = replace(scene.frames[0], **changes)
    return [one.reason for one in HeldObjectFinder(robot, [it.reported for it in scene.objects]).find(frame)]


def test_each_missing_answer_has_its_reason(generator: SceneGenerator, robot: Robot) -> None:
    scene = generator.draw(np.random.default_rng((5, 0)))
    frame = scene.frames[0]
    nothing = np.zeros_like(frame.depth)
    assert all("have no depth" in reason for reason in answers(scene, robot, depth=nothing))
    near = np.full_like(frame.depth, 0.3)
    assert all("is hidden" in reason for reason in answers(scene, robot, depth=near))
    eye = frame.camera.pose[:3, 3]
    away = frame.camera.placed(look_at(eye, 2.0 * eye))
    assert all("not in the image" in reason for reason in answers(scene, robot, camera=away))
    middle = np.mean([one.pose[:3, 3] for one in scene.objects], axis=0)
    far = frame.camera.placed(look_at(middle + 8.0 * (eye - middle), middle))
    assert all("out of the range" in reason for reason in answers(scene, robot, camera=far))


def test_an_empty_hand_is_no_object(generator: SceneGenerator, robot: Robot) -> None:
    reasons = []
    for seed in range(4):
        scene = generator.draw(np.random.default_rng((7, seed)), SyntheticSettings(empty=1.0))
        reasons += [one.reason for one in found_in(scene, robot)]
    assert sum(bool(reason) for reason in reasons) >= 7


def test_an_object_far_from_where_the_hand_holds_it_is_no_answer(generator: SceneGenerator, robot: Robot) -> None:
    answers = 0
    for seed in range(4):
        scene = generator.draw(np.random.default_rng((5, seed)))
        attached = []
        for one in scene.objects:
            x, y, z = one.reported.position
            attached.append(one.reported.model_copy(update={"position": (x + 0.06, y, z)}))  # 7 deviations
        found = HeldObjectFinder(robot, attached).find(scene.frames[0])
        for one, its in zip(scene.objects, found, strict=True):
            wrong = np.linalg.norm(its.pose[:3, 3] - one.pose[:3, 3]) > 0.01
            answers += not its.reason and not wrong
    assert answers == 0


def test_calibration_tells_the_inflation_that_errors_need() -> None:
    """Squared errors that are ``k`` times those of chi-squared ask for ``k`` times the inflation."""
    script, rng = benchmark_script("perception.held"), np.random.default_rng(0)
    factors = {"ball": 2.0, "cup": 0.5}
    found = [
        script.Sample(k, method, kind, 1.0, "", 0.0, 0.0, 0.0, 0.0, squared, 1.0, 0.0)
        for kind, factor in factors.items()
        for method in script.METHODS
        for k, squared in enumerate([*(factor * rng.chisquare(6, 4000)), 1e9])
    ]
    rows = {shape: cells for shape, *cells in script.inflation_rows(found)}
    for kind, shape in script.SHAPES.items():
        for cell, now in zip(rows[shape], script.INFLATION[shape], strict=True):
            assert not cell if kind not in factors else abs(float(cell) / now - factors[kind]) < 0.1
    for _, kind, count, _, _, median, *_ in script.covariance_rows(found, 1):
        assert count == 4001 and abs(float(median) - factors[kind]) < 0.1


ODD_URDF = """<robot name="odd"><link name="bäse link"/><link name="tool.0"/>
<joint name="slide/1" type="prismatic"><parent link="bäse link"/><child link="tool.0"/><origin xyz="0 0 0.3"/>
<axis xyz="0 0 1"/><limit lower="0" upper="0.5" velocity="1" effort="1"/></joint></robot>"""
ODD_ROBOT = """schema: apex-ompl/robot/1
name: odd
parts: [{name: arm, urdf: odd.urdf}]
joints: {slide/1: {home: 0.1, acceleration: 1, jerk: 10}}
"""


def test_a_robot_without_shapes_and_with_odd_names_holds_what_is_seen(tmp_path: Path) -> None:
    (tmp_path / "odd.urdf").write_text(ODD_URDF, encoding="utf-8")
    (tmp_path / "odd.yaml").write_text(ODD_ROBOT)
    odd = load_robot(str(tmp_path / "odd.yaml"))
    camera = default_camera(SyntheticSettings()).placed(look_at((0.9, 0.3, 0.8), (0.0, 0.0, 0.45)))
    held = AttachedObject(name="box", box=(0.1, 0.14, 0.2), position=(0.0, 0.0, 0.05), link="tool.0")
    true = odd.link_pose(np.array([0.1]), "tool.0") @ held.pose
    true[:3, :3] = pin.exp3(np.array([0.05, -0.04, 0.08])) @ true[:3, :3]
    true[:3, 3] += 0.006, -0.005, 0.002
    view = ZBuffer().draw([solid_part(coal_geometry(held), true, 1, (1.0, 1.0, 1.0))], camera, camera.pose)
    found = HeldObjectFinder(odd, [held]).find(Frame(camera, view.depth, joints={"slide/1": 0.1}))[0]
    assert not found.reason
    np.testing.assert_allclose(found.pose, true, atol=2e-3)


def test_a_frame_without_a_joint_and_bad_settings_are_refused(generator: SceneGenerator, robot: Robot) -> None:
    scene = generator.draw(np.random.default_rng((5, 0)))
    frame = scene.frames[0]
    finder = HeldObjectFinder(robot, [one.reported for one in scene.objects])
    with pytest.raises(ApexError, match="joint"):
        finder.find(Frame(frame.camera, frame.depth, joints={}))
    with pytest.raises(ApexError, match="link"):
        finder.find(replace(frame, camera=frame.camera.model_copy(update={"link": "nowhere"})))
    for settings in (
        {"grasp_turn": (1.0, -1.0, 1.0)}, {"grasp_shift": (0.01,)}, {"grasp_turn": 4.0}, {"starts": ()},
        {"starts": (float("nan"),)}, {"size_spread": 2.0}, {"edge": float("nan")}, {"most_points": 0.5},
    ):  # fmt: skip
        with pytest.raises(ApexError, match=next(iter(settings))):
            HeldSettings(**settings)  # type: ignore[arg-type]
