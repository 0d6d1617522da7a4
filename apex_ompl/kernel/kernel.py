"""Clearances, gradients and proofs for a robot in a scene, in terms of NumPy arrays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from apex_ompl.errors import ParameterError
from apex_ompl.kernel.compiled.check import motion_proof, queries, separation
from apex_ompl.kernel.compiled.robot.kinematics import joint_pushes
from apex_ompl.kernel.compiled.workspace import workspace_sizes
from apex_ompl.kernel.tables import RobotTables, SceneTables
from apex_ompl.types import Array
from apex_ompl.util.arrays import compact
from apex_ompl.util.process import in_threads
from apex_ompl.util.validation import number_array, shape_error

MOST_PAIRS = 16  # pairs that are listed for one state
MOST_STEPS = motion_proof.MOST_STEPS  # of a grid of states over a path
COLLIDES = separation.COLLIDES  # stands for the number of pairs of a state that is proved to collide


class Kernel:
    """Clearances, gradients and proofs for a robot in a scene; serial, and safe to use from several threads."""

    def __init__(self, robot: RobotTables, scene: SceneTables) -> None:
        """Check ``robot`` among the obstacles of ``scene``."""
        self.robot = robot
        self.scene = scene
        self.packed: tuple[Any, ...] = (*robot.packed, *scene.packed)
        self._workspace_sizes = workspace_sizes(robot.arrays)

    def within(self, lower: Array, upper: Array) -> Kernel:
        """Return the kernel with other position limits, each of shape (dof,); itself where they are the same."""
        mine = self.robot.arrays
        if np.array_equal(lower, mine.lower) and np.array_equal(upper, mine.upper):
            return self
        arrays = mine._replace(lower=np.array(lower, float), upper=np.array(upper, float))
        return Kernel(replace(self.robot, arrays=arrays), self.scene)

    def workspace(self) -> tuple[NDArray[np.int64], Array]:
        """Return new buffers for one call, so that several threads may call."""
        return np.empty(self._workspace_sizes[0], np.int64), np.empty(self._workspace_sizes[1])

    def states(self, q: ArrayLike) -> Array:
        """Return states as a contiguous array of shape (N, dof).

        Raises:
            ParameterError: Another shape.
        """
        states = compact(np.atleast_2d(number_array(q, "states")))
        if states.ndim != 2 or states.shape[1] != self.robot.dof:
            raise shape_error(states, ("N", self.robot.dof), "states")
        return states

    def unproved(
        self, q: ArrayLike, threads: int = 1, most: int = MOST_PAIRS
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the pairs that the spheres do not prove to be apart at states, shape (N, dof).

        Args:
            q: States.
            threads: Number of threads that share many states; the result is the same.
            most: Largest number K of pairs that are listed for one state.

        Returns:
            Pairs, shape (N, K, 2): two bodies, or a body and -1 - obstacle; and their number, shape (N,): 0 where
            the state is proved free, K where there may be more than K; -1 where the tables do not hold for the state,
            -2 where it is proved to collide.
        """
        states = self.states(q)
        found = np.empty((len(states), most, 2), np.int64)
        counts = np.empty(len(states), np.int64)

        def check(rows: slice) -> None:
            queries.check_states(*self.packed, *self.workspace(), states[rows], found[rows], counts[rows])

        in_threads(len(states), threads, check)
        return found, counts

    def clearance(self, q: ArrayLike, limit: float = np.inf, threads: int = 1) -> Array:
        """Return the signed clearance of the sphere cover at states, shape (N, dof).

        Args:
            q: States.
            limit: Larger clearances are given as this [m]; a small one is faster.
            threads: Number of threads that share many states; the result is the same.

        Returns:
            Shape (N, 2) [m]: to the obstacles, and between bodies that may touch. The true clearances are at least as
            large where these are positive. NaN where a state is not finite, or a hand is outside its limits.
        """
        states = self.states(q)
        values, none = np.empty((len(states), 2)), np.empty((0, 2, states.shape[1]))

        def measure(rows: slice) -> None:
            queries.clearances(*self.packed, *self.workspace(), states[rows], float(limit), values[rows], none)

        in_threads(len(states), threads, measure)
        return values

    def clearance_gradient(self, q: ArrayLike, limit: float = np.inf, threads: int = 1) -> tuple[Array, Array]:
        """Return :meth:`clearance`, whose arguments it has, and its gradient with respect to the states.

        Returns:
            Values, shape (N, 2) [m], and gradients, shape (N, 2, dof) [m/rad]; zero where a value is ``limit``. Where
            two spheres are equally near the gradient is that of one of them.
        """
        states = self.states(q)
        values = np.empty((len(states), 2))
        gradients = np.empty((len(states), 2, states.shape[1]))

        def measure(rows: slice) -> None:
            queries.clearances(
                *self.packed, *self.workspace(), states[rows], float(limit), values[rows], gradients[rows]
            )

        in_threads(len(states), threads, measure)
        return values, gradients

    def joint_frames(self, q: ArrayLike, threads: int = 1) -> tuple[Array, Array]:
        """Return rotations, shape (N, J, 3, 3), and origins, shape (N, J, 3) [m], of all joints, their axes along z.

        Args:
            q: States, shape (N, dof).
            threads: Number of threads.
        """
        states = self.states(q)
        joints = len(self.robot.arrays.joint_parent)
        rotation, origin = np.empty((len(states), joints, 3, 3)), np.empty((len(states), joints, 3))

        def place(rows: slice) -> None:
            queries.joint_frames(*self.robot.packed, *self.workspace(), states[rows], rotation[rows], origin[rows])

        in_threads(len(states), threads, place)
        return rotation, origin

    def cover_spheres(self, q: ArrayLike) -> Array:
        """Return the spheres that contain the robot and its held objects in a state, shape (dof,).

        Returns:
            Centers in the world and radii, shape (S, 4) [m].
        """
        arrays = self.robot.arrays
        rotation, origin = (frames[0] for frames in self.joint_frames(q))
        sizes = np.diff(np.append(arrays.body_root, len(arrays.node_count)))
        leaf = arrays.node_count == 0
        joint = np.repeat(arrays.body_joint, sizes)[leaf]
        centers = (rotation[joint] * arrays.node_center[leaf][:, None]).sum(axis=2) + origin[joint]
        return np.column_stack([centers, arrays.node_radius[leaf]])

    def joint_pushes(
        self, frames: tuple[Array, Array], carriers: NDArray[np.int64], points: Array, found: tuple[Array, Array],
        reach: float,
    ) -> Array:  # fmt: skip
        """Return generalized forces on points of the robot away from the nearest obstacles, shape (N, dof) [m].

        Args:
            frames: What :meth:`joint_frames` returns for N states.
            carriers: Joints that carry P points, shape (P,).
            points: The points in the world, shape (N, P, 3) [m].
            found: Their signed distances from the obstacles, shape (N, P) [m], and the gradients, shape (N, P, 3).
            reach: A force falls from 1 at an obstacle to 0 at this distance [m].
        """
        pushed, arrays = np.empty((len(points), self.robot.dof)), map(np.ascontiguousarray, (points, *found))
        joint_pushes(*self.robot.packed, *frames, carriers, *arrays, float(reach), pushed)
        return pushed

    def proves(self, path: ArrayLike, resolution: float) -> bool:
        """Whether the spheres alone prove a path free, its states at most ``resolution`` apart [rad, max-norm].

        Args:
            path: States, shape (N, dof), N > 1.
            resolution: Spacing; intervals are proved as a whole where the bounds on motion suffice.

        Raises:
            ParameterError: Another shape, or a spacing that is not positive.
        """
        states = self.states(path)
        if len(states) < 2:
            raise shape_error(states, ("N", self.robot.dof), "path", least=2)
        if not resolution > 0.0:
            raise ParameterError("resolution", resolution, "a positive number of radians")
        if self.unproved(states[[0, -1]])[1].any():
            return False
        check = PathCheck(self)
        last = check.start(states, float(resolution), [])
        return last >= 0 and check.first_unproved(self) is None


