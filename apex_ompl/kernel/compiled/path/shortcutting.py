"""Shortcuts along a path of straight motions, where the spheres prove that they are free."""

from __future__ import annotations

import math

from apex_ompl.kernel.compiled.arrays import RobotArrays, SceneArrays, robot_view, scene_view
from apex_ompl.kernel.compiled.check.motion_proof import is_motion_proved
from apex_ompl.kernel.compiled.compilation import entry_point, inlined
from apex_ompl.kernel.compiled.layout import Floats, Integers, Singles
from apex_ompl.kernel.compiled.workspace import Workspace, workspace_view

LEAST_GAIN = 1e-6  # by which a shortcut must be shorter [rad]


@inlined
def _apart(path: Floats, i: int, j: int, weight: Floats) -> float:
    """Return the distance of two states [rad]."""
    square = 0.0
    for d in range(path.shape[1]):
        square += ((path[j, d] - path[i, d]) * weight[d]) ** 2
    return float(math.sqrt(square))


@inlined
def _leave_out(
    t: RobotArrays, s: SceneArrays, w: Workspace, path: Floats, count: int, resolution: float, motion: Floats,
    starts: Integers, queue: Integers, ends: Integers, state: Floats, found: Integers, counts: Integers,
    first: int, tries: int,
) -> tuple[int, int]:  # fmt: skip
    """Leave out corners between which the straight motion is proved, most at a time, from a corner on.

    It ends after the corner at which it has tried ``tries`` motions or more.

    Returns:
        How many corners are left, and the corner from which to go on.
    """
    dof, i = path.shape[1], first
    while i < count - 2 and tries > 0:
        for j in range(count - 1, i + 1, -1):
            tries -= 1
            for d in range(dof):
                motion[0, d], motion[1, d] = path[i, d], path[j, d]
            if is_motion_proved(t, s, w, motion, resolution, starts, queue, ends, state, found, counts):
                for k in range(j, count):
                    for d in range(dof):
                        path[i + 1 + k - j, d] = path[k, d]
                count -= j - i - 1
                break
        i += 1
    return count, i


@inlined
def _point_at(path: Floats, count: int, along: float, weight: Floats, out: Floats) -> int:
    """Put the state at a length along a path into place [rad]; return the number of the state before it."""
    for i in range(count - 1):
        length = _apart(path, i, i + 1, weight)
        if along <= length or i == count - 2:
            share = min(along / length, 1.0) if length > 0.0 else 0.0
            for d in range(path.shape[1]):
                out[d] = path[i, d] + share * (path[i + 1, d] - path[i, d])
            return i
        along -= length
    return count - 2


@inlined
def _cut(
    t: RobotArrays, s: SceneArrays, w: Workspace, draws: Floats, path: Floats, count: int, resolution: float,
    motion: Floats, starts: Integers, queue: Integers, ends: Integers, state: Floats, found: Integers, counts: Integers,
) -> int:  # fmt: skip
    """Put straight motions between drawn places of a path in place, where they are proved; return how many corners."""
    dof = path.shape[1]
    for n in range(len(draws)):
        if count < 3:
            break
        total = 0.0
        for i in range(count - 1):
            total += _apart(path, i, i + 1, t.weight)
        low, high = min(draws[n, 0], draws[n, 1]) * total, max(draws[n, 0], draws[n, 1]) * total
        i = _point_at(path, count, low, t.weight, motion[0])
        j = _point_at(path, count, high, t.weight, motion[1])
        size = i + 3 + count - 1 - j
        if i == j or size > len(path) or _apart(motion, 0, 1, t.weight) > high - low - LEAST_GAIN:
            continue
        if not is_motion_proved(t, s, w, motion, resolution, starts, queue, ends, state, found, counts):
            continue
        if size > count:
            for k in range(count - 1, j, -1):
                for d in range(dof):
                    path[k + size - count, d] = path[k, d]
        else:
            for k in range(j + 1, count):
                for d in range(dof):
                    path[k + size - count, d] = path[k, d]
        for d in range(dof):
            path[i + 1, d], path[i + 2, d] = motion[0, d], motion[1, d]
        count = size
    return count


@entry_point
def shortcut_path(
    ri: Integers, rf: Floats, si: Integers, sf: Floats, sg: Singles, wi: Integers, wf: Floats,
    draws: Floats, resolution: float, path: Floats, progress: Integers,
    motion: Floats, starts: Integers, queue: Integers, ends: Integers, state: Floats, found: Integers, counts: Integers,
) -> None:  # fmt: skip
    """Shorten a path by straight motions between two states of it: draws, or without any, between its corners.

    Args:
        ri: Robot, packed; see :func:`apex_ompl.kernel.compiled.layout.pack`.
        rf: Robot.
        si: Scene, packed.
        sf: Scene.
        sg: Scene.
        wi: Workspace, see :func:`apex_ompl.kernel.compiled.workspace.workspace_sizes`.
        wf: Workspace.
        draws: Where shortcuts start and end, as shares of the length, shape (N, 2).
        resolution: Largest spacing of the states that are checked [rad, max-norm].
        path: Corners of the path, shape (M, dof), with room for more.
        progress: Their number, the corner from which corners are left out, and for how many motions that is tried,
            shape (3,). The first two get what they are afterwards.
        motion: Memory, shape (2, dof).
        starts: Memory, shape (2,).
        queue: Memory, twice as many rows as the longest motion has states, and 4.
        ends: Memory, shape (3,).
        state: Memory, shape (dof,).
        found: Memory, shape (1, 2).
        counts: Gets numbers of what was proved, see :func:`apex_ompl.kernel.compiled.check.motion_proof.prove_path`.
    """
    t, s = robot_view(ri, rf), scene_view(si, sf, sg)
    w = workspace_view(t, wi, wf)
    count = progress[0]
    if len(draws) == 0:
        count, progress[1] = _leave_out(
            t, s, w, path, count, resolution, motion, starts, queue, ends, state, found, counts, progress[1],
            progress[2],
        )  # fmt: skip
    else:
        count = _cut(t, s, w, draws, path, count, resolution, motion, starts, queue, ends, state, found, counts)
    progress[0] = count
