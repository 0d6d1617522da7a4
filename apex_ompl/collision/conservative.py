"""First stage of the collision checker: proofs by balls that states and motions are free, and that states collide."""

from __future__ import annotations

import threading
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from apex_ompl.collision.cover.spheres import shape_key
from apex_ompl.collision.mesh_stage import MeshStage
from apex_ompl.collision.tables import make_tables, primitives, stored_tables
from apex_ompl.kernel.kernel import COLLIDES, MOST_PAIRS, Kernel, PathCheck
from apex_ompl.kernel.library import compile_for_plans
from apex_ompl.kernel.scene_builder import Solids, moved, tables_of
from apex_ompl.kernel.tables import RobotTables, SceneTables
from apex_ompl.robot import Robot
from apex_ompl.types import Array
from apex_ompl.util.forking import ProcessLock


class UnprovedPairs(NamedTuple):
    """Pairs that the meshes must check at a state.

    Attributes:
        pairs: Pairs of geometries that are not proved to be apart.
        complete: Whether all others are proved to be apart.
        collides: Whether the state is proved to collide, so that the meshes need not check it.
    """

    pairs: list[tuple[int, int]]
    complete: bool
    collides: bool = False


MOST_TABLES = 64  # kept for each robot: one for each set of held objects

_robots: WeakKeyDictionary[Robot, dict[Hashable, tuple[RobotTables, list[int]]]] = WeakKeyDictionary()
"""Tables of a robot with its held objects, and the numbers that links and held objects had then."""


@dataclass
class CheckCounts:
    """Numbers of checks by the two stages of a checker.

    Attributes:
        proved: States that the spheres proved free.
        meshes: States that the meshes checked.
        colliding: States that balls inside of bodies proved to collide.
        blocked: States that the spheres do not prove free, which compiled searches treat as blocked.
        intervals: Intervals of motions that the spheres tried to prove as a whole.
        proved_intervals: Those that they proved.
        steps: Steps between the states of motions.
        proved_steps: Those inside proved intervals.
    """

    proved: int = 0
    meshes: int = 0
    colliding: int = 0
    blocked: int = 0
    intervals: int = 0
    proved_intervals: int = 0
    steps: int = 0
    proved_steps: int = 0

    @property
    def states(self) -> int:
        """States that were checked one by one."""
        return self.proved + self.meshes + self.colliding + self.blocked


def _numbered(tables: RobotTables, before: Sequence[int], now: Sequence[int]) -> RobotTables:
    """Return tables of the same bodies under other numbers."""
    if before == now:
        return tables
    renamed = dict(zip(before, now, strict=True))
    return replace(tables, numbers=tuple(renamed[number] for number in tables.numbers))