class PathCounts(NamedTuple):
    """Counts of the check of a path.

    Attributes:
        proved: States that were proved free.
        open: States that were not.
        proved_intervals: Intervals that were proved as a whole.
        intervals: Intervals that were tried.
        proved_steps: Steps of the grid inside proved intervals.
    """

    proved: int
    open: int
    proved_intervals: int
    intervals: int
    proved_steps: int


class PathCheck:
    """Checks of states and paths by the spheres, in one thread's memory.

    Attributes:
        robot: The robot that it was made for.
        state: The state that was examined last, shape (dof,).
        pairs: Pairs that are not proved there, shape (MOST_PAIRS, 2): two bodies, or a body and -1 - obstacle.
    """

    def __init__(self, kernel: Kernel) -> None:
        """Allocate buffers for checks of a kernel's robot."""
        self.robot = kernel.robot
        self._workspace = kernel.workspace()
        self._states = np.empty((1, kernel.robot.dof))
        self.state, self.pairs = self._states[0], np.empty((MOST_PAIRS, 2), np.int64)
        self._found, self._ends, self._counts = self.pairs[None], np.zeros(3, np.int64), np.zeros(5, np.int64)
        self._two_starts, self._queue = np.empty(2, np.int64), np.empty((4096, 2), np.int64)

    def check_state(self, kernel: Kernel, q: Array) -> int:
        """Return the number of pairs that are not proved at a state, shape (dof,): as :meth:`Kernel.unproved` does."""
        self.state[:] = q
        queries.check_states(*kernel.packed, *self._workspace, self._states, self._found, self._ends[:1])
        return int(self._ends[0])

    def start(self, path: Array, resolution: float, states: Sequence[int] = (0, -1)) -> int:
        """Start the check of a path; return the number of steps of the grid over it, or -1 where there is none.

        Args:
            path: States, shape (N, dof), N > 1, contiguous.
            resolution: Largest spacing of the grid [rad, max-norm].
            states: Given states that are checked too, first or last: 0 or -1.
        """
        starts = self._two_starts if len(path) == 2 else np.empty(len(path), np.int64)
        last = int(motion_proof.lay_grid(path, resolution, starts))
        if last < 0:
            return last
        queue = self._queue if len(self._queue) >= 2 * last + 4 else np.empty((2 * last + 4, 2), np.int64)
        entered = [*((last, last) if k < 0 else (0, 0) for k in states), (0, last)]
        queue[: len(entered)] = entered
        self._ends[:2] = 0, len(entered)
        self._counts[:] = 0
        self._path, self._starts, self._open = path, starts, queue
        return last

    def first_unproved(self, kernel: Kernel) -> int | None:
        """Return the number on the grid of the next state that is not proved free, which is in ``state``, or None."""
        number = motion_proof.prove_path(
            *kernel.packed, *self._workspace, self._path, self._starts, self._open, self._ends, self.state, self.pairs,
            self._counts,
        )  # fmt: skip
        return None if number == motion_proof.DONE else int(number)

    def segment(self, number: int) -> int:
        """Return the segment of the path that a state of the grid lies on."""
        return max(int(np.searchsorted(self._starts, number)) - 1, 0)

    @property
    def open_pairs(self) -> int:
        """Number of pairs that are not proved at the state of :meth:`first_unproved`."""
        return int(self._ends[2])

    @property
    def counts(self) -> PathCounts:
        """Counts so far."""
        return PathCounts(*self._counts.tolist())
