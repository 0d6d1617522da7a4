"""Compiled functions that Python calls for states: proofs, clearances and joint frames.

Robots and scenes come packed, see :func:`apex_ompl.kernel.compiled.layout.pack`.
"""

from __future__ import annotations

import math

from apex_ompl.kernel.compiled.arrays import robot_view, scene_view
from apex_ompl.kernel.compiled.check.clearance import (
    gradient_between_bodies,
    gradient_to_obstacle,
    nearest_bodies,
    nearest_obstacle,
)
from apex_ompl.kernel.compiled.check.separation import tables_hold, unproved_at_state
from apex_ompl.kernel.compiled.compilation import entry_point
from apex_ompl.kernel.compiled.layout import Floats, Integers, Singles
from apex_ompl.kernel.compiled.robot.kinematics import place_joints, place_robot
from apex_ompl.kernel.compiled.workspace import workspace_view


@entry_point
def check_states(
    ri: Integers, rf: Floats, si: Integers, sf: Floats, sg: Singles, wi: Integers, wf: Floats,
    states: Floats, found: Integers, counts: Integers,
) -> None:  # fmt: skip
    """Find for each state, shape (N, dof), the pairs that are not proved apart.

    ``found`` (N, K, 2) gets the pairs, ``counts`` (N,) their number or a code in its place, see
    :func:`apex_ompl.kernel.compiled.check.separation.unproved_at_state`.
    """
    t, s = robot_view(ri, rf), scene_view(si, sf, sg)
    w = workspace_view(t, wi, wf)
    for k in range(len(states)):
        counts[k] = unproved_at_state(t, s, w, states[k], found[k])


@entry_point
def clearances(
    ri: Integers, rf: Floats, si: Integers, sf: Floats, sg: Singles, wi: Integers, wf: Floats,
    states: Floats, limit: float, values: Floats, gradients: Floats,
) -> None:  # fmt: skip
    """Put the signed clearances of states, shape (N, dof), to obstacles and between links into ``values`` (N, 2) [m].

    Clearances above ``limit`` are given as ``limit``, with gradient 0. ``gradients``, shape (N, 2, dof), gets the
    gradients; shape (0, 2, dof) asks for none. States for which the tables do not hold get NaN.
    """
    t, s = robot_view(ri, rf), scene_view(si, sf, sg)
    w = workspace_view(t, wi, wf)
    for k in range(len(states)):
        q = states[k]
        if not tables_hold(t, q, w.half_width):
            values[k, 0] = values[k, 1] = math.nan
            if len(gradients):
                for i in range(len(q)):
                    gradients[k, 0, i] = gradients[k, 1, i] = math.nan
            continue
        place_robot(t, w, q)
        near = nearest_obstacle(t, s, w, q, limit)
        own = nearest_bodies(t, w, q, limit)
        values[k, 0], values[k, 1] = near[0], own[0]
        if len(gradients):
            for i in range(len(q)):
                gradients[k, 0, i] = gradients[k, 1, i] = 0.0
            if near[1] >= 0:
                gradient_to_obstacle(t, s, w, near, gradients[k, 0])
            if own[1] >= 0:
                gradient_between_bodies(t, w, own, gradients[k, 1])


@entry_point
def joint_frames(
    ri: Integers, rf: Floats, wi: Integers, wf: Floats, states: Floats, rotation: Floats, origin: Floats
) -> None:
    """Put the frames of all joints, axes along z, into ``rotation`` (N, J, 3, 3) and ``origin`` (N, J, 3) [m]."""
    t = robot_view(ri, rf)
    w = workspace_view(t, wi, wf)
    for k in range(len(states)):
        place_robot(t, w, states[k])
        place_joints(t, w, states[k], t.lazy, 0, len(t.lazy))
        for j in range(len(t.joint_parent)):
            for i in range(3):
                origin[k, j, i] = w.origin[j, i]
                for m in range(3):
                    rotation[k, j, i, m] = w.rotation[j, i, m]
