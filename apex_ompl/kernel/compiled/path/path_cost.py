"""Cost of a path that is to be clear and short, with its gradient and Gauss-Newton matrix.

The cost of the path q(u) = sum_i B_i(u) P_i with control points P is

    J(P) = stiffness / 2 int |q'(u)|^2 du + 1/N sum_k c(q(u_k)),

with the clearance cost c of :mod:`apex_ompl.kernel.compiled.check.clearance_cost` at N samples u_k. The first term is
stiffness / 2 P^T A P with the Gram matrix A of the derivatives B_i'.
"""

from __future__ import annotations

import math
from typing import Annotated, NamedTuple

from apex_ompl.kernel.compiled.arrays import RobotArrays, SceneArrays, robot_view, scene_view
from apex_ompl.kernel.compiled.check.clearance_cost import state_cost
from apex_ompl.kernel.compiled.check.separation import tables_hold
from apex_ompl.kernel.compiled.compilation import reassociating_entry_point, reassociating_inlined
from apex_ompl.kernel.compiled.layout import Floats, Integers, Singles, buffer_sizes, buffer_view
from apex_ompl.kernel.compiled.workspace import Workspace, workspace_view

BLOCK, STRIDE = 8, 128  # rows of a Cholesky factor that are made together, and numbers of each that are used at a time
PANEL = BLOCK * STRIDE


class CostSettings(NamedTuple):
    """Settings of the cost and of the steps.

    Attributes:
        scene_margin: Clearance to obstacles below which a state costs [m].
        own_margin: Clearance between links below which a state costs [m].
        stiffness: Weight of half the integral of the squared speed [1/rad^2].
        damping: Damping of the first step.
        enough: The steps end when both clearances reach this [m].
        tolerance: A step that lowers the cost by less than this share is the last.
        steps: Most steps, rejected ones among them.
    """

    scene_margin: float
    own_margin: float
    stiffness: float
    damping: float
    enough: float
    tolerance: float
    steps: int


class PathCost(NamedTuple):
    """Cost of a path; infinite where the tables do not hold for one of its samples.

    Attributes:
        cost: The cost J.
        clearance_cost: The part of it that is due to clearance.
        scene_clearance: Smallest clearance to the scene at the samples, at most its margin [m].
        own_clearance: Smallest clearance between links at the samples, at most its margin [m].
    """

    cost: float
    clearance_cost: float
    scene_clearance: float
    own_clearance: float


class PathReport(NamedTuple):
    """Result of the compiled functions: the fields of :class:`PathCost`, steps taken, and the damping to go on with.

    They return, and take, plain tuples, since numba unpickles the class of a named tuple at every call from Python.
    """

    cost: float
    clearance_cost: float
    scene_clearance: float
    own_clearance: float
    steps: int
    damping: float


Numbers = tuple[float, float, float, float, float, float, int]  # of CostSettings
Report = tuple[float, float, float, float, int, float]  # of PathReport


class Buffers(NamedTuple):
    """Memory for the steps of one path; the unknowns are the free control points, joint by joint.

    Attributes:
        gram: Upper halves of the Gauss-Newton matrices, of the path and of the trial.
        factor: Upper Cholesky factor.
        panel: Pieces of rows of it, side by side.
        gradient: Gradients of the path and of the trial.
        step: Right-hand side, then step.
        trial: Control points of the trial.
        state: A sample.
        row: Gradient of one clearance at a sample.
        state_gradient: Gradient of the clearance cost of a sample.
        state_gram: Lower half of its Gauss-Newton matrix.
        room: Buffer for a row of it times the weights of a sample.
        held: Whether an unknown stays at its limit.
    """

    gram: Annotated[Floats, 2, "unknowns", "unknowns"]
    factor: Annotated[Floats, "unknowns", "unknowns"]
    panel: Annotated[Floats, PANEL]
    gradient: Annotated[Floats, 2, "unknowns"]
    step: Annotated[Floats, "unknowns"]
    trial: Annotated[Floats, "points", "dof"]
    state: Annotated[Floats, "dof"]
    row: Annotated[Floats, "dof"]
    state_gradient: Annotated[Floats, "dof"]
    state_gram: Annotated[Floats, "dof", "dof"]
    room: Annotated[Floats, "unknowns"]
    held: Annotated[Integers, "unknowns"]


buffers_view = buffer_view(Buffers, ("unknowns", "points", "dof"))


def optimization_buffer_sizes(unknowns: int, points: int, dof: int) -> tuple[int, int]:
    """Return how many integers and floats one call needs as buffers."""
    return buffer_sizes(Buffers, unknowns=unknowns, points=points, dof=dof)


@reassociating_inlined
def set_sample(
    weights: Floats, first: Integers, k: int, control: Floats, lower: Floats, upper: Floats, q: Floats
) -> None:
    """Put sample ``k`` of a path into ``q``, inside the limits in spite of rounding."""
    for i in range(len(q)):
        total = 0.0
        for m in range(weights.shape[1]):
            total += weights[k, m] * control[first[k] + m, i]
        q[i] = min(max(total, lower[i]), upper[i])


@reassociating_inlined
def clear(band: int, gradient: Floats, gram: Floats) -> None:
    """Put zeros into a gradient, shape (n,), and the band of a matrix (n, n) from its diagonal on."""
    for i in range(len(gradient)):
        gradient[i] = 0.0
        row = gram[i, i : i + band]
        for k in range(len(row)):
            row[k] = 0.0


