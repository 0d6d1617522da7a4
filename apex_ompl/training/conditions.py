"""Queries and paths of data sets as batches of tensors: start, goal, and the obstacles or their features.

A :class:`ConditionTable` holds the paths of a data set as they are. An :class:`EncodedPaths` table is for a scene
``clearances``: it augments the paths at every batch, and computes their features where the table is, on a GPU or a CPU.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields

import numpy as np
import torch
from torch import Tensor

from apex_ompl.kernel import Kernel
from apex_ompl.model.geometry import rotation_matrices
from apex_ompl.model.query import HALVES, Probes, Query
from apex_ompl.model.scene_encoding import SceneEncoding
from apex_ompl.training.records import Paths, held_extents
from apex_ompl.training.scene_encoding import Obstacles, TorchSceneEncoding

PART_LENGTHS = (0.25, 0.9)  # range of the length of a part of a path, as a share of it
RESTS = 0.5  # share of the parts that start or end where their path does
BENT = 0.1  # parts whose states are all nearer to a straight line are not taken [rad, max-norm]
PART_STATES = 64  # of a part, from which its control points are computed
STRANGERS = 24  # obstacles of another scene that are tried
CHECKED_STATES = 24  # of a path, at which it is checked against them


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
        features: Those of a :class:`SceneEncoding`, shape (B, F); with them, obstacles and probe points are left out.
        among: The obstacles of such conditions, for models that compute features along their own estimates.
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
    features: Tensor
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


def batch_queries(queries: Sequence[Query], encoding: Probes | SceneEncoding, kernel: Kernel) -> Conditions:
    """Return queries as a batch; of the kernel only the robot's kinematics are used, not its scene."""
    if isinstance(encoding, SceneEncoding):
        rows = (np.stack([getattr(q, name) for q in queries]) for name in ("start", "goal", "point"))
        ends = (torch.tensor(row, dtype=torch.float32) for row in rows)
        return conditions_of_features(torch.from_numpy(encoding.features(queries, kernel)), *ends)
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
    numbers = (start, goal, np.stack([q.point for q in queries]), encoding.positions(kernel, start, goal))
    rest = (shape, position, rotation, size, mask)
    columns = [torch.tensor(a, dtype=torch.float32) for a in numbers] + [torch.from_numpy(a) for a in rest]
    return Conditions(*[*columns, torch.empty(count, 0)])


def conditions_of_features(
    features: Tensor, start: Tensor, goal: Tensor, point: Tensor, *, among: Obstacles | None = None
) -> Conditions:
    """Return conditions with the features of a scene encoding, shape (B, F), and with no obstacles but ``among``."""
    count, none = len(start), start.new_empty(len(start), 0, 3)
    shape, mask = (start.new_zeros(count, 0, dtype=kind) for kind in (torch.int64, torch.bool))
    turns = start.new_empty(count, 0, 3, 3)
    return Conditions(start, goal, point, turns, shape, none, turns, none, mask, features, among=among)


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


@dataclass(frozen=True)
class Augmentation:
    """How paths are varied.

    Attributes:
        parts: Share of the paths of which a part is taken.
        mixed: Share of the paths among whose obstacles are put some of another scene that leave it free.
    """

    parts: float = 0.0
    mixed: float = 0.0


