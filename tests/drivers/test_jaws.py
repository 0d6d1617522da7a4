"""Jaws of a parallel gripper in MuJoCo: forces, centering and friction against Newton's laws."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from physics import library

from apex_ompl.drivers import MujocoDriver
from apex_ompl.drivers.grasps import GRASPING, Grasps
from apex_ompl.drivers.jaws import SPEED, jaw_joint
from apex_ompl.drivers.twin_settings import TwinSettings
from apex_ompl.errors import ApexError, UnknownNameError
from apex_ompl.robot import Robot, load_robot
from apex_ompl.robot.config import RobotConfig
from apex_ompl.robot.model import bare_robot, build_robot
from apex_ompl.scene.problem import Problem

library()
FORCE, WIDE, OFF = 30.0, 0.05, 0.006
FINGERS = "panda_leftfinger", "panda_rightfinger"


@pytest.fixture(scope="module")
def panda() -> Robot:
    return load_robot("panda")


def held_in_air(robot: Robot, mass: float, friction: float = 0.8) -> tuple[MujocoDriver, Grasps]:
    """A box between the jaws of a gripper that points down, off their middle."""
    home = dict(zip(robot.joint_names, robot.home.tolist(), strict=True))
    box = {
        "name": "box", "box": [0.04, WIDE, 0.06], "link": "panda_hand", "position": [0.0, OFF, 0.1034], "mass": mass,
    }  # fmt: skip
    problem = Problem.parse(
        {"schema": "apex-ompl/problem/1", "name": "jaws", "robot": "panda", "start": home, "goal": {"joints": home},
         "attached": [box]}, "jaws",
    )  # fmt: skip
    settings = TwinSettings(finger_stiffness=GRASPING.finger_stiffness, friction=friction)
    driver = MujocoDriver(robot, problem, settings=settings)
    return driver, Grasps(driver, standing={"box"})


def place(driver: MujocoDriver) -> Any:
    return (np.linalg.inv(driver.pose("panda_hand")) @ driver.pose("box"))[:3, 3]


def closed(driver: MujocoDriver, grasps: Grasps) -> None:
    """Close the jaws while the box has no weight."""
    body = driver.twin.model.body("box").id
    driver.twin.model.body_gravcomp[body] = 1.0
    grasps.grasp("box", "hand")
    driver.twin.model.body_gravcomp[body] = 0.0


def test_jaws_press_with_their_force_and_center(panda: Robot) -> None:
    driver, grasps = held_in_air(panda, 0.2)
    assert place(driver)[1] == pytest.approx(OFF, abs=1e-6)
    closed(driver, grasps)
    assert [(one.kind, one.links) for one in grasps.found] == [("friction", FINGERS)]
    assert grasps.found[0].force == pytest.approx(2.0 * FORCE, rel=0.05)
    gaps = [float(driver.data.joint(jaw_joint(link)).qpos[0]) for link in FINGERS]
    assert gaps == pytest.approx([0.04 - WIDE / 2] * 2, abs=1e-3)
    assert abs(place(driver)[1]) < 1e-3
    before = place(driver)
    driver.advance(driver.time + 1.0)
    assert np.abs(place(driver) - before).max() < 1e-3


def test_friction_holds_as_much_as_coulomb_says(panda: Robot) -> None:
    held = {}
    for share in (0.7, 1.4):  # of the weight 2 mu F that friction holds
        friction = 0.4
        driver, grasps = held_in_air(panda, share * 2.0 * friction * FORCE / 9.81, friction)
        closed(driver, grasps)
        before = driver.pose("box")[2, 3]
        driver.advance(driver.time + 0.4)
        held[share] = before - driver.pose("box")[2, 3] < 2e-3
    assert held == {0.7: True, 1.4: False}


def test_jaws_open_again_at_their_speed(panda: Robot) -> None:
    driver, grasps = held_in_air(panda, 0.2)
    closed(driver, grasps)
    way = 0.04 - WIDE / 2
    grasps.open("hand")
    driver.advance(driver.time + 0.5 * way / SPEED)
    half = float(driver.data.joint(jaw_joint(FINGERS[0])).qpos[0])
    assert 0.3 * way < half < 0.8 * way
    driver.advance(driver.time + 0.4)
    gaps = [float(driver.data.joint(jaw_joint(link)).qpos[0]) for link in FINGERS]
    assert np.abs(gaps).max() < 1e-3 and not driver.twin.forces(driver.data, "box").keys() & set(FINGERS)


def test_jaws_are_there_where_fingers_yield_alone(panda: Robot) -> None:
    rigid, yielding = MujocoDriver(panda), MujocoDriver(panda, settings=GRASPING)
    assert yielding.twin.model.nv - rigid.twin.model.nv == 2
    rigid.twin.grip(yielding.data, "hand", False)
    with pytest.raises(UnknownNameError, match="claw"):
        yielding.grip("claw")


@pytest.mark.parametrize(
    ("jaws", "match"),
    [
        ({"panda_thumb": (0.0, 0.04, 0.0)}, "panda_thumb"),
        ({"panda_leftfinger": (0.0, 0.0, 0.0)}, "not zero"),
        ({"panda_leftfinger": (0.0, 0.04)}, "jaws"),
    ],
)
def test_faulty_jaws_are_refused(jaws: dict[str, Any], match: str) -> None:
    from apex_ompl.util.schema import validate

    _, config, path = bare_robot("panda")
    data = config.model_dump(by_alias=True, exclude_defaults=True)
    data["hands"]["hand"]["jaws"] = jaws
    with pytest.raises(ApexError, match=match):
        build_robot(validate(RobotConfig, data, "panda"), path)
