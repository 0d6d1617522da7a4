"""Shortcuts along a path of straight motions, where the spheres prove that they are free."""

from __future__ import annotations

import math

from apex_ompl.kernel.compiled.arrays import RobotArrays, SceneArrays, robot_view, scene_view
from apex_ompl.kernel.compiled.compilation import entry_point, inlined
from apex_ompl.kernel.compiled.layout import Floats, Integers, Singles
from apex_ompl.kernel.compiled.motion_proof import is_motion_proved
from apex_ompl.kernel.compiled.workspace import Workspace, workspace_view

LEAST_GAIN = 1e-6  # by which a shortcut must be shorter [rad]


@inlined
def _apart(path: Floats, i: int, j: int) -> float:
    """Return the distance of two states [rad]."""
    square = 0.0
    for d in range(path.shape[1]):
        square += (path[j, d] - path[i, d]) ** 2
    return float(math.sqrt(square))


@inlined
def _leave_out(
    t: RobotArrays, s: SceneArrays, w: Workspace, path: Floats, count: int, resolution: float, motion: Floats,
    starts: Integers, queue: Integers, ends: Integers, state: Floats, found: Integers, counts: Integers,
) -> int:  # fmt: skip
    """Leave out corners between which the straight motion is proved, most at a time; return how many are left."""
    dof, i = path.shape[1], 0
    while i < count - 2:
        for j in range(count - 1, i + 1, -1):
            for d in range(dof):
                motion[0, d], motion[1, d] = path[i, d], path[j, d]
            if is_motion_proved(t, s, w, motion, resolution, starts, queue, ends, state, found, counts):
                for k in range(j, count):
                    for d in range(dof):
                        path[i + 1 + k - j, d] = path[k, d]
                count -= j - i - 1
                break
        i += 1
    return count


@inlined
def _point_at(path: Floats, count: int, along: float, out: Floats) -> int:
    """Put the state at a length along a path into place [rad]; return the number of the state before it."""
    for i in range(count - 1):
        length = _apart(path, i, i + 1)
        if along <= length or i == count - 2:
            share = min(along / length, 1.0) if length > 0.0 else 0.0
            for d in range(path.shape[1]):
                out[d] = path[i, d] + share * (path[i + 1, d] - path[i, d])
            return i
        along -= length
    return count - 2


@entry_point
def shortcut_path(
    ri: Integers, rf: Floats, si: Integers, sf: Floats, sg: Singles, wi: Integers, wf: Floats,
    draws: Floats, resolution: float, path: Floats, count: int,
    motion: Floats, starts: Integers, queue: Integers, ends: Integers, state: Floats, found: Integers, counts: Integers,
) -> int:  # fmt: skip
    """Shorten a path by straight motions between two states of it, its corners first, then any.

    Args:
        ri: Robot, packed; see :func:`apex_ompl.kernel.compiled.layout.pack`.
        rf: Robot.
        si: Scene, packed.
        sf: Scene.
        sg: Scene.
        wi: Workspace, see :func:`apex_ompl.kernel.compiled.workspace.workspace_sizes`.
        wf: Workspace.
        draws: Where shortcuts begin and end, as shares of the length, shape (N, 2).
        resolution: Largest spacing of the states that are checked [rad, max-norm].
        path: Corners of the path, shape (M, dof), with room for more.
        count: Their number.
        motion: Memory, shape (2, dof).
        starts: Memory, shape (2,).
        queue: Memory, twice as many rows as the longest motion has states, and 4.
        ends: Memory, shape (3,).
        state: Memory, shape (dof,).
        found: Memory, shape (1, 2).
        counts: Gets numbers of what was proved, see :func:`apex_ompl.kernel.compiled.motion_proof.prove_path`.

    Returns:
        The number of corners that are left.
    """
    t, s = robot_view(ri, rf), scene_view(si, sf, sg)
    w = workspace_view(t, wi, wf)
    dof = path.shape[1]
    count = _leave_out(t, s, w, path, count, resolution, motion, starts, queue, ends, state, found, counts)
    for n in range(len(draws)):
        if count < 3:
            break
        total = 0.0
        for i in range(count - 1):
            total += _apart(path, i, i + 1)
        low, high = min(draws[n, 0], draws[n, 1]) * total, max(draws[n, 0], draws[n, 1]) * total
        i, j = _point_at(path, count, low, motion[0]), _point_at(path, count, high, motion[1])
        size = i + 3 + count - 1 - j
        if i == j or size > len(path) or _apart(motion, 0, 1) > high - low - LEAST_GAIN:
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
    return int(_leave_out(t, s, w, path, count, resolution, motion, starts, queue, ends, state, found, counts))
