"""Inverse kinematics: damped least squares on residuals of link poses, inside the joint limits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from apex_ompl.robot import Robot

Array = NDArray[np.float64]


class Kinematics:
    """Poses and Jacobians of links in state order; one per thread."""

    def __init__(self, robot: Robot) -> None:
        """Keep Pinocchio data for ``robot``."""
        self.robot = robot
        self._data = robot.model.createData()
        self._columns = np.argsort(robot.to_pinocchio(np.arange(robot.dof, dtype=float)))

    def update(self, q: Array) -> None:
        """Run the kinematics at a state, shape (dof,)."""
        model = self.robot.model
        pin.computeJointJacobians(model, self._data, self.robot.to_pinocchio(q))
        pin.updateFramePlacements(model, self._data)

    def pose(self, frame: int) -> Array:
        """Return the pose of a frame in the world, shape (4, 4) [m]."""
        return np.array(self._data.oMf[frame].homogeneous)

    def jacobian(self, frame: int) -> Array:
        """Return the Jacobian of a frame's origin in world axes, shape (6, dof): linear, then angular."""
        local = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        return np.array(pin.getFrameJacobian(self.robot.model, self._data, frame, local))[:, self._columns]


class Task(Protocol):
    """Something to bring to zero."""

    def residual(self, kinematics: Kinematics) -> tuple[Array, Array]:
        """Return the residual, shape (m,), and its Jacobian, shape (m, dof), at the updated state."""


@dataclass(frozen=True)
class PointTask:
    """Bring a point of a link to a point of the world.

    Attributes:
        frame: The link's frame.
        local: The point in the link's frame, shape (3,) [m].
        target: The point in the world, shape (3,) [m].
    """

    frame: int
    local: Array
    target: Array

    def residual(self, kinematics: Kinematics) -> tuple[Array, Array]:
        """Return the offset from the target [m] and its Jacobian."""
        pose, jacobian = kinematics.pose(self.frame), kinematics.jacobian(self.frame)
        arm = pose[:3, :3] @ self.local
        return pose[:3, 3] + arm - self.target, jacobian[:3] - pin.skew(arm) @ jacobian[3:]


@dataclass(frozen=True)
class AxisTask:
    """Turn an axis of a link to a direction of the world.

    Attributes:
        frame: The link's frame.
        local: Unit axis in the link's frame, shape (3,).
        target: Unit direction in the world, shape (3,).
    """

    frame: int
    local: Array
    target: Array

    def residual(self, kinematics: Kinematics) -> tuple[Array, Array]:
        """Return the difference of the two unit vectors and its Jacobian."""
        axis = kinematics.pose(self.frame)[:3, :3] @ self.local
        return axis - self.target, -pin.skew(axis) @ kinematics.jacobian(self.frame)[3:]


@dataclass(frozen=True)
class IKResult:
    """Outcome of one descent.

    Attributes:
        q: The best state, shape (dof,).
        error: Norm of its residual.
        iterations: Steps taken.
    """

    q: Array
    error: float
    iterations: int


def solve(
    kinematics: Kinematics,
    tasks: Sequence[Task],
    q0: Array,
    *,
    tolerance: float = 1e-4,
    max_iterations: int = 100,
    damping: float = 1e-2,
    fixed: Sequence[int] | NDArray[np.intp] = (),
) -> IKResult:
    """Descend from a state by damped least squares (Levenberg-Marquardt steps), clipped to the limits.

    Args:
        kinematics: Of the robot.
        tasks: What to bring to zero, together.
        q0: First state, shape (dof,).
        tolerance: Norm of the residual at which to stop.
        max_iterations: Most steps to take.
        damping: First damping factor; it shrinks with success and grows with failure.
        fixed: Indices of joints that stay as they are in ``q0``.
    """
    limits = kinematics.robot.limits
    held = np.asarray(fixed, dtype=np.intp)

    def evaluate(q: Array) -> tuple[Array, Array]:
        kinematics.update(q)
        parts = [task.residual(kinematics) for task in tasks]
        jacobian = np.concatenate([j for _, j in parts])
        jacobian[:, held] = 0.0
        return np.concatenate([r for r, _ in parts]), jacobian

    q = np.clip(np.asarray(q0, float), limits.lower, limits.upper)
    residual, jacobian = evaluate(q)
    error = float(np.linalg.norm(residual))
    count = 0
    while count < max_iterations and error > tolerance:
        count += 1
        gram = jacobian.T @ jacobian + damping * np.eye(len(q))
        trial = np.clip(q - np.linalg.solve(gram, jacobian.T @ residual), limits.lower, limits.upper)
        new_residual, new_jacobian = evaluate(trial)
        new_error = float(np.linalg.norm(new_residual))
        if new_error < error:
            q, residual, jacobian, error = trial, new_residual, new_jacobian, new_error
            damping = max(damping / 3.0, 1e-9)
        else:
            damping *= 4.0
            if damping > 1e6:
                break
    return IKResult(q, error, count)
