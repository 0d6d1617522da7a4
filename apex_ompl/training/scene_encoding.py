"""Scene encoding for training: the features of scene ``clearances``, computed for many scenes at once.

The features are those of :mod:`apex_ompl.model.scene_encoding`, which computes them scene by scene.
:class:`TorchSceneEncoding` computes them by torch on any device. On a CPU torch takes many times as long for them as
for the network, so :class:`KernelSceneEncoding` computes frames and distances by the kernel.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from apex_ompl.kernel import Kernel, RobotTables
from apex_ompl.kernel.arrays import FIXED, REVOLUTE
from apex_ompl.kernel.scene_distances import ObstacleBatch
from apex_ompl.model.config import PIECES
from apex_ompl.model.geometry import SHAPES, signed_distances
from apex_ompl.model.query import MAX_DISTANCE
from apex_ompl.model.scene_encoding import KEY_RANGE, REACH, SceneEncoding
from apex_ompl.types import Array

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
        """Return a slice of the obstacles."""
        return self.chosen(which, self.owner[which])

    def chosen(self, which: Tensor | slice, owner: Tensor) -> Obstacles:
        """Return obstacles by their indices, with given owners."""
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
    """Return the number of pairs of a point and an obstacle that a device holds in memory at a time."""
    return PAIRS.get(device.type, PAIRS["cpu"])


@dataclass(frozen=True, eq=False)
class Chains:
    """Joints that move probe points.

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
        """Return the joints of a robot that move probe points, which are fixed to joints of shape (P,)."""
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


