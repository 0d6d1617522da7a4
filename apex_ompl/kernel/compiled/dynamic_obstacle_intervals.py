"""Times at which a ball that stands still may meet a dynamic obstacle, in closed form.

In the frame of the dynamic obstacle, at a time T behind its stamp, a ball's center is at p + u T, and the ball meets
the dynamic obstacle grown by the ball's radius and the margin, R(T) = R + g T with g the growth of the margin, 0 before
the stamp. The set of such T is an interval: the distance is convex in T, and R linear. For

- balls |p + u T| <= R(T) is a quadratic inequality;
- capsules it is the union of that for both ends and of that across the axis, as long as p + u T is between the ends;
- boxes |p_i + u_i T| <= h_i + R(T) are two linear inequalities an axis (slabs: a bound at edges and corners);
- cylinders the bound is that across the axis and a slab along it (at the rims);
- grids of distances the bound is the box of the grid.
"""

from __future__ import annotations

import math

from apex_ompl.kernel.compiled.arrays import BOX, CAPSULE, CYLINDER, GRID, SPHERE
from apex_ompl.kernel.compiled.compilation import inlined
from apex_ompl.kernel.compiled.dynamic_obstacles import DynamicArrays

NEVER = (math.inf, -math.inf)
STILL = 1e-15  # squared speed below which nothing moves [m^2/s^2]
ROUNDING = 1e-9  # added to radii [m]

Interval = tuple[float, float]


@inlined
def _below(a: float, b: float, within: Interval) -> Interval:
    """Return the part of an interval in which a + b T <= 0."""
    if b > 0.0:
        return within[0], min(within[1], -a / b)
    if b < 0.0:
        return max(within[0], -a / b), within[1]
    return within if a <= 0.0 else NEVER


@inlined
def _in_slab(p: float, u: float, half: float, growth: float, within: Interval) -> Interval:
    """Return the part of an interval in which |p + u T| <= half + growth T."""
    return _below(-p - half, -u - growth, _below(p - half, u - growth, within))


@inlined
def _in_ball(c: float, b: float, a: float, radius: float, growth: float, within: Interval) -> Interval:
    """Return the part of an interval in which |p + u T| <= radius + growth T; within T >= 0 where there is growth.

    Args:
        c: p . p.
        b: p . u.
        a: u . u.
        radius: See above.
        growth: See above.
        within: The interval.
    """
    a, b, c = a - growth * growth, b - radius * growth, c - radius * radius
    if abs(a) <= STILL:
        return _below(c, 2.0 * b, within)
    root = b * b - a * c
    if a < 0.0:
        if c <= 0.0:
            return within
        return max(within[0], (-b - math.sqrt(max(root, 0.0))) / a), within[1]
    if root < 0.0:
        return NEVER
    root = math.sqrt(root)
    return max(within[0], (-b - root) / a), min(within[1], (-b + root) / a)


@inlined
def _hull(one: Interval, other: Interval) -> Interval:
    """Return the smallest interval around two, of which either may be empty."""
    if one[0] > one[1]:
        return other
    if other[0] > other[1]:
        return one
    return min(one[0], other[0]), max(one[1], other[1])


@inlined
def _in_shape(
    m: DynamicArrays, o: int, p: tuple[float, float, float], u: tuple[float, float, float],
    radius: float, growth: float, within: Interval,
) -> Interval:  # fmt: skip
    """Return the part of an interval in which p + u T may be within radius + growth T of an obstacle, in its frame."""
    kind, size = m.kind[o], m.size[o]
    if kind == BOX:
        for i in range(3):
            within = _in_slab(p[i], u[i], size[i] + radius, growth, within)
        return within
    if kind == GRID:
        for i in range(3):
            half = 0.5 * size[0] * (m.grid[o, 1 + i] - 1)
            within = _in_slab(p[i] - half, u[i], half + radius, growth, within)
        return within
    c, b, a = p[0] * p[0] + p[1] * p[1], p[0] * u[0] + p[1] * u[1], u[0] * u[0] + u[1] * u[1]
    radius += size[0]
    if kind == SPHERE:
        return _in_ball(c + p[2] * p[2], b + p[2] * u[2], a + u[2] * u[2], radius, growth, within)
    across = _in_ball(c, b, a, radius, growth, within)
    if kind == CYLINDER:
        return _in_slab(p[2], u[2], size[1] + radius - size[0], growth, across)
    if kind != CAPSULE:
        return within
    found = _in_slab(p[2], u[2], size[1], 0.0, across)
    for end in (-size[1], size[1]):
        z = p[2] - end
        ball = _in_ball(c + z * z, b + z * u[2], a + u[2] * u[2], radius, growth, within)
        found = _hull(found, ball)
    return found


@inlined
def meeting_times(m: DynamicArrays, o: int, x: float, y: float, z: float, radius: float, within: Interval) -> Interval:
    """Return an interval that holds all times at which a ball may meet a dynamic obstacle.

    Args:
        m: The dynamic obstacles.
        o: Number of the dynamic obstacle.
        x: Center of the ball [m].
        y: The same.
        z: The same.
        radius: Of the ball [m].
        within: Interval of times, of the dynamic obstacles' stamps, that is looked at [s].

    Returns:
        First and last time; the first is after the last where they never meet.
    """
    r, stamp, margin = m.rotation[o], m.stamp[o], radius + m.growth[o, 0] + ROUNDING
    d, v = (x - m.place[o, 0], y - m.place[o, 1], z - m.place[o, 2]), m.velocity[o]
    p = (
        r[0, 0] * d[0] + r[1, 0] * d[1] + r[2, 0] * d[2],
        r[0, 1] * d[0] + r[1, 1] * d[1] + r[2, 1] * d[2],
        r[0, 2] * d[0] + r[1, 2] * d[1] + r[2, 2] * d[2],
    )
    u = (
        -r[0, 0] * v[0] - r[1, 0] * v[1] - r[2, 0] * v[2],
        -r[0, 1] * v[0] - r[1, 1] * v[1] - r[2, 1] * v[2],
        -r[0, 2] * v[0] - r[1, 2] * v[1] - r[2, 2] * v[2],
    )
    first, last = within[0] - stamp, within[1] - stamp
    found = NEVER
    if last >= 0.0:
        found = _in_shape(m, o, p, u, margin, m.growth[o, 1], (max(first, 0.0), last))
    if first < 0.0:
        found = _hull(found, _in_shape(m, o, p, u, margin, 0.0, (first, min(last, 0.0))))
    return found[0] + stamp, found[1] + stamp
