"""Searches in compiled code: RRT-Connect on what the spheres prove, and shortest paths in graphs of states.

RRT-Connect (Kuffner and LaValle, 2000): of two trees of states, one of starts and one of goals, the smaller grows. Its
node that is nearest to a random state makes a step of at most a given length towards it, and the other tree then goes
straight for the new node as far as it can. (Balanced trees, LaValle, Planning Algorithms, 2006, section 5.5.3. Where
trees grow in turn, the one in the open fills the room while the other is still in a narrow place.)

Motions are checked as elsewhere in a search: states of a grid over them, and intervals as a whole where the bounds on
displacements suffice. A state that the spheres do not prove free counts as blocked, whether it collides or not, so that
no mesh is asked. Where the free space is narrower than the error of the spheres, these trees find nothing.
"""

from __future__ import annotations

import math

import numpy as np

from apex_ompl.kernel.compiled.arrays import robot_view, scene_view
from apex_ompl.kernel.compiled.check.motion_proof import is_motion_proved
from apex_ompl.kernel.compiled.compilation import entry_point, inlined
from apex_ompl.kernel.compiled.layout import Floats, Integers, Singles
from apex_ompl.kernel.compiled.workspace import workspace_view


@inlined
def nearest(states: Floats, count: int, q: Floats, weight: Floats, squares: Floats) -> int:
    """Return the node of a tree that is nearest to a state; ``states`` are columns, shape (dof, M)."""
    room = squares[:count]
    for n in range(len(room)):
        room[n] = 0.0
    for i in range(len(q)):
        row, value, factor = states[i, :count], q[i], weight[i]
        for n in range(len(row)):
            apart = (row[n] - value) * factor
            room[n] += apart * apart
    best = 0
    for n in range(len(room)):
        if room[n] < room[best]:
            best = n
    return best


@entry_point
def grow_trees(
    ri: Integers, rf: Floats, si: Integers, sf: Floats, sg: Singles, wi: Integers, wf: Floats,
    samples: Floats, longest: float, resolution: float,
    states: Floats, parents: Integers, sizes: Integers, met: Integers, squares: Floats, target: Floats,
    motion: Floats, starts: Integers, queue: Integers, ends: Integers, state: Floats, found: Integers, counts: Integers,
) -> int:  # fmt: skip
    """Let two trees grow by one random state after the other until they meet, or there is no more room.

    Args:
        ri: Robot, packed; see :func:`apex_ompl.kernel.compiled.layout.pack`.
        rf: Robot.
        si: Scene, packed.
        sf: Scene.
        sg: Scene.
        wi: Workspace, see :func:`apex_ompl.kernel.compiled.workspace.workspace_sizes`.
        wf: Workspace.
        samples: Random states, shape (N, dof).
        longest: Longest step, of joints weighed as in distances [rad].
        resolution: Largest spacing of the states that are checked [rad, max-norm].
        states: Nodes of the trees as columns, shape (2, dof, M).
        parents: Their parents, -1 for roots, shape (2, M).
        sizes: Numbers of nodes, and of the tree whose turn it is where they are equal, shape (3,).
        met: Gets the nodes at which the trees met, shape (2,).
        squares: Memory, shape (M,).
        target: Memory, shape (dof,).
        motion: Memory, shape (2, dof).
        starts: Memory, shape (2,).
        queue: Memory, twice as many rows as a step has states, and 4.
        ends: Memory, shape (3,).
        state: Memory, shape (dof,).
        found: Memory, shape (1, 2).
        counts: Gets numbers of what was proved, see :func:`apex_ompl.kernel.compiled.check.motion_proof.prove_path`.

    Returns:
        The number of random states that were used; ``met`` is -1 where the trees did not meet by them.
    """
    t, s = robot_view(ri, rf), scene_view(si, sf, sg)
    w = workspace_view(t, wi, wf)
    dof, room = states.shape[1], states.shape[2]
    met[0] = met[1] = -1
    for k in range(len(samples)):
        first = sizes[2] if sizes[0] == sizes[1] else int(sizes[1] < sizes[0])
        sizes[2] = 1 - first
        tree, new, near = first, -1, -1
        for i in range(dof):
            target[i] = samples[k, i]
        while True:
            if sizes[tree] == room:
                return k
            if near < 0:
                near = nearest(states[tree], sizes[tree], target, t.weight, squares)
            square = 0.0
            for i in range(dof):
                motion[0, i] = states[tree, i, near]
                square += ((target[i] - motion[0, i]) * t.weight[i]) ** 2
            share = 1.0 if square <= longest * longest else longest / math.sqrt(square)
            for i in range(dof):
                motion[1, i] = target[i] if share == 1.0 else motion[0, i] + share * (target[i] - motion[0, i])
            if not is_motion_proved(t, s, w, motion, resolution, starts, queue, ends, state, found, counts):
                break
            node = sizes[tree]
            for i in range(dof):
                states[tree, i, node] = motion[1, i]
            parents[tree, node] = near
            sizes[tree] = node + 1
            if tree != first:
                if share == 1.0:
                    met[first], met[tree] = new, node
                    return k + 1
                near = node
                continue
            for i in range(dof):  # the other one goes for it
                target[i] = motion[1, i]
            tree, new, near = 1 - first, node, -1
    return len(samples)


