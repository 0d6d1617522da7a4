"""Joints and covered bodies, the input of a robot's tables."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from apex_ompl.kernel.compiled.arrays import FIXED
from apex_ompl.types import Array


def no_balls() -> Array:
    """Return no balls, shape (0, 4)."""
    return np.empty((0, 4))


@dataclass(frozen=True)
class JointSpec:
    """A joint of a tree; number 0 is the world, and parents come before their children.

    Attributes:
        parent: Number of the parent.
        kind: FIXED, REVOLUTE or PRISMATIC.
        placement: Pose in the parent's frame at value 0, shape (4, 4) [m].
        axis: Unit vector in the joint's own frame, shape (3,).
        source: Planned joint that drives it.
        ratio: Value of the joint is ``ratio * q[source] + shift``; mimic joints share a source.
        shift: See ``ratio``.
    """

    parent: int
    kind: int = FIXED
    placement: Array | None = None
    axis: Array | None = None
    source: int = -1
    ratio: float = 1.0
    shift: float = 0.0


@dataclass(frozen=True)
class BodySpec:
    """A solid fixed to a joint, and the tree of spheres that contains it.

    Attributes:
        name: Name of the body.
        joint: Number of its joint.
        placement: Pose of the spheres' frame in the joint's, shape (4, 4) [m].
        centers: Shape (n, 3) [m]; node 0 is the root.
        radii: Shape (n,) [m].
        first: First child of each node, shape (n,).
        count: Number of children of each node, 0 for leaves, shape (n,).
        inner: Centers and radii of balls inside of the solid, in the frame of the spheres, shape (k, 4) [m].
        meets_scene: Whether it is checked against obstacles.
    """

    name: str
    joint: int
    placement: Array
    centers: Array
    radii: Array
    first: NDArray[np.int64]
    count: NDArray[np.int64]
    inner: Array = field(default_factory=no_balls)
    meets_scene: bool = True
