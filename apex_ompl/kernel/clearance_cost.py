"""Inside the kernel: by how much a state falls short of the clearance that is asked for."""

from __future__ import annotations

import math

from apex_ompl.kernel.clearance import (
    Nearest,
    gradient_of_two,
    gradient_to_obstacle,
    nearest_of_two,
    nearest_to_obstacle,
)
from apex_ompl.kernel.compiled import inlined
from apex_ompl.kernel.kinematics import open_cluster, place_robot
from apex_ompl.kernel.tables import Floats, RobotArrays, SceneArrays
from apex_ompl.kernel.views import Work


@inlined
def _add_clearance_cost(value: float, row: Floats, slope: Floats, gram: Floats) -> float:
    """Add the square of a clearance_cost whose gradient is -``row``: its gradient, and its Gauss-Newton matrix."""
    for i in range(len(row)):
        u = row[i]
        if u != 0.0:
            slope[i] -= value * u
            for k in range(i + 1):
                gram[i, k] += u * row[k]
    return 0.5 * value * value


@inlined
def _to_scene(
    t: RobotArrays, s: SceneArrays, w: Work, q: Floats, c: int, o: int, margin: float, row: Floats, slope: Floats,
    gram: Floats, least: Floats,
) -> float:  # fmt: skip
    near = nearest_to_obstacle(t, s, w, q, c, o, (margin, -1, -1, -1, -1))
    if near[1] < 0:
        return 0.0
    least[0] = min(least[0], near[0])
    for i in range(len(row)):
        row[i] = 0.0
    gradient_to_obstacle(t, s, w, near, row)
    for i in range(len(row)):
        row[i] /= margin
    return _add_clearance_cost((margin - near[0]) / margin, row, slope, gram)


@inlined
def _of_pair(
    t: RobotArrays, w: Work, q: Floats, p: int, margin: float, row: Floats, slope: Floats, gram: Floats, least: Floats
) -> float:
    near: Nearest = (margin, -1, -1, -1, -1)
    a, b = t.pair_clusters[p, 0], t.pair_clusters[p, 1]
    u, v = w.ball[a], w.ball[b]
    apart = math.sqrt((u[0] - v[0]) ** 2 + (u[1] - v[1]) ** 2 + (u[2] - v[2]) ** 2)
    if a != b and apart - t.cluster_outer[a] - t.cluster_outer[b] >= margin:
        return 0.0
    open_cluster(t, w, q, a)
    open_cluster(t, w, q, b)
    first = t.pair_bodies[p, 0]
    for k in range(first, first + t.pair_bodies[p, 1]):
        near = nearest_of_two(t, w, t.bodies[k, 0], t.bodies[k, 1], near)
    if near[1] < 0:
        return 0.0
    least[1] = min(least[1], near[0])
    for i in range(len(row)):
        row[i] = 0.0
    gradient_of_two(t, w, near, row)
    for i in range(len(row)):
        row[i] /= margin
    return _add_clearance_cost((margin - near[0]) / margin, row, slope, gram)


@inlined
def clearance_costs(
    t: RobotArrays, s: SceneArrays, w: Work, q: Floats, margins: Floats, row: Floats, slope: Floats, gram: Floats,
    least: Floats,
) -> float:  # fmt: skip
    """Return half the sum of squared clearance_costs at a state; put gradient and lower half of the matrix into place.

    ``least`` (2,) is brought down to the clearances to the scene and of the robot to itself.
    """
    for i in range(len(slope)):
        slope[i] = 0.0
        for k in range(i + 1):
            gram[i, k] = 0.0
    place_robot(t, w, q)
    total = 0.0
    reach = margins[0]
    for c in range(len(t.cluster_joint)):
        if not t.cluster_meets_scene[c]:
            continue
        x, y, z = w.ball[c, 0], w.ball[c, 1], w.ball[c, 2]
        radius = t.cluster_outer[c] + reach
        k = 0
        while k < len(s.tree_skip):
            low, high = s.tree_low[k], s.tree_high[k]
            dx = max(low[0] - x, x - high[0], 0.0)
            dy = max(low[1] - y, y - high[1], 0.0)
            dz = max(low[2] - z, z - high[2], 0.0)
            if dx * dx + dy * dy + dz * dz > radius * radius:
                k = s.tree_skip[k]
                continue
            first = s.tree_range[k, 0]
            for o in range(first, first + s.tree_range[k, 1]):
                total += _to_scene(t, s, w, q, c, o, reach, row, slope, gram, least)
            k += 1
        for o in range(len(s.kind) - s.open[0], len(s.kind)):
            total += _to_scene(t, s, w, q, c, o, reach, row, slope, gram, least)
    for p in range(len(t.pair_common)):
        total += _of_pair(t, w, q, p, margins[1], row, slope, gram, least)
    return total
