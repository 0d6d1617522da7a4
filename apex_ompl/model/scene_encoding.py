"""Scene encoding of models with ``scene="clearances"``: distances alone, whatever geometry the obstacles are given as.

The features of a query are the concatenation of

- the clearance of each arm from the obstacles at K key states, shape (K, A), after PRESTO (arXiv 2409.16012);
- positions of the P probe points at L states along the straight line from start to goal, shape (L, P, 3), their signed
  distances from the nearest obstacle, shape (L, P), the gradients of these, shape (L, P, 3), and the generalized forces
  on the joints, shape (L, dof), see :meth:`apex_ompl.kernel.Kernel.joint_pushes`;
- a box around the objects that each hand holds, in the frame of the holding link, shape (H, 7): whether there is one,
  its center and its half edges.

All are scaled to about -1..1. An arm is the set of bodies that move with one joint of the world. At key states it is
represented by balls around pieces of its links, with the fingers half closed and without held objects.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apex_ompl.kernel import Kernel, RobotTables
from apex_ompl.kernel.scene_builder import scene_tables
from apex_ompl.kernel.scene_distances import group_clearances, nearest_points
from apex_ompl.kernel.tables import SceneTables
from apex_ompl.model.config import HELD_FEATURES, PIECES, WORKSPACE_CENTER, ConditionConfig
from apex_ompl.model.geometry import HeldExtent
from apex_ompl.model.query import MAX_DISTANCE, Probes, Query
from apex_ompl.types import Array, Flags

ROUNDS = 10  # of Lloyd's algorithm, which divides a cluster's spheres among its pieces
KEY_RANGE = 0.3  # clearances at key states are clipped here [m]
REACH = 0.2  # distance of a probe point from an obstacle from which its force is zero [m]
HELD_SIZE = 0.2  # scale of held objects [m]
HALF = 2.0**-11  # relative rounding of half precision, in which checkpoints store balls
CANDIDATES = 8  # states from which a key state is chosen
_EMPTY = scene_tables([])


@dataclass(frozen=True, eq=False)
class KeyStates:
    """Key states of A arms, each of C clusters of bodies in PIECES balls; arrays are buffers of a checkpoint.

    Attributes:
        state: Key states, shape (K, dof) [rad].
        joint: Joint that carries each cluster, shape (A, C).
        ball: Center in the joint's frame and radius of the ball around each cluster, and of those of its pieces,
            shape (A, C, 1 + PIECES, 4) [m].
    """

    state: Array
    joint: NDArray[np.int64]
    ball: Array

    @classmethod
    def of(cls, key_state: NDArray[Any], key_joint: NDArray[Any], key_ball: NDArray[Any]) -> KeyStates:
        """Return key states of the buffers of a checkpoint."""
        return cls(np.asarray(key_state, float), np.asarray(key_joint, np.int64), np.asarray(key_ball, float))

    def placed(self, kernel: Kernel) -> Array:
        """Return the balls in the world at all key states, shape (K * A, C, 1 + PIECES, 4) [m]."""
        rotation, origin = kernel.joint_frames(self.state)
        found = np.empty((len(self.state), *self.ball.shape))
        found[..., :3] = np.einsum("kacij,acpj->kacpi", rotation[:, self.joint], self.ball[..., :3])
        found[..., :3] += origin[:, self.joint][:, :, :, None]
        found[..., 3] = self.ball[..., 3]
        return found.reshape(-1, *self.ball.shape[1:])


def arms(robot: RobotTables) -> list[NDArray[np.int64]]:
    """Return the clusters of bodies of each arm that can meet obstacles; an arm moves with one joint of the world."""
    a = robot.arrays
    base = np.arange(len(a.joint_parent))
    for joint in range(1, len(base)):
        base[joint] = base[a.joint_parent[joint]] if a.joint_parent[joint] else joint
    meets = np.flatnonzero(a.cluster_meets_scene & (a.cluster_joint > 0))
    owner = base[a.cluster_joint[meets]]
    return [meets[owner == joint] for joint in np.unique(owner)]


def key_states(robot: RobotTables, states: Array, count: int, rng: np.random.Generator) -> KeyStates:
    """Return key states of a robot with empty hands, spread out among given states.

    Each is the one of some candidates whose clusters are farthest from those of the key states so far (best-candidate
    sampling, Mitchell 1991).

    Args:
        robot: Tables of the robot with empty hands.
        states: States of paths from which they are chosen, shape (N, dof) [rad].
        count: Number K of key states.
        rng: Source of the candidates.
    """
    kernel, groups = Kernel(robot, _EMPTY), arms(robot)
    most = max(len(group) for group in groups)
    padded = np.stack([np.resize(group, most) for group in groups])  # an arm of fewer links has some of them twice
    joint = robot.arrays.cluster_joint[padded]
    ball = np.stack([[_pieces(robot, kernel, int(c)) for c in row] for row in padded])
    chosen = states[rng.integers(len(states), size=count * CANDIDATES)].astype(np.float16).astype(float)
    spread = KeyStates(chosen, joint, ball).placed(kernel)[:, :, 0, :3].reshape(len(chosen), -1)
    kept = [0]
    for k in range(1, count):
        some = slice(k * CANDIDATES, (k + 1) * CANDIDATES)
        apart = ((spread[some, None] - spread[kept][None]) ** 2).sum(axis=2).min(axis=1)
        kept.append(some.start + int(apart.argmax()))
    return KeyStates(chosen[kept], joint, ball)


def _pieces(robot: RobotTables, kernel: Kernel, cluster: int) -> Array:
    """Return a ball around a cluster's spheres at half of the limits, and those of its pieces, (1 + PIECES, 4) [m]."""
    a = robot.arrays
    middle = (a.lower + a.upper)[None] / 2.0
    rotation, origin = (frames[0] for frames in kernel.joint_frames(middle))
    first, number = a.cluster_bodies[cluster]
    centers, radii, home = [], [], a.cluster_joint[cluster]
    ends = np.append(a.body_root, len(a.node_first))
    for body in range(first, first + number):
        nodes = np.arange(ends[body], ends[body + 1])
        nodes, joint = nodes[a.node_count[nodes] == 0], a.body_joint[body]
        world = a.node_center[nodes] @ rotation[joint].T + origin[joint]
        centers.append((world - origin[home]) @ rotation[home])
        radii.append(a.node_radius[nodes])
    points, sizes = np.concatenate(centers), np.concatenate(radii)
    seeds = points[[int(np.linalg.norm(points - points.mean(axis=0), axis=1).argmax())]]
    while len(seeds) < PIECES:
        apart = np.linalg.norm(points[:, None] - seeds, axis=2).min(axis=1)
        seeds = np.append(seeds, points[[int(apart.argmax())]], axis=0)
    for _ in range(ROUNDS):
        part = np.linalg.norm(points[:, None] - seeds, axis=2).argmin(axis=1)
        seeds = np.stack([points[part == k].mean(axis=0) if (part == k).any() else seeds[k] for k in range(PIECES)])
    pieces = np.stack([_ball(points[part == k], sizes[part == k]) for k in np.unique(part)])
    return np.stack([_ball(pieces[:, :3], pieces[:, 3]), *(pieces[k % len(pieces)] for k in range(PIECES))])


