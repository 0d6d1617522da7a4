"""Worlds in which obstacles move while a robot executes: scripted ones, and ones that answer to what the robot does."""

from __future__ import annotations

from abc import ABC, abstractmethod

from apex_ompl.scene.bodies import Obstacle
from apex_ompl.scene.problem import Problem
from apex_ompl.trajectory import Trajectory
from apex_ompl.types import Array


class World(ABC):
    """What truly happens in a run.

    A run calls ``begin`` once, when its first motion is committed, and ``advance`` at every step of its clock, with
    times that increase from 0; ``present`` may be asked about any time up to the last step.

    Attributes:
        name: Its name, such as ``popup/12``.
        problem: What stands still, start and goal, and what is held.
        fastest: Largest speed of its obstacles [m/s].
    """

    name: str
    problem: Problem
    fastest: float

    def begin(self, motion: Trajectory, time: float) -> None:  # noqa: B027 - most worlds do not care
        """Take the first motion that the robot is to follow, and when it begins [s]."""

    def advance(self, time: float, q: Array) -> None:  # noqa: B027
        """Take the robot's state, shape (dof,), at a time [s]."""

    @abstractmethod
    def present(self, time: float) -> tuple[Obstacle, ...]:
        """Return the moving obstacles that are there at a time [s], where they are then, with their velocities."""

    @abstractmethod
    def script(self) -> tuple[Obstacle, ...]:
        """Return what the moving obstacles did up to the last step: obstacles with ``trajectory`` and ``appears``."""