class ConservativeChecker:
    """Conservative checks of a scene; safe to use from several threads while the scene is not edited."""

    def __init__(self, robot: Robot, scene: MeshStage) -> None:
        """Check ``robot`` with its held objects among the obstacles of ``scene``."""
        self.scene = scene
        self._robot = robot
        self._local = threading.local()
        self._lock = ProcessLock()
        self._solids: dict[int, Solids] = {}  # of obstacles, by number; those that are missing are new
        self._moved: set[int] = set()
        self._listed = False  # whether the obstacles of the tables are those of the scene, moved or not
        self._held_listed = False  # whether the held objects are
        self._kernel: Kernel | None = None

    @property
    def kernel(self) -> Kernel:
        """The kernel with the tables of robot and obstacles as they are now.

        Raises:
            MissingFileError: The robot names a file of covers that cannot be read.
            FileFormatError: That file does not follow its schema.
            RobotError: The kernel does not support the motion of a joint.
        """
        if self._kernel is not None and self._listed and self._held_listed and not self._moved:
            return self._kernel
        compile_for_plans()
        with self._lock:
            old = self._kernel
            robot = self._robot_tables() if old is None or not self._held_listed else old.robot
            scene = self._scene_tables() if old is None or not self._listed else self._tables_after_moves(old.scene)
            self._moved.clear()
            self._listed = self._held_listed = True
            self._kernel = Kernel(robot, self._with_allowed(scene, robot))
            return self._kernel

    def obstacles_changed(self) -> None:
        """Note that obstacles were added or removed."""
        self._listed = False

    def obstacle_moved(self, number: int) -> None:
        """Note that an obstacle was moved."""
        self._moved.add(number)

    def held_changed(self) -> None:
        """Note that objects were attached or detached."""
        self._held_listed = False

    def _with_allowed(self, tables: SceneTables, robot: RobotTables) -> SceneTables:
        """Return tables of the scene with the pairs that may touch, whose bodies are rows of the robot's tables."""
        allowed = self.scene.allowed_obstacles
        if not allowed and not len(tables.arrays.allowed):
            return tables
        rows = {number: row for row, number in enumerate(robot.numbers)}
        pairs = sorted((rows[body], obstacle) for body, obstacle in allowed)
        return replace(tables, arrays=tables.arrays._replace(allowed=np.array(pairs, np.int64).reshape(-1, 2)))

    def _robot_tables(self) -> RobotTables:
        scene, robot = self.scene, self._robot
        numbers = [*range(scene.links), *scene.held.values()]
        solids = [scene.solids[number] for number in numbers]
        held = solids[scene.links :]
        poses = tuple((s.joint, s.placement.homogeneous.tobytes(), shape_key(s.shape)) for s in held)
        touch = tuple(sorted((k, tuple(sorted(v))) for k, v in scene.touch.items()))
        among = frozenset(pair for pair in scene.allowed if not pair & scene.scene.keys())
        key = (tuple(scene.held), poses, touch, among)
        known = _robots.setdefault(robot, {})
        if key in known:
            return _numbered(*known[key], numbers)
        rows = {number: row for row, number in enumerate(numbers)}
        meets = [solid.joint > 0 or number >= scene.links for solid, number in zip(solids, numbers, strict=True)]
        pairs = [(rows[a], rows[b]) for a, b in scene.body_pairs]
        tables = (make_tables if known else stored_tables)(robot, solids, meets, pairs)
        tables = replace(tables, numbers=tuple(numbers[k] for k in tables.numbers))
        while len(known) >= MOST_TABLES:
            known.pop(next(iter(known)), None)
        known[key] = tables, numbers
        return tables

    def _scene_tables(self) -> SceneTables:
        numbers = self.scene.scene.values()
        self._solids = {k: self._solids[k] if self._is_known(k) else self._solids_of(k) for k in numbers}
        return tables_of(self._solids)

    def _tables_after_moves(self, tables: SceneTables) -> SceneTables:
        for number in self._moved:
            self._solids[number] = self._solids_of(number)
            tables = moved(tables, number, self._solids[number])
        return tables

    def _is_known(self, number: int) -> bool:
        return number in self._solids and number not in self._moved

    def _solids_of(self, number: int) -> Solids:
        solid = self.scene.solids[number]
        return Solids.of(primitives(solid.shape, solid.placement.homogeneous))

    def unproved_at(self, q: Array, check_counts: CheckCounts) -> UnprovedPairs | None:
        """Return the pairs left to the meshes at a state, shape (dof,); None where it is proved free."""
        check = self._check()
        count = check.check_state(self.kernel, q)
        if count == 0:
            check_counts.proved += 1
            return None
        return self._left(check.pairs, count)

    def unproved_among(
        self, states: Array, check_counts: CheckCounts, threads: int = 1
    ) -> list[tuple[int, UnprovedPairs]]:  # fmt: skip
        """Return the states, shape (N, dof), that are not proved free, by number, and the pairs left."""
        found, counts = self.kernel.unproved(states, threads)
        opened = np.flatnonzero(counts)
        check_counts.proved += len(states) - len(opened)
        return [(int(k), self._left(found[k], int(counts[k]))) for k in opened]

    def _left(self, found: NDArray[np.int64], count: int) -> UnprovedPairs:
        numbers = self.kernel.robot.numbers
        pairs = [(numbers[a], numbers[b] if b >= 0 else -1 - b) for a, b in found[: max(count, 0)].tolist()]
        return UnprovedPairs(pairs, 0 < count < MOST_PAIRS, count == COLLIDES)

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
        check = self._check()
        steps = check.start(path, resolution, (0, -1) if start else (-1,))
        if steps < 0:
            raise NoGridError
        hit = None
        while hit is None:
            number = check.first_unproved(self.kernel)
            if number is None:
                break
            if not is_free(check.state, self._left(check.pairs, check.open_pairs)):
                hit = check.state.copy(), check.segment(number)
        counts = check.counts
        check_counts.proved += counts.proved
        check_counts.intervals += counts.intervals
        check_counts.proved_intervals += counts.proved_intervals
        check_counts.proved_steps += counts.proved_steps
        check_counts.steps += steps
        return hit

    def _check(self) -> PathCheck:
        """Return this thread's memory for checks by the kernel as it is now."""
        check: PathCheck | None = getattr(self._local, "check", None)
        kernel = self.kernel
        if check is None or check.robot is not kernel.robot:
            check = self._local.check = PathCheck(kernel)
        return check


class NoGridError(Exception):
    """A path that no grid can be laid over."""
