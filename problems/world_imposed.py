"""Cubes that are brought into the way of the robot's first motion, and stand: ``imposed``.

This is the paper's experiment with obstacles that "are imposed manually": one is brought in while the robots move, and
stays until it is moved again. Distances, speeds and times are this project's own choice. The cube comes into view
beside the way, moves at constant speed to where a hand will be, and stands; the first motion is clear of it until half
a second after that, and all of its way is 0.12 m from the robot when it sets out, so that a robot that stops for what
it sees is not hit. A cube of ``popup`` comes into being at once, nearer to the hand, and moves on for ever if it moves.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from apex_ompl.problems.world_ambushes import (
    CLEARANCE,
    GOAL_CLEARANCE,
    SPEEDS,
    AmbushEnvironment,
    moment_of,
)
from apex_ompl.problems.world_robot import cube
from apex_ompl.scene.problem import Problem
from apex_ompl.scene.scripts import place_at, row_of
from apex_ompl.timing import Trajectory
from apex_ompl.types import Array

DRAWS = 1000  # of a cube
AGAIN_DRAWS = 200  # of where one that is moved again goes
SHARES = (0.05, 0.4)  # of the first motion's length, at which the cube comes into view
COMING = (0.3, 1.0)  # for which it comes [s]
NOTICE = 0.5  # after it stands, or after it comes into view where no draw leaves that, before the motion meets it [s]
AGAIN_SHARE = 0.5  # of the cubes that are moved once more
STANDS = (2.0, 5.0)  # before it is moved again [s]
WAYS = (0.2, 0.5)  # that it is moved then [m]
APART = 0.12  # of each of its ways to the robot when the cube sets out [m]
STEP, MOMENT = 0.02, 0.02  # between two places and between two times that are looked at [m, s]


class _Coming(NamedTuple):
    """When a cube comes into view on the first motion [s], where, shape (3,) [m], when it stands, and where."""

    begins: float
    here: Array
    stands: float
    there: Array


class ImposedEnvironment(AmbushEnvironment):
    """A cube is brought into the way of the first motion, and stands; half of the cubes are moved again later.

    It stands clear of the goals, so that there may be a way round it. Moved again, it goes on to where it is clear of
    the robot and of the goals. Where no draw has room, there is no cube.
    """

    def __init__(self, name: str, problem: Problem, edge: float, rng: np.random.Generator) -> None:
        """Draw the speed, and whether the cube is moved again; see :class:`AmbushEnvironment`."""
        super().__init__(name, problem, edge, rng, float(rng.uniform(*SPEEDS)))
        again = rng.random() < AGAIN_SHARE
        self._waits = float(rng.uniform(*STANDS)) if again else math.inf
        self._coming: _Coming | None = None
        self._moved_again = math.inf

    def start(self, motion: Trajectory, time: float) -> None:
        """Take the first motion, and when it starts [s]: decide how the cube comes.

        Raises:
            ParameterError: The time is before the last step.
        """
        super().start(motion, time)
        for number in range(DRAWS):
            drawn = self._drawn(motion, noticed_standing=2 * number < DRAWS)
            if drawn is None:
                continue
            self._coming = _Coming(time + drawn.begins, drawn.here, time + drawn.stands, drawn.there)
            return

    def advance(self, time: float, q: Array) -> None:
        """Take the robot's state, shape (dof,), at a time [s].

        A cube whose way is nearer to the robot than ``APART`` when it would set out does not come.

        Raises:
            ParameterError: The time is before the last step.
        """
        super().advance(time, q)
        q = np.asarray(q, float)
        if self._coming is not None and time >= self._coming.begins:
            self._come(self._coming, time, q)
        if time >= self._moved_again:
            self._move_again(time, q)

    def _come(self, coming: _Coming, time: float, q: Array) -> None:
        """Bring the cube in, or never, with the robot at a state, shape (dof,), at a time [s]."""
        self._coming = None
        if not self._has_room(coming.here, coming.there, q):
            return
        later = time - coming.begins
        begins, stands = row_of(time, coming.here), row_of(coming.stands + later, coming.there)
        script, made = (row_of(0.0, coming.here), begins, stands), cube("cube_0", self._edge, coming.here)
        self._obstacles = (made.model_copy(update={"trajectory": script, "appears": time}),)
        self._moved_again = self.foreseen = stands[0] + self._waits

    def _move_again(self, time: float, q: Array) -> None:
        """Move the cube once more, with the robot at a state, shape (dof,), at a time [s]."""
        self._moved_again = self.foreseen = math.inf
        (one,) = self._obstacles
        here = place_at(one, time)
        there = self._next(here, q)
        assert one.trajectory is not None
        lasts = float(np.linalg.norm(there - here)) / self.fastest
        if lasts > 0.0:
            script = (*one.trajectory, row_of(time, here), row_of(time + lasts, there))
            self._obstacles = (one.model_copy(update={"trajectory": script}),)

    def _has_room(self, here: Array, there: Array, q: Array) -> bool:
        """Whether a cube may move from a place to another, both shape (3,) [m], with the robot at a state."""
        balls = self._robot.balls(q)
        places = np.linspace(here, there, 2 + math.ceil(float(np.linalg.norm(there - here)) / STEP))
        return all(balls.clearance(place, self._edge) >= APART for place in places)

    def _drawn(self, motion: Trajectory, noticed_standing: bool) -> _Coming | None:
        """Return how a cube comes that the motion would meet, or None."""
        rng, robot = self._rng, self._robot
        begins, lasts = moment_of(motion, rng.uniform(*SHARES)), rng.uniform(*COMING)
        angle, link = rng.uniform(0.0, 2.0 * np.pi), robot.hands[int(rng.integers(len(robot.hands)))]
        stands = begins + lasts
        noticed = (stands if noticed_standing else begins) + NOTICE
        if noticed >= motion.duration:
            return None
        heading = np.array([np.cos(angle), np.sin(angle), 0.0])
        velocity, short = self.fastest * heading, rng.uniform(0.0, self._edge / 2.0)
        there = robot.hand(motion(rng.uniform(noticed, motion.duration)), link) - short * heading
        there[2] = max(there[2], self._edge / 2.0)
        here = there - lasts * velocity
        if self._robot.around.entry(here, velocity, self._edge)[0] < lasts:
            return None
        if not all(self._is_free(there, q, GOAL_CLEARANCE) for q in (*robot.goals, motion.positions[-1])):
            return None
        if not self._has_room(here, there, motion(begins)):
            return None
        way = ((t, here + min(t - begins, lasts) * velocity) for t in self._times(begins, noticed))
        if not all(self._is_free(place, motion(t), CLEARANCE) for t, place in way):
            return None
        rest = self._times(noticed, motion.duration)
        if all(self._is_free(here + min(t - begins, lasts) * velocity, motion(t), 0.0) for t in rest):
            return None
        return _Coming(begins, here, stands, there)

    def _times(self, first: float, last: float) -> list[float]:
        """Return times between two, ``MOMENT`` apart at most [s]."""
        times: list[float] = np.linspace(first, last, 2 + math.ceil((last - first) / MOMENT)).tolist()
        return times

    def _next(self, here: Array, q: Array) -> Array:
        """Return where a cube that stands here is moved to with the robot at a state, both shape (3,) [m]."""
        for _ in range(AGAIN_DRAWS):
            angle, length = self._rng.uniform(0.0, 2.0 * np.pi), self._rng.uniform(*WAYS)
            heading = np.array([np.cos(angle), np.sin(angle), 0.0])
            there = here + length * heading
            if self._robot.around.entry(here, heading, self._edge)[0] < length:
                continue
            if not all(self._is_free(there, goal, GOAL_CLEARANCE) for goal in self._robot.goals):
                continue
            if self._has_room(here, there, q):
                return np.asarray(there)
        return here
