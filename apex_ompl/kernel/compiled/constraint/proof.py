"""Proof that constraints are kept along a whole curve, by bisection of its pieces.

A piece is a cubic q(x) in its share x from 0 to 1, or a straight line. On an interval of half width h around a share m,
with x = m + u h and |u| <= 1, its states are

    q = q_m + delta,   delta = u s + u^2 b + u^3 c + e,   |e_i| <= d_i,

s, b and c the derivatives of Taylor's theorem, d rounding and gaps between pieces, so that |delta_i| <= w_i =
|s_i| + |b_i| + |c_i| + d_i. The links of a group are one serial chain from A to B, whose joints are numbered from A.
<<<<<<< HEAD
Let y be the place of B, its z axis, or twice the vector part of its quaternion, each seen from A. On this box, for
=======
Let y be the place p of B, its z axis, or twice the vector part of its quaternion, each seen from A, and a_i the axis of
joint i through o_i, all at q_m. With
>>>>>>> conproof

    far_i = |a_i x (p - o_i)|  (for the z axis |a_i x z|; for prismatic joints 1, and 0 for the z axis),
    m_i = sum of w_k far_k over k > i,

products of exponentials show that y moves by at most m_0 on this box, and that

    |y(q) - y_m - J delta| <= sum of w_i (w_i far_i / 2 + m_i) over revolute joints.

<<<<<<< HEAD
the inner sum over revolute joints k < i, the first term for revolute joints i alone. For the quaternion the sum is
sum_i (v w_i^2 / 2 + w_i sum_{k < i} w_k), v >= |vector part| on the box. J delta is u J s + u^2 J b + u^3 J c + J e,
and a norm is convex: it is largest at u = +-1 and u^2 = 0 or 1 as if these were independent. So |y| is at most
=======
For the quaternion it is sum_i w_i (w_i |y_m| / 8 + w_i^2 / 24 + m_i / 2) with far_i = 1. J delta is
u J s + u^2 J b + u^3 J c + J e, and a norm is convex: it is largest at u = +-1 and u^2 = 0 or 1 as if these were
independent. So |y| is at most
>>>>>>> conproof

    max |y_m +- J s + {0, 1} J b| + |J c| + sum_i d_i far_i + the remainder above,

which is a bound on |r| for POSITION, on sin(theta) for AXIS where z_A . z_B, bounded in the same way, is positive, and
on 2 sin(theta / 2) for ROTATION. Another bound is |r| <= |r_m| + m_0. The derivation is in docs/constraints.md.
"""

from __future__ import annotations

import math
from typing import Annotated, NamedTuple

from apex_ompl.kernel.compiled.arrays import REVOLUTE, RobotArrays, robot_view
from apex_ompl.kernel.compiled.compilation import entry_point, inlined
from apex_ompl.kernel.compiled.constraint.projection import rows_view
from apex_ompl.kernel.compiled.constraint.rows import (
    AXIS,
    POSITION,
    ROTATION,
    ConstraintArrays,
    RowBuffers,
    angle_over_sine,
    constraints_view,
    place_frames,
    set_residual,
)
from apex_ompl.kernel.compiled.layout import Floats, Integers, buffer_view
from apex_ompl.kernel.compiled.robot.kinematics import place_joints
from apex_ompl.kernel.compiled.workspace import Workspace, workspace_view

PROVED, VIOLATED, UNDECIDED, INVALID = range(4)  # outcomes
TIGHT = 0.25  # share of a tolerance by which bounds may exceed |r|, while intervals are few
ROUNDING = 1e-12  # of states and residuals, for frames within some 100 m
DEEPEST = 40  # bisections of a piece
INTERVALS, MORE_INTERVALS = 20_000, 100  # most intervals: so many, and so many for each piece
LEAST_COSINE = -0.9  # of a turn whose quaternion is taken from its rotation vector


class ConstraintProofBuffers(NamedTuple):
    """Memory and results of a proof.

    Attributes:
        counts: Intervals examined, and piece and group at which the proof failed, -1 for none.
        figures: Share of the piece at which it failed, and |r| there.
        bounds: Largest proved bounds of the groups [m, rad].
        violations: Largest |r| of the groups at examined states [m, rad].
        found: Bounds of the groups on an interval.
        stack: Intervals of the piece that wait: their start and end as shares.
        cubic: Coefficients of the piece by powers of the share.
        state: State in the middle of an interval.
        rates: Vectors s, b and c.
        deviation: Bounds d on the rest.
        width: Bounds w on all.
        linear: Images of s, b and c under the Jacobian.
        center: Value of y in the middle.
    """

    counts: Annotated[Integers, 3]
    figures: Annotated[Floats, 2]
    bounds: Annotated[Floats, "groups"]
    violations: Annotated[Floats, "groups"]
    found: Annotated[Floats, "groups"]
    stack: Annotated[Floats, DEEPEST + 2, 2]
    cubic: Annotated[Floats, 4, "dof"]
    state: Annotated[Floats, "dof"]
    rates: Annotated[Floats, 3, "dof"]
    deviation: Annotated[Floats, "dof"]
    width: Annotated[Floats, "dof"]
    linear: Annotated[Floats, 3, 3]
    center: Annotated[Floats, 3]


