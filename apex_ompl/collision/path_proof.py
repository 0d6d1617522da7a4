"""Proofs that whole paths and motions are free, with their least clearance, and which motions a change may block.

The algorithm is that of the kernel's ``curve_proof``.
"""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from collections.abc import Hashable, Iterable, Iterator
from dataclasses import dataclass, replace
from weakref import WeakKeyDictionary

import numpy as np

from apex_ompl.collision.exact_shapes import PlacedShape, joined, placed_after, rearranged, shape_arrays
from apex_ompl.collision.mesh_stage import MeshStage
from apex_ompl.collision.solids import Solid
from apex_ompl.collision.tables import joint_tree, stored_shapes
from apex_ompl.kernel.arrays import Floats, Integers, ShapeArrays, pack
from apex_ompl.kernel.curve_proof import MORE, OUTSIDE, PROVED, TOUCHING, CurveProof
from apex_ompl.kernel.kernel import Kernel
from apex_ompl.kernel.products import product
from apex_ompl.kernel.scene_builder import primitive, scene_tables
from apex_ompl.kernel.tables import with_pairs
from apex_ompl.kernel.timing import cubic_rates
from apex_ompl.paths.path import SEARCH_RESOLUTION
from apex_ompl.robot import Robot
from apex_ompl.types import Array, Flags
from apex_ompl.util.arrays import compact, distinct
from apex_ompl.util.forking import ProcessLock

MOST_PACKED = 64  # sets of held objects that are kept for each robot
TOUCH = 1e-5  # distance that counts as contact [m]
TOLERANCE = 1e-5  # of the least clearance [m]
SEEDS = 9  # states whose spheres show what clearance to look for
SLACK, MOST_LIMIT = 0.01, 0.5  # of what the spheres are larger than the shapes, and of that clearance [m]
BUDGET = 1000  # intervals between two readings of the clock: some milliseconds


MOST_SCENES = 2  # whose packed shapes are kept

_links: WeakKeyDictionary[Robot, ShapeArrays] = WeakKeyDictionary()
_bodies: WeakKeyDictionary[Robot, OrderedDict[int, tuple[Array, ShapeArrays]]] = WeakKeyDictionary()


_packed: OrderedDict[Hashable, tuple[ShapeArrays, list[PlacedShape], tuple[Integers, Floats]]] = OrderedDict()
"""Packed shapes of the last scenes, which are many numbers where clouds are among them."""


@dataclass(frozen=True)
class Curve:
    """A curve through the joint space: straight lines between states, or the cubic pieces of a motion.

    Attributes:
        knots: Increasing parameters of the states, shape (K,): lengths [rad], or times [s].
        states: Shape (K, dof).
        rates: Velocities and accelerations side by side, shape (K, 2 dof); (0, 2 dof) for straight lines.
        slack: Sum of the gaps between the pieces, by rounding [rad].
    """

    knots: Array
    states: Array
    rates: Array
    slack: float

    @classmethod
    def polyline(cls, states: Array) -> Curve:
        """Return straight lines between states, shape (N, dof); their parameter is the length in the max-norm."""
        steps = np.abs(np.diff(states, axis=0)).max(axis=1)
        moves = ~(steps <= 0.0)  # with steps that are not numbers, which are refused later
        states = compact(states[np.append(True, moves)])
        knots = np.append(0.0, np.cumsum(steps[moves]))
        if len(states) == 1:
            states, knots = np.repeat(states, 2, axis=0), np.zeros(2)
        return cls(knots, states, np.empty((0, 2 * states.shape[1])), 0.0)

    @classmethod
    def cubic(cls, times: Array, positions: Array, velocities: Array, accelerations: Array) -> Curve:
        """Return the cubic pieces of a motion, given at its knots, shapes (K,) and (K, dof); the parameter is the time.

        The acceleration is linear between knots.
        """
        if len(times) == 1:
            return cls.polyline(positions)
        t, q, v, a = map(compact, (times, positions, velocities, accelerations))
        return cls(t, q, *cubic_rates((t, q, v, a)))


