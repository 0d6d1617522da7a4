"""Cubes that answer to the robot: ``popup``, which comes into being before it, ``interceptor`` and ``pusher``.

That an obstacle is put into the way while the robot moves is the paper's experiment; distances, speeds and times are
this project's own choice. A cube that moves does so horizontally, for ever, and does not come to where an arm cannot
evade it. Where no draw has room, there is no cube. A pusher comes towards the robot and leaves again, as a hand of a
person does.
"""

from __future__ import annotations

import math

import numpy as np

from apex_ompl.problems.catalogue import SuiteError
from apex_ompl.problems.world_robot import RobotPlaces, cube
from apex_ompl.problems.worlds import ScriptedEnvironment
from apex_ompl.scene.bodies import PlaceInTime
from apex_ompl.scene.problem import Problem
from apex_ompl.scene.scripts import place_at, row_of
from apex_ompl.timing import Trajectory
from apex_ompl.types import Array

SPEEDS = (0.1, 0.4)  # [m/s]
DRAWS = 200  # of a cube; the first half of those of ``popup`` must be in the way
STILL_SHARE = 0.5  # of the cubes of ``popup`` that stand
SHARES = (0.2, 0.7)  # of the first motion's length, at which a cube comes into being
DISTANCES = (0.25, 0.6)  # from a hand to the front of that cube [m]
PATH_STATES, REST_STATES = 201, 30  # of a motion for its length, and of its rest for whether a cube is in the way
WINDOW = 0.05  # of time, for the direction of a hand [s]
LEAST_SPEED = 0.02  # of a hand that a cube appears before [m/s]
PLANNED_CLEARANCE, CLEARANCE = (
    0.08,
    0.04,
)  # of the robot to a cube when it appears: as it is drawn, and least; of ``interceptor`` at the start [m]
LEAST_HEADING = 0.02  # way of a cube that moves to where the hand is going [m]
GOAL_CLEARANCE = 0.03  # of a cube that stands to the goal [m]
LEADS = (0.4, 1.5)  # between the start of the first motion and its meeting with a cube [s]


class AmbushEnvironment(ScriptedEnvironment):
    """A world of one cube, which is made by the robot's first motion."""

    foreseen = -math.inf

    def __init__(self, name: str, problem: Problem, edge: float, rng: np.random.Generator, speed: float) -> None:
        """Make a world without a cube yet.

        Args:
            name: Name of the world.
            problem: What stands still.
            edge: Of the cube [m].
            rng: Source of all that is drawn.
            speed: Of the cube [m/s].
        """
        super().__init__(name, problem, (), speed)
        self._robot, self._edge, self._rng = RobotPlaces(problem), edge, rng

    def _is_free(self, place: Array, q: Array, gap: float) -> bool:
        """Whether a cube at a place, shape (3,) [m], leaves a gap to the robot at a state, shape (dof,) [m]."""
        return self._robot.balls(q).clearance(place, self._edge) >= gap

    def _make(self, place: Array, velocity: Array, time: float) -> None:
        """Make the cube at a place, shape (3,) [m], and at a time [s], which fixes its motion."""
        made = cube("cube_0", self._edge, place - time * velocity, velocity)
        self._obstacles, self.foreseen = (made.model_copy(update={"appears": float(time)}),), math.inf


