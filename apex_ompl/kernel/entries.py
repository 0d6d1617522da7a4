"""The compiled functions that Python calls. Robots and scenes come packed, see ``apex_ompl.kernel.tables.pack``."""

from __future__ import annotations

import math

from apex_ompl.kernel.clearance import gradient_of_two, gradient_to_obstacle, nearest_bodies, nearest_obstacle
from apex_ompl.kernel.compiled import entry, inlined
from apex_ompl.kernel.kinematics import bound_motion, place_joint, place_robot
from apex_ompl.kernel.separation import judged, known, proved
from apex_ompl.kernel.tables import Floats, Integers
from apex_ompl.kernel.views import Work, robot_view, scene_view, work_view

PROVED_STATES, OPEN_STATES, PROVED_BOXES, TRIED_BOXES, PROVED_STEPS = range(5)
DONE = -1
MOST_STEPS = 50_000_000


@entry
def judge_states(
    ri: Integers, rf: Floats, si: Integers, sf: Floats, wi: Integers, wf: Floats,
    states: Floats, found: Integers, counts: Integers,
) -> None:  # fmt: skip
    """List for each state, shape (N, dof), the pairs that are not proved to be apart.

    ``found`` (N, K, 2) gets the pairs, ``counts`` (N,) their number, or -1 when nothing can be said of the state.
    """
    t, s = robot_view(ri, rf), scene_view(si, sf)
    w = work_view(t, wi, wf)
    for k in range(len(states)):
        counts[k] = judged(t, s, w, states[k], found[k])


@entry
def clearances(
    ri: Integers, rf: Floats, si: Integers, sf: Floats, wi: Integers, wf: Floats,
    states: Floats, limit: float, values: Floats, slopes: Floats,
) -> None:  # fmt: skip
    """Put the signed clearance of each state, shape (N, dof), to obstacles and between links into ``values`` (N, 2).

    Clearances over ``limit`` are not looked for; ``limit`` stands for them, with gradient 0. ``slopes``, shape
    (N, 2, dof), gets the gradients; shape (0, 2, dof) asks for none. States that the tables do not hold for get NaN.
    """
    t, s = robot_view(ri, rf), scene_view(si, sf)
    w = work_view(t, wi, wf)
    for k in range(len(states)):
        q = states[k]
        if not known(t, q, w.reach):
            values[k, 0] = values[k, 1] = math.nan
            if len(slopes):
                for i in range(len(q)):
                    slopes[k, 0, i] = slopes[k, 1, i] = math.nan
            continue
        place_robot(t, w, q)
        near = nearest_obstacle(t, s, w, q, limit)
        own = nearest_bodies(t, w, q, limit)
        values[k, 0], values[k, 1] = near[0], own[0]
        if len(slopes):
            for i in range(len(q)):
                slopes[k, 0, i] = slopes[k, 1, i] = 0.0
            if near[1] >= 0:
                gradient_to_obstacle(t, s, w, near, slopes[k, 0])
            if own[1] >= 0:
                gradient_of_two(t, w, own, slopes[k, 1])


@entry
def joint_frames(
    ri: Integers, rf: Floats, wi: Integers, wf: Floats, states: Floats, turn: Floats, origin: Floats
) -> None:
    """Put the frames of all joints, axes along z, into ``turn`` (N, J, 3, 3) and ``origin`` (N, J, 3)."""
    t = robot_view(ri, rf)
    w = work_view(t, wi, wf)
    for k in range(len(states)):
        place_robot(t, w, states[k])
        for j in t.lazy:
            place_joint(t, w, states[k], j)
        for j in range(len(t.joint_parent)):
            for i in range(3):
                origin[k, j, i] = w.origin[j, i]
                for m in range(3):
                    turn[k, j, i, m] = w.turn[j, i, m]


@entry
def lay_grid(path: Floats, resolution: float, starts: Integers) -> int:
    """Lay a grid of states over a path, shape (N, dof), at most ``resolution`` apart [max-norm].

    ``starts`` (N,) gets the numbers of the given states in the grid; from each to the next there are as many steps as
    are needed, at least one.

    Returns:
        The number of the last state, or -1 for a path with numbers that are not finite, or with too many steps.
    """
    starts[0] = 0
    for k in range(len(path) - 1):
        largest = 0.0
        for i in range(path.shape[1]):
            step = abs(path[k + 1, i] - path[k, i])
            if not math.isfinite(step):
                return -1
            largest = max(largest, step)
        steps = largest / resolution
        if not steps <= MOST_STEPS - starts[k]:  # before it is rounded: whole numbers overflow
            return -1
        starts[k + 1] = starts[k] + max(1, int(math.ceil(steps)))
    return int(starts[len(path) - 1])


