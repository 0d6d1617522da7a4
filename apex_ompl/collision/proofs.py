"""The first stage of the verdict: what the sphere covers prove, and what they leave for the meshes."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple
from weakref import WeakKeyDictionary

import coal
import numpy as np
from numpy.typing import NDArray

from apex_ompl.collision.broadphase import CompiledScene
from apex_ompl.collision.rough_cover import rough_cover
from apex_ompl.collision.shapes import is_shell
from apex_ompl.collision.sphere_proof import Cover
from apex_ompl.collision.spheres import make_cover, read_covers, shape_key
from apex_ompl.collision.tabulate import tabulate, tabulate_scene
from apex_ompl.kernel import entries
from apex_ompl.kernel.face import MOST_PAIRS, Kernel
from apex_ompl.kernel.tables import RobotTables, SceneTables
from apex_ompl.robot import Robot

Array = NDArray[np.float64]


class Open(NamedTuple):
    """What the meshes must judge at a state.

    Attributes:
        pairs: Pairs of geometries that are not proved to be apart.
        complete: Whether all others are proved to be apart.
    """

    pairs: list[tuple[int, int]]
    complete: bool


LEAVES = 32  # of a cover made at run time

_robots: WeakKeyDictionary[Robot, RobotTables] = WeakKeyDictionary()
_covers: dict[str, Cover] = {}


@dataclass
class Tally:
    """What the two stages of a verdict did.

    Attributes:
        proved: States that the spheres proved free.
        meshes: States that the meshes judged.
        boxes: Stretches of motions that the spheres tried to prove at once.
        proved_boxes: Those that they proved.
        steps: Steps between states to judge along motions.
        proved_steps: Those inside proved stretches.
    """

    proved: int = 0
    meshes: int = 0
    boxes: int = 0
    proved_boxes: int = 0
    steps: int = 0
    proved_steps: int = 0

    @property
    def states(self) -> int:
        """States that were judged one by one."""
        return self.proved + self.meshes


def covers_of(robot: Robot, shapes: Sequence[coal.CollisionGeometry]) -> list[Cover]:
    """Return a cover of each shape: one that the robot's file brings, or a quick one made now.

    Raises:
        MissingFileError: The robot names a file of covers that cannot be read.
        FileFormatError: That file does not follow its schema.
    """
    if robot.covers is not None:
        _covers.update(_read(str(robot.covers)))
    found = []
    for shape in shapes:
        key = shape_key(shape)
        if key not in _covers:
            boxy = is_shell(shape) or shape.getNodeType() == coal.GEOM_BOX
            _covers[key] = rough_cover(shape) if boxy else make_cover(shape, effort=1, most=LEAVES)
        found.append(_covers[key])
    return found


@lru_cache(maxsize=8)
def _read(path: str) -> dict[str, Cover]:
    return read_covers(path)


class Proofs:
    """Proofs for one compiled scene; safe to use from several threads."""

    def __init__(self, robot: Robot, scene: CompiledScene) -> None:
        """Make the kernel's tables of ``robot``, and of what ``scene`` holds besides.

        Raises:
            MissingFileError: The robot names a file of covers that cannot be read.
            FileFormatError: That file does not follow its schema.
            RobotError: A joint moves in a way that the kernel does not know.
        """
        self.scene = scene
        self._local = threading.local()
        self.kernel = Kernel(self._robot(robot), self._obstacles())

    def _robot(self, robot: Robot) -> RobotTables:
        scene = self.scene
        if not scene.held and robot in _robots:
            return _robots[robot]
        numbers = [*range(scene.links), *scene.held.values()]
        rows = {number: row for row, number in enumerate(numbers)}
        items = [scene.geometry.geometryObjects[number] for number in numbers]
        covers = covers_of(robot, [item.geometry for item in items])
        meets = [item.parentJoint > 0 or number >= scene.links for item, number in zip(items, numbers, strict=True)]
        pairs = [(rows[a], rows[b]) for a, b in scene.pairs if a in rows and b in rows]
        tables = tabulate(robot, items=items, numbers=numbers, covers=covers, meets_scene=meets, pairs=pairs)
        if not scene.held:
            _robots[robot] = tables
        return tables

    def _obstacles(self) -> SceneTables:
        items = self.scene.geometry.geometryObjects
        return tabulate_scene(
            {n: (items[n].geometry, items[n].placement.homogeneous) for n in self.scene.scene.values()}
        )

    def obstacles_moved(self) -> None:
        """Take over the poses of the scene's obstacles."""
        self.kernel = Kernel(self.kernel.robot, self._obstacles())

    def open_at(self, q: Array, tally: Tally) -> Open | None:
        """Return what is left to be judged at a state, shape (dof,); None where it is proved free."""
        mine = self._local
        if not hasattr(mine, "state"):
            mine.state = np.empty((1, self.kernel.robot.dof))
            mine.found, mine.counts = np.empty((1, MOST_PAIRS, 2), np.int64), np.empty(1, np.int64)
            mine.room = self.kernel.room()
        mine.state[0] = q
        entries.judge_states(*self.kernel.packed, *mine.room, mine.state, mine.found, mine.counts)
        count = int(mine.counts[0])
        if count == 0:
            tally.proved += 1
            return None
        return self._left(mine.found[0], count)

    def open_among(self, states: Array, tally: Tally) -> list[tuple[int, Open]]:
        """Return the states, shape (N, dof), that are not proved free: their numbers and what is left to be judged."""
        found, counts = self.kernel.unproved(states)
        opened = np.flatnonzero(counts)
        tally.proved += len(states) - len(opened)
        return [(int(k), self._left(found[k], int(counts[k]))) for k in opened]

    def _left(self, found: NDArray[np.int64], count: int) -> Open:
        numbers = self.kernel.robot.numbers
        pairs = [(numbers[a], numbers[b] if b >= 0 else -1 - b) for a, b in found[: max(count, 0)].tolist()]
        return Open(pairs, 0 < count < MOST_PAIRS)

    def open_states(
        self, path: Array, starts: NDArray[np.int64], queue: Sequence[tuple[int, int]], tally: Tally
    ) -> Iterator[tuple[int, Array, Open]]:
        """Prove a path, and yield what the meshes must judge: number in the grid, state, what is left to be judged.

        Args:
            path: States, shape (N, dof).
            starts: Where they stand in the grid, see ``apex_ompl.collision.sweep.grid``.
            queue: Intervals of the grid to prove; one of a single state asks for that state, others for what is
                between their ends.
            tally: Is kept up to date.
        """
        kernel = self.kernel
        work = np.empty((2 * int(starts[-1]) + len(queue) + 2, 2), np.int64)
        work[: len(queue)] = queue
        ends = np.array([0, len(queue), 0], np.int64)
        state, counts = np.empty(path.shape[1]), np.zeros(5, np.int64)
        found = np.empty((MOST_PAIRS, 2), np.int64)
        packed, room = kernel.packed, kernel.room()
        seen = counts.copy()
        while True:
            number = entries.advance(*packed, *room, path, starts, work, ends, state, found, counts)
            fresh = counts - seen
            seen = counts.copy()
            tally.proved += int(fresh[entries.PROVED_STATES])
            tally.boxes += int(fresh[entries.TRIED_BOXES])
            tally.proved_boxes += int(fresh[entries.PROVED_BOXES])
            tally.proved_steps += int(fresh[entries.PROVED_STEPS])
            if number == entries.DONE:
                return
            yield number, state, self._left(found, int(ends[2]))
