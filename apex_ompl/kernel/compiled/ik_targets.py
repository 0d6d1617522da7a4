"""Residuals and Jacobians of the targets of inverse kinematics.

A target has three vectors a, b, c, fixed to the frames of its joints (joint 0 is the world), a value and a weight. Its
residual, all in the world, is the weight times

- OFFSET: point b - point a - value * direction c, three numbers [m],
- OPPOSITION: direction a + value * direction b, three numbers,
- ANGLE: direction a . direction b - value, one number.
"""

from __future__ import annotations

from typing import Annotated, NamedTuple

from apex_ompl.kernel.compiled.arrays import FIXED, REVOLUTE, RobotArrays
from apex_ompl.kernel.compiled.compilation import inlined
from apex_ompl.kernel.compiled.layout import Floats, Integers, table_view
from apex_ompl.kernel.compiled.workspace import Workspace

OFFSET, OPPOSITION, ANGLE = range(3)


class TargetArrays(NamedTuple):
    """Arrays of targets, one row each.

    Attributes:
        kind: OFFSET, OPPOSITION or ANGLE.
        joints: Joints of a, b and c.
        vectors: Vectors a, b and c in their frames [m, or of length 1].
        value: The value.
        weight: The weight.
    """

    kind: Integers
    joints: Annotated[Integers, 3]
    vectors: Annotated[Floats, 3, 3]
    value: Floats
    weight: Floats


targets_view = table_view(TargetArrays)


@inlined
def _rotated(w: Workspace, j: int, v: Floats) -> tuple[float, float, float]:
    """Return a direction that is fixed to a joint's frame, in the world."""
    r = w.rotation[j]
    return (
        r[0, 0] * v[0] + r[0, 1] * v[1] + r[0, 2] * v[2],
        r[1, 0] * v[0] + r[1, 1] * v[1] + r[1, 2] * v[2],
        r[2, 0] * v[0] + r[2, 1] * v[1] + r[2, 2] * v[2],
    )


@inlined
def _add_columns(
    t: RobotArrays, w: Workspace, j: int, x: tuple[float, float, float], point: bool, f: float, row: Floats
) -> None:
    """Add f times the Jacobian of a point, or of a direction, that is fixed to a joint's frame to ``row`` (3, dof)."""
    while j > 0:
        kind = t.joint_kind[j]
        if kind != FIXED:
            r, o, k = w.rotation[j], w.origin[j], t.joint_source[j]
            scale = f * t.joint_ratio[j]
            if kind == REVOLUTE:
                u, v, z = x[0], x[1], x[2]
                if point:
                    u, v, z = u - o[0], v - o[1], z - o[2]
                row[0, k] += scale * (r[1, 2] * z - r[2, 2] * v)
                row[1, k] += scale * (r[2, 2] * u - r[0, 2] * z)
                row[2, k] += scale * (r[0, 2] * v - r[1, 2] * u)
            elif point:
                for i in range(3):
                    row[i, k] += scale * r[i, 2]
        j = t.joint_parent[j]


@inlined
def linearize(t: RobotArrays, w: Workspace, targets: TargetArrays, m: int, residual: Floats, row: Floats) -> int:
    """Put the residual of target ``m`` into ``residual`` (3,) and its Jacobian into ``row`` (3, dof).

    Returns:
        How many numbers the residual has.
    """
    for i in range(3):
        for k in range(row.shape[1]):
            row[i, k] = 0.0
    ja, jb, jc = targets.joints[m, 0], targets.joints[m, 1], targets.joints[m, 2]
    value, weight, vectors = targets.value[m], targets.weight[m], targets.vectors[m]
    a, b = _rotated(w, ja, vectors[0]), _rotated(w, jb, vectors[1])
    if targets.kind[m] == OFFSET:
        c = _rotated(w, jc, vectors[2])
        o, p = w.origin[ja], w.origin[jb]
        a = (a[0] + o[0], a[1] + o[1], a[2] + o[2])
        b = (b[0] + p[0], b[1] + p[1], b[2] + p[2])
        for i in range(3):
            residual[i] = weight * (b[i] - a[i] - value * c[i])
        _add_columns(t, w, ja, a, True, -weight, row)
        _add_columns(t, w, jb, b, True, weight, row)
        _add_columns(t, w, jc, c, False, -weight * value, row)
        return 3
    if targets.kind[m] == OPPOSITION:
        for i in range(3):
            residual[i] = weight * (a[i] + value * b[i])
        _add_columns(t, w, ja, a, False, weight, row)
        _add_columns(t, w, jb, b, False, weight * value, row)
        return 3
    residual[0] = weight * (a[0] * b[0] + a[1] * b[1] + a[2] * b[2] - value)
    # The Jacobian of a . b is b . Ja + a . Jb: the rows of Ja are summed in place.
    _add_columns(t, w, ja, a, False, weight, row)
    for k in range(row.shape[1]):
        row[0, k] = b[0] * row[0, k] + b[1] * row[1, k] + b[2] * row[2, k]
        row[1, k] = row[2, k] = 0.0
    _add_projected_columns(t, w, jb, b, a, weight, row)
    return 1


@inlined
def _add_projected_columns(
    t: RobotArrays,
    w: Workspace,
    j: int,
    x: tuple[float, float, float],
    n: tuple[float, float, float],
    f: float,
    row: Floats,
) -> None:
    """Add f n . J, J the Jacobian of a direction x fixed to a joint's frame, to the first row of ``row`` (3, dof)."""
    while j > 0:
        if t.joint_kind[j] == REVOLUTE:
            r = w.rotation[j]
            across = (
                r[1, 2] * x[2] - r[2, 2] * x[1],
                r[2, 2] * x[0] - r[0, 2] * x[2],
                r[0, 2] * x[1] - r[1, 2] * x[0],
            )
            part = n[0] * across[0] + n[1] * across[1] + n[2] * across[2]
            row[0, t.joint_source[j]] += f * t.joint_ratio[j] * part
        j = t.joint_parent[j]
