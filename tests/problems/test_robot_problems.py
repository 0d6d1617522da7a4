"""Problems of ``broad`` for any robot: arms by groups, the cell's frame, and drawn problems."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from small_arm import write_arm

from apex_ompl import load_robot
from apex_ompl.collision import CollisionChecker
from apex_ompl.constraints.links import Links
from apex_ompl.errors import RobotError
from apex_ompl.goals.arms import arms_of
from apex_ompl.kernel import Kernel
from apex_ompl.problems.robot_cells import Cell, cell_of, standard_cell
from apex_ompl.problems.robot_problems import LEVELS, drawn_for, problem_of, robot_of
from apex_ompl.robot import Robot

PLACE = "position: [0.7, -0.4, 0.2], orientation: [0, 0, 0.6, 0.8]"
TURN = np.array([[0.28, -0.96, 0.0], [0.96, 0.28, 0.0], [0.0, 0.0, 1.0]])  # of that orientation
SHIFT = np.array([0.7, -0.4, 0.2])
OPEN = "disabled_pairs: small_arm.pairs.yaml\n"
PAIRS = """schema: apex-ompl/disabled-pairs/1
pairs: [{links: [base, column], reason: adjacent}, {links: [column, upper], reason: adjacent},
  {links: [upper, lower], reason: adjacent}]
"""


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("small")
    file = write_arm(folder)
    file.write_text(file.read_text() + OPEN)
    (folder / "small_arm.pairs.yaml").write_text(PAIRS)
    return file


def test_the_arms_of_robots(robot: Robot, baxter: Robot, small: Path, tmp_path: Path) -> None:
    left, right = arms_of(robot)
    assert left.joints == (*range(7), 14) and right.joints == (*range(7, 14), 15) and left.hand == "left_hand"
    names = robot.joint_names
    assert [names[k] for k in left.chain] == [f"left_joint{k}" for k in range(1, 8)]
    assert [arm.name for arm in arms_of(baxter)] == ["left_arm", "right_arm"]
    (arm,) = arms_of(load_robot(small))
    assert (arm.link, arm.point, arm.fingers, arm.hand) == ("lower", (0.0, 0.0, 0.37), (0.0, 0.0, 1.0), None)
    assert not arm.is_pointed
    # From the first joint to the tip of the stretched arm, which is the farthest there is.
    assert arm.reach == pytest.approx(0.1 + 0.42 + 0.37, abs=2e-3) and arm.reach <= 0.89
    np.testing.assert_allclose(arm.base, [0, 0, 0.25], atol=1e-9)
    tip = load_robot(small).link_pose(load_robot(small).home, "lower") @ [0, 0, 0.37, 1]
    np.testing.assert_allclose(arm.tip, tip[:3], atol=1e-9)
    # Groups that share joints, none of which contains the other, are no arms; neither are parts of an arm.
    text = small.read_text()
    groups = "groups: {all: [turn, shoulder, elbow], end: [elbow, shoulder], crossed: [turn, elbow]}\n"
    write_arm(tmp_path).write_text(text.replace(OPEN, "") + groups)
    (named,) = arms_of(load_robot(tmp_path / "small_arm.robot.yaml"))
    assert named.name == "all"
    write_arm(tmp_path).write_text(text.replace(OPEN, "locked: {shoulder: 0.4, elbow: 0.6}\n").replace(
        "  shoulder: {home: 0.4, acceleration: 10, jerk: 200}\n  elbow: {home: 0.6, acceleration: 10, jerk: 200}\n", ""
    ))  # fmt: skip
    with pytest.raises(RobotError, match="has no arms; expected a group of 2 or more joints"):
        arms_of(load_robot(tmp_path / "small_arm.robot.yaml"))


def test_the_frame_of_the_pandas_is_what_the_rule_gives(robot: Robot) -> None:
    found, standard = Cell.of(robot), standard_cell()
    assert cell_of(robot) is standard and found.pose is not None
    np.testing.assert_allclose(found.pose, np.eye(4), atol=0.02)
    assert found.size == pytest.approx(1.0, abs=0.01)
    np.testing.assert_allclose(found.shoulders, standard.shoulders, atol=0.02)
    np.testing.assert_allclose(found.reaches, standard.reaches, atol=0.01)


def test_problems_move_with_the_robot(small: Path, tmp_path: Path) -> None:
    """An arm that stands elsewhere gets the same problems there."""
    there = write_arm(tmp_path)
    text = small.read_text().replace("urdf: small_arm.urdf}", f"urdf: small_arm.urdf, {PLACE}}}")
    there.write_text(text)
    (tmp_path / "small_arm.pairs.yaml").write_text(PAIRS)
    here, moved = robot_of(str(small)), robot_of(str(there))
    for level in ("free", "rack", "mikado"):
        a, b = drawn_for(here, level, 5), drawn_for(moved, level, 5)
        np.testing.assert_allclose(a.start, b.start, atol=1e-4)
        np.testing.assert_allclose(a.goal, b.goal, atol=1e-4)
        assert [body.shape for body in a.scene] == [body.shape for body in b.scene] and a.scene
        positions = np.array([body.position for body in a.scene]) @ TURN.T + SHIFT
        np.testing.assert_allclose(positions, [body.position for body in b.scene], atol=3e-4)


@pytest.mark.parametrize("level", LEVELS[::9])
def test_ends_are_free_by_a_margin_and_problems_the_same_again(small: Path, baxter: Robot, level: str) -> None:
    for robot, file in ((robot_of(str(small)), str(small)), (baxter, "baxter")):
        drawn = drawn_for(robot, level, 3)
        problem = problem_of(drawn, file, level, 3)
        assert problem.name == f"{robot.name}/broad/{level}/3" and problem.robot == file
        again = drawn_for(robot, level, 3)
        assert np.array_equal(drawn.start, again.start) and drawn.scene == again.scene
        checker = CollisionChecker(robot, drawn.scene, drawn.attached)
        for q in (drawn.start, drawn.goal):
            assert robot.limit_fault(q) is None and checker.is_free(q)
            assert checker.obstacle_distance(q[None]) >= 0.0099


def test_tips_of_the_arms_of_any_robot_reach_their_regions(baxter: Robot) -> None:
    from apex_ompl.goals.state_sampling import HandPoseSampler

    cell, rng = cell_of(baxter), np.random.default_rng(1)
    sampler = HandPoseSampler(cell.tables, (), 0.01)
    regions = [cell.wide_region(arm) for arm in (0, 1)]
    found = [sampler.sample(rng, regions, (0.0, 0.4)) for _ in range(4)]
    states = np.array([q for q in found if q is not None])
    assert len(states) >= 2
    rotation, origin = Kernel(Links.of(baxter).tables, sampler._kernel.scene).joint_frames(states)
    for arm, (x, y) in zip(cell.arms, cell.middles, strict=True):
        tip = Links.of(baxter).point(arm.link, arm.point)
        points = cell.inward(rotation[:, tip.joint] @ np.asarray(tip.vector) + origin[:, tip.joint])
        assert (np.abs(points - (x, y, 0.45)) <= (0.251, 0.501, 0.351)).all()
