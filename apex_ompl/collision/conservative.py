"""First stage of the collision checker: proofs by sphere covers that states and motions are free."""

from __future__ import annotations

import threading
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from typing import NamedTuple
from weakref import WeakKeyDictionary

import coal
import numpy as np
from numpy.typing import NDArray

from apex_ompl.collision.broadphase import CompiledScene
from apex_ompl.collision.cover.proof import Cover
from apex_ompl.collision.cover.rough import rough_cover
from apex_ompl.collision.cover.spheres import make_cover, read_covers, shape_key
from apex_ompl.collision.shapes import is_shell
from apex_ompl.collision.tabulate import mesh_boxes, primitives, tabulate, tabulate_scene
from apex_ompl.kernel.compiled import motion_proof, queries
from apex_ompl.kernel.kernel import MOST_PAIRS, Kernel
from apex_ompl.kernel.tables import RobotTables, SceneTables
from apex_ompl.robot import Robot
from apex_ompl.types import Array


class UnprovedPairs(NamedTuple):
    """Pairs that the meshes must check at a state.

    Attributes:
        pairs: Pairs of geometries that are not proved to be apart.
        complete: Whether all others are proved to be apart.
    """

    pairs: list[tuple[int, int]]
    complete: bool


QUICK_GAPS, LEAVES = (0.02, 0.005), 32  # of covers made at run time
SLENDER = 0.05  # cylinders thinner or flatter than this are covered like boxes

MOST_TABLES = 64  # kept for each robot: one for each set of held objects

_robots: WeakKeyDictionary[Robot, dict[Hashable, RobotTables]] = WeakKeyDictionary()
_quick: dict[str, Cover] = {}  # by shape key


@dataclass
class CheckCounts:
    """Numbers of checks by the two stages of a checker.

    Attributes:
        proved: States that the spheres proved free.
        meshes: States that the meshes checked.
        intervals: Intervals of motions that the spheres tried to prove as a whole.
        proved_intervals: Those that they proved.
        steps: Steps between the states of motions.
        proved_steps: Those inside proved intervals.
    """

    proved: int = 0
    meshes: int = 0
    intervals: int = 0
    proved_intervals: int = 0
    steps: int = 0
    proved_steps: int = 0

    @property
    def states(self) -> int:
        """States that were checked one by one."""
        return self.proved + self.meshes


def covers_of(robot: Robot, shapes: Sequence[coal.CollisionGeometry]) -> list[Cover]:
    """Return a cover of each shape: one from the robot's file, or a rough one made now.

    Covers in files are not checked here: ``scripts/make_covers.py`` writes only proved covers, and the tests prove
    again those that ship.

    Raises:
        MissingFileError: The robot names a file of covers that cannot be read.
        FileFormatError: That file does not follow its schema.
    """
    given = read_covers(robot.covers) if robot.covers is not None else {}
    found = []
    for shape in shapes:
        key = shape_key(shape)
        if key not in given and key not in _quick:
            _quick[key] = _quick_cover(shape)
        found.append(given[key] if key in given else _quick[key])
    return found


def _quick_cover(shape: coal.CollisionGeometry) -> Cover:
    kind = shape.getNodeType()
    if is_shell(shape) or kind == coal.GEOM_BOX:
        return rough_cover(shape)
    if kind == coal.GEOM_CYLINDER:
        sizes = sorted((float(shape.radius), float(shape.halfLength)))
        if sizes[0] < SLENDER * sizes[1]:
            return rough_cover(coal.Box(2.0 * shape.radius, 2.0 * shape.radius, 2.0 * shape.halfLength))
    return make_cover(shape, QUICK_GAPS, effort=1, most=LEAVES)


