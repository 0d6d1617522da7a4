"""Residuals of constraints between two frames, with their Jacobians.

A group of rows is about a second frame B seen from a first one A; each is fixed to a joint (joint 0 is the world). Its
residual r, of one to three numbers, is

- POSITION: (axis i of A) . (p_B - p_A) - value_i for the first axes of A [m],
- AXIS: theta (x_A . z_B, y_A . z_B) / sin(theta), theta the angle between z_A and z_B, so that |r| = theta [rad],
- ROTATION: the rotation vector log(R_A^T R_B), so that |r| is the angle between the frames [rad].

A velocity of joint k, with axis z through o, moves B relative to A by the twist +-(z x (p_B - o), z), where joints
between A and what A and B have in common count as negative: a point of the second frame is carried backwards. The
Jacobians follow from this twist (v, w) in the axes of A: v for POSITION; for AXIS w x z_B through the chain rule; and
for ROTATION the inverse of the left Jacobian of SO(3) (Sola, Deray and Atchuthan 2018, equation 146)

    I - 1/2 [r] + (1 / theta^2 - (1 + cos theta) / (2 theta sin theta)) [r]^2.

A group with a dead zone ``slack`` above 0 has no rows where |r| <= slack, and else the row |r| - slack.
"""

from __future__ import annotations

import math
from typing import Annotated, NamedTuple

from apex_ompl.kernel.compiled.arrays import REVOLUTE, RobotArrays
from apex_ompl.kernel.compiled.compilation import inlined
from apex_ompl.kernel.compiled.layout import Floats, Integers, table_view
from apex_ompl.kernel.compiled.robot.kinematics import place_joints
from apex_ompl.kernel.compiled.workspace import Workspace

POSITION, AXIS, ROTATION = range(3)
NEAR_ZERO = 1e-4  # angle below which series take the place of quotients [rad]
NEAR_TURN = 1e-6  # sine below which an angle is pi or 0


class ConstraintArrays(NamedTuple):
    """Arrays of groups of rows, and of the joints that they depend on.

    Attributes:
        kind: POSITION, AXIS or ROTATION.
        rows: Number of rows of each group.
        joints: Joints that carry its first and its second frame.
        span: First of its links, and their number.
        chain: Joints that are placed, parents first.
        link: Joints that move the second frame relative to the first, from the second to the first.
        side: 1 for links that carry the second frame, -1 for those that carry the first.
        rotation: Rotations of the first and second frame in the frames of their joints, axes as columns.
        point: Their origins in these [m].
        value: Values of the rows.
        tolerance: Largest |r| with which the group holds.
        slack: Dead zone, 0 for none.
        scale: 1 for planned joints that may move, 0 for those that stay.
    """

    kind: Integers
    rows: Integers
    joints: Annotated[Integers, 2]
    span: Annotated[Integers, 2]
    chain: Integers
    link: Integers
    side: Floats
    rotation: Annotated[Floats, 2, 3, 3]
    point: Annotated[Floats, 2, 3]
    value: Annotated[Floats, 3]
    tolerance: Floats
    slack: Floats
    scale: Floats


constraints_view = table_view(ConstraintArrays)


class RowBuffers(NamedTuple):
    """Memory for rows and Newton steps, for at most M rows.

    Attributes:
        axes: Axes of the first and second frame of a group in the world, as columns.
        place: Their origins in the world [m].
        group: Residual of a group.
        residual: Residuals of all groups.
        jacobian: Their Jacobian.
        factor: Lower Cholesky factor.
        solution: Solution of the normal equations.
        blocked: Whether a joint stands at a limit that a step went against.
    """

    axes: Annotated[Floats, 2, 3, 3]
    place: Annotated[Floats, 2, 3]
    group: Annotated[Floats, 3]
    residual: Annotated[Floats, "rows"]
    jacobian: Annotated[Floats, "rows", "dof"]
    factor: Annotated[Floats, "rows", "rows"]
    solution: Annotated[Floats, "rows"]
    blocked: Annotated[Integers, "dof"]


@inlined
def place_frames(w: Workspace, c: ConstraintArrays, g: int, b: RowBuffers) -> None:
    """Put the frames of a group in the world into the buffers; the joints are placed."""
    for f in range(2):
        j = c.joints[g, f]
        r, o, own, at = w.rotation[j], w.origin[j], c.rotation[g, f], c.point[g, f]
        for i in range(3):
            b.place[f, i] = o[i] + r[i, 0] * at[0] + r[i, 1] * at[1] + r[i, 2] * at[2]
            for k in range(3):
                b.axes[f, i, k] = r[i, 0] * own[0, k] + r[i, 1] * own[1, k] + r[i, 2] * own[2, k]