class EncodedPaths:
    """Paths of a data set and their scenes as tensors.

    The augmentation reverses a path with probability 1/2. A part of a free path is free, and a path stays free among
    more obstacles if these do not touch the balls around the arms. Rejecting obstacles that touch them gives samples
    of paths and scenes conditioned on the paths being free.

    Attributes:
        control: Control points, shape (N, points, dof), float32 [rad].
    """

    def __init__(self, paths: Paths, encoding: TorchSceneEncoding, augmentation: Augmentation | None) -> None:
        """Copy paths to the device of ``encoding``; without an augmentation they stay as they are.

        Raises:
            DatasetError: Held objects have no extents.
        """
        a, device = paths.arrays, encoding.balls.device
        self._encoding, self._augmentation, spline = encoding, augmentation, paths.spline
        self.control = torch.tensor(paths.control(), dtype=torch.float32, device=device)
        self._point = torch.tensor(np.asarray(a["point"], np.float32), device=device)
        self._problem = torch.tensor(a["problem"].astype(np.int64), device=device)
        held = np.array([encoding.scene_encoding.held(held_extents(text)) for text in paths.names["held"]], np.float32)
        self._held = torch.tensor(held[a["held"]], device=device)
        shape = a["shape"].astype(np.int64)
        self._count = torch.tensor(a["things"].astype(np.int64), device=device)
        self._first = torch.cumsum(self._count, 0) - self._count
        owner = torch.repeat_interleave(torch.arange(paths.problems, device=device), self._count)
        rotation, size = rotation_matrices(a["orientation"]), a["size"] * HALVES[shape]
        places = (encoding.tensor(values) for values in (a["position"], rotation, size))
        self._obstacles = Obstacles(torch.tensor(shape, device=device), *[*places, owner])
        mixes = augmentation is not None and augmentation.mixed > 0.0
        self._at_keys, self._keys = self._clearances(paths.problems, keep=mixes)
        u = np.linspace(0.0, 1.0, PART_STATES)
        self._basis = encoding.tensor(spline.basis(spline.parameters))
        self._few = encoding.tensor(spline.basis(np.linspace(0.0, 1.0, CHECKED_STATES)))
        self._fit = encoding.tensor(np.linalg.pinv(spline.basis(u)[:, spline.inner]))
        self._inner, self._even = spline.inner, encoding.tensor(u)
        self._line = encoding.tensor(spline.line(np.zeros(1), np.ones(1)))
        self._along = encoding.tensor(encoding.scene_encoding.probes.shares)

    def _clearances(self, problems: int, *, keep: bool) -> tuple[Tensor, Tensor]:
        """Return the features of key states of each scene, and of each obstacle where they are kept."""
        obstacles, features = self._obstacles, len(self._encoding.balls)
        count = len(obstacles.owner)
        found = torch.ones(problems, features, device=self.control.device)
        kept = torch.empty(count if keep else 0, features, dtype=torch.half, device=self.control.device)
        step = 4096
        for k in range(0, count, step):
            some = obstacles.part(slice(k, k + step))
            by_obstacle = self._encoding.at_keys(some)
            found.scatter_reduce_(0, some.owner[:, None].expand_as(by_obstacle), by_obstacle.float(), "amin")
            if keep:
                kept[k : k + step] = by_obstacle
        return found.half(), kept

    def batch(self, which: Tensor, generator: torch.Generator) -> tuple[Tensor, Conditions]:
        """Return control points (B, points, dof) and conditions of paths by their indices, augmented.

        Args:
            which: Shape (B,).
            generator: Source of the augmentation, on the CPU, so that it is the same on all devices.
        """
        device, encoding = self.control.device, self._encoding
        which = which.to(device)
        control, problem = self.control[which], self._problem[which]
        held, at_keys = self._held[problem], self._at_keys[problem].float()
        count, first = self._count[problem], self._first[problem]
        index = torch.arange(int(count.max()) if len(which) else 0, device=device)
        mask = index < count[:, None]
        index = torch.where(mask, first[:, None] + index, 0)
        if self._augmentation is not None:
            control = self._varied(control, generator)
            strangers, free = self._strangers(control, held, generator)
            if self._augmentation.mixed > 0.0:
                for one in range(STRANGERS):  # few of them leave a path free
                    rows = free[:, one].nonzero()[:, 0]
                    others = self._keys[strangers[rows, one]].float()
                    at_keys[rows] = torch.minimum(at_keys[rows], others)
            mask, index = torch.cat([mask, free], dim=1), torch.cat([index, strangers], dim=1)
        start, goal = control[:, 0], control[:, -1]
        line = start[:, None] + self._along[:, None] * (goal - start)[:, None]
        owner, place = mask.nonzero(as_tuple=True)
        among = self._obstacles.chosen(index[owner, place], owner)
        features = torch.cat([at_keys, encoding.along(line, among), held], dim=1)
        return control, conditions_of_features(features, start, goal, self._point[which], among=among)

    def _uniform(self, generator: torch.Generator, *shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator).to(self.control.device)

    def _varied(self, control: Tensor, generator: torch.Generator) -> Tensor:
        """Return paths, some of them reversed, and some replaced by a part."""
        assert self._augmentation is not None
        count = len(control)
        turned, taken, length, first, rests = self._uniform(generator, 5, count)
        control = torch.where((turned < 0.5)[:, None, None], control.flip(1), control)
        length = PART_LENGTHS[0] + (PART_LENGTHS[1] - PART_LENGTHS[0]) * length
        first = torch.where(rests < RESTS / 2, 0.0, torch.where(rests < RESTS, 1.0, first)) * (1.0 - length)
        at = (first[:, None] + length[:, None] * self._even) * (len(self._basis) - 1)
        low = at.long().clamp(max=len(self._basis) - 2)
        share = (at - low)[..., None]
        states = (self._basis[low] * (1.0 - share) + self._basis[low + 1] * share) @ control
        start, goal = states[:, :1], states[:, -1:]
        rest = states - start - self._even[:, None] * (goal - start)
        part = start + self._line * (goal - start)
        part[:, self._inner] += self._fit @ rest
        bent = rest.abs().amax(dim=(1, 2)) > BENT
        return torch.where(((taken < self._augmentation.parts) & bent)[:, None, None], part, control)

    def _strangers(self, control: Tensor, held: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Return indices of obstacles of other scenes, shape (B, STRANGERS), and which of them leave the paths free."""
        assert self._augmentation is not None
        count, obstacles = len(control), self._obstacles
        shares = self._uniform(generator, count, STRANGERS + 3)
        other = (shares[:, 0] * len(self._count)).long().clamp(max=len(self._count) - 1)
        number = self._count[other][:, None]
        index = self._first[other][:, None] + (shares[:, 3:] * number).long()
        index = torch.where(number > 0, index.clamp(max=max(0, len(obstacles.owner) - 1)), 0)
        chosen = self._uniform(generator, count, STRANGERS) < shares[:, 1:2]
        chosen &= (number > 0) & (shares[:, 2:3] < self._augmentation.mixed) & ~held.any(dim=1, keepdim=True)
        owner, place = chosen.nonzero(as_tuple=True)
        centers, radii = self._encoding.arm_balls(self._few @ control)
        some = obstacles.chosen(index[owner, place], owner)
        free = torch.zeros_like(chosen)
        free[owner, place] = self._encoding.least(some, centers, radii) > 0.0
        return index, free
