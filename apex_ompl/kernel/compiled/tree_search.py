"""RRT-Connect (Kuffner and LaValle, 2000) in compiled code, on what the spheres prove.

Of two trees of states, one of starts and one of goals, the smaller grows: its node that is nearest to a random state
makes a step of at most a given length towards it, and the other tree then goes straight for the new node as far as it
can. (Balanced trees, LaValle, Planning Algorithms, 2006, section 5.5.3. Where trees grow in turn, the one in the open
fills the room while the other is still in a narrow place.)

Motions are checked as elsewhere in a search: states of a grid over them, and intervals as a whole where the bounds on
displacements suffice. A state that the spheres do not prove free counts as blocked, whether it collides or not, so that
no mesh is asked: where the free space is narrower than the spheres are good, these trees find nothing, and others must.
"""

from __future__ import annotations

import math

from apex_ompl.kernel.compiled.arrays import robot_view, scene_view
from apex_ompl.kernel.compiled.compilation import entry_point, inlined
from apex_ompl.kernel.compiled.layout import Floats, Integers, Singles
from apex_ompl.kernel.compiled.motion_proof import is_motion_proved
from apex_ompl.kernel.compiled.workspace import workspace_view


@inlined
def _nearest(states: Floats, count: int, q: Floats, squares: Floats) -> int:
    """Return the node of a tree that is nearest to a state; ``states`` are columns, shape (dof, M)."""
    room = squares[:count]
    for n in range(len(room)):
        room[n] = 0.0
    for i in range(len(q)):
        row, value = states[i, :count], q[i]
        for n in range(len(row)):
            apart = row[n] - value
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
        longest: Longest step [rad].
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
        counts: Gets numbers of what was proved, see :func:`apex_ompl.kernel.compiled.motion_proof.prove_path`.

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
                near = _nearest(states[tree], sizes[tree], target, squares)
            square = 0.0
            for i in range(dof):
                motion[0, i] = states[tree, i, near]
                square += (target[i] - motion[0, i]) ** 2
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
