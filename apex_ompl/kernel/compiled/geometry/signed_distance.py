"""Signed distances of points to obstacles, their gradients, and the traversal of a scene's tree of boxes.

Obstacles are boxes, spheres, cylinders, capsules, half-spaces and grids of distances.
"""

from __future__ import annotations

import math

from apex_ompl.kernel.compiled.arrays import BOX, CAPSULE, CYLINDER, GRID, HALF_SPACE, SPHERE, SceneArrays
from apex_ompl.kernel.compiled.compilation import inlined
from apex_ompl.kernel.compiled.geometry.bounding_trees import items_apart
from apex_ompl.kernel.compiled.geometry.grid_distance import FARTHER, OPEN, compare, grid_direction, grid_distance
from apex_ompl.kernel.compiled.layout import Floats


@inlined
def local_point(s: SceneArrays, o: int, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Return a point of the world in an obstacle's frame."""
    r, p = s.rotation[o], s.offset[o]
    dx, dy, dz = x - p[0], y - p[1], z - p[2]
    return (
        r[0, 0] * dx + r[1, 0] * dy + r[2, 0] * dz,
        r[0, 1] * dx + r[1, 1] * dy + r[2, 1] * dz,
        r[0, 2] * dx + r[1, 2] * dy + r[2, 2] * dz,
    )


@inlined
def primitive_distance(kind: int, size: Floats | tuple[float, float, float], a: float, b: float, c: float) -> float:
    """Return the signed distance of a point from a box, a ball, a cylinder or a capsule, in its frame [m]."""
    if kind == BOX:
        a, b, c = abs(a) - size[0], abs(b) - size[1], abs(c) - size[2]
        inside = min(max(a, b, c), 0.0)
        a, b, c = max(a, 0.0), max(b, 0.0), max(c, 0.0)
        return float(math.sqrt(a * a + b * b + c * c) + inside)
    if kind == CYLINDER:
        across, along = math.sqrt(a * a + b * b) - size[0], abs(c) - size[1]
        inside = min(max(across, along), 0.0)
        across, along = max(across, 0.0), max(along, 0.0)
        return float(math.sqrt(across * across + along * along) + inside)
    if kind == CAPSULE:
        c -= min(max(c, -size[1]), size[1])
    return float(math.sqrt(a * a + b * b + c * c) - size[0])


@inlined
def distance(s: SceneArrays, o: int, x: float, y: float, z: float, enough: float = math.inf) -> float:
    """Return the signed distance of a point of the world to an obstacle [m], negative inside; a bound of a grid's.

    Of a grid, a coarser bound is given where that is ``enough``.
    """
    kind, size = s.kind[o], s.size[o]
    if kind == HALF_SPACE:
        n = s.offset[o]
        return float(n[0] * x + n[1] * y + n[2] * z - size[0])
    if kind == SPHERE:
        p = s.offset[o]
        return float(math.sqrt((x - p[0]) ** 2 + (y - p[1]) ** 2 + (z - p[2]) ** 2) - size[0])
    a, b, c = local_point(s, o, x, y, z)
    if kind == GRID:
        return float(grid_distance(s.grid[o], s.values, size[0], a, b, c, enough))
    return primitive_distance(kind, size, a, b, c)


@inlined
def apart(s: SceneArrays, o: int, x: float, y: float, z: float, reach: float) -> bool:
    """Whether a point of the world is proved to be farther than ``reach`` [m] from an obstacle."""
    if s.kind[o] != GRID:
        return distance(s, o, x, y, z) > reach
    a, b, c = local_point(s, o, x, y, z)
    return compare(s.grid[o], s.values, s.size[o, 0], a, b, c, reach) == FARTHER


@inlined
def ball_apart(s: SceneArrays, o: int, x: float, y: float, z: float, radius: float) -> bool:
    """Whether a ball around a point of the world is proved apart from an obstacle, exactly where a grid is too coarse.

    A point inside of a solid has a distance, and so a bound, below minus the one to the surface: a ball whose bound is
    above minus its radius, and which meets no part of the surface, is outside. Balls around points have no inside.
    """
    if s.kind[o] != GRID:
        return distance(s, o, x, y, z) > radius
    a, b, c = local_point(s, o, x, y, z)
    grid, spacing, points = s.grid[o], s.size[o, 0], s.size[o, 2]
    compared = compare(grid, s.values, spacing, a, b, c, radius)
    if compared != OPEN:
        return compared == FARTHER
    outside = points > 0.0 or compare(grid, s.values, spacing, a, b, c, -radius) == FARTHER
    return outside and items_apart(grid, s.values, a, b, c, radius + points)


@inlined
def direction(s: SceneArrays, o: int, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Return the gradient of :func:`distance`: a unit vector, one of several where the distance has an edge."""
    kind, size, p = s.kind[o], s.size[o], s.offset[o]
    if kind == HALF_SPACE:
        return p[0], p[1], p[2]
    a, b, c = local_point(s, o, x, y, z)
    if kind == BOX:
        u, v, w = abs(a) - size[0], abs(b) - size[1], abs(c) - size[2]
        if max(u, v, w) > 0.0:
            u, v, w = max(u, 0.0), max(v, 0.0), max(w, 0.0)
        else:
            first, second = u >= v and u >= w, v > u and v >= w
            u, v, w = (1.0, 0.0, 0.0) if first else (0.0, 1.0, 0.0) if second else (0.0, 0.0, 1.0)
        a, b, c = math.copysign(u, a), math.copysign(v, b), math.copysign(w, c)
    elif kind == CYLINDER:
        radial = math.sqrt(a * a + b * b)
        across, along = radial - size[0], abs(c) - size[1]
        if max(across, along) > 0.0:
            across, along = max(across, 0.0), max(along, 0.0)
        else:
            across, along = (1.0, 0.0) if across >= along else (0.0, 1.0)
        if radial > 0.0:
            a, b, c = a / radial * across, b / radial * across, math.copysign(along, c)
        else:
            a, b, c = across, 0.0, math.copysign(along, c)
    elif kind == GRID:
        a, b, c = grid_direction(s.grid[o], s.values, size[0], a, b, c)
    elif kind == CAPSULE:
        c -= min(max(c, -size[1]), size[1])
    length = math.sqrt(a * a + b * b + c * c)
    if not length > 0.0:
        return s.rotation[o, 0, 0], s.rotation[o, 1, 0], s.rotation[o, 2, 0]
    a, b, c = a / length, b / length, c / length
    r = s.rotation[o]
    return (
        r[0, 0] * a + r[0, 1] * b + r[0, 2] * c,
        r[1, 0] * a + r[1, 1] * b + r[1, 2] * c,
        r[2, 0] * a + r[2, 1] * b + r[2, 2] * c,
    )


@inlined
def next_obstacles(s: SceneArrays, x: float, y: float, z: float, radius: float, k: int) -> tuple[int, int, int]:
    """Return the next range of obstacles that may meet a ball: those of a leaf whose box meets it, half-spaces last.

    Args:
        s: The scene.
        x: Center of the ball [m].
        y: Center of the ball [m].
        z: Center of the ball [m].
        radius: Radius of the ball [m], which may change from call to call; a ball that is not a number meets all.
        k: First node: 0, or the one that the call before returned.

    Returns:
        The node to go on with, first obstacle, and the one after the last; an empty range is the end.
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
