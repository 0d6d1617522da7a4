"""Franka's arms by the package that speaks to their version: impedance controllers of 1 kHz in C++, given references.

``panda-python`` speaks to the Panda (Franka Emika Robot, system 4.2.1 or later), ``franky-control`` to the Franka
Research 3 (5.9 or later). In both the torque is K (q_d - q) + D (v_d - v), limited in its rate; gravity is compensated
by the robot, for the load that is set in Desk. ``franky`` adds Coriolis torques, and the feedforward that it is given.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any, Protocol

import numpy as np

from apex_ompl.drivers import library
from apex_ompl.errors import DriverError, ParameterError
from apex_ompl.types import Array
from apex_ompl.util.validation import check_array, check_flag, check_positive, finite_array

JOINTS = 7  # of an arm
PACKAGES = {"panda-python": "panda_py", "franky-control": "franky"}
"""Packages by their names, and the modules that they install."""


@dataclass(frozen=True)
class FrankaSettings:
    """Settings of the arms' controllers.

    Attributes:
        stiffness: K of the seven joints [Nm/rad].
        damping: D of the seven joints [Nm s/rad].
        torque_threshold: External torque above which an arm stops by itself [Nm].
        force_threshold: External force and torque at the hand above which it does [N, Nm].
        rate: References a second [Hz].
        lead: Least time by which motions are sent before they start [s].
        realtime: Whether a kernel with real-time priorities is demanded.
    """

    stiffness: tuple[float, ...] = (600.0, 600.0, 600.0, 600.0, 250.0, 150.0, 50.0)
    damping: tuple[float, ...] = (50.0, 50.0, 50.0, 50.0, 30.0, 25.0, 15.0)
    torque_threshold: float = 20.0
    force_threshold: float = 30.0
    rate: float = 1000.0
    lead: float = 0.02
    realtime: bool = True

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            ParameterError: One is not positive, or there are not seven.
        """
        for name in ("stiffness", "damping"):
            given = finite_array(getattr(self, name), name)
            check_array(given, (JOINTS,), name)
            for value in given.tolist():
                check_positive(value, name)
        for name in ("torque_threshold", "force_threshold", "rate", "lead"):
            check_positive(getattr(self, name), name)
        check_flag(self.realtime, "realtime")


class Arm(Protocol):
    """An arm whose controller takes references."""

    def start(self) -> None:
        """Hold the measured position."""

    def command(self, q: Array, v: Array, torque: Array) -> None:
        """Set the reference: position, velocity and feedforward torque, each of shape (7,)."""

    def state(self) -> tuple[Array, Array]:
        """Return the measured position and velocity, each of shape (7,)."""
        ...

    def error(self) -> str:
        """Return why the controller ended, or nothing while it runs."""
        ...

    def recover(self) -> None:
        """Recover from errors, and hold the measured position."""

    def finish(self) -> None:
        """End the controller of an arm at rest."""


class PandaArm:
    """An arm by ``panda-python``, whose controller takes no feedforward torque."""

    def __init__(self, panda: Any, controller: Any, settings: FrankaSettings) -> None:
        """Take a connected ``panda_py.Panda``, and the class ``panda_py.controllers.JointPosition``."""
        self._panda, self._kind, self._settings, self._failed = panda, controller, settings, False
        torques, forces = [settings.torque_threshold] * JOINTS, [settings.force_threshold] * 6
        panda.get_robot().set_collision_behavior(torques, torques, forces, forces)

    @classmethod
    def connect(cls, address: str, settings: FrankaSettings) -> PandaArm:
        """Connect to an arm."""
        found = library.panda_py()
        config = found.RealtimeConfig.kEnforce if settings.realtime else found.RealtimeConfig.kIgnore
        return cls(found.Panda(address, realtime_config=config), found.JointPosition, settings)

    def start(self) -> None:
        """Hold the measured position."""
        gains = np.array(self._settings.stiffness), np.array(self._settings.damping)
        self._controller = self._kind(*gains, 1.0)  # references are not filtered
        self._panda.start_controller(self._controller)
        self._failed = False

    def command(self, q: Array, v: Array, torque: Array) -> None:
        """Set the reference, without the torque."""
        self._controller.set_control(q, v)

    def state(self) -> tuple[Array, Array]:
        """Return the measured position and velocity."""
        if self._failed:
            self._panda.stop_controller()  # without which the state is that of the failure
        state = self._panda.get_state()
        return np.array(state.q), np.array(state.dq)

    def error(self) -> str:
        """Return why the controller ended, or nothing while it runs."""
        try:
            self._panda.raise_error()
        except Exception as error:  # of libfranka
            self._failed = True
            return _text(error)
        return ""

    def recover(self) -> None:
        """Recover from errors, and hold the measured position."""
        self._panda.recover()
        self.start()

    def finish(self) -> None:
        """End the controller; the robot holds its position."""
        self._panda.stop_controller()


