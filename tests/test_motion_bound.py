"""How far spheres move along motions: the kernel's bounds against samples."""

from __future__ import annotations

import inspect
from typing import Any

import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from random_robots import random_robot
from support import states_around_home

from apex_ompl.collision import CollisionChecker
from apex_ompl.kernel.compiled.compilation import OPTIONS
from apex_ompl.kernel.compiled.kinematics import place_joint, place_robot
from apex_ompl.kernel.compiled.layout import layout
from apex_ompl.kernel.compiled.motion_bound import bound_displacements, cluster_displacement, relative_displacement
from apex_ompl.kernel.compiled.workspace import Workspace, workspace_dimensions
from apex_ompl.kernel.tables import RobotTables
from apex_ompl.robot import Robot


def from_python(function: Any) -> Any:
    """A function that only compiled ones call, compiled for calls from Python."""
    names = ", ".join(inspect.signature(function.py_func).parameters)
    space = {"function": function}
    exec(f"def call({names}):\n    return function({names})", space)
    return numba.njit(**OPTIONS)(space["call"])


place_all, place_one, bound_all, cluster_bound, relative_bound = map(
    from_python, (place_robot, place_joint, bound_displacements, cluster_displacement, relative_displacement)
)


def workspace(tables: RobotTables) -> Workspace:
    dimensions = workspace_dimensions(tables.arrays)
    work = Workspace(*(np.zeros(field.sized(dimensions), field.dtype) for field in layout(Workspace)))
    work.rotation[0] = np.eye(3)
    return work


def placed(tables: RobotTables, q: np.ndarray) -> tuple[Workspace, list[np.ndarray]]:
    """The joints at a state, and the world centres of all spheres, cluster by cluster."""
    t, w = tables.arrays, workspace(tables)
    place_all(t, w, q)
    for j in t.lazy:
        place_one(t, w, q, int(j))
    ends = [*t.body_root[1:], len(t.node_first)]
    found = []
    for first, count in t.cluster_bodies:
        rows = []
        for b in range(first, first + count):
            j, nodes = t.body_joint[b], slice(int(t.body_root[b]), int(ends[b]))
            rows.append(t.node_centre[nodes] @ w.rotation[j].T + w.origin[j])
        found.append(np.concatenate(rows))
    return w, found


def check(tables: RobotTables, middle: np.ndarray, step: np.ndarray, deviation: np.ndarray, seed: int) -> float:
    """Compare bounds with samples; return the largest ratio of what moves to its bound."""
    t, rng = tables.arrays, np.random.default_rng(seed)
    w, here = placed(tables, middle)
    w.step[:], w.deviation[:], w.half_width[:] = step, deviation, np.abs(step) + deviation
    bound_all(t, w)
    tightest = 0.0
    for along in [-1.0, 1.0, *rng.uniform(-1.0, 1.0, 6)]:
        q = middle + along * step + rng.choice([-1.0, 0.0, 1.0], len(step)) * deviation
        there_frames, there = placed(tables, q)

        def in_frame(points: np.ndarray, frames: Workspace, j: int) -> np.ndarray:
            return (points - frames.origin[j]) @ frames.rotation[j]

        for c in range(len(here)):
            moved = np.linalg.norm(there[c] - here[c], axis=1).max()
            assert moved <= cluster_bound(w, c) + 1e-9
            tightest = max(tightest, moved / (cluster_bound(w, c) + 1e-9))
        for (a, b), common in zip(t.pair_clusters, t.pair_common, strict=True):
            bound = relative_bound(w, int(a), int(b), int(common))
            before, after = (
                in_frame(cloud[a], frames, common)[:, None] - in_frame(cloud[b], frames, common)[None]
                for cloud, frames in ((here, w), (there, there_frames))
            )
            assert np.linalg.norm(after - before, axis=2).max() <= bound + 1e-9
    return tightest


@settings(max_examples=40)
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
    for q in states_around_home(robot, rng, 6):
        step = rng.normal(0.0, size, robot.dof)
        step[robot.groups.get("hands", [])] *= 0.1
        inner = np.clip(q, robot.limits.lower + np.abs(step), robot.limits.upper - np.abs(step))
        tightest = max(tightest, check(tables, inner, step, np.abs(rng.normal(0.0, 0.01 * size, robot.dof)), 1))
    assert tightest > 0.35  # a bound that is far off would be useless


def test_functions_that_only_compiled_ones_call_say_so(robot: Robot) -> None:
    tables = CollisionChecker(robot).kernel.robot
    work = workspace(tables)
    assert cluster_bound(work, 0) == 0.0
    with pytest.raises(TypeError):
        cluster_displacement(work, 0)
