"""What a model of scene ``clearances`` sees, computed by the kernel for many scenes at once: for trainings on a CPU.

There torch takes many times as long for it as for the network.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from apex_ompl.kernel import Kernel
from apex_ompl.kernel.scene_distances import ObstacleBatch
from apex_ompl.model.query import MAX_DISTANCE
from apex_ompl.model.scene_encoding import KEY_RANGE, Sight
from apex_ompl.training.obstacles import Obstacles
from apex_ompl.training.torch_scene_encoding import TorchSight
from apex_ompl.types import Array


class CompiledSight(TorchSight):
    """A :class:`TorchSight` on the CPU whose frames and distances the kernel computes."""

    def __init__(self, sight: Sight, kernel: Kernel, device: torch.device) -> None:
        """Evaluate a sight for a robot; of the kernel only the kinematics are used."""
        super().__init__(sight, kernel, device)
        self._kernel, self._groups = kernel, sight.balls(kernel)

    def frames(self, states: Tensor) -> tuple[Tensor, Tensor]:
        """Return rotations (N, J, 3, 3) and origins (N, J, 3) [m] of the joints in use, at states (N, dof)."""
        rotation, origin = self._kernel.joint_frames(states.numpy(), torch.get_num_threads())
        return _single(rotation[:, self._needed]), _single(origin[:, self._needed])

    def nearest(self, obstacles: Obstacles, points: Tensor) -> tuple[Tensor, Tensor]:
        """Return distances, at most MAX_DISTANCE, and gradients of points of scenes, see :meth:`Obstacles.nearest`."""
        first = np.searchsorted(obstacles.owner.numpy(), np.arange(len(points) + 1))
        found = _batch(obstacles).nearest(first, points.numpy(), MAX_DISTANCE, torch.get_num_threads())
        return _single(found[0]), _single(found[1])

    def least(self, obstacles: Obstacles, centers: Tensor, radii: Tensor) -> Tensor:
        """Return the least distance of each obstacle from balls of its scene, see :meth:`Obstacles.least`."""
        return _single(_batch(obstacles).least(obstacles.owner.numpy(), centers.numpy(), radii.numpy()))

    def at_keys(self, obstacles: Obstacles) -> Tensor:
        """Return the features of key states by each obstacle alone, shape (T, K * A); a scene has the least of them."""
        found = _batch(obstacles).clearances(self._groups, KEY_RANGE)
        return torch.from_numpy(np.maximum(found, -KEY_RANGE) / KEY_RANGE).half()


def _batch(obstacles: Obstacles) -> ObstacleBatch:
    columns = (obstacles.shape, obstacles.position, obstacles.rotation, obstacles.size)
    return ObstacleBatch(*(column.numpy() for column in columns))


def _single(values: Array) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(values, np.float32))
