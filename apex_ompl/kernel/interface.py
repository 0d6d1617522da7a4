"""The kernel as Python objects use it: a robot among obstacles."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from apex_ompl.errors import ParameterError
from apex_ompl.kernel import entries
from apex_ompl.kernel.tables import RobotTables, SceneTables
from apex_ompl.kernel.views import room
from apex_ompl.types import Array
from apex_ompl.util.validation import shape_error

MOST_PAIRS = 16  # that are told apart for one state


class Kernel:
    """Clearances, gradients and proofs for a robot in a scene; serial, and safe to use from several threads."""

    def __init__(self, robot: RobotTables, scene: SceneTables) -> None:
        """Check ``robot`` among the obstacles of ``scene``."""
        self.robot = robot
        self.scene = scene
        self.packed: tuple[Any, ...] = (*robot.packed, *scene.packed)
        self._room = room(robot.arrays)

    def room(self) -> tuple[NDArray[np.int64], Array]:
        """Return new arrays for one call to work in, so that several threads may call."""
        return np.empty(self._room[0], np.int64), np.empty(self._room[1])

    def states(self, q: ArrayLike) -> Array:
        """Return states as an array of shape (N, dof), in a row of memory.

        Raises:
            ParameterError: Another shape.
        """
        states = np.require(np.atleast_2d(np.asarray(q, dtype=float)), requirements=["C", "W"])
        if states.ndim != 2 or states.shape[1] != self.robot.dof:
            raise shape_error(states, ("N", self.robot.dof), "states")
        return states

    def unproved(self, q: ArrayLike) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return what the spheres cannot prove for states, shape (N, dof).

        Returns:
            Pairs, shape (N, K, 2): two bodies, or a body and -1 - obstacle; and their number, shape (N,): 0 where
            the state is proved free, K where there may be more than K, -1 where the spheres say nothing.
        """
        states = self.states(q)
        found = np.empty((len(states), MOST_PAIRS, 2), np.int64)
        counts = np.empty(len(states), np.int64)
        entries.judge_states(*self.packed, *self.room(), states, found, counts)
        return found, counts

    def clearance(self, q: ArrayLike, limit: float = np.inf) -> Array:
        """Return the signed clearance of the sphere cover at states, shape (N, dof).

        Args:
            q: States.
            limit: Larger clearances are not looked for, and given as this [m].

        Returns:
            Shape (N, 2) [m]: to the obstacles, and between bodies that may touch. The true clearances are at least as
            large where these are positive. NaN where a state is not finite, or a hand is outside its limits.
        """
        states = self.states(q)
        values = np.empty((len(states), 2))
        entries.clearances(*self.packed, *self.room(), states, float(limit), values, np.empty((0, 2, states.shape[1])))
        return values

    def clearance_gradient(self, q: ArrayLike, limit: float = np.inf) -> tuple[Array, Array]:
        """Return :meth:`clearance` and its gradient with respect to the states.

        Returns:
            Values, shape (N, 2) [m], and gradients, shape (N, 2, dof) [m/rad]; zero where a value is ``limit``. Where
            two spheres are equally near the gradient is that of one of them.
        """
        states = self.states(q)
        values = np.empty((len(states), 2))
        slopes = np.empty((len(states), 2, states.shape[1]))
        entries.clearances(*self.packed, *self.room(), states, float(limit), values, slopes)
        return values, slopes

    def joint_frames(self, q: ArrayLike) -> tuple[Array, Array]:
        """Return rotations, shape (N, J, 3, 3), and origins, shape (N, J, 3) [m], of all joints, their axes along z."""
        states = self.states(q)
        joints = len(self.robot.arrays.joint_parent)
        turn, origin = np.empty((len(states), joints, 3, 3)), np.empty((len(states), joints, 3))
        entries.joint_frames(*self.robot.packed, *self.room(), states, turn, origin)
        return turn, origin

    def proves(self, path: ArrayLike, resolution: float) -> bool:
        """Whether the spheres alone prove all of a path free, its states at most ``resolution`` apart [rad, max-norm].

        Args:
            path: States, shape (N, dof), N > 1.
            resolution: Spacing; whole stretches are proved at once where that works.

        Raises:
            ParameterError: Another shape, or a spacing that is not positive.
        """
        states = self.states(path)
        if len(states) < 2:
            raise shape_error(states, ("N", self.robot.dof), "path", least=2)
        if not resolution > 0.0:
            raise ParameterError("resolution", resolution, "a positive number of radians")
        found, counts = self.unproved(states[[0, -1]])
        if counts.any():
            return False
        starts = np.empty(len(states), np.int64)
        last = entries.lay_grid(states, float(resolution), starts)
        if last < 0:
            return False
        queue, ends, check_counts = np.empty((2 * last + 4, 2), np.int64), np.array([0, 1, 0]), np.zeros(5, np.int64)
        queue[0] = 0, last
        state = np.empty(self.robot.dof)
        arrays = (states, starts, queue, ends, state, found[0], check_counts)
        return bool(entries.advance(*self.packed, *self.room(), *arrays) == entries.DONE)
