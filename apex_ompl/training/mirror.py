"""Mirror symmetry of a robot, which doubles the training data."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from apex_ompl.kernel import Kernel
from apex_ompl.training.records import Paths, to_half, to_micro
from apex_ompl.types import Array

EMPTY_HANDS = "[]"  # JSON of the held objects
STRIDE, SELF_CLEARANCE_RANGE = 8, 0.01  # of the states of an image that are checked; range of the check [m]


@dataclass(frozen=True)
class Mirror:
    """Mirror symmetry of a robot in the plane y = 0.

    The image of state q is ``sign * q[order] + shift``.

    Attributes:
        order: Index of the joint whose value each joint takes.
        sign: 1 or -1 for each joint.
        shift: Offset of each joint [rad].
    """

    order: Sequence[int]
    sign: Sequence[float]
    shift: Sequence[float]

    def states(self, q: Array) -> Array:
        """Return the images of states, shape (..., dof)."""
        return np.asarray(q[..., list(self.order)] * np.array(self.sign) + np.array(self.shift))

    def paths(self, paths: Paths, kernel: Kernel) -> Paths:
        """Return the images of all paths of problems with empty hands.

        No robot is exactly symmetric: images that leave the joint limits, or in which the robot's sphere cover
        collides with itself, are left out.
        """
        a = dict(paths.arrays)
        spline, lower, upper = paths.spline, kernel.robot.arrays.lower, kernel.robot.arrays.upper
        control = self.states(paths.control())
        inside = ((control >= lower) & (control <= upper)).all(axis=(1, 2))
        held = np.array(paths.names["held"], object)[a["held"][a["problem"]]] if len(control) else np.zeros(0, object)
        kept = inside & (held == EMPTY_HANDS)
        for k in np.flatnonzero(kept):
            kept[k] = kernel.clearance(spline.path(control[k])[::STRIDE], SELF_CLEARANCE_RANGE)[:, 1].min() >= 0.0
        flip = np.array([1.0, -1.0, 1.0])
        a["position"] = (a["position"] * flip).astype(np.float32)
        a["orientation"] = (a["orientation"] * np.array([-1.0, 1.0, -1.0, 1.0])).astype(np.float32)
        for name in ("problem", "clearance", "length", "source", "homotopy"):
            a[name] = a[name][kept]
        a["point"] = (a["point"][kept] * flip).astype(np.float32)
        a["start"], a["goal"] = to_micro(control[kept, 0]), to_micro(control[kept, -1])
        a["control"] = to_half(control[kept][:, spline.inner], lower, upper).astype(np.float16)
        return Paths(a, paths.names, paths.about)
