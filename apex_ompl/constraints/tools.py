"""Kinematics of several tools at many states at once: places, Jacobians, null spaces, and Newton's method on poses."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from apex_ompl.kernel import Kernel
from apex_ompl.kernel.arrays import FIXED, PRISMATIC
from apex_ompl.kernel.products import product
from apex_ompl.kernel.tool_poses import DAMPING, LEAST_SQUARE, ToolSolver
from apex_ompl.types import Array, Flags

LEAST_PIVOT = 1e-14
NULL = 1e-6  # least square of a column of the projector, for there to be a null space


class Tool(NamedTuple):
    """A frame that is moved by joints of its own.

    Attributes:
        name: Its name.
        joint: Joint that it is fixed to, by the kernel's number.
        pose: Pose in the frame of the joint, shape (4, 4) [m].
        columns: Planned joints that move it, shape (C,).
    """

    name: str
    joint: int
    pose: Array
    columns: NDArray[np.intp]


class Linearization(NamedTuple):
    """Derivatives of one tool's pose at N states.

    Attributes:
        jacobian: Velocity and angular velocity in the world by joint, shape (N, 6, C).
        factor: Lower Cholesky factor of J J^T + lambda I, shape (N, 6, 6).
    """

    jacobian: Array
    factor: Array

    @property
    def manipulability(self) -> Array:
        """sqrt(det J J^T) (Yoshikawa 1985), shape (N,)."""
        return np.asarray(np.prod(np.diagonal(self.factor, axis1=1, axis2=2), axis=1))


class Tools:
    """Tools of a robot, each moved by other joints than the others are.

    Attributes:
        tools: The tools.
        kernel: The robot among its obstacles.
    """

    def __init__(self, kernel: Kernel, tools: Sequence[Tool]) -> None:
        """Find the joints of each tool."""
        self.kernel, self.tools = kernel, tuple(tools)
        arrays = kernel.robot.arrays
        self._chains, self._selections, self._prismatic, self._arms = [], [], [], list[Array]()
        for tool in tools:
            joint, reach = tool.joint, float(np.sqrt((tool.pose[:3, 3] ** 2).sum()))
            chain, arms = list[int](), list[float]()
            while joint > 0:
                source = int(arrays.joint_source[joint])
                planned = arrays.joint_kind[joint] != FIXED and source in tool.columns
                if arrays.joint_kind[joint] == PRISMATIC:
                    ends = np.array([arrays.lower[source], arrays.upper[source]])
                    reach += float(np.abs(arrays.joint_ratio[joint] * ends + arrays.joint_shift[joint]).max())
                if planned:
                    chain.insert(0, joint)
                    arms.insert(0, reach)
                reach += float(np.sqrt((arrays.joint_offset[joint] ** 2).sum()))
                joint = int(arrays.joint_parent[joint])
            selection = np.zeros((len(chain), len(tool.columns)))
            for row, joint in enumerate(chain):
                selection[row, list(tool.columns).index(arrays.joint_source[joint])] = arrays.joint_ratio[joint]
            self._chains.append(np.array(chain))
            self._selections.append(selection)
            self._prismatic.append(arrays.joint_kind[chain] == PRISMATIC)
            self._arms.append(np.array(arms))
        poses = np.array([tool.pose for tool in tools]).reshape(-1, 4, 4)
        self._solver = ToolSolver(kernel.robot, [t.joint for t in tools], poses, [t.columns for t in tools])

    def poses(self, q: Array) -> tuple[Array, Array]:
        """Return rotations, shape (N, F, 3, 3), and origins, shape (N, F, 3) [m], of F tools at states, (N, dof)."""
        return self._placed(self.kernel.joint_frames(q))

    def linearizations(self, q: Array) -> list[Linearization]:
        """Return the derivatives of each tool's pose at states, shape (N, dof)."""
        frames = self.kernel.joint_frames(q)
        points = self._placed(frames)[1]
        return [self._linearized(f, frames, points[:, f]) for f in range(len(self.tools))]

    def speeds(self, q: Array, velocities: Array) -> Array:
        """Return speeds of the tools' origins at states moving with velocities, both (N, dof); shape (N, F) [m/s]."""
        frames = self.kernel.joint_frames(q)
        points, found = self._placed(frames)[1], []
        for f, tool in enumerate(self.tools):
            moved = product(self._jacobian(f, frames, points[:, f]), velocities[:, tool.columns, None])[:, :3, 0]
            found.append(np.sqrt((moved * moved).sum(axis=1)))
        return np.stack(found, axis=1)

    def close(self, q: Array, rotation: Array, point: Array, steps: int = 8) -> tuple[Array, Flags]:
        """Return states at which the tools have given poses, near others, and which arrived.

        Newton's method with the pseudoinverse; limits of the joints are not taken into account.

        Args:
            q: First states, shape (N, dof).
            rotation: Wanted rotations, shape (N, F, 3, 3).
            point: Wanted origins, shape (N, F, 3) [m].
            steps: Most steps.
        """
        return self._solver.close(q, rotation, point, steps)

    def bends(self, f: int, velocity: Array, acceleration: Array) -> tuple[Array, Array, Array]:
        """Return bounds of a tool's acceleration, angular velocity and angular acceleration.

        With joints i from the base to the tip, arms a_i (the longest distance of the tool from the joint), and S_i the
        sum of the speeds of the joints before i,

            |p''| <= sum_i a_i (|q_i''| + |q_i'| (|q_i'| + 2 S_i)),    |w'| <= sum_i (|q_i''| + |q_i'| S_i).

        Args:
            f: Number of the tool.
            velocity: Bounds of |q'|, shape (N, dof).
            acceleration: Bounds of |q''|, shape (N, dof).
        """
        columns, spread = self.tools[f].columns, np.abs(self._selections[f]).T
        v, a = product(velocity[:, columns], spread), product(acceleration[:, columns], spread)
        turning = np.where(self._prismatic[f], 0.0, v)
        before = np.cumsum(turning, axis=1) - turning
        arm = np.where(self._prismatic[f], 1.0, self._arms[f])
        bend = (arm * (a + v * (turning + 2.0 * before))).sum(axis=1)
        return bend, turning.sum(axis=1), (np.where(self._prismatic[f], 0.0, a) + turning * before).sum(axis=1)

    def _placed(self, frames: tuple[Array, Array]) -> tuple[Array, Array]:
        rotation, origin = frames
        turned = [product(rotation[:, tool.joint], tool.pose[:3, :3]) for tool in self.tools]
        points = [origin[:, t.joint] + product(rotation[:, t.joint], t.pose[:3, 3:])[..., 0] for t in self.tools]
        return np.stack(turned, axis=1), np.stack(points, axis=1)

    def _jacobian(self, f: int, frames: tuple[Array, Array], point: Array) -> Array:
        chain, prismatic = self._chains[f], self._prismatic[f]
        axis = frames[0][..., 2][:, chain]
        arm = point[:, None] - frames[1][:, chain]
        twist = np.empty((len(point), 6, len(chain)))
        for i, (j, k) in enumerate(((1, 2), (2, 0), (0, 1))):
            twist[:, i] = axis[..., j] * arm[..., k] - axis[..., k] * arm[..., j]
            twist[:, 3 + i] = axis[..., i]
            if prismatic.any():
                twist[:, i, prismatic] = axis[:, prismatic, i]
                twist[:, 3 + i, prismatic] = 0.0
        return product(twist, self._selections[f])

    def _linearized(self, f: int, frames: tuple[Array, Array], point: Array) -> Linearization:
        jacobian = self._jacobian(f, frames, point)
        return Linearization(jacobian, factored(product(jacobian, _transposed(jacobian))))


