"""Occupancy maps that are told states in which the robot is free."""

from __future__ import annotations

import numpy as np
import pytest
from small_arm import write_arm

from apex_ompl.collision import CollisionChecker
from apex_ompl.collision.cloud_contact import on_robot
from apex_ompl.perception import OccupancyMap, OccupancySettings
from apex_ompl.robot import Robot, load_robot
from apex_ompl.scene.bodies import AttachedObject

HELD = AttachedObject(name="held", box=(0.1, 0.1, 0.2), position=(0.0, 0.0, 0.45), link="lower")


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> Robot:
    return load_robot(str(write_arm(tmp_path_factory.mktemp("arm"))))


def test_surfaces_measured_inside_of_a_free_robot_are_moved_out_of_it(arm: Robot) -> None:
    q, bounds = arm.home, ((-0.6, -0.8, -0.3), (0.8, 0.8, 1.3))
    made = OccupancyMap(bounds, 0.02, arm, OccupancySettings(padding=0.02))
    places = (np.argwhere(made.unknown) + 0.5) * made.resolution + made.origin
    inner = on_robot(places, arm, q, 0.0, [HELD]).reshape(made.evidence.shape)
    rim = made.touched(q, [HELD], 0.0) & ~inner
    made.evidence[rim] = 1
    assert rim.sum() > 100 and CollisionChecker(arm, [], [HELD]).is_free(q)
    assert not CollisionChecker(arm, made.world(), [HELD]).is_free(q)
    told = made.world(start=q, goal=[q, q], held=[HELD])
    assert CollisionChecker(arm, told, [HELD], proofs=False).is_free(q)
    before, after = made.points(), made.points(start=q, held=[HELD])
    assert before.shape == after.shape and 0.01 < np.linalg.norm(after - before, axis=1).max() < 0.04
    made.clear()
    middle = (arm.link_pose(q, "lower") @ HELD.pose)[:3, 3]
    deep = np.linalg.norm(places - middle, axis=1) < 0.025  # in a box of 0.1 m
    made.evidence[deep.reshape(inner.shape)] = 1
    assert deep.any() and (made.points(start=q, held=[HELD]) == made.points()).all()  # an obstacle is really there
    assert not CollisionChecker(arm, made.world(goal=q, held=[HELD]), [HELD]).is_free(q)


def test_unknown_voxels_at_start_and_goals_do_not_count(arm: Robot) -> None:
    made = OccupancyMap(((-0.6, -0.8, -0.3), (0.8, 0.8, 1.3)), 0.05, arm)
    start, goals = arm.home, arm.home + np.array([[0.7, 0.0, 0.0], [0.0, 0.5, -0.5]])
    blocked = made.blocked("blocked", start, goal=goals, margin=0.02)
    touched = np.any([made.touched(q, margin=0.02) for q in (start, *goals)], axis=0)
    assert (blocked == ~touched).all() and blocked.sum() < made.blocked("blocked", start, margin=0.02).sum()
    checker = CollisionChecker(arm, made.world("blocked", start, goal=goals))
    assert checker.are_free(np.array([start, *goals])).all()
