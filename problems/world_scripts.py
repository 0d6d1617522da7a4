"""Environments whose obstacles move by records of the scene: fixed from the start, or made when the robot starts."""

from __future__ import annotations

import math

from apex_ompl.errors import ParameterError
from apex_ompl.problems.worlds import DynamicEnvironment
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.scene.problem import Problem
from apex_ompl.scene.scripts import fastest, is_there, obstacle_at, recorded
from apex_ompl.timing import Trajectory
from apex_ompl.types import Array
from apex_ompl.util.validation import check_number


class ScriptedEnvironment(DynamicEnvironment):
    """An environment of obstacles with a velocity or a script.

    Attributes:
        foreseen: Time up to which ``present`` may be asked, besides the last step [s]; infinite where all is fixed.
    """

    foreseen: float = math.inf

    def __init__(self, name: str, problem: Problem, obstacles: tuple[Obstacle, ...], fastest: float) -> None:
        """Make an environment.

        Args:
            name: Its name.
            problem: Static obstacles, start and goal.
            obstacles: Moving obstacles, from time 0 on.
            fastest: Their largest speed [m/s].
        """
        self.name, self.problem, self.fastest = name, problem, fastest
        self._obstacles = obstacles
        self._now = 0.0

    def start(self, motion: Trajectory, time: float) -> None:
        """Take the first motion, and when it starts [s].

        Raises:
            ParameterError: The time is before the last step.
        """
        check_number(time, "time", self._now)

    def advance(self, time: float, q: Array) -> None:
        """Take the robot's state, shape (dof,), at a time [s].

        Raises:
            ParameterError: The time is before the last step.
        """
        check_number(time, "time", self._now)
        self._now = float(time)

    def present(self, time: float) -> tuple[Obstacle, ...]:
        """Return the moving obstacles that are there at a time [s], where they are then, with their velocities.

        Before time 0 obstacles of constant velocity move, and scripts stand.

        Raises:
            ParameterError: It is not decided yet what will be then.
        """
        check_number(time, "time", high=max(self._now, self.foreseen))
        return tuple(obstacle_at(o, time) for o in self._until(time) if is_there(o, time))

    def script(self) -> tuple[Obstacle, ...]:
        """Return what the moving obstacles did up to the last step."""
        return tuple(recorded(o, self._now) for o in self._until(self._now) if is_there(o, self._now))

    def _until(self, time: float) -> tuple[Obstacle, ...]:
        """Return the obstacles, with scripts that last longer than up to a time [s]; of wanderers overridden."""
        return self._obstacles


def environment_of(problem: Problem) -> ScriptedEnvironment:
    """Return the environment of a problem's own obstacles, which move by their records whatever the robot does.

    Obstacles with a velocity move for ever.

    Raises:
        ParameterError: A pair of bodies that may touch names an obstacle that moves.
    """
    touching = next((pair for pair in problem.allowed if {*pair} & {*problem.moving}), None)
    if touching is not None:
        raise ParameterError("allowed", touching, "no obstacle that moves in a pair that may touch")
    dynamic = tuple(o for o in problem.scene if o.moving)
    return ScriptedEnvironment(problem.name, problem.still, dynamic, max(map(fastest, dynamic), default=0.0))
