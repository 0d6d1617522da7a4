"""What a model of scene ``clearances`` sees, computed by torch for many scenes at once, as training needs it.

The features are those of :mod:`apex_ompl.model.scene_encoding`, which computes them scene by scene. On the CPU the
kernel computes them for all scenes, see :mod:`apex_ompl.training.kernel_scene_encoding`.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from apex_ompl.kernel import Kernel
from apex_ompl.kernel.arrays import FIXED, REVOLUTE
from apex_ompl.model.config import PIECES
from apex_ompl.model.query import MAX_DISTANCE, WORKSPACE_CENTER
from apex_ompl.model.scene_encoding import KEY_RANGE, Sight
from apex_ompl.training.obstacles import Obstacles, pairs_at_a_time
from apex_ompl.training.pushes import Chains, generalized_forces, pushes


class TorchSight:
    """A :class:`Sight` evaluated by torch.

    Attributes:
        sight: The sight.
        balls: Balls of the arms at key states, see :meth:`apex_ompl.model.scene_encoding.KeyStates.placed`.
    """

    def __init__(self, sight: Sight, kernel: Kernel, device: torch.device) -> None:
        """Evaluate a sight for a robot; of the kernel only the kinematics are used."""
        robot, self.sight, self._device = kernel.robot, sight, device
        a = robot.arrays
        self.balls = self.tensor(sight.balls(kernel))
        self._reach = self.tensor(sight.keys.ball)
        chains = Chains.of(robot, sight.probes.joint)
        self._chains = self._matrices(chains)
        ball_chains = Chains.of(robot, np.repeat(sight.keys.joint.ravel(), PIECES))
        self._ball_chains = self._matrices(ball_chains)
        joints_of_all = [*sight.probes.joint, *sight.keys.joint.ravel(), *chains.joint]
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
        self._probe_joint = self._index([place[j] for j in sight.probes.joint.tolist()])
        self._probe_offset = self.tensor(sight.probes.offset)
        self._chain_joint = self._index([place[j] for j in chains.joint.tolist()])
        self._ball_chain_joint = self._index([place[j] for j in ball_chains.joint.tolist()])
        self._ball_joint = self._index([[place[j] for j in row] for row in sight.keys.joint.tolist()])
        self._center = self.tensor(WORKSPACE_CENTER)

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
        """Return numbers as a tensor where this computes."""
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
        """Return how deep the arms are in obstacles along paths of L states, and the gradient of that.

        It is the mean over states, and the sum over balls that contain the arms, of CHOMP's cost of the distance d
        between ball and obstacle (Ratliff et al. 2009): margin / 2 - d inside, (d - margin)^2 / (2 margin) within the
        margin, 0 outside. Held objects, and arms against one another, do not count.

        Args:
            paths: States, shape (B, L, dof) [rad].
            obstacles: Obstacles of the B scenes.
            margin: Distance at which the cost begins [m].

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
        parts = (points - self._center, near, gradients, pushed)
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
