"""RRT-Connect on the manifold of constraints, by projection (CBiRRT, Berenson et al. 2009).

Steps towards a random state are projected onto the constraints; a tree goes on as long as they come nearer to it. The
other tree then goes for the last new node in the same way. An edge is as many chords as ``pieces`` says, between
projected states; each chord is proved free as a straight motion, see :mod:`apex_ompl.kernel.compiled.path.search`.
Their distance from the manifold is left to the proof of the whole path.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from apex_ompl.kernel.compiled.arrays import RobotArrays, SceneArrays, robot_view, scene_view
from apex_ompl.kernel.compiled.check.motion_proof import is_motion_proved
from apex_ompl.kernel.compiled.compilation import entry_point, inlined
from apex_ompl.kernel.compiled.constraint.projection import project, rows_view
from apex_ompl.kernel.compiled.constraint.rows import ConstraintArrays, RowBuffers, constraints_view
from apex_ompl.kernel.compiled.layout import Floats, Integers, Singles
from apex_ompl.kernel.compiled.path.search import nearest
from apex_ompl.kernel.compiled.workspace import Workspace, workspace_view

TOLERANCE, STEPS = 1e-6, 10  # of a projection
LEAST_MOVE, MOST_MOVE = 0.05, 2.0  # of a projected step, as shares of its length
SAME = 1e-9  # distance of states that are one [rad]


class ProofBuffers(NamedTuple):
    """Buffers of :func:`apex_ompl.kernel.compiled.check.motion_proof.is_motion_proved`."""

    resolution: float
    starts: Integers
    queue: Integers
    ends: Integers
    state: Floats
    found: Integers
    counts: Integers


@inlined
def _distance(a: Floats, b: Floats) -> float:
    total = 0.0
    for i in range(len(a)):
        total += (a[i] - b[i]) ** 2
    return math.sqrt(total)


@inlined
def _is_chord_free(t: RobotArrays, s: SceneArrays, w: Workspace, motion: Floats, p: ProofBuffers) -> bool:
    return bool(is_motion_proved(t, s, w, motion, p.resolution, p.starts, p.queue, p.ends, p.state, p.found, p.counts))


@inlined
def _is_edge_free(
    t: RobotArrays, s: SceneArrays, w: Workspace, c: ConstraintArrays, begin: Floats, end: Floats, pieces: int,
    motion: Floats, b: RowBuffers, p: ProofBuffers,
) -> bool:  # fmt: skip
    """Whether the chords between projected states from one state of the manifold to another are proved free."""
    dof, most = len(begin), MOST_MOVE * _distance(begin, end) / pieces
    for i in range(dof):
        motion[0, i] = begin[i]
    for n in range(1, pieces + 1):
        for i in range(dof):
            motion[1, i] = end[i] if n == pieces else begin[i] + n / pieces * (end[i] - begin[i])
        if n < pieces and project(t, w, motion[1], c, 1.0, TOLERANCE, STEPS, b) < 0:
            return False
        if _distance(motion[0], motion[1]) > most or not _is_chord_free(t, s, w, motion, p):
            return False
        for i in range(dof):
            motion[0, i] = motion[1, i]
    return True


class Edges(NamedTuple):
    """Edges towards a state.

    Attributes:
        longest: Length of an edge before its projection [rad].
        pieces: Number of its chords.
        target: The state, shape (dof,).
        begin: Start of an edge, shape (dof,).
        end: Its end, shape (dof,).
        motion: Memory, shape (2, dof).
    """

    longest: float
    pieces: int
    target: Floats
    begin: Floats
    end: Floats
    motion: Floats


class Trees(NamedTuple):
    """Two trees.

    Attributes:
        states: Nodes as columns, shape (2, dof, M).
        parents: Their parents, -1 for roots, shape (2, M).
        sizes: Numbers of nodes, shape (2,) or more.
        squares: Memory, shape (M,).
    """

    states: Floats
    parents: Integers
    sizes: Integers
    squares: Floats


@inlined
def _step(
    t: RobotArrays, s: SceneArrays, w: Workspace, c: ConstraintArrays, e: Edges, exact: bool, b: RowBuffers,
    p: ProofBuffers,
) -> bool:  # fmt: skip
    """Put the end of an edge from ``e.begin`` towards the target into ``e.end``; whether it may be added.

    The target is reached itself where it is ``exact``, on the constraints.
    """
    begin, end, target, longest = e.begin, e.end, e.target, e.longest
    apart = _distance(begin, target)
    if apart <= SAME:
        return False
    share = min(1.0, longest / apart)
    last = exact and share == 1.0
    for i in range(len(end)):
        end[i] = target[i] if last else begin[i] + share * (target[i] - begin[i])
    if not last:
        if project(t, w, end, c, 1.0, TOLERANCE, STEPS, b) < 0:
            return False
        moved = _distance(begin, end)
        if moved > MOST_MOVE * longest or moved < LEAST_MOVE * longest or _distance(end, target) >= apart:
            return False
    return _is_edge_free(t, s, w, c, begin, end, e.pieces, e.motion, b, p)


@inlined
def _extend(
    t: RobotArrays, s: SceneArrays, w: Workspace, c: ConstraintArrays, trees: Trees, tree: int, e: Edges,
    exact: bool, b: RowBuffers, p: ProofBuffers,
) -> tuple[int, int]:  # fmt: skip
    """Let a tree go for the target from its nearest node; return that and its last node, -1 where there is no room."""
    root = nearest(trees.states[tree], trees.sizes[tree], e.target, t.weight, trees.squares)
    near, dof = root, len(e.target)
    for i in range(dof):
        e.begin[i] = trees.states[tree, i, near]
    while True:
        node = trees.sizes[tree]
        if node == trees.states.shape[2]:
            return root, -1
        if not _step(t, s, w, c, e, exact, b, p):
            return root, near
        for i in range(dof):
            trees.states[tree, i, node] = e.begin[i] = e.end[i]
        trees.parents[tree, node] = near
        trees.sizes[tree], near = node + 1, node


@entry_point
def grow_constrained_trees(
    ri: Integers, rf: Floats, si: Integers, sf: Floats, sg: Singles, wi: Integers, wf: Floats,
    samples: Floats, longest: float, resolution: float,
    states: Floats, parents: Integers, sizes: Integers, met: Integers, squares: Floats, target: Floats,
    motion: Floats, starts: Integers, queue: Integers, ends: Integers, state: Floats, found: Integers, counts: Integers,
    ci: Integers, cf: Floats, pieces: int, rows: int, bi: Integers, bf: Floats, room: Floats,
) -> int:  # fmt: skip
    """Let two trees grow as :func:`apex_ompl.kernel.compiled.path.search.grow_trees` does, on the constraints.

    Args:
        ri: Robot, packed; see :func:`apex_ompl.kernel.compiled.layout.pack`.
        rf: Robot.
        si: Scene, packed.
        sf: Scene.
        sg: Scene.
        wi: Workspace.
        wf: Workspace.
        samples: Random states, shape (N, dof).
        longest: Length of an edge before its projection [rad].
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
        counts: Gets numbers of what was proved.
        ci: Groups of rows, packed.
        cf: Groups of rows.
        pieces: Number of chords of an edge.
        rows: Number of all rows.
        bi: Buffers, see :func:`apex_ompl.kernel.compiled.constraint.projection.row_buffer_sizes`.
        bf: Buffers.
        room: Memory, shape (2, dof).

    Returns:
        The number of random states that were used; ``met`` is -1 where the trees did not meet by them.
    """
    t, s, c = robot_view(ri, rf), scene_view(si, sf, sg), constraints_view(ci, cf)
    w = workspace_view(t, wi, wf)
    dof = states.shape[1]
    b = rows_view(bi, bf, (rows, dof))
    p = ProofBuffers(resolution, starts, queue, ends, state, found, counts)
    trees, e = Trees(states, parents, sizes, squares), Edges(longest, pieces, target, room[0], room[1], motion)
    met[0] = met[1] = -1
    for k in range(len(samples)):
        first = sizes[2] if sizes[0] == sizes[1] else int(sizes[1] < sizes[0])
        sizes[2] = 1 - first
        for i in range(dof):
            target[i] = samples[k, i]
        root, new = _extend(t, s, w, c, trees, first, e, False, b, p)
        if new < 0:
            return k
        if new == root:
            continue
        for i in range(dof):  # the other one goes for it
            target[i] = states[first, i, new]
        root, node = _extend(t, s, w, c, trees, 1 - first, e, True, b, p)
        if node < 0:
            return k
        if _distance(e.begin, target) <= SAME:
            met[first], met[1 - first] = new, node
            return k + 1
    return len(samples)


@entry_point
def connect_states(
    ri: Integers, rf: Floats, si: Integers, sf: Floats, sg: Singles, wi: Integers, wf: Floats,
    first: Floats, longest: float, resolution: float, target: Floats, nodes: Floats,
    motion: Floats, starts: Integers, queue: Integers, ends: Integers, state: Floats, found: Integers, counts: Integers,
    ci: Integers, cf: Floats, pieces: int, rows: int, bi: Integers, bf: Floats, room: Floats,
) -> int:  # fmt: skip
    """Go from a state of the manifold towards another one in edges as trees do.

    Args:
        ri: Robot, packed.
        rf: Robot.
        si: Scene, packed.
        sf: Scene.
        sg: Scene.
        wi: Workspace.
        wf: Workspace.
        first: The first state, shape (dof,).
        longest: Length of an edge before its projection [rad].
        resolution: Largest spacing of the states that are checked [rad, max-norm].
        target: The last state, shape (dof,).
        nodes: Gets the states after the first one, shape (M, dof).
        motion: Memory; this and what follows as of :func:`grow_constrained_trees`.
        starts: Memory.
        queue: Memory.
        ends: Memory.
        state: Memory.
        found: Memory.
        counts: Gets numbers of what was proved.
        ci: Groups of rows, packed.
        cf: Groups of rows.
        pieces: Number of chords of an edge.
        rows: Number of all rows.
        bi: Buffers.
        bf: Buffers.
        room: Memory.

    Returns:
        How many states there are up to the target, or -1 where it was not reached.
    """
    t, s, c = robot_view(ri, rf), scene_view(si, sf, sg), constraints_view(ci, cf)
    w = workspace_view(t, wi, wf)
    b = rows_view(bi, bf, (rows, len(first)))
    p = ProofBuffers(resolution, starts, queue, ends, state, found, counts)
    e = Edges(longest, pieces, target, room[0], room[1], motion)
    for i in range(len(first)):
        e.begin[i] = first[i]
    for n in range(len(nodes)):
        if not _step(t, s, w, c, e, True, b, p):
            return -1
        for i in range(len(first)):
            nodes[n, i] = e.begin[i] = e.end[i]
        if _distance(e.begin, target) <= SAME:
            return n + 1
    return -1