@reassociating_inlined
def add_sample(
    share: float, weights: Floats, first: int, pinned: int, free: int, here: Floats, matrix: Floats, gradient: Floats,
    gram: Floats, room: Floats,
) -> None:  # fmt: skip
    """Add the gradient ``here`` of a sample's cost and its ``matrix``, mapped to the control points.

    Of the matrix the lower half is read; the upper one becomes its image. ``room`` is memory as long as the gradient.
    """
    dof = len(here)
    for d in range(dof):
        for e in range(d):
            matrix[e, d] = matrix[d, e]
    start, end = max(0, pinned - first), min(len(weights), free + pinned - first)
    for m in range(start, end):
        i, f = first + m - pinned, share * weights[m]
        for d in range(dof):
            gradient[i * dof + d] += f * here[d]
    for d in range(dof):
        if not matrix[d, d] > 0.0:  # the joint moves nothing that is near
            continue
        source = matrix[d]
        for k in range(start, end):
            scaled = room[(k - start) * dof : (k - start + 1) * dof]
            for n in range(dof):
                scaled[n] = weights[k] * source[n]
        at = (first + start - pinned) * dof
        for m in range(start, end):
            i, f = first + m - pinned, share * weights[m]
            shift, stop = (m - start) * dof, (end - start) * dof
            target, scaled = gram[i * dof + d, at + shift : at + stop], room[shift:stop]
            for j in range(len(target)):
                target[j] += f * scaled[j]


@reassociating_inlined
def add_speed(
    stiffness: float, speed_gram: Floats, pinned: int, control: Floats, gradient: Floats, gram: Floats
) -> float:
    """Add gradient and matrix of stiffness / 2 P^T A P; return the term."""
    points, dof = control.shape
    free, total = points - 2 * pinned, 0.0
    for i in range(points):
        a = i - pinned
        inside = 0 <= a < free
        for k in range(points):
            b, f = k - pinned, stiffness * speed_gram[i, k]
            if f == 0.0:
                continue
            for d in range(dof):
                total += 0.5 * f * control[i, d] * control[k, d]
                if inside:
                    gradient[a * dof + d] += f * control[k, d]
            if inside and a <= b < free:
                for d in range(dof):
                    gram[a * dof + d, b * dof + d] += f
    return total


class PathProblem(NamedTuple):
    """Data of the cost of a path: weights at its samples, and the matrix of its speed.

    Attributes:
        weights: Weights of control points at the samples, shape (N, degree + 1).
        first: The first control point that they belong to, shape (N,).
        speed_gram: Gram matrix A of the speed, shape (P, P).
    """

    weights: Floats
    first: Integers
    speed_gram: Floats


@reassociating_inlined
def evaluate_path(
    problem: PathProblem, t: RobotArrays, s: SceneArrays, w: Workspace, pinned: int, control: Floats,
    settings: CostSettings, b: Buffers, gradient: Floats, gram: Floats,
) -> PathCost:  # fmt: skip
    """Return the cost of a path; put its gradient (n,) and the upper band of its matrix (n, n) into place.

    The unknowns are the free control points: number i * dof + d for joint d of free point i.
    """
    weights, first, dof = problem.weights, problem.first, control.shape[1]
    free = len(control) - 2 * pinned
    clear(weights.shape[1] * dof, gradient, gram)
    scene, own = settings.scene_margin, settings.own_margin
    total, share, q = 0.0, 1.0 / len(weights), b.state
    for k in range(len(weights)):
        set_sample(weights, first, k, control, t.lower, t.upper, q)
        if not tables_hold(t, q, w.half_width):
            return PathCost(math.inf, math.inf, -math.inf, -math.inf)
        cost, scene, own = state_cost(
            t, s, w, q, settings.scene_margin, settings.own_margin, b.row, b.state_gradient, b.state_gram, scene, own,
        )  # fmt: skip
        if cost > 0.0:
            total += share * cost
            add_sample(
                share, weights[k], first[k], pinned, free, b.state_gradient, b.state_gram, gradient, gram, b.room
            )
    speed = add_speed(settings.stiffness, problem.speed_gram, pinned, control, gradient, gram)
    return PathCost(total + speed, total, scene, own)


@reassociating_entry_point
def path_cost(
    ri: Integers, rf: Floats, si: Integers, sf: Floats, sg: Singles, wi: Integers, wf: Floats,
    weights: Floats, first: Integers,
    speed_gram: Floats, pinned: int, control: Floats, numbers: Numbers, bi: Integers, bf: Floats, gradient: Floats,
) -> Report:  # fmt: skip
    """Return the cost of a path, put its gradient (n,) into place; see ``optimize_path`` for the arguments."""
    t, s = robot_view(ri, rf), scene_view(si, sf, sg)
    w = workspace_view(t, wi, wf)
    points, dof = control.shape
    b = buffers_view(bi, bf, ((points - 2 * pinned) * dof, points, dof))
    settings = CostSettings(*numbers)
    problem = PathProblem(weights, first, speed_gram)
    c = evaluate_path(problem, t, s, w, pinned, control, settings, b, gradient, b.gram[0])
    return c.cost, c.clearance_cost, c.scene_clearance, c.own_clearance, 0, settings.damping
