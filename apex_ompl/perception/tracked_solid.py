"""The solid of a tracked obstacle for planners: it contains what is needed, and changes only where it has to."""

from __future__ import annotations

import math

import numpy as np

from apex_ompl.scene.bodies import Obstacle
from apex_ompl.scene.scripts import vector
from apex_ompl.types import Array


def next_solid(before: Obstacle | None, needed: Obstacle, slack: float) -> Obstacle:
    """Return a solid that contains a needed one: the last one, moved as little as that takes, or a new one.

    Noise of the estimate that is less than the slack then does not move it.

    Args:
        before: The last solid, or None.
        needed: A box or a cylinder.
        slack: Length by which a new solid is larger than needed; it is replaced where that is more than twice as
            much [m].
    """
    if before is not None and (before.box is None) == (needed.box is None):
        own, old = needed.pose[:3, :3], before.pose[:3, :3]
        reach = np.abs(old.T @ own) @ _lengths(needed) if needed.box is not None else _lengths(needed)
        upright = needed.box is not None or abs(own[:, 2] @ old[:, 2]) > math.cos(slack / _lengths(needed).max())
        spare = _lengths(before) - reach
        if upright and spare.min() >= 0.0 and spare.max() <= 2.0 * slack:
            return before.model_copy(update={"position": held_back(before, needed, spare / 2.0)})
    x, y, z = (_lengths(needed) + slack).tolist()
    larger = {"box": (x, y, z)} if needed.box is not None else {"cylinder": {"radius": x / 2.0, "length": z}}
    pose = {"position": needed.position, "orientation": needed.orientation}
    return Obstacle.model_validate({"name": needed.name, **larger, **pose})


def held_back(before: Obstacle, needed: Obstacle, spare: Array) -> tuple[float, float, float]:
    """Return the position nearest to the last one at which a solid contains what is needed [m].

    Noise of the estimate that is less than the spare then does not move the solid.

    Args:
        before: The last solid.
        needed: What it has to contain, with axes that are alike.
        spare: By how much it may be off along its axes, shape (3,) [m].
    """
    turn = before.pose[:3, :3]
    off = turn.T @ np.subtract(before.position, needed.position)
    if before.cylinder is not None:
        off[:2] *= min(1.0, spare[0] / max(float(np.hypot(off[0], off[1])), 1e-12))
        off[2] = np.clip(off[2], -spare[2], spare[2])
    else:
        off = np.clip(off, -spare, spare)
    return vector(np.add(needed.position, turn @ off))


def _lengths(solid: Obstacle) -> Array:
    """Return the lengths of a box or a cylinder along its axes, shape (3,) [m]."""
    if solid.box is not None:
        return np.array(solid.box)
    assert solid.cylinder is not None
    return np.array([2.0 * solid.cylinder.radius, 2.0 * solid.cylinder.radius, solid.cylinder.length])