_proof_view = buffer_view(ConstraintProofBuffers, ("groups", "dof"))


class Sweep(NamedTuple):
    """Sums over the links of a group, from its second frame to its first.

    Attributes:
        moved: Sum m_0 of w_i far_i.
        crossed: Sum of w_i m_i over revolute joints.
        squared: Sum of w_i^2 far_i over revolute joints.
        deviated: Sum of d_i far_i.
    """

    moved: float
    crossed: float
    squared: float
    deviated: float


@inlined
def _sweep(
    t: RobotArrays, w: Workspace, c: ConstraintArrays, g: int, p: ConstraintProofBuffers,
    x: float, y: float, z: float,
) -> Sweep:  # fmt: skip
    """Sum up the links of a group, and put the images of s, b and c into ``p.linear``, in the axes of the world.

    ``x``, ``y`` and ``z`` are the place of the second frame for POSITION and its z axis for AXIS. The images are
    velocities of that place, changes of that axis, and angular velocities for ROTATION.
    """
    kind, linear = c.kind[g], p.linear
    moved = crossed = squared = deviated = 0.0
    for m in range(3):
        linear[m, 0] = linear[m, 1] = linear[m, 2] = 0.0
    for n in range(c.span[g, 0], c.span[g, 0] + c.span[g, 1]):
        j = c.link[n]
        k, ratio = t.joint_source[j], t.joint_ratio[j]
        r, o = w.rotation[j], w.origin[j]
        turns = t.joint_kind[j] == REVOLUTE
        if not turns and kind != POSITION:
            continue
        u, v, q, far = r[0, 2], r[1, 2], r[2, 2], 1.0
        if turns and kind != ROTATION:
            e, f, h = x, y, z
            if kind == POSITION:
                e, f, h = x - o[0], y - o[1], z - o[2]
            u, v, q = v * h - q * f, q * e - u * h, u * f - v * e
            far = math.sqrt(u * u + v * v + q * q)
        width = abs(ratio) * p.width[k]
        if turns:
            crossed += width * moved
            squared += width * width * far
        deviated += abs(ratio) * p.deviation[k] * far
        moved += width * far
        for m in range(3):
            factor = c.side[n] * ratio * p.rates[m, k]
            linear[m, 0] += factor * u
            linear[m, 1] += factor * v
            linear[m, 2] += factor * q
    return Sweep(moved, crossed, squared, deviated)


@inlined
def _to_axes(p: ConstraintProofBuffers, axes: Floats) -> None:
    """Turn the images of s, b and c into the axes of a frame, the columns of a (3, 3)."""
    for m in range(3):
        x, y, z = p.linear[m, 0], p.linear[m, 1], p.linear[m, 2]
        for i in range(3):
            p.linear[m, i] = axes[0, i] * x + axes[1, i] * y + axes[2, i] * z


@inlined
def _largest(p: ConstraintProofBuffers, rows: int) -> float:
    """Return max |y_m +- J s + {0, 1} J b| + |J c| for the first rows of y."""
    most = rest = 0.0
    for corner in range(4):
        total = 0.0
        for i in range(rows):
            value = p.center[i] + (p.linear[0, i] if corner < 2 else -p.linear[0, i])
            value += p.linear[1, i] if corner % 2 == 1 else 0.0
            total += value * value
        most = max(most, total)
    for i in range(rows):
        rest += p.linear[2, i] * p.linear[2, i]
    return math.sqrt(most) + math.sqrt(rest)


@inlined
def _angle_bound(p: ConstraintProofBuffers, rest: float) -> float:
    """Return a bound on the angle of an AXIS, whose sine differs from its linear part by at most ``rest``."""
    bound = math.pi
    cosine = p.center[2] - abs(p.linear[0, 2]) + min(p.linear[1, 2], 0.0) - abs(p.linear[2, 2]) - rest
    if cosine > -1.0:
        bound = math.atan2(math.sqrt(max(1.0 - cosine * cosine, 0.0)), cosine)
    sine = _largest(p, 2) + rest
    if cosine > 0.0 and sine < 1.0:
        bound = min(bound, math.atan2(sine, math.sqrt(1.0 - sine * sine)))
    return bound