class ConservativeChecker:
    """Conservative checks of one compiled scene; safe to use from several threads."""

    def __init__(self, robot: Robot, scene: CompiledScene) -> None:
        """Make the kernel's tables of ``robot`` with its held objects and of the obstacles of ``scene``.

        Raises:
            MissingFileError: The robot names a file of covers that cannot be read.
            FileFormatError: That file does not follow its schema.
            RobotError: A joint moves in a way that the kernel does not know.
        """
        self.scene = scene
        self._local = threading.local()
        self._boxes: dict[int, Array] = {}
        self.kernel = Kernel(self._robot(robot), self._obstacles())

    def _robot(self, robot: Robot) -> RobotTables:
        scene = self.scene
        numbers = [*range(scene.links), *scene.held.values()]
        rows = {number: row for row, number in enumerate(numbers)}
        items = [scene.geometry.geometryObjects[number] for number in numbers]
        held = items[scene.links :]
        poses = tuple((i.parentJoint, i.placement.homogeneous.tobytes(), shape_key(i.geometry)) for i in held)
        key = (tuple(scene.held.items()), poses, tuple(sorted((k, tuple(sorted(v))) for k, v in scene.touch.items())))
        known = _robots.setdefault(robot, {})
        if key in known:
            return known[key]
        covers = covers_of(robot, [item.geometry for item in items])
        meets = [item.parentJoint > 0 or number >= scene.links for item, number in zip(items, numbers, strict=True)]
        pairs = [(rows[a], rows[b]) for a, b in scene.pairs if a in rows and b in rows]
        tables = tabulate(robot, items=items, numbers=numbers, covers=covers, meets_scene=meets, pairs=pairs)
        while len(known) >= MOST_TABLES:
            known.pop(next(iter(known)), None)
        known[key] = tables
        return tables

    def _obstacles(self) -> SceneTables:
        solids = {}
        for number in self.scene.scene.values():
            item = self.scene.geometry.geometryObjects[number]
            if is_shell(item.geometry) and number not in self._boxes:
                self._boxes[number] = mesh_boxes(item.geometry)
            solids[number] = primitives(item.geometry, item.placement.homogeneous, self._boxes.get(number))
        return tabulate_scene(solids)

    def obstacles_moved(self) -> None:
        """Make the tables of the obstacles again after they moved."""
        self.kernel = Kernel(self.kernel.robot, self._obstacles())

    def unproved_at(self, q: Array, check_counts: CheckCounts) -> UnprovedPairs | None:
        """Return the pairs left to the meshes at a state, shape (dof,); None where it is proved free."""
        buffers = self._buffers()
        buffers.state[0] = q
        queries.check_states(
            *self.kernel.packed, *buffers.workspace, buffers.state, buffers.found[None], buffers.ends[:1]
        )
        count = int(buffers.ends[0])
        if count == 0:
            check_counts.proved += 1
            return None
        return self._left(buffers.found, count)

    def unproved_among(self, states: Array, check_counts: CheckCounts) -> list[tuple[int, UnprovedPairs]]:
        """Return the states, shape (N, dof), that are not proved free, by number, and the pairs left."""
        found, counts = self.kernel.unproved(states)
        opened = np.flatnonzero(counts)
        check_counts.proved += len(states) - len(opened)
        return [(int(k), self._left(found[k], int(counts[k]))) for k in opened]

    def _left(self, found: NDArray[np.int64], count: int) -> UnprovedPairs:
        numbers = self.kernel.robot.numbers
        pairs = [(numbers[a], numbers[b] if b >= 0 else -1 - b) for a, b in found[: max(count, 0)].tolist()]
        return UnprovedPairs(pairs, 0 < count < MOST_PAIRS)

    def first_collision(
        self,
        path: Array,
        resolution: float,
        start: bool,
        check_counts: CheckCounts,
        is_free: Callable[[Array, UnprovedPairs], bool],
    ) -> tuple[Array, int] | None:
        """Return the first collision found on a path, whose intervals are proved as a whole where possible.

        Args:
            path: States, shape (N, dof), N > 1, contiguous.
            resolution: Largest spacing of states [rad, max-norm].
            start: Whether the first state is checked too.
            check_counts: Counts to add to.
            is_free: Checks a state that is not proved by the meshes, given the pairs left to them.

        Returns:
            A state in collision and the segment that it lies on, or None.

        Raises:
            NoGridError: The path has numbers that are not finite, or is too long for its resolution.
        """
        buffers = self._buffers()
        starts = buffers.starts if len(path) == 2 else np.empty(len(path), np.int64)
        last = motion_proof.lay_grid(path, resolution, starts)
        if last < 0:
            raise NoGridError
        queue, ends, state = buffers.queue, buffers.ends, buffers.state[0]
        if len(queue) < 2 * last + 4:
            queue = np.empty((2 * last + 4, 2), np.int64)
        entered = [(0, 0), (last, last), (0, last)][0 if start else 1 :]
        queue[: len(entered)] = entered
        ends[:2] = 0, len(entered)
        buffers.counts[:] = 0
        hit = None
        while hit is None:
            number = motion_proof.prove_path(
                *self.kernel.packed, *buffers.workspace, path, starts, queue, ends, state, buffers.found, buffers.counts
            )
            if number == motion_proof.DONE:
                break
            if not is_free(state, self._left(buffers.found, int(ends[2]))):
                hit = state.copy(), max(int(np.searchsorted(starts, number)) - 1, 0)
        proved, _, proved_intervals, intervals, proved_steps = buffers.counts.tolist()
        check_counts.proved += proved
        check_counts.intervals += intervals
        check_counts.proved_intervals += proved_intervals
        check_counts.proved_steps += proved_steps
        check_counts.steps += last
        return hit

    def _buffers(self) -> _Buffers:
        """Return this thread's buffers."""
        buffers: _Buffers | None = getattr(self._local, "buffers", None)
        if buffers is None:
            buffers = self._local.buffers = _Buffers(self.kernel)
        return buffers


class NoGridError(Exception):
    """A path that no grid can be laid over."""


class _Buffers:
    """Arrays that one thread passes to compiled code."""

    def __init__(self, kernel: Kernel) -> None:
        self.workspace = kernel.workspace()
        self.state = np.empty((1, kernel.robot.dof))
        self.found = np.empty((MOST_PAIRS, 2), np.int64)
        self.starts = np.empty(2, np.int64)
        self.queue = np.empty((4096, 2), np.int64)
        self.ends = np.zeros(3, np.int64)
        self.counts = np.zeros(5, np.int64)
