"""Inside the kernel: control points of a path moved until it is clear and short, by Levenberg and Marquardt's method.

The cost of a path is half the integral of its speed squared, times ``stiffness``, plus half the mean, over samples of
it, of the sum of squared violations of the margin. A violation is (margin - clearance) / margin where positive, for the
nearest spheres of every cluster and obstacle, and of every two clusters that may touch. As a sum of squares it is
descended by Gauss's and Newton's steps, damped in the metric of the speed term, which spreads them smoothly over the
path (a covariant descent as CHOMP's, Zucker et al. 2013, on the least squares of GPMP2, Mukadam et al. 2018).
"""

from __future__ import annotations

import math

from apex_ompl.kernel.clearance_cost import clearance_costs
from apex_ompl.kernel.compiled import entry, inlined, pasted
from apex_ompl.kernel.separation import known
from apex_ompl.kernel.tables import Floats, Integers, RobotArrays, SceneArrays
from apex_ompl.kernel.views import Work, robot_view, scene_view, work_view

SCENE_MARGIN, OWN_MARGIN, STIFFNESS, DAMPING, ENOUGH_SCENE, ENOUGH_OWN, TOLERANCE, STEPS = range(8)
COST, CLEARANCE_COST, SCENE, OWN, TAKEN = range(5)  # what is said of a path
LEAST_DAMPING, MOST_DAMPING = 1e-9, 1e9


@inlined
def _sample(weights: Floats, first: Integers, k: int, control: Floats, lower: Floats, upper: Floats, q: Floats) -> None:
    """Put sample k of a path into ``q``; rounding does not lead out of the limits."""
    for i in range(len(q)):
        total = 0.0
        for m in range(weights.shape[1]):
            total += weights[k, m] * control[first[k] + m, i]
        q[i] = min(max(total, lower[i]), upper[i])


@inlined
def _add_sample(
    share: float, weights: Floats, first: int, pinned: int, free: int, here: Floats, matrix: Floats, slope: Floats,
    gram: Floats,
) -> None:  # fmt: skip
    """Add what a state, its gradient ``here`` and lower half of its matrix, means for the control points."""
    dof = len(here)
    for m in range(len(weights)):
        i = first + m - pinned
        if i < 0 or i >= free:
            continue
        f = share * weights[m]
        for d in range(dof):
            slope[i * dof + d] += f * here[d]
        for k in range(m, min(len(weights), free + pinned - first)):
            g, at = f * weights[k], (first + k - pinned) * dof
            for d in range(dof):
                target = gram[i * dof + d]
                for e in range(d + 1):
                    target[at + e] += g * matrix[d, e]
                for e in range(d + 1, dof):
                    target[at + e] += g * matrix[e, d]


@inlined
def _add_speed(stiffness: float, stretch: Floats, pinned: int, control: Floats, slope: Floats, gram: Floats) -> float:
    """Add the speed term's gradient and matrix; return the term."""
    points, dof = control.shape
    free, total = points - 2 * pinned, 0.0
    for i in range(points):
        a = i - pinned
        inside = 0 <= a < free
        for k in range(points):
            b, f = k - pinned, stiffness * stretch[i, k]
            if f == 0.0:
                continue
            for d in range(dof):
                total += 0.5 * f * control[i, d] * control[k, d]
                if inside:
                    slope[a * dof + d] += f * control[k, d]
            if inside and a <= b < free:
                for d in range(dof):
                    gram[a * dof + d, b * dof + d] += f
    return total


