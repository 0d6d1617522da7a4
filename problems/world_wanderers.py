"""Cubes that wander in front of the robot: ``turning`` and ``crowd``.

Boxes, speeds and times are this project's own choice. A cube keeps inside a box around the places of held objects, and
outside of a column above each base, where an arm could not evade it; it is reflected there. Cubes pass through each
other, and through what stands still.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from apex_ompl.problems.catalogue import SuiteError
from apex_ompl.problems.world_robot import RobotPlaces, Surroundings, cube
from apex_ompl.problems.worlds import ScriptedEnvironment
from apex_ompl.scene.bodies import Obstacle, PlaceInTime
from apex_ompl.scene.problem import Problem
from apex_ompl.scene.scripts import row_of
from apex_ompl.types import Array

SPEEDS = (0.1, 0.4)  # of which each cube draws one [m/s]
LEGS = (0.5, 2.0)  # between turns [s]
START_CLEARANCE = 0.05  # of the robot to a cube at time 0 [m]
PLACES = 200  # tried for a cube
SHORTEST = 1e-9  # time between two rows of a script [s]
AHEAD = 10.0  # by which scripts are longer than asked for [s]
CROWD = 3


@dataclass(eq=False)
class Wanderer:
    """The way of one cube: straight lines between turns and reflections.

    Attributes:
        rng: Source of its turns.
        around: Surroundings of the robot.
        edge: Of the cube [m].
        velocity: Shape (3,) [m/s].
        rows: Its way so far.
        turns: Whether it turns by itself.
    """

    rng: np.random.Generator
    around: Surroundings
    edge: float
    velocity: Array
    rows: list[PlaceInTime]
    turns: bool
    _turn: float = field(init=False)

    def __post_init__(self) -> None:
        """Draw the time of the first turn."""
        self._turn = self.rng.uniform(*LEGS) if self.turns else np.inf

    def go_on(self) -> None:
        """Append the row of the next turn or reflection."""
        time, place = self.rows[-1][0], np.array(self.rows[-1][1:])
        low, high = self.around.box(self.edge)
        while time - self.rows[-1][0] <= SHORTEST:  # in a corner several sides reflect it at once
            ways = np.where(self.velocity > 0.0, high - place, low - place)
            with np.errstate(divide="ignore", invalid="ignore"):
                walls = np.where(self.velocity == 0.0, np.inf, ways / self.velocity)
            at_wall, at_base = float(walls.min()), self.around.entry(place, self.velocity, self.edge)
            step, axis = min((max(at_wall, 0.0), int(walls.argmin())), at_base)
            if self._turn - time < step:
                step, axis = self._turn - time, -1
            place = place + step * self.velocity
            time += step
            if axis < 0:
                speed = float(np.linalg.norm(self.velocity))
                self.velocity = speed * direction(self.rng)
                self._turn += self.rng.uniform(*LEGS)
            else:
                self.velocity = np.where(np.arange(3) == axis, -self.velocity, self.velocity)
        self.rows.append(row_of(time, np.clip(place, low, high)))


def direction(rng: np.random.Generator) -> Array:
    """Return a direction, evenly over the sphere, shape (3,)."""
    drawn = rng.normal(size=3)
    return np.asarray(drawn / np.linalg.norm(drawn))


class WanderersEnvironment(ScriptedEnvironment):
    """Cubes at constant speed, each one its own, that are reflected, and that turn if they are told to.

    They do not depend on what the robot does.
    """

    def __init__(self, name: str, problem: Problem, edge: float, rng: np.random.Generator, turns: bool):
        """Draw the cubes.

        Args:
            name: Name of the world.
            problem: What stands still.
            edge: Of the cubes [m].
            rng: Source of their places, speeds and directions.
            turns: Whether it is one cube that takes a new direction after each leg, or ``CROWD`` that do not.

        Raises:
            SuiteError: There is no place for a cube.
        """
        robot = RobotPlaces(problem)
        self._ways = [_wanderer(robot, edge, stream, turns) for stream in rng.spawn(1 if turns else CROWD)]
        cubes = tuple(cube(f"cube_{k}", edge, np.array(way.rows[0][1:])) for k, way in enumerate(self._ways))
        super().__init__(name, problem, cubes, max(float(np.linalg.norm(way.velocity)) for way in self._ways))

    def _until(self, time: float) -> tuple[Obstacle, ...]:
        if min(way.rows[-1][0] for way in self._ways) <= time:
            for way in self._ways:
                while way.rows[-1][0] <= time + AHEAD:
                    way.go_on()
            scripts = [tuple(way.rows) for way in self._ways]
            known = zip(self._obstacles, scripts, strict=True)
            self._obstacles = tuple(o.model_copy(update={"trajectory": rows}) for o, rows in known)
        return self._obstacles


def _wanderer(robot: RobotPlaces, edge: float, rng: np.random.Generator, turns: bool) -> Wanderer:
    balls, (low, high) = robot.balls(robot.start), robot.around.box(edge)
    for _ in range(PLACES):
        place, velocity = rng.uniform(low, high), rng.uniform(*SPEEDS) * direction(rng)
        if robot.around.entry(place, velocity, edge)[0] > 0.0 and balls.clearance(place, edge) >= START_CLEARANCE:
            return Wanderer(rng, robot.around, edge, velocity, [row_of(0.0, place)], turns)
    raise SuiteError(f"{robot.problem.name}: no place for a cube of {edge:g} m was found in {PLACES} draws")
