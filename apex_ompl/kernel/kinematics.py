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
def bound_motion(t: RobotArrays, w: Work, reach: Floats) -> None:
    """Bound how far the spheres of each cluster move, relative to each joint frame above, and to the world.

    ``reach`` (dof,) is how far each planned joint may be from the state that ``w`` holds. From the tips to the root:
    what moved by at most m relative to a joint's frame stays within (distance from the axis + m) of that axis, so
    that turning the joint by at most a moves it by at most a (distance + m), an arc being longer than its chord.
    This is the bound of adaptive collision checking (Schwarzer, Saha and Latombe 2005), with the lever arms of the
    state itself.
    """
    for c in range(len(t.cluster_joint)):
        j, dof, moved = t.cluster_joint[c], t.cluster_dof[c], 0.0
        if dof >= 0:
            moved = t.cluster_speed[c] * reach[dof]
        while j > 0:
            w.sway[c, j] = moved
            kind = t.joint_kind[j]
            if kind != FIXED:
                turn = abs(t.joint_ratio[j]) * reach[t.joint_source[j]]
                if kind == REVOLUTE:
                    moved += turn * (_lever(w, c, j) + t.cluster_spread[c] + moved)
                else:
                    moved += turn
            j = t.joint_parent[j]
        w.sway[c, 0] = moved


@inlined
def _lever(w: Work, c: int, j: int) -> float:
    """Return the distance of the centre of a cluster's ball from the axis of a joint."""
    r, o, p = w.turn[j], w.origin[j], w.ball[c]
    x, y, z = p[0] - o[0], p[1] - o[1], p[2] - o[2]
    along = r[0, 2] * x + r[1, 2] * y + r[2, 2] * z
    return math.sqrt(max(0.0, x * x + y * y + z * z - along * along))
