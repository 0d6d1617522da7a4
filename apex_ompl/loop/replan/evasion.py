"""Steps aside: for a robot that is at rest where an obstacle comes, or moves to where one will be."""

from __future__ import annotations

import numpy as np

from apex_ompl.moving.dynamic_obstacles import clearance_in_time
from apex_ompl.moving.following import Following
from apex_ompl.moving.search import Search
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


def endangered(following: Following, at: float, conflict: float, within: float = SOON) -> bool:
    """Whether a robot stands at a time, and an obstacle is to touch it within some time from then.

    Args:
        following: What the robot follows.
        at: Time of the clock [s].
        conflict: That of the first contact that is predicted of what it follows [s], infinite without one.
        within: The time from ``at`` on [s].
    """
    return following.at_rest(at) and conflict < at + within


def threatened(following: Following, at: float, conflict: float) -> bool:
    """Whether a robot that moves at a time, as :func:`endangered` has it, comes into conflict soon."""
    return not following.at_rest(at) and conflict < at + SOON


def step_aside(search: Search, *, proved: bool = False) -> Trajectory | None:
    """Return the straight motion to a state nearby that stays clear, or else clear for longest, or None.

    One that begins while the robot moves is the fastest to that state. Besides states around, the robot may go back: to
    states of its last motion to a goal, and to where it began. Where
    motions aside are to be proved clear of all that obstacles can reach, the states are clear of that at the arrival
    where possible, and motions that are proved come first; another one may still have a fail-safe stop at each of its
    steps.

    Args:
        search: The replan.
        proved: Whether only a motion that is proved is of use.
    """
    request, ready = search.request, search.ready
    q, limits, hold = search.start.position, ready.setup.robot.limits, ready.settings.rest_hold
    size = np.repeat(STRAYS, AROUND // len(STRAYS))[:, None]
    states = q + size * search.rng.normal(size=(len(size), len(q)))
    looks = search.soonest + DURATION + np.linspace(0.0, hold, LOOKS)
    rows = np.arange(len(states))
    for turn in range(ASCENTS + 1):
        states = np.clip(states, limits.lower, limits.upper)
        states[:, ready.fingers] = q[ready.fingers]
        clear, slopes = _looked(search, states, looks)
        if turn < ASCENTS:  # away from what comes nearest
            slope = slopes[rows, clear.argmin(axis=1)]
            states = states + STRIDE * slope / np.maximum(np.linalg.norm(slope, axis=1, keepdims=True), 1e-6)
    back = _back(search)
    states, clear = np.concatenate([states, back]), np.concatenate([clear, _looked(search, back, looks)[0]])
    near = np.minimum(clear.min(axis=1), ready.kernel.clearance(states, SEEN).min(axis=1))
    search.charges.charge("clearance in time", len(states))
    size = np.abs(states - q).max(axis=1)
    best, unproved, latest = None, None, request.conflict + GAIN
    proves = request.reachable if ready.settings.evade == "proved" else None
    for k in np.argsort(-(near - NEARNESS * size), kind="stable"):
        if search.charges.over():
            break
        motion = _to(search, states[k])
        if motion is None:
            continue
        one = search.following(motion)
        conflict = ready.first_conflict(request.predicted, one, one.begin, one.end + hold, search.charges)
        if conflict <= latest or not ready.clear_of_still(motion, search.charges):
            continue
        if proves is not None and not ready.proved_to_rest(proves, Following(motion, search.soonest), search.charges):
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
    search.charges.charge("straight motion")
    states = np.stack([search.start.position, state])
    return time_path(states, search.ready.limits, search.ready.names).trajectory


def _looked(search: Search, states: Array, looks: Array) -> tuple[Array, Array]:
    """Return clearances of states at some times [m], and their gradients.

    Where motions aside are to be proved, the last column is that to all that obstacles can reach at the first time.

    Args:
        search: The replan.
        states: Shape (N, dof).
        looks: Times of the clock, shape (T,) [s].

    Returns:
        Clearances, shape (N, T) or (N, T + 1), and gradients, shape (N, T or T + 1, dof).
    """
    ready, request, count = search.ready, search.request, len(states)
    asked = [(request.predicted, looks)]
    if request.reachable is not None and ready.settings.evade == "proved":
        asked.append((request.reachable, looks[:1]))
    clear, slopes = list[Array](), list[Array]()
    for dynamic, times in asked:
        many = np.repeat(states, len(times), axis=0)
        values, gradients = clearance_in_time(ready.kernel, dynamic, many, np.tile(times, count), SEEN)
        search.charges.charge("clearance in time", len(values))
        clear.append(values.reshape(count, -1))
        slopes.append(gradients.reshape(count, len(times), -1)[:, :, :-1])
    return np.concatenate(clear, axis=1), np.concatenate(slopes, axis=1)


def _back(search: Search) -> Array:
    """Return the states that a robot may go back to, shape (N, dof)."""
    ready, route = search.ready, search.request.route
    begun = ready.setup.start[None]
    if route is None:
        return begun
    return np.concatenate([begun, route.motion(np.linspace(0.0, route.motion.duration, BACK))])
