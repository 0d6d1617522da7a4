"""Balls around clusters of bodies and their parts for values of their inner joints, and around the leaves of covers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from apex_ompl.kernel.compiled.arrays import BINS, LIMIT_SLACK, PRISMATIC, REVOLUTE
from apex_ompl.kernel.products import product
from apex_ompl.kernel.tables import BodySpec, JointSpec
from apex_ompl.types import Array

OF_BIN = 4  # steps between the values at which balls are made, in a range of values
SAMPLES = OF_BIN * BINS + 1  # of these values


class ClusterBall(NamedTuple):
    """Ball around a cluster in the frame of its joint.

    Attributes:
        center: Shape (3,) [m].
        radius: Radius around the solids [m].
        outer: Radius around the leaf spheres [m].
        spread: Largest distance of a sphere's center from that of the ball [m].
        speed: Largest speed of such a center, per unit of the inner planned joint.
    """

    center: Array
    radius: float
    outer: float
    spread: float
    speed: float


class Member(NamedTuple):
    """A body of a cluster.

    Attributes:
        joint: Its joint.
        centers: Centers of its spheres in the joint's frame, shape (n, 3) [m].
        radii: Shape (n,) [m].
        outer: Radii around the leaves below each, shape (n,) [m].
    """

    joint: int
    centers: Array
    radii: Array
    outer: Array


def cluster_ball(
    members: Sequence[Member],
    top: int,
    inner: Sequence[int],
    joints: Sequence[JointSpec],
    placements: Sequence[Array],
    limits: tuple[float, float] | None,
) -> ClusterBall:
    """Return the ball around a cluster.

    Inner joints are sampled over their range; between two samples a center moves by at most its speed times half the
    spacing.

    Args:
        members: Bodies of the cluster.
        top: Joint of the cluster.
        inner: Its inner joints, parents first.
        joints: All joints.
        placements: Poses of all joints in their parents, with their axes along z.
        limits: Range of the planned joint that drives the inner joints, None where there is none.
    """
    low, high = limits or (0.0, 0.0)
    values = np.zeros(1) if limits is None else np.linspace(low, high, SAMPLES)
    points = _points(members, top, inner, joints, placements, values)
    radii = np.concatenate([m.radii for m in members])
    roots = np.concatenate([np.arange(len(m.radii)) == 0 for m in members])
    speeds = np.concatenate([_speed(m, top, joints, placements, (low, high)) for m in members])
    slack = 0.0 if limits is None else speeds * (high - low) / (SAMPLES - 1) / 2.0
    center = _middle(points[:, roots], (radii + slack)[roots])
    away = np.linalg.norm(points - center, axis=2).max(axis=0) + slack
    leaves = np.concatenate([m.outer for m in members])
    # The roots contain the solids; the leaves and inner nodes are what moves.
    return ClusterBall(
        center, float((away + radii)[roots].max()) + 1e-9, float((away + leaves)[roots].max()) + 1e-9,
        float(away.max()) + 1e-9, float(speeds.max()),
    )  # fmt: skip


def part_balls(
    members: Sequence[Member],
    top: int,
    inner: Sequence[int],
    joints: Sequence[JointSpec],
    placements: Sequence[Array],
    limits: tuple[float, float] | None,
) -> tuple[Array, Array]:
    """Return balls around a part of a cluster for each of BINS ranges of values, from the lowest limit to the highest.

    Args are those of :func:`cluster_ball`, but for the limits, which are the robot's own and hold within LIMIT_SLACK.

    Returns:
        Centers and radii around the solids, shape (BINS, 4), and radii around the leaf spheres, shape (BINS,) [m].
    """
    low, high = limits or (0.0, 0.0)
    roots = [Member(m.joint, m.centers[:1], m.radii[:1], m.outer[:1]) for m in members]
    points = _points(roots, top, inner, joints, placements, np.linspace(low, high, SAMPLES))
    speeds = np.concatenate([_speed(m, top, joints, placements, (low, high)) for m in roots])
    slack = speeds * ((high - low) / (SAMPLES - 1) / 2.0 + LIMIT_SLACK)
    rows = OF_BIN * np.arange(BINS)[:, None] + np.arange(OF_BIN + 1)
    within = points[rows]  # (BINS, OF_BIN + 1, bodies, 3)
    radii, leaves = np.concatenate([m.radii for m in roots]), np.concatenate([m.outer for m in roots])
    wide = (radii + slack)[:, None]
    center = 0.5 * ((within - wide).min(axis=(1, 2)) + (within + wide).max(axis=(1, 2)))
    away = np.linalg.norm(within - center[:, None, None], axis=3).max(axis=1) + slack
    return np.column_stack([center, (away + radii).max(axis=1) + 1e-9]), (away + leaves).max(axis=1) + 1e-9


def _points(
    members: Sequence[Member], top: int, inner: Sequence[int], joints: Sequence[JointSpec],
    placements: Sequence[Array], values: Array,
) -> Array:  # fmt: skip
    """Return the centers of all spheres at values of the inner joints, in the frame of the cluster's, (N, n, 3)."""
    poses = {top: np.tile(np.eye(4), (len(values), 1, 1))}
    for k in inner:
        poses[k] = product(product(poses[joints[k].parent], placements[k]), _motions(joints[k], values))
    return np.concatenate([transformed(poses[m.joint], m.centers) for m in members], axis=1)


