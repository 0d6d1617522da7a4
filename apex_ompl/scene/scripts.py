"""Positions of dynamic obstacles over time: at constant velocity, or by a script.

A script is ``Obstacle.trajectory``, positions joined by straight lines from time 0 on, and ``Obstacle.appears``.
"""

from __future__ import annotations

from bisect import bisect_right

import numpy as np
from numpy.typing import ArrayLike

from apex_ompl.scene.bodies import MOTION, Obstacle, PlaceInTime, Vector
from apex_ompl.scene.problem import Problem
from apex_ompl.types import Array


def is_there(obstacle: Obstacle, time: float) -> bool:
    """Whether an obstacle has appeared at a time [s] or before."""
    return time >= obstacle.appears or obstacle.appears == 0.0


def place_at(obstacle: Obstacle, time: float) -> Array:
    """Return the position of an obstacle at a time [s], shape (3,) [m]; before time 0 a script stands still."""
    start, velocity = _piece(obstacle, time)
    return np.asarray(start[1:] + (time - start[0]) * velocity)


def velocity_at(obstacle: Obstacle, time: float) -> Array:
    """Return the velocity of an obstacle from a time [s] on, shape (3,) [m/s]."""
    return _piece(obstacle, time)[1]


def obstacle_at(obstacle: Obstacle, time: float) -> Obstacle:
    """Return an obstacle as it is at a time [s]: with its position and its velocity then, and without a script.

    One that does not move is returned as it is.
    """
    if not obstacle.moving:
        return obstacle
    start, velocity = _piece(obstacle, time)
    now = {"position": vector(start[1:] + (time - start[0]) * velocity), "velocity": vector(velocity)}
    return obstacle.model_copy(update={**now, "trajectory": None, "appears": 0.0})


def standing(obstacle: Obstacle) -> Obstacle:
    """Return an obstacle that stands still at its position."""
    return obstacle.model_copy(update={**dict.fromkeys(MOTION), "appears": 0.0})


def problem_at(problem: Problem, time: float) -> Problem:
    """Return a problem with its obstacles as they are at a time [s], without those that have not appeared."""
    here = tuple(obstacle_at(o, time) for o in problem.scene if is_there(o, time))
    absent = {o.name for o in problem.scene} - {o.name for o in here}
    pairs = tuple(pair for pair in problem.allowed if not {*pair} & absent)
    return problem.model_copy(update={"scene": here, "allowed": pairs})


def fastest(obstacle: Obstacle) -> float:
    """Return the largest speed of an obstacle [m/s]."""
    if obstacle.trajectory is None:
        return float(np.linalg.norm(obstacle.velocity or (0.0, 0.0, 0.0)))
    rows = np.array(obstacle.trajectory)
    steps = np.diff(rows, axis=0)
    return float(max(np.linalg.norm(steps[:, 1:], axis=1) / steps[:, 0], default=0.0))


def script_times(obstacle: Obstacle) -> tuple[float, ...]:
    """Return the times at which an obstacle appears or its velocity may change [s], from 0 on."""
    return tuple(sorted({0.0, obstacle.appears, *(row[0] for row in obstacle.trajectory or ())}))


def recorded(obstacle: Obstacle, until: float) -> Obstacle:
    """Return the motion of an obstacle up to a time [s] as a script; it stands still afterwards."""
    rows = obstacle.trajectory or ((0.0, *obstacle.position),)
    past = [row for row in rows if row[0] < until]
    last = until if obstacle.trajectory is None else min(until, rows[-1][0])
    end = row_of(last, place_at(obstacle, last))
    script = (*past, end) if not past or last > past[-1][0] else tuple(past)
    return obstacle.model_copy(update={"velocity": None, "trajectory": script})


def moved_to(obstacle: Obstacle, position: ArrayLike) -> Obstacle:
    """Return an obstacle that is at a position at time 0, shape (3,) [m], with its whole script moved by as much."""
    place = vector(position)
    if obstacle.trajectory is None:
        return obstacle.model_copy(update={"position": place})
    shift = np.subtract(place, obstacle.position)
    rows = [(0.0, *place), *(row_of(row[0], np.add(row[1:], shift)) for row in obstacle.trajectory[1:])]
    return obstacle.model_copy(update={"position": place, "trajectory": tuple(rows)})


def vector(numbers: ArrayLike) -> Vector:
    """Return three numbers as a record has them."""
    x, y, z = np.asarray(numbers, float).tolist()
    return x, y, z


def row_of(time: float, place: ArrayLike) -> PlaceInTime:
    """Return the row of a script for a time [s] and a place, shape (3,) [m]."""
    return (float(time), *vector(place))


def _piece(obstacle: Obstacle, time: float) -> tuple[Array, Array]:
    """Return start, shape (4,) of time [s] and position [m], and velocity, shape (3,), of the piece at a time."""
    rows, still = obstacle.trajectory, np.zeros(3)
    if rows is None:
        return np.array([0.0, *obstacle.position]), np.array(obstacle.velocity or still, float)
    k = bisect_right(rows, time, key=lambda row: row[0]) - 1
    start = np.array(rows[max(k, 0)])
    if k < 0 or k == len(rows) - 1:
        return start, still
    step = np.subtract(rows[k + 1], start)
    return start, np.asarray(step[1:] / step[0])
