"""Judges of tasks in physics: objects are put where a task ends well, and elsewhere."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from physics import library
from planning import cached_problem
from small_arm import arm_problem

from apex_ompl import load_problem, load_robot
from apex_ompl.drivers import MujocoDriver
from apex_ompl.drivers.grasps import GRASPING
from apex_ompl.drivers.vessels import liquid
from apex_ompl.physics.judges import Check, Intended, Judge
from apex_ompl.robot import Robot
from apex_ompl.scene.problem import Problem
from apex_ompl.types import Array

library()


def with_liquid(problem: Problem) -> Problem:
    return problem.model_copy(update={"attached": (*problem.attached, *liquid(problem))})


def shifted(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Array:
    pose = np.eye(4)
    pose[:3, 3] = x, y, z
    return pose


class Scene:
    """A robot at the start of a problem, whose objects are put where a test says."""

    def __init__(self, robot: Robot, problem: Problem, **judge: Any) -> None:
        self.problem, self.robot = problem, robot
        self.driver = MujocoDriver(robot, with_liquid(problem), settings=GRASPING)
        self.start = problem.start_state(robot.joint_names)
        self.held = {one.name: Intended(one.name, one.link, one.pose) for one in problem.attached}
        self.judge = {"intended": self.held, "end": self.start} | judge

    def put(self, name: str, pose: Array) -> Scene:
        self.driver.twin._set_free(self.driver.data, name, pose)
        self.driver.twin._mj.mj_forward(self.driver.twin.model, self.driver.data)
        return self

    def checks(self) -> dict[str, Check]:
        return {check.name: check for check in Judge(self.problem, self.driver, **self.judge).checks()}

    def failed(self) -> set[str]:
        return {name for name, check in self.checks().items() if not check.passed}


def test_what_is_held_is_where_the_hand_has_it(robot: Robot) -> None:
    scene = Scene(robot, cached_problem("stack_boxes"))
    assert scene.failed() == set() and len(scene.checks()) == 5
    first = scene.driver.pose("upper")
    assert scene.put("upper", shifted(z=0.018) @ first).failed() == set()
    assert scene.put("upper", shifted(z=0.022) @ first).failed() == {"upper is held by right_hand"}
    turned = first.copy()
    turned[:3, :3] = first[:3, :3] @ np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    assert scene.put("upper", turned).failed() == {"upper is held by right_hand"}


@pytest.mark.parametrize(("problem", "name", "round_about"), [("pour", "empty", "z"), ("ball_in_cup", "ball", "xz")])
def test_a_turn_of_a_round_object_about_its_axis_is_none(
    robot: Robot, problem: str, name: str, round_about: str
) -> None:
    scene = Scene(robot, cached_problem(problem))
    first, before = scene.driver.pose(name), scene.failed()
    for about in "xz":
        turn = np.eye(4)
        turn[:3, :3] = pin.utils.rotate(about, 1.0)
        lost = {one for one in scene.put(name, first @ turn).failed() - before if f"{name} is held by" in one}
        assert bool(lost) == (about not in round_about)


def test_no_object_may_lie_on_the_floor(robot: Robot) -> None:
    scene = Scene(robot, cached_problem("stack_boxes"))
    scene.put("upper", shifted(0.5, 0.0, -0.68))
    assert scene.failed() == {"upper is held by right_hand", "no object is on the floor"}
    assert scene.checks()["no object is on the floor"].found == "upper on the floor"


def test_what_was_released_is_where_it_was_to_be_and_at_rest(robot: Robot) -> None:
    problem, place = cached_problem("stack_boxes"), shifted(0.4, 0.0, 0.8)
    lower = next(one for one in problem.attached if one.name == "lower")
    wanted = {"upper": Intended("upper", "", place), "lower": Intended("lower", lower.link, lower.pose)}
    scene = Scene(robot, problem, intended=wanted).put("upper", place)
    assert scene.failed() == set()
    scene.driver.data.qvel[scene.driver.twin.model.joint("upper").dofadr[0]] = 0.1
    assert scene.failed() == {"upper is where it was put"}
    scene.driver.data.qvel[:] = 0.0
    assert scene.put("upper", shifted(0.4, 0.03, 0.8)).failed() == {"upper is where it was put"}


def test_a_ball_falls_into_its_cup(robot: Robot) -> None:
    problem = cached_problem("ball_in_cup")
    cup = next(one for one in problem.attached if one.name == "cup")
    wanted = {"cup": Intended("cup", cup.link, cup.pose), "ball": Intended("ball", "", np.eye(4), falls=True)}
    scene = Scene(robot, problem, intended=wanted)
    inside = scene.driver.pose("cup")
    assert scene.failed() == {"ball is in cup"}
    assert scene.put("ball", inside @ shifted(z=-0.029)).failed() == set()
    assert scene.put("ball", inside @ shifted(z=0.1)).failed() == {"ball is in cup"}


def test_a_peg_is_in_its_hole(robot: Robot) -> None:
    scene = Scene(robot, cached_problem("peg_in_hole"))
    block = scene.driver.pose("block")
    face = "peg is -50 mm from the face of block"
    assert face in scene.failed()
    flip = np.diag([1.0, -1.0, -1.0, 1.0])  # the peg's face looks at that of the block, 35 mm above its center
    for depth, across, passed in ((0.05, 0.0, True), (0.05, 0.014, True), (0.05, 0.02, False), (0.02, 0.0, False)):
        scene.put("peg", block @ shifted(x=across, z=0.035 - depth + 0.09) @ flip)
        assert scene.checks()[face].passed == passed


def test_liquids_stay_in_cups_or_are_poured_for_the_most_part(robot: Robot) -> None:
    upright = Scene(robot, cached_problem("pour_upright"))
    assert upright.failed() == set()
    upright.put("left_cup/3", shifted(0.3, 0.3, 0.5))
    assert upright.failed() == {"100% of the liquid stayed in left_cup"}
    poured = Scene(robot, cached_problem("pour"))
    name = "75% of the liquid was poured into empty"
    assert poured.checks()[name].found == "0 of 20 balls"
    for k in range(1, 21):
        assert poured.checks()[name].passed == (k > 15)
        poured.put(f"full/{k}", poured.driver.pose("empty") @ shifted(z=-0.05))


def test_cargo_stands_on_its_tray(robot: Robot) -> None:
    problem = cached_problem("carry_tray")
    scene = Scene(robot, problem)
    tray, cargo = scene.driver.pose("tray"), scene.driver.pose("cargo")
    scene.judge["standing"] = {"cargo": ("tray", np.linalg.inv(tray) @ cargo)}
    assert scene.failed() == set()
    assert scene.put("cargo", shifted(x=0.04) @ cargo).failed() == {"cargo stands on tray"}


def test_empty_hands_reach_the_goal_without_touching_anything(robot: Robot) -> None:
    problem = load_problem("shelf_swap")
    scene = Scene(robot, problem, touched=[("board_1", "left_link7")])
    assert scene.failed() == {"no link touched an obstacle"}
    ended = Scene(robot, problem, end=problem.goal_states(robot.joint_names)[0])
    assert ended.failed() == {"left_hand is where the plan ends", "right_hand is where the plan ends"}


@pytest.mark.parametrize("name", ["reach_past_post", "handover"])
def test_starts_pass_as_their_own_ends(name: str, robot: Robot) -> None:
    assert Scene(robot, cached_problem(name)).failed() == set()


def test_an_arm_without_hands_is_where_the_plan_ends(tmp_path: Path) -> None:
    problem = arm_problem(tmp_path)
    arm = load_robot(problem.robot)
    driver = MujocoDriver(arm, problem)
    for off, passed in ((0.0, True), (0.05, False)):
        checks = Judge(problem, driver, {}, problem.start_state(arm.joint_names) + off).checks()
        (check,) = [one for one in checks if one.name == "the robot is where the plan ends"]
        assert check.passed is passed