@inlined
def _turn_bound(
    p: ConstraintProofBuffers, b: RowBuffers, sweep: Sweep, sine: float, cosine: float
) -> float:  # fmt: skip
    """Return a bound on the angle of a ROTATION, whose sine and cosine in the middle are given, residual in ``b``."""
    if cosine < LEAST_COSINE:
        return math.pi
    half = math.sqrt(0.5 * (1.0 + cosine))
    scale = 1.0 / (angle_over_sine(sine, cosine) * half)
    for i in range(3):
        p.center[i] = scale * b.group[i]
    x, y, z = 0.5 * p.center[0], 0.5 * p.center[1], 0.5 * p.center[2]
    for m in range(3):
        u, v, q = p.linear[m, 0], p.linear[m, 1], p.linear[m, 2]
        p.linear[m, 0] = half * u + v * z - q * y
        p.linear[m, 1] = half * v + q * x - u * z
        p.linear[m, 2] = half * q + u * y - v * x
    now = 2.0 * math.sqrt(x * x + y * y + z * z)
    rest = 0.5 * sweep.crossed + sweep.squared * (now / 8.0 + sweep.moved / 24.0)  # w_i^3 <= w_i^2 m_0
    chord = 0.5 * (_largest(p, 3) + sweep.deviated + rest + ROUNDING)
    return 2.0 * math.atan2(chord, math.sqrt(1.0 - chord * chord)) if chord < 1.0 else math.pi


@inlined
def bound_group(
    t: RobotArrays, w: Workspace, c: ConstraintArrays, g: int, p: ConstraintProofBuffers, b: RowBuffers
) -> tuple[float, float]:  # fmt: skip
    """Return |r| of a group at the state in the middle, whose joints are placed, and a bound on the interval around it.

    The interval is in ``p.rates``, ``p.deviation`` and ``p.width``. What is not a number gives no number.
    """
    place_frames(w, c, g, b)
    sine, cosine = set_residual(c, g, b)
    first, second, size = b.axes[0], b.axes[1], 0.0
    for i in range(c.rows[g]):
        size += b.group[i] * b.group[i]
    size = math.sqrt(size)
    kind = c.kind[g]
    if kind == AXIS:
        x, y, z = second[0, 2], second[1, 2], second[2, 2]
        for i in range(3):
            p.center[i] = first[0, i] * x + first[1, i] * y + first[2, i] * z
    else:
        x, y, z = b.place[1, 0], b.place[1, 1], b.place[1, 2]
    sweep = _sweep(t, w, c, g, p, x, y, z)
    _to_axes(p, first)
    bound, rest = size + sweep.moved, sweep.deviated + sweep.crossed + 0.5 * sweep.squared
    if kind == POSITION:
        for i in range(c.rows[g]):
            p.center[i] = b.group[i]
        bound = min(bound, _largest(p, c.rows[g]) + rest)
    elif kind == AXIS:
        bound = min(bound, _angle_bound(p, rest + ROUNDING))
    else:
        bound = min(bound, _turn_bound(p, b, sweep, sine, cosine))
    return size, bound + ROUNDING


@inlined
def _set_piece(
    times: Floats, states: Floats, velocities: Floats, accelerations: Floats, k: int, p: ConstraintProofBuffers
) -> bool:
    """Set coefficients and deviations of piece ``k``; false where they are no numbers, or its end is before its start.

    The gap to the state and velocity at its end counts as deviation.
    """
    following = min(k + 1, len(states) - 1)
    total = 0.0
    for i in range(len(p.state)):
        q, gap = states[k, i], 0.0
        p.cubic[0, i], p.cubic[2, i], p.cubic[3, i] = q, 0.0, 0.0
        if len(velocities) == 0:
            p.cubic[1, i] = states[following, i] - q
        else:
            long, a = times[following] - times[k], accelerations[k, i]
            if not long >= 0.0:
                return False
            p.cubic[1, i] = long * velocities[k, i]
            p.cubic[2, i] = 0.5 * long * long * a
            p.cubic[3, i] = long * long * (accelerations[following, i] - a) / 6.0
            gap = abs(q + p.cubic[1, i] + p.cubic[2, i] + p.cubic[3, i] - states[following, i])
            end = p.cubic[1, i] + 2.0 * p.cubic[2, i] + 3.0 * p.cubic[3, i]
            gap += abs(end - long * velocities[following, i])
        p.deviation[i] = gap + ROUNDING
        total += abs(q) + abs(states[following, i]) + abs(p.cubic[1, i]) + abs(p.cubic[2, i]) + abs(p.cubic[3, i]) + gap
    return total < math.inf


