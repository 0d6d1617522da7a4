"""Motions made of others: of joints that move beside each other, sums of displacements, and rests.

Where two motions of the same joints overlap, q(t) = q_1(t) + q_2(t) - q_0, with the state q_0 that they share: the
start of both, or the end of the first and the start of the second. Sums of piecewise cubic polynomials are of the same
kind, so that they are proved and limited as any other motion.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from apex_ompl.errors import ParameterError
from apex_ompl.timing.knots import SAME_KNOT, union
from apex_ompl.timing.trajectory import Trajectory
from apex_ompl.types import Array


def together(motions: Sequence[Trajectory]) -> Trajectory:
    """Return motions of different joints, which start at the same time, as one; each stands still after its end.

    Raises:
        ParameterError: No motion, or a joint in two of them.
    """
    names = [name for motion in motions for name in motion.joint_names]
    if not names or len(set(names)) < len(names):
        raise ParameterError("motions", ", ".join(names) or "none", "motions of different joints")
    times = union(*(motion.times for motion in motions))
    states = np.concatenate([motion.states(times) for motion in motions], axis=2)
    return Trajectory(times, states[0], states[1], states[2], tuple(names))


def rest(state: Array, duration: float, joint_names: Sequence[str]) -> Trajectory:
    """Return the motion that stands at a state, shape (dof,), for a time [s]."""
    times = np.array([0.0, duration]) if duration > 0.0 else np.zeros(1)
    still = np.zeros((len(times), len(state)))
    return Trajectory(times, still + state, still, still, tuple(joint_names))


def until_rest(motion: Trajectory) -> Trajectory:
    """Return a motion without the rest at its end."""
    moving = (motion.positions != motion.positions[-1]).any(axis=1)
    moving |= (motion.velocities != 0.0).any(axis=1) | (motion.accelerations != 0.0).any(axis=1)
    last = int(np.flatnonzero(moving)[-1]) + 2 if moving.any() else 1
    if last >= len(motion.times):
        return motion
    states = np.stack([motion.positions, motion.velocities, motion.accelerations])[:, :last]
    return Trajectory(motion.times[:last], states[0], states[1], states[2], motion.joint_names)


def superposed(parts: Sequence[tuple[Trajectory, float]]) -> Trajectory:
    """Return the sum of the displacements of motions, each of which rests before it starts and after it ends.

    Args:
        parts: Motions from rest to rest and the times when they start [s], the first one at 0.
    """
    first = parts[0][0]
    times = union(*(motion.times + start for motion, start in parts))
    q = np.tile(first.positions[0], (len(times), 1))
    v, a = np.zeros_like(q), np.zeros_like(q)
    for motion, start in parts:
        inside = np.clip(times - start, 0.0, motion.duration)
        moving = (times >= start - SAME_KNOT) & (times <= start + motion.duration + SAME_KNOT)
        q += motion(inside) - motion.positions[0]
        v += np.where(moving[:, None], motion(inside, order=1), 0.0)
        a += np.where(moving[:, None], motion(inside, order=2), 0.0)
    return Trajectory(times, q, v, a, first.joint_names)