def _speed(
    body: Member, top: int, joints: Sequence[JointSpec], placements: Sequence[Array], limits: tuple[float, float]
) -> Array:
    """Bound the speed of a body's spheres relative to the cluster's joint, per unit of the planned joint."""
    reach = np.linalg.norm(body.centers, axis=1)
    speed = np.zeros(len(reach))
    k = body.joint
    while k != top:
        joint = joints[k]
        if joint.kind == REVOLUTE:
            speed += abs(joint.ratio) * reach
        elif joint.kind == PRISMATIC:
            speed += abs(joint.ratio)
            reach = reach + max(abs(joint.ratio * v + joint.shift) for v in limits)
        reach = reach + np.linalg.norm(placements[k][:3, 3])
        k = joint.parent
    return speed


def _motions(joint: JointSpec, q: Array) -> Array:
    """Return the motion of a joint at values of its planned joint, shape (N, 4, 4)."""
    poses = np.tile(np.eye(4), (len(q), 1, 1))
    values = joint.ratio * q + joint.shift
    if joint.kind == REVOLUTE:
        c, s = np.cos(values), np.sin(values)
        poses[:, 0, 0], poses[:, 0, 1], poses[:, 1, 0], poses[:, 1, 1] = c, -s, s, c
    elif joint.kind == PRISMATIC:
        poses[:, 2, 3] = values
    return poses


def leaf_radii(centers: Array, radii: Array, body: BodySpec) -> Array:
    """Return for each node a radius around all leaves below it."""
    above = np.full(len(radii), -1)
    for k in np.flatnonzero(body.count):
        above[body.first[k] : body.first[k] + body.count[k]] = k
    leaves = np.flatnonzero(np.asarray(body.count) == 0)
    outer, at = np.zeros(len(radii)), leaves
    while len(leaves):
        np.maximum.at(outer, at, np.linalg.norm(centers[leaves] - centers[at], axis=1) + radii[leaves])
        at = above[at]
        leaves, at = leaves[at >= 0], at[at >= 0]
    return outer + 1e-12


def _middle(points: Array, radii: Array) -> Array:
    """Return the approximate center of the smallest ball around balls at points (..., n, 3) with radii (n,).

    By steps towards the farthest ball (Badoiu and Clarkson 2003).
    """
    flat = points.reshape(-1, 3)
    wide = np.broadcast_to(radii, points.shape[:-1]).ravel()
    center: Array = flat.mean(axis=0)
    for step in range(1, 100):
        offsets = flat - center
        lengths = np.sqrt(np.einsum("ij,ij->i", offsets, offsets))
        k = int(np.argmax(lengths + wide))
        long = float(lengths[k])
        if long == 0.0:
            break
        center = center + offsets[k] / long * (long + wide[k]) / (step + 1) * 0.5
    return center


def transformed(pose: Array, points: Array) -> Array:
    """Return points, shape (n, 3), after poses, shape (..., 4, 4): shape (..., n, 3)."""
    return product(points, np.swapaxes(pose[..., :3, :3], -1, -2)) + pose[..., None, :3, 3]
