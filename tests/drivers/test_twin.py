"""Models in MuJoCo against Pinocchio's dynamics and kinematics, and contacts against the collision checker."""

from __future__ import annotations

import sys
import xml.etree.ElementTree as ET
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from physics import library
from planning import cached_problem
from small_arm import write_arm
from support import STEP, states_around_home

from apex_ompl.collision import CollisionChecker
from apex_ompl.drivers import Twin, TwinSettings
from apex_ompl.drivers.geoms import MOST_GEOMS
from apex_ompl.drivers.twin_settings import PAYLOAD_RADIUS, mimic_joints, servo_gains
from apex_ompl.errors import MissingFileError, ParameterError, RobotError, SceneError, UnknownNameError
from apex_ompl.robot import Robot, load_robot
from apex_ompl.robot.dynamics import Dynamics
from apex_ompl.scene.bodies import AttachedObject, Obstacle
from apex_ompl.scene.problem import Goal, Problem

mujoco = library()

ROBOTS = ("dual_panda_softhand", "panda", "baxter")


def problem_of(robot: Robot, scene: tuple[Obstacle, ...] = (), **more: Any) -> Problem:
    home = dict(zip(robot.joint_names, robot.home.tolist(), strict=True))
    return Problem(name="twin", robot=robot.name, scene=scene, start=home, goal=Goal(joints=(home,)), **more)


def cloud(folder: Path) -> str:
    np.save(folder / "cloud.npy", np.random.default_rng(0).uniform(-0.1, 0.1, (50, 3)))
    return str(folder / "cloud.npy")


def voxels(folder: Path) -> str:
    occupied = np.random.default_rng(1).random((3, 4, 3)) < 0.5
    np.savez(folder / "voxels.npz", occupied=occupied, resolution=0.08, origin=np.zeros(3))
    return str(folder / "voxels.npz")


def step(folder: Path) -> str:
    (folder / "step.obj").write_text(STEP)
    return str(folder / "step.obj")


SHAPES: dict[str, Callable[[Path], dict[str, Any]]] = {
    "box": lambda _: {"box": (0.09, 0.2, 0.4)},
    "sphere": lambda _: {"sphere": {"radius": 0.12}},
    "cylinder": lambda _: {"cylinder": {"radius": 0.08, "length": 0.4}},
    "capsule": lambda _: {"capsule": {"radius": 0.07, "length": 0.3}},
    "half_space": lambda _: {
        "half_space": {"normal": (0.0, 1.0, 0.5), "offset": -0.35},
        "position": (0.0, 0.0, 0.0),
        "orientation": (0.0, 0.0, 0.6, 0.8),
    },
    "mesh": lambda folder: {"mesh": {"file": step(folder)}},
    "points": lambda folder: {"points": {"file": cloud(folder), "radius": 0.02}},
    "voxels": lambda folder: {"voxels": {"file": voxels(folder)}},
}


@pytest.fixture(scope="module", params=ROBOTS)
def twin(request: pytest.FixtureRequest) -> Twin:
    return Twin(load_robot(request.param))


def spread(twin: Twin, planned: np.ndarray) -> np.ndarray:
    """A vector of all joints of the model from one of the planned joints."""
    found = np.zeros(twin.model.nv)
    found[twin.v] = planned
    for joint in ET.fromstring(twin.robot.urdf).findall("joint"):
        mimic = joint.find("mimic")
        if mimic is not None:
            leader = twin.robot.joint_names.index(str(mimic.get("joint")))
            at = twin.model.joint(str(joint.get("name"))).dofadr[0]
            found[at] = float(mimic.get("multiplier", 1)) * planned[leader]
    return found


def test_every_mimic_joint_of_the_urdf_is_an_equality(twin: Twin) -> None:
    wanted = {
        (str(joint.get("name")), str(mimic.get("joint")), float(mimic.get("multiplier", 1)))
        for joint in ET.fromstring(twin.robot.urdf).findall("joint")
        if (mimic := joint.find("mimic")) is not None
    }
    model = twin.model
    found = {
        (model.joint(first).name, model.joint(second).name, float(data[1]))
        for first, second, data in zip(model.eq_obj1id, model.eq_obj2id, model.eq_data, strict=True)
    }
    assert found == wanted and model.neq == len(wanted)
    assert len(wanted) == {"dual_panda_softhand": 38}.get(twin.robot.name, 0)


def test_mimic_joints_of_mimic_joints_follow_the_first_one() -> None:
    chain = """<robot name="r"><joint name="a" type="revolute"><mimic joint="b" multiplier="2" offset="0.5"/></joint>
    <joint name="b" type="revolute"><mimic joint="c" multiplier="-3" offset="0.1"/></joint></robot>"""
    by_name = {one.joint: one for one in mimic_joints(chain)}
    assert (by_name["a"].leader, by_name["a"].multiplier) == ("c", -6.0)
    assert by_name["a"].offset == pytest.approx(2 * 0.1 + 0.5)
    assert (by_name["b"].leader, by_name["b"].multiplier, by_name["b"].offset) == ("c", -3.0, 0.1)


