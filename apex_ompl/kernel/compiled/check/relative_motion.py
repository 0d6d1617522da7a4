"""Motion of one shape as seen from another during a motion around a state, to first order with a bounded remainder.

From the tip to the root the joints between two shapes form one chain: those of the moving side up to the lowest common
joint, then those of the other side down to its joint, whose motion counts with the opposite sign. Along this chain the
bounds are those of :mod:`.robot.motion_bound`, of adaptive collision checking (Schwarzer, Saha and
Latombe 2005) and of Taylor's theorem, for all points of a ball with center c and radius s around the moving shape:

    arm_i = |a_i x (c - o_i)| + s + m,
    velocity = sum_i step_i a_i x (c - o_i),    turn = sum_i step_i a_i.

To first order a point p of the shape moves by u (velocity + turn x (p - c)), u from -1 to 1. Let n be the unit normal
of a plane that separates the shapes, fixed to the other side. The distance of p to first order is linear in u, its
minimum over the shape concave, so that it is least at u = -1 or u = 1, where it follows from the support functions of
both shapes in the directions n -+ n x turn. Less the remainder, that bounds the distance of the shapes during the
whole motion.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from apex_ompl.kernel.compiled.arrays import FIXED, REVOLUTE
from apex_ompl.kernel.compiled.compilation import inlined, outlined
from apex_ompl.kernel.compiled.geometry.convex_distance import radius, support
from apex_ompl.kernel.compiled.geometry.shapes import Corners, PairBuffers, ShapeArrays, corners_of
from apex_ompl.kernel.compiled.layout import Floats, Integers


class Frames(NamedTuple):
    """Arrays of a robot and of the buffers of a state that bound the relative motion of pairs."""

    joint_parent: Integers
    joint_kind: Integers
    joint_source: Integers
    joint_ratio: Floats
    rotation: Floats
    origin: Floats
    step: Floats
    deviation: Floats
    half_width: Floats


@inlined
def place_shape(f: Frames, h: ShapeArrays, row: int, g: PairBuffers, s: int) -> None:
    """Place a shape on side ``s``, as the piece that is examined, with its ball."""
    j = h.joint[row]
    r, o, a, p, ball = f.rotation[j], f.origin[j], h.rotation[row], h.offset[row], h.ball[row]
    for i in range(3):
        g.origin[s, i] = o[i] + r[i, 0] * p[0] + r[i, 1] * p[1] + r[i, 2] * p[2]
        g.ball[s, i] = o[i] + r[i, 0] * ball[0] + r[i, 1] * ball[1] + r[i, 2] * ball[2]
        g.center[s, i], g.size[s, i] = g.origin[s, i], h.size[row, i]
        for k in range(3):
            g.rotation[s, i, k] = r[i, 0] * a[0, k] + r[i, 1] * a[1, k] + r[i, 2] * a[2, k]
    g.ball[s, 3] = ball[3]
    g.kind[s], g.first[s], g.corners[s] = h.kind[row], h.points_of[row, 0], h.points_of[row, 1]
    g.graph[s], g.at[s] = h.graph[row], 0


@inlined
def set_chain(f: Frames, g: PairBuffers, joint: int, other: int) -> tuple[int, int]:
    """Put the joints from ``joint`` to ``other`` into ``g.chain``, both ends included.

    Returns:
        How many belong to the side of ``joint``, and how many there are. Only the joint above all is left out.
    """
    a, b, count, below = joint, other, 0, 0
    while a != b:
        if a > b:
            g.chain[count] = a
            count += 1
            a = f.joint_parent[a]
        else:
            below += 1
            b = f.joint_parent[b]
    b = other
    for k in range(below):
        g.chain[count + below - 1 - k] = b
        b = f.joint_parent[b]
    return count, count + below


@outlined
def set_relative_motion(f: Frames, g: PairBuffers, s: int, joint: int, other: int) -> None:
    """Set velocity, turn and bounds of side ``s``, fixed to ``joint``, as seen from the other side's joint."""
    mine, count = set_chain(f, g, joint, other)
    x, y, z, spread = g.ball[s, 0], g.ball[s, 1], g.ball[s, 2], g.ball[s, 3]
    moved = deviated = levers = curvature = vx = vy = vz = ox = oy = oz = 0.0
    for i in range(count):
        j = g.chain[i]
        if f.joint_kind[j] == FIXED:
            continue
        k, ratio = f.joint_source[j], f.joint_ratio[j]
        width, deviation, step = abs(ratio) * f.half_width[k], abs(ratio) * f.deviation[k], ratio * f.step[k]
        if i >= mine:
            step = -step
        r, o = f.rotation[j], f.origin[j]
        ax, ay, az = r[0, 2], r[1, 2], r[2, 2]
        if f.joint_kind[j] == REVOLUTE:
            u, v, c = x - o[0], y - o[1], z - o[2]
            u, v, c = ay * c - az * v, az * u - ax * c, ax * v - ay * u
            arm = math.sqrt(u * u + v * v + c * c) + spread + moved
            vx, vy, vz = vx + step * u, vy + step * v, vz + step * c
            ox, oy, oz = ox + step * ax, oy + step * ay, oz + step * az
            curvature += abs(step) * (levers + 0.5 * abs(step) * arm)
            levers += abs(step) * arm
            deviated += deviation * (arm + deviated)
            moved += width * arm
        else:
            vx, vy, vz = vx + step * ax, vy + step * ay, vz + step * az
            levers += abs(step)
            deviated += deviation
            moved += width
    g.velocity[s, 0], g.velocity[s, 1], g.velocity[s, 2] = vx, vy, vz
    g.turn[s, 0], g.turn[s, 1], g.turn[s, 2] = ox, oy, oz
    g.arc_bound[s], g.remainder[s] = moved, deviated + curvature


