"""Queries as batches of tensors: start, goal, obstacle point, and the obstacles."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields

import numpy as np
import torch
from torch import Tensor

from apex_ompl.kernel import Kernel
from apex_ompl.model.geometry import rotation_matrices
from apex_ompl.model.query import HALVES, Probes, Query
from apex_ompl.model.scene_encoding import Sight
from apex_ompl.training.obstacles import Obstacles
from apex_ompl.training.records import Paths


@dataclass(frozen=True)
class Conditions:
    """Batch of B queries as tensors, padded to M obstacles each.

    Attributes:
        start: Shape (B, dof) [rad].
        goal: Shape (B, dof) [rad].
        point: Obstacle points, shape (B, 3) [m].
        probes: Positions of the P probe points at L states of the straight line, shape (B, L, P, 3) [m].
        shape: Indices of shapes, shape (B, M).
        position: Shape (B, M, 3) [m].
        rotation: Rotation matrices, shape (B, M, 3, 3).
        size: Half edges; radius; or radius and half length along z, shape (B, M, 3) [m].
        mask: True for an obstacle, False for padding, shape (B, M).
        seen: Features of a :class:`Sight`, shape (B, F). Where there are any, obstacles and probe points are left out.
        among: The obstacles of such conditions, where a model is trained that looks at them again.
    """

    start: Tensor
    goal: Tensor
    point: Tensor
    probes: Tensor
    shape: Tensor
    position: Tensor
    rotation: Tensor
    size: Tensor
    mask: Tensor
    seen: Tensor
    among: Obstacles | None = field(default=None, kw_only=True)

    def to(self, device: torch.device | str) -> Conditions:
        """Return a copy on a device; those of ``among`` stay where they are."""
        return Conditions(*(getattr(self, name).to(device) for name in COLUMNS), among=self.among)

    @classmethod
    def concatenate(cls, batches: Sequence[Conditions]) -> Conditions:
        """Return batches as one, padded to the largest number of obstacles; ``among`` of several is left out."""
        if len(batches) == 1:
            return batches[0]
        most = max(batch.mask.shape[1] for batch in batches)
        columns = []
        for name in COLUMNS:
            tensors = [getattr(batch, name) for batch in batches]
            if name in ("shape", "position", "rotation", "size", "mask"):
                tensors = [_zero_padded(tensor, most) for tensor in tensors]
            columns.append(torch.cat(tensors))
        return cls(*columns)

    def obstacles(self) -> Obstacles:
        """Return all T obstacles of the batch."""
        mask = self.mask
        columns = self.shape[mask], self.position[mask], self.rotation[mask], self.size[mask]
        return Obstacles(*columns, mask.nonzero()[:, 0])

    def probe_distances(self) -> Tensor:
        """Return the signed distances from each of the T obstacles to its query's probe points, (T, L * P) [m]."""
        obstacles = self.obstacles()
        return obstacles.distances(self.probes.flatten(1, 2)[obstacles.owner])


COLUMNS = tuple(f.name for f in fields(Conditions) if f.name != "among")
"""Names of the tensors of conditions, one row for each query."""


def pad_obstacles(values: Tensor, mask: Tensor, fill: float) -> Tensor:
    """Return values of all T obstacles of a batch, shape (T, K), by query: shape (B, M + 1, K).

    At least one row a query is padding, so that a reduction over the obstacles is defined where there are none.

    Args:
        values: Shape (T, K).
        mask: Which obstacles there are, shape (B, M), with T True entries.
        fill: Value of the padding.
    """
    count, most = mask.shape
    padded = values.new_full((count, most + 1, values.shape[1]), fill)
    padded[:, :most][mask] = values
    return padded


def _zero_padded(tensor: Tensor, most: int) -> Tensor:
    """Return a tensor of shape (B, M, ...) extended by zeros to shape (B, most, ...)."""
    if tensor.shape[1] == most:
        return tensor
    zeros = tensor.new_zeros(len(tensor), most - tensor.shape[1], *tensor.shape[2:])
    return torch.cat([tensor, zeros], dim=1)


