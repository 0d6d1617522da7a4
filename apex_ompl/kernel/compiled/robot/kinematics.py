"""Forward kinematics of joints, clusters and spheres, and the torques by which obstacles push the joints."""

from __future__ import annotations

from apex_ompl.kernel.compiled.arrays import BINS, FIXED, REVOLUTE, RobotArrays, robot_view
from apex_ompl.kernel.compiled.compilation import entry_point, inlined
from apex_ompl.kernel.compiled.layout import Floats, Integers
from apex_ompl.kernel.compiled.packet.sincos import set_sines
from apex_ompl.kernel.compiled.workspace import Workspace


@inlined
def place_joints(t: RobotArrays, w: Workspace, q: Floats, joints: Integers, first: int, count: int) -> None:
    """Place ``count`` of some joints, in their order, from the one at ``first`` on."""
    for k in range(count):
        j = joints[first + k]
        source = t.joint_source[j]
        w.angle[k] = t.joint_ratio[j] * q[source] + t.joint_shift[j] if source >= 0 else 0.0
    set_sines(w.angle, count, w.cosine, w.sine)
    for k in range(count):
        _place_joint(t, w, joints[first + k], w.angle[k], w.cosine[k], w.sine[k])


@inlined
def _place_joint(t: RobotArrays, w: Workspace, j: int, value: float, c: float, s: float) -> None:
    """Place one joint in the world: rotation R_parent R_j Rz(value), or Rz left out and the origin moved along z."""
    up, kind = t.joint_parent[j], t.joint_kind[j]
    a, b, r = w.rotation[up], t.joint_rotation[j], w.rotation[j]
    o = t.joint_offset[j]
    for i in range(3):
        w.origin[j, i] = w.origin[up, i] + a[i, 0] * o[0] + a[i, 1] * o[1] + a[i, 2] * o[2]
        for k in range(3):
            r[i, k] = a[i, 0] * b[0, k] + a[i, 1] * b[1, k] + a[i, 2] * b[2, k]
    if kind == FIXED:
        return
    if kind == REVOLUTE:
        for i in range(3):
            x, y = r[i, 0], r[i, 1]
            r[i, 0], r[i, 1] = c * x + s * y, c * y - s * x
    else:
        for i in range(3):
            w.origin[j, i] += r[i, 2] * value


@inlined
def place_robot(t: RobotArrays, w: Workspace, q: Floats) -> None:
    """Place all joints but the clusters' inner ones, and the clusters' balls; no part of one is opened yet."""
    place_joints(t, w, q, t.eager, 0, len(t.eager))
    for c in range(len(t.cluster_joint)):
        j = t.cluster_joint[c]
        r, ball = w.rotation[j], t.cluster_ball[c]
        for i in range(3):
            w.ball[c, i] = w.origin[j, i] + r[i, 0] * ball[0] + r[i, 1] * ball[1] + r[i, 2] * ball[2]
            w.ball_rows[i, c] = w.ball[c, i]
        w.ball_rows[3, c] = ball[3]
    for p in range(len(t.part_lazy)):
        w.opened[p] = 0


@inlined
def point_position(w: Workspace, j: int, c: Floats) -> tuple[float, float, float]:
    """Return the place in the world of a point, whose place in the frame of joint ``j`` is in ``c``, shape (3,) [m]."""
    r, o = w.rotation[j], w.origin[j]
    return (
        o[0] + r[0, 0] * c[0] + r[0, 1] * c[1] + r[0, 2] * c[2],
        o[1] + r[1, 0] * c[0] + r[1, 1] * c[1] + r[1, 2] * c[2],
        o[2] + r[2, 0] * c[0] + r[2, 1] * c[1] + r[2, 2] * c[2],
    )


@inlined
def node_position(t: RobotArrays, w: Workspace, j: int, n: int) -> tuple[float, float, float]:
    """Return the center of node ``n``, fixed to joint ``j``, in the world [m]."""
    return point_position(w, j, t.node_center[n])