@inlined
def _segment(starts: Integers, g: int) -> int:
    """Return the segment that state ``g`` of the grid lies on, the last one for the end."""
    low, high = 0, len(starts) - 1
    while high - low > 1:
        middle = (low + high) // 2
        if starts[middle] <= g:
            low = middle
        else:
            high = middle
    return low


@inlined
def _state(path: Floats, starts: Integers, g: int, out: Floats) -> None:
    """Put state ``g`` of the grid over a path into ``out``."""
    k = _segment(starts, g)
    if g == starts[k + 1]:
        k += 1
    if g == starts[k]:
        for i in range(len(out)):
            out[i] = path[k, i]
        return
    step = (g - starts[k]) / (starts[k + 1] - starts[k])
    for i in range(len(out)):
        out[i] = path[k, i] + step * (path[k + 1, i] - path[k, i])


@inlined
def _take_in(w: Work, state: Floats, middle: Floats, along: float) -> None:
    """Widen reach and stray to a state that is about ``along`` of a step from the middle."""
    along = min(max(along, -1.0), 1.0)
    for i in range(len(middle)):
        shift = state[i] - middle[i]
        w.reach[i] = max(w.reach[i], abs(shift))
        w.stray[i] = max(w.stray[i], abs(shift - along * w.step[i]))


@inlined
def _describe(path: Floats, starts: Integers, a: int, b: int, middle: Floats, w: Work) -> None:
    """Describe the path between two states of the grid for :func:`bound_motion`, as seen from a state between them."""
    centre, dof = (a + b) // 2, len(middle)
    _state(path, starts, b, w.end)
    for i in range(dof):
        w.step[i] = 0.5 * w.end[i]
        w.reach[i] = w.stray[i] = 0.0
    _state(path, starts, a, w.end)
    for i in range(dof):
        w.step[i] -= 0.5 * w.end[i]
    _take_in(w, w.end, middle, 2.0 * (a - centre) / (b - a))
    _state(path, starts, b, w.end)
    _take_in(w, w.end, middle, 2.0 * (b - centre) / (b - a))
    for k in range(_segment(starts, a) + 1, _segment(starts, b) + 1):
        _take_in(w, path[k], middle, 2.0 * (starts[k] - centre) / (b - a))
    for i in range(dof):
        w.reach[i] = max(w.reach[i], abs(w.step[i]) + w.stray[i]) + 1e-12  # and rounding
        w.stray[i] += 1e-12


@entry
def advance(
    ri: Integers, rf: Floats, si: Integers, sf: Floats, wi: Integers, wf: Floats, path: Floats, starts: Integers,
    queue: Integers, ends: Integers, state: Floats, found: Integers, check_counts: Integers,
) -> int:  # fmt: skip
    """Prove a path until a state is met that only the meshes can judge.

    The path, shape (N, dof), carries a grid: vertex k is state ``starts[k]`` of it, shape (N,), with evenly spaced
    ones between. ``queue`` holds intervals of the grid that are not settled, from ``ends[0]`` to ``ends[1]``; an
    interval of one state asks for that state. The ends of every other interval have their own entries. Of an interval
    the middle is judged, then a box around it that holds all of the interval, and if that is not proved its halves
    wait their turn, so that states are met in bit-reversed order.

    Returns:
        DONE, or the number of the state that is not proved: it is in ``state``, its pairs in ``found`` (K, 2) and
        their number in ``ends[2]``, as in :func:`judge_states`. Calling again goes on behind it.
    """
    t, s = robot_view(ri, rf), scene_view(si, sf)
    w = work_view(t, wi, wf)
    while ends[0] < ends[1]:
        a, b = queue[ends[0], 0], queue[ends[0], 1]
        ends[0] += 1
        middle = (a + b) // 2
        if b - a == 1:
            continue
        _state(path, starts, middle, state)
        ends[2] = judged(t, s, w, state, found)
        if ends[2] == 0:
            check_counts[PROVED_STATES] += 1
            if b - a >= 3:
                check_counts[TRIED_BOXES] += 1
                _describe(path, starts, a, b, state, w)
                if known(t, state, w.reach):
                    bound_motion(t, w)
                    if proved(t, s, w, state, w.pair):
                        check_counts[PROVED_BOXES] += 1
                        check_counts[PROVED_STEPS] += b - a
                        continue
        if b - a >= 2:
            queue[ends[1], 0], queue[ends[1], 1] = a, middle
            queue[ends[1] + 1, 0], queue[ends[1] + 1, 1] = middle, b
            ends[1] += 2
        if ends[2] != 0:
            check_counts[OPEN_STATES] += 1
            return int(middle)
    return DONE
