"""Data, buffers and differences of the interior-point steps that lower the duration of a motion.

See :mod:`apex_ompl.kernel.compiled.timing.duration_optimization`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any, NamedTuple

from apex_ompl.kernel.compiled.compilation import reassociating_inlined
from apex_ompl.kernel.compiled.layout import Floats, Integers, buffer_sizes, buffer_view

ORDERS = 3  # of derivatives that have limits
WIDTH = ORDERS + 1  # control points that a sample, or a jerk, depends on
UNIT = 0.01  # of clearances [m]
LEAST_SLACK = 0.02  # of a clearance that is new and too low [UNIT]
LEAST_BOUND_SLACK = 1e-6  # of a position limit [rad]
ROWS_PER_SAMPLE = 40  # clearances of a motion, on average at most
MOST_ENDS = 256  # clearances at start and goal


class DurationSettings(NamedTuple):
    """Settings of the steps.

    Attributes:
        margin: Least clearance [m].
        horizon: Clearances above it are left out [m].
        prox: Weight of half the squared change of a sample in a step [1/rad^2].
        mean: Mean of slacks times multipliers at the start.
        decrease: Share of that mean which a step aims at.
        largest: Largest change of a control point in a step [rad].
        tolerance: Sum of slacks times multipliers at which the steps end: a bound on what is left of the objective.
        hurry: Weight of u; 0 keeps the knot spacing.
        calm: Weight of half the sum of squared jerks as shares of their limits.
        steps: Most steps.
    """

    margin: float
    horizon: float
    prox: float
    mean: float
    decrease: float
    largest: float
    tolerance: float
    hurry: float
    calm: float
    steps: int


Penalty = Any
Penalize = Callable[..., None]
"""Compiled function ``(penalty, t, w, q, b)`` that adds further terms of the objective at a sample q.

Their negative gradient is added to ``b.sample_gradient``, the lower half of their matrix to ``b.sample_gram``.
"""

Numbers = tuple[float, float, float, float, float, float, float, float, float, int]  # of DurationSettings


class Buffers(NamedTuple):
    """Memory of the steps; unknown i * dof + d is joint d of free control point i.

    Attributes:
        gram: Band of the matrix from its diagonal on, a row for each unknown; then its Cholesky factor.
        gradient: Negative right-hand side, then the step.
        border: Column of u, then the solution for it.
        upper_dual: Multipliers of the limits of positive differences.
        lower_dual: Multipliers of the limits of negative differences.
        bound_dual: Multipliers of the upper and the lower position limits.
        clearance: Clearances over their margins, in UNIT.
        row: Their gradients, divided by UNIT.
        slack: Their slacks, of this step and the one before.
        dual: Their multipliers, of this step and the one before.
        key: What they are between, of this step and the one before.
        begin: The first one of each sample, of this step and the one before.
        end_clearance: Clearances at start and goal [m].
        end_key: What they are between.
        state: A sample, or its change.
        sample_gradient: Gradient of a sample.
        sample_gram: Matrix of a sample.
    """

    gram: Annotated[Floats, "unknowns", "band"]
    gradient: Annotated[Floats, "unknowns"]
    border: Annotated[Floats, "unknowns"]
    upper_dual: Annotated[Floats, ORDERS, "points", "dof"]
    lower_dual: Annotated[Floats, ORDERS, "points", "dof"]
    bound_dual: Annotated[Floats, 2, "unknowns"]
    clearance: Annotated[Floats, "rows"]
    row: Annotated[Floats, "rows", "dof"]
    slack: Annotated[Floats, 2, "rows"]
    dual: Annotated[Floats, 2, "rows"]
    key: Annotated[Integers, 2, "rows"]
    begin: Annotated[Integers, 2, "places"]
    end_clearance: Annotated[Floats, MOST_ENDS]
    end_key: Annotated[Integers, MOST_ENDS]
    state: Annotated[Floats, "dof"]
    sample_gradient: Annotated[Floats, "dof"]
    sample_gram: Annotated[Floats, "dof", "dof"]


buffers_view = buffer_view(Buffers, ("unknowns", "band", "points", "dof", "rows", "places"))


def duration_dimensions(points: int, pinned: int, dof: int, samples: int) -> dict[str, int]:
    """Return the dimensions of the buffers."""
    return {
        "unknowns": (points - 2 * pinned) * dof, "band": WIDTH * dof, "points": points, "dof": dof,
        "rows": ROWS_PER_SAMPLE * samples, "places": samples + 1,
    }  # fmt: skip


def duration_buffer_sizes(points: int, pinned: int, dof: int, samples: int) -> tuple[int, int]:
    """Return how many integers and floats one call needs as buffers."""
    return buffer_sizes(Buffers, **duration_dimensions(points, pinned, dof, samples))


class Problem(NamedTuple):
    """Data of a motion besides robot and scene.

    Attributes:
        weights: Weights of control points at the samples, shape (N, 4).
        first: The first control point that they belong to, shape (N,).
        mass: Band of the mass matrix of the samples, shape (P, 4).
        limits: Limits of velocity, acceleration and jerk, (3, dof); not positive for a joint that stays.
        pinned: Number of control points at each end that stay.
    """

    weights: Floats
    first: Integers
    mass: Floats
    limits: Floats
    pinned: int


@reassociating_inlined
def difference(order: int, m: int) -> float:
    """Return the coefficient of control point ``m`` in a difference of an order from 1 to 3."""
    if order == 1:
        return -1.0 if m == 0 else 1.0
    if order == 2:
        return -2.0 if m == 1 else 1.0
    return (-1.0 if m == 0 else 1.0) if m % 3 == 0 else (3.0 if m == 1 else -3.0)


@reassociating_inlined
def differences(order: int, i: int, d: int, values: Floats) -> float:
    """Return the ``i``-th difference of column ``d``."""
    if order == 1:
        return float(values[i + 1, d] - values[i, d])
    if order == 2:
        return float(values[i + 2, d] - 2.0 * values[i + 1, d] + values[i, d])
    return float(values[i + 3, d] - values[i, d] + 3.0 * (values[i + 1, d] - values[i + 2, d]))


@reassociating_inlined
def step_difference(order: int, i: int, d: int, pinned: int, free: int, dof: int, step: Floats) -> float:
    """Return the ``i``-th difference of a step in joint ``d``; pinned points do not move."""
    total = 0.0
    for m in range(order + 1):
        a = i + m - pinned
        if 0 <= a < free:
            total += difference(order, m) * step[a * dof + d]
    return total