@inlined
def place_part(t: RobotArrays, w: Workspace, q: Floats, p: int) -> None:
    """Place the inner joints of a part and the root spheres of its bodies, unless that was done at this state."""
    if w.opened[p]:
        return
    w.opened[p] = 1
    place_joints(t, w, q, t.lazy, t.part_lazy[p, 0], t.part_lazy[p, 1])
    first = t.part_bodies[p, 0]
    for b in range(first, first + t.part_bodies[p, 1]):
        w.root[b, 0], w.root[b, 1], w.root[b, 2] = node_position(t, w, t.body_joint[b], t.body_root[b])


@inlined
def place_cluster(t: RobotArrays, w: Workspace, q: Floats, c: int) -> None:
    """Place all parts of a cluster."""
    first = t.cluster_parts[c, 0]
    for p in range(first, first + t.cluster_parts[c, 1]):
        place_part(t, w, q, p)


@inlined
def bin_of(t: RobotArrays, q: Floats, c: int) -> int:
    """Return the range of values of the joint that drives a cluster's inner ones that a state is in, or 0."""
    k = t.cluster_dof[c]
    if k < 0:
        return 0
    x = (q[k] - t.cluster_range[c, 0]) * t.cluster_range[c, 1]
    if not x > 0.0:
        return 0
    return int(x) if x < BINS else BINS - 1


@inlined
def is_near_ball(
    t: RobotArrays, w: Workspace, radii: Floats, b: int, u: float, v: float, r: float, reach: float
) -> bool:
    """Whether leaves of a body, as spheres of ``radii``, are within ``reach`` of a point of the world."""
    j, top = t.body_joint[b], 1
    a, o = w.rotation[j], w.origin[j]
    u, v, r = u - o[0], v - o[1], r - o[2]
    x = a[0, 0] * u + a[1, 0] * v + a[2, 0] * r  # in the joint's frame, as the spheres are
    y = a[0, 1] * u + a[1, 1] * v + a[2, 1] * r
    z = a[0, 2] * u + a[1, 2] * v + a[2, 2] * r
    w.stack[0] = t.body_root[b]
    while top > 0:
        top -= 1
        n = w.stack[top]
        c, apart = t.node_center[n], radii[n] + reach
        if (x - c[0]) ** 2 + (y - c[1]) ** 2 + (z - c[2]) ** 2 > apart * apart:
            continue
        if t.node_count[n] == 0:
            return True
        for k in range(t.node_first[n], t.node_first[n] + t.node_count[n]):
            w.stack[top] = k
            top += 1
    return False


@inlined
def part_far(
    t: RobotArrays, w: Workspace, leaves: bool, c: int, p: int, k: int, u: float, v: float, r: float, reach: float
) -> bool:  # fmt: skip
    """Whether the ball of range ``k`` around part ``p`` of a cluster is farther than ``reach`` from a point."""
    x, y, z = point_position(w, t.cluster_joint[c], t.part_ball[p, k])
    apart = (t.part_outer[p, k] if leaves else t.part_ball[p, k, 3]) + reach
    return bool((x - u) ** 2 + (y - v) ** 2 + (z - r) ** 2 > apart * apart)


@inlined
def mark_near(
    t: RobotArrays, w: Workspace, q: Floats, leaves: bool, c: int, parts: int,
    u: float, v: float, r: float, reach: float,
) -> bool:  # fmt: skip
    """Mark the bodies of a cluster that are within ``reach`` of a point of the world; whether there are any.

    A body of a cluster of several is examined as its root sphere alone. What is not a number counts as near. Only the
    parts that are bits of ``parts`` are examined; those that are farther than their balls reach are not placed.
    """
    radii = t.node_outer if leaves else t.node_radius
    if t.cluster_bodies[c, 1] == 1:
        place_cluster(t, w, q, c)
        w.near[t.cluster_bodies[c, 0]] = 1
        return is_near_ball(t, w, radii, t.cluster_bodies[c, 0], u, v, r, reach)
    k, first, found = bin_of(t, q, c), t.cluster_parts[c, 0], False
    for m in range(t.cluster_parts[c, 1]):
        p = first + m
        away = not (parts >> m) & 1 or part_far(t, w, leaves, c, p, k, u, v, r, reach)
        if not away:
            place_part(t, w, q, p)
        for b in range(t.part_bodies[p, 0], t.part_bodies[p, 0] + t.part_bodies[p, 1]):
            far = away
            if not away:
                apart = radii[t.body_root[b]] + reach
                far = (w.root[b, 0] - u) ** 2 + (w.root[b, 1] - v) ** 2 + (w.root[b, 2] - r) ** 2 > apart * apart
            w.near[b] = 0 if far else 1
            found = found or not far
    return found


