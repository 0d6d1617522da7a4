"""Paths for one problem by trees and by optimization, all in the kernel: without Pinocchio, Coal and OMPL."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from apex_ompl.kernel import Kernel
from apex_ompl.kernel.search import ENOUGH, RESOLUTION, TreePair, shortcut
from apex_ompl.paths.candidates import first_valid
from apex_ompl.paths.optimizer import Optimizer
from apex_ompl.training.records import to_half
from apex_ompl.types import Array
from apex_ompl.util.resolution import FINE_RESOLUTION, SEARCH_RESOLUTION

FEW, MANY = 1, 8  # initial paths that are optimized together
BUMP_SIZE = (0.4, 1.2)  # range of the amplitude of random bumps [rad]
PART_STEPS = 12  # optimizer steps for a part of a path
COMPARED_STATES = 12  # number of states at which two paths are compared
CLEARANCE_RANGE = 0.2  # clearances are measured up to here [m]
TREE_RANGE = 1.0  # longest step of trees [rad]
TREE_ITERATIONS = 30_000  # of trees, at most


class PathFinder:
    """Finds paths for one problem; a path is valid where the sphere cover proves it free of collisions.

    Attributes:
        kernel: The robot among its obstacles.
        start: Shape (dof,) [rad].
        goal: Shape (dof,) [rad].
        optimizer: Optimizer of the paths' splines.
        iterations: Of trees, at most.
        points: Obstacle points nearest to the robot, shape (3,) [m], by the bytes of the state.
        proposer: Returns proposals of a model, control points of shape (count, points, dof), for a count and a seed;
            None where there is no model.
    """

    proposer: Callable[[int, int], Array] | None = None

    def __init__(self, kernel: Kernel, start: Array, goal: Array, optimizer: Optimizer) -> None:
        """Find paths from ``start`` to ``goal``, shape (dof,) [rad]."""
        self.kernel, self.start, self.goal, self.optimizer = kernel, start, goal, optimizer
        self.lower, self.upper = kernel.robot.arrays.lower, kernel.robot.arrays.upper
        self.iterations = TREE_ITERATIONS
        self.points: dict[bytes, Array] = {}

    def is_valid(self, states: Array) -> bool:
        """Whether a path, shape (N, dof), passes the full check."""
        inside = bool((states >= self.lower).all() and (states <= self.upper).all())
        return inside and self.proves(states)

    def proves(self, states: Array) -> bool:
        """Whether a path, shape (N, dof), inside of the limits is proved free."""
        return self.kernel.proves(states, FINE_RESOLUTION)

    def is_free(self, line: Array) -> bool:
        """Whether a straight motion, shape (2, dof), is free at the resolution that planners search with."""
        return self.kernel.proves(line, SEARCH_RESOLUTION)

    def search(self, seed: int) -> Array | None:
        """Return the control points of a spline fitted to a path of RRT-Connect that is cut short, or None."""
        rng = np.random.default_rng(seed)
        ends = self.start[None], self.goal[None]
        states = TreePair(self.kernel, *ends, TREE_RANGE, SEARCH_RESOLUTION, rng).grow(self.iterations)
        if states is None:
            return None
        path, _ = shortcut(self.kernel, states, ENOUGH, RESOLUTION, rng)
        return self.optimizer.spline.fit(path, self.lower, self.upper).control

    def optimize_proposals(self, seed: int) -> Array | None:
        """Return the control points of a valid path, optimized from a model's proposals, or None."""
        if self.proposer is None:
            return None
        return first_valid(self.optimizer, self.kernel, self.proposer(MANY, seed), self.is_valid)

    def obstacle_point(self, q: Array) -> Array | None:
        """Return the obstacle point nearest to the robot at a state, shape (3,) [m], or None where it is unknown."""
        return self.points.get(q.tobytes())

    def optimize_bumps(self, rng: np.random.Generator, *, line: bool, many: bool) -> Array | None:
        """Return the control points of a valid path, optimized from lines with random bumps, or None.

        Args:
            rng: Source of the bumps.
            line: Whether the straight line itself is the first initial path.
            many: Whether to optimize many initial paths at once, instead of few and then more.
        """
        start, goal, size = self.start, self.goal, float(rng.uniform(*BUMP_SIZE))
        counts = (4 * MANY,) if many else (FEW, MANY)
        for count in counts:
            starts = self.optimizer.starts(start, goal, count + 1, rng, size)
            found = first_valid(self.optimizer, self.kernel, starts[:count] if line else starts[1:], self.is_valid)
            if found is not None:
                return found
        return None

    def shorten(self, control: Array) -> Array | None:
        """Return the control points of the shortest valid path found by shortening a path, or None."""
        return self.optimizer.shorten(self.kernel, control, self.is_valid)

    def quantize(self, control: Array) -> Array | None:
        """Return control points in the precision of the store, or None where the path then fails the full check."""
        inner = self.optimizer.spline.inner
        stored = np.clip(control, self.lower, self.upper)
        stored[inner] = to_half(stored[inner], self.lower, self.upper)
        stored[0], stored[-1] = np.round(control[0], 6), np.round(control[-1], 6)
        stored = self.optimizer.spline.with_ends(stored, stored[0], stored[-1])
        return stored if self.is_valid(self.optimizer.spline.path(stored)) else None

    def part(self, control: Array, first: int, last: int) -> Array | None:
        """Return the control points of a path's part from state ``first`` to state ``last``.

        None where the straight line between these is valid, or where the fitted part is not.
        """
        spline = self.optimizer.spline
        states = spline.path(control)[first : last + 1].copy()
        states[[0, -1]] = np.round(states[[0, -1]], 6)
        if self.is_valid(states[[0, -1]]):
            return None
        fitted = spline.fit(states, self.lower, self.upper).control
        stored = self.quantize(fitted)
        if stored is None:
            stored = self.quantize(self.optimizer.improve(self.kernel, fitted[None], steps=PART_STEPS).control[0])
        return stored

    def homotopy_classes(self, paths: Sequence[Array]) -> list[int]:
        """Return the class of each path, numbered from 0; paths of one class can be deformed into each other.

        Two paths can be deformed into each other when the straight motions between their states at equal parameters are
        free (visibility deformation, Jaillet and Simeon 2008), here at some parameters.
        """
        spline = self.optimizer.spline
        found: list[int] = []
        where = np.linspace(0, spline.states - 1, COMPARED_STATES + 2).astype(int)[1:-1]
        states = [spline.path(control)[where] for control in paths]
        for k, mine in enumerate(states):
            for other, number in zip(states[:k], found, strict=True):
                lines = (np.stack(pair) for pair in zip(mine, other, strict=True))
                if all(self.is_free(line) for line in lines):
                    found.append(number)
                    break
            else:
                found.append(max(found, default=-1) + 1)
        return found

    def clearance(self, states: Array) -> float:
        """Return the smallest clearance of the sphere cover along a path, at every other state from the first [m]."""
        return float(self.kernel.clearance(states[::2], CLEARANCE_RANGE).min())