class PopupEnvironment(AmbushEnvironment):
    """A cube comes into being .25 to .6 m before a hand, in the direction of the hand's motion.

    It does so when the robot has done a share of its first motion, or as soon after that as it has room. It stands,
    clear of the goal, or moves towards where the hand is going. It is in the way of the rest of the first motion,
    unless no draw is.
    """

    def __init__(self, name: str, problem: Problem, edge: float, rng: np.random.Generator) -> None:
        """Draw whether and how fast the cube moves; see :class:`AmbushEnvironment`."""
        super().__init__(name, problem, edge, rng, 0.0 if rng.random() < STILL_SHARE else float(rng.uniform(*SPEEDS)))
        self._planned: tuple[float, Array, Array] | None = None

    def start(self, motion: Trajectory, time: float) -> None:
        """Take the first motion, and when it starts [s]: decide when and where the cube will come into being.

        Raises:
            ParameterError: The time is before the last step.
        """
        super().start(motion, time)
        for number in range(DRAWS):
            drawn = self._drawn(motion, in_the_way=2 * number < DRAWS)
            if drawn is not None:
                self._planned = (time + drawn[0], *drawn[1:])
                return

    def advance(self, time: float, q: Array) -> None:
        """Take the robot's state, shape (dof,), at a time [s].

        Raises:
            ParameterError: The time is before the last step.
        """
        super().advance(time, q)
        if self._obstacles or self._planned is None or time < self._planned[0]:
            return
        if self._is_free(self._planned[1], np.asarray(q, float), CLEARANCE):
            self._make(self._planned[1], self._planned[2], time)

    def _drawn(self, motion: Trajectory, in_the_way: bool) -> tuple[float, Array, Array] | None:
        """Return time on the motion [s], place, shape (3,) [m], and velocity of a cube [m/s], or None."""
        rng, robot = self._rng, self._robot
        moment = moment_of(motion, rng.uniform(*SHARES))
        link, distance = robot.hands[int(rng.integers(len(robot.hands)))], rng.uniform(*DISTANCES) + self._edge / 2.0
        around = np.clip([moment - WINDOW, moment + WINDOW], 0.0, motion.duration)
        before, here, after, last = (
            robot.hand(motion(t), link) for t in (around[0], moment, around[1], motion.duration)
        )
        span, way = float(np.ptp(around)), after - before
        if span == 0.0 or np.linalg.norm(way) < LEAST_SPEED * span:
            return None
        place = here + distance / np.linalg.norm(way) * way
        place[2] = max(place[2], self._edge / 2.0)
        velocity, heading = np.zeros(3), last[:2] - place[:2]
        if self.fastest > 0.0:
            if np.linalg.norm(heading) < LEAST_HEADING:
                return None
            velocity[:2] = self.fastest / np.linalg.norm(heading) * heading
        elif not all(self._is_free(place, q, GOAL_CLEARANCE) for q in (*robot.goals, motion.positions[-1])):
            return None
        if self._robot.around.entry(place, velocity, self._edge)[0] < np.inf:
            return None
        if not self._is_free(place, motion(moment), PLANNED_CLEARANCE):
            return None
        rest = np.linspace(moment, motion.duration, REST_STATES) if in_the_way else np.zeros(0)
        meets = (not self._is_free(place + (t - moment) * velocity, motion(t), 0.0) for t in rest)
        return (moment, place, velocity) if any(meets) or not in_the_way else None


class InterceptorEnvironment(AmbushEnvironment):
    """A cube at constant velocity would meet a hand .4 to 1.5 s after the start of the first motion.

    It is there from that start on, clear of the robot then, and its front face comes to where the motion has the hand,
    at its end if it ends before.
    """

    def __init__(self, name: str, problem: Problem, edge: float, rng: np.random.Generator) -> None:
        """Draw the speed; see :class:`AmbushEnvironment`."""
        super().__init__(name, problem, edge, rng, float(rng.uniform(*SPEEDS)))

    def start(self, motion: Trajectory, time: float) -> None:
        """Take the first motion, and when it starts [s]: the cube exists afterwards.

        Raises:
            ParameterError: The time is before the last step.
        """
        super().start(motion, time)
        rng, robot = self._rng, self._robot
        for _ in range(DRAWS):
            lead, link = rng.uniform(*LEADS), robot.hands[int(rng.integers(len(robot.hands)))]
            angle = rng.uniform(0.0, 2.0 * np.pi)
            heading = np.array([np.cos(angle), np.sin(angle), 0.0])
            meeting = robot.hand(motion(min(lead, motion.duration)), link) - self._edge / 2.0 * heading
            meeting[2] = max(meeting[2], self._edge / 2.0)
            velocity = self.fastest * heading
            place = meeting - lead * velocity
            if self._robot.around.entry(place, velocity, self._edge)[0] == np.inf and self._is_free(
                place, motion.positions[0], CLEARANCE
            ):
                self._make(place, velocity, time)
                return


def moment_of(motion: Trajectory, share: float) -> float:
    """Return when a motion has done a share of its length in joint space [s]; half of its time where it has none."""
    times = np.linspace(0.0, motion.duration, PATH_STATES)
    steps = np.linalg.norm(np.diff(motion(times), axis=0), axis=1)
    done = np.append(0.0, np.cumsum(steps))
    return float(np.interp(share * done[-1], done, times)) if done[-1] > 0.0 else share * motion.duration


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
        return np.zeros(3) if self._robot.around.entry(here, velocity, self._edge)[0] < 2.0 * PERIOD else velocity


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
                if robot.around.entry(place, np.zeros(3), edge)[0] > 0.0:
                    return place
                break
    raise SuiteError(f"{robot.problem.name}: no place for a cube of {edge:g} m was found in {PLACES} draws")
