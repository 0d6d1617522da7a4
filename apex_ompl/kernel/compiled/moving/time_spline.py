"""Cubic B-splines in time along the path of another motion, from its present state to rest.

The path is q(s), a motion of piecewise constant jerk over its own time s; the new motion passes s(t) at time t. Its
control points, h apart in time, are

    c_i = q(s(i h)),

whose differences are averages of derivatives: of a motion within the limits they make a spline within the limits, of
jerks that are averages over 3 h. The first three are others,

    c_0 = p - h^2 / 6 a,   c_1 = c_0 + h v + h^2 / 2 a,   c_-1 = c_0 - h v + h^2 / 2 a,

which reproduce any state (p, v, a) exactly. Three equal ones are rest.
"""

from __future__ import annotations

from apex_ompl.kernel.compiled.compilation import inlined
from apex_ompl.kernel.compiled.layout import Floats

ROUNDING = 1e-9  # share by which a limit may be exceeded, and distance beyond a position limit [rad]


@inlined
def path_piece(knots: Floats, s: float, k: int) -> int:
    """Return the piece of the path that ``s`` lies on, at ``k`` or after it."""
    while k + 2 < len(knots) and knots[k + 1] <= s:
        k += 1
    return k


@inlined
def path_value(knots: Floats, states: Floats, k: int, i: int, s: float) -> tuple[float, float, float]:
    """Return position, velocity and acceleration of joint ``i`` at ``s`` on piece ``k``; at rest after the end."""
    if len(knots) == 1 or s >= knots[len(knots) - 1]:
        return states[0, len(knots) - 1, i], 0.0, 0.0
    since, jerk = s - knots[k], (states[2, k + 1, i] - states[2, k, i]) / (knots[k + 1] - knots[k])
    q, v, a = states[0, k, i], states[1, k, i], states[2, k, i]
    return (
        q + since * (v + since * (a / 2.0 + since * jerk / 6.0)),
        v + since * (a + since * jerk / 2.0),
        a + since * jerk,
    )


@inlined
def keeps_limits(
    control: Floats, first: int, joint: int, h: float, lower: Floats, upper: Floats,
    velocity: Floats, acceleration: Floats, jerk: Floats,
) -> bool:  # fmt: skip
    """Whether the piece of four control points keeps the limits of a joint: exactly, but for positions of a hull."""
    c = control[first : first + 4, joint]
    a, b = (c[2] - 2.0 * c[1] + c[0]) / (h * h), (c[3] - 2.0 * c[2] + c[1]) / (h * h)
    over = 1.0 + ROUNDING
    if abs(b) > over * acceleration[joint] or abs(b - a) > over * h * jerk[joint]:
        return False
    v, w = (c[2] - c[0]) / (2.0 * h), (c[3] - c[1]) / (2.0 * h)
    fastest = max(abs(v), abs(w))
    if a * b < 0.0:
        fastest = max(fastest, abs(v - 0.5 * a * a * h / (b - a)))
    if fastest > over * velocity[joint]:
        return False
    return bool(max(c[2], c[1]) <= upper[joint] + ROUNDING and min(c[2], c[1]) >= lower[joint] - ROUNDING)


@inlined
def set_start(start: Floats, h: float, control: Floats) -> None:
    """Set the first three control points for a state, shape (3, dof)."""
    for i in range(start.shape[1]):
        v, a = start[1, i], start[2, i]
        control[1, i] = start[0, i] - h * h / 6.0 * a
        control[0, i], control[2, i] = control[1, i] - h * v + 0.5 * h * h * a, control[1, i] + h * v + 0.5 * h * h * a


@inlined
def spline_knots(
    start: Floats, control: Floats, count: int, h: float, first_time: float, times: Floats, out: Floats
) -> int:
    """Put the knots of a spline that rests after ``count + 1`` steps into place; return their number.

    Args:
        start: Its state at the start, shape (3, dof).
        control: Its control points, shape (count + 4, dof) or more.
        count: See above.
        h: Length of the steps [s].
        first_time: Time of the first knot [s].
        times: Gets the times, shape (count + 2,) or more [s].
        out: Gets positions, velocities and accelerations, shape (3, that, dof).
    """
    for k in range(count + 2):
        times[k] = first_time + k * h
        for i in range(start.shape[1]):
            x, y, z = control[k, i], control[k + 1, i], control[k + 2, i]
            out[0, k, i] = (x + 4.0 * y + z) / 6.0
            out[1, k, i], out[2, k, i] = (z - x) / (2.0 * h), (z - 2.0 * y + x) / (h * h)
    for i in range(start.shape[1]):
        for order in range(3):
            out[order, 0, i] = start[order, i]
        out[0, count + 1, i], out[1, count + 1, i], out[2, count + 1, i] = control[count + 2, i], 0.0, 0.0
    return count + 2
