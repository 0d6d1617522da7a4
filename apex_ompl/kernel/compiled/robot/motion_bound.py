"""Bounds on how far the spheres of clusters move during a motion around a state.

The states are q + u ``step`` + e with |u| <= 1 and |e_i| <= ``deviation_i``, so that they lie within ``half_width`` of
q. Joint i has the axis a_i through o_i at q. Two bounds are kept, relative to the frame of each joint above a cluster
and to the world; the smaller one holds.

``arc_bound`` is that of adaptive collision checking (Schwarzer, Saha and Latombe 2005), with the lever arms of the
state itself. From the tip to the root, with h_i the half width of joint i and arm_i = |a_i x (p - o_i)| + m:

    m <- m + h_i arm_i  (revolute)   or   m + h_i  (prismatic),

since a point that has moved by m stays within arm_i of the axis, and an arc is longer than its chord.

``linear`` and ``remainder`` are Taylor's theorem along u. A point p moves by at most |v| + 1/2 max |p''|, with

    v = sum_i step_i a_i x (p - o_i)  (revolute)   or   step_i a_i  (prismatic),
    |p''| <= sum_i arm_i |step_i| (|step_i| + 2 sum_k |step_k|),  k the revolute joints between the root and i,

the latter by the Jacobi identity; prismatic joints have arm 1 and no square of their own. The code sums from the tip:
``levers`` is the sum of |step_i| arm_i so far. ``linear`` is v of the center of the cluster's ball; the remainder adds
what differs for centers of spheres up to ``cluster_spread`` away, the deviation from the straight motion, which is
propagated as m is, and what moves inside the cluster.
"""

from __future__ import annotations

import math

from apex_ompl.kernel.compiled.arrays import FIXED, REVOLUTE, RobotArrays
from apex_ompl.kernel.compiled.compilation import inlined
from apex_ompl.kernel.compiled.workspace import Workspace


@inlined
def bound_displacements(t: RobotArrays, w: Workspace) -> None:
    """Bound the displacement of each cluster's spheres over ``w.step``, ``w.deviation`` and ``w.half_width``.

    ``w`` holds the frames of the state in the middle; ``w.arc_bound``, ``w.linear`` and ``w.remainder`` are set.
    """
    w.moving[0] = 1
    for c in range(len(t.cluster_joint)):
        j, dof, inner, spread = t.cluster_joint[c], t.cluster_dof[c], 0.0, t.cluster_spread[c]
        if dof >= 0:
            inner = t.cluster_speed[c] * w.half_width[dof]
        moved, deviated, levers, curvature = inner, 0.0, 0.0, 0.0
        vx = vy = vz = ox = oy = oz = 0.0
        while True:
            w.arc_bound[c, j] = moved
            w.linear[c, j, 0], w.linear[c, j, 1], w.linear[c, j, 2] = vx, vy, vz
            w.remainder[c, j] = inner + deviated + curvature + spread * math.sqrt(ox * ox + oy * oy + oz * oz)
            if j == 0:
                break
            kind = t.joint_kind[j]
            if kind != FIXED:
                k, ratio = t.joint_source[j], t.joint_ratio[j]
                width, deviation, step = abs(ratio) * w.half_width[k], abs(ratio) * w.deviation[k], ratio * w.step[k]
                r, o, p = w.rotation[j], w.origin[j], w.ball[c]
                ax, ay, az = r[0, 2], r[1, 2], r[2, 2]
                if kind == REVOLUTE:
                    x, y, z = p[0] - o[0], p[1] - o[1], p[2] - o[2]
                    x, y, z = ay * z - az * y, az * x - ax * z, ax * y - ay * x
                    arm = math.sqrt(x * x + y * y + z * z) + spread + moved
                    vx, vy, vz = vx + step * x, vy + step * y, vz + step * z
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
            j = t.joint_parent[j]


@inlined
def cluster_displacement(w: Workspace, c: int) -> float:
    """Return a bound on the displacement of a cluster's spheres in the world, plus the margin [m]."""
    if w.moving[0] == 0:
        return 0.0
    x, y, z = w.linear[c, 0, 0], w.linear[c, 0, 1], w.linear[c, 0, 2]
    return float(min(w.arc_bound[c, 0], math.sqrt(x * x + y * y + z * z) + w.remainder[c, 0]) + w.margin[0])


@inlined
def relative_displacement(w: Workspace, a: int, b: int, common: int) -> float:
    """Return a bound on the displacement of two clusters' spheres relative to each other, plus the margin [m].

    Both displacements are taken in the frame of ``common``, a joint above both.
    """
    if w.moving[0] == 0:
        return 0.0
    u, v = w.linear[a, common], w.linear[b, common]
    x, y, z = u[0] - v[0], u[1] - v[1], u[2] - v[2]
    straight = math.sqrt(x * x + y * y + z * z) + w.remainder[a, common] + w.remainder[b, common]
    return float(min(w.arc_bound[a, common] + w.arc_bound[b, common], straight) + w.margin[0])
