"""Dynamic obstacles: continuous collision checks of timed motions among them, and clearances in time."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from copy import copy
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from apex_ompl.collision.path_proof import Curve
from apex_ompl.collision.shapes import world_geometry
from apex_ompl.collision.tables import primitives
from apex_ompl.errors import ParameterError, SceneError, UnknownNameError
from apex_ompl.kernel import Kernel
from apex_ompl.kernel.arrays import DynamicArrays, pack, unpack
from apex_ompl.kernel.moving import clearances_in_time, first_conflict
from apex_ompl.kernel.scene_builder import Solids, grid_columns, joined
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.scene.scripts import is_there, obstacle_at, place_at, script_times, velocity_at
from apex_ompl.timing import Trajectory
from apex_ompl.types import Array
from apex_ompl.util.arrays import compact
from apex_ompl.util.display import one_line
from apex_ompl.util.validation import check_array, check_number, finite_array

SHORTEST = 1e-3  # length of an interval of time that is given up [s]
PREPARED = 64  # motions whose curves are kept


class DynamicObstacles:
    """Dynamic obstacles at constant velocity without rotation, beside the scene of a kernel.

    Each has a position and a velocity at a time stamp, and a margin by which it counts as larger, which may grow after
    the time stamp. An update writes to arrays.

    Attributes:
        names: Names of the obstacles.
        arrays: Their solids, views of ``packed``.
        packed: The same arrays as compiled code takes them.
    """

    def __init__(
        self, obstacles: Iterable[Obstacle], allowed: Iterable[tuple[int, str]] = (), *, stamp: float = 0.0
    ) -> None:
        """Place obstacles where their records say at a time stamp, with their velocities and without margins.

        Meshes, points, voxels and grids of distances move as grids of distances.

        Args:
            obstacles: The obstacles; those without a velocity are at rest.
            allowed: Bodies, as rows of the robot's tables, and names of dynamic obstacles that they may touch.
            stamp: Time of the places [s].

        Raises:
            SceneError: A name is given twice.
            ParameterError: An obstacle is a half-space, or none at all.
        """
        given = tuple(obstacles) if isinstance(obstacles, Iterable) else (obstacles,)
        for o in given:
            if not isinstance(o, Obstacle):
                raise ParameterError("obstacles", obstacles, "a list of obstacles")
        self.names = tuple(o.name for o in given)
        if len(set(self.names)) < len(given):
            raise SceneError(f"names of dynamic obstacles must differ, found {', '.join(o.name for o in given)}")
        for o in given:
            if o.half_space is not None:
                raise ParameterError(f"dynamic obstacle {o.name}", "a half_space", "a shape that is bounded")
        rows = [Solids.of(primitives(*world_geometry(o))) for o in given]
        owner = np.repeat(np.arange(len(rows)), np.array([len(some.kind) for some in rows], int))
        solids = joined(rows)
        places = np.array([o.position for o in given], float).reshape(-1, 3)
        self._from_body = solids.offset - places[owner]
        pairs = [(body, self._row(name)) for body, name in allowed]
        velocity = np.array([o.velocity or (0.0, 0.0, 0.0) for o in given], float).reshape(-1, 3)
        arrays = DynamicArrays(
            kind=solids.kind,
            owner=owner.astype(np.int64),
            allowed=np.array(pairs, np.int64).reshape(-1, 2),
            rotation=solids.rotation,
            place=solids.offset,
            size=solids.size,
            velocity=velocity[owner],
            stamp=np.full(len(owner), float(stamp)),
            growth=np.zeros((len(owner), 2)),
            **grid_columns(solids.grids),
        )
        self._pack(pack(arrays))

    def _pack(self, packed: tuple[Array, ...]) -> None:
        self.packed = packed
        self.arrays: DynamicArrays = unpack(DynamicArrays, *packed)

    def __getstate__(self) -> dict[str, Any]:
        """Return the state without views of its arrays."""
        return {name: value for name, value in self.__dict__.items() if name != "arrays"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore a state, and the views of its arrays."""
        self.__dict__.update(state)
        self._pack(self.packed)

    def __repr__(self) -> str:
        """Return the names of the obstacles."""
        return one_line("DynamicObstacles", *self.names)

    def __len__(self) -> int:
        """Return the number of obstacles."""
        return len(self.names)

    def update(
        self, name: str, position: ArrayLike | None = None, velocity: ArrayLike | None = None,
        *, stamp: float | None = None, growth: tuple[float, float] | None = None,
    ) -> None:  # fmt: skip
        """Update an obstacle; what is not given stays.

        Args:
            name: Its name.
            position: Position at the time stamp, shape (3,) [m].
            velocity: Shape (3,) [m/s].
            stamp: Time stamp [s].
            growth: Margin at the time stamp [m], and its growth after it [m/s]; neither is negative.

        Raises:
            UnknownNameError: There is no such obstacle.
            ParameterError: A number that is not finite, or another shape; a margin that is negative.
        """
        mine = self.arrays.owner == self._row(name)
        given = (("position", position, 3), ("velocity", velocity, 3), ("growth", growth, 2))
        values = {key: finite_array(value, key) for key, value, _ in given if value is not None}
        for key, _, count in given:
            if key in values:
                check_array(values[key], (count,), key)
        if stamp is not None:
            check_number(stamp, "stamp")
        if "growth" in values and values["growth"].min() < 0.0:
            raise ParameterError("growth", growth, "numbers that are not negative")
        if "position" in values:
            self.arrays.place[mine] = values.pop("position") + self._from_body[mine]
        for key, value in values.items():
            getattr(self.arrays, key)[mine] = value
        if stamp is not None:
            self.arrays.stamp[mine] = stamp

    def placed(self, positions: Array, velocities: Array, growth: Array, stamps: Array) -> DynamicObstacles:
        """Return a copy with other positions, velocities and margins, unchecked.

        Args:
            positions: Positions at the time stamps, shape (N, 3) [m].
            velocities: Shape (N, 3) [m/s].
            growth: Margins at the time stamps [m], and their growth after them [m/s], shape (N, 2).
            stamps: Time stamps, shape (N,) [s].
        """
        other = self.larger(0.0)
        a = other.arrays
        a.place[:] = positions[a.owner] + self._from_body
        a.velocity[:], a.stamp[:], a.growth[:] = velocities[a.owner], stamps[a.owner], growth[a.owner]
        return other

    def larger(self, by: float) -> DynamicObstacles:
        """Return a copy with margins that are larger by a distance [m]."""
        other, (integers, floats, *singles) = copy(self), self.packed
        other._pack((integers, floats.copy(), *singles))  # nothing else is written to
        other.arrays.growth[:, 0] += by
        return other

    def with_margin(self, margin: float, growth: float = 0.0) -> DynamicObstacles:
        """Return a copy with a margin at the time stamps [m], which grows after them [m/s], in place of theirs."""
        other = self.larger(0.0)
        other.arrays.growth[:] = margin, growth
        return other

    def nominal(self, margin: float) -> DynamicObstacles:
        """Return a copy whose margins are at most a distance [m], and do not grow."""
        other = self.with_margin(margin)
        other.arrays.growth[:, 0] = np.minimum(self.arrays.growth[:, 0], margin)
        return other

    def at(self, time: float) -> dict[str, Array]:
        """Return the positions of the obstacles at a time [s], shape (3,) [m], by name."""
        a, found = self.arrays, {}
        for row, name in enumerate(self.names):
            k = int(np.argmax(a.owner == row))
            found[name] = a.place[k] - self._from_body[k] + (time - a.stamp[k]) * a.velocity[k]
        return found

    def _row(self, name: str) -> int:
        if name not in self.names:
            raise UnknownNameError("dynamic_obstacle", name, self.names)
        return self.names.index(name)