def batch_queries(queries: Sequence[Query], eyes: Probes | Sight, kernel: Kernel) -> Conditions:
    """Return queries as a batch; of the kernel only the robot's kinematics are used, not its scene."""
    if isinstance(eyes, Sight):
        rows = (np.stack([getattr(q, name) for q in queries]) for name in ("start", "goal", "point"))
        ends = (torch.tensor(row, dtype=torch.float32) for row in rows)
        return conditions_of_features(torch.from_numpy(eyes.features(queries, kernel)), *ends)
    most = max((len(q.obstacles) for q in queries), default=0)
    count = len(queries)
    shape, mask = np.zeros((count, most), np.int64), np.zeros((count, most), bool)
    position, size = np.zeros((count, most, 3), np.float32), np.zeros((count, most, 3), np.float32)
    rotation = np.broadcast_to(np.eye(3, dtype=np.float32), (count, most, 3, 3)).copy()
    for k, query in enumerate(queries):
        n, obstacles = len(query.obstacles), query.obstacles
        shape[k, :n], mask[k, :n], position[k, :n] = obstacles.shape, True, obstacles.position
        rotation[k, :n], size[k, :n] = obstacles.rotation, obstacles.size
    start, goal = np.stack([q.start for q in queries]), np.stack([q.goal for q in queries])
    numbers = (start, goal, np.stack([q.point for q in queries]), eyes.positions(kernel, start, goal))
    rest = (shape, position, rotation, size, mask)
    columns = [torch.tensor(a, dtype=torch.float32) for a in numbers] + [torch.from_numpy(a) for a in rest]
    return Conditions(*[*columns, torch.empty(count, 0)])


def conditions_of_features(
    seen: Tensor, start: Tensor, goal: Tensor, point: Tensor, *, among: Obstacles | None = None
) -> Conditions:
    """Return conditions with the features of a sight, shape (B, F), and without obstacles but those of ``among``."""
    count, none = len(start), start.new_empty(len(start), 0, 3)
    shape, mask = (start.new_zeros(count, 0, dtype=kind) for kind in (torch.int64, torch.bool))
    turns = start.new_empty(count, 0, 3, 3)
    return Conditions(start, goal, point, turns, shape, none, turns, none, mask, seen, among=among)


class ConditionTable:
    """Conditions of the paths of a data set, from which batches are taken by index.

    Attributes:
        control: Control points of the paths, shape (N, points, dof), float32 [rad].
    """

    def __init__(self, paths: Paths, probes: Probes, kernel: Kernel) -> None:
        """Compute the conditions of all paths; of the kernel only the robot's kinematics are used, not its scene."""
        a = paths.arrays
        start, goal = paths.start, paths.goal
        self.control = torch.tensor(paths.control(), dtype=torch.float32)
        self.start, self.goal = (torch.tensor(v, dtype=torch.float32) for v in (start, goal))
        self.point = torch.from_numpy(np.asarray(a["point"], np.float32))
        self.probes = torch.from_numpy(probes.positions(kernel, start, goal))
        self.problem = torch.from_numpy(a["problem"].astype(np.int64))
        shape = a["shape"].astype(np.int64)
        self.shape = torch.from_numpy(shape)
        self.position = torch.from_numpy(np.asarray(a["position"], np.float32))
        self.rotation = torch.from_numpy(rotation_matrices(a["orientation"]))
        self.size = torch.from_numpy(np.asarray(a["size"] * HALVES[shape], np.float32))
        self.count = torch.from_numpy(a["things"].astype(np.int64))
        self.first = torch.cumsum(self.count, 0) - self.count

    def batch(self, which: Tensor, generator: torch.Generator) -> tuple[Tensor, Conditions]:
        """Return control points (B, points, dof) and conditions of paths by their indices, shape (B,), as they are."""
        del generator
        return self.control[which], self.conditions(which)

    def conditions(self, which: Tensor) -> Conditions:
        """Return the conditions of some paths by their indices, shape (B,)."""
        problem = self.problem[which]
        count, first = self.count[problem], self.first[problem]
        most = int(count.max()) if len(which) else 0
        mask = torch.arange(most) < count[:, None]
        at = torch.where(mask, first[:, None] + torch.arange(most), 0)
        columns = [table[which] for table in (self.start, self.goal, self.point, self.probes)]
        columns += [table[at] for table in (self.shape, self.position, self.rotation, self.size)]
        return Conditions(*[*columns, mask, torch.empty(len(which), 0)])
