"""Starts and goals: hands sent to places, into wide regions, at rest, contorted; and parts that keep clear of them."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np
from numpy.typing import NDArray

from apex_ompl.collision.shapes import world_geometry
from apex_ompl.collision.tabulate import primitives
from apex_ompl.goals.inverse_kinematics import Links
from apex_ompl.goals.state_sampling import HandPoseSampler, HandRegion, has_clearance
from apex_ompl.kernel import Kernel, RobotTables, SceneTables
from apex_ompl.kernel.scene_builder import Solids, boxes_around, tables_of
from apex_ompl.problems.broad.composition import Place
from apex_ompl.problems.broad.held import Held
from apex_ompl.problems.broad.shapes import Part, kernel_columns
from apex_ompl.problems.scenes import DOWN, FORWARD
from apex_ompl.problems.suite_robot import robot
from apex_ompl.types import Array

FINGERS = (DOWN, FORWARD, (0.0, 0.0, 1.0), (0.0, -1.0, 0.0), (0.0, 1.0, 0.0))
SHOULDERS = (0.5, -0.5)  # y of the arms [m]
REACH = 0.78  # of a place that a hand is sent to, from the axis of its arm [m]
PLACE_WIDTH = 0.02  # half the width of the region around a place [m]
PLACED, RESTING = 0.7, 0.07  # share of hands that are sent to places, and of states at rest
CONTORTED = 0.13  # share of states that are drawn evenly from the limits
BATCH = 48  # such states at once
REST_SPREAD = 0.15  # standard deviation of a state at rest around home [rad]


@cache
def _fixtures() -> tuple[Solids, ...]:
    return tuple(Solids.of(primitives(*world_geometry(body))) for body in robot().fixtures)


def scene_of(parts: Sequence[Part], swelling: float = 0.0) -> SceneTables:
    """Return the kernel's scene of the robot's fixtures and of parts, numbered behind them.

    Args:
        parts: The parts.
        swelling: By how much every part is thicker on each side [m].
    """
    found = dict(enumerate(_fixtures()))
    kind, rotation, offset, size = kernel_columns(parts, swelling)
    around = boxes_around(kind, rotation, offset, size) if parts else np.empty((0, 2, 3))
    exact = np.array([swelling == 0.0], np.int64)
    for k in range(len(parts)):
        one = slice(k, k + 1)
        found[len(found)] = Solids(kind[one], exact, rotation[one], offset[one], size[one], around[one], (None,))
    return tables_of(found)


def clear_parts(tables: RobotTables, parts: list[Part], ends: Array, margin: float) -> list[Part]:
    """Return those parts that keep a margin to the robot at some states.

    Args:
        tables: The robot with what it holds.
        parts: The parts.
        ends: Shape (n, dof).
        margin: [m].
    """
    fixtures = len(_fixtures())
    while parts:
        found, counts = Kernel(tables, scene_of(parts, margin)).unproved(ends)
        rows = np.concatenate([some[: max(n, 0), 1] for some, n in zip(found, counts, strict=True)])
        touching: NDArray[np.int64] = np.unique(-1 - rows[rows < -fixtures]) - fixtures
        if not len(touching):
            break
        gone = set(touching.tolist())
        parts = [part for k, part in enumerate(parts) if k not in gone]
    return parts


def palm_line(tables: RobotTables, ends: Array, count: int) -> Array:
    """Return the grasp points of both hands at states between start and goal, shape (2, count, 3) [m]."""
    links = Links.of(robot())
    points = [links.point(hand.palm, hand.point) for hand in robot().hands.values()]
    states = np.linspace(ends[0], ends[1], count + 2)[1:-1]
    rotation, origin = Kernel(tables, scene_of(())).joint_frames(states)
    return np.stack([rotation[:, p.joint] @ np.asarray(p.vector) + origin[:, p.joint] for p in points])


class EndSampler:
    """Sampler of starts and goals among parts, by hands in places and by joints."""

    def __init__(self, held: Held, parts: Sequence[Part], places: Sequence[Place], margin: float) -> None:
        """Sample states that keep ``margin`` [m] to ``parts``, or else to the fixtures alone."""
        self._held, self._margin = held, margin
        self._scenes = [scene_of(parts), scene_of(())] if parts else [scene_of(())]
        self._places = [[p for p in places if _in_reach(p.point, y)] for y in SHOULDERS]
        self._hands = robot().groups["hands"]

    def sample(self, rng: np.random.Generator) -> Array | None:
        """Return a state, shape (dof,), or None; where none is found among the parts, one that is clear without."""
        share = rng.random()
        if share < RESTING + CONTORTED:
            return self._joints(rng, rest=share < RESTING)
        regions = (self._region(rng, 0), self._region(rng, 1))
        synergies = (self._held.low, self._held.high)
        for scene in self._scenes:
            sampler = HandPoseSampler(self._held.tables, scene, self._margin)
            found = sampler.sample(rng, regions, synergies, attempts=2)
            if found is not None:
                return found
        return None

    def _joints(self, rng: np.random.Generator, *, rest: bool) -> Array | None:
        some = robot()
        states = rng.uniform(some.limits.lower, some.limits.upper, (BATCH, some.dof))
        if rest:
            states[:] = some.home + rng.normal(0.0, REST_SPREAD, (BATCH, some.dof))
        states[:, self._hands] = rng.uniform(self._held.low, self._held.high, (BATCH, 2))
        states[:] = np.round(np.clip(states, some.limits.lower, some.limits.upper), 6)
        states = states[[some.limit_fault(q) is None for q in states]]
        for scene in self._scenes:
            clear = np.flatnonzero(has_clearance(Kernel(self._held.tables.both, scene), states, self._margin))
            if len(clear):
                return np.array(states[clear[0]])
        return None

    def _region(self, rng: np.random.Generator, side: int) -> HandRegion:
        """Return a region for a hand: around a place within reach, or wide."""
        own = self._places[side]
        if own and rng.random() < PLACED:
            one = own[int(rng.integers(len(own)))]
            x, y, z = ((float(v) - PLACE_WIDTH, float(v) + PLACE_WIDTH) for v in one.point)
            fingers = FINGERS if one.fingers is None or rng.random() < 0.2 else (one.fingers,)
            return HandRegion(x, y, z, fingers)
        middle = 0.7 * SHOULDERS[side]
        return HandRegion((0.25, 0.75), (middle - 0.5, middle + 0.5), (0.1, 0.8), FINGERS)


def _in_reach(point: Array, shoulder: float) -> bool:
    """Whether the arm at ``y = shoulder`` reaches a place above the tables and before it."""
    x, y, z = point
    return bool(x > 0.15 and 0.03 < z < 1.05 and np.linalg.norm([x, y - shoulder, z - 0.35]) < REACH)