class Conflict(NamedTuple):
    """The first moment at which a motion is not proved clear.

    Attributes:
        time: First moment that cannot be proved [s from the motion's start]; infinite where all of it is proved.
        body: Name of the body that is not proved clear there, empty where there is none.
        dynamic_obstacle: Name of the dynamic obstacle.
        intervals: Number of intervals of time that were checked.
    """

    time: float
    body: str
    dynamic_obstacle: str
    intervals: int

    def __bool__(self) -> bool:
        """Whether there is one."""
        return math.isfinite(self.time)


@lru_cache(maxsize=PREPARED)
def curve_of(motion: Trajectory) -> Curve:
    """Return the cubic pieces of a motion for collision checks; those of the last motions are cached."""
    return Curve.cubic(motion.times, motion.positions, motion.velocities, motion.accelerations)


def prove_motion(
    kernel: Kernel, dynamic: DynamicObstacles, motion: Trajectory, start: float = 0.0, end: float | None = None,
    *, clock: float = 0.0, shortest: float = SHORTEST,
) -> Conflict:  # fmt: skip
    """Check a timed motion continuously among dynamic obstacles, and find the first moment that is not proved clear.

    The check is that of the sphere covers along the motion's own cubic pieces
    (:func:`apex_ompl.kernel.moving.first_conflict`): it is sound and conservative by some millimeters. The scene of the
    kernel and self-collision are not checked.

    Args:
        kernel: The kernel of the robot with its held objects.
        dynamic: The obstacles.
        motion: The motion; after its end the robot is at rest.
        start: Time of the motion at which the check starts [s].
        end: Time of the motion at which it ends [s], by default its duration.
        clock: Time of the dynamic obstacles' stamps when the motion is at 0 [s].
        shortest: Length of an interval of time that is not divided further [s].

    Raises:
        ParameterError: The motion is one of other joints, or a number is not finite.
    """
    if motion.dof != kernel.robot.dof:
        raise ParameterError("motion", motion.dof, f"one of {kernel.robot.dof} joints")
    until = motion.duration if end is None else end
    for name, value in (("start", start), ("end", until), ("clock", clock)):
        check_number(value, name)
    time, body, row, intervals = first_conflict(
        kernel, dynamic.packed, curve_of(motion), start, until, clock, shortest
    )  # fmt: skip
    found = body >= 0 and math.isfinite(time)
    names = (kernel.robot.body_names[body], dynamic.names[row]) if found else ("", "")
    return Conflict(time, *names, intervals)