@inlined
def _set_interval(middle: float, half: float, p: ConstraintProofBuffers) -> None:
    """Set state, derivatives and widths for the interval of half width ``half`` around a share of the piece."""
    for i in range(len(p.state)):
        v, a, jerk = p.cubic[1, i], p.cubic[2, i], p.cubic[3, i]
        p.state[i] = p.cubic[0, i] + middle * (v + middle * (a + middle * jerk))
        s = half * (v + middle * (2.0 * a + 3.0 * middle * jerk))
        b = half * half * (a + 3.0 * middle * jerk)
        c = half * half * half * jerk
        p.rates[0, i], p.rates[1, i], p.rates[2, i] = s, b, c
        p.width[i] = abs(s) + abs(b) + abs(c) + p.deviation[i]


@inlined
def _examine(
    t: RobotArrays, w: Workspace, c: ConstraintArrays, p: ConstraintProofBuffers, b: RowBuffers, tight: bool
) -> tuple[int, int, float]:
    """Return outcome, failing group and its |r| for the interval that is set; UNDECIDED where it is to be bisected.

    Where it is to be ``tight``, a bound is at most a share TIGHT of the tolerance above |r| in the middle.
    """
    place_joints(t, w, p.state, c.chain, 0, len(c.chain))
    for g in range(len(c.kind)):
        size, bound = bound_group(t, w, c, g, p, b)
        p.violations[g] = max(p.violations[g], size)
        if not size <= c.tolerance[g]:
            return VIOLATED, g, size
        if not bound <= (min(c.tolerance[g], size + TIGHT * c.tolerance[g]) if tight else c.tolerance[g]):
            return UNDECIDED, g, size
        p.found[g] = bound
    for g in range(len(c.kind)):
        p.bounds[g] = max(p.bounds[g], p.found[g])
    return PROVED, -1, 0.0


@entry_point
def prove_constraints(
    ri: Integers, rf: Floats, wi: Integers, wf: Floats, ci: Integers, cf: Floats,
    times: Floats, states: Floats, velocities: Floats, accelerations: Floats,
    bi: Integers, bf: Floats, rows: int, pi: Integers, pf: Floats,
) -> int:  # fmt: skip
    """Prove that |r| <= tolerance for all groups along a curve.

    Args:
        ri: Robot, packed; see :func:`apex_ompl.kernel.compiled.layout.pack`.
        rf: Robot.
        wi: Workspace.
        wf: Workspace.
        ci: Groups of rows, packed.
        cf: Groups of rows.
        times: Times of the states of a motion of constant jerk between them, shape (N,); none for straight lines.
        states: One or more states, shape (N, dof).
        velocities: At them, shape (N, dof), or (0, dof) for straight lines.
        accelerations: At them.
        bi: Buffers, see :func:`apex_ompl.kernel.compiled.constraint.projection.row_buffer_sizes`.
        bf: Buffers.
        rows: Number of all rows.
        pi: Buffers, :class:`ConstraintProofBuffers`, which get the results.
        pf: Buffers.

    Returns:
        PROVED; VIOLATED at a state beyond a tolerance; UNDECIDED where a bound stays above the tolerance after many
        bisections; or INVALID at a piece that has no numbers. Where it is not PROVED, ``counts`` and ``figures`` say
        where.
    """
    t, c = robot_view(ri, rf), constraints_view(ci, cf)
    w = workspace_view(t, wi, wf)
    b = rows_view(bi, bf, (rows, states.shape[1]))
    p = _proof_view(pi, pf, (len(c.kind), states.shape[1]))
    pieces = max(len(states) - 1, 1)
    p.counts[0], p.counts[1], p.counts[2] = 0, -1, -1
    for g in range(len(c.kind)):
        p.bounds[g] = p.violations[g] = 0.0
    most = INTERVALS + MORE_INTERVALS * pieces
    for k in range(pieces):
        if not _set_piece(times, states, velocities, accelerations, k, p):
            p.counts[1], p.figures[0], p.figures[1] = k, 0.0, math.nan
            return INVALID
        top = 1
        p.stack[0, 0], p.stack[0, 1] = 0.0, 1.0
        while top > 0:
            top -= 1
            start, end = p.stack[top, 0], p.stack[top, 1]
            middle = 0.5 * (start + end)
            _set_interval(middle, 0.5 * (end - start), p)
            p.counts[0] += 1
            outcome, g, size = _examine(t, w, c, p, b, 2 * p.counts[0] < most)
            if outcome == PROVED:
                continue
            last = top + 2 > len(p.stack) or p.counts[0] >= most
            if outcome == VIOLATED or last or not p.violations[g] + ROUNDING <= c.tolerance[g]:
                p.counts[1], p.counts[2], p.figures[0], p.figures[1] = k, g, middle, size
                return outcome
            p.stack[top, 0], p.stack[top, 1] = middle, end
            p.stack[top + 1, 0], p.stack[top + 1, 1] = start, middle
            top += 2
    return PROVED
