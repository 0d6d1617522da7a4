"""What changed between two kernels of one checker, and whether motions can have been affected."""

from __future__ import annotations

import numpy as np

from apex_ompl.collision.path_proof import obstacles_alone
from apex_ompl.kernel import Kernel
from apex_ompl.types import Array, Flags
from apex_ompl.util.resolution import SEARCH_RESOLUTION


def changed_obstacles(before: Kernel, now: Kernel) -> Flags | None:
    """Return which solids of the scene of now were not in it before, shape (solids,).

    A solid that is gone can block nothing. None where more changed than obstacles: the robot, what it holds, or which
    pairs may touch.
    """
    old, new = before.scene.arrays, now.scene.arrays
    if now.robot is not before.robot or not np.array_equal(old.allowed, new.allowed):
        return None
    known = {_row(before, k) for k in range(len(old.kind))}
    return np.array([_row(now, k) not in known for k in range(len(new.kind))], bool)


def _row(kernel: Kernel, k: int) -> tuple[object, ...]:
    """Return all that a solid is, but for its place in the tables."""
    a, grids = kernel.scene.arrays, kernel.scene.grids
    grid = grids[k] if len(grids) else None
    return (
        int(a.kind[k]),
        int(a.owner[k]),
        a.rotation[k].tobytes(),
        a.offset[k].tobytes(),
        a.size[k].tobytes(),
        id(grid),
    )


def may_have_become_blocked(before: Kernel, now: Kernel, first: Array, last: Array) -> Flags:
    """Return which straight motions that were free before may be blocked now, shape (N,).

    Those that the sphere cover proves clear of all solids that are new, or moved, stay free.

    Args:
        before: The kernel with which they were free.
        now: The kernel of now.
        first: States that they begin at, shape (N, dof).
        last: States that they end at, shape (N, dof).
    """
    changed = None if now is before else changed_obstacles(before, now)
    if now is before or (changed is not None and not changed.any()):
        return np.zeros(len(first), bool)
    if changed is None:
        return np.ones(len(first), bool)
    alone = obstacles_alone(now, changed)
    return np.array([not alone.proves(np.stack(ends), SEARCH_RESOLUTION) for ends in zip(first, last, strict=True)])
