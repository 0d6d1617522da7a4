"""How far spheres move along motions: the kernel's bounds against samples."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from random_robots import random_robot
from scipy.spatial.distance import cdist
from support import states_around_home

from apex_ompl.collision import CollisionChecker
from apex_ompl.kernel.compiled.arrays import robot_view
from apex_ompl.kernel.compiled.compilation import outlined
from apex_ompl.kernel.compiled.jit import uncached
from apex_ompl.kernel.compiled.layout import new_buffers
from apex_ompl.kernel.compiled.robot.kinematics import place_joints, place_robot
from apex_ompl.kernel.compiled.robot.motion_bound import (
    bound_displacements,
    cluster_displacement,
    relative_displacement,
)
from apex_ompl.kernel.compiled.workspace import Workspace, workspace_dimensions, workspace_view
from apex_ompl.kernel.tables import RobotTables
from apex_ompl.robot import Robot


@uncached
def place(ri, rf, wi, wf, q):  # type: ignore[no-untyped-def]
    """Place all joints at a state."""
    t = robot_view(ri, rf)
    w = workspace_view(t, wi, wf)
    place_robot(t, w, q)
    place_joints(t, w, q, t.lazy, 0, len(t.lazy))


@uncached
def bound(ri, rf, wi, wf, q, step, deviation, clusters, pairs):  # type: ignore[no-untyped-def] # noqa: PLR0917
    """Put the bounds of all clusters and pairs for a motion around a state into place."""
    t = robot_view(ri, rf)
    w = workspace_view(t, wi, wf)
    place_robot(t, w, q)
    for k in range(len(q)):
        w.step[k], w.deviation[k], w.half_width[k] = step[k], deviation[k], abs(step[k]) + deviation[k]
    bound_displacements(t, w)
    for c in range(len(clusters)):
        clusters[c] = cluster_displacement(w, c)
    for p in range(len(pairs)):
        pairs[p] = relative_displacement(w, t.pair_clusters[p, 0], t.pair_clusters[p, 1], t.pair_common[p])


def buffers(tables: RobotTables) -> tuple[np.ndarray, np.ndarray, Workspace]:
    return new_buffers(Workspace, **workspace_dimensions(tables.arrays))


def placed(tables: RobotTables, q: np.ndarray) -> tuple[Workspace, list[np.ndarray]]:
    """The joints at a state, and the world centers of all spheres, cluster by cluster."""
    t, (wi, wf, w) = tables.arrays, buffers(tables)
    place(*tables.packed, wi, wf, q)
    ends = [*t.body_root[1:], len(t.node_first)]
    found = []
    for first, count in t.cluster_bodies:
        rows = []
        for b in range(first, first + count):
            j, nodes = t.body_joint[b], slice(int(t.body_root[b]), int(ends[b]))
            rows.append(t.node_center[nodes] @ w.rotation[j].T + w.origin[j])
        found.append(np.concatenate(rows))
    return w, found


def in_frame(points: np.ndarray, frames: Workspace, joint: int) -> np.ndarray:
    return (points - frames.origin[joint]) @ frames.rotation[joint]


def check(tables: RobotTables, middle: np.ndarray, step: np.ndarray, deviation: np.ndarray, seed: int) -> float:
    """Compare bounds with samples; return the largest ratio of what moves to its bound."""
    t, rng = tables.arrays, np.random.default_rng(seed)
    w, here = placed(tables, middle)
    clusters, pairs = np.empty(len(t.cluster_joint)), np.empty(len(t.pair_common))
    bound(*tables.packed, *buffers(tables)[:2], middle, step, deviation, clusters, pairs)
    tightest = 0.0
    for along in [-1.0, 1.0, *rng.uniform(-1.0, 1.0, 4)]:
        q = middle + along * step + rng.choice([-1.0, 0.0, 1.0], len(step)) * deviation
        there_frames, there = placed(tables, q)
        for c in range(len(here)):
            moved = np.linalg.norm(there[c] - here[c], axis=1).max()
            assert moved <= clusters[c] + 1e-9
            tightest = max(tightest, moved / (clusters[c] + 1e-9))
        for (a, b), common, most in zip(t.pair_clusters, t.pair_common, pairs, strict=True):
            moves = [in_frame(there[k], there_frames, common) - in_frame(here[k], w, common) for k in (a, b)]
            assert cdist(*moves).max() <= most + 1e-9
    return tightest


@settings(max_examples=10)
@given(seed=st.integers(0, 10**6), size=st.floats(1e-3, 1.0), curved=st.floats(0.0, 0.3))
def test_spheres_of_random_trees_stay_within_their_bounds(seed: int, size: float, curved: float) -> None:
    tables, *_ = random_robot(seed)
    rng = np.random.default_rng(seed)
    step, deviation = rng.normal(0.0, size, tables.dof), np.abs(rng.normal(0.0, size * curved, tables.dof))
    over = (np.abs(step) + deviation).max() / 0.9  # the balls of clusters hold inside the limits, which are 1
    step, deviation = step / max(1.0, over), deviation / max(1.0, over)
    inside = 1.0 - np.abs(step) - deviation
    check(tables, rng.uniform(-inside, inside), step, deviation, seed)


@pytest.mark.parametrize("size", [0.01, 0.1, 0.4])
@pytest.mark.parametrize("which", ["robot", "baxter"])
def test_spheres_of_real_robots_stay_within_their_bounds(
    which: str, size: float, request: pytest.FixtureRequest
) -> None:
    robot: Robot = request.getfixturevalue(which)
    tables = CollisionChecker(robot).kernel.robot
    rng = np.random.default_rng(6)
    tightest = 0.0
    for q in states_around_home(robot, rng, 3):
        step = rng.normal(0.0, size, robot.dof)
        step[robot.groups.get("hands", [])] *= 0.1
        inner = np.clip(q, robot.limits.lower + np.abs(step), robot.limits.upper - np.abs(step))
        tightest = max(tightest, check(tables, inner, step, np.abs(rng.normal(0.0, 0.01 * size, robot.dof)), 1))
    assert tightest > 0.35  # a bound that is far off would be useless


def test_functions_that_only_compiled_ones_call_say_so() -> None:
    inner = outlined(lambda x: x + 1.0)

    @uncached
    def outer(x):  # type: ignore[no-untyped-def]
        return inner(x)

    assert outer(1.0) == 2.0
    with pytest.raises(TypeError):
        inner(1.0)
