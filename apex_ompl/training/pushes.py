"""How obstacles push a robot's joints, by torch, as trainings need it; see also ``Kernel.joint_pushes``."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from apex_ompl.kernel import RobotTables
from apex_ompl.kernel.arrays import FIXED, REVOLUTE
from apex_ompl.model.scene_encoding import REACH
from apex_ompl.types import Array


@dataclass(frozen=True, eq=False)
class Chains:
    """Joints above probe points.

    Attributes:
        joint: The J joints that move and carry a probe point, parents before children, shape (J,).
        below: 1 where a joint moves a probe point, shape (J, P).
        revolute: Whether a joint turns, shape (J,).
        to_state: Rate of each joint's value by the planned ones, shape (J, dof).
    """

    joint: NDArray[np.int64]
    below: Array
    revolute: NDArray[np.bool_]
    to_state: Array

    @classmethod
    def of(cls, robot: RobotTables, probe_joint: NDArray[np.int64]) -> Chains:
        """Return the joints of a robot above probe points, which are fixed to joints of shape (P,)."""
        a = robot.arrays
        chains = []
        for carrier in probe_joint.tolist():
            chain, joint = [], carrier
            while joint > 0:
                chain.append(joint)
                joint = int(a.joint_parent[joint])
            chains.append(chain)
        moving = sorted({j for chain in chains for j in chain if a.joint_kind[j] != FIXED})
        below = np.array([[float(j in chain) for chain in chains] for j in moving]).reshape(len(moving), -1)
        to_state = np.zeros((len(moving), robot.dof))
        to_state[np.arange(len(moving)), a.joint_source[moving]] = a.joint_ratio[moving]
        return cls(np.array(moving, np.int64), below, a.joint_kind[moving] == REVOLUTE, to_state)


def pushes(
    chains: tuple[Tensor, Tensor, Tensor], frames: tuple[Tensor, Tensor], points: Tensor, distances: Tensor,
    gradients: Tensor,
) -> Tensor:  # fmt: skip
    """Return generalized forces of the nearest obstacles at N states, shape (N, dof) [m].

    Args:
        chains: ``below``, ``revolute`` and ``to_state`` of :class:`Chains`.
        frames: Axes, shape (N, J, 3), and origins, shape (N, J, 3) [m], of its joints.
        points: Probe points, shape (N, P, 3) [m].
        distances: Their signed distances from the nearest obstacles, shape (N, P) [m].
        gradients: The gradients of these, shape (N, P, 3).
    """
    force = (1.0 - distances / REACH).clip(min=0.0)[..., None] * gradients
    return generalized_forces(chains, frames, points, force)


def generalized_forces(
    chains: tuple[Tensor, Tensor, Tensor], frames: tuple[Tensor, Tensor], points: Tensor, force: Tensor
) -> Tensor:
    """Return generalized forces of forces on points at N states, their transposed Jacobians times these: (N, dof).

    Args:
        chains: ``below``, ``revolute`` and ``to_state`` of :class:`Chains`.
        frames: Axes, shape (N, J, 3), and origins, shape (N, J, 3) [m], of its joints.
        points: Shape (N, P, 3) [m].
        force: Shape (N, P, 3).
    """
    below, revolute, to_state = chains
    axes, origins = frames
    total, moment = (torch.einsum("jp,npi->nji", below, v) for v in (force, torch.linalg.cross(points, force)))
    torque = moment - torch.linalg.cross(origins, total)
    along = (axes * torch.where(revolute[:, None], torque, total)).sum(-1)
    return along @ to_state
