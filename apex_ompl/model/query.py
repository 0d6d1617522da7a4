"""Planning queries of a model: start, goal, obstacle point and obstacles; and the robot's probe points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from apex_ompl.kernel import Kernel, RobotTables
from apex_ompl.kernel.arrays import BOX, GRID, HALF_SPACE
from apex_ompl.kernel.scene_builder import Solids, boxes_around, primitive, tables_of
from apex_ompl.kernel.tables import SceneTables
from apex_ompl.model.geometry import HeldExtent, ObstacleRecord, rotation_matrices
from apex_ompl.model.primitive_fit import primitives_like
from apex_ompl.types import Array, Flags
from apex_ompl.util.arrays import narrowed
from apex_ompl.util.display import fields_line

HALVES = np.array([[0.5, 0.5, 0.5], [1.0, 0.5, 0.5], [1.0, 0.5, 0.5], [1.0, 0.5, 0.5]], np.float32)
"""Factors from the sizes in data sets (edges, lengths) to those of the networks (half edges, half lengths), by shape;
radii are kept."""

KINEMATICS_BATCH = 1024
"""Number of paths whose joint frames are in memory at the same time."""

MAX_DISTANCE = 0.4
"""Largest distance among the features of a model; larger ones are clipped [m]."""

TURN = 2.0 * np.pi  # of a continuous joint [rad]

HALF_SPACE_BOX = np.array([3.0, 3.0, 0.5])
"""Half edges of the box that represents a half-space [m]."""


@dataclass(frozen=True, eq=False)
class ObstacleSet:
    """M obstacles of primitive shape.

    Attributes:
        shape: Indices into ``apex_ompl.training.records.SHAPES``, shape (M,).
        position: Positions of the centers in the world, shape (M, 3) [m].
        rotation: Rotation matrices, obstacle to world, shape (M, 3, 3).
        size: Half edges; radius; or radius and half length along z, shape (M, 3) [m].
    """

    shape: NDArray[np.int64]
    position: Array
    rotation: Array
    size: Array

    __repr__ = fields_line

    @classmethod
    def from_rows(cls, rows: Sequence[ObstacleRecord]) -> ObstacleSet:
        """Return the obstacles of a data set, given as rows of shape, position, orientation (xyzw) and size."""
        columns = list(zip(*rows, strict=True)) or [(), (), (), ()]
        shape = np.array(columns[0], np.int64)
        position, orientation, size = (
            np.array(c, float).reshape(-1, n) for c, n in zip(columns[1:], (3, 4, 3), strict=True)
        )
        return cls(shape, position, rotation_matrices(orientation).astype(float), size * HALVES[shape])

    @classmethod
    def from_scene(cls, tables: SceneTables, chosen: Flags) -> ObstacleSet:
        """Return some obstacles of a kernel scene; a half-space becomes a box larger than the workspace.

        A grid of distances becomes primitives that approximate it, see :mod:`apex_ompl.model.primitive_fit`.

        Args:
            tables: The scene.
            chosen: Which of its obstacles to take, shape (all obstacles,).
        """
        scene = tables.arrays
        grids = np.flatnonzero(chosen & (scene.kind == GRID))
        chosen = chosen & (scene.kind != GRID)
        shape, position = scene.kind[chosen].copy(), scene.offset[chosen].copy()
        rotation, size = scene.rotation[chosen].copy(), scene.size[chosen].copy()
        for k in np.flatnonzero(shape == HALF_SPACE):
            normal, distance = position[k].copy(), size[k, 0]
            rotation[k] = _rotation_to(normal)
            shape[k], position[k], size[k] = BOX, (distance - HALF_SPACE_BOX[2]) * normal, HALF_SPACE_BOX
        rows = [(shape, position, rotation, size)]
        for place in grids.tolist():
            alike = Solids.of(primitives_like(primitive(tables, place)))
            rows.append((alike.kind, alike.offset, alike.rotation, alike.size))
        return cls(*(np.concatenate(column) for column in zip(*rows, strict=True)))

    def __len__(self) -> int:
        """Return the number of obstacles M."""
        return len(self.shape)

    def tables(self) -> SceneTables:
        """Return the obstacles as tables of the kernel."""
        position, rotation, size = (np.asarray(v, float) for v in (self.position, self.rotation, self.size))
        kind = np.asarray(self.shape, np.int64)
        boxes = boxes_around(kind, rotation, position, size)
        exact = np.ones(len(kind), np.int64)
        return tables_of({0: Solids(kind, exact, rotation, position, size, boxes, (None,) * len(kind))})


def encoded_range(robot: RobotTables) -> tuple[Array, Array]:
    """Return the values that networks scale to -1..1: the limits, of continuous joints a turn to either side of 0."""
    a = robot.arrays
    return narrowed((a.lower, a.upper), a.continuous != 0, -TURN, TURN)


def turned_back(queries: Sequence[Query], robot: RobotTables) -> Sequence[Query]:
    """Return queries whose continuous joints start within half a turn of 0; goals are moved by as many turns."""
    endless = robot.arrays.continuous != 0
    if not endless.any():
        return queries
    turns = [np.where(endless, TURN * np.rint(np.asarray(query.start, float) / TURN), 0.0) for query in queries]
    return [replace(q, start=q.start - by, goal=q.goal - by) for q, by in zip(queries, turns, strict=True)]


def _rotation_to(normal: Array) -> Array:
    """Return a rotation matrix whose z axis is the unit vector ``normal``, shape (3, 3)."""
    across = np.cross(normal, np.eye(3)[int(np.argmin(np.abs(normal)))])
    across /= np.linalg.norm(across)
    return np.stack([across, np.cross(normal, across), normal], axis=1)


@dataclass(frozen=True, eq=False)
class Query:
    """Planning query of the model: the vector g of the paper, and the obstacles.

    Attributes:
        start: Shape (dof,) [rad].
        goal: Shape (dof,) [rad].
        point: Obstacle point nearest to the robot at the start, shape (3,) [m].
        known: The obstacles as primitives, or None where there is a scene.
        scene: The obstacles as tables of the kernel, with a flag for each solid that is no fixture; or None.
        held: Links that hold an object, and the corners of the box around it in their frames, each of shape (2, 3) [m].
    """

    start: Array
    goal: Array
    point: Array
    known: ObstacleSet | None
    scene: tuple[SceneTables, Flags] | None = None
    held: Sequence[HeldExtent] = ()

    __repr__ = fields_line

    @cached_property
    def obstacles(self) -> ObstacleSet:
        """The obstacles without fixtures such as tables, computed when they are first used."""
        if self.known is not None:
            return self.known
        assert self.scene is not None
        return ObstacleSet.from_scene(*self.scene)

    def obstacle_tables(self) -> tuple[SceneTables, Flags | None]:
        """Return tables of the obstacles, and a flag for each of their solids that is no fixture; None for all."""
        return (self.obstacles.tables(), None) if self.scene is None else self.scene


class Probes:
    """Probe points: P points fixed to the robot's links, whose distances to the obstacles are features.

    By default they are the centers of the bounding balls of the sphere cover's clusters.

    Attributes:
        joint: Joint that carries each point, an index into the kernel's tables, shape (P,).
        offset: Positions in the joints' frames, shape (P, 3) [m].
        shares: Parameters of the straight line from start to goal at which they are placed, shape (L,) in 0..1.
    """

    def __init__(self, joint: NDArray[np.int64], offset: Array, along: int) -> None:
        """Fix points to joints.

        Args:
            joint: Joints, shape (P,).
            offset: Positions in the joints' frames, shape (P, 3) [m].
            along: Number L of states of the straight line, ends included.
        """
        self.joint, self.offset = joint, offset
        self.shares = np.linspace(0.0, 1.0, along)

    @classmethod
    def from_robot(cls, robot: RobotTables, along: int) -> Probes:
        """Return the default probe points of a robot: one for each cluster that moves and can meet obstacles."""
        a = robot.arrays
        moved = np.flatnonzero(a.cluster_meets_scene & (a.cluster_joint > 0))
        return cls(a.cluster_joint[moved], a.cluster_ball[moved, :3], along)

    def positions(self, kernel: Kernel, start: Array, goal: Array) -> NDArray[np.float32]:
        """Return the points' positions along straight lines between states of shape (B, dof): (B, L, P, 3) [m]."""
        found = np.empty((len(start), len(self.shares), len(self.joint), 3), np.float32)
        for k in range(0, len(start), KINEMATICS_BATCH):
            ends = start[k : k + KINEMATICS_BATCH, None], goal[k : k + KINEMATICS_BATCH, None]
            states = ends[0] + self.shares[:, None] * (ends[1] - ends[0])
            rotation, origin = kernel.joint_frames(states.reshape(-1, start.shape[1]))
            points = np.einsum("npij,pj->npi", rotation[:, self.joint], self.offset) + origin[:, self.joint]
            found[k : k + KINEMATICS_BATCH] = points.reshape(states.shape[0], *found.shape[1:])
        return found
