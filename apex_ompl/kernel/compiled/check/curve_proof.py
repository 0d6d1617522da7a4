"""Proof that a whole curve is free, and its least clearance, by branch and bound.

Intervals of the curve are bisected, breadth first. On each the sphere covers are tried first, for all pairs at once.
The few pairs that they leave are bounded by their exact shapes
(:func:`apex_ompl.kernel.compiled.check.pair_distance.pair_bound`); a pair that is not decided goes on to the two halves
of the interval, alone. Bounds are compared with a margin: 0 for a bare proof; for the least clearance c it is a limit,
or the least distance found so far less a tolerance, so that in the end margin <= c <= found. Bearings do not count for
it (:mod:`apex_ompl.kernel.compiled.check.clearance_table`). A pair that is nearer than ``touch`` at a state in the
middle of an interval counts as touching.
"""

from __future__ import annotations

from typing import Annotated, NamedTuple

from apex_ompl.kernel.compiled.arrays import RobotArrays, SceneArrays, robot_view, scene_view
from apex_ompl.kernel.compiled.check.clearance_table import proved_by_table
from apex_ompl.kernel.compiled.check.curve import set_motion, set_state
from apex_ompl.kernel.compiled.check.pair_distance import pair_bound
from apex_ompl.kernel.compiled.check.relative_motion import Frames
from apex_ompl.kernel.compiled.check.separation import tables_hold, unproved
from apex_ompl.kernel.compiled.compilation import entry_point, inlined
from apex_ompl.kernel.compiled.geometry.shapes import PairBuffers, ShapeArrays, pair_view, shapes_view
from apex_ompl.kernel.compiled.layout import Floats, Integers, Singles, buffer_view
from apex_ompl.kernel.compiled.robot.kinematics import place_part, place_robot
from apex_ompl.kernel.compiled.robot.motion_bound import bound_displacements
from apex_ompl.kernel.compiled.workspace import Workspace, workspace_view

PROVED, MORE, TOUCHING, UNDECIDED, OUTSIDE = range(5)  # outcomes
QUEUE = 1 << 14  # intervals that wait
MOST_UNPROVED = 2048  # pairs that the spheres leave on one interval
MANY = 12  # pairs from which a long interval is bisected first
SHORT = 0.01  # share of the curve below which an interval is not long
SHORTEST = 1e-11  # share of the curve below which a pair that is still open is not divided further
ALL = -1  # stands for all pairs


class ProofBuffers(NamedTuple):
    """State of a proof between calls.

    Attributes:
        places: First and one after the last interval in the queue, which goes around; intervals so far.
        pairs: Body and other body, or -1 - obstacle; ALL for all pairs; of each interval in the queue.
        found: Pairs that the spheres leave.
        worst: The pair with the least distance found.
        intervals: Start and end of each interval in the queue.
        figures: Margin, least distance found, where on the curve, and the length that spheres alone proved.
        where: Middle of the last interval.
        state: State in the middle.
    """

    places: Annotated[Integers, 3]
    pairs: Annotated[Integers, QUEUE, 2]
    found: Annotated[Integers, MOST_UNPROVED, 2]
    worst: Annotated[Integers, 2]
    intervals: Annotated[Floats, QUEUE, 2]
    figures: Annotated[Floats, 4]
    where: Annotated[Floats, 1]
    state: Annotated[Floats, "dof"]


_proof_view = buffer_view(ProofBuffers, ("dof",))
MARGIN, LEAST, WHERE, BY_SPHERES = range(4)  # of the figures


@inlined
def _append(p: ProofBuffers, a: float, b: float, first: int, second: int) -> None:
    k = p.places[1] % QUEUE
    p.intervals[k, 0], p.intervals[k, 1], p.pairs[k, 0], p.pairs[k, 1] = a, b, first, second
    p.places[1] += 1


