"""Traversal of a scene's tree of boxes, shared by proofs, nearest obstacles and the clearance cost."""

from __future__ import annotations

from apex_ompl.kernel.compiled.arrays import SceneArrays
from apex_ompl.kernel.compiled.compilation import inlined


@inlined
def next_obstacles(s: SceneArrays, x: float, y: float, z: float, radius: float, k: int) -> tuple[int, int, int]:
    """Return the next range of obstacles that may meet a ball: those of a leaf whose box meets it, half-spaces last.

    Args:
        s: The scene.
        x: Center of the ball [m].
        y: Center of the ball [m].
        z: Center of the ball [m].
        radius: Radius of the ball [m], which may change from call to call; a ball that is not a number meets all.
        k: Node to begin with: 0, or the one that the call before returned.

    Returns:
        The node to go on with, first obstacle, and the one behind the last; an empty range is the end.
    """
    nodes, obstacles = len(s.tree_skip), len(s.kind)
    while k < nodes:
        low, high = s.tree_low[k], s.tree_high[k]
        dx = max(low[0] - x, x - high[0], 0.0)
        dy = max(low[1] - y, y - high[1], 0.0)
        dz = max(low[2] - z, z - high[2], 0.0)
        if dx * dx + dy * dy + dz * dz > radius * radius:
            k = s.tree_skip[k]
            continue
        first, count = s.tree_range[k, 0], s.tree_range[k, 1]
        k += 1
        if count > 0:
            return k, first, first + count
    return nodes + 1, obstacles - (s.open[0] if k == nodes else 0), obstacles


@inlined
def is_allowed(s: SceneArrays, body: int, obstacle: int) -> bool:
    """Whether a body may touch an obstacle."""
    for k in range(len(s.allowed)):
        if s.allowed[k, 0] == body and s.allowed[k, 1] == s.owner[obstacle]:
            return True
    return False