@dataclass(frozen=True)
class PathProof:
    """Outcome of the proof of a path or a motion.

    Attributes:
        ok: Whether it is proved free.
        reason: Why not: one sentence, empty for a proved path.
        parameter: Where on the curve the fault is, or the least distance found.
        state: The state there, shape (dof,).
        clearance: Least distance of a checked pair that was found at a state [m], infinite where there is no pair, NaN
            for hands outside their limits. Links that a table proves to be apart as in a bearing do not count.
        clearance_bound: Least distance that is proved along the whole curve, bearings apart [m]; 0 without a proof.
        pair: Names of the two bodies at the least distance found; empty where there is none.
        by_spheres: Share of the curve's length that sphere covers and tables proved for all pairs at once; tables and
            exact shapes proved the rest pair by pair.
        intervals: Number of intervals checked.
        timed_out: Whether the deadline passed before the proof ended.
    """

    ok: bool
    reason: str
    parameter: float
    state: Array
    clearance: float
    clearance_bound: float
    pair: tuple[str, str]
    by_spheres: float
    intervals: int
    timed_out: bool = False

    def __bool__(self) -> bool:
        """Whether the curve is proved free."""
        return self.ok

    @classmethod
    def refused(cls, reason: str, curve: Curve) -> PathProof:
        """Return the outcome for a curve whose first state is not free."""
        return cls(False, reason, float(curve.knots[0]), curve.states[0].copy(), 0.0, 0.0, ("", ""), 0.0, 0)


def obstacles_alone(kernel: Kernel, chosen: Flags) -> Kernel:
    """Return a kernel that checks a robot against some obstacles, shape (obstacles,), and not against itself."""
    bodies, scene = kernel.robot.arrays, kernel.scene.arrays
    robot = replace(kernel.robot, arrays=with_pairs(bodies, np.zeros(len(bodies.pair_common), bool)))
    solids = [(int(scene.owner[k]), primitive(kernel.scene, int(k))) for k in np.flatnonzero(chosen)]
    tables = scene_tables(solids)
    return Kernel(robot, replace(tables, arrays=tables.arrays._replace(allowed=scene.allowed)))


def _shapes_of_bodies(robot: Robot, scene: MeshStage, kernel: Kernel) -> ShapeArrays:
    """Return the shapes of a kernel's bodies; those of the links, and of the last sets of held objects, are kept."""
    known = _bodies.setdefault(robot, OrderedDict())
    key = id(kernel.robot.arrays.node_center)  # shared by all kernels of one set of bodies
    if key not in known:
        turns = [turn.T for turn in joint_tree(robot).turns]

        def placed(numbers: Iterable[int]) -> list[PlacedShape]:
            solids = (scene.solids[number] for number in numbers)
            return [PlacedShape(s.shape, s.joint, product(turns[s.joint], s.placement.homogeneous)) for s in solids]

        if robot not in _links:
            _links[robot] = stored_shapes(placed(range(scene.links)))
        held = [number for number in kernel.robot.numbers if number >= scene.links]
        rows = {number: scene.links + k for k, number in enumerate(held)}
        order = [rows.get(number, number) for number in kernel.robot.numbers]
        while len(known) >= MOST_PACKED:
            known.popitem(last=False)
        arrays = rearranged(joined(_links[robot], shape_arrays(placed(held))), order)
        known[key] = kernel.robot.arrays.node_center, arrays
    return known[key][1]


def _pack(bodies: ShapeArrays, obstacles: list[PlacedShape]) -> tuple[Integers, Floats]:
    """Return the packed shapes of bodies and obstacles; those of the last scenes are kept."""
    key = id(bodies), tuple((id(shape.geometry), shape.pose.tobytes()) for shape in obstacles)
    found = _packed.pop(key, None)
    if found is None:
        found = bodies, obstacles, pack(bodies, placed_after(bodies, shape_arrays(obstacles)))
    _packed[key] = found
    while len(_packed) > MOST_SCENES:
        _packed.pop(next(iter(_packed), key), None)
    return found[2]