@inlined
def dot_columns(a: Floats, i: int, b: Floats, k: int) -> float:
    """Return the product of column i of a matrix (3, 3) and column k of another one."""
    return float(a[0, i] * b[0, k] + a[1, i] * b[1, k] + a[2, i] * b[2, k])


@inlined
def angle_over_sine(sine: float, cosine: float) -> float:
    """Return theta / sin(theta)."""
    if sine < NEAR_ZERO and cosine > 0.0:
        return 1.0 + sine * sine / 6.0
    return math.atan2(sine, cosine) / sine


@inlined
def set_residual(c: ConstraintArrays, g: int, b: RowBuffers) -> tuple[float, float]:
    """Put the residual of a group, whose frames are placed, into ``b.group``; return sine and cosine of its angle."""
    first, second, r = b.axes[0], b.axes[1], b.group
    if c.kind[g] == POSITION:
        x, y, z = b.place[1, 0] - b.place[0, 0], b.place[1, 1] - b.place[0, 1], b.place[1, 2] - b.place[0, 2]
        for i in range(c.rows[g]):
            r[i] = first[0, i] * x + first[1, i] * y + first[2, i] * z - c.value[g, i]
        return 0.0, 1.0
    if c.kind[g] == AXIS:
        x, y, cosine = (
            dot_columns(first, 0, second, 2),
            dot_columns(first, 1, second, 2),
            dot_columns(first, 2, second, 2),
        )
        sine = math.sqrt(x * x + y * y)
        if sine < NEAR_TURN and cosine < 0.0:
            r[0], r[1] = math.pi, 0.0
            return sine, cosine
        f = angle_over_sine(sine, cosine)
        r[0], r[1] = f * x, f * y
        return sine, cosine
    x = 0.5 * (dot_columns(first, 2, second, 1) - dot_columns(first, 1, second, 2))
    y = 0.5 * (dot_columns(first, 0, second, 2) - dot_columns(first, 2, second, 0))
    z = 0.5 * (dot_columns(first, 1, second, 0) - dot_columns(first, 0, second, 1))
    trace = dot_columns(first, 0, second, 0) + dot_columns(first, 1, second, 1) + dot_columns(first, 2, second, 2)
    sine, cosine = math.sqrt(x * x + y * y + z * z), 0.5 * (trace - 1.0)
    if sine < NEAR_TURN and cosine < 0.0:  # half a turn: its axis is the largest column of R + I
        best = 0
        for i in range(1, 3):
            if dot_columns(first, i, second, i) > dot_columns(first, best, second, best):
                best = i
        size = math.sqrt(max(0.5 * (dot_columns(first, best, second, best) + 1.0), 1e-12))
        for i in range(3):
            entry = dot_columns(first, i, second, best) + (1.0 if i == best else 0.0)
            r[i] = math.pi * 0.5 * entry / size
        return sine, cosine
    f = angle_over_sine(sine, cosine)
    r[0], r[1], r[2] = f * x, f * y, f * z
    return sine, cosine


@inlined
def _twist(
    t: RobotArrays, w: Workspace, j: int, p: Floats
) -> tuple[float, float, float, float, float, float]:  # fmt: skip
    """Return velocity of a point p (3,) and angular velocity per unit of a joint's own value."""
    r, o = w.rotation[j], w.origin[j]
    x, y, z = r[0, 2], r[1, 2], r[2, 2]
    if t.joint_kind[j] != REVOLUTE:
        return x, y, z, 0.0, 0.0, 0.0
    u, v, q = p[0] - o[0], p[1] - o[1], p[2] - o[2]
    return y * q - z * v, z * u - x * q, x * v - y * u, x, y, z