class TorchSceneEncoding:
    """A :class:`SceneEncoding` evaluated by torch.

    Attributes:
        scene_encoding: The features, scene by scene.
        balls: Balls of the arms at key states, see :meth:`apex_ompl.model.scene_encoding.KeyStates.placed`.
    """

    def __init__(self, encoding: SceneEncoding, kernel: Kernel, device: torch.device) -> None:
        """Evaluate a scene encoding for a robot; of the kernel only the kinematics are used."""
        robot, self.scene_encoding, self._device = kernel.robot, encoding, device
        a = robot.arrays
        self.balls = self.tensor(encoding.balls(kernel))
        self._reach = self.tensor(encoding.keys.ball)
        chains = Chains.of(robot, encoding.probes.joint)
        self._chains = self._matrices(chains)
        ball_chains = Chains.of(robot, np.repeat(encoding.keys.joint.ravel(), PIECES))
        self._ball_chains = self._matrices(ball_chains)
        joints_of_all = [*encoding.probes.joint, *encoding.keys.joint.ravel(), *chains.joint]
        self._needed = needed = self._with_parents(a.joint_parent, joints_of_all)
        place = {joint: k for k, joint in enumerate(needed)}
        depth = [0] * len(needed)
        for k, joint in enumerate(needed[1:], start=1):
            depth[k] = depth[place[int(a.joint_parent[joint])]] + 1
        levels = [[k for k, d in enumerate(depth) if d == level] for level in range(1, max(depth) + 1)]
        self._levels = []
        for level in levels:
            joints = [needed[k] for k in level]
            parents = [place[int(a.joint_parent[j])] for j in joints]
            kind = a.joint_kind[joints]
            numbers = self._index(level), self._index(parents), self._index(a.joint_source[joints] * (kind != FIXED))
            places = self.tensor(a.joint_rotation[joints]), self.tensor(a.joint_offset[joints])
            turns = kind == REVOLUTE
            ratios = [np.where(f, a.joint_ratio[joints], 0.0) for f in (turns, (kind != FIXED) & ~turns)]
            shifts = [np.where(f, a.joint_shift[joints], 0.0) for f in (turns, (kind != FIXED) & ~turns)]
            self._levels.append((numbers, places, tuple(map(self.tensor, (*ratios, *shifts)))))
        self._joints = len(needed)
        self._probe_joint = self._index([place[j] for j in encoding.probes.joint.tolist()])
        self._probe_offset = self.tensor(encoding.probes.offset)
        self._chain_joint = self._index([place[j] for j in chains.joint.tolist()])
        self._ball_chain_joint = self._index([place[j] for j in ball_chains.joint.tolist()])
        self._ball_joint = self._index([[place[j] for j in row] for row in encoding.keys.joint.tolist()])
        self._center, self._unit = self.tensor(encoding.center), encoding.reach

    @staticmethod
    def _with_parents(parents: np.ndarray, joints: list[int]) -> list[int]:
        """Return joints and all above them, the world first, ascending, so that parents come before children."""
        found = {0}
        for one in joints:
            joint = int(one)
            while joint not in found:
                found.add(joint)
                joint = int(parents[joint])
        return sorted(found)

    def _matrices(self, chains: Chains) -> tuple[Tensor, Tensor, Tensor]:
        return self.tensor(chains.below), self._index(chains.revolute), self.tensor(chains.to_state)

    def tensor(self, values: object) -> Tensor:
        """Return numbers as a tensor on its device."""
        return torch.tensor(np.asarray(values, np.float32), device=self._device)

    def _index(self, values: object) -> Tensor:
        return torch.tensor(np.asarray(values), device=self._device)

    def frames(self, states: Tensor) -> tuple[Tensor, Tensor]:
        """Return rotations (N, J, 3, 3) and origins (N, J, 3) [m] of the joints in use, at states (N, dof)."""
        count = len(states)
        rotation = states.new_zeros(count, self._joints, 3, 3)
        rotation[:, 0] = torch.eye(3, device=states.device)
        origin = states.new_zeros(count, self._joints, 3)
        for (mine, parents, source), (turn, offset), (turned, slid, turned_by, slid_by) in self._levels:
            up, q = rotation[:, parents], states[:, source]
            angle, distance = turned * q + turned_by, slid * q + slid_by
            r = up @ turn
            c, s = angle.cos()[..., None], angle.sin()[..., None]
            x, y, z = r[..., 0], r[..., 1], r[..., 2]
            rotation[:, mine] = torch.stack([c * x + s * y, c * y - s * x, z], dim=-1)
            origin[:, mine] = origin[:, parents] + (up @ offset[..., None])[..., 0] + z * distance[..., None]
        return rotation, origin

    def arm_balls(self, paths: Tensor) -> tuple[Tensor, Tensor]:
        """Return centers (B, N, 3) and radii (N,) [m] of balls that contain the arms at states, (B, S, dof)."""
        centers = self._placed_balls(*self.frames(paths.flatten(0, 1)))
        return centers.reshape(len(paths), -1, 3), self._reach[:, :, 1:, 3].flatten().repeat(paths.shape[1])

    def _placed_balls(self, rotation: Tensor, origin: Tensor) -> Tensor:
        """Return centers of balls that contain the arms, shape (N, A, C, PIECES, 3) [m], by frames of joints."""
        joint, ball = self._ball_joint, self._reach[:, :, 1:]
        return torch.einsum("nacij,acpj->nacpi", rotation[:, joint], ball[..., :3]) + origin[:, joint][:, :, :, None]

    def collision_cost(self, paths: Tensor, obstacles: Obstacles, margin: float) -> tuple[Tensor, Tensor]:
        """Return the collision cost of the arms along paths of L states, and its gradient.

        It is the mean over states, and the sum over balls that contain the arms, of CHOMP's cost of the distance d
        between ball and obstacle (Ratliff et al. 2009): margin / 2 - d inside, (d - margin)^2 / (2 margin) within the
        margin, 0 outside. Held objects, and arms against one another, do not count.

        Args:
            paths: States, shape (B, L, dof) [rad].
            obstacles: Obstacles of the B scenes.
            margin: Distance from which the cost is positive [m].

        Returns:
            Shapes (B,) [m] and (B, L, dof) [m / rad].
        """
        count, states = paths.shape[:2]
        rotation, origin = self.frames(paths.flatten(0, 1))
        centers = self._placed_balls(rotation, origin).flatten(1, 3)
        distances, gradients = self.nearest(obstacles, centers.reshape(count, -1, 3))
        depth = margin + self._reach[:, :, 1:, 3].flatten() - distances.reshape(centers.shape[:2])
        slope = (depth / margin).clamp(0.0, 1.0)
        cost = slope * (depth - 0.5 * margin * slope)
        force = slope[..., None] * gradients.reshape(centers.shape)
        frames = rotation[:, self._ball_chain_joint][..., 2], origin[:, self._ball_chain_joint]
        away = generalized_forces(self._ball_chains, frames, centers, force)
        return cost.reshape(count, -1).sum(dim=1) / states, -away.reshape(paths.shape) / states

    def nearest(self, obstacles: Obstacles, points: Tensor) -> tuple[Tensor, Tensor]:
        """Return distances, at most MAX_DISTANCE, and gradients of points of scenes, see :meth:`Obstacles.nearest`."""
        return obstacles.nearest(points, MAX_DISTANCE)

    def least(self, obstacles: Obstacles, centers: Tensor, radii: Tensor) -> Tensor:
        """Return the least distance of each obstacle from balls of its scene, see :meth:`Obstacles.least`."""
        return obstacles.least(centers, radii)

    def along(self, paths: Tensor, obstacles: Obstacles) -> Tensor:
        """Return the features along paths of L states each among obstacles, shape (B, L, dof): (B, features)."""
        count, states = paths.shape[:2]
        rotation, origin = self.frames(paths.flatten(0, 1))
        joint = self._probe_joint
        points = (rotation[:, joint] @ self._probe_offset[..., None])[..., 0] + origin[:, joint]
        distances, gradients = self.nearest(obstacles, points.reshape(count, -1, 3))
        distances, gradients = distances.reshape(points.shape[:2]), gradients.reshape(points.shape)
        frames = rotation[:, self._chain_joint][..., 2], origin[:, self._chain_joint]
        pushed = pushes(self._chains, frames, points, distances, gradients)
        near = distances.clamp(min=-MAX_DISTANCE) / MAX_DISTANCE
        parts = ((points - self._center) / self._unit, near, gradients, pushed)
        return torch.cat([part.reshape(count, -1) for part in parts], dim=1)

    def at_keys(self, obstacles: Obstacles) -> Tensor:
        """Return the features of key states by each obstacle alone, shape (T, K * A); a scene has the least of them."""
        pieces = self.balls[:, :, 1:]
        centers, radii = pieces[..., :3].reshape(-1, 3), pieces[..., 3].flatten()
        groups, step = len(pieces), max(1, pairs_at_a_time(centers.device) // len(centers))
        rows = []
        for k in range(0, len(obstacles.owner), step):
            some = obstacles.part(slice(k, k + step))
            apart = some.distances(centers.expand(len(some.owner), -1, -1)) - radii
            least = apart.reshape(len(apart), groups, -1).amin(dim=2)
            rows.append((least.clamp(-KEY_RANGE, KEY_RANGE) / KEY_RANGE).half())
        return torch.cat(rows) if rows else torch.zeros(0, groups, dtype=torch.float16, device=self._device)


class KernelSceneEncoding(TorchSceneEncoding):
    """A :class:`TorchSceneEncoding` on the CPU whose frames and distances the kernel computes."""

    def __init__(self, encoding: SceneEncoding, kernel: Kernel, device: torch.device) -> None:
        """Evaluate a scene encoding for a robot; of the kernel only the kinematics are used."""
        super().__init__(encoding, kernel, device)
        self._kernel, self._groups = kernel, encoding.balls(kernel)

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
