"""Other paths, from which faster motions are optimized until the time of an anytime plan ends.

They are of other homotopies, or lead to other goals: paths of new trees and of the planner with other seeds, the best
motion led through a random free state or moved at random, and straight lines through random free states. Goals that are
given in the workspace are sampled again.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from apex_ompl.apex.parameters import ApexParameters
from apex_ompl.kernel import Kernel
from apex_ompl.kernel.search import ENOUGH, RESOLUTION, TreePair, shortcut
from apex_ompl.ompl.setup import assemble
from apex_ompl.paths.path import SEARCH_RESOLUTION, resample
from apex_ompl.planning.more_goals import sampled_goal, with_more
from apex_ompl.planning.query import goal_record
from apex_ompl.planning.step_records import PlanQuery
from apex_ompl.robot.model import Limits
from apex_ompl.robot.rest_to_rest import direct_durations
from apex_ompl.timing import Trajectory
from apex_ompl.types import Array
from apex_ompl.util.clocks import Deadline

TREE_RANGE, ITERATIONS = 1.5, 6_000  # longest step of trees [rad], and most iterations
KNOTS = 0.02  # by which motions take longer than direct ones for the spacing of their knots [s]
STATES = 129  # of the best motion, where it is led or moved
SPREADS = 0.3, 0.6, 1.0  # of random states around a path [rad]
SHIFTS = 0.05, 0.8  # least and largest size of a random movement of the best motion [rad]
WIDTHS = 0.1, 0.5  # and of its width, as a share of the motion
ATTEMPTS = 20  # for a random free state
SHARE, MOST_SEED = 0.2, 2**31 - 2  # of the time left that the planner has for a path, and its seeds
FEW_STATES, DEEP = 33, 0.01  # of a path, and their mean depth in obstacles beyond which it is left out [m]


def tree_path(
    kernel: Kernel, start: Array, goals: Array, rng: np.random.Generator, stop: Callable[[], bool]
) -> Array | None:
    """Return a path of new trees after shortcuts, shape (N, dof), or None.

    Args:
        kernel: The robot among its obstacles, with the limits of the states.
        start: Start, shape (dof,).
        goals: Goals, shape (N, dof).
        rng: Source of the random states.
        stop: Asked from time to time whether to give up.
    """
    trees = TreePair(kernel, start[None], goals, TREE_RANGE, SEARCH_RESOLUTION, rng)
    path = trees.grow(ITERATIONS, stop)
    return None if path is None else shortcut(kernel, path, ENOUGH, RESOLUTION, rng.spawn(1)[0], stop)[0]


class OtherPaths:
    """Paths to the goals of a query, in an order that follows from its seed.

    Attributes:
        query: The query; its set-up gets the goals that are sampled.
        best: The fastest motion so far, or None.
        most: Duration that a motion has to undercut [s].
    """

    def __init__(self, query: PlanQuery, limits: Limits, stop: Callable[[], bool]) -> None:
        """Make paths for motions within some limits until ``stop`` returns True."""
        self.query = query
        self.best: Trajectory | None = None
        self.most = np.inf
        self._limits, self._stop, setup = limits, stop, query.setup
        self._rng = np.random.default_rng([setup.seed, STATES])
        self._kernel = setup.checker.kernel.within(*setup.bounds)
        self._parameters = query.parameters if isinstance(query.parameters, ApexParameters) else ApexParameters()
        self._goal = sampled_goal(setup)

    def paths(self) -> Iterator[Array]:
        """Yield paths, shape (N, dof), until the time ends or no goal is left that could be reached sooner."""
        kinds = self._lines, self._trees, self._moved, self._led, self._planned, self._moved, self._led, self._through
        while self._goal is not None or len(self._goals()):
            for kind in kinds:
                if self._stop():
                    return
                for path in kind():
                    if self._is_hopeful(path):
                        yield path
                    if self._stop():
                        return

    def _is_hopeful(self, path: Array) -> bool:
        """Whether a path, shape (N, dof), is not so deep in obstacles that a motion hardly gets out of them."""
        clearances = self._kernel.clearance(resample(path, FEW_STATES)).min(axis=1)
        return bool(np.minimum(clearances, 0.0).mean() > -DEEP)

    def _sooner(self, goals: Array) -> Array:
        """Return the goals that a motion could reach in less than that duration, shape (N, dof)."""
        return goals[direct_durations(self.query.setup.start, goals, self._limits) < self.most - KNOTS]

    def _goals(self) -> Array:
        return self._sooner(self.query.setup.valid_goals)

    def _ends(self) -> tuple[Array, Array] | None:
        """Return the start and a random goal."""
        goals = self._goals()
        return (self.query.setup.start, goals[self._rng.integers(len(goals))]) if len(goals) else None

    def _lines(self) -> Iterator[Array]:
        """Yield straight lines to new goals."""
        setup = self.query.setup
        if self._goal is None:
            return
        self.query.setup, found = with_more(setup, self._goal, self._rng.spawn(1)[0])
        for goal in self._sooner(found):
            yield np.stack([setup.start, goal])

    def _trees(self) -> Iterator[Array]:
        """Yield a path of new trees."""
        goals, rng = self._goals(), self._rng.spawn(1)[0]
        path = tree_path(self._kernel, self.query.setup.start, goals, rng, self._stop) if len(goals) else None
        if path is not None:
            yield self._between(path, path[0], path[-1])

    def _planned(self) -> Iterator[Array]:
        """Yield the path of the planner with another seed: proposals of its model, repaired, rather than a sprint."""
        from apex_ompl.planning import steps  # which imports this module

        setup, goals, names = self.query.setup, self._goals(), self.query.setup.robot.joint_names
        if not len(goals):
            return
        ends = {
            "start": dict(zip(names, setup.start.tolist(), strict=True)),
            "goal": goal_record(setup.robot, list(goals), {}),
        }  # fmt: skip
        moving = [name for k, name in enumerate(names) if k not in setup.held]
        seed = int(self._rng.integers(MOST_SEED))
        other = assemble(setup.problem.model_copy(update=ends), setup.robot, seed, setup.checker, moving)
        query = PlanQuery(
            other, self.query.planner, self._parameters.changed(seed=seed, sprint=0),
            Deadline(SHARE * self.query.deadline.remaining), interrupt=self.query.interrupt,
        )  # fmt: skip
        found = steps.solve(query, lines=False)
        if found and found.path is not None:
            yield steps.with_exact_ends(other, found.path).states

    def _led(self) -> Iterator[Array]:
        """Yield the path of the best motion with a random free state in place of a stretch."""
        if self.best is None or not len(self._sooner(self.best.positions[-1:])):
            return
        states = self.best(np.linspace(0.0, self.best.duration, STATES))
        first = int(self._rng.integers(0, STATES - 2))
        last = int(self._rng.integers(first + 2, STATES))
        q = self._free_state(states[(first + last) // 2])
        if q is not None:
            inner = np.concatenate([states[: first + 1], q[None], states[last:]])
            yield self._between(inner, *self.best.positions[[0, -1]])

    def _moved(self) -> Iterator[Array]:
        """Yield the path of the best motion with a smooth random movement."""
        if self.best is None or not len(self._sooner(self.best.positions[-1:])):
            return
        rng, s = self._rng, np.linspace(0.0, 1.0, STATES)
        states = resample(self.best(np.linspace(0.0, self.best.duration, STATES)), STATES)
        shape = 4.0 * s * (1.0 - s) * np.exp(-(((s - rng.random()) / rng.uniform(*WIDTHS)) ** 2))
        largest = rng.normal(0.0, np.exp(rng.uniform(*np.log(SHIFTS))), states.shape[1])
        yield self._between(states + shape[:, None] * largest, *self.best.positions[[0, -1]])

    def _through(self) -> Iterator[Array]:
        """Yield a straight line through one or two random free states."""
        ends = self._ends()
        if ends is None:
            return
        shares = np.sort(self._rng.uniform(0.1, 0.9, self._rng.integers(1, 3)))
        states = [self._free_state(ends[0] + share * (ends[1] - ends[0])) for share in shares]
        inner = [q for q in states if q is not None]
        if len(inner) == len(states):
            yield np.stack([ends[0], *inner, ends[1]])

    def _between(self, states: Array, start: Array, goal: Array) -> Array:
        """Return states, shape (N, dof), within the limits, with exact ends and joints that stay."""
        states = states.clip(self._limits.lower, self._limits.upper)
        states[:, self.query.setup.held] = start[self.query.setup.held]
        states[0], states[-1] = start, goal
        return states

    def _free_state(self, around: Array) -> Array | None:
        """Return a random free state around another, shape (dof,), or None."""
        setup, spread = self.query.setup, float(self._rng.choice(SPREADS))
        for _ in range(ATTEMPTS):
            q = np.clip(around + self._rng.normal(0.0, spread, around.shape), self._limits.lower, self._limits.upper)
            q[setup.held] = setup.start[setup.held]
            if setup.checker.is_free(q):
                return np.asarray(q)
        return None