@inlined
def _record(
    p: ProofBuffers, distance: float, where: float, a: int, b: int, tolerance: float, share: float
) -> None:  # fmt: skip
    """Keep the least distance found, and lower the margin to it less the larger tolerance, at most by half."""
    if distance < p.figures[LEAST]:
        p.figures[LEAST], p.figures[WHERE], p.worst[0], p.worst[1] = distance, where, a, b
        if tolerance > 0.0:
            least = distance - max(tolerance, share * distance)
            p.figures[MARGIN] = min(p.figures[MARGIN], max(least, 0.5 * distance))


@inlined
def _place_parts(t: RobotArrays, w: Workspace, q: Floats, a: int, b: int) -> None:
    """Place the parts of clusters that body ``a`` and, if it is one, body ``b`` belong to."""
    for p in range(len(t.part_bodies)):
        first, count = t.part_bodies[p, 0], t.part_bodies[p, 1]
        if first <= a < first + count or first <= b < first + count:
            place_part(t, w, q, p)


@inlined
def _bound(
    f: Frames, h: ShapeArrays, rows: Integers, g: PairBuffers, a: int, b: int, need: float
) -> tuple[float, float]:
    """Return :func:`pair_bound` of body ``a`` and body ``b``, or obstacle -1 - ``b``, whose shape is in ``rows``."""
    return pair_bound(f, h, a, b if b >= 0 else rows[-1 - b], g, need)


@inlined
def _take(p: ProofBuffers) -> int:
    """Return the place of the next interval in the queue: the oldest, or the newest where the queue is getting full."""
    p.places[2] += 1
    if p.places[1] - p.places[0] < QUEUE // 2:
        p.places[0] += 1
        return int((p.places[0] - 1) % QUEUE)
    p.places[1] -= 1
    return int(p.places[1] % QUEUE)


@inlined
def _place(t: RobotArrays, w: Workspace, p: ProofBuffers) -> bool:
    """Place the robot at the state in the middle; false where the tables do not hold for it.

    The curve stays inside the limits, also where the box around an interval of it does not.
    """
    for i in range(len(p.state)):
        w.end[i], w.half_width[i] = w.half_width[i], 0.0
    holds = tables_hold(t, p.state, w.half_width)
    for i in range(len(p.state)):
        w.half_width[i] = w.end[i]
    if holds:
        place_robot(t, w, p.state)
    return holds


@inlined
def _left_by_spheres(
    t: RobotArrays, s: SceneArrays, w: Workspace, p: ProofBuffers, a: float, b: float, shortest: float
) -> int:
    """Put the pairs that the spheres leave into ``found``, or append both halves of an interval that has too many.

    Returns:
        The number of pairs, or -1 where an interval got too short.
    """
    limit = len(p.found) if b - a <= SHORT * shortest / SHORTEST else MANY
    bound_displacements(t, w)
    w.margin[0] = p.figures[MARGIN]
    count = unproved(t, s, w, p.state, p.found[:limit])
    w.margin[0] = 0.0
    if count == limit:
        if b - a <= shortest:
            return -1
        middle = 0.5 * (a + b)
        _append(p, a, middle, ALL, ALL)
        _append(p, middle, b, ALL, ALL)
        return 0
    if count == 0:
        p.figures[BY_SPHERES] += b - a
    return count


@inlined
def _by_table(t: RobotArrays, q: Floats, half_width: Floats, a: int, b: int, margin: float) -> bool:
    """Whether two bodies have a table that proves them apart over a box of states, by a margin unless a bearing."""
    for k in range(len(t.bodies)):
        if t.bodies_table[k] >= 0 and t.bodies[k, 0] == a and t.bodies[k, 1] == b:
            return proved_by_table(t, k, q, half_width, margin)
    return False


@inlined
def _left_by_tables(t: RobotArrays, w: Workspace, p: ProofBuffers, count: int) -> int:
    """Keep of ``count`` pairs in ``found`` those that no table proves, and return their number."""
    left = 0
    for m in range(count):
        x, y = p.found[m, 0], p.found[m, 1]
        if y < 0 or not _by_table(t, p.state, w.half_width, x, y, p.figures[MARGIN]):
            p.found[left, 0], p.found[left, 1] = x, y
            left += 1
    return left