def _ball(points: Array, radii: Array) -> Array:
    """Return a ball around balls, rounded outwards to half precision, shape (4,) [m]."""
    middle = ((points - radii[:, None]).min(axis=0) + (points + radii[:, None]).max(axis=0)) / 2.0
    middle = middle.astype(np.float16).astype(float)
    reach = float((np.linalg.norm(points - middle, axis=1) + radii).max())
    return np.array([*middle, float(np.float16(reach * (1.0 + 2.0 * HALF)))])


@dataclass(frozen=True, eq=False)
class SceneEncoding:
    """Features of queries by a model's key states, probes and hands.

    Attributes:
        keys: Key states.
        probes: Probe points.
        hands: Links that hold objects.
        center: Origin of the points among the features, shape (3,) [m].
        reach: Length by which positions relative to it are divided [m].
    """

    keys: KeyStates
    probes: Probes
    hands: Sequence[str]
    center: Sequence[float] = WORKSPACE_CENTER
    reach: float = 1.0
    _placed: dict[str, tuple[tuple[Array, Array], Array]] = field(default_factory=dict, init=False)

    def features(self, queries: Sequence[Query], kernel: Kernel) -> NDArray[np.float32]:
        """Return the features of Q queries, shape (Q, size); of the kernel only the kinematics are used."""
        balls, shares = self.balls(kernel), self.probes.shares[:, None]
        rows = []
        for query in queries:
            scene, chosen = query.obstacle_tables()
            line = query.start + shares * (np.asarray(query.goal) - query.start)
            along = self.along(kernel, line[None], scene, chosen)[0]
            rows.append(np.concatenate([self.at_keys(balls, scene, chosen), along, self.held(query.held)]))
        return np.array(rows, np.float32)

    def balls(self, kernel: Kernel) -> Array:
        """Return the balls of :meth:`KeyStates.placed`, kept while the kernel's joints are where they were."""
        joints = (kernel.robot.arrays.joint_rotation, kernel.robot.arrays.joint_offset)
        kept = self._placed.get("last")
        if kept is None or not all(map(np.array_equal, joints, kept[0])):
            kept = self._placed["last"] = joints, self.keys.placed(kernel)
        return kept[1]

    @staticmethod
    def at_keys(balls: Array, scene: SceneTables, chosen: Flags | None) -> NDArray[np.float32]:
        """Return the features of key states, shape (K * A,), whose balls :meth:`KeyStates.placed` gives."""
        found = group_clearances(scene, balls, KEY_RANGE, chosen)
        return (np.maximum(found, -KEY_RANGE) / KEY_RANGE).astype(np.float32)

    def along(self, kernel: Kernel, paths: Array, scene: SceneTables, chosen: Flags | None) -> NDArray[np.float32]:
        """Return the features along paths of L states each, shape (B, L, dof) [rad]: shape (B, features).

        Of the kernel only the kinematics are used.
        """
        count, probes = len(paths), self.probes
        frames = rotation, origin = kernel.joint_frames(paths.reshape(-1, paths.shape[-1]))
        points = np.einsum("npij,pj->npi", rotation[:, probes.joint], probes.offset, order="C")
        points += origin[:, probes.joint]
        distances, gradients = nearest_points(scene, points.reshape(-1, 3), MAX_DISTANCE, chosen)
        found = distances.reshape(points.shape[:2]), gradients.reshape(points.shape)
        pushed = kernel.joint_pushes(frames, probes.joint, points, found, REACH)
        near = np.maximum(distances, -MAX_DISTANCE) / MAX_DISTANCE
        parts = ((points - np.array(self.center)) / self.reach, near, gradients, pushed)
        return np.concatenate([part.reshape(count, -1) for part in parts], axis=1, dtype=np.float32, casting="unsafe")

    def held(self, extents: Sequence[HeldExtent]) -> NDArray[np.float32]:
        """Return the features of held objects, shape (H * HELD_FEATURES,); objects of one hand are in one box."""
        found = np.zeros((len(self.hands), HELD_FEATURES), np.float32)
        for row, hand in zip(found, self.hands, strict=True):
            boxes = np.array([box for link, box in extents if link == hand])
            if len(boxes):
                low, high = boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)
                row[0], row[1:4], row[4:] = 1.0, (low + high) / 2.0 / HELD_SIZE, (high - low) / 2.0 / HELD_SIZE
        return found.ravel()


def encoding_of(condition: ConditionConfig, keys: KeyStates, probes: Probes) -> SceneEncoding:
    """Return the scene encoding of a condition's configuration."""
    return SceneEncoding(keys, probes, condition.hands, condition.center, condition.reach)