@inlined
def _push(keys: Floats, nodes: Integers, size: int, key: float, node: int) -> int:
    """Put a node into a binary heap; return the new size."""
    k = size
    while k > 0 and keys[(k - 1) // 2] > key:
        keys[k], nodes[k] = keys[(k - 1) // 2], nodes[(k - 1) // 2]
        k = (k - 1) // 2
    keys[k], nodes[k] = key, node
    return size + 1


@inlined
def _pop(keys: Floats, nodes: Integers, size: int) -> int:
    """Take the first node out of a binary heap; return the new size."""
    size -= 1
    key, node, k = keys[size], nodes[size], 0
    while 2 * k + 1 < size:
        child = 2 * k + 1
        if child + 1 < size and keys[child + 1] < keys[child]:
            child += 1
        if keys[child] >= key:
            break
        keys[k], nodes[k] = keys[child], nodes[child]
        k = child
    keys[k], nodes[k] = key, node
    return size


@entry_point
def shortest_path(
    first: Integers, ends: Integers, lengths: Floats, usable: Integers, entry: Floats, leave: Floats,
    heuristic: Floats, cost: Floats, parent: Integers, keys: Floats, nodes: Integers,
) -> int:  # fmt: skip
    """Return the last node of a shortest path, found by A* (Hart, Nilsson and Raphael 1968), or -1 without one.

    The path goes from a start over a node to enter by, along edges, to a node to leave by, and to a goal.

    Args:
        first: First edge of each node, shape (N + 1,).
        ends: Node that each directed edge leads to, shape (E,).
        lengths: Length of each edge, shape (E,).
        usable: 0 for edges that may not be used, shape (E,).
        entry: Distance from the start to each node, shape (N,); infinite where there is none.
        leave: Distance from each node to a goal, shape (N,); infinite where there is none.
        heuristic: Consistent lower bound on the distance to a goal, shape (N,).
        cost: Filled with the distance to each node, shape (N,).
        parent: Filled with the edge by which each node is reached, shape (N,); -1 from the start.
        keys: Buffer, shape (N + E,).
        nodes: Buffer, shape (N + E,).
    """
    size, best, last = 0, np.inf, -1
    for i in range(len(entry)):
        cost[i], parent[i] = entry[i], -1
        if entry[i] < np.inf:
            size = _push(keys, nodes, size, entry[i] + heuristic[i], i)
    while size > 0 and keys[0] < best:
        key, i = keys[0], nodes[0]
        size = _pop(keys, nodes, size)
        if key > cost[i] + heuristic[i]:
            continue
        if cost[i] + leave[i] < best:
            best, last = cost[i] + leave[i], i
        for e in range(first[i], first[i + 1]):
            j, found = ends[e], cost[i] + lengths[e]
            if usable[e] and found < cost[j]:
                cost[j], parent[j] = found, e
                size = _push(keys, nodes, size, found + heuristic[j], j)
    return last
