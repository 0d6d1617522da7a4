"""What the model is conditioned on: start, goal, obstacle point, and the obstacles, as tensors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from apex_ompl.datasets.records import SHAPES, Paths
from apex_ompl.kernel import Kernel, RobotTables
from apex_ompl.kernel.compiled.arrays import BOX, HALF_SPACE, SceneArrays
from apex_ompl.types import Array

HALVES = np.array([[0.5, 0.5, 0.5], [1.0, 0.5, 0.5], [1.0, 0.5, 0.5], [1.0, 0.5, 0.5]], np.float32)
"""From sizes as they are stored to those of the networks: half edges, radii, half lengths."""


@dataclass(frozen=True, eq=False)
class ObstacleSet:
    """Obstacles.

    Attributes:
        shape: Number of each one's shape in ``apex_ompl.datasets.records.SHAPES``, shape (M,).
        position: Shape (M, 3) [m].
        turn: Rotations, shape (M, 3, 3).
        size: Half edges; radius; or radius and half length along z, shape (M, 3) [m].
    """

    shape: NDArray[np.int64]
    position: Array
    turn: Array
    size: Array

    @classmethod
    def of(cls, rows: Sequence[tuple[int, Sequence[float], Sequence[float], Sequence[float]]]) -> ObstacleSet:
        """Return obstacles from rows of shape, position, orientation and size, as data sets hold them."""
        columns = list(zip(*rows, strict=True)) or [(), (), (), ()]
        shape = np.array(columns[0], np.int64)
        place, turn, size = (np.array(c, float).reshape(-1, n) for c, n in zip(columns[1:], (3, 4, 3), strict=True))
        return cls(shape, place, rotations(turn).astype(float), size * HALVES[shape])

    @classmethod
    def among(cls, scene: SceneArrays, chosen: NDArray[np.bool_]) -> ObstacleSet:
        """Return some of the kernel's obstacles; a half-space is a large box, as far as a robot can tell."""
        shape, position = scene.kind[chosen].copy(), scene.offset[chosen].copy()
        turn, size = scene.rotation[chosen].copy(), scene.size[chosen].copy()
        for k in np.flatnonzero(shape == HALF_SPACE):
            normal, distance = position[k].copy(), size[k, 0]
            turn[k] = _upright(normal)
            shape[k], position[k], size[k] = BOX, (distance - LARGE[2]) * normal, LARGE
        return cls(shape, position, turn, size)

    def __len__(self) -> int:
        """Return their number."""
        return len(self.shape)


AT_ONCE = 1024
"""Paths whose joint frames are in memory at once."""

LARGE = np.array([3.0, 3.0, 0.5])
"""Half edges of the box that stands for a half-space [m]."""


def _upright(normal: Array) -> Array:
    """Return a rotation whose z axis is ``normal``, shape (3, 3)."""
    across = np.cross(normal, np.eye(3)[int(np.argmin(np.abs(normal)))])
    across /= np.linalg.norm(across)
    return np.stack([across, np.cross(normal, across), normal], axis=1)


@dataclass(frozen=True, eq=False)
class Query:
    """A problem as the model sees it.

    Attributes:
        start: Shape (dof,) [rad].
        goal: Shape (dof,) [rad].
        point: The obstacle point nearest to the robot at the start, shape (3,) [m].
        things: The obstacles, fixtures such as tables left out.
    """

    start: Array
    goal: Array
    point: Array
    things: ObstacleSet