@inlined
def _by_shapes(
    t: RobotArrays, w: Workspace, h: ShapeArrays, rows: Integers, g: PairBuffers, p: ProofBuffers,
    a: float, b: float, count: int, shortest: float, touch: float, tolerance: float, share: float,
) -> int:  # fmt: skip
    """Bound the pairs in ``found`` by their shapes; append both halves of the interval for those that stay open.

    Returns:
        PROVED, TOUCHING or UNDECIDED.
    """
    middle = 0.5 * (a + b)
    f = Frames(
        t.joint_parent, t.joint_kind, t.joint_source, t.joint_ratio, w.rotation, w.origin, w.step, w.deviation,
        w.half_width,
    )  # fmt: skip
    for m in range(count):
        x, y = p.found[m, 0], p.found[m, 1]
        if m > 0 and p.found[m - 1, 0] == x and p.found[m - 1, 1] == y:
            continue
        _place_parts(t, w, p.state, x, y)
        bound, upper = _bound(f, h, rows, g, x, y, p.figures[MARGIN])
        _record(p, upper, middle, x, y, tolerance, share)
        if upper <= touch:
            return TOUCHING
        if bound > 0.0 and bound >= p.figures[MARGIN]:
            continue
        if b - a <= shortest:
            return UNDECIDED
        _append(p, a, middle, x, y)
        _append(p, middle, b, x, y)
    return PROVED


@entry_point
def prove_curve(
    ri: Integers, rf: Floats, si: Integers, sf: Floats, sg: Singles, hi: Integers, hf: Floats, rows: Integers,
    wi: Integers, wf: Floats, gi: Integers, gf: Floats, pi: Integers, pf: Floats,
    knots: Floats, states: Floats, rates: Floats, slack: float, touch: float, tolerance: float, share: float,
    budget: int,
) -> int:  # fmt: skip
    """Prove a curve free, for at most ``budget`` intervals; another call goes on.

    Robot, scene and shapes come packed; ``rows`` gives the shape of an obstacle by its number. Then come the buffers of
    a state, of a pair and of the proof, in which the whole curve is the first interval. ``knots``, ``states``,
    ``rates`` and ``slack`` are the curve, see :func:`.curve.set_motion`; ``touch`` is the distance that counts as
    contact [m], ``tolerance`` that of the least clearance [m], 0 for a bare proof, and ``share`` the same as a share of
    it; the larger one counts.

    Returns:
        PROVED, MORE, TOUCHING (the pair is in ``worst``), UNDECIDED where an
        interval got too short, or OUTSIDE at a state for which the tables do not hold.
    """
    t, s, h = robot_view(ri, rf), scene_view(si, sf, sg), shapes_view(hi, hf)
    w, g, p = workspace_view(t, wi, wf), pair_view(gi, gf, ()), _proof_view(pi, pf, (len(t.lower),))
    whole = knots[len(knots) - 1] - knots[0]
    shortest = SHORTEST * whole
    while p.places[0] < p.places[1] and budget > 0:
        budget -= 1
        e = _take(p)
        a, b, first, second = p.intervals[e, 0], p.intervals[e, 1], p.pairs[e, 0], p.pairs[e, 1]
        p.where[0] = 0.5 * (a + b)
        set_state(knots, states, rates, p.where[0], p.state)
        set_motion(knots, states, rates, slack, a, b, p.state, w)
        if not _place(t, w, p):
            return OUTSIDE
        if p.places[1] - p.places[0] > QUEUE - 2 * MOST_UNPROVED:
            return UNDECIDED
        count = 1
        p.found[0, 0], p.found[0, 1] = first, second
        if first == ALL:
            count = _left_by_spheres(t, s, w, p, a, b, shortest)
            if count < 0:
                return UNDECIDED
        if len(t.table_joints):
            count = _left_by_tables(t, w, p, count)
        outcome = _by_shapes(t, w, h, rows, g, p, a, b, count, shortest, touch, tolerance, share)
        if outcome != PROVED:
            return outcome
    return PROVED if p.places[0] == p.places[1] else MORE