@inlined
def evaluate(
    t: RobotArrays, s: SceneArrays, w: Work, weights: Floats, first: Integers, stretch: Floats, pinned: int,
    control: Floats, settings: Floats, slope: Floats, gram: Floats, small: Floats, matrix: Floats, about: Floats,
) -> None:  # fmt: skip
    """Evaluate a path: cost and clearances into ``about``, gradient (n,) and upper half of the matrix (n, n).

    The unknowns are the free control points: number i * dof + d for joint d of free point i. ``small`` (3, dof) and
    ``matrix`` (dof, dof) are to work in.
    """
    dof = control.shape[1]
    free = len(control) - 2 * pinned
    for i in range(free * dof):
        slope[i] = 0.0
        for k in range(i, free * dof):
            gram[i, k] = 0.0
    about[SCENE], about[OWN] = settings[SCENE_MARGIN], settings[OWN_MARGIN]
    total, share, q = 0.0, 1.0 / len(weights), small[0]
    for k in range(len(weights)):
        _sample(weights, first, k, control, t.lower, t.upper, q)
        if not known(t, q, w.reach):
            about[COST] = about[CLEARANCE_COST] = math.inf
            about[SCENE] = about[OWN] = -math.inf
            return
        part = clearance_costs(t, s, w, q, settings[:STIFFNESS], small[1], small[2], matrix, about[SCENE:TAKEN])
        if part > 0.0:
            total += share * part
            _add_sample(share, weights[k], first[k], pinned, free, small[2], matrix, slope, gram)
    about[CLEARANCE_COST] = total
    about[COST] = total + _add_speed(settings[STIFFNESS], stretch, pinned, control, slope, gram)


@inlined
def _factorise(factor: Floats, band: int) -> bool:
    """Put the upper factor of Cholesky in place of a matrix; both are zero beyond ``band`` from the diagonal."""
    n = len(factor)
    for k in range(n):
        end, source = min(n, k + band), factor[k]
        if not source[k] > 0.0:
            return False
        root = 1.0 / math.sqrt(source[k])
        for j in range(k, end):
            source[j] *= root
        for i in range(k + 1, end):
            f = source[i]
            if f != 0.0:
                target = factor[i]
                for j in range(i, end):
                    target[j] -= f * source[j]
    return True