def clearance_in_time(
    kernel: Kernel, dynamic: DynamicObstacles, states: ArrayLike, times: ArrayLike, limit: float = np.inf
) -> tuple[Array, Array]:
    """Return the signed clearances of a robot's sphere cover to dynamic obstacles, and their gradients.

    Args:
        kernel: The kernel of the robot with its held objects.
        dynamic: The obstacles.
        states: States, shape (N, dof).
        times: Times of the dynamic obstacles' stamps, shape (N,) [s].
        limit: Larger clearances are returned as this [m]; a small one is faster.

    Returns:
        Values, shape (N,) [m], NaN where a state is not finite or a hand is outside its limits, margins subtracted;
        and gradients, shape (N, dof + 1): with respect to the state [m/rad], and to the time [m/s].

    Raises:
        ParameterError: Another shape, or a time that is not finite.
    """
    q, at = kernel.states(states), compact(finite_array(times, "times"))
    check_array(at, (len(q),), "times")
    return clearances_in_time(kernel, dynamic.packed, q, at, limit)


def allowed_rows(kernel: Kernel, allowed: Iterable[tuple[str, str]], names: Sequence[str]) -> list[tuple[int, str]]:
    """Return pairs of names of bodies that may touch as rows of a robot's tables and names of dynamic obstacles."""
    rows: list[tuple[int, str]] = []
    for pair in allowed:
        for dynamic_obstacle, body in (pair, pair[::-1]):
            if dynamic_obstacle in names:
                rows += [(k, dynamic_obstacle) for k, name in enumerate(kernel.robot.body_names) if name == body]
    return rows


class Piece(NamedTuple):
    """A piece of time in which all obstacles move at constant velocity.

    Attributes:
        start: Start of the piece [s].
        end: End of the piece [s].
        dynamic: The obstacles that exist then, with ``start`` as their stamp; valid until the next piece is taken.
    """

    start: float
    end: float
    dynamic: DynamicObstacles


class ScriptedDynamicObstacles:
    """Dynamic obstacles with scripts, beside the scene of a kernel.

    Attributes:
        kernel: The kernel of the robot with its held objects.
        obstacles: The obstacles with their scripts.
    """

    def __init__(self, kernel: Kernel, obstacles: Iterable[Obstacle], allowed: Sequence[tuple[str, str]] = ()) -> None:
        """Take obstacles, and pairs of names of bodies that may touch.

        Raises:
            SceneError, ParameterError: As :class:`apex_ompl.moving.dynamic_obstacles.DynamicObstacles`.
        """
        self.kernel, self.obstacles, self._allowed = kernel, tuple(obstacles), tuple(allowed)
        self._known: dict[tuple[str, ...], DynamicObstacles] = {}
        self._dynamic(self.obstacles, 0.0)

    def pieces(self, end: float) -> Iterator[Piece]:
        """Yield the pieces of the time from 0 to ``end`` [s] in turn; a single one without length where that is 0."""
        inner = {time for o in self.obstacles for time in script_times(o) if 0.0 < time < end}
        edges = [0.0, *sorted(inner), end]
        for start, until in zip(edges[:-1], edges[1:], strict=True):
            here = [o for o in self.obstacles if is_there(o, start)]
            yield Piece(start, until, self._dynamic(here, start))

    def clearances(self, motion: Trajectory, times: Array) -> Array:
        """Return lower bounds of a motion's distance to the obstacles at some times, shape (N,) [m].

        They are distances of the sphere cover, which contains the robot; infinite where there is no obstacle, NaN where
        a hand is outside its limits.

        Args:
            motion: The motion; after its end the robot is at rest.
            times: Shape (N,), increasing from 0 or more [s].
        """
        found = np.full(len(times), np.inf)
        for start, end, dynamic in self.pieces(float(times[-1]) if len(times) else 0.0):
            rows = np.flatnonzero((times >= start) & (times <= end))
            if len(dynamic) and len(rows):
                at = times[rows]
                found[rows] = clearance_in_time(self.kernel, dynamic, motion(at), at)[0]
        return found

    def _dynamic(self, here: Sequence[Obstacle], time: float) -> DynamicObstacles:
        """Return obstacles with their motion from a time on [s]."""
        names = tuple(o.name for o in here)
        if names not in self._known:
            rows = allowed_rows(self.kernel, self._allowed, names)
            self._known[names] = DynamicObstacles([obstacle_at(o, time) for o in here], rows)
        dynamic = self._known[names]
        for o in here:
            dynamic.update(o.name, place_at(o, time), velocity_at(o, time), stamp=time)
        return dynamic