class PathProver:
    """Proofs for a robot in a scene; safe to use from several threads while the scene is not edited."""

    def __init__(self, robot: Robot, scene: MeshStage) -> None:
        """Prove paths of ``robot`` among the obstacles of ``scene``."""
        self._robot = robot
        self._scene = scene
        self._local = threading.local()
        self._lock = ProcessLock()
        self._placed: dict[int, tuple[Solid, PlacedShape]] = {}
        self._current: tuple[Kernel, tuple[Integers, Floats, Integers]] | None = None

    def _shapes(self, kernel: Kernel) -> tuple[Integers, Floats, Integers]:
        """Return the exact shapes of the bodies and obstacles of a kernel, and the rows of the obstacles by number.

        Those of the last kernel are kept.
        """
        current = self._current
        if current is not None and current[0] is kernel:
            return current[1]
        with self._lock:
            owners = distinct(kernel.scene.arrays.owner).tolist()
            placed = {}
            for number in owners:
                solid = self._scene.solids[number]
                known = self._placed.get(number)
                if known is None or known[0] is not solid:
                    known = solid, PlacedShape(solid.shape, 0, solid.placement.homogeneous)
                placed[number] = known
            self._placed = placed
            bodies = _shapes_of_bodies(self._robot, self._scene, kernel)
            rows = np.full(max(owners, default=-1) + 1, -1, np.int64)
            rows[owners] = len(bodies.kind) + np.arange(len(owners))
            shapes = *_pack(bodies, [shape for _, shape in placed.values()]), rows
            self._current = kernel, shapes
            return shapes

    def prove(
        self, kernel: Kernel, curve: Curve, *, touch: float = TOUCH, tolerance: float = TOLERANCE, share: float = 0.0,
        deadline: float | None = None,
    ) -> PathProof:  # fmt: skip
        """Prove that a curve is free, and find its least clearance.

        Args:
            kernel: The kernel of the scene as it is now, or of some of its obstacles.
            curve: The curve.
            touch: Distance of a pair that counts as contact [m].
            tolerance: Of the least clearance [m]: ``clearance_bound`` is at least ``clearance`` less this, or half of
                it; 0 asks for the proof alone.
            share: The same as a share of the clearance; the larger one counts.
            deadline: Value of ``time.perf_counter`` at which to give up [s].
        """
        if not (np.isfinite(curve.states).all() and np.isfinite(curve.rates).all()):
            return PathProof.refused("a state that is not finite", curve)
        limits: Iterable[float] = (0.0,)
        if tolerance > 0.0:
            places = distinct(np.linspace(0, len(curve.states) - 1, SEEDS).round().astype(int))
            limits = _limits(np.nanmin(kernel.clearance(curve.states[places], MOST_LIMIT), initial=MOST_LIMIT))
        proof, outcome, over = self._run(kernel, curve, limits, (touch, tolerance, share), deadline)
        margin, least, where, by_spheres = proof.figures
        names, ok = self._names(kernel, *proof.pair), outcome == PROVED
        reason, length = "", float(curve.knots[-1] - curve.knots[0])
        if over:
            reason = "not proved in time"
        elif outcome == TOUCHING:
            reason = f"{names[0]} <-> {names[1]} " + ("touch" if least <= 0.0 else f"are {least * 1e6:.2g} um apart")
        elif outcome == OUTSIDE:
            reason, where, least = "a hand outside its limits", proof.middle, np.nan
        elif not ok:
            reason, where = "too close to contact to be proved", proof.middle
        share = by_spheres / length if length > 0.0 else 0.0
        bound = margin if ok and tolerance > 0.0 else 0.0
        return PathProof(ok, reason, where, proof.state, least, bound, names, share, proof.intervals, over)

    def clearances(self, kernel: Kernel, states: Array) -> Array:
        """Return the distances of the nearest pairs at states that are free, shape (N,) [m].

        Args:
            kernel: The kernel of the scene as it is now.
            states: The states, shape (N, dof).
        """
        found, still = np.empty(len(states)), np.empty((0, 2 * states.shape[1]))
        near = np.nan_to_num(kernel.clearance(states, MOST_LIMIT).min(axis=1), nan=MOST_LIMIT)
        for k, q in enumerate(states):
            curve = Curve(np.zeros(2), np.stack([q, q]), still, 0.0)
            proof, _, _ = self._run(kernel, curve, _limits(float(near[k])), (TOUCH, TOLERANCE, 0.0))
            found[k] = proof.figures.least
        return found

    def _run(
        self, kernel: Kernel, curve: Curve, limits: Iterable[float], bounds: tuple[float, float, float],
        deadline: float | None = None,
    ) -> tuple[CurveProof, int, bool]:  # fmt: skip
        """Return a proof at its end, its outcome, and whether the deadline passed before.

        Args:
            kernel: The kernel.
            curve: The curve.
            limits: Clearances above which none is looked for, in turn, until one is found [m].
            bounds: Distance that counts as contact, tolerance of the clearance [m], and the same as a share of it.
            deadline: As of :meth:`prove`.
        """
        proof, shapes = self._proof(kernel), self._shapes(kernel)
        for limit in limits:
            proof.start(kernel, shapes, curve, limit)
            outcome, over = MORE, False
            while outcome == MORE and not over:
                outcome = proof.advance(*bounds, BUDGET)
                over = outcome == MORE and deadline is not None and time.perf_counter() > deadline
            if over or outcome != PROVED or proof.figures.least <= limit:
                break
        return proof, outcome, over

    def _names(self, kernel: Kernel, first: int, second: int) -> tuple[str, str]:
        if first < 0:
            return "", ""
        numbers, solids = kernel.robot.numbers, self._scene.solids
        return solids[numbers[first]].name, solids[numbers[second] if second >= 0 else -1 - second].name

    def _proof(self, kernel: Kernel) -> CurveProof:
        """Return this thread's memory for proofs by a kernel."""
        proof: CurveProof | None = getattr(self._local, "proof", None)
        if proof is None or proof.robot is not kernel.robot:
            proof = self._local.proof = CurveProof(kernel)
        return proof


