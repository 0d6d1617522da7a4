"""Dynamic obstacles as cameras see them: a sensor of the closed loop.

At its rate every camera draws a frame, in which obstacles of a color are found (:mod:`apex_ompl.perception.obstacles`)
and tracked (:mod:`apex_ompl.perception.tracking`). An observation has the stamp of the frames and is received later by
the latency. Names are the tracker's own; obstacles are larger by the margin that their covariances give.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from apex_ompl.drivers.driver import Driver
from apex_ompl.drivers.mujoco import MujocoDriver
from apex_ompl.errors import ParameterError
from apex_ompl.loop.environment import Environment, Observation
from apex_ompl.perception.camera import Camera
from apex_ompl.perception.obstacle_settings import ObstacleSettings
from apex_ompl.perception.obstacles import ObstacleFinder
from apex_ompl.perception.registration import RegistrationSettings, corrected
from apex_ompl.perception.rendered_camera import RenderedCamera
from apex_ompl.perception.rig import Eye, check_cameras, default_cameras, misplaced, noisy
from apex_ompl.perception.surfaces import RobotSurface, body_box
from apex_ompl.perception.tracking import ObstacleTracker, TrackedObstacle, TrackerSettings
from apex_ompl.perception.twin_camera import TwinCamera
from apex_ompl.robot import Robot, load_robot
from apex_ompl.scene.bodies import AttachedObject, Obstacle
from apex_ompl.util.display import fields_line
from apex_ompl.util.validation import check_number, check_positive, check_seed

WIDTH = 320  # of the default cameras [pixels]
LOW, HIGH = (-0.8, -1.2, -0.05), (1.5, 1.2, 1.6)  # corners of the space beyond which no obstacle counts [m]
SPREAD = 0.01  # by which held objects are larger, in which no obstacle has its center [m]
TURNING = TrackerSettings(births=1, of=1, longest=3.0, gate=25.0, power=0.2, margin=1.0, slack=0.004)
"""Settings of obstacles that may turn around between two frames."""
EARLY = 1e-6  # of a frame [s]


class CameraSensor:
    """Observations of dynamic obstacles by cameras.

    Attributes:
        eyes: The cameras.
        robot: The robot.
        attached: What it holds.
        rate: Frames a second of each camera [1/s].
        latency: Time from a frame to its observation [s].
        error: Largest error of the position that the margin does not hold [m].
        named: Whether names are those of the environment.
        tracker: The tracker.
        tracked: What it has tracked so far.
    """

    named = False

    def __init__(
        self, eyes: Sequence[Eye], robot: Robot, attached: Sequence[AttachedObject] = (), *, rate: float = 30.0,
        latency: float = 0.03, error: float = 0.006, obstacles: ObstacleSettings | None = None,
        tracker: TrackerSettings | None = None, registration: RegistrationSettings | None = None,
    ) -> None:  # fmt: skip
        """Set up the finder and the tracker.

        Raises:
            MissingFileError: The extra ``perception`` is not installed.
            ParameterError: There is no camera, or a number is out of its range.
        """
        check_positive(rate, "rate", "a positive number of frames a second")
        check_number(latency, "latency", 0.0)
        check_number(error, "error", 0.0)
        if not eyes:
            raise ParameterError("eyes", "none", "one camera or more")
        self.eyes, self.robot, self.attached = tuple(eyes), robot, tuple(attached)
        self.rate, self.latency, self.error = rate, latency, error
        self._finder, self.tracker = ObstacleFinder(obstacles), ObstacleTracker(tracker)
        self.tracked: tuple[TrackedObstacle, ...] = ()
        self._surface, self._registration = RobotSurface(robot), registration or RegistrationSettings()
        self._boxes = [body_box(one, SPREAD) for one in self.attached]
        self._next = -np.inf

    __repr__ = fields_line

    def read(self, now: float) -> Observation | None:
        """Return what the cameras see at a time [s], where it is time for a frame, else None.

        Frames have stamps on the same clock; that of the last one counts.

        Raises:
            ParameterError: A frame has no colors.
        """
        if now < self._next - EARLY:
            return None
        self._next = (now if np.isinf(self._next) else self._next) + 1.0 / self.rate
        gone: list[str] = []
        seen, stamp = set(), -np.inf
        for eye in self.eyes:
            frame = eye.frame()
            if frame.color is None:
                raise ParameterError("eyes", f"{frame.camera.name!r} without colors", "frames with colors")
            stamp = max(stamp, frame.stamp)
            given = corrected(frame, self._surface, self._registration)
            held = [self.robot.link_pose(given.registration.state, one.link) @ one.pose for one in self.attached]
            found = self._finder.find(given, frame.color, list(zip(held, self._boxes, strict=True)))
            self.tracked = self.tracker.update(stamp, found, given)
            gone += self.tracker.gone
            seen |= {one.name for one in self.tracked if one.observed is not None}
        there = [one for one in self.tracked if one.name in seen]
        low, high = np.array(self._finder.settings.low), np.array(self._finder.settings.high)
        for one in self.tracked:
            place = one.pose[:3, 3]
            if one.name not in seen and not ((place > low) & (place < high)).all():
                gone.append(one.name)
        errors = {one.name: self.error for one in there}
        solids, received = tuple(one.solid for one in there), stamp + self.latency
        velocities = {one.name: (one.velocity, one.speed_deviation) for one in there}
        return Observation(
            stamp, received, solids, errors, tuple(dict.fromkeys(gone)), bounds=True, velocities=velocities
        )  # fmt: skip

    def close(self) -> None:
        """Release what draws the images."""
        for eye in self.eyes:
            getattr(eye, "close", tuple)()


@dataclass(frozen=True)
class Cameras:
    """Simulated cameras as a sensor of a run: ``apex_ompl.run(..., driver="kinematic", sensor=Cameras())``.

    A robot in physics is drawn by MuJoCo, others by the kernel's renderer. Poses and depths of the cameras are off by
    their spreads.

    Attributes:
        cameras: The cameras, as they are reported.
        rate: Frames a second of each camera [1/s].
        latency: Time from a frame to its observation [s].
        error: Largest error of the position that the margin does not hold [m].
        obstacles: What obstacles look like.
        tracker: Settings of the tracker.
        rendered: Whether the kernel's renderer draws a robot in physics, too, which is faster.
        seed: Seed of errors and noise.
    """

    cameras: tuple[Camera, ...] = field(default_factory=lambda: default_cameras(WIDTH))
    rate: float = 30.0
    latency: float = 0.03
    error: float = 0.006
    obstacles: ObstacleSettings = field(default_factory=lambda: ObstacleSettings(low=LOW, high=HIGH))
    tracker: TrackerSettings = field(default_factory=lambda: TURNING)
    rendered: bool = False
    seed: int = 0

    def __post_init__(self) -> None:
        """Check all.

        Raises:
            ParameterError: There is no camera, or a number is out of its range.
        """
        check_cameras(self.cameras)
        check_positive(self.rate, "rate", "a positive number of frames a second")
        check_number(self.latency, "latency", 0.0)
        check_number(self.error, "error", 0.0)
        check_seed(self.seed)

    @property
    def largest_error(self) -> float:
        """Largest error of positions on which the guarantee rests [m]."""
        return self.error

    def as_dict(self) -> dict[str, Any]:
        """Return what a result says of it."""
        names = [camera.name for camera in self.cameras]
        return {"cameras": names, "rate": self.rate, "latency": self.latency}

    def __call__(self, driver: Driver, environment: Environment) -> CameraSensor:
        """Return the sensor at work for a driver's robot in an environment.

        Raises:
            ApexError: A camera's link is unknown, a body has no surface, or an extra is not installed.
        """
        problem = environment.problem.still
        robot, zero = load_robot(problem.robot), driver.time
        eyes: list[Eye] = []

        def others(time: float) -> tuple[Obstacle, ...]:
            return environment.present(time - zero)

        for k, camera in enumerate(self.cameras):
            rng = np.random.default_rng((self.seed, k))
            true = misplaced(camera, rng)
            measured = noisy(true, rng)
            if isinstance(driver, MujocoDriver) and not self.rendered:
                eyes.append(TwinCamera(driver, true, reported=camera, measured=measured, others=others))
            else:
                eyes.append(
                    RenderedCamera(driver, robot, problem, true, reported=camera, measured=measured, others=others)
                )
        return CameraSensor(
            eyes, robot, problem.attached, rate=self.rate, latency=self.latency, error=self.error,
            obstacles=self.obstacles, tracker=self.tracker,
        )  # fmt: skip