@inlined
def _least(corners: Corners, g: PairBuffers, s: int, x: float, y: float, z: float) -> float:
    """Return the least value of direction . (p - c) over the piece of side ``s``, c the center of the side's ball."""
    p = support(corners, g, s, -x, -y, -z)
    c = g.ball[s]
    along = x * (p[0] - c[0]) + y * (p[1] - c[1]) + z * (p[2] - c[2])
    return float(along - radius(g, s) * math.sqrt(x * x + y * y + z * z))


@outlined
def distance_during_motion(
    corners: Corners, g: PairBuffers, s: int, x: float, y: float, z: float, offset: float
) -> float:
    """Return a lower bound of the distance of two pieces during the motion of ``g`` [m].

    Args:
        corners: Corners of hulls and triangles.
        g: The pieces and their motion.
        s: The moving side.
        x: Normal of a separating plane, fixed to the other side, towards the moving one.
        y: See ``x``.
        z: See ``x``.
        offset: Largest value of the normal over the other side [m]; infinite: to be computed here.
    """
    if math.isinf(offset):
        c = g.ball[1 - s]
        offset = x * c[0] + y * c[1] + z * c[2] - _least(corners, g, 1 - s, -x, -y, -z)
    o, v, c = g.turn[s], g.velocity[s], g.ball[s]
    middle = x * c[0] + y * c[1] + z * c[2] - offset
    along = x * v[0] + y * v[1] + z * v[2]
    u, p, q = y * o[2] - z * o[1], z * o[0] - x * o[2], x * o[1] - y * o[0]  # n x turn
    ahead = middle + along + _least(corners, g, s, x + u, y + p, z + q)
    backward = middle - along + _least(corners, g, s, x - u, y - p, z - q)
    return float(min(ahead, backward) - g.remainder[s])


@inlined
def half_space_distance(g: PairBuffers, h: ShapeArrays, row: int) -> tuple[float, float]:
    """Return the distance of side 0 to a half-space, a lower bound during the motion and its value now [m]."""
    n, offset, corners = h.offset[row], h.size[row, 0], corners_of(h)
    x, y, z = n[0], n[1], n[2]
    c = g.ball[0]
    now = x * c[0] + y * c[1] + z * c[2] - offset + _least(corners, g, 0, x, y, z)
    bound = distance_during_motion(corners, g, 0, x, y, z, offset)
    return max(bound, now - g.arc_bound[0]), now


@outlined
def convex_bound(corners: Corners, g: PairBuffers, distance: float) -> float:
    """Return a lower bound of the distance of two pieces during the motion, given a lower bound of it now [m].

    ``g.normal`` is the normal of a separating plane from side 0 to side 1.
    """
    x, y, z = g.normal[0], g.normal[1], g.normal[2]
    bound = distance - min(g.arc_bound[0], g.arc_bound[1])
    for s in range(2):
        x, y, z = -x, -y, -z
        bound = max(bound, distance_during_motion(corners, g, s, x, y, z, math.inf))
    return float(bound)