@dataclass(frozen=True)
class Conditions:
    """A batch of B queries as tensors, with M obstacles each at most.

    Attributes:
        start: Shape (B, dof) [rad].
        goal: Shape (B, dof) [rad].
        point: Shape (B, 3) [m].
        probes: Where points of the robot are along the straight line, shape (B, L, P, 3) [m].
        shape: Numbers of shapes, shape (B, M).
        position: Shape (B, M, 3) [m].
        turn: Rotations, shape (B, M, 3, 3).
        size: Half edges; radius; or radius and half length along z, shape (B, M, 3) [m].
        there: Which obstacles there are, shape (B, M).
    """

    start: Tensor
    goal: Tensor
    point: Tensor
    probes: Tensor
    shape: Tensor
    position: Tensor
    turn: Tensor
    size: Tensor
    there: Tensor

    def to(self, device: torch.device | str) -> Conditions:
        """Return the same on a device."""
        return Conditions(*(getattr(self, f.name).to(device) for f in fields(self)))

    @classmethod
    def joined(cls, parts: Sequence[Conditions]) -> Conditions:
        """Return several batches as one."""
        most = max(part.there.shape[1] for part in parts)
        columns = []
        for f in fields(cls):
            tensors = [getattr(part, f.name) for part in parts]
            if f.name in ("shape", "position", "turn", "size", "there"):
                tensors = [_padded(tensor, most) for tensor in tensors]
            columns.append(torch.cat(tensors))
        return cls(*columns)

    def things(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return shape (T,), position (T, 3), turn (T, 3, 3) and size (T, 3) of the obstacles that there are."""
        there = self.there
        return self.shape[there], self.position[there], self.turn[there], self.size[there]

    def apart(self) -> Tensor:
        """Return the distances of the obstacles that there are from the probes, shape (T, L * P) [m]."""
        owner = self.there.nonzero()[:, 0]
        return distances(*self.things(), self.probes.flatten(1, 2)[owner])


def pooled(values: Tensor, there: Tensor, rest: float) -> Tensor:
    """Return values (T, K) of obstacles that are there at their places, shape (B, M + 1, K), and ``rest`` besides."""
    count, most = there.shape
    table = values.new_full((count, most + 1, values.shape[1]), rest)
    table[:, :most][there] = values
    return table


def _padded(tensor: Tensor, most: int) -> Tensor:
    """Return a tensor (B, M, ...) with zeros behind, shape (B, most, ...)."""
    if tensor.shape[1] == most:
        return tensor
    zeros = tensor.new_zeros(len(tensor), most - tensor.shape[1], *tensor.shape[2:])
    return torch.cat([tensor, zeros], dim=1)


class Probes:
    """Points of the robot that the model looks at, found by the kernel.

    By default they are the centres of the balls around the clusters of bodies that move.
    """

    def __init__(self, joint: NDArray[np.int64], offset: Array, along: int) -> None:
        """Take points by their joints, shape (P,), and places in the joints' frames, shape (P, 3) [m].

        Args:
            joint: Joints of the kernel's tables.
            offset: Places [m].
            along: At how many states of the straight line, ends included.
        """
        self.joint, self.offset = joint, offset
        self.shares = np.linspace(0.0, 1.0, along)

    @classmethod
    def of(cls, robot: RobotTables, along: int) -> Probes:
        """Return the default points of a robot."""
        a = robot.arrays
        moved = np.flatnonzero(a.cluster_meets_scene & (a.cluster_joint > 0))
        return cls(a.cluster_joint[moved], a.cluster_ball[moved, :3], along)

    def places(self, kernel: Kernel, start: Array, goal: Array) -> NDArray[np.float32]:
        """Return where the points are along straight lines between states of shape (B, dof): (B, L, P, 3) [m]."""
        found = np.empty((len(start), len(self.shares), len(self.joint), 3), np.float32)
        for k in range(0, len(start), AT_ONCE):
            ends = start[k : k + AT_ONCE, None], goal[k : k + AT_ONCE, None]
            states = ends[0] + self.shares[:, None] * (ends[1] - ends[0])
            turn, origin = kernel.joint_frames(states.reshape(-1, start.shape[1]))
            places = np.einsum("npij,pj->npi", turn[:, self.joint], self.offset) + origin[:, self.joint]
            found[k : k + AT_ONCE] = places.reshape(states.shape[0], *found.shape[1:])
        return found


def rotations(orientation: NDArray[np.floating]) -> NDArray[np.float32]:
    """Return rotations, shape (..., 3, 3), of quaternions xyzw, shape (..., 4)."""
    x, y, z, w = np.moveaxis(orientation / np.linalg.norm(orientation, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.asarray(np.moveaxis(np.array(rows), (0, 1), (-2, -1)), np.float32)


def batched(queries: Sequence[Query], probes: Probes, kernel: Kernel) -> Conditions:
    """Return queries as a batch; the kernel's obstacles are not looked at."""
    most = max((len(q.things) for q in queries), default=0)
    count = len(queries)
    shape, there = np.zeros((count, most), np.int64), np.zeros((count, most), bool)
    position, size = np.zeros((count, most, 3), np.float32), np.zeros((count, most, 3), np.float32)
    turn = np.broadcast_to(np.eye(3, dtype=np.float32), (count, most, 3, 3)).copy()
    for k, query in enumerate(queries):
        n, things = len(query.things), query.things
        shape[k, :n], there[k, :n], position[k, :n] = things.shape, True, things.position
        turn[k, :n], size[k, :n] = things.turn, things.size
    start, goal = np.stack([q.start for q in queries]), np.stack([q.goal for q in queries])
    numbers = (start, goal, np.stack([q.point for q in queries]), probes.places(kernel, start, goal))
    rest = (shape, position, turn, size, there)
    columns = [torch.tensor(a, dtype=torch.float32) for a in numbers] + [torch.from_numpy(a) for a in rest]
    return Conditions(*columns)


class Table:
    """The conditions of many paths, to take batches from."""

    def __init__(self, paths: Paths, probes: Probes, kernel: Kernel) -> None:
        """Take in paths; the kernel's obstacles are not looked at."""
        a = paths.arrays
        start, goal = paths.start, paths.goal
        self.start, self.goal = (torch.tensor(v, dtype=torch.float32) for v in (start, goal))
        self.point = torch.from_numpy(np.asarray(a["point"], np.float32))
        self.probes = torch.from_numpy(probes.places(kernel, start, goal))
        self.problem = torch.from_numpy(a["problem"].astype(np.int64))
        shape = a["shape"].astype(np.int64)
        self.shape = torch.from_numpy(shape)
        self.position = torch.from_numpy(np.asarray(a["position"], np.float32))
        self.turn = torch.from_numpy(rotations(a["orientation"]))
        self.size = torch.from_numpy(np.asarray(a["size"] * HALVES[shape], np.float32))
        self.count = torch.from_numpy(a["things"].astype(np.int64))
        self.first = torch.cumsum(self.count, 0) - self.count

    def batch(self, which: Tensor) -> Conditions:
        """Return the conditions of some paths by their numbers, shape (B,)."""
        problem = self.problem[which]
        count, first = self.count[problem], self.first[problem]
        most = int(count.max()) if len(which) else 0
        there = torch.arange(most) < count[:, None]
        at = torch.where(there, first[:, None] + torch.arange(most), 0)
        columns = [table[which] for table in (self.start, self.goal, self.point, self.probes)]
        columns += [table[at] for table in (self.shape, self.position, self.turn, self.size)]
        return Conditions(*[*columns, there])


def distances(shape: Tensor, position: Tensor, turn: Tensor, size: Tensor, points: Tensor) -> Tensor:
    """Return signed distances [m] of points to obstacles, each with points of its own: shape (T, K).

    The formulas are those of the kernel, see :mod:`apex_ompl.kernel.compiled.signed_distance`.

    Args:
        shape: Numbers of shapes, shape (T,).
        position: Shape (T, 3) [m].
        turn: Rotations, shape (T, 3, 3).
        size: Half edges; radius; or radius and half length along z, shape (T, 3) [m].
        points: Shape (T, K, 3) [m].
    """
    local = (points - position[:, None]) @ turn
    half, kind = size[:, None], shape[:, None]
    apart = local.abs() - half
    box = apart.clamp(min=0.0).norm(dim=-1) + apart.amax(dim=-1).clamp(max=0.0)
    radius, length, around = half[..., 0], half[..., 1], local[..., :2].norm(dim=-1)
    sphere = local.norm(dim=-1) - radius
    across, along = around - radius, local[..., 2].abs() - length
    cylinder = torch.hypot(across.clamp(min=0.0), along.clamp(min=0.0)) + torch.maximum(across, along).clamp(max=0.0)
    capsule = torch.hypot(around, along.clamp(min=0.0)) - radius
    found: Tensor = torch.where(kind == SHAPES.index("box"), box, sphere)
    found = torch.where(kind == SHAPES.index("cylinder"), cylinder, found)
    return torch.where(kind == SHAPES.index("capsule"), capsule, found)
