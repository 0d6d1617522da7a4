"""Proofs that bodies collide with obstacles: balls inside of the bodies that meet them.

What is proved here is what the meshes would find: the balls are inside of closed solids, so that an obstacle that
meets one either crosses the body's surface or is inside of it.
"""

from __future__ import annotations

from apex_ompl.kernel.compiled.arrays import GRID, RobotArrays, SceneArrays
from apex_ompl.kernel.compiled.compilation import inlined
from apex_ompl.kernel.compiled.grid_distance import FARTHER, compare
from apex_ompl.kernel.compiled.item_tree import items_apart
from apex_ompl.kernel.compiled.kinematics import point_position
from apex_ompl.kernel.compiled.layout import Integers
from apex_ompl.kernel.compiled.signed_distance import distance, local_point
from apex_ompl.kernel.compiled.workspace import Workspace

DEPTH = 5e-4  # by which a ball must meet an obstacle, many times what rounding and Coal's tolerances are worth [m]


@inlined
def ball_meets(s: SceneArrays, o: int, x: float, y: float, z: float, radius: float) -> bool:
    """Whether a ball is proved to meet an obstacle whose shape the tables have: its surface, where it is a mesh."""
    reach = radius - DEPTH
    if s.kind[o] != GRID:
        return distance(s, o, x, y, z) < reach
    a, b, c = local_point(s, o, x, y, z)
    if compare(s.grid[o], s.values, s.size[o, 0], a, b, c, reach) == FARTHER:
        return False
    reach += s.size[o, 2]
    return reach > 0.0 and not items_apart(s.grid[o], s.values, a, b, c, reach)


@inlined
def collides(t: RobotArrays, s: SceneArrays, w: Workspace, found: Integers, count: int) -> bool:
    """Whether one of some pairs of a body and an obstacle is proved to collide at the state for which ``w`` is placed.

    Args:
        t: The robot.
        s: The scene.
        w: Workspace, in which the clusters of the pairs are placed.
        found: Pairs, shape (K, 2): a body and -1 - owner of an obstacle, or two bodies, which are left alone.
        count: Number of pairs.
    """
    for k in range(count):
        owner = -1 - found[k, 1]
        if owner < 0:
            continue
        b = found[k, 0]
        j, first = t.body_joint[b], t.body_inner[b, 0]
        for o in range(len(s.kind)):
            if s.owner[o] != owner or not s.exact[o]:
                continue
            for n in range(first, first + t.body_inner[b, 1]):
                x, y, z = point_position(w, j, t.inner_ball[n])
                if ball_meets(s, o, x, y, z, t.inner_ball[n, 3]):
                    return True
    return False