@inlined
def mark_pair(t: RobotArrays, w: Workspace, q: Floats, leaves: bool, p: int, reach: float) -> bool:
    """Mark the bodies of a pair of clusters that are near the ball around the other's; False where no two can be.

    A cluster with inner joints is placed last, and only where the other is near the ball around those of its bodies
    that the pair is about.

    Args:
        t: The robot.
        w: Workspace.
        q: The state.
        leaves: Whether the balls are those around leaf spheres, else those around the solids.
        p: The pair.
        reach: Distance of spheres within which they are near [m].
    """
    first = 0 if t.cluster_lazy[t.pair_clusters[p, 0], 1] <= t.cluster_lazy[t.pair_clusters[p, 1], 1] else 1
    a, b = t.pair_clusters[p, first], t.pair_clusters[p, 1 - first]
    x, y, z = w.ball[b, 0], w.ball[b, 1], w.ball[b, 2]
    if t.cluster_lazy[b, 1] > 0:
        x, y, z = point_position(w, t.cluster_joint[b], t.pair_ball[p, 1 - first])
    radius = t.pair_outer[p, 1 - first] if leaves else t.pair_ball[p, 1 - first, 3]
    if not mark_near(t, w, q, leaves, a, t.pair_parts[p, first], x, y, z, radius + reach):
        return False
    x, y, z = w.ball[a, 0], w.ball[a, 1], w.ball[a, 2]
    if t.cluster_lazy[a, 1] > 0:
        x, y, z = point_position(w, t.cluster_joint[a], t.pair_ball[p, first])
    radius = t.pair_outer[p, first] if leaves else t.pair_ball[p, first, 3]
    return mark_near(t, w, q, leaves, b, t.pair_parts[p, 1 - first], x, y, z, radius + reach)


@entry_point
def joint_pushes(
    ri: Integers, rf: Floats, rotation: Floats, origin: Floats, carriers: Integers, points: Floats, distances: Floats,
    gradients: Floats, reach: float, pushed: Floats,
) -> None:  # fmt: skip
    """Put generalized forces of the nearest obstacles at N states into ``pushed``, shape (N, dof) [m].

    A point p at distance d is pushed by f = max(0, 1 - d / reach) along the gradient of its distance. A joint of axis z
    through o gets the sum of z . ((p - o) x f) over the points that it moves, or of z . f where it slides: the
    transposed Jacobians times the forces.

    Args:
        ri: Integers of the robot.
        rf: Floats of the robot.
        rotation: Frames of all joints, axes along z, shape (N, J, 3, 3).
        origin: Their origins, shape (N, J, 3) [m].
        carriers: Joints that carry the P points, shape (P,).
        points: The points in the world, shape (N, P, 3) [m].
        distances: Their signed distances from the nearest obstacles, shape (N, P) [m].
        gradients: The gradients of these, shape (N, P, 3).
        reach: Distance from which on a point is not pushed [m].
        pushed: Shape (N, dof).
    """
    t = robot_view(ri, rf)
    for n in range(len(points)):
        for i in range(pushed.shape[1]):
            pushed[n, i] = 0.0
        for p in range(len(carriers)):
            force = 1.0 - distances[n, p] / reach
            if not force > 0.0:
                continue
            u, v, w = force * gradients[n, p, 0], force * gradients[n, p, 1], force * gradients[n, p, 2]
            j = carriers[p]
            while j > 0:
                if t.joint_kind[j] != FIXED:
                    x, y, z = rotation[n, j, 0, 2], rotation[n, j, 1, 2], rotation[n, j, 2, 2]
                    if t.joint_kind[j] == REVOLUTE:
                        a, b = points[n, p, 0] - origin[n, j, 0], points[n, p, 1] - origin[n, j, 1]
                        c = points[n, p, 2] - origin[n, j, 2]
                        along = x * (b * w - c * v) + y * (c * u - a * w) + z * (a * v - b * u)
                    else:
                        along = x * u + y * v + z * w
                    pushed[n, t.joint_source[j]] += t.joint_ratio[j] * along
                j = t.joint_parent[j]
