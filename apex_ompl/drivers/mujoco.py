"""A driver whose robot is simulated by MuJoCo: motions are followed in physics, on a simulated clock.

At each step the torque of a motor is tau + kp (q_d - q) + kd (v_d - v), held for the step, as that of a controller of
1 kHz is. The feedforward tau are the torques of inverse dynamics (:mod:`apex_ompl.robot.dynamics`) for the robot with
all that it holds, with the inertia of rotors and the friction of joints, and without the gravity of the links, which
MuJoCo compensates. Its integrator has velocities half a step before positions; so has v_d.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from apex_ompl.drivers.commands import START_TOLERANCE, Commands
from apex_ompl.drivers.driver import DriverState
from apex_ompl.drivers.guard import Guard
from apex_ompl.drivers.twin import Twin
from apex_ompl.drivers.twin_settings import TwinSettings, held_loads
from apex_ompl.errors import MissingFileError, ParameterError
from apex_ompl.robot.dynamics import Dynamics
from apex_ompl.robot.model import Robot
from apex_ompl.scene.problem import Problem
from apex_ompl.timing.trajectory import Trajectory
from apex_ompl.types import Array, Flags
from apex_ompl.util.display import fields_line
from apex_ompl.util.validation import check_array, check_integer, check_name, check_number, check_positive, finite_array

BLOCK = 500  # steps whose commands are computed at once
MOST_STEPS = 10**7  # of one advance
LARGEST_PICTURE = 4096  # width and height [pixels]
ELEVATION, DISTANCE, CENTER = -25.0, 2.6, (0.3, 0.0, 0.3)  # of the camera [degrees, m, m]


@dataclass(frozen=True, eq=False)
class Execution:
    """What happened at each step, just before it.

    Attributes:
        times: Shape (N,) [s].
        commanded: Commanded positions, shape (N, dof) [rad].
        positions: Measured positions, shape (N, dof) [rad].
        torques: Torques at the links: those of the servos before they were clipped, without what rotors and friction
            need for the commanded motion, shape (N, dof) [Nm].
        clipped: Whether the torque of a motor was clipped at its limit, shape (N, dof).
        effort: The limits of torques at the links, shape (dof,) [Nm].
    """

    times: Array
    commanded: Array
    positions: Array
    torques: Array
    clipped: Flags
    effort: Array

    __repr__ = fields_line

    @property
    def tracking_error(self) -> Array:
        """Distances of the measured from the commanded positions, shape (N, dof) [rad]."""
        return np.abs(self.positions - self.commanded)

    @property
    def torque_use(self) -> Array:
        """Torques at the links as shares of their limits, shape (N, dof)."""
        return np.abs(self.torques) / self.effort


class MujocoDriver:
    """A robot that is simulated by MuJoCo, in the state at rest that a problem starts in.

    Obstacles move as the problem has them, whose time 0 is that of the driver's clock. The clock stands still until
    :meth:`advance`.

    Attributes:
        robot: The robot.
        names: Names of the joints.
        limits: Limits of the joints.
        twin: The model.
        data: The ``MjData``.
    """

    def __init__(
        self, robot: Robot, problem: Problem | None = None, *, state: Array | None = None,
        settings: TwinSettings | None = None, tolerance: float = START_TOLERANCE, assumed: Problem | None = None,
        guard: Guard | None = None,
    ) -> None:  # fmt: skip
        """Build the model.

        Args:
            robot: The robot.
            problem: Obstacles, held objects and payload; without it there is the robot alone.
            state: State at time 0, shape (dof,); by default the start of the problem, or the home of the robot.
            settings: Settings of the model.
            tolerance: Largest distance of the start of a motion from the commanded position [rad].
            assumed: What the controller takes to be held, by default that of the problem.
            guard: How far the robot may be from its motion.

        Raises:
            ApexError: As :class:`apex_ompl.drivers.twin.Twin`, or the state has another shape.
        """
        if state is None:
            state = robot.home if problem is None else problem.start_state(robot.joint_names)
        self.robot, self.names, self.limits = robot, robot.joint_names, robot.limits
        self._commands = Commands(self.names, self.limits, state, tolerance, (guard or Guard()).bounds(robot))
        self.twin = twin = Twin(robot, problem, settings)
        self.data = twin.data(finite_array(state, "state"))
        loads = twin.loads if assumed is None else held_loads(robot, assumed, twin.settings)
        self.allow(() if problem is None else problem.allowed)
        self._loaded, self._bare = Dynamics(robot, loads), Dynamics(robot)
        self._rotors, self._friction = twin.rotor_inertia, twin.friction
        self._pressed, self._press = np.zeros(len(self.names)), np.zeros(len(self.names))
        self._steps, self._closed = 0, False
        self._renderer: Any = None
        self.forget()

    @property
    def time(self) -> float:
        """Time on the driver's clock [s]."""
        return self._steps * self.twin.settings.step

    @property
    def end(self) -> float:
        """Time from which on rest is commanded [s]."""
        return self._commands.end

    def state(self) -> DriverState:
        """Return the simulated state."""
        self._check_open()
        data, twin = self.data, self.twin
        return DriverState(self.time, data.qpos[twin.q].copy(), data.qvel[twin.v].copy())

    def commanded(self) -> Array:
        """Return the commanded positions, without what hands press beyond them, shape (dof,) [rad]."""
        return np.asarray(self._commands.states(np.array([self.time]))[0, 0])

    def send(self, motion: Trajectory, at: float) -> None:
        """Follow a motion from a time on (:meth:`apex_ompl.drivers.driver.Driver.send`)."""
        self._check_open()
        self._commands.send(motion, at, self.time, self.state())

    def stop(self) -> None:
        """Come to rest within the limits, along the motion that is under way; motions that wait are dropped."""
        self._check_open()
        self._commands.stop(self.time)

    def press(self, joint: str, by: float) -> None:
        """Close a hand further than motions command, at its largest speed.

        Args:
            joint: Its synergy.
            by: How far, added to the commanded position; 0 for not at all.

        Raises:
            UnknownNameError: There is no such joint.
        """
        check_name(joint, "joint", self.names)
        check_number(by, "by", 0.0, 1.0)
        self._press[self.names.index(joint)] = by

    def grip(self, hand: str, closed: bool = True) -> None:
        """Close the jaws of a gripper by its force, or open them; other hands do not move.

        Raises:
            UnknownNameError: There is no such hand.
        """
        check_name(hand, "hand", self.robot.hands)
        self.twin.grip(self.data, hand, closed)

    @property
    def fault(self) -> str:
        """Why the driver stopped, in a sentence; else empty."""
        return self._commands.fault

    def recover(self) -> Array:
        """Hold the measured position, and take up motions again (:meth:`apex_ompl.drivers.driver.Driver.recover`)."""
        self._check_open()
        return self._commands.recover(self.state(), self.time)

    def close(self) -> None:
        """Release the model and what draws it."""
        if self._renderer is not None:
            self._renderer.close()
        self._renderer, self._closed = None, True

    def advance(self, until: float) -> None:
        """Simulate up to a time on the driver's clock, to the nearest step [s].

        Raises:
            ParameterError: The time is over, or more than 10^7 steps ahead.
        """
        self._check_open()
        until = float(finite_array(until, "until"))
        count = round((until - self.time) / self.twin.settings.step)
        if not 0 <= count <= MOST_STEPS:
            raise ParameterError("until", until, f"a time from {self.time:g} s on, at most {MOST_STEPS} steps ahead")
        while count:
            count -= self._advance(min(BLOCK, count))

    @property
    def execution(self) -> Execution:
        """What happened at each step since the start, or since :meth:`forget`."""
        rows = np.concatenate([np.empty((0, len(self.names), 4)), *self._parts])
        times, (commanded, positions, own, asked) = np.concatenate([np.empty(0), *self._times]), np.moveaxis(rows, 2, 0)
        clipped = np.abs(asked) > self.twin.motor_torque
        return Execution(times, commanded, positions, asked - own, clipped, self.robot.effort)

    @property
    def contacts(self) -> dict[tuple[str, str], float]:
        """Pairs of bodies that touched since the start, by name, and how deep at most [m].

        Pairs that may touch are left out: those that the robot's checker does not check, held objects and the links
        that may touch them, and those that are allowed then (:meth:`allow`). The floor is ``world``.
        """
        return dict(self._contacts)

    @property
    def tracking_error(self) -> Array:
        """Distances of the measured from the commanded positions at each step, shape (N, dof) [rad]."""
        return self.execution.tracking_error

    @property
    def torque_use(self) -> Array:
        """Torques at the links at each step as shares of their limits, shape (N, dof)."""
        return self.execution.torque_use

    def allow(self, pairs: Iterable[tuple[str, str]]) -> None:
        """Let only these pairs be allowed from now on: :attr:`contacts` leaves them out, and they touch nevertheless.

        At first these are the pairs that the problem allows.
        """
        self._allowed = {(min(pair), max(pair)) for pair in pairs}

    def forget(self) -> None:
        """Forget what happened so far: contacts and :attr:`execution`."""
        self._times: list[Array] = []
        self._parts: list[Array] = []
        self._contacts: dict[tuple[str, str], float] = {}

    def pose(self, name: str) -> Array:
        """Return the simulated pose of a link, an obstacle or a held object in the world, shape (4, 4) [m].

        Raises:
            UnknownNameError: There is no such body.
        """
        self._check_open()
        return self.twin.pose(self.data, name)

    def picture(
        self, size: tuple[int, int] = (640, 480), azimuth: float = 150.0, center: ArrayLike = CENTER,
        distance: float = DISTANCE,
    ) -> Any:  # fmt: skip
        """Return a picture of the scene as it is, shape (height, width, 3), of type uint8.

        Args:
            size: Width and height [pixels].
            azimuth: Direction of view about the vertical axis, 180 from the front [degrees].
            center: Point in the middle of the picture, shape (3,) [m].
            distance: Of the camera from that point [m].

        Raises:
            ParameterError: A size or a distance that is out of range, or no point.
            MissingFileError: There is no OpenGL.
        """
        self._check_open()
        check_array(finite_array(size, "size"), (2,), "size")
        width, height = (check_integer(side, "size", 1, LARGEST_PICTURE) for side in size)
        point = finite_array(center, "center")
        check_array(point, (3,), "center")
        check_positive(distance, "distance", "a positive number of meters")
        camera = self.twin.camera(float(finite_array(azimuth, "azimuth")), ELEVATION, distance, point.tolist())
        if self._renderer is None or (self._renderer.width, self._renderer.height) != (width, height):
            self._renderer = self._new_renderer(width, height)
        self._renderer.update_scene(self.data, camera)
        return np.array(self._renderer.render())

    def _new_renderer(self, width: int, height: int) -> Any:
        if self._renderer is not None:
            self._renderer.close()
        try:
            return self.twin.renderer(width, height)
        except Exception as error:  # of several kinds, by what is missing
            why = f"{' '.join(str(error).split())}; install libegl1 or libosmesa6, and set MUJOCO_GL to egl or osmesa"
            raise MissingFileError("OpenGL", "library for pictures", why) from error

    def _check_open(self) -> None:
        if self._closed:
            raise ParameterError("driver", "one that was closed", "an open one")

    def _advance(self, count: int) -> int:
        """Simulate some steps, fewer where the robot is stopped, and return their number."""
        twin, data = self.twin, self.data
        times = np.asarray((self._steps + np.arange(count)) * twin.settings.step, np.float64)
        self._commands.forget(float(times[0]) - twin.settings.step)
        q, v, a = self._commands.states(times)
        own = self._rotors * a + self._friction * v
        torques = self._loaded.torques(q, v, a) - self._bare.torques(q) + own
        before = self._commands.states(times - twin.settings.step / 2.0)[1]
        reach = self.limits.velocity * twin.settings.step * np.arange(1, count + 1)[:, None]
        pressed = self._pressed + np.clip(self._press - self._pressed, -reach, reach)
        self._pressed = pressed[-1]
        feedforward = torques + twin.kp * np.minimum(q + pressed, self.limits.upper) + twin.kd * before
        rows = np.stack([q, np.empty_like(q), own, np.empty_like(q)], axis=2)
        for k, row in enumerate(rows):
            row[:, 1] = data.qpos[twin.q]
            if self._commands.watch(DriverState(float(times[k]), row[:, 1], data.qvel[twin.v])):
                self._commands.stop(float(times[k]))  # what follows is commanded anew
                times, rows = times[:k], rows[:k]
                break
            data.ctrl[twin.u] = feedforward[k] - twin.kp * row[:, 1] - twin.kd * data.qvel[twin.v]
            twin.move_obstacles(data, float(times[k]))
            twin.step(data)
            row[:, 3] = twin.asked_torques(data)
            for pair, depth in twin.contacts(data).items():
                if pair not in self._allowed:
                    self._contacts[pair] = max(depth, self._contacts.get(pair, 0.0))
        self._times.append(times)
        self._parts.append(rows)
        self._steps += len(times)
        return len(times)
