"""Sampling of free states that reach a goal given in the workspace, those near the start in time first.

Inverse kinematics descends from states around the start, near and far. Each state found is moved within the goal to
where its direct motion from the start is fastest, locally (:meth:`apex_ompl.kernel.IKSolver.approach`). As that knows
no obstacles, the nearest free states are then improved by random search: perturbed, pulled towards the start, brought
back to the goal, and kept where they are free and nearer. Parts of a goal that share no joint, as poses of two hands,
are combined from different descents. Where free states are much farther than colliding ones, all this is done twice.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from apex_ompl.collision import CollisionChecker
from apex_ompl.goals.alignment import relative_error, unit_of, within
from apex_ompl.kernel import IKDescents, IKSolver
from apex_ompl.robot import Robot
from apex_ompl.robot.rest_to_rest import direct_durations, direct_reach
from apex_ompl.types import Array
from apex_ompl.util.arrays import distinct
from apex_ompl.util.display import counted

if TYPE_CHECKING:
    from apex_ompl.constraints.constraint_set import ConstraintSet

BATCH = 32  # descents at once
FEW = 64  # descents of a search, more only until one free state is found
SEARCHES = 2  # one after the other, at most
ENOUGH = 1.15  # ratio of durations, to free states over to any, up to which one search is enough
FARTHEST = 1.2  # largest standard deviation of states around the start [rad]
HOME_SPREAD = 0.6  # standard deviation of states around home [rad]
TOLERANCE = 1e-6  # norm of the residual at which a descent stops
REACHED = 1e-4  # largest norm of the residual of states that reach the goal, or half of the least tolerance
DESCENT_STEPS = 40  # most steps of a descent from a random state
RETURN_STEPS = 20  # most steps of a descent back to the goal
KEPT = 0.75  # share of the states that are kept for the next power, the nearest
POWERS = 2, 4, 8, 16  # of the distances, one after the other
WEIGHTS = 1e2, 4e2, 1e3, 4e3  # of the residuals, for each power
NEAREST = 4  # states that are improved by random search
NEAR, APART = 0.1, 0.5  # least distance, of the joint that moves most, of the nearest states, and of others [rad]
FAR = 1.5  # ratio of the duration to a state to that of the nearest, up to which it is returned
SAME = 0.02  # distance up to which states collide where one does [rad]
KEPT_CLEAR, CLOSE = 0.005, 0.1  # clearance that states keep [m], and share of the duration that one in contact costs
MARGIN = 0.05  # clearance that is enough [m]
CLEARING_ROUNDS = 12  # of random search for a free state
CHILDREN = 16  # states of a round of random search
MIXED = 4  # states of which the joints of a part of the goal are taken
MOST_ROUNDS = 20  # of random search
LOWER, PATIENCE = 0.99, 4  # ratio of costs, and rounds after which it ends without one lower by it
LOG_SPREADS = math.log(0.02), math.log(0.3)  # of the standard deviation of perturbations, as a share of reaches
ALONG = np.array([0.4, 0.65, 0.88])  # states along a line, as shares of it
DETOUR, DEPTH = 0.6, 0.005  # largest share that a blocked line adds to a duration, and depth for half of it [m]
SHORTEST = 0.05  # least duration for which the reach is computed [s]
PULL = 0.3  # largest share of the way to the start


ON_CONSTRAINTS = "constraints"  # error term of a goal of which no state on the constraints was found


class WorkspaceGoal(Protocol):
    """A goal that is reached where some errors are within their bounds."""

    @property
    def robot(self) -> Robot:
        """The robot."""

    @property
    def start(self) -> Array:
        """The start, shape (dof,)."""

    @property
    def inverse(self) -> IKSolver:
        """Inverse kinematics of the goal."""

    @property
    def bounds(self) -> Mapping[str, float]:
        """Tolerance of each error term: lengths [m] and angles [rad]."""

    def errors(self, q: Array) -> Mapping[str, float]:
        """Return the error terms at a state, shape (dof,), all 0 or more."""


@runtime_checkable
class Hinting(Protocol):
    """A goal that may tell why it is out of reach, and what is meant."""

    def out_of_reach(self) -> str:
        """Return why no state reaches it, where that is shown, or nothing."""

    def hint(self) -> str:
        """Return as what it may be meant, or nothing."""


@runtime_checkable
class GoalSet(Protocol):
    """Goals of which any will do, which sample themselves."""

    def sample(
        self, checker: CollisionChecker, rng: np.random.Generator, count: int = 8, max_attempts: int = 200
    ) -> GoalSamples:
        """Sample free states that reach one of the goals."""

    def sample_on(
        self, constraints: ConstraintSet, checker: CollisionChecker, rng: np.random.Generator, count: int = 8,
        max_attempts: int = 200,
    ) -> GoalSamples:  # fmt: skip
        """Sample free states that reach one of the goals and satisfy constraints."""


@dataclass(frozen=True)
class GoalSamples:
    """States sampled for a goal.

    Attributes:
        states: Free states that reach the goal, shape (found, dof).
        attempts: Number of attempts of inverse kinematics.
        converged: Number of attempts that reached the goal, free or in collision.
        best: Error terms of the best attempt.
        blocked: A collision of the last state that reached the goal; empty if one was free or none reached it.
        hint: As what a goal that was not reached may be meant, or nothing.
        far: Why no state reaches the goal, where that is shown, or nothing.
    """

    states: Array
    attempts: int
    converged: int
    best: Mapping[str, float]
    blocked: str
    hint: str = ""
    far: str = ""

    @property
    def fault(self) -> str:
        """Reason for which there is no state, in one sentence; empty when there is one."""
        if len(self.states):
            return ""
        tried = counted(self.attempts, "descent")
        if not self.attempts and not self.converged:
            return "none of the goal states is inside the limits and leaves the joints that are not planned as they are"
        if ON_CONSTRAINTS in self.best:
            return f"none on the constraints found in {tried}"
        if self.converged:
            return f"none found in {tried}: all {counted(self.converged, 'state')} at the goal collide, {self.blocked}"
        best = ", ".join(f"{name} {value:.3g} {unit_of(name)} off" for name, value in self.best.items())
        return "; ".join(filter(None, [self.far or f"none found in {tried}; the best has {best}", self.hint]))


def sample(
    goal: WorkspaceGoal | GoalSet,
    checker: CollisionChecker,
    rng: np.random.Generator,
    count: int = 8,
    max_attempts: int = 200,
) -> GoalSamples:
    """Sample free states that reach a goal: the nearest to the start in time, then others that are apart from them.

    Args:
        goal: The goal.
        checker: Checks the states for collision.
        rng: Source of random numbers.
        count: Most states to return.
        max_attempts: Most descents from random states.
    """
    if isinstance(goal, GoalSet):
        return goal.sample(checker, rng, count, max_attempts)
    search = _Search(goal, checker, rng)
    near = others = np.empty((0, checker.robot.dof))
    for _ in range(SEARCHES):
        found, reached = search.found(count, max_attempts)
        near, others = search.best_of(np.concatenate([near, found])), np.concatenate([others, reached])
        if not len(near) or search.durations(near).min() <= ENOUGH * search.least:
            break
    if len(near):
        near = near[:count]
        others = others[search.durations(others) <= FAR * search.durations(near).min()]
    states = np.concatenate([near, search.nearest(others, count - len(near), APART, near)])
    states = states[[within(goal.errors(q), goal.bounds) for q in states]]
    converged, blocked = search.converged, ""
    if search.colliding is None and not len(states):
        converged = 0
    if search.colliding is not None and not len(states):
        blocked = str(next(iter(checker.contacts(search.colliding)), "in collision"))
    hint = far = ""
    if isinstance(goal, Hinting) and not len(states) and not converged:
        hint, far = goal.hint(), goal.out_of_reach()
    return GoalSamples(states, search.attempts, converged, search.errors, blocked, hint, far)


def sample_on_constraints(
    goal: WorkspaceGoal | GoalSet, constraints: ConstraintSet, checker: CollisionChecker, rng: np.random.Generator,
    *, known: GoalSamples, count: int = 8, max_attempts: int = 200,
) -> GoalSamples:  # fmt: skip
    """Sample free states that reach a goal and satisfy constraints along the path, the nearest to the start first.

    States of the goal, and random ones, are moved by Newton's method on the residuals of both together.

    Args:
        goal: The goal.
        constraints: The constraints.
        checker: Checks the states for collision.
        rng: Source of random numbers.
        known: States of the goal, from which it begins.
        count: Most states to return.
        max_attempts: Most random states.
    """
    if isinstance(goal, GoalSet):
        return goal.sample_on(constraints, checker, rng, count, max_attempts)
    search, found, attempts, converged = _Search(goal, checker, rng), list[Array](), 0, 0
    states, blocked = known.states, ""
    while True:
        for q in states:
            end, arrived = constraints.newton(q, goal.inverse.residual)
            if arrived and within(goal.errors(end), goal.bounds) and constraints.is_satisfied(end):
                converged += 1
                if checker.is_free(end):
                    found.append(end)
                else:
                    blocked = str(next(iter(checker.contacts(end)), "in collision"))
        if len(found) >= count or attempts >= max_attempts or (found and attempts >= FEW):
            break
        states = search.first_states(BATCH, around_home=attempts > 0)
        states = search.descended(states, DESCENT_STEPS).states
        attempts += BATCH
    near = search.nearest(np.array(found).reshape(-1, len(search.start)), count, NEAR)
    best = known.best if converged else {**known.best, ON_CONSTRAINTS: math.inf}
    return GoalSamples(near, known.attempts + attempts, converged, best, blocked)


class _Search:
    """Search for states of a goal that are near the start in time.

    Attributes:
        attempts: Number of descents from random states.
        converged: Number of those that reached the goal.
        errors: Error terms of the best of them.
        least: Least duration of a direct motion to a state that reaches the goal, free or in collision [s].
        colliding: A state that reaches the goal in collision, or None.
    """

    def __init__(self, goal: WorkspaceGoal, checker: CollisionChecker, rng: np.random.Generator) -> None:
        self.goal, self.checker, self.rng = goal, checker, rng
        self.limits = goal.robot.limits
        self.start = goal.start.clip(self.limits.lower, self.limits.upper)
        self.attempts, self.converged = 0, 0
        self.errors: Mapping[str, float] = {}
        self.least = math.inf
        self.colliding: Array | None = None
        self._reached = min(REACHED, *(bound / 2.0 for bound in goal.bounds.values() if bound))
        self._known: dict[bytes, bool] = {}  # whether a state is free
        self._blocked = np.empty((0, len(self.start)))
        self._start_clearance = checker.kernel.clearance(self.start[None], 0.0)

    def found(self, count: int, max_attempts: int) -> tuple[Array, Array]:
        """Return free states of low cost, shape (N, dof), and all that descents reached, (M, dof), by a search anew.

        Args:
            count: Most states that are wanted.
            max_attempts: Most descents of this search and those before.
        """
        near = known = reached = np.empty((0, len(self.start)))
        first = self.attempts
        while self.attempts < max_attempts and (not len(near) or self.attempts < first + FEW):
            ends = self.descended(
                self.first_states(min(BATCH, max_attempts - self.attempts), around_home=self.attempts > 0),
                DESCENT_STEPS,
            )
            self.attempts += len(ends.states)
            errors, bounds = self.goal.errors(ends.states[int(np.argmin(ends.errors))]), self.goal.bounds
            if not self.errors or relative_error(errors, bounds) < relative_error(self.errors, bounds):
                self.errors = errors
            new = self.reached(ends)
            self.converged += len(new)
            reached = np.concatenate([reached, new])
            if len(self.nearest(reached, 1, APART)):
                new = np.concatenate([new, self.mixed(reached)])
                known = np.concatenate([near, new, *self.approached(new)])
            else:
                known = reached = np.concatenate([reached, self.cleared(new)])
            near = self.nearest(known, min(count, NEAREST), NEAR)
        return (self.improved(near, np.concatenate([known, reached])) if len(near) else near), reached

    def best_of(self, states: Array) -> Array:
        """Return the free state of least cost and the nearest others, shape (N, dof)."""
        best = states[self.free(states, self.costs(states, self.durations(states)), 1, 0.0)]
        return np.concatenate([best, self.nearest(states, NEAREST - 1, NEAR, best)])

    def durations(self, states: Array) -> Array:
        """Return the least durations of direct motions to states, shape (N,) [s]."""
        return direct_durations(self.start, states, self.limits)

    def first_states(self, count: int, around_home: bool) -> Array:
        """Return random states from which inverse kinematics descends, shape (count, dof).

        They are around the start, near and far, or every other one around home. Joints that do not matter for the goal
        are as at the start.
        """
        free = self.goal.inverse.free
        states, noise = np.tile(self.start, (count, 1)), self.rng.normal(size=(count, len(free)))
        states[:, free] += np.linspace(0.0, FARTHEST, count)[:, None] * noise
        if around_home:
            states[1::2, free] = self.goal.robot.home[free] + HOME_SPREAD * noise[1::2]
        return states.clip(self.limits.lower, self.limits.upper)

    def descended(self, states: Array, max_steps: int) -> IKDescents:
        """Return the ends of descents from states, shape (N, dof), continuous joints at most half a turn away."""
        ends = self.goal.inverse.descend(states, tolerance=TOLERANCE, max_steps=max_steps)
        return ends._replace(states=self.goal.robot.turned_to(ends.states, self.start))

    def returned(self, states: Array) -> Array:
        """Return the ends of descents from states, shape (N, dof), that reach the goal."""
        ends = self.descended(states, RETURN_STEPS)
        return ends.states[ends.errors <= self._reached]

    def reached(self, ends: IKDescents) -> Array:
        """Return the ends that reach the goal, shape (N, dof); inexactly only where none does so exactly."""
        exact = ends.errors <= self._reached
        if not exact.any():
            exact = np.array([within(self.goal.errors(q), self.goal.bounds) for q in ends.states])
        return ends.states[exact]

    def mixed(self, states: Array) -> Array:
        """Return states of the goal with the joints of each of its parts from the states where these are nearest.

        Parts of a goal depend on no joint in common, as the poses of two hands; with a single one there are none.

        Args:
            states: States that reach the goal, shape (N, dof).

        Returns:
            States that reach the goal, shape (M, dof).
        """
        parts = self._parts(states[0]) if len(states) else []
        if len(parts) < 2:
            return states[:0]
        nearest = list[NDArray[np.intp]]()
        for joints in parts:
            alone = np.tile(self.start, (len(states), 1))
            alone[:, joints] = states[:, joints]
            nearest.append(np.argsort(self.durations(alone), kind="stable")[:MIXED])
        rows = list(itertools.islice(itertools.product(*nearest), CHILDREN))
        mixed = states[[row[0] for row in rows]]
        for k, joints in enumerate(parts[1:], 1):
            mixed[:, joints] = states[[row[k] for row in rows]][:, joints]
        return mixed

    def approached(self, states: Array) -> list[Array]:
        """Return states moved within the goal towards the start, for each power, shape (N, dof) each."""
        found = list[Array]()
        for power, weight in zip(POWERS, WEIGHTS, strict=True):
            if not len(states):
                break
            durations = self.durations(states)
            self.least = min(self.least, float(durations.min()))
            states = states[np.argsort(durations, kind="stable")[: max(int(KEPT * len(states)), 1)]]
            ends = self.goal.inverse.approach(states, self.start, self._reach(states), power, weight=weight)
            states = self.returned(ends.states)
            found.append(states)
        return found

    def cleared(self, states: Array) -> Array:
        """Return states of the goal with more clearance, by random search, shape (N, dof)."""
        best = states[:0]
        clearances = np.empty(0)
        for _ in range(CLEARING_ROUNDS if len(states) else 0):
            best, clearances = np.concatenate([best, states]), np.append(clearances, self._clearances(states))
            order = np.argsort(-clearances, kind="stable")[:NEAREST]
            best, clearances = best[order], clearances[order]
            if self._is_free(best[0]):
                break
            states = self._children(best, 0.0)
        return best

    def free(self, states: Array, costs: Array, count: int, apart: float, taken: Array | None = None) -> list[int]:
        """Return the rows of the free states of least cost, up to a number of them, that are apart from each other.

        Args:
            states: States that reach the goal, shape (N, dof).
            costs: Their costs, shape (N,).
            count: Their largest number.
            apart: Least distance, of the joint that moves most.
            taken: States from which they are to be apart, too, shape (M, dof).
        """
        rows = list[int]()
        taken = states[:0] if taken is None else taken
        for row in np.argsort(costs, kind="stable"):
            q = states[row]
            if len(rows) >= count:
                break
            if not (np.abs(taken - q).max(axis=1) < apart).any() and self._is_free(q):
                rows.append(int(row))
                taken = np.concatenate([taken, q[None]])
        return rows

    def nearest(self, states: Array, count: int, apart: float, taken: Array | None = None) -> Array:
        """Return the free states that are nearest in time, see :meth:`free`."""
        closeness = _closeness(self.checker.kernel.clearance(states, KEPT_CLEAR))
        return states[self.free(states, self.durations(states) * closeness, count, apart, taken)]

    def costs(self, states: Array, durations: Array) -> Array:
        """Return the durations to states, more by a share where the straight lines to them collide, shape (N,) [s]."""
        clearances = self.checker.kernel.clearance(states, KEPT_CLEAR)
        lines = self.start + ALONG[:, None, None] * (states - self.start)
        along = self.checker.kernel.clearance(lines.reshape(-1, states.shape[1]), 0.0)
        least = np.minimum(self._start_clearance, clearances)
        depths = np.maximum(least - along.reshape(len(ALONG), len(states), 2), 0.0).sum(axis=2).mean(axis=0)
        blocked = 1.0 + DETOUR * depths / (depths + DEPTH)
        costs: Array = durations * blocked * _closeness(clearances)
        return costs

    def improved(self, near: Array, known: Array) -> Array:
        """Return free states of lower cost by random search, the least one first, and nearest ones, shape (N, dof).

        Args:
            near: The nearest free states, shape (N, dof).
            known: States that reach the goal, shape (M, dof).
        """
        durations = self.durations(known)
        nearest = np.argsort(durations, kind="stable")[:CHILDREN]
        best, durations = np.concatenate([near, known[nearest]]), np.append(self.durations(near), durations[nearest])
        costs = self.costs(best, durations)
        rows = self.free(best, costs, NEAREST, NEAR)
        best, costs = best[rows], costs[rows]
        least, idle = np.inf, 0
        for _ in range(MOST_ROUNDS):
            idle = 0 if costs[0] < LOWER * least else idle + 1
            least = min(least, costs[0])
            if idle >= PATIENCE:
                break
            children = self._children(best, PULL)
            durations = self.durations(children)
            sooner = durations < costs.max()
            if sooner.any():
                children, durations = children[sooner], durations[sooner]
                best, costs = np.concatenate([best, children]), np.append(costs, self.costs(children, durations))
                rows = self.free(best, costs, NEAREST, 0.0)
                best, costs = best[rows], costs[rows]
        best = best[:1]
        return np.concatenate([best, self.nearest(np.concatenate([near, best]), NEAREST - 1, NEAR, best)])

    def _parts(self, q: Array) -> list[NDArray[np.int64]]:
        """Return the joints of each part of the goal, by the Jacobian at a state, shape (dof,)."""
        free = self.goal.inverse.free
        depends = self.goal.inverse.residual(q)[1][:, free] != 0.0
        part = np.arange(len(free))
        for row in depends[depends.any(axis=1)]:
            part[np.isin(part, part[row])] = part[row].min()
        return [free[part == k] for k in distinct(part[depends.any(axis=0)])]

    def _reach(self, states: Array) -> Array:
        """Return how far the joints move in the least duration to one of states, shape (dof,)."""
        return direct_reach(max(float(self.durations(states).min()), SHORTEST), self.limits)

    def _children(self, parents: Array, pull: float) -> Array:
        """Return states of the goal around others, shape (N, dof), up to a share ``pull`` of the way to the start."""
        rng, free = self.rng, self.goal.inverse.free
        children = parents[rng.integers(len(parents), size=CHILDREN)]
        spread = np.array([[math.exp(one)] for one in rng.uniform(*LOG_SPREADS, size=CHILDREN).tolist()])
        change = spread * self._reach(parents) * rng.normal(size=children.shape)
        change += pull * rng.random((CHILDREN, 1)) * (self.start - children)
        children[:, free] += change[:, free]
        return self.returned(children)

    def _clearances(self, states: Array) -> Array:
        """Return the sum of the least clearances to obstacles and of the robot to itself, shape (N,) [m]."""
        clearances: Array = self.checker.kernel.clearance(states, MARGIN).sum(axis=1)
        return clearances

    def _is_free(self, q: Array) -> bool:
        """Whether a state is free."""
        key = q.tobytes()
        if key not in self._known:
            if (np.abs(self._blocked - q).max(axis=1) < SAME).any():
                return False
            self._known[key] = free = self.checker.is_free(q)
            if not free:
                self.colliding = q
                self._blocked = np.concatenate([self._blocked, q[None]])
        return self._known[key]


def _closeness(clearances: Array) -> Array:
    """Return factors on durations for states that are near something, shape (N,), for clearances, shape (N, 2) [m]."""
    near = (KEPT_CLEAR - clearances).max(axis=1, initial=0.0)
    factors: Array = 1.0 + CLOSE * np.minimum(near / KEPT_CLEAR, 1.0)
    return factors
