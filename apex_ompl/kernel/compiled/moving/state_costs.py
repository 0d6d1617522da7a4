"""Clearance costs of states among static and dynamic obstacles, with gradients and Gauss-Newton matrices.

The cost of a state at a time is that of :mod:`apex_ompl.kernel.compiled.check.clearance_cost`, to which every cluster
and every dynamic obstacle add the same term, with the dynamic obstacle at its place at that time and larger by its
margin.
"""

from __future__ import annotations

import math

from apex_ompl.kernel.compiled.arrays import RobotArrays, SceneArrays, robot_view, scene_view
from apex_ompl.kernel.compiled.check.clearance import gradient_to_obstacle, nearest_to_obstacle
from apex_ompl.kernel.compiled.check.clearance_cost import add_violation, state_cost
from apex_ompl.kernel.compiled.check.separation import tables_hold
from apex_ompl.kernel.compiled.compilation import entry_point, inlined
from apex_ompl.kernel.compiled.layout import Floats, Integers, Singles
from apex_ompl.kernel.compiled.moving.dynamic_obstacles import (
    DynamicArrays,
    dynamic_view,
    margin_at,
    place_dynamic,
    scene_of_dynamic,
)
from apex_ompl.kernel.compiled.workspace import Workspace, workspace_view


@inlined
def add_dynamic(
    t: RobotArrays, dynamic: DynamicArrays, placed: SceneArrays, w: Workspace, q: Floats, time: float, margin: float,
    row: Floats, gradient: Floats, gram: Floats, scene: float,
) -> tuple[float, float]:  # fmt: skip
    """Add what dynamic obstacles cost at a time to the gradient and the lower half of the matrix of a placed state.

    ``placed`` are the dynamic obstacles as a scene, ``scene`` the smallest clearance so far [m].

    Returns:
        The cost, and the smallest clearance [m].
    """
    cost = 0.0
    place_dynamic(dynamic, time, placed.offset)
    for c in range(len(t.cluster_joint)):
        if not t.cluster_meets_scene[c]:
            continue
        for o in range(len(dynamic.kind)):
            grown = margin_at(dynamic, o, time)
            near = nearest_to_obstacle(t, placed, w, q, c, o, (margin + grown, -1, -1, -1, -1))
            if near[1] >= 0:
                clearance = near[0] - grown
                scene = min(scene, clearance)
                for i in range(len(row)):
                    row[i] = 0.0
                gradient_to_obstacle(t, placed, w, near, row)
                cost += add_violation(clearance, margin, row, gradient, gram)
    return cost, scene


@entry_point
def state_costs(
    ri: Integers, rf: Floats, si: Integers, sf: Floats, sg: Singles, mi: Integers, mf: Floats, ms: Singles,
    wi: Integers, wf: Floats, offset: Floats,
    states: Floats, times: Floats, scene_margin: float, own_margin: float, row: Floats,
    values: Floats, gradients: Floats, grams: Floats,
) -> None:  # fmt: skip
    """Put clearance costs of states, shape (N, dof), at times, shape (N,) [s], into place.

    ``mi``, ``mf`` and ``ms`` are packed dynamic obstacles; ``offset`` (M, 3) and ``row`` (dof,) are buffers. ``values``
    (N, 3) gets the cost and the clearances to the scene and between links [m], at most the margins; ``gradients`` (N,
    dof) and ``grams`` (N, dof, dof) the gradients and the matrices. Where the tables do not hold for a state its cost
    is infinite, and the rest 0.
    """
    t, s, m = robot_view(ri, rf), scene_view(si, sf, sg), dynamic_view(mi, mf, ms)
    w = workspace_view(t, wi, wf)
    placed = scene_of_dynamic(m, offset)
    dof = states.shape[1]
    for k in range(len(states)):
        gradient, gram = gradients[k], grams[k]
        if not tables_hold(t, states[k], w.half_width):
            values[k, 0], values[k, 1], values[k, 2] = math.inf, -math.inf, -math.inf
            for i in range(dof):
                gradient[i] = 0.0
                for j in range(dof):
                    gram[i, j] = 0.0
            continue
        cost, scene, own = state_cost(
            t, s, w, states[k], scene_margin, own_margin, row, gradient, gram, scene_margin, own_margin
        )
        moving, scene = add_dynamic(t, m, placed, w, states[k], times[k], scene_margin, row, gradient, gram, scene)
        values[k, 0], values[k, 1], values[k, 2] = cost + moving, scene, own
        for i in range(dof):
            for j in range(i):
                gram[j, i] = gram[i, j]
