"""Worlds that attack the closed loop within the assumptions of its guarantee, unlike the suites' worlds.

One or two bodies of other shapes than cubes (rods, plates, balls, cylinders, capsules, a mesh), as fast as is allowed
at any time, that stop, turn at once, and react to what the robot does; seen by one of six sensors. Everything is drawn
from a number, and nothing is tuned on them.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from apex_ompl import problems
from apex_ompl.loop.sensor import Sensor
from apex_ompl.problems.world_robot import RobotPlaces
from apex_ompl.problems.worlds import ScriptedEnvironment
from apex_ompl.scene.bodies import Obstacle, PlaceInTime
from apex_ompl.scene.scripts import row_of
from apex_ompl.types import Array

KIND, SUITES = "attack", ("vertical", "horizontal")
SENSORS = (
    {},  # the default one
    {"rate": 100.0, "age": 0.0, "noise": 0.0, "dropout": 0.0},
    {"rate": 10.0, "age": 0.15, "noise": 0.02},
    {"rate": 30.0, "age": 0.1, "noise": 0.005, "dropout": 0.2},
    {"rate": 60.0, "age": 0.02, "noise": 0.003},
    {"rate": 15.0, "age": 0.2, "noise": 0.012, "dropout": 0.05},
)
SPEEDS = (0.1, 0.2, 0.4, 0.8, 1.2)  # largest one of the bodies [m/s]
FIRST = 900_000  # seed of the first problem: the test split
PERIOD = 0.03  # time between two decisions of a body [s]
GAP, FARTHEST, STEP = (0.12, 0.5), 2.0, 0.02  # to the robot at the start, from outside [m]
LOW, HIGH = np.array([-0.4, -0.9, 0.0]), np.array([0.9, 0.9, 1.1])  # where places to go to are drawn [m]
STANDS = 1e-3  # change of a joint in a decision below which the robot stands [rad]
AHEAD = 0.15  # time by which the robot's motion is extrapolated [s]

Decide = Callable[["AttackEnvironment", float, Array, Array, Array], Array]


def wandering(world: AttackEnvironment, time: float, here: Array, q: Array, speed: Array) -> Array:
    """Go to drawn places, stop for a while, turn at once."""
    del q, speed
    rng = world.rng
    if time >= world.until:
        world.until = time + rng.uniform(0.1, 0.8)
        stands = rng.random() < 0.4
        world.target = here if stands else rng.uniform(LOW, HIGH)
    return world.target


def chasing(world: AttackEnvironment, time: float, here: Array, q: Array, speed: Array) -> Array:
    """Go to the nearest link."""
    del time, speed
    return world.nearest(here, q)


def ambushing(world: AttackEnvironment, time: float, here: Array, q: Array, speed: Array) -> Array:
    """Stand until the robot moves, then dart to where the nearest link will be; go away after a while."""
    if time < world.until:
        return world.target
    if np.abs(speed).max() * PERIOD < STANDS:
        return here
    world.target = world.nearest(here, q + AHEAD * speed)
    world.until = time + 0.25
    return world.target


def blocking(world: AttackEnvironment, time: float, here: Array, q: Array, speed: Array) -> Array:
    """Go between a hand and its goal, nearer to the hand the longer it takes."""
    del here, speed
    hand = world.places.hands[int(world.rng.integers(len(world.places.hands)))] if time < PERIOD else world.hand
    world.hand = hand
    share = max(0.6 - 0.2 * time, 0.05)
    goal = world.places.goals[0] if len(world.places.goals) else world.places.start
    return (1.0 - share) * world.places.hand(q, hand) + share * world.places.hand(goal, hand)


def swinging(world: AttackEnvironment, time: float, here: Array, q: Array, speed: Array) -> Array:
    """Go to and fro across the nearest link, turning at drawn times."""
    del speed
    if time >= world.until:
        world.until, world.side = time + world.rng.uniform(0.1, 0.5), -world.side
    target = world.nearest(here, q)
    return target + 0.3 * world.side * world.across


def frightening(world: AttackEnvironment, time: float, here: Array, q: Array, speed: Array) -> Array:
    """Come near whenever the robot stands, and go into its way whenever it moves."""
    del time
    if np.abs(speed).max() * PERIOD < STANDS:
        return world.nearest(here, q)
    return world.nearest(here, q + 2.0 * AHEAD * speed)


WAYS: tuple[Decide, ...] = (wandering, chasing, ambushing, blocking, swinging, frightening)


def shapes(folder: Path) -> tuple[dict[str, Any], ...]:
    """Return the shapes of bodies, the mesh in a file in a folder."""
    corner = folder / "corner.stl"
    if not corner.exists():
        legs = [trimesh.creation.box((0.3, 0.05, 0.05)), trimesh.creation.box((0.05, 0.3, 0.05))]
        legs[1].apply_translation((0.1, 0.12, 0.0))
        folder.mkdir(parents=True, exist_ok=True)
        trimesh.util.concatenate(legs).export(corner)
    return (
        {"box": (0.5, 0.04, 0.04)}, {"box": (0.3, 0.3, 0.02)}, {"sphere": {"radius": 0.06}},
        {"cylinder": {"radius": 0.05, "length": 0.25}}, {"capsule": {"radius": 0.04, "length": 0.3}},
        {"box": (0.02, 0.02, 0.02)}, {"mesh": {"file": str(corner), "solid": False}},
    )  # fmt: skip


class AttackEnvironment(ScriptedEnvironment):
    """Bodies that decide every 0.03 s where to go, at their largest speed.

    Attributes:
        places: The robot.
        rng: Source of decisions.
        until: Time until which a decision holds [s].
        target: Where a body goes, shape (3,) [m].
        side: To which side it swings.
        across: Along which direction, shape (3,).
        hand: Link that is blocked.
    """

    foreseen = -math.inf

    def __init__(self, number: int, folder: Path) -> None:
        """Draw a world.

        Args:
            number: Its number.
            folder: Where the mesh is kept.
        """
        self.rng = np.random.default_rng([zlib.crc32(KIND.encode()), number])
        suite = SUITES[number % 2]
        problem = problems.load(f"{suite}/free/{FIRST + number // 2}")
        self.places = RobotPlaces(problem)
        speed = float(self.rng.choice(SPEEDS))
        count = 1 + int(self.rng.random() < 0.3)
        known = shapes(folder)
        bodies = []
        for k in range(count):
            turn = self.rng.normal(size=4)
            fields = {"name": f"body_{k}", "orientation": tuple((turn / np.linalg.norm(turn)).tolist())}
            fields |= known[int(self.rng.integers(len(known)))]
            place = self._outside(radius_of(fields))
            bodies.append(Obstacle.model_validate({**fields, "position": tuple(place.tolist())}))
        super().__init__(f"{KIND}/{suite}/{number}", problem, tuple(bodies), speed)
        self._ways = [WAYS[int(self.rng.integers(len(WAYS)))] for _ in bodies]
        self._rows = [[row_of(0.0, body.position)] for body in bodies]
        self._decided, self._before = -math.inf, self.places.start
        self.until, self.side, self.hand = 0.0, 1.0, self.places.hands[0]
        self.target = np.array(bodies[0].position)
        way = self.rng.normal(size=3)
        self.across = way / np.linalg.norm(way)

    @property
    def sensor(self) -> Sensor:
        """The sensor of the world."""
        number = int(self.name.rpartition("/")[2])
        return Sensor(seed=number, **SENSORS[number % len(SENSORS)])

    def advance(self, time: float, q: Array) -> None:
        """Take the robot's state, shape (dof,), at a time [s]."""
        super().advance(time, q)
        if time < self._decided + PERIOD - 1e-9:
            return
        state = np.asarray(q, float)
        moved = (state - self._before) / max(time - self._decided, PERIOD)
        self._decided, self._before = time, state
        found = []
        for rows, way, body in zip(self._rows, self._ways, self._obstacles, strict=True):
            here = self._here(rows, body, time)
            target = np.maximum(way(self, time, here, state, moved), (-2.0, -2.0, 0.02))
            step = np.asarray(target, float) - here
            distance = float(np.linalg.norm(step))
            reach = self.fastest * PERIOD * (1.0 - 1e-9)
            then = here + step * min(1.0, reach / distance) if distance > 0.0 else here
            if time > rows[-1][0]:
                rows.append(row_of(time, here))
            script: Sequence[PlaceInTime] = (*rows, row_of(time + PERIOD, then))
            found.append(body.model_copy(update={"velocity": None, "trajectory": tuple(script)}))
        self._obstacles = tuple(found)

    def _here(self, rows: list[PlaceInTime], body: Obstacle, time: float) -> Array:
        if body.trajectory is None:
            return np.array(rows[-1][1:])
        (begin, *first), (end, *last) = body.trajectory[-2:] if len(body.trajectory) > 1 else body.trajectory * 2
        share = min((time - begin) / (end - begin), 1.0) if end > begin else 1.0
        return (1.0 - share) * np.array(first) + share * np.array(last)

    def nearest(self, here: Array, q: Array) -> Array:
        """Return the middle of the nearest ball of the robot at a state, of those that can evade, shape (3,) [m]."""
        balls = self.places.balls(q, evading=True)
        return np.asarray(balls.centers[np.argmin(np.linalg.norm(balls.centers - here, axis=1) - balls.radii)])

    def _outside(self, radius: float) -> Array:
        """Return a place with a drawn gap to the robot at its start, shape (3,) [m]."""
        balls, gap = self.places.balls(self.places.start), self.rng.uniform(*GAP)
        hand = self.places.hand(self.places.start, self.places.hands[int(self.rng.integers(len(self.places.hands)))])
        while True:
            way = self.rng.normal(size=3)
            for distance in np.arange(gap, FARTHEST, STEP):
                place = hand + distance * way / np.linalg.norm(way)
                clear = (np.linalg.norm(balls.centers - place, axis=1) - balls.radii).min() - radius
                if clear >= gap and place[2] > 0.05:
                    return np.asarray(place)


def radius_of(fields: dict[str, Any]) -> float:
    """Return the radius of a ball around a body's origin that contains it [m]."""
    if "box" in fields:
        return 0.5 * float(np.linalg.norm(fields["box"]))
    if "sphere" in fields:
        return float(fields["sphere"]["radius"])
    for name in ("cylinder", "capsule"):
        if name in fields:
            return float(fields[name]["radius"]) + 0.5 * float(fields[name]["length"])
    return float(np.linalg.norm(trimesh.load(fields["mesh"]["file"]).vertices, axis=1).max())
