"""Where a robot moves that finds no motion to a goal: aside from an obstacle, or to a waiting state."""

from __future__ import annotations

import numpy as np

from apex_ompl.errors import ApexError
from apex_ompl.moving.context import Following
from apex_ompl.moving.dynamic_obstacles import clearance_in_time
from apex_ompl.moving.search import Search, rest_of_route
from apex_ompl.timing import Trajectory, time_path
from apex_ompl.types import Array

SOON = 1.2  # time before a contact below which a step aside is sought [s]
URGENT = 0.5  # time before a contact below which a step aside is sought first [s]
AROUND, STRAYS = 24, (0.05, 0.2, 0.4)  # number of states to step aside to, and their initial distances [rad]
ASCENTS, STRIDE = 3, 0.25  # gradient steps of these states away from obstacles, and their length [rad]
LOOKS, SEEN = 4, 0.3  # times at which such a state is checked, and largest clearance that is computed [m]
DURATION = 0.35  # typical duration of a step aside [s]
GAIN = 0.2  # time that a step aside must gain where it is touched in the end [s]
BACK = 6  # number of states of the last motion to a goal that the robot may go back to
NEARNESS = 0.05  # clearance that a step shorter by 1 rad is worth [m]
SHARES = (0.9, 0.75, 0.6, 0.45, 0.3, 0.15)  # shares of the way to a goal at which the robot may wait
NEAREST_GOALS = 2  # number of goals to which the robot may move nearer
LEAST_NEARER = 0.1  # least distance by which a waiting state is nearer to a goal [rad]


def endangered(following: Following, at: float, conflict: float, within: float = SOON) -> bool:
    """Whether a robot will be at rest at a time, and an obstacle will touch it within some time after that.

    Args:
        following: The motion that the robot follows.
        at: Clock time [s].
        conflict: Clock time of the first predicted contact [s], infinite without one.
        within: The time after ``at`` [s].
    """
    return following.at_rest(at) and conflict < at + within


def threatened(following: Following, at: float, conflict: float) -> bool:
    """Whether a robot will be moving at a time, and comes into conflict soon; the arguments of :func:`endangered`."""
    return not following.at_rest(at) and conflict < at + SOON


