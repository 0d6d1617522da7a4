"""Proofs that whole paths are free, by bisection of a grid of states over them."""

from __future__ import annotations

import math

from apex_ompl.kernel.compiled.arrays import RobotArrays, SceneArrays, robot_view, scene_view
from apex_ompl.kernel.compiled.check.curve import piece_of
from apex_ompl.kernel.compiled.check.separation import tables_hold, unproved, unproved_at_state
from apex_ompl.kernel.compiled.compilation import entry_point, inlined, outlined
from apex_ompl.kernel.compiled.layout import Floats, Integers, Singles
from apex_ompl.kernel.compiled.robot.motion_bound import bound_displacements
from apex_ompl.kernel.compiled.workspace import Workspace, workspace_view

PROVED_STATES, OPEN_STATES, PROVED_INTERVALS, TRIED_INTERVALS, PROVED_STEPS = range(5)  # what is counted
DONE = -1
MOST_STEPS = 50_000_000


@inlined
def grid_over(path: Floats, resolution: float, starts: Integers) -> int:
    """Lay a grid over a path, see :func:`lay_grid`."""
    starts[0] = 0
    for k in range(len(path) - 1):
        largest = 0.0
        for i in range(path.shape[1]):
            step = abs(path[k + 1, i] - path[k, i])
            if not math.isfinite(step):
                return -1
            largest = max(largest, step)
        steps = largest / resolution
        if not steps <= MOST_STEPS - starts[k]:  # compared as floats: an int would overflow
            return -1
        starts[k + 1] = starts[k] + max(1, int(math.ceil(steps)))
    return int(starts[len(path) - 1])


@entry_point
def lay_grid(path: Floats, resolution: float, starts: Integers) -> int:
    """Lay a grid of states over a path, shape (N, dof), at most ``resolution`` apart [max-norm].

    ``starts`` (N,) gets the numbers of the given states in the grid; from each to the next there are as many steps as
    are needed, at least one.

    Returns:
        The number of the last state, or -1 for a path with numbers that are not finite, or with too many steps.
    """
    return int(grid_over(path, resolution, starts))


@inlined
def _state(path: Floats, starts: Integers, g: int, out: Floats) -> None:
    """Put state ``g`` of the grid over a path into ``out``."""
    k = piece_of(starts, g)
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
def _widen(w: Workspace, state: Floats, middle: Floats, along: float) -> None:
    """Widen half width and deviation so that they hold a state that is about ``along`` steps from the middle."""
    along = min(max(along, -1.0), 1.0)
    for i in range(len(middle)):
        offset = state[i] - middle[i]
        w.half_width[i] = max(w.half_width[i], abs(offset))
        w.deviation[i] = max(w.deviation[i], abs(offset - along * w.step[i]))


@inlined
def _set_motion(path: Floats, starts: Integers, a: int, b: int, middle: Floats, w: Workspace) -> None:
    """Set step, deviation and half width of ``w`` for the path from state ``a`` to ``b`` around ``middle``."""
    center, dof = (a + b) // 2, len(middle)
    _state(path, starts, b, w.end)
    for i in range(dof):
        w.step[i] = 0.5 * w.end[i]
        w.half_width[i] = w.deviation[i] = 0.0
    _state(path, starts, a, w.end)
    for i in range(dof):
        w.step[i] -= 0.5 * w.end[i]
    _widen(w, w.end, middle, 2.0 * (a - center) / (b - a))
    _state(path, starts, b, w.end)
    _widen(w, w.end, middle, 2.0 * (b - center) / (b - a))
    for k in range(piece_of(starts, a) + 1, piece_of(starts, b) + 1):
        _widen(w, path[k], middle, 2.0 * (starts[k] - center) / (b - a))
    for i in range(dof):
        w.half_width[i] = max(w.half_width[i], abs(w.step[i]) + w.deviation[i]) + 1e-12  # against rounding
        w.deviation[i] += 1e-12


@outlined
def prove_grid(
    t: RobotArrays, s: SceneArrays, w: Workspace, path: Floats, starts: Integers, queue: Integers, ends: Integers,
    state: Floats, found: Integers, counts: Integers,
) -> int:  # fmt: skip
    """Prove a path free, up to the first state that is not proved, see :func:`prove_path`."""
    while ends[0] < ends[1]:
        a, b = queue[ends[0], 0], queue[ends[0], 1]
        ends[0] += 1
        middle = (a + b) // 2
        if b - a == 1:
            continue
        _state(path, starts, middle, state)
        ends[2] = unproved_at_state(t, s, w, state, found)
        if ends[2] == 0:
            counts[PROVED_STATES] += 1
            if b - a >= 3:
                counts[TRIED_INTERVALS] += 1
                _set_motion(path, starts, a, b, state, w)
                if tables_hold(t, state, w.half_width):
                    bound_displacements(t, w)
                    if unproved(t, s, w, state, w.pair) == 0:
                        counts[PROVED_INTERVALS] += 1
                        counts[PROVED_STEPS] += b - a
                        continue
        if b - a >= 2:
            queue[ends[1], 0], queue[ends[1], 1] = a, middle
            queue[ends[1] + 1, 0], queue[ends[1] + 1, 1] = middle, b
            ends[1] += 2
        if ends[2] != 0:
            counts[OPEN_STATES] += 1
            return int(middle)
    return DONE


@inlined
def is_motion_proved(
    t: RobotArrays, s: SceneArrays, w: Workspace, motion: Floats, resolution: float, starts: Integers, queue: Integers,
    ends: Integers, state: Floats, found: Integers, counts: Integers,
) -> bool:  # fmt: skip
    """Whether a straight motion, shape (2, dof), is proved free after its first state, its last state first.

    Buffers are those of :func:`prove_path`; a motion of more states than there is room for is not proved.
    """
    last = grid_over(motion, resolution, starts)
    if last < 0 or len(queue) < 2 * last + 4:
        return False
    queue[0, 0] = queue[0, 1] = queue[1, 1] = last
    queue[1, 0], ends[0], ends[1] = 0, 0, 2
    return bool(prove_grid(t, s, w, motion, starts, queue, ends, state, found, counts) == DONE)


@entry_point
def prove_path(
    ri: Integers, rf: Floats, si: Integers, sf: Floats, sg: Singles, wi: Integers, wf: Floats,
    path: Floats, starts: Integers,
    queue: Integers, ends: Integers, state: Floats, found: Integers, counts: Integers,
) -> int:  # fmt: skip
    """Prove a path free, up to the first state that is not proved.

    The path, shape (N, dof), carries a grid: vertex k is state ``starts[k]`` of it, shape (N,), with evenly spaced
    states between. The grid is bisected breadth first. ``queue`` holds the open intervals, entries ``ends[0]`` to
    ``ends[1]``; an interval (k, k) stands for state k alone. For each, the state in the middle is checked, then the
    motion over the whole interval by the bounds on displacements; if that is not proved, its two halves are appended.

    ``counts`` (5,) counts in the order of PROVED_STATES ... PROVED_STEPS.

    Returns:
        DONE, or the number of the state that is not proved: it is in ``state``, its pairs in ``found`` (K, 2) and
        their number in ``ends[2]``, as in :func:`.queries.check_states`. Another call goes on after it.
    """
    t, s = robot_view(ri, rf), scene_view(si, sf, sg)
    w = workspace_view(t, wi, wf)
    return int(prove_grid(t, s, w, path, starts, queue, ends, state, found, counts))
