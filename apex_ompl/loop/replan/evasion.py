"""Steps aside: for a robot that is at rest where an obstacle comes, or moves to where one will be."""

from __future__ import annotations

import numpy as np

from apex_ompl.errors import ApexError
from apex_ompl.moving.context import Following
from apex_ompl.moving.dynamic_obstacles import clearance_in_time
from apex_ompl.moving.search import Search, rest_of_route
from apex_ompl.timing import Trajectory, time_path
from apex_ompl.types import Array

SOON = 1.2  # time before a contact from which on a step aside is looked for [s]
URGENT = 0.5  # time before one from which on that comes before anything else [s]
AROUND, STRAYS = 24, (0.05, 0.2, 0.4)  # states that a robot may step aside to, and how far they are at first [rad]
ASCENTS, STRIDE = 3, 0.25  # steps of these away from obstacles, and their length [rad]
LOOKS, SEEN = 4, 0.3  # moments at which such a state is looked at, and distances that are told apart [m]
DURATION = 0.35  # about how long a step aside takes [s]
GAIN = 0.2  # time that a step aside that is touched in the end must gain [s]
BACK = 6  # states of the last motion to a goal, and the start of the run, that it may go to as well
NEARNESS = 0.05  # clearance that a step shorter by 1 rad is worth [m]
SHARES = (0.9, 0.75, 0.6, 0.45, 0.3, 0.15)  # of the way to a goal, the nearest to it first
NEAREST_GOALS = 2  # nearest goals to which that is tried
LEAST_NEARER = 0.1  # distance that a robot comes nearer to a goal at least [rad]


def endangered(following: Following, at: float, conflict: float, within: float = SOON) -> bool:
    """Whether a robot stands at a time, and an obstacle is to touch it within some time from then.

    Args:
        following: What the robot follows.
        at: Clock time [s].
        conflict: That of the first contact that is predicted of what it follows [s], infinite without one.
        within: The time from ``at`` on [s].
    """
    return following.at_rest(at) and conflict < at + within


def threatened(following: Following, at: float, conflict: float) -> bool:
    """Whether a robot that moves at a time, as :func:`endangered` has it, comes into conflict soon."""
    return not following.at_rest(at) and conflict < at + SOON


def step_aside(search: Search, *, proved: bool = False) -> Trajectory | None:
    """Return the straight motion to a state nearby that stays clear, or else clear for longest, or None.

    One that starts while the robot moves is the fastest to that state. Besides states around, the robot may go back: to
    states of its last motion to a goal, and to where it started. Where
    motions aside are to be proved clear of all that obstacles can reach, the states are clear of that at the arrival
    where possible, and motions that are proved come first; another one may still have a fail-safe stop at each of its
    steps.

    Args:
        search: The replan.
        proved: Whether only a motion that is proved is of use.
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
        clear, slopes = _looked(search, states, looks)
        if turn < ASCENTS:  # away from what comes nearest
            slope = slopes[rows, clear.argmin(axis=1)]
            states = states + STRIDE * slope / np.maximum(np.linalg.norm(slope, axis=1, keepdims=True), 1e-6)
    back = _back(search)
    states, clear = np.concatenate([states, back]), np.concatenate([clear, _looked(search, back, looks)[0]])
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
    return time_path(states, search.context.limits, search.context.names).trajectory


def _looked(search: Search, states: Array, looks: Array) -> tuple[Array, Array]:
    """Return clearances of states at some times [m], and their gradients.

    Where motions aside are to be proved, the last column is that to all that obstacles can reach at the first time.

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
    """Return a motion from rest to a state nearer to a goal that stays clear for a while, or None.

    The states are on the straight lines to the nearest goals, and on what is left of the last motion to a goal; the
    robot goes straight to them.
    """
    q, context = search.start.position, search.context
    for state in _waiting_states(search):
        if search.budget.over():
            return None
        search.budget.spend("straight motion")
        try:
            motion = time_path(np.stack([q, state]), context.limits, context.names).trajectory
        except ApexError:
            continue
        if search.accepts(motion):
            return motion
    return None


def _waiting_states(search: Search) -> Array:
    """Return the states where it may wait, shape (N, dof), the nearest to a goal first."""
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