def null_directions(at: Linearization) -> Array:
    """Return a unit vector of the null space of each Jacobian, shape (N, C), 0 where there is none.

    It is the largest column of the projector I - J^T (J J^T)^-1 J, with signs so that neighbors agree.
    """
    projector = -product(_transposed(at.jacobian), solved(at.factor, at.jacobian))
    columns = projector.shape[1]
    projector[:, range(columns), range(columns)] += 1.0
    squares = np.diagonal(projector, axis1=1, axis2=2)
    best = squares.argmax(axis=1)
    size = squares[np.arange(len(best)), best]
    found = projector[np.arange(len(best)), best] / np.sqrt(np.maximum(size, NULL))[:, None]
    found[size <= NULL] = 0.0
    turned = (found[1:] * found[:-1]).sum(axis=1) < 0.0
    found[1:] *= np.cumprod(np.where(turned, -1.0, 1.0))[:, None]
    return np.asarray(found)


def pose_errors(rotation: Array, point: Array, wanted_rotation: Array, wanted_point: Array) -> Array:
    """Return what poses lack of others, shape (..., 6): translation [m] and small rotations in the world [rad]."""
    turn = np.zeros(point.shape)
    cosine = -0.5
    for k in range(3):
        a, b = rotation[..., k], wanted_rotation[..., k]
        for i, (j, m) in enumerate(((1, 2), (2, 0), (0, 1))):
            turn[..., i] += 0.5 * (a[..., j] * b[..., m] - a[..., m] * b[..., j])
        cosine = cosine + 0.5 * (a * b).sum(axis=-1)
    square = (turn * turn).sum(axis=-1)
    far = np.asarray(cosine) < 0.0  # more than a quarter of a turn
    scale = np.where(far, 1.0 / np.sqrt(np.maximum(square, LEAST_SQUARE)), 1.0 + square / 6.0)
    return np.concatenate([wanted_point - point, scale[..., None] * turn], axis=-1)


def factored(matrix: Array) -> Array:
    """Return the lower Cholesky factors of matrices A + lambda I, A positive semidefinite, shape (N, m, m)."""
    size = matrix.shape[1]
    factor = np.zeros_like(matrix)
    for j in range(size):
        pivot = matrix[:, j, j] + DAMPING - (factor[:, j, :j] * factor[:, j, :j]).sum(axis=1)
        factor[:, j, j] = np.sqrt(np.maximum(pivot, LEAST_PIVOT))
        if j + 1 < size:
            below = (factor[:, j + 1 :, :j] * factor[:, j : j + 1, :j]).sum(axis=2)
            factor[:, j + 1 :, j] = (matrix[:, j + 1 :, j] - below) / factor[:, j, j, None]
    return factor


def solved(factor: Array, right: Array) -> Array:
    """Return the solutions X of L L^T X = R for factors, shape (N, m, m), and R of shape (N, m, k)."""
    found, size = right.copy(), factor.shape[1]
    for i in range(size):
        found[:, i] -= (factor[:, i, :i, None] * found[:, :i]).sum(axis=1)
        found[:, i] /= factor[:, i, i, None]
    for i in reversed(range(size)):
        found[:, i] -= (factor[:, i + 1 :, i, None] * found[:, i + 1 :]).sum(axis=1)
        found[:, i] /= factor[:, i, i, None]
    return found


def _transposed(matrix: Array) -> Array:
    return np.ascontiguousarray(matrix.transpose(0, 2, 1))
