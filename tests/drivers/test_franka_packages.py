"""What the driver gives the packages of Franka's arms, by their real classes and without a robot."""

from __future__ import annotations

import importlib
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from stand_ins_of_franka import STAND_INS, stand_ins

from apex_ompl.drivers import FrankaSettings
from apex_ompl.drivers.franka_arms import FrankyArm, PandaArm, package_of
from apex_ompl.errors import DriverError, ParameterError

Q, V, TORQUE = np.linspace(-1.0, 1.0, 7), np.linspace(0.1, 0.7, 7), np.linspace(-3.0, 3.0, 7)


def public(kind: Any) -> set[str]:
    return {name for name in vars(kind) if not name.startswith("_")}


def test_panda_py_takes_the_references() -> None:
    controllers = pytest.importorskip("panda_py.controllers")
    done: list[Any] = []
    robot = SimpleNamespace(set_collision_behavior=lambda *rows: done.append(rows))
    panda = SimpleNamespace(
        get_robot=lambda: robot, start_controller=done.append, stop_controller=lambda: done.append("stopped"),
        raise_error=lambda: None, get_state=lambda: SimpleNamespace(q=Q.tolist(), dq=V.tolist()),
        recover=lambda: done.append("recovered"),
    )  # fmt: skip
    arm = PandaArm(panda, controllers.JointPosition, FrankaSettings(torque_threshold=25.0, force_threshold=40.0))
    assert done.pop() == ([25.0] * 7, [25.0] * 7, [40.0] * 6, [40.0] * 6)
    arm.start()
    assert isinstance(done.pop(), controllers.JointPosition)
    arm.command(Q, V, TORQUE)  # which checks shapes and types, and keeps what it was given to itself
    with pytest.raises(TypeError):
        arm.command(Q[:6], V, TORQUE)
    np.testing.assert_array_equal(arm.state(), [Q, V])
    assert arm.error() == ""
    panda.raise_error = lambda: (_ for _ in ()).throw(RuntimeError("libfranka:  reflex\n"))
    assert arm.error() == "libfranka: reflex"
    arm.state()
    assert done.pop() == "stopped"  # or else the state would be that of the failure
    arm.recover()
    assert done[0] == "recovered" and isinstance(done[1], controllers.JointPosition)
    arm.finish()
    assert done[2] == "stopped"


def test_franky_takes_the_references() -> None:
    franky = pytest.importorskip("franky")
    done: list[Any] = []
    robot = SimpleNamespace(
        set_collision_behavior=lambda *values: done.append(values), current_joint_positions=Q, is_in_control=True,
        current_joint_state=franky.JointState(Q, V), move=lambda motion, asynchronous: done.append(motion),
        poll_motion=lambda: True, recover_from_errors=lambda: True, join_motion=lambda: True,
    )  # fmt: skip
    arm = FrankyArm(robot, franky.JointImpedanceTracker, FrankaSettings())
    assert done.pop() == (20.0, 30.0)
    arm.start()
    motion = done.pop()
    assert isinstance(motion, franky.JointImpedanceTrackingMotion)
    np.testing.assert_array_equal(motion.get_gains().stiffness, FrankaSettings().stiffness)
    np.testing.assert_array_equal(motion.get_gains().damping, FrankaSettings().damping)
    np.testing.assert_array_equal(motion.get_reference().q, Q)  # until the first reference
    arm.command(2.0 * Q, V, TORQUE)
    reference = motion.get_reference()
    np.testing.assert_array_equal([reference.q, reference.dq, reference.tau_ff], [2.0 * Q, V, TORQUE])
    with pytest.raises(ValueError, match="finite"):
        arm.command(np.full(7, np.nan), V, TORQUE)
    np.testing.assert_array_equal(arm.state(), [Q, V])
    assert arm.error() == ""
    robot.is_in_control = False
    assert arm.error() == "the controller ended"
    robot.poll_motion = lambda: (_ for _ in ()).throw(franky.ControlException("libfranka: reflex"))
    assert arm.error() == "libfranka: reflex"
    arm.recover()
    assert isinstance(done.pop(), franky.JointImpedanceTrackingMotion)
    robot.is_in_control = True
    arm.finish()
    assert isinstance(done.pop(), franky.TorqueStopMotion)


def test_panda_py_has_what_its_stand_in_has(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("panda_py")
    from panda_py import Panda
    from panda_py.controllers import JointPosition
    from panda_py.libfranka import RealtimeConfig, Robot, RobotState

    with stand_ins(monkeypatch):
        stand_in = importlib.import_module("panda_py")
    assert str(STAND_INS) in str(stand_in.__file__)
    for kind in (Panda, JointPosition, RealtimeConfig, Robot):
        same = getattr(stand_in, kind.__name__)
        assert public(same) and public(same) <= set(dir(kind)), kind
    assert {"q", "dq"} <= set(dir(RobotState))


def test_franky_has_what_its_stand_in_has(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("franky")
    from franky import JointImpedanceTracker, JointState, RealtimeConfig, Robot

    with stand_ins(monkeypatch):
        stand_in = importlib.import_module("franky")
    assert str(STAND_INS) in str(stand_in.__file__)
    for kind in (Robot, JointImpedanceTracker, RealtimeConfig):
        same = getattr(stand_in, kind.__name__)
        assert public(same) and public(same) <= set(dir(kind)), kind
    assert {"position", "velocity"} <= set(dir(JointState))


@pytest.mark.parametrize("package", ["panda-python", "franky-control"])
def test_an_arm_that_is_not_there_is_named(package: str) -> None:
    from apex_ompl.drivers.franka_arms import connect

    pytest.importorskip({"panda-python": "panda_py", "franky-control": "franky"}[package])
    with pytest.raises(DriverError, match="the arm at 127.0.0.99 cannot be connected: libfranka: Connection to FCI"):
        connect(package, "127.0.0.99", FrankaSettings(realtime=False))


def test_the_package_is_named_where_both_are_installed() -> None:
    pytest.importorskip("panda_py")
    pytest.importorskip("franky")
    with pytest.raises(ParameterError, match="since both are installed"):
        package_of(None)
    assert package_of("panda-python") == "panda-python"
