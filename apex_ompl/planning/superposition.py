"""Sums of motions from rest to rest: of arms that move at once, and of one motion that starts before another ends.

Where two motions overlap, q(t) = q_1(t) + q_2(t) - q_0, with the state q_0 that they share: the start of both, or the
end of the first and the start of the second. Sums of piecewise cubic polynomials are of the same kind, so that they are
proved and limited as any other motion.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from apex_ompl.timing import Trajectory
from apex_ompl.types import Array
from apex_ompl.util.arrays import distinct

APART = 1e-9  # least time between knots [s]


def superposed(parts: Sequence[tuple[Trajectory, float]]) -> Trajectory:
    """Return the sum of the displacements of motions, each of which rests before it starts and after it ends.

    Args:
        parts: Motions from rest to rest and the times when they start [s], the first one at 0.
    """
    first = parts[0][0]
    known = np.sort(np.concatenate([motion.times + start for motion, start in parts]))
    times = known[np.append(True, np.diff(known) > APART)]
    q = np.tile(first.positions[0], (len(times), 1))
    v, a = np.zeros_like(q), np.zeros_like(q)
    for motion, start in parts:
        inside = np.clip(times - start, 0.0, motion.duration)
        moving = (times >= start - APART) & (times <= start + motion.duration + APART)
        q += motion(inside) - motion.positions[0]
        v += np.where(moving[:, None], motion(inside, order=1), 0.0)
        a += np.where(moving[:, None], motion(inside, order=2), 0.0)
    return Trajectory(times, q, v, a, first.joint_names)


def abreast(paths: Sequence[Array]) -> Array:
    """Return the states of paths that are followed at once, each in proportion to its number of states, shape (N, dof).

    Args:
        paths: States from the same start, shape (M, dof) each.
    """
    shares = [np.linspace(0.0, 1.0, len(path)) for path in paths]
    u = distinct(np.concatenate([np.array([0.0, 1.0]) if max(map(len, paths)) > 1 else np.zeros(1), *shares]))
    q = np.tile(paths[0][0], (len(u), 1))
    for path, share in zip(paths, shares, strict=True):
        if len(path) > 1:
            q += np.stack([np.interp(u, share, column) for column in (path - path[0]).T], axis=1)
    return q
