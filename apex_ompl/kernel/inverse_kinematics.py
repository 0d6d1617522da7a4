"""Inverse kinematics on the kernel's tables: targets, residuals and descents; numpy alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from apex_ompl.errors import ParameterError
from apex_ompl.kernel.ik_solver import FACING, GAP, PARTS, SLOPE, descend, residual
from apex_ompl.kernel.tables import RobotTables
from apex_ompl.kernel.views import room
from apex_ompl.types import Array
from apex_ompl.util.validation import check_indices, is_integer, shape_error


class Fixed(NamedTuple):
    """A point or a direction that is fixed to the frame of a joint; joint 0 is the world.

    Attributes:
        joint: Number of the joint.
        vector: In its frame, shape (3,) [m, or of length 1].
    """

    joint: int
    vector: ArrayLike


@dataclass(frozen=True)
class Target:
    """Something to bring to zero; made by :func:`gap`, :func:`facing` or :func:`slope`."""

    whole: tuple[int, int, int, int]
    parts: tuple[float, ...]

    def __post_init__(self) -> None:
        """Check what the compiled code trusts.

        Raises:
            ParameterError: Not four whole numbers, the kind first, or not eleven parts.
        """
        if len(self.whole) != 4 or self.whole[0] not in (GAP, FACING, SLOPE):
            raise ParameterError("target", self.whole, "a kind and three joints")
        if not all(is_integer(j) for j in self.whole):
            raise ParameterError("target", self.whole, "whole numbers of joints")
        if len(self.parts) != PARTS:
            raise ParameterError("target", self.parts, f"{PARTS} parts")

    @property
    def rows(self) -> int:
        """How many numbers its residual has."""
        return 1 if self.whole[0] == SLOPE else 3


NOTHING = Fixed(0, (0.0, 0.0, 0.0))


def gap(first: Fixed, second: Fixed, along: Fixed = NOTHING, distance: float = 0.0, weight: float = 1.0) -> Target:
    """Bring a point to where it is ``distance`` from another along a direction: weight (second - first - d along)."""
    return _target(GAP, first, second, along, distance, weight)


def facing(first: Fixed, second: Fixed, sign: float = 1.0, weight: float = 1.0) -> Target:
    """Bring two unit directions to face each other, or with sign -1 to agree: weight (first + sign second)."""
    return _target(FACING, first, second, NOTHING, sign, weight)


def slope(first: Fixed, second: Fixed, cosine: float = 0.0, weight: float = 1.0) -> Target:
    """Bring the angle of two unit directions to one whose cosine is given: weight (first . second - cosine)."""
    return _target(SLOPE, first, second, NOTHING, cosine, weight)


def _target(kind: int, a: Fixed, b: Fixed, c: Fixed, number: float, weight: float) -> Target:
    vectors = [np.asarray(v.vector, float).reshape(3) for v in (a, b, c)]
    return Target((kind, a.joint, b.joint, c.joint), (*np.concatenate(vectors).tolist(), float(number), float(weight)))


class Descents(NamedTuple):
    """Ends of descents.

    Attributes:
        states: Shape (N, dof).
        errors: Norms of the residuals there, shape (N,).
        steps: Steps taken, shape (N,).
    """

    states: Array
    errors: Array
    steps: NDArray[np.int64]


class Inverse:
    """Inverse kinematics of a robot for some targets; serial, and safe to use from several threads."""

    def __init__(self, robot: RobotTables, targets: Sequence[Target], fixed: Sequence[int] | NDArray[np.intp] = ()):
        """Bring ``targets`` to zero together, but leave the planned joints whose numbers are ``fixed`` alone.

        Raises:
            ParameterError: There is no target, or one hangs on a joint that the robot does not have.
        """
        arrays = robot.arrays
        joints = sorted({j for target in targets for j in target.whole[1:]})
        if not joints or joints[0] < 0 or joints[-1] >= len(arrays.joint_parent):
            raise ParameterError("targets", joints, f"targets on joints 0 to {len(arrays.joint_parent) - 1}")
        check_indices(fixed, robot.dof, "fixed", "planned joints")
        self.robot = robot
        self.targets = tuple(targets)
        self.rows = sum(target.rows for target in targets)
        self._whole = np.array([target.whole for target in targets], np.int64)
        self._parts = np.array([target.parts for target in targets])
        above: set[int] = set()
        for joint in joints:
            k = joint
            while k > 0 and k not in above:
                above.add(k)
                k = int(arrays.joint_parent[k])
        self._chain = np.array(sorted(above), np.int64)
        moved = {int(arrays.joint_source[j]) for j in above} - {-1}
        self._free = np.array(sorted(moved - {int(k) for k in fixed}), np.int64)
        self._room = room(arrays)

    def _working(self) -> tuple[NDArray[np.int64], Array]:
        return np.empty(self._room[0], np.int64), np.empty(self._room[1])

    def residual(self, q: Array) -> tuple[Array, Array]:
        """Return the residual at a state, shape (m,), and its Jacobian, shape (m, dof), of all planned joints.

        Raises:
            ParameterError: Another shape.
        """
        q = np.require(q, float, ["C", "W"])
        if q.shape != (self.robot.dof,):
            raise shape_error(q, (self.robot.dof,), "state")
        values, rows = np.empty(self.rows), np.empty((self.rows, len(q)))
        work = np.empty((4, max(len(q), 3)))
        residual(
            *self.robot.packed,
            *self._working(),
            self._chain,
            self._whole,
            self._parts,
            q,
            values,
            rows,
            work[:, : len(q)],
        )
        return values, rows

    def descend(
        self, states: ArrayLike, *, tolerance: float = 1e-4, max_steps: int = 100, damping: float = 1e-2
    ) -> Descents:
        """Descend from states by damped least squares (Levenberg-Marquardt), clipped to the limits.

        A state that is not finite in a joint that the targets depend on gets an error that is not finite; other joints
        stay as they are.

        Args:
            states: First states, shape (N, dof).
            tolerance: Norm of the residual at which to stop.
            max_steps: Most steps to take.
            damping: First damping factor; it shrinks with success and grows with failure.

        Raises:
            ParameterError: Another shape.
        """
        ends = np.array(states, float, order="C", ndmin=2)
        if ends.ndim != 2 or ends.shape[1] != self.robot.dof:
            raise shape_error(ends, ("N", self.robot.dof), "states")
        errors, counts = np.empty(len(ends)), np.empty(len(ends), np.int64)
        n, dof = len(self._free), ends.shape[1]
        scratch = np.empty(3 + 4 * dof + 3 * n * n + 3 * n)
        descend(
            *self.robot.packed, *self._working(), self._chain, self._free, self._whole, self._parts, ends, errors,
            counts, np.array([tolerance, max_steps, damping], float), scratch,
        )  # fmt: skip
        return Descents(ends, errors, counts)
