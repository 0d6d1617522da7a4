"""What the closed loop runs in: the environment with its moving obstacles, and what a sensor observes of them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Protocol

from numpy.typing import ArrayLike

from apex_ompl.scene.bodies import Obstacle
from apex_ompl.scene.problem import Problem
from apex_ompl.timing import Trajectory
from apex_ompl.types import Array
from apex_ompl.util.display import fields_line


class Environment(Protocol):
    """What the robot and the obstacles truly do in a run.

    The clock of a run calls ``advance`` at each of its steps, with times that increase from 0 and the state that the
    robot's driver reached, and ``start`` once, when the first motion is committed. ``present`` may be asked about any
    time up to the last step; sensors observe what it returns.

    Attributes:
        name: Its name, such as ``popup/vertical/large/12``.
        problem: Static obstacles, start and goal, and held objects.
        fastest: Largest speed of its obstacles [m/s].
        ran: Whether a run was made in it; each is good for one.
    """

    name: str
    problem: Problem
    fastest: float
    ran: bool

    def start(self, motion: Trajectory, time: float) -> None:
        """Take the first motion that the robot is to follow, and when it starts [s]."""

    def advance(self, time: float, q: Array) -> None:
        """Take the robot's state, shape (dof,), at a time [s]."""

    def present(self, time: float) -> tuple[Obstacle, ...]:
        """Return the moving obstacles that exist at a time [s], where they are then, with their velocities."""

    def script(self) -> tuple[Obstacle, ...]:
        """Return what the moving obstacles did up to the last step: obstacles with ``trajectory`` and ``appears``."""


@dataclass(frozen=True)
class Observation:
    """Moving obstacles that a sensor saw at one moment.

    Attributes:
        stamp: When they were where they were seen [s].
        received: When the loop receives the observation [s], not before the stamp.
        seen: The obstacles with their shapes where they were seen, by name, without velocities. A known obstacle that
            is missing here was not seen, which tells nothing about where it is.
        errors: Errors of positions by names of obstacles, in place of the largest error of the settings: a largest
            distance [m], or a covariance of the position, shape (3, 3) [m^2], of which three standard deviations along
            its longest axis count.
        gone: Names of obstacles that are not there any more.
        bounds: Whether shapes are bounds: bodies that contain the obstacles, up to the errors, and change as more of
            an obstacle is seen. Only bounds that are apart contradict each other, wherever their centers are.
        velocities: What a sensor that tracks obstacles itself knows of their velocities, by names: a velocity, shape
            (3,), and its standard deviation on each axis [m/s]. It counts where it is known better than by the places
            seen, such as while the bounds of an obstacle still change.
    """

    stamp: float
    received: float
    seen: tuple[Obstacle, ...]
    errors: Mapping[str, ArrayLike] = field(default_factory=dict)
    gone: tuple[str, ...] = ()
    bounds: bool = False
    velocities: Mapping[str, tuple[ArrayLike, float]] = field(default_factory=dict)

    __repr__ = fields_line


class ObservationSource(Protocol):
    """A sensor at work."""

    def observations(self, until: float) -> Iterable[Observation]:
        """Return the observations with stamps up to a time [s] that were not returned before, in order of stamp."""


class LiveSensor(Protocol):
    """A sensor of one's own.

    With an attribute ``named`` that is false, names of obstacles are its own and not those of the environment: the
    robot then starts with the first observation, whatever is in it.
    """

    def read(self, now: float) -> Observation | None:
        """Return what it saw since the last call, or None; called once in each period.

        Args:
            now: Time on the clock of the run [s]: the driver's, or the time since the start of the run. Stamps are of
                that clock.
        """
