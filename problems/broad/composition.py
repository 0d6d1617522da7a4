"""Compositions: parts with the places that hands are sent to, before they stand somewhere in the workspace."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from apex_ompl.goals.state_sampling import Direction
from apex_ompl.problems.broad.shapes import Parts, Point, mirror, place, turn
from apex_ompl.types import Array

STANDING, FLOATING = "standing", "floating"


class Place(NamedTuple):
    """A place that a hand may be sent to: inside, behind or between parts.

    Attributes:
        point: Where the grasp point is to be, shape (3,) [m].
        fingers: Direction that the fingers point along; None for any.
    """

    point: Array
    fingers: Direction | None = None


@dataclass(frozen=True)
class Composition:
    """Parts and places in a frame of their own: the front faces -x, what stands stands on z = 0.

    Attributes:
        parts: The parts.
        places: Interesting places.
        stance: STANDING for what has a foot, FLOATING for what may have any pose.
    """

    parts: Parts
    places: Sequence[Place]
    stance: str = STANDING

    def placed(self, pose: Array) -> Composition:
        """Return the composition moved by a pose, shape (4, 4)."""
        return Composition(place(self.parts, pose), [_placed(pose, p) for p in self.places], self.stance)

    def mirrored(self) -> Composition:
        """Return the composition mirrored at the plane y = 0."""
        flip = np.diag([1.0, -1.0, 1.0, 1.0])
        return Composition(mirror(self.parts, 1), [_placed(flip, p) for p in self.places], self.stance)


def _placed(pose: Array, one: Place) -> Place:
    fingers = one.fingers
    if fingers is not None:
        x, y, z = (float(v) for v in pose[:3, :3] @ np.asarray(fingers))
        fingers = (x, y, z)
    return Place(pose[:3, :3] @ np.asarray(one.point, float) + pose[:3, 3], fingers)


def at(x: float, y: float, z: float, fingers: Direction | None = None) -> Place:
    """Return a place by its coordinates [m]."""
    return Place(np.array([x, y, z], float), fingers)


def places_at(points: Sequence[Point] | Array, fingers: Direction | None = None) -> list[Place]:
    """Return a place at each of some points, shape (n, 3) [m]."""
    return [Place(np.asarray(point, float), fingers) for point in points]


def site(rng: np.random.Generator, composition: Composition) -> Array:
    """Return a random pose in the workspace of both arms for a composition, shape (4, 4).

    What stands faces the robot more or less, on the tables or raised above them; sometimes it lies or leans like what
    floats.
    """
    pose = np.eye(4)
    pose[:3, 3] = rng.uniform(0.42, 0.68), rng.uniform(-0.55, 0.55), 0.0
    if composition.stance == STANDING and rng.random() < 0.9:
        pose[2, 3] = max(0.0, rng.uniform(-0.2, 0.35))
        return pose @ turn("z", rng.normal(0.0, 0.4)) @ turn(rng.normal(size=3), rng.normal(0.0, 0.06))
    pose[2, 3] = rng.uniform(0.15, 0.75)
    axis = rng.normal(size=3)
    return pose @ turn(axis, rng.uniform(-np.pi, np.pi))
