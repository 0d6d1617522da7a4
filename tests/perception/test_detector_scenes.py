"""Scenes of the detector: objects rest on the tables, both renderers agree, and draws are those of their seeds."""

from __future__ import annotations

import coal
import numpy as np
import pytest

from apex_ompl.collision.shapes import coal_geometry
from apex_ompl.perception.camera import Camera, DepthErrors
from apex_ompl.perception.detector import KINDS
from apex_ompl.perception.detector_scenes import (
    TRAINING,
    ObjectSceneGenerator,
    ObjectSettings,
    clutter,
    free_pose,
)
from apex_ompl.perception.rendering import DepthSensor, Mujoco
from apex_ompl.perception.surfaces import geometry_surface
from apex_ompl.perception.synthetic import KINDS as NOMINAL
from apex_ompl.perception.synthetic import held_object
from apex_ompl.problems.objects import DATA
from apex_ompl.robot import Robot

SMALL = Camera(width=160, height=120, focal=(116.0, 116.0), center=(79.5, 59.5), depth=DepthErrors(correlation=1))


@pytest.mark.parametrize("kind", KINDS)
def test_free_objects_rest_on_the_table_or_are_above_it(kind: str) -> None:
    rng, size, lowest = np.random.default_rng(0), np.array(NOMINAL[kind].size), []
    surface = geometry_surface(coal_geometry(held_object(kind, size, "palm", 1, name=kind, meshes=DATA)), kind, 96, 4)
    middle = np.array([0.4, 0.0, 0.5])
    for _ in range(20):
        pose = free_pose(rng, kind, size, middle, ObjectSettings(lying=0.5))
        lowest.append(surface.at(pose).vertices[:, 2].min())
        assert abs(pose[0, 3] - 0.4) <= 0.35 and abs(pose[1, 3]) <= 0.5
    assert np.abs(lowest).max() < 1e-3
    assert all(free_pose(rng, kind, size, middle, ObjectSettings(floating=1.0))[2, 3] > 0.14 for _ in range(5))


def test_objects_do_not_touch_and_are_the_same_for_the_same_seed(robot: Robot) -> None:
    generator = ObjectSceneGenerator(robot, DATA, camera=SMALL)
    for seed in range(3):
        scene = generator.draw_objects(np.random.default_rng((42, seed)), TRAINING)
        free = [one for one in scene.objects if not one.held]
        assert len(scene.objects) - len(free) == len(scene.reported) == 2
        for k, one in enumerate(free):
            for other in scene.objects[: 2 + k]:
                gap = np.linalg.norm(one.pose[:3, 3] - other.pose[:3, 3])
                assert gap > np.linalg.norm(one.size) + np.linalg.norm(other.size)
        for one in scene.objects:
            assert (one.seen > 0.0) == bool((scene.labels == one.label).any()) and 0.0 <= one.seen <= 1.0
        again = generator.draw_objects(np.random.default_rng((42, seed)), TRAINING)
        assert np.array_equal(again.frame.depth, scene.frame.depth)
        assert np.array_equal(again.frame.color, scene.frame.color)


def test_both_renderers_see_the_same_but_in_other_colors(robot: Robot) -> None:
    settings = ObjectSettings(sensor=DepthSensor(gain=0.0, holes=0.0))
    scenes = [
        ObjectSceneGenerator(robot, DATA, renderer, SMALL).draw_objects(np.random.default_rng(43), settings)
        for renderer in (None, Mujoco())
    ]
    a, b = (scene.frame.depth for scene in scenes)
    both = (a > 0.0) & (b > 0.0)
    assert both.mean() > 0.3
    assert np.median(np.abs(a - b)[both]) < 1.1e-3 and np.mean(np.abs(a - b)[both] < 5e-3) > 0.95
    assert np.mean(scenes[0].labels == scenes[1].labels) > 0.97
    colors = [scene.frame.color for scene in scenes]
    assert colors[0] is not None and colors[1] is not None
    assert np.mean(np.abs(colors[0].astype(int) - colors[1])) > 10.0 and colors[1].std() > 10.0


def test_no_round_clutter_looks_like_an_object() -> None:
    parts = clutter(np.random.default_rng(0), 60)
    assert len({part.label for part in parts}) == 60
    round_ones = [part.solid for part in parts if isinstance(part.solid, coal.Cylinder | coal.Sphere)]
    assert len(round_ones) > 15
    for solid in round_ones:
        for kind in ("can", "cup", "peg") if isinstance(solid, coal.Cylinder) else ("ball",):
            assert abs(np.log(solid.radius / NOMINAL[kind].size[0])) > np.log(1.15)
