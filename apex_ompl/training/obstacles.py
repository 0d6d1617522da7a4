"""Obstacles of many scenes as tensors, and the distances of points from the nearest ones."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from apex_ompl.model.geometry import SHAPES, signed_distances

PAIRS = {"cpu": 2**22, "cuda": 2**25}  # pairs of point and obstacle whose distances are in memory at a time


@dataclass(frozen=True)
class Obstacles:
    """T obstacles of several scenes.

    Attributes:
        shape: Indices of shapes, shape (T,).
        position: Shape (T, 3) [m].
        rotation: Rotation matrices, shape (T, 3, 3).
        size: Half edges; radius; or radius and half length along z, shape (T, 3) [m].
        owner: The scene of each, ascending, shape (T,).
    """

    shape: Tensor
    position: Tensor
    rotation: Tensor
    size: Tensor
    owner: Tensor

    def distances(self, points: Tensor) -> Tensor:
        """Return the signed distances of each obstacle from points of its own, shape (T, N, 3) [m]: shape (T, N)."""
        found: Tensor = signed_distances(self.shape, self.position, self.rotation, self.size, points)
        return found

    def part(self, which: slice) -> Obstacles:
        """Return some of them."""
        return self.chosen(which, self.owner[which])

    def chosen(self, which: Tensor | slice, owner: Tensor) -> Obstacles:
        """Return some of them by their indices, for scenes of theirs."""
        columns = (self.shape, self.position, self.rotation, self.size)
        shape, position, rotation, size = (column[which] for column in columns)
        return Obstacles(shape, position, rotation, size, owner)

    def least(self, centers: Tensor, radii: Tensor) -> Tensor:
        """Return the least distance of each obstacle from balls of its scene, (B, N, 3) and (N,) [m]: shape (T,)."""
        step = max(1, pairs_at_a_time(centers.device) // max(1, centers.shape[1]))
        rows = []
        for k in range(0, len(self.owner), step):
            some = self.part(slice(k, k + step))
            rows.append((some.distances(centers[some.owner]) - radii).amin(dim=1))
        return torch.cat(rows) if rows else centers.new_zeros(0)

    def nearest(self, points: Tensor, limit: float) -> tuple[Tensor, Tensor]:
        """Return the signed distances of points from the nearest obstacles of their scenes, and their gradients.

        Args:
            points: Points of each scene, shape (B, N, 3) [m].
            limit: Larger distances are given as this, with gradients of 0 [m].

        Returns:
            Shapes (B, N) [m] and (B, N, 3).
        """
        count, each = points.shape[:2]
        least = points.new_full((count, each), limit)
        index = torch.full((count, each), -1, dtype=torch.int64, device=points.device)
        step = max(1, pairs_at_a_time(points.device) // max(1, each))
        for k in range(0, len(self.owner), step):
            some = self.part(slice(k, k + step))
            owner = some.owner[:, None].expand(-1, each)
            found = some.distances(points[some.owner])
            nearer = torch.full_like(least, torch.inf).scatter_reduce(0, owner, found, "amin")
            number = torch.arange(k, k + len(some.owner), device=points.device)[:, None]
            mine = torch.where(found == nearer[some.owner], number, -1)
            which = torch.full_like(index, -1).scatter_reduce(0, owner, mine, "amax")
            index = torch.where(nearer < least, which, index)
            least = torch.minimum(least, nearer)
        return least, self._gradients(points, index)

    def _gradients(self, points: Tensor, index: Tensor) -> Tensor:
        """Return the gradients of the distances of points, (B, N, 3), from obstacles by their indices, (B, N)."""
        if not len(self.owner):
            return torch.zeros_like(points)
        at = index.clamp(min=0)
        rotation, half, kind = self.rotation[at], self.size[at], self.shape[at][..., None]
        local = ((points - self.position[at])[..., None, :] @ rotation)[..., 0, :]
        sign = torch.where(local < 0.0, -1.0, 1.0)
        excess = local.abs() - half
        inside = torch.nn.functional.one_hot(excess.argmax(-1), 3).to(local)
        box = sign * torch.where((excess > 0.0).any(-1, keepdim=True), excess.clamp(min=0.0), inside)
        radial = torch.linalg.vector_norm(local[..., :2], dim=-1)
        across, along = radial - half[..., 0], local[..., 2].abs() - half[..., 1]
        out = torch.maximum(across, along) > 0.0
        side = torch.where(out, across.clamp(min=0.0), (across >= along).to(local))[..., None]
        end = torch.where(out, along.clamp(min=0.0), (across < along).to(local))[..., None]
        plane = local[..., :2] / radial.clamp(min=1e-9)[..., None]
        cylinder = torch.cat([plane * side, sign[..., 2:] * end], dim=-1)
        reach = half[..., 1]
        axial = local[..., 2] - local[..., 2].clamp(-reach, reach)
        capsule = torch.cat([local[..., :2], axial[..., None]], dim=-1)
        found = torch.where(kind == SHAPES.index("box"), box, local)
        found = torch.where(kind == SHAPES.index("cylinder"), cylinder, found)
        found = torch.where(kind == SHAPES.index("capsule"), capsule, found)
        found = found / torch.linalg.vector_norm(found, dim=-1, keepdim=True).clamp(min=1e-12)
        turned = (rotation @ found[..., None])[..., 0]
        return torch.where(index[..., None] >= 0, turned, 0.0)


def pairs_at_a_time(device: torch.device) -> int:
    """Return how many pairs of a point and an obstacle a device has in memory at a time."""
    return PAIRS.get(device.type, PAIRS["cpu"])
