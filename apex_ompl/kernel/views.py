"""Inside the kernel: packed arrays taken apart, and room to work in."""

from __future__ import annotations

from typing import NamedTuple

from apex_ompl.kernel.compiled import pasted
from apex_ompl.kernel.tables import Floats, Integers, RobotArrays, SceneArrays


@pasted
def _ints(i: Integers, k: int) -> Integers:
    return i[i[2 * k] : i[2 * k + 1]]


@pasted
def _floats(i: Integers, f: Floats, k: int) -> Floats:
    return f[i[2 * k] : i[2 * k + 1]]


@pasted
def robot_view(i: Integers, f: Floats) -> RobotArrays:
    """Take apart what ``pack`` made of a robot's arrays."""
    return RobotArrays(
        _ints(i, 0), _ints(i, 1), _ints(i, 2), _ints(i, 3), _ints(i, 4),
        _ints(i, 5), _ints(i, 6).reshape(-1, 2), _ints(i, 7), _ints(i, 8).reshape(-1, 2), _ints(i, 9),
        _ints(i, 10), _ints(i, 11), _ints(i, 12), _ints(i, 13),
        _ints(i, 14).reshape(-1, 2), _ints(i, 15), _ints(i, 16).reshape(-1, 2), _ints(i, 17).reshape(-1, 2),
        _floats(i, f, 18).reshape(-1, 3, 3), _floats(i, f, 19).reshape(-1, 3), _floats(i, f, 20), _floats(i, f, 21),
        _floats(i, f, 22), _floats(i, f, 23), _floats(i, f, 24).reshape(-1, 4), _floats(i, f, 25),
        _floats(i, f, 26), _floats(i, f, 27), _floats(i, f, 28).reshape(-1, 3), _floats(i, f, 29), _floats(i, f, 30),
    )  # fmt: skip


@pasted
def scene_view(i: Integers, f: Floats) -> SceneArrays:
    """Take apart what ``pack`` made of a scene's arrays."""
    return SceneArrays(
        _ints(i, 0), _ints(i, 1), _ints(i, 2), _ints(i, 3).reshape(-1, 2), _ints(i, 4),
        _floats(i, f, 5).reshape(-1, 3, 3), _floats(i, f, 6).reshape(-1, 3), _floats(i, f, 7).reshape(-1, 3),
        _floats(i, f, 8).reshape(-1, 3), _floats(i, f, 9).reshape(-1, 3),
    )  # fmt: skip


class Work(NamedTuple):
    """Room for one state; J joints, C clusters, B bodies, N nodes.

    ``turn`` (J, 3, 3) and ``origin`` (J, 3) are the joints in the world; ``ball`` (C, 3) the centres of the clusters'
    balls, ``opened`` (C,) whether inner joints and ``root`` (B, 3), the centres of the bodies' outermost spheres, are
    known. ``stack`` holds nodes that wait, ``flags`` (1,) whether clusters move. Then, relative to the frames of joints
    above a cluster, (C, J): ``sway`` bounds how far the centre of any of its spheres moves; so does the length of
    ``drift`` (C, J, 3) with ``rest`` added to it. ``step``, ``stray``, ``reach`` and ``end`` (dof,) describe motions,
    see :func:`apex_ompl.kernel.kinematics.bound_motion`; ``pair`` (1, 2) is for who needs it.
    """

    turn: Floats
    origin: Floats
    ball: Floats
    opened: Integers
    root: Floats
    sway: Floats
    stack: Integers
    flags: Integers
    drift: Floats
    rest: Floats
    step: Floats
    stray: Floats
    reach: Floats
    end: Floats
    pair: Integers


def room(arrays: RobotArrays) -> tuple[int, int]:
    """Return how many integers and floats one call of the kernel needs to work in."""
    joints, clusters = len(arrays.joint_parent), len(arrays.cluster_joint)
    floats = 12 * joints + 3 * clusters + 3 * len(arrays.body_joint) + 5 * clusters * joints + 4 * len(arrays.lower)
    return clusters + 3 + 2 * len(arrays.node_first) + 2, floats


@pasted
def work_view(t: RobotArrays, i: Integers, f: Floats) -> Work:
    """Take apart room of the size that :func:`room` says."""
    joints, clusters, bodies, dof = len(t.joint_parent), len(t.cluster_joint), len(t.body_joint), len(t.lower)
    a = 9 * joints
    b = a + 3 * joints
    c = b + 3 * clusters
    d = c + 3 * bodies
    chains = clusters * joints
    e = d + 5 * chains
    work = Work(
        f[:a].reshape(joints, 3, 3), f[a:b].reshape(joints, 3), f[b:c].reshape(clusters, 3), i[:clusters],
        f[c:d].reshape(bodies, 3), f[d : d + chains].reshape(clusters, joints), i[clusters + 3 :],
        i[clusters + 2 : clusters + 3], f[d + chains : d + 4 * chains].reshape(clusters, joints, 3),
        f[d + 4 * chains : e].reshape(clusters, joints), f[e : e + dof], f[e + dof : e + 2 * dof],
        f[e + 2 * dof : e + 3 * dof], f[e + 3 * dof : e + 4 * dof], i[clusters : clusters + 2].reshape(1, 2),
    )  # fmt: skip
    for k in range(3):
        work.origin[0, k] = 0.0
        for m in range(3):
            work.turn[0, k, m] = 1.0 if k == m else 0.0
    for k in range(dof):
        work.reach[k] = 0.0
    work.flags[0] = 0
    return work