def _limits(near: float) -> Iterator[float]:
    """Yield limits of the clearance that is looked for, from that of the spheres, which cover more [m]."""
    near, slack = max(near, 0.0), SLACK
    while near + slack < MOST_LIMIT:
        yield near + slack
        slack *= 2.0
    yield np.inf


def changed_obstacles(before: Kernel, now: Kernel) -> Flags | None:
    """Return which solids of the current scene were not in it before, shape (solids,).

    A removed solid can block nothing. None where more than obstacles changed: the robot, its held objects, or the pairs
    that may touch.
    """
    old, new = before.scene.arrays, now.scene.arrays
    if now.robot is not before.robot or not np.array_equal(old.allowed, new.allowed):
        return None
    known = {_row(before, k) for k in range(len(old.kind))}
    return np.array([_row(now, k) not in known for k in range(len(new.kind))], bool)


def _row(kernel: Kernel, k: int) -> tuple[object, ...]:
    """Return the content of a solid, without its place in the tables."""
    a, grids = kernel.scene.arrays, kernel.scene.grids
    grid = grids[k] if len(grids) else None
    return (
        int(a.kind[k]),
        int(a.owner[k]),
        a.rotation[k].tobytes(),
        a.offset[k].tobytes(),
        a.size[k].tobytes(),
        id(grid),
    )


def may_have_become_blocked(before: Kernel, now: Kernel, first: Array, last: Array) -> Flags:
    """Return which straight motions that were free before may be blocked now, shape (N,).

    Motions that the sphere cover proves clear of all new or moved solids stay free.

    Args:
        before: The kernel with which they were free.
        now: The current kernel.
        first: Start states of the motions, shape (N, dof).
        last: End states of the motions, shape (N, dof).
    """
    changed = None if now is before else changed_obstacles(before, now)
    if now is before or (changed is not None and not changed.any()):
        return np.zeros(len(first), bool)
    if changed is None:
        return np.ones(len(first), bool)
    alone = obstacles_alone(now, changed)
    return np.array([not alone.proves(np.stack(ends), SEARCH_RESOLUTION) for ends in zip(first, last, strict=True)])
