"""Inverse kinematics on the kernel's tables: targets, residuals and descents."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from apex_ompl.errors import ParameterError
from apex_ompl.kernel.compiled.layout import Floats, Integers, pack
from apex_ompl.kernel.compiled.robot.inverse_kinematics import (
    ANGLE,
    OFFSET,
    OPPOSITION,
    TargetArrays,
    approach,
    descend,
    ik_buffer_sizes,
    residual_and_jacobian,
)
from apex_ompl.kernel.compiled.workspace import workspace_sizes
from apex_ompl.kernel.tables import RobotTables
from apex_ompl.types import Array
from apex_ompl.util.arrays import compact
from apex_ompl.util.validation import check_indices, shape_error


class FixedVector(NamedTuple):
    """A point or a direction that is fixed to the frame of a joint; joint 0 is the world.

    Attributes:
        joint: Number of the joint.
        vector: In its frame, shape (3,) [m, or of length 1].
    """

    joint: int
    vector: ArrayLike


@dataclass(frozen=True, eq=False)
class Target:
    """A residual to bring to zero: see :func:`offset_target`, :func:`opposition_target` and :func:`angle_target`.

    Attributes:
        kind: Which of the three.
        vectors: Points or directions a, b and c.
        value: Distance, sign or cosine.
        weight: Factor on the residual.
    """

    kind: int
    vectors: tuple[FixedVector, FixedVector, FixedVector]
    value: float
    weight: float

    def __post_init__(self) -> None:
        """Check what the compiled code trusts.

        Raises:
            ParameterError: Another kind, or not three vectors on joints with numbers.
        """
        if self.kind not in (OFFSET, OPPOSITION, ANGLE) or len(self.vectors) != 3:
            raise ParameterError("target", (self.kind, self.vectors), "a kind and three vectors")
        for joint, vector in self.vectors:
            if isinstance(joint, bool) or not isinstance(joint, (int, np.integer)):
                raise ParameterError("target", joint, "the number of a joint")
            if np.shape(vector) != (3,):
                raise ParameterError("target", vector, "a vector of shape (3,)")

    @property
    def joints(self) -> tuple[int, ...]:
        """Joints of the three vectors."""
        return tuple(int(v.joint) for v in self.vectors)

    @property
    def rows(self) -> int:
        """How many numbers its residual has."""
        return 1 if self.kind == ANGLE else 3


NOTHING = FixedVector(0, (0.0, 0.0, 0.0))


def offset_target(
    first: FixedVector, second: FixedVector, along: FixedVector = NOTHING, distance: float = 0.0, weight: float = 1.0
) -> Target:
    """Return a target for two points: ``distance`` apart along a unit direction, or at one place.

    The residual is weight (second - first - distance along), shape (3,) [m].
    """
    return Target(OFFSET, (first, second, along), float(distance), float(weight))


def opposition_target(first: FixedVector, second: FixedVector, sign: float = 1.0, weight: float = 1.0) -> Target:
    """Return a target for two unit directions: opposite, or with sign -1 equal.

    The residual is weight (first + sign second), shape (3,).
    """
    return Target(OPPOSITION, (first, second, NOTHING), float(sign), float(weight))


def angle_target(first: FixedVector, second: FixedVector, cosine: float = 0.0, weight: float = 1.0) -> Target:
    """Return a target for the angle between two unit directions, by its cosine.

    The residual is weight (first . second - cosine), shape (1,).
    """
    return Target(ANGLE, (first, second, NOTHING), float(cosine), float(weight))


@lru_cache(maxsize=256)
def _moving(
    parents: bytes, sources: bytes, joints: tuple[int, ...], fixed: tuple[int, ...]
) -> tuple[Integers, Integers]:
    """Return the joints above some and they themselves, and the planned joints that move them, without fixed ones.

    Args:
        parents: Parent of each joint, as bytes of integers, which can be keys of a cache.
        sources: Planned joint of each, or -1.
        joints: The joints.
        fixed: The planned joints that are left out.
    """
    parent, source, above = np.frombuffer(parents, np.int64), np.frombuffer(sources, np.int64), set[int]()
    for joint in joints:
        k = joint
        while k > 0 and k not in above:
            above.add(k)
            k = int(parent[k])
    moved = {int(source[j]) for j in above} - {-1}
    return np.array(sorted(above), np.int64), np.array(sorted(moved - set(fixed)), np.int64)


class IKDescents(NamedTuple):
    """Ends of descents.

    Attributes:
        states: Shape (N, dof).
        errors: Norms of the residuals there, shape (N,).
        steps: Steps taken, shape (N,).
    """

    states: Array
    errors: Array
    steps: NDArray[np.int64]


class IKSolver:
    """Inverse kinematics of a robot for some targets; serial, and safe to use from several threads."""

    def __init__(self, robot: RobotTables, targets: Sequence[Target], fixed: Sequence[int] | NDArray[np.intp] = ()):
        """Bring ``targets`` to zero together, but leave the planned joints whose numbers are ``fixed`` alone.

        The numbers of those that are moved are in ``free``.

        Raises:
            ParameterError: There is no target, or one hangs on a joint that the robot does not have.
        """
        arrays = robot.arrays
        joints = sorted({j for target in targets for j in target.joints})
        if not joints or joints[0] < 0 or joints[-1] >= len(arrays.joint_parent):
            raise ParameterError("targets", joints, f"targets on joints 0 to {len(arrays.joint_parent) - 1}")
        check_indices(fixed, robot.dof, "fixed", "planned joints")
        self.robot = robot
        self.targets = tuple(targets)
        self.rows = sum(target.rows for target in targets)
        arrays_of_targets = TargetArrays(
            kind=np.array([target.kind for target in targets], np.int64),
            joints=np.array([target.joints for target in targets], np.int64),
            vectors=np.array([[v.vector for v in target.vectors] for target in targets], float),
            value=np.array([target.value for target in targets]),
            weight=np.array([target.weight for target in targets]),
        )
        self._targets = pack(arrays_of_targets)
        structure = arrays.joint_parent.tobytes(), arrays.joint_source.tobytes()
        moving = _moving(*structure, tuple(joints), tuple(int(k) for k in fixed))
        self._chain, self.free = (array.copy() for array in moving)  # which users of these may change
        self._workspace_sizes = workspace_sizes(arrays)
        self._buffer_sizes = ik_buffer_sizes(robot.dof, len(self.free))

    def _memory(self, sizes: tuple[int, int]) -> tuple[Integers, Floats]:
        return np.empty(sizes[0], np.int64), np.empty(sizes[1])

    def residual(self, q: Array) -> tuple[Array, Array]:
        """Return the residual at a state, shape (m,), and its Jacobian, shape (m, dof), of all planned joints.

        Raises:
            ParameterError: Another shape.
        """
        q = compact(q)
        if q.shape != (self.robot.dof,):
            raise ParameterError("state", q.shape, f"an array of shape ({self.robot.dof},)")
        values, jacobian = np.empty(self.rows), np.empty((self.rows, len(q)))
        residual_and_jacobian(
            *self.robot.packed, *self._memory(self._workspace_sizes), self._chain, *self._targets, q, values, jacobian,
            *self._memory(self._buffer_sizes),
        )  # fmt: skip
        return values, jacobian

    def descend(
        self, states: ArrayLike, *, tolerance: float = 1e-4, max_steps: int = 100, damping: float = 1e-2
    ) -> IKDescents:
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
        ends, errors, counts = self._ends(states)
        descend(
            *self.robot.packed, *self._memory(self._workspace_sizes), self._chain, self.free, *self._targets, ends,
            errors, counts, float(tolerance), int(max_steps), float(damping), *self._memory(self._buffer_sizes),
        )  # fmt: skip
        return IKDescents(ends, errors, counts)

    def approach(
        self, states: ArrayLike, start: Array, reach: Array, power: int, *, weight: float = 1e3, max_steps: int = 12
    ) -> IKDescents:
        """Move states towards a start, with the targets as a penalty, inside the limits.

        The sum over joints of (distance / reach)^power becomes less, locally; with a high power that is the largest
        of them. A :meth:`descend` brings the ends back to the targets.

        Args:
            states: First states, shape (N, dof).
            start: The start, shape (dof,).
            reach: Distances of the joints that count as equal, above 0, shape (dof,).
            power: Even, 2 or more.
            weight: Of the residuals.
            max_steps: Most steps to take.

        Raises:
            ParameterError: Another shape, a reach that is not above 0, or another power.
        """
        ends, errors, counts = self._ends(states)
        start, reach = compact(start), compact(reach)
        for name, value in (("start", start), ("reach", reach)):
            if value.shape != (self.robot.dof,):
                raise shape_error(value, (self.robot.dof,), name)
        if not (reach > 0.0).all():
            raise ParameterError("reach", reach.min(), "distances above 0")
        if power < 2 or power % 2:
            raise ParameterError("power", power, "an even number from 2")
        approach(
            *self.robot.packed, *self._memory(self._workspace_sizes), self._chain, self.free, *self._targets, start,
            reach, int(power), float(weight), ends, errors, counts, int(max_steps),
            *self._memory(self._buffer_sizes),
        )  # fmt: skip
        return IKDescents(ends, errors, counts)

    def _ends(self, states: ArrayLike) -> tuple[Array, Array, NDArray[np.int64]]:
        """Return a copy of states, shape (N, dof), and memory for errors and numbers of steps."""
        ends = np.array(states, float, order="C", ndmin=2)
        if ends.ndim != 2 or ends.shape[1] != self.robot.dof:
            raise shape_error(ends, ("N", self.robot.dof), "states")
        return ends, np.empty(len(ends)), np.empty(len(ends), np.int64)