@inlined
def _in_axes(a: Floats, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Return a vector of the world in the axes of a frame, the columns of a (3, 3)."""
    return (
        a[0, 0] * x + a[1, 0] * y + a[2, 0] * z,
        a[0, 1] * x + a[1, 1] * y + a[2, 1] * z,
        a[0, 2] * x + a[1, 2] * y + a[2, 2] * z,
    )


@inlined
def _add_group(
    t: RobotArrays, w: Workspace, c: ConstraintArrays, g: int, b: RowBuffers, sine: float, cosine: float, m: int
) -> None:
    """Put the Jacobian of a group, whose residual is in ``b.group``, into the rows from ``m`` on."""
    dof, rows, kind = b.jacobian.shape[1], c.rows[g], c.kind[g]
    for i in range(m, m + rows):
        for k in range(dof):
            b.jacobian[i, k] = 0.0
    first, second, r = b.axes[0], b.axes[1], b.group
    f = g3 = 0.0
    bx = by = 0.0
    if kind != POSITION:
        small = sine < NEAR_ZERO and cosine > 0.0
        safe = max(sine, NEAR_TURN)
        theta = math.atan2(sine, cosine)
        if kind == AXIS:
            bx, by = dot_columns(first, 0, second, 2), dot_columns(first, 1, second, 2)
            f = 1.0 if small else theta / safe
            g3 = 1.0 / 3.0 if small else (sine - theta * cosine) / (safe * safe * safe)
        else:
            g3 = 1.0 / 12.0 if small else 1.0 / (theta * theta) - (1.0 + cosine) / (2.0 * theta * safe)
    for n in range(c.span[g, 0], c.span[g, 0] + c.span[g, 1]):
        j = c.link[n]
        k = t.joint_source[j]
        s = c.side[n] * t.joint_ratio[j] * c.scale[k]
        if s == 0.0:
            continue
        vx, vy, vz, wx, wy, wz = _twist(t, w, j, b.place[1])
        if kind == POSITION:
            x, y, z = _in_axes(first, vx, vy, vz)
            b.jacobian[m, k] += s * x
            if rows > 1:
                b.jacobian[m + 1, k] += s * y
            if rows > 2:
                b.jacobian[m + 2, k] += s * z
        elif kind == AXIS:
            ax, ay, az = second[0, 2], second[1, 2], second[2, 2]
            x, y, z = _in_axes(first, wy * az - wz * ay, wz * ax - wx * az, wx * ay - wy * ax)
            b.jacobian[m, k] += s * (f * x - bx * g3 * z)
            b.jacobian[m + 1, k] += s * (f * y - by * g3 * z)
        else:
            x, y, z = _in_axes(first, wx, wy, wz)
            u, v, q = r[1] * z - r[2] * y, r[2] * x - r[0] * z, r[0] * y - r[1] * x
            b.jacobian[m, k] += s * (x - 0.5 * u + g3 * (r[1] * q - r[2] * v))
            b.jacobian[m + 1, k] += s * (y - 0.5 * v + g3 * (r[2] * u - r[0] * q))
            b.jacobian[m + 2, k] += s * (z - 0.5 * q + g3 * (r[0] * v - r[1] * u))


@inlined
def set_rows(t: RobotArrays, w: Workspace, q: Floats, c: ConstraintArrays, share: float, b: RowBuffers) -> int:
    """Put residuals and Jacobian of all groups at a state into the buffers; return the number of rows.

    Args:
        t: The robot.
        w: Workspace.
        q: The state.
        c: The groups.
        share: Factor on their dead zones.
        b: Buffers.
    """
    place_joints(t, w, q, c.chain, 0, len(c.chain))
    m, dof = 0, b.jacobian.shape[1]
    for g in range(len(c.kind)):
        place_frames(w, c, g, b)
        sine, cosine = set_residual(c, g, b)
        slack, size, rows = share * c.slack[g], 0.0, c.rows[g]
        for i in range(rows):
            size += b.group[i] * b.group[i]
        size = math.sqrt(size)
        if slack > 0.0 and size <= slack:
            continue
        _add_group(t, w, c, g, b, sine, cosine, m)
        if slack > 0.0:
            for k in range(dof):
                total = 0.0
                for i in range(rows):
                    total += b.group[i] * b.jacobian[m + i, k]
                b.jacobian[m, k] = total / size
            b.residual[m] = size - slack
            m += 1
        else:
            for i in range(rows):
                b.residual[m + i] = b.group[i]
            m += rows
    return m


@inlined
def group_norm(w: Workspace, c: ConstraintArrays, g: int, b: RowBuffers) -> float:
    """Return |r| of a group at the state whose joints are placed."""
    place_frames(w, c, g, b)
    set_residual(c, g, b)
    total = 0.0
    for i in range(c.rows[g]):
        total += b.group[i] * b.group[i]
    return math.sqrt(total)