def test_a_model_that_lost_mimic_joints_is_refused(monkeypatch: pytest.MonkeyPatch, robot: Robot) -> None:
    monkeypatch.setattr(Twin, "_add_exclusions", lambda self, spec: spec.delete(next(iter(spec.equalities))))
    with pytest.raises(RobotError, match="37 equalities for the 38 mimic joints"):
        Twin(robot)


def test_links_are_where_pinocchio_has_them(twin: Twin) -> None:
    robot = twin.robot
    for q in robot.random_state(np.random.default_rng(3), 4):
        data = twin.data(q)
        for link in robot.link_names:
            if link in twin.names:
                np.testing.assert_allclose(twin.pose(data, link), robot.link_pose(q, link), atol=1e-9)
    assert {item for item in robot.link_names if item not in twin.names} <= {"world"}


def test_inverse_dynamics_are_pinocchios(twin: Twin) -> None:
    """Of all masses, centers and inertias, with gravity, and of fingers that follow."""
    robot, rng = twin.robot, np.random.default_rng(4)
    twin.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    to_all = np.stack([spread(twin, row) for row in np.eye(robot.dof)])
    for q in robot.random_state(rng, 4):
        v, a = rng.normal(0.0, 1.0, (2, robot.dof))
        data = twin.data(q)
        data.qvel[:], data.qacc[:] = spread(twin, v), spread(twin, a)
        mujoco.mj_inverse(twin.model, data)
        by_motors = twin.model.jnt_actgravcomp[twin.model.dof_jntid].astype(bool)
        forces = data.qfrc_inverse + np.where(by_motors, 0.0, data.qfrc_gravcomp)  # else the model compensates gravity
        found = to_all @ forces - twin.rotor_inertia * a - twin.friction * v
        wanted = Dynamics(robot).torques(q[None], v[None], a[None])[0]
        np.testing.assert_allclose(found, wanted, atol=1e-6 * max(1.0, np.abs(wanted).max()))
        np.testing.assert_allclose(to_all @ data.qfrc_gravcomp, Dynamics(robot).torques(q[None])[0], atol=1e-6)


def test_loads_are_those_of_the_model(robot: Robot) -> None:
    """The masses that feedforward counts, against those of bodies in the model at their places."""
    held = (
        AttachedObject(name="bar", link="left_hand_palm", cylinder={"radius": 0.02, "length": 0.3}, mass=0.7,
                       position=(0.01, 0.02, -0.05), orientation=(0.5, 0.5, 0.5, 0.5), center_of_mass=(0.0, 0.0, 0.1)),
        AttachedObject(name="brick", link="right_hand_palm", box=(0.1, 0.05, 0.2), position=(0.0, 0.0, -0.08)),
    )  # fmt: skip
    problem = problem_of(robot, attached=held, payload={"right_hand": 2.0})
    twin = Twin(robot, problem, TwinSettings(density=500.0))
    data = twin.data(robot.home)
    masses = {"bar": 0.7, "brick": 500.0 * 0.1 * 0.05 * 0.2}
    assert [load.mass for load in twin.loads] == pytest.approx([*masses.values(), 2.0])
    payload = next(name for name in twin.names if name.startswith("payload"))
    for load, name in zip(twin.loads, ("bar", "brick", payload), strict=True):
        body, pose = twin.model.body(name), robot.link_pose(robot.home, load.link)
        assert body.mass[0] == pytest.approx(load.mass)
        np.testing.assert_allclose(data.body(name).xipos, pose[:3, :3] @ load.center + pose[:3, 3], atol=1e-9)
        turn = data.body(name).ximat.reshape(3, 3)
        in_world = turn @ np.diag(body.inertia) @ turn.T
        np.testing.assert_allclose(in_world, pose[:3, :3] @ load.inertia @ pose[:3, :3].T, atol=1e-9)
    assert twin.model.body(payload).inertia == pytest.approx(0.4 * 2.0 * PAYLOAD_RADIUS**2)


def disagreements(robot: Robot, problem: Problem, states: np.ndarray) -> tuple[int, int]:
    """How many states the checker and the contacts judge differently, and how many collide."""
    checker, twin = CollisionChecker(robot, problem.scene), Twin(robot, problem)
    for held in problem.attached:
        checker.attach(held)
    free = np.array([checker.is_free(q) for q in states])
    touching = np.array([any(depth > 0.0 for depth in twin.contacts(twin.data(q)).values()) for q in states])
    return int(np.sum(free == touching)), int(np.sum(~free))


