"""Checks of arrays that were read from a file; compiled code trusts its arrays."""

from __future__ import annotations

from typing import Any

import numpy as np

from apex_ompl.kernel.compiled.arrays import BOX, FIXED, HALF_SPACE, PRISMATIC, RobotArrays, SceneArrays
from apex_ompl.kernel.compiled.layout import layout

PARTS = ("cluster_parts", "cluster_range", "part_lazy", "part_bodies", "part_ball", "part_outer")
MADE = {"body_inner", "inner_ball", "pair_ball", "pair_outer", "pair_parts", "run_pairs", *PARTS}
"""Arrays of a robot that make checks faster; they are not stored."""


def head_fault(head: dict[str, Any]) -> str:
    """Return the key of a file's head that is missing or of another type, or an empty string."""
    for key, kind in (("joints", str), ("bodies", str), ("numbers", int)):
        values = head.get(key)
        if not isinstance(values, list) or not all(type(v) is kind for v in values):
            return key
    return "" if isinstance(head.get("name"), str) else "name"


def scene_fault(s: SceneArrays) -> str:
    """Return the name of an array with another type or length, or with numbers out of range; else an empty string."""
    obstacles, boxes = len(s.kind), len(s.tree_skip)
    for field in layout(SceneArrays):
        name, array = field.name, getattr(s, field.name)
        if field.single:
            continue
        if array.dtype != field.dtype or array.shape[1:] != field.shape:
            return name
        size = boxes if name.startswith("tree") else {"open": 1, "allowed": len(s.allowed)}.get(name, obstacles)
        if len(array) != size or not np.isfinite(array).all():
            return name
    if obstacles and not BOX <= s.kind.min() <= s.kind.max() <= HALF_SPACE:
        return "kind"
    closed = obstacles - int(s.open[0])
    if not 0 <= closed <= obstacles or (s.kind[:closed] == HALF_SPACE).any() or (s.kind[closed:] != HALF_SPACE).any():
        return "open"
    if ((s.tree_skip <= np.arange(boxes)) | (s.tree_skip > boxes)).any():
        return "tree_skip"
    first, count = s.tree_range.T
    if boxes and not ((first >= 0) & (count >= 0) & (first <= closed) & (count <= closed - first)).all():
        return "tree_range"
    return ""


def robot_fault(t: RobotArrays, dof: int, bodies: int) -> str:
    """Return the name of an array with a wrong length, or with numbers out of range; else an empty string."""
    return _length_fault(t, dof, bodies) or _range_fault(t, dof, bodies) or _tree_fault(t) or _order_fault(t)


def _length_fault(t: RobotArrays, dof: int, bodies: int) -> str:
    sizes = {"joint": len(t.joint_parent), "cluster": len(t.cluster_joint), "body": bodies}
    sizes |= {"node": len(t.node_first), "pair": len(t.pair_common), "lower": dof, "upper": dof}
    if sizes["joint"] == 0:
        return "joint_parent"
    for name, array in ((name, array) for name, array in t._asdict().items() if name not in MADE):
        if len(array) != sizes.get(name.split("_")[0], len(array)):
            return name
        if array.dtype == np.float64 and not np.isfinite(array).all():
            return name
    return ""


def _range_fault(t: RobotArrays, dof: int, bodies: int) -> str:
    joints, clusters, nodes = len(t.joint_parent), len(t.cluster_joint), len(t.node_first)
    ranges = {
        "joint_parent": (0, joints), "eager": (1, joints), "lazy": (1, joints), "body_root": (0, nodes),
        "cluster_joint": (0, joints), "body_joint": (0, joints), "pair_clusters": (0, clusters),
        "pair_common": (0, joints), "bodies": (0, bodies), "joint_kind": (FIXED, PRISMATIC + 1),
        "joint_source": (-1, dof), "cluster_dof": (-1, dof), "cluster_lazy": (0, len(t.lazy) + 1),
        "cluster_bodies": (0, bodies + 1), "pair_bodies": (0, len(t.bodies) + 1), "node_count": (0, nodes),
    }  # fmt: skip
    for name, (low, high) in ranges.items():
        array = getattr(t, name)
        if array.size and not low <= array.min() <= array.max() < high:
            return name
    for name, most in (("eager", len(t.eager)), ("cluster_lazy", t.cluster_lazy[:, 1].max(initial=0))):
        if most >= joints:
            return name
    for name, size in (("cluster_lazy", len(t.lazy)), ("cluster_bodies", bodies), ("pair_bodies", len(t.bodies))):
        array = getattr(t, name)
        if array.size and array.sum(axis=1).max() > size:
            return name
    if (t.joint_source[t.joint_kind != FIXED] < 0).any():
        return "joint_source"
    for name in ("node_radius", "node_outer", "cluster_outer", "cluster_spread", "cluster_speed"):
        if (getattr(t, name) < 0.0).any():
            return name
    return "cluster_ball" if (t.cluster_ball[:, 3] < 0.0).any() else ""


def _tree_fault(t: RobotArrays) -> str:
    """Bodies must have nodes of their own, and children must follow their parents inside a body."""
    ends = np.append(t.body_root[1:], len(t.node_first))
    if len(t.body_root) and (t.body_root[0] != 0 or (ends <= t.body_root).any()):
        return "body_root"
    body = np.repeat(np.arange(len(t.body_root)), ends - t.body_root)
    inner = np.flatnonzero(t.node_count)
    first, last = t.node_first[inner], t.node_first[inner] + t.node_count[inner]
    if (first <= inner).any() or (last > ends[body[inner]]).any():
        return "node_first"
    if (t.bodies[:, 0] == t.bodies[:, 1]).any():
        return "bodies"
    return "joint_parent" if (t.joint_parent[1:] >= np.arange(1, len(t.joint_parent))).any() else ""


def _order_fault(t: RobotArrays) -> str:
    """Every joint must be placed after its parent, for each cluster, and pairs must name a joint above both."""
    placed = {0}
    for j in t.eager.tolist():
        if int(t.joint_parent[j]) not in placed:
            return "eager"
        placed.add(j)
    for c, top in enumerate(t.cluster_joint.tolist()):
        here = set(placed)
        first, count = t.cluster_lazy[c].tolist()
        for j in t.lazy[first : first + count].tolist():
            if int(t.joint_parent[j]) not in here:
                return "lazy"
            here.add(j)
        first, count = t.cluster_bodies[c].tolist()
        if top not in placed or not set(t.body_joint[first : first + count].tolist()) <= here:
            return "cluster_joint"
    for (a, b), common in zip(t.pair_clusters.tolist(), t.pair_common.tolist(), strict=True):
        if not all(common in _above(t, int(t.cluster_joint[c])) for c in (a, b)):
            return "pair_common"
    return ""


def _above(t: RobotArrays, joint: int) -> set[int]:
    chain = {0, joint}
    while joint > 0:
        joint = int(t.joint_parent[joint])
        chain.add(joint)
    return chain
