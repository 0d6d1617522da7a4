"""The share of free states that spheres prove, by which planners choose, against the meshes alone."""

from __future__ import annotations

import numpy as np
import pytest

import apex_ompl
from apex_ompl.apex.path_validator import PathValidator
from apex_ompl.collision import CollisionChecker
from apex_ompl.collision.proved_share import ENOUGH, STATES, proved_share, share_note
from apex_ompl.robot import Robot, load_robot

LINK = '<link name="{}"><collision><origin xyz="{} 0 0"/><geometry><box size="{}"/></geometry></collision></link>'
JOINT = """<joint name="{}" type="revolute"><parent link="{}"/><child link="{}"/><origin xyz="{}"/><axis xyz="0 0 1"/>
<limit lower="-3" upper="3" velocity="2" effort="1"/></joint>"""
URDF = "".join([
    '<robot name="flat">', LINK.format("plate", 0, "2 2 0.1"), LINK.format("first", 0.2, "0.4 0.04 0.04"),
    LINK.format("second", 0.2, "0.4 0.04 0.04"), JOINT.format("one", "plate", "first", "0 0 0.071"),
    JOINT.format("two", "first", "second", "0.42 0 0"), "</robot>",
])  # fmt: skip
FILE = """schema: apex-ompl/robot/1
name: flat
parts: [{name: arm, urdf: flat.urdf}]
joints: {one: {home: 0.0, acceleration: 9, jerk: 90}, two: {home: 0.0, acceleration: 9, jerk: 90}}
"""
GOAL = {"one": 1.5, "two": 0.0}
POST = {"name": "post", "box": (0.05, 0.05, 0.6), "position": (0.54, 0.54, 0.36)}


@pytest.fixture(scope="module")
def bare(tmp_path_factory: pytest.TempPathFactory) -> Robot:
    """A planar arm a millimeter above a plate, less than its covers protrude; it has no tables."""
    folder = tmp_path_factory.mktemp("bare")
    (folder / "flat.urdf").write_text(URDF)
    (folder / "flat.robot.yaml").write_text(FILE)
    return load_robot(str(folder / "flat.robot.yaml"))


def test_the_share_is_that_of_the_free_states(bare: Robot) -> None:
    states = bare.random_state(np.random.default_rng(0), STATES)
    proved = CollisionChecker(bare).kernel.unproved(states)[1] == 0
    free = CollisionChecker(bare, proofs=False).are_free(states)
    assert proved_share(bare) == proved.sum() / free.sum() < ENOUGH
    assert "0%" in share_note(bare) and "flat" in share_note(bare)
    good = load_robot("panda")
    assert ENOUGH <= proved_share(good) <= 1.0 and share_note(good) == ""


def test_a_robot_of_which_little_is_proved_is_planned_for_by_meshes(bare: Robot) -> None:
    planner = apex_ompl.MotionPlanner(bare)
    planner.world.add(**POST)
    result = planner.plan(bare.home, GOAL, params={"model": "none"}, seed=1, timing=False)
    assert result and share_note(bare) in result.notes and result.solved_by == "sprint"
    meshes = CollisionChecker(bare, planner.world.obstacles.values(), proofs=False)
    assert meshes.first_collision(result.path, 0.02) is None
    setup = planner.simple_setup(bare.home, GOAL)
    assert not PathValidator(setup.getSpaceInformation()).by_spheres


def test_trees_of_spheres_come_first_for_other_robots() -> None:
    panda = load_robot("panda")
    setup = apex_ompl.MotionPlanner(panda).simple_setup(panda.home, panda.random_state(np.random.default_rng(3)))
    assert PathValidator(setup.getSpaceInformation()).by_spheres
