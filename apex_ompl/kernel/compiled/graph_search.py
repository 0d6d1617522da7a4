"""Shortest paths in graphs of states."""

from __future__ import annotations

import numpy as np

from apex_ompl.kernel.compiled.compilation import entry_point, inlined
from apex_ompl.kernel.compiled.layout import Floats, Integers


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
    begins: Integers, ends: Integers, lengths: Floats, usable: Integers, entry: Floats, leave: Floats,
    heuristic: Floats, cost: Floats, parent: Integers, keys: Floats, nodes: Integers,
) -> int:  # fmt: skip
    """Return the last node of a shortest path, found by A* (Hart, Nilsson and Raphael 1968), or -1 without one.

    The path goes from a start over a node to enter by, along edges, to a node to leave by, and to a goal.

    Args:
        begins: First edge of each node, shape (N + 1,).
        ends: Node that each directed edge leads to, shape (E,).
        lengths: Length of each edge, shape (E,).
        usable: 0 for edges that may not be used, shape (E,).
        entry: Length of the way from the start to each node, shape (N,); infinite where there is none.
        leave: Length of the way from each node to a goal, shape (N,); infinite where there is none.
        heuristic: Consistent lower bound on the length of the way to a goal, shape (N,).
        cost: Filled with the length of the way to each node, shape (N,).
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
        for e in range(begins[i], begins[i + 1]):
            j, way = ends[e], cost[i] + lengths[e]
            if usable[e] and way < cost[j]:
                cost[j], parent[j] = way, e
                size = _push(keys, nodes, size, way + heuristic[j], j)
    return last