@pytest.mark.parametrize("shape", SHAPES)
def test_contacts_are_the_verdicts_of_the_checker(robot: Robot, tmp_path: Path, shape: str) -> None:
    pose = {"position": (0.3, 0.5, 0.5), "orientation": (0.0, 0.6, 0.0, 0.8)}
    obstacle = Obstacle(name="it", **(pose | SHAPES[shape](tmp_path)))
    states = states_around_home(robot, np.random.default_rng(5), 50, 0.3)
    wrong, colliding = disagreements(robot, problem_of(robot, (obstacle,)), states)
    assert wrong == 0 and 5 < colliding < 45


@pytest.mark.parametrize("name", ["peg_in_hole", "ball_in_cup"])
def test_contacts_of_held_objects_are_the_verdicts_of_the_checker(robot: Robot, name: str) -> None:
    problem, rng = cached_problem(name), np.random.default_rng(6)
    start = problem.start_state(robot.joint_names)
    states = robot.within_limits(start + rng.normal(0.0, 0.3, (60, robot.dof)))
    states = np.clip(states, robot.limits.lower, robot.limits.upper)
    wrong, colliding = disagreements(robot, problem, states)
    assert wrong == 0 and 5 < colliding < 55


def test_an_allowed_pair_that_overlaps_at_the_start_does_not_collide(robot: Robot) -> None:
    palm = robot.link_pose(robot.home, "left_hand_palm")
    wall = Obstacle(name="wall", box=(0.1, 0.1, 0.1), position=tuple(palm[:3, 3]))
    twin = Twin(robot, problem_of(robot, (wall,)))
    touching = {pair for pair in twin.contacts(twin.data(robot.home)) if "wall" in pair}
    assert ("left_hand_palm", "wall") in touching
    allowed = Twin(robot, problem_of(robot, (wall,), allowed=(("wall", "left_hand_palm"),)))
    found = {pair for pair in allowed.contacts(allowed.data(robot.home)) if "wall" in pair}
    assert found == touching - {("left_hand_palm", "wall")}


def test_an_allowed_pair_that_is_apart_at_the_start_collides(robot: Robot) -> None:
    there = robot.home.copy()
    there[0] += 0.8
    wall = Obstacle(name="wall", box=(0.1, 0.1, 0.1), position=tuple(robot.link_pose(there, "left_hand_palm")[:3, 3]))
    twin = Twin(robot, problem_of(robot, (wall,), allowed=(("wall", "left_hand_palm"),)))
    assert ("left_hand_palm", "wall") in twin.contacts(twin.data(there))


def test_any_robot_has_a_twin(tmp_path: Path) -> None:
    """One without masses and efforts, whose joints hold it by their rotors."""
    robot = load_robot(str(write_arm(tmp_path)))
    twin = Twin(robot, settings=TwinSettings(gains={"elbow": (50.0, 3.0)}))
    assert np.isinf(twin.motor_torque).all()
    assert (twin.kp[2], twin.kd[2]) == (50.0, 3.0)
    np.testing.assert_allclose(twin.kd[:2] ** 2, 4.0 * twin.kp[:2] * 0.1, rtol=1e-6)  # critical damping
    data = twin.data(robot.home)
    for link in ("upper", "lower"):
        np.testing.assert_allclose(twin.pose(data, link), robot.link_pose(robot.home, link), atol=1e-9)


def test_motors_of_pandas_are_known(robot: Robot) -> None:
    gains, twin = servo_gains(robot, TwinSettings()), Twin(robot)
    assert [gains[f"{side}_joint{k}"][0] for side in ("left", "right") for k in (1, 7)] == [4500, 2000] * 2
    spare = 0.1 * robot.limits.acceleration + 1.0 * robot.limits.velocity
    np.testing.assert_allclose(twin.motor_torque[:14], (robot.effort + spare)[:14])
    assert np.isinf(twin.motor_torque[14:]).all()


def test_bad_input_is_named(robot: Robot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ParameterError, match="step"):
        TwinSettings(step=0.0)
    with pytest.raises(ParameterError, match="friction"):
        TwinSettings(friction=-1.0)
    with pytest.raises(ParameterError, match="floor"):
        TwinSettings(floor=float("nan"))
    with pytest.raises(ParameterError, match=r"gains\.elbow"):
        TwinSettings(gains={"elbow": (50.0, -3.0)})
    with pytest.raises(UnknownNameError, match="elbow"):
        Twin(robot, settings=TwinSettings(gains={"elbow": (50.0, 3.0)}))
    np.save(tmp_path / "many.npy", np.random.default_rng(0).random((MOST_GEOMS + 1, 3)))
    many = Obstacle(name="many", points={"file": str(tmp_path / "many.npy"), "radius": 0.01})
    with pytest.raises(SceneError, match=f"many: {MOST_GEOMS + 1} points"):
        Twin(robot, problem_of(robot, (many,)))
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(MissingFileError, match=r"apex-ompl\[twin\]"):
        Twin(robot)
