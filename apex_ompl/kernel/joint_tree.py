"""The tree of a robot's joints, the clusters of bodies that follow from it, and the balls around them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeVar, cast

import numpy as np

from apex_ompl.kernel.cluster_balls import ClusterBall, Member, cluster_ball, leaf_radii, part_balls
from apex_ompl.kernel.compiled.arrays import FIXED
from apex_ompl.kernel.products import product
from apex_ompl.kernel.tables import BodySpec, JointSpec
from apex_ompl.types import Array
from apex_ompl.util.arrays import length

MOST_KEPT = 2000  # balls and radii
MOST_PARTS = 62  # of a cluster: bits of a number

T = TypeVar("T")


def turn_to(axis: Array | None) -> Array:
    """Return the rotation by which the kernel turns a joint's frame, so that ``axis`` is its z; shape (4, 4)."""
    turn = np.eye(4)
    if axis is not None:
        z = np.asarray(axis, float) / length(axis)
        x = np.eye(3)[int(np.argmin(np.abs(z)))]
        x = x - z * float((x * z).sum())
        x /= length(x)
        turn[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
    return turn


class JointTree:
    """Joints with their axes along z.

    Attributes:
        joints: The joints, the world first, parents before their children.
        turns: Rotation of each joint's frame that takes its axis to z, shape (4, 4).
        placements: Pose of each turned frame in that of its parent, shape (4, 4) [m].
        chains: Numbers of each joint and of those above it, up to the world.
        home: Joint of the cluster of each joint's bodies: the joint itself, or the one that carries the hand.
    """

    def __init__(self, joints: Sequence[JointSpec]) -> None:
        """Read the joints."""
        self.joints = tuple(joints)
        self.turns = [turn_to(joint.axis if joint.kind != FIXED else None) for joint in joints]
        self.placements = [np.eye(4)]
        self.chains = [[0]]
        for k, joint in enumerate(joints[1:], start=1):
            placement = np.eye(4) if joint.placement is None else joint.placement
            self.placements.append(product(product(self.turns[joint.parent].T, placement), self.turns[k]))
            self.chains.append([k, *self.chains[joint.parent]])
        drivers = [joint.source for joint in joints if joint.kind != FIXED]
        self._shared = {source for source in drivers if drivers.count(source) > 1}
        self._fingers = [self._is_finger(k) for k in range(len(joints))]
        self.home = [self._cluster_joint(k) for k in range(len(joints))]
        self._known: dict[tuple[object, ...], object] = {}

    def inner(self, top: int) -> list[int]:
        """Return the joints below ``top`` whose bodies are in its cluster, parents first."""
        joints = range(1, len(self.joints))
        return [k for k in joints if k != top and self.home[k] == top and top in self.chains[k]]

    def ball(
        self, members: Sequence[Member], top: int, inner: Sequence[int], limits: tuple[float, float] | None
    ) -> ClusterBall:
        """Return the ball of :func:`apex_ompl.kernel.cluster_balls.cluster_ball`; it is kept."""
        content = tuple((m.joint, m.centers.tobytes(), m.radii.tobytes(), m.outer.tobytes()) for m in members)
        key = top, tuple(inner), limits, content
        return self._kept(key, lambda: cluster_ball(members, top, inner, self.joints, self.placements, limits))

    def part_balls(
        self, members: Sequence[Member], top: int, inner: Sequence[int], limits: tuple[float, float] | None
    ) -> tuple[Array, Array]:
        """Return the balls of :func:`apex_ompl.kernel.cluster_balls.part_balls`; they are kept."""
        content = tuple((m.joint, *(array[:1].tobytes() for array in m[1:])) for m in members)
        key = "part", top, tuple(inner), limits, content
        return self._kept(key, lambda: part_balls(members, top, inner, self.joints, self.placements, limits))

    def branch(self, joint: int, top: int) -> int:
        """Return the joint below ``top`` that a joint is or hangs at; ``top`` itself, too, where there are many."""
        chain = self.chains[joint]
        below = sum(one.parent == top for one in self.joints[1:])
        return top if below >= MOST_PARTS else chain[max(chain.index(top) - 1, 0)]

    def outer_radii(self, centers: Array, body: BodySpec) -> Array:
        """Return the radii of :func:`apex_ompl.kernel.cluster_balls.leaf_radii`, shape (n,); they are kept."""
        radii = np.asarray(body.radii, float)
        key = (
            centers.tobytes(),
            radii.tobytes(),
            np.asarray(body.first, int).tobytes(),
            np.asarray(body.count, int).tobytes(),
        )
        return self._kept(key, lambda: leaf_radii(centers, radii, body))

    def _kept(self, key: tuple[object, ...], make: Callable[[], T]) -> T:
        found = self._known.get(key)
        if found is None:
            found = make()
            if len(self._known) >= MOST_KEPT:
                self._known.clear()
            self._known[key] = found
        return cast(T, found)

    def _is_finger(self, k: int) -> bool:
        joint = self.joints[k]
        if k == 0:
            return False
        if joint.kind == FIXED:
            return self._is_finger(joint.parent)
        return joint.source in self._shared

    def _cluster_joint(self, k: int) -> int:
        """Return the joint of the cluster of a joint's bodies.

        Joints of which several follow one planned joint are taken for fingers, as long as one planned joint drives
        all of what hangs there.
        """
        top = next(x for x in self.chains[k] if not self._fingers[x])
        below = [i for i in range(len(self.joints)) if i != top and top in self.chains[i]]
        fingers = [i for i in below if self.joints[i].kind != FIXED and self._all_fingers(i, top)]
        driven = {self.joints[i].source for i in fingers}
        carried = any(not self._fingers[i] and any(self._fingers[x] for x in self.chains[i]) for i in below)
        return k if carried or len(driven) > 1 else top

    def _all_fingers(self, k: int, top: int) -> bool:
        chain = self.chains[k]
        return all(self._fingers[x] for x in chain[: chain.index(top)])
