"""Where to wait for a goal: for a robot that stands while there is no way to it."""

from __future__ import annotations

import numpy as np

from apex_ompl.errors import ApexError
from apex_ompl.moving.search import Search
from apex_ompl.moving.sources import rest_of_route
from apex_ompl.timing import Trajectory, time_path
from apex_ompl.types import Array

SHARES = (0.9, 0.75, 0.6, 0.45, 0.3, 0.15)  # of the way to a goal, the nearest to it first
GOALS = 2  # nearest goals to which that is tried
LEAST = 0.1  # distance that a robot comes nearer to a goal at least [rad]


def wait_nearer(search: Search) -> Trajectory | None:
    """Return a motion from rest to a state nearer to a goal that stays clear for a while, or None.

    The states are on the straight lines to the nearest goals, and on what is left of the last motion to a goal; the
    robot goes straight to them.
    """
    q, ready = search.start.position, search.ready
    for state in _states(search):
        if search.charges.over():
            return None
        search.charges.charge("straight motion")
        try:
            motion = time_path(np.stack([q, state]), ready.limits, ready.names).trajectory
        except ApexError:
            continue
        if search.accepts(motion):
            return motion
    return None


def _states(search: Search) -> Array:
    """Return the states where it may wait, shape (N, dof), the nearest to a goal first."""
    q, goals = search.start.position, search.goals
    ways = [q + np.array(SHARES)[:, None] * (goal - q) for goal in goals[:GOALS]]
    rest = rest_of_route(search)
    if rest is not None:
        ways.append(rest[np.rint(np.array(SHARES) * (len(rest) - 1)).astype(int)])
    states = np.concatenate(ways)
    left = np.linalg.norm(states[:, None] - goals, axis=2).min(axis=1)
    now = np.linalg.norm(goals - q, axis=1).min()
    order = np.argsort(left, kind="stable")
    found: Array = states[order][left[order] <= now - LEAST]
    return found
