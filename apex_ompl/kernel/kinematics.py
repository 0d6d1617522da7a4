"""Inside the kernel: forward kinematics, and bounds on how far clusters move."""

from __future__ import annotations

import math

from apex_ompl.kernel.compiled import inlined
from apex_ompl.kernel.tables import FIXED, REVOLUTE, Floats, RobotArrays
from apex_ompl.kernel.views import Work


@inlined
def place_joint(t: RobotArrays, w: Work, q: Floats, j: int) -> None:
    """Place one joint in the world, from its parent."""
    up, kind = t.joint_parent[j], t.joint_kind[j]
    a, b, r = w.turn[up], t.joint_rotation[j], w.turn[j]
    o = t.joint_offset[j]
    for i in range(3):
        w.origin[j, i] = w.origin[up, i] + a[i, 0] * o[0] + a[i, 1] * o[1] + a[i, 2] * o[2]
        for k in range(3):
            r[i, k] = a[i, 0] * b[0, k] + a[i, 1] * b[1, k] + a[i, 2] * b[2, k]
    if kind == FIXED:
        return
    value = t.joint_ratio[j] * q[t.joint_source[j]] + t.joint_shift[j]
    if kind == REVOLUTE:
        c, s = math.cos(value), math.sin(value)
        for i in range(3):
            x, y = r[i, 0], r[i, 1]
            r[i, 0], r[i, 1] = c * x + s * y, c * y - s * x
    else:
        for i in range(3):
            w.origin[j, i] += r[i, 2] * value


@inlined
def place_robot(t: RobotArrays, w: Work, q: Floats) -> None:
    """Place all joints but the clusters' inner ones, and the clusters' balls."""
    for j in t.eager:
        place_joint(t, w, q, j)
    for c in range(len(t.cluster_joint)):
        j = t.cluster_joint[c]
        r, ball = w.turn[j], t.cluster_ball[c]
        for i in range(3):
            w.ball[c, i] = w.origin[j, i] + r[i, 0] * ball[0] + r[i, 1] * ball[1] + r[i, 2] * ball[2]
        w.opened[c] = 0


@inlined
def node_x(t: RobotArrays, w: Work, j: int, n: int) -> tuple[float, float, float]:
    """Return the centre of a node that hangs on a joint, in the world."""
    r, o, c = w.turn[j], w.origin[j], t.node_centre[n]
    return (
        o[0] + r[0, 0] * c[0] + r[0, 1] * c[1] + r[0, 2] * c[2],
        o[1] + r[1, 0] * c[0] + r[1, 1] * c[1] + r[1, 2] * c[2],
        o[2] + r[2, 0] * c[0] + r[2, 1] * c[1] + r[2, 2] * c[2],
    )


@inlined
def open_cluster(t: RobotArrays, w: Work, q: Floats, c: int) -> None:
    """Place a cluster's inner joints and the outermost spheres of its bodies, unless that was done."""
    if w.opened[c]:
        return
    w.opened[c] = 1
    first = t.cluster_lazy[c, 0]
    for k in range(first, first + t.cluster_lazy[c, 1]):
        place_joint(t, w, q, t.lazy[k])
    first = t.cluster_bodies[c, 0]
    for b in range(first, first + t.cluster_bodies[c, 1]):
        w.root[b, 0], w.root[b, 1], w.root[b, 2] = node_x(t, w, t.body_joint[b], t.body_root[b])


@inlined
def bound_motion(t: RobotArrays, w: Work) -> None:
    """Bound how far the spheres of each cluster move, relative to the frame of each joint above, and to the world.

    States are within ``w.reach`` of the one that ``w`` holds, and within ``w.stray`` of the straight motion through it
    that goes by ``w.step`` to both sides, (dof,) each. From the tips to the root, with the joints beyond the frame of
    a joint; two bounds are kept, of which the smaller one holds.

    ``sway``: what moved by at most m relative to a joint's frame stays within (distance from the axis + m) of that
    axis, so that turning the joint by at most a moves it by at most a (distance + m), an arc being longer than its
    chord. This is the bound of adaptive collision checking (Schwarzer, Saha and Latombe 2005), with the lever arms of
    the state itself.

    ``drift`` and ``rest``: by Taylor's theorem a point p moves by at most the length of its velocity, the sum of
    step_i a_i x (p - o_i), and half of its largest acceleration. With the Jacobi identity the acceleration is at most
    the sum of 2 step_i arm_i (the steps of the turning joints below i, and half of step_i), where arm_i bounds the
    distance of p from the axis a_i all along. The stray adds to it as in ``sway``, and so does what moves inside a
    cluster.
    """
    w.flags[0] = 1
    for c in range(len(t.cluster_joint)):
        j, dof, inner, spread = t.cluster_joint[c], t.cluster_dof[c], 0.0, t.cluster_spread[c]
        if dof >= 0:
            inner = t.cluster_speed[c] * w.reach[dof]
        moved, strayed, levers, bend = inner, 0.0, 0.0, 0.0
        vx = vy = vz = ox = oy = oz = 0.0
        while True:
            w.sway[c, j] = moved
            w.drift[c, j, 0], w.drift[c, j, 1], w.drift[c, j, 2] = vx, vy, vz
            w.rest[c, j] = inner + strayed + bend + spread * math.sqrt(ox * ox + oy * oy + oz * oz)
            if j == 0:
                break
            kind = t.joint_kind[j]
            if kind != FIXED:
                k, ratio = t.joint_source[j], t.joint_ratio[j]
                reach, stray, step = abs(ratio) * w.reach[k], abs(ratio) * w.stray[k], ratio * w.step[k]
                r, o, p = w.turn[j], w.origin[j], w.ball[c]
                ax, ay, az = r[0, 2], r[1, 2], r[2, 2]
                if kind == REVOLUTE:
                    x, y, z = p[0] - o[0], p[1] - o[1], p[2] - o[2]
                    x, y, z = ay * z - az * y, az * x - ax * z, ax * y - ay * x
                    arm = math.sqrt(x * x + y * y + z * z) + spread + moved
                    vx, vy, vz = vx + step * x, vy + step * y, vz + step * z
                    ox, oy, oz = ox + step * ax, oy + step * ay, oz + step * az
                    bend += abs(step) * (levers + 0.5 * abs(step) * arm)
                    levers += abs(step) * arm
                    strayed += stray * (arm + strayed)
                    moved += reach * arm
                else:
                    vx, vy, vz = vx + step * ax, vy + step * ay, vz + step * az
                    levers += abs(step)
                    strayed += stray
                    moved += reach
            j = t.joint_parent[j]


@inlined
def cluster_sway(w: Work, c: int) -> float:
    """Return how far the spheres of a cluster move at most in the world."""
    if w.flags[0] == 0:
        return 0.0
    x, y, z = w.drift[c, 0, 0], w.drift[c, 0, 1], w.drift[c, 0, 2]
    return float(min(w.sway[c, 0], math.sqrt(x * x + y * y + z * z) + w.rest[c, 0]))


@inlined
def pair_sway(w: Work, a: int, b: int, common: int) -> float:
    """Return how far the spheres of two clusters move at most relative to each other."""
    if w.flags[0] == 0:
        return 0.0
    u, v = w.drift[a, common], w.drift[b, common]
    x, y, z = u[0] - v[0], u[1] - v[1], u[2] - v[2]
    straight = math.sqrt(x * x + y * y + z * z) + w.rest[a, common] + w.rest[b, common]
    return float(min(w.sway[a, common] + w.sway[b, common], straight))
