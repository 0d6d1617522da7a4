"""A cube that comes towards the robot and leaves again, as a hand of a person does: ``pusher``.

Speed, distances and times are this project's own choice.
"""

from __future__ import annotations

import math

import numpy as np

from apex_ompl.problems.catalogue import SuiteError
from apex_ompl.problems.world_robot import RobotPlaces, base_entry, cube
from apex_ompl.problems.worlds import ScriptedEnvironment
from apex_ompl.scene.bodies import PlaceInTime
from apex_ompl.scene.problem import Problem
from apex_ompl.scene.scripts import place_at, row_of
from apex_ompl.timing import Trajectory
from apex_ompl.types import Array

SPEED = 0.15  # [m/s]
STAYS = 3.0  # from when it sets out to when it turns back [s]
WAITS = (0.0, 1.0)  # after the start of the first motion, before it starts [s]
PERIOD = 0.1  # least time between two of its decisions [s]
GAPS = (0.25, 0.4)  # to the robot at the start, from outside [m]
SIDE = math.radians(70.0)  # largest angle between the direction that it comes from and the front
FARTHEST, SCAN, PLACES = 1.5, 0.02, 200  # of its place from a hand [m], steps in looking for it [m], draws
ROUNDING = 1e-9  # of times [s]


class PusherEnvironment(ScriptedEnvironment):
    """A cube that stands before the robot, comes towards the nearest link, and leaves the way it came.

    Links that stay at the bases are not what it comes for, and it stands before a column above a base, where an arm
    could not evade it. It decides at steps of the run, every 0.1 s at most.
    """

    foreseen = -math.inf

    def __init__(self, name: str, problem: Problem, edge: float, rng: np.random.Generator) -> None:
        """Draw where the cube stands at first, and how long it waits.

        Args:
            name: Name of the world.
            problem: What stands still.
            edge: Of the cube [m].
            rng: Source of all that is drawn.

        Raises:
            SuiteError: There is no place for the cube.
        """
        self._robot, self._edge = RobotPlaces(problem), edge
        place = _outside(self._robot, edge, rng)
        super().__init__(name, problem, (cube("cube_0", edge, place, np.zeros(3)),), SPEED)
        self._rows = [row_of(0.0, place)]
        self._wait, self._sets_out, self._decided = float(rng.uniform(*WAITS)), math.inf, -math.inf

    def start(self, motion: Trajectory, time: float) -> None:
        """Take the first motion, and when it starts [s].

        Raises:
            ParameterError: The time is before the last step.
        """
        super().start(motion, time)
        self._sets_out = time + self._wait

    def advance(self, time: float, q: Array) -> None:
        """Take the robot's state, shape (dof,), at a time [s].

        Raises:
            ParameterError: The time is before the last step.
        """
        super().advance(time, q)
        if time < self._sets_out or self.foreseen == math.inf:
            return
        here = place_at(self._obstacles[0], time)
        if time >= self._sets_out + STAYS - ROUNDING:
            self._go(time, here, [row_of(2.0 * time - row[0], row[1:]) for row in self._rows[:0:-1]])
            self.foreseen = math.inf
        elif time >= self._decided + PERIOD - ROUNDING:
            self._decided = time
            self._go(time, here, [row_of(time + STAYS, here + STAYS * self._towards(here, np.asarray(q, float)))])

    def _go(self, time: float, here: Array, then: list[PlaceInTime]) -> None:
        """Take down where it is, shape (3,) [m], at a time [s], and what it does from there unless it decides anew."""
        if time > self._rows[-1][0]:
            self._rows.append(row_of(time, here))
        later = [row for row in then if row[0] > self._rows[-1][0]]
        script = (*self._rows, *later)
        self._obstacles = (self._obstacles[0].model_copy(update={"velocity": None, "trajectory": script}),)

    def _towards(self, here: Array, q: Array) -> Array:
        """Return its velocity towards the nearest link at a state, shape (dof,), from a place; both shape (3,)."""
        balls = self._robot.balls(q, evading=True)
        outside = np.maximum(np.abs(balls.centers - here) - self._edge / 2.0, 0.0)
        nearest = balls.centers[np.argmin(np.linalg.norm(outside, axis=1) - balls.radii)]
        way = np.append(nearest[:2], max(nearest[2], self._edge / 2.0)) - here
        distance = float(np.linalg.norm(way))
        if distance < SPEED * PERIOD:
            return np.zeros(3)
        velocity = SPEED / distance * way
        return np.zeros(3) if base_entry(here, velocity, self._edge)[0] < 2.0 * PERIOD else velocity


def _outside(robot: RobotPlaces, edge: float, rng: np.random.Generator) -> Array:
    """Return a place before the robot at its start, with a gap of ``GAPS`` to it, shape (3,) [m]."""
    balls = robot.balls(robot.start)
    for _ in range(PLACES):
        hand, gap = robot.hand(robot.start, robot.hands[int(rng.integers(len(robot.hands)))]), rng.uniform(*GAPS)
        angle = rng.uniform(-SIDE, SIDE)
        for distance in np.arange(gap, FARTHEST, SCAN):
            place = hand + distance * np.array([np.cos(angle), np.sin(angle), 0.0])
            place[2] = max(place[2], edge / 2.0)
            if balls.clearance(place, edge) >= gap:
                if base_entry(place, np.zeros(3), edge)[0] > 0.0:
                    return place
                break
    raise SuiteError(f"{robot.problem.name}: no place for a cube of {edge:g} m was found in {PLACES} draws")
