"""Self-motions: the curves of states of a redundant arm that reach the same poses.

Descents of inverse kinematics from random states find a state on each curve. From there a curve is followed both ways
along the null vector of the Jacobian, by predictor and corrector steps (Allgower and Georg 2003, chapter 2), until it
closes or meets a joint limit. Between its states the joint that moves most moves by :data:`SPACING`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apex_ompl.kernel import IKSolver
from apex_ompl.robot.model import Robot
from apex_ompl.types import Array

SPACING = 0.1  # between states of a curve, of the joint that moves most [rad]
SHORTEST = 1.0 / 16.0  # least step, as a share of SPACING
LONGEST_JUMP = 1.5  # largest change by a corrected step, as a share of the predicted one
MOST_STEPS = 400  # of a curve, each way
EXACT = 1e-9  # norm of the residual at which descents end
REACHED = 1e-6  # largest norm of the residual of a state that reaches the poses
DESCENT_STEPS, CORRECTOR_STEPS = 60, 8
SINGULAR = 1e-3  # singular values below this share of the largest count as 0
BATCH = 32  # descents at once
IDLE = 64  # descents that reach the poses in a row without a new curve, after which the search ends
SAME = 1e-3  # distance up to which states of an arm that is not redundant, or of two searches, are one [rad]


@dataclass(frozen=True, eq=False)
class SelfMotions:
    """What a search found.

    Attributes:
        states: States that reach the poses, shape (N, dof).
        curves: Number of the curve of each, shape (N,); states of arms with more than one redundant joint, which are
            drawn at random, have one each.
        descents: Number of descents from random states.
        missed: Where those ended that did not reach the poses, shape (M, dof).
    """

    states: Array
    curves: NDArray[np.intp]
    descents: int
    missed: Array

    @classmethod
    def together(cls, found: Sequence[SelfMotions]) -> SelfMotions:
        """Return what several searches found, each state once, with the curves numbered on."""
        states, curves = found[0].states, found[0].curves
        for one in found[1:]:
            away = [np.abs(states - q).max(axis=1, initial=0.0).min(initial=np.inf) for q in one.states]
            apart = np.array(away) > SAME
            states = np.concatenate([states, one.states[apart]])
            curves = np.concatenate([curves, one.curves[apart] + curves.max(initial=-1) + 1])
        missed = np.concatenate([one.missed for one in found])
        return cls(states, curves, sum(one.descents for one in found), missed)


def search(
    inverse: IKSolver, robot: Robot, base: Array, rng: np.random.Generator, *, descents: int, most: int
) -> SelfMotions:
    """Find the curves of states that reach the targets of an inverse kinematics, and follow them.

    Args:
        inverse: The inverse kinematics.
        robot: The robot, whose continuous joints end within half a turn of ``base``.
        base: Values of the joints that do not move, and the first state to descend from, shape (dof,).
        rng: Source of random states.
        descents: Most descents from random states.
        most: Number of states after which no further curve is searched for.
    """
    free, (lower, upper) = inverse.free, robot.range_around(base)
    shape = (-1, len(base))
    states, curves, missed = np.empty((0, len(base))), list[int](), list[Array]()
    attempts = idle = number = 0
    while attempts < descents and idle < IDLE and len(states) < most:
        seeds = np.tile(base, (min(BATCH, descents - attempts), 1))
        first = 1 if attempts == 0 else 0
        seeds[first:, free] = rng.uniform(lower[free], upper[free], (len(seeds) - first, len(free)))
        ends = inverse.descend(seeds, tolerance=EXACT, max_steps=DESCENT_STEPS)
        attempts += len(seeds)
        for q, error in zip(robot.turned_to(ends.states, base), ends.errors, strict=True):
            if not error <= REACHED:
                missed.append(q)
                continue
            away = float(np.abs(robot.turned_to(states, q) - q).max(axis=1).min(initial=np.inf))
            redundant = _redundancy(inverse, q) if away > SAME else 0
            if away <= (SPACING if redundant else SAME):
                idle += 1
                continue
            idle = 0
            found = list(_curve(inverse, robot, q)) if redundant == 1 else [q]
            states = np.concatenate([states, [robot.turned_to(one, base) for one in found]])
            curves += [number] * len(found)
            number += 1
    return SelfMotions(states, np.array(curves, np.intp), attempts, np.array(missed).reshape(shape))


def _redundancy(inverse: IKSolver, q: Array) -> int:
    """Return how many directions leave the residual as it is at a state, shape (dof,)."""
    singular = np.linalg.svd(inverse.residual(q)[1][:, inverse.free])[1]
    return len(inverse.free) - _rank(singular)


def _rank(singular: Array) -> int:
    return int((singular > SINGULAR * singular[0]).sum()) if len(singular) else 0


def _curve(inverse: IKSolver, robot: Robot, q: Array) -> Iterator[Array]:
    """Yield states along the curve through a state, shape (dof,) each, itself first."""
    yield q
    for sign in (1.0, -1.0):
        closed = False
        before, direction = q, sign * _tangent(inverse, q, None)
        for k in range(MOST_STEPS):
            after = _step(inverse, robot, before, direction)
            if after is None:
                break
            closed = k > 1 and float(np.abs(robot.turned_to(after, q) - q).max()) < 0.75 * SPACING
            if closed:
                break
            yield after
            before, direction = after, _tangent(inverse, after, direction)
        if closed:
            return


def _tangent(inverse: IKSolver, q: Array, before: Array | None) -> Array:
    """Return the direction of a curve at a state, its largest element 1, shape (dof,).

    It is the null vector of the Jacobian; with the direction before, that one's projection on the null space, so that
    the curve goes on the same way.
    """
    free = inverse.free
    _, singular, rows = np.linalg.svd(inverse.residual(q)[1][:, free])
    null = rows[-1]
    if before is not None:
        kernel = rows[min(_rank(singular), len(free) - 1) :]
        null = kernel.T @ (kernel @ before[free])
    made = np.zeros(len(q))
    made[free] = null / max(float(np.abs(null).max()), 1e-12)
    return made


def _step(inverse: IKSolver, robot: Robot, q: Array, direction: Array) -> Array | None:
    """Return the next state of a curve, shape (dof,), or None where it ends."""
    limits = robot.limits
    room = np.where(direction > 0.0, limits.upper - q, q - limits.lower) / np.maximum(np.abs(direction), 1e-12)
    step = min(SPACING, float(room[inverse.free].min()))
    while step >= SHORTEST * SPACING:
        ends = inverse.descend((q + step * direction)[None], tolerance=EXACT, max_steps=CORRECTOR_STEPS)
        after = ends.states[0]
        moved = after - q
        near = float(np.abs(moved).max()) <= LONGEST_JUMP * step
        if ends.errors[0] <= REACHED and near and float((moved * direction).sum()) > 0.0:
            return np.asarray(after)
        step *= 0.5
    return None