class FrankyArm:
    """An arm by ``franky-control``."""

    def __init__(self, robot: Any, tracker: Any, settings: FrankaSettings) -> None:
        """Take a connected ``franky.Robot``, and the class ``franky.JointImpedanceTracker``."""
        self._robot, self._kind, self._settings = robot, tracker, settings
        robot.set_collision_behavior(settings.torque_threshold, settings.force_threshold)

    @classmethod
    def connect(cls, address: str, settings: FrankaSettings) -> FrankyArm:
        """Connect to an arm."""
        found = library.franky()
        config = found.RealtimeConfig.Enforce if settings.realtime else found.RealtimeConfig.Ignore
        return cls(found.Robot(address, realtime_config=config), found.JointImpedanceTracker, settings)

    def start(self) -> None:
        """Hold the measured position."""
        gains = {"stiffness": np.array(self._settings.stiffness), "damping": np.array(self._settings.damping)}
        self._tracker = self._kind(self._robot, **gains)

    def command(self, q: Array, v: Array, torque: Array) -> None:
        """Set the reference."""
        self._tracker.set_target(q, v, torque)

    def state(self) -> tuple[Array, Array]:
        """Return the measured position and velocity."""
        state = self._robot.current_joint_state
        return np.array(state.position), np.array(state.velocity)

    def error(self) -> str:
        """Return why the controller ended, or nothing while it runs."""
        if self._robot.is_in_control:
            return ""
        try:
            self._robot.poll_motion()  # which raises what ended it
            return "the controller ended"
        except Exception as error:  # of libfranka
            return _text(error)

    def recover(self) -> None:
        """Recover from errors, and hold the measured position."""
        self._robot.recover_from_errors()
        self.start()

    def finish(self) -> None:
        """End the controller; the robot holds its position."""
        self._tracker.stop()


def package_of(package: str | None) -> str:
    """Return the name of the package to use: the one that is given, or the only one that is installed.

    Raises:
        ParameterError: There is no such package, or both are installed and none is given.
        MissingFileError: It is not installed.
    """
    known = " or ".join(PACKAGES)
    if package is None:
        found = [name for name, module in PACKAGES.items() if find_spec(module) is not None]
        if not found:
            library.franky()  # which says what to install
        if len(found) > 1:
            raise ParameterError("package", package, f"{known}, since both are installed")
        return found[0]
    if package not in PACKAGES:
        raise ParameterError("package", package, known)
    getattr(library, PACKAGES[package])()
    return package


def connect(package: str, address: str, settings: FrankaSettings) -> Arm:
    """Connect to an arm by a package.

    Raises:
        DriverError: The arm does not answer, or refuses.
    """
    kind = PandaArm if package == "panda-python" else FrankyArm
    try:
        return kind.connect(address, settings)
    except Exception as error:  # of libfranka
        raise DriverError(f"the arm at {address} cannot be connected: {_text(error)}") from error


def _text(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__