@inlined
def _newton_step(
    gram: Floats, stretch: Floats, damping: float, pinned: int, dof: int, held: Integers, band: int, factor: Floats,
    step: Floats,
) -> bool:  # fmt: skip
    """Solve (gram + damping x speed's metric) x = step in place; ``held`` unknowns stay."""
    n = len(step)
    for i in range(n):
        for k in range(i, min(n, i + band)):
            factor[i, k] = 0.0 if held[i] or held[k] else gram[i, k]
        a, d = i // dof, i % dof
        for k in range(i, min(n, i + band), dof):
            if not held[i] and not held[k]:
                factor[i, k] += damping * stretch[a + pinned, (k - d) // dof + pinned]
        if held[i]:
            factor[i, i], step[i] = 1.0, 0.0
    if not _factorise(factor, band):
        return False
    for i in range(n):
        step[i] /= factor[i, i]
        for j in range(i + 1, min(n, i + band)):
            step[j] -= step[i] * factor[i, j]
    for i in range(n - 1, -1, -1):
        total = step[i]
        for j in range(i + 1, min(n, i + band)):
            total -= factor[i, j] * step[j]
        step[i] = total / factor[i, i]
    return True


@inlined
def _try(
    t: RobotArrays, control: Floats, pinned: int, slope: Floats, held: Integers, step: Floats, trial: Floats, way: int
) -> None:
    """Before a step (way 0) list the unknowns that stay at their limits; behind it (1) put it on the control points."""
    dof = control.shape[1]
    for i in range(len(step)):
        a, d = pinned + i // dof, i % dof
        if way == 0:
            value, g = control[a, d], slope[i]
            held[i] = (value <= t.lower[d] and g > 0.0) or (value >= t.upper[d] and g < 0.0)
            step[i] = -g
        else:
            trial[a, d] = min(max(control[a, d] + step[i], t.lower[d]), t.upper[d])


@pasted
def _room(scratch: Floats, n: int, points: int, dof: int) -> tuple[Floats, ...]:
    a = n * n
    b = 3 * a + 2 * n
    c = b + n
    d = c + points * dof
    e = d + 3 * dof
    return (
        scratch[: 2 * a].reshape(2, n, n), scratch[2 * a : 3 * a].reshape(n, n), scratch[3 * a : b].reshape(2, n),
        scratch[b:c], scratch[c:d].reshape(points, dof), scratch[d:e].reshape(3, dof),
        scratch[e : e + dof * dof].reshape(dof, dof), scratch[e + dof * dof : e + dof * dof + 10].reshape(2, 5),
    )  # fmt: skip


def room_for(n: int, points: int, dof: int) -> int:
    """Return how many floats one call needs to work in, for n unknowns."""
    return 3 * n * n + 3 * n + points * dof + 3 * dof + dof * dof + 10


@entry
def path_cost(
    ri: Integers, rf: Floats, si: Integers, sf: Floats, wi: Integers, wf: Floats, weights: Floats, first: Integers,
    stretch: Floats, pinned: int, control: Floats, settings: Floats, scratch: Floats, about: Floats, slope: Floats,
) -> None:  # fmt: skip
    """Evaluate a path: see :func:`bend`. ``about`` (5,) says what it found, ``slope`` gets the gradient (n,)."""
    t, s = robot_view(ri, rf), scene_view(si, sf)
    w = work_view(t, wi, wf)
    points, dof = control.shape
    n = (points - 2 * pinned) * dof
    grams, _, _, _, _, small, matrix, _ = _room(scratch, n, points, dof)
    about[TAKEN] = 0.0
    evaluate(
        t, s, w, weights, first, stretch, pinned, control, settings, slope, grams[0], small, matrix, about,
    )  # fmt: skip


@entry
def bend(
    ri: Integers, rf: Floats, si: Integers, sf: Floats, wi: Integers, wf: Floats, weights: Floats, first: Integers,
    stretch: Floats, pinned: int, control: Floats, settings: Floats, scratch: Floats, held: Integers, about: Floats,
) -> None:  # fmt: skip
    """Improve a path in place; its control points (P, dof) are put inside the limits.

    Args:
        ri: Robot; and so on, see :func:`apex_ompl.kernel.tables.pack`.
        rf: Robot.
        si: Scene.
        sf: Scene.
        wi: Room to work in.
        wf: Room to work in.
        weights: Weights of control points at the samples that are judged, shape (N, degree + 1).
        first: The first control point that they belong to, shape (N,).
        stretch: Gram matrix of the speed, shape (P, P).
        pinned: Number of control points at each end that stay.
        control: Control points.
        settings: Numbers in the order of SCENE_MARGIN ... STEPS; the work ends early when the clearances reach both
            ENOUGH_SCENE and ENOUGH_OWN, or when a step lowers the cost by less than TOLERANCE of it.
        scratch: As many floats as :func:`room_for` says.
        held: Room, shape (n,).
        about: Gets numbers in the order of COST ... TAKEN, and the damping of the end, shape (6,).
    """
    t, s = robot_view(ri, rf), scene_view(si, sf)
    w = work_view(t, wi, wf)
    points, dof = control.shape
    free = points - 2 * pinned
    n = free * dof
    grams, factor, slopes, step, trial, small, matrix, tables = _room(scratch, n, points, dof)
    for i in range(points):
        for d in range(dof):
            if pinned <= i < points - pinned:
                control[i, d] = min(max(control[i, d], t.lower[d]), t.upper[d])
            trial[i, d] = control[i, d]
    now, taken, damping, band = 0, 0, settings[DAMPING], min(n, weights.shape[1] * dof)
    evaluate(
        t, s, w, weights, first, stretch, pinned, control, settings, slopes[now], grams[now], small, matrix,
        tables[now],
    )  # fmt: skip
    while taken < settings[STEPS] and math.isfinite(tables[now, COST]):
        if tables[now, SCENE] >= settings[ENOUGH_SCENE] and tables[now, OWN] >= settings[ENOUGH_OWN]:
            break
        taken += 1
        _try(t, control, pinned, slopes[now], held, step, trial, 0)
        better = _newton_step(grams[now], stretch, damping, pinned, dof, held, band, factor, step)
        if better:
            _try(t, control, pinned, slopes[now], held, step, trial, 1)
            evaluate(
                t, s, w, weights, first, stretch, pinned, trial, settings, slopes[1 - now], grams[1 - now], small,
                matrix, tables[1 - now],
            )  # fmt: skip
            better = tables[1 - now, COST] < tables[now, COST]
        if not better:
            damping = max(4.0 * damping, LEAST_DAMPING)
            if damping > MOST_DAMPING:
                break
            continue
        gain = tables[now, COST] - tables[1 - now, COST]
        now = 1 - now
        damping = max(damping / 3.0, LEAST_DAMPING)
        for i in range(points):
            for d in range(dof):
                control[i, d] = trial[i, d]
        if gain < settings[TOLERANCE] * tables[now, COST]:
            break
    for i in range(4):
        about[i] = tables[now, i]
    about[TAKEN], about[TAKEN + 1] = taken, damping