def step_aside(search: Search, *, proved: bool = False) -> Trajectory | None:
    """Return the straight motion to a state nearby that stays clear, or else the longest clear one, or None.

    A motion that starts while the robot moves is the fastest to that state. Besides states nearby, the robot may go
    back to states of its last motion to a goal, and to its start. Where steps aside must be proved clear of all
    reachable sets, the states are clear of these at the arrival where possible, and proved motions come first; another
    one may still have a fail-safe stop at each of its steps.

    Args:
        search: The replan.
        proved: Whether only a proved motion is returned.
    """
    request, context = search.request, search.context
    q, limits, hold = search.start.position, context.setup.robot.limits, context.settings.rest_hold
    size = np.repeat(STRAYS, AROUND // len(STRAYS))[:, None]
    states = q + size * search.rng.normal(size=(len(size), len(q)))
    looks = search.soonest + DURATION + np.linspace(0.0, hold, LOOKS)
    rows = np.arange(len(states))
    for turn in range(ASCENTS + 1):
        states = np.clip(states, limits.lower, limits.upper)
        states[:, context.fingers] = q[context.fingers]
        clear, slopes = _clearances(search, states, looks)
        if turn < ASCENTS:  # away from what comes nearest
            slope = slopes[rows, clear.argmin(axis=1)]
            states = states + STRIDE * slope / np.maximum(np.linalg.norm(slope, axis=1, keepdims=True), 1e-6)
    back = _back(search)
    states, clear = np.concatenate([states, back]), np.concatenate([clear, _clearances(search, back, looks)[0]])
    near = np.minimum(clear.min(axis=1), context.kernel.clearance(states, SEEN).min(axis=1))
    search.budget.spend("clearance in time", len(states))
    size = np.abs(states - q).max(axis=1)
    best, unproved, latest = None, None, request.conflict + GAIN
    proves = request.reachable if context.settings.evade == "proved" else None
    for k in np.argsort(-(near - NEARNESS * size), kind="stable"):
        if search.budget.over():
            break
        motion = _to(search, states[k])
        if motion is None:
            continue
        one = search.following(motion)
        conflict = context.first_conflict(request.predicted, one, one.start_time, one.end + hold, search.budget)
        if conflict <= latest or not context.clear_of_static(motion, search.budget):
            continue
        if proves is not None and not context.proved_to_rest(proves, Following(motion, search.soonest), search.budget):
            unproved = motion if unproved is None else unproved
            continue
        best, latest = motion, conflict
        if np.isinf(conflict):
            break
    return unproved if best is None and not proved else best


def _to(search: Search, state: Array) -> Trajectory | None:
    """Return the motion to a state, shape (dof,), or None where there is none within the limits."""
    if search.start.moves:
        return search.direct(state)
    search.budget.spend("straight motion")
    states = np.stack([search.start.position, state])
    context = search.context
    return time_path(states, context.limits, context.names, motion_limits=context.torques).trajectory


def _clearances(search: Search, states: Array, looks: Array) -> tuple[Array, Array]:
    """Return clearances of states at some times [m], and their gradients.

    Where steps aside must be proved, the last column is the clearance to the reachable sets at the first time.

    Args:
        search: The replan.
        states: Shape (N, dof).
        looks: Clock times, shape (T,) [s].

    Returns:
        Clearances, shape (N, T) or (N, T + 1), and gradients, shape (N, T or T + 1, dof).
    """
    context, request, count = search.context, search.request, len(states)
    asked = [(request.predicted, looks)]
    if request.reachable is not None and context.settings.evade == "proved":
        asked.append((request.reachable, looks[:1]))
    clear, slopes = list[Array](), list[Array]()
    for dynamic, times in asked:
        many = np.repeat(states, len(times), axis=0)
        values, gradients = clearance_in_time(context.kernel, dynamic, many, np.tile(times, count), SEEN)
        search.budget.spend("clearance in time", len(values))
        clear.append(values.reshape(count, -1))
        slopes.append(gradients.reshape(count, len(times), -1)[:, :, :-1])
    return np.concatenate(clear, axis=1), np.concatenate(slopes, axis=1)


def _back(search: Search) -> Array:
    """Return the states that a robot may go back to, shape (N, dof)."""
    context, route = search.context, search.request.route
    started = context.setup.start[None]
    if route is None:
        return started
    return np.concatenate([started, route.motion(np.linspace(0.0, route.motion.duration, BACK))])


def wait_nearer(search: Search) -> Trajectory | None:
    """Return a motion from rest to a waiting state, nearer to a goal, that stays clear for a while, or None.

    The states are on the straight lines to the nearest goals, and on the remaining motion to a goal. The motion to a
    state is straight.
    """
    q, context = search.start.position, search.context
    for state in _waiting_states(search):
        if search.budget.over():
            return None
        search.budget.spend("straight motion")
        try:
            states = np.stack([q, state])
            motion = time_path(states, context.limits, context.names, motion_limits=context.torques).trajectory
        except ApexError:
            continue
        if search.accepts(motion):
            return motion
    return None


def _waiting_states(search: Search) -> Array:
    """Return the waiting states, shape (N, dof), the nearest to a goal first."""
    q, goals = search.start.position, search.goals
    ways = [q + np.array(SHARES)[:, None] * (goal - q) for goal in goals[:NEAREST_GOALS]]
    rest = rest_of_route(search)
    if rest is not None:
        ways.append(rest[np.rint(np.array(SHARES) * (len(rest) - 1)).astype(int)])
    states = np.concatenate(ways)
    left = np.linalg.norm(states[:, None] - goals, axis=2).min(axis=1)
    now = np.linalg.norm(goals - q, axis=1).min()
    order = np.argsort(left, kind="stable")
    found: Array = states[order][left[order] <= now - LEAST_NEARER]
    return found
