"""Goals of which any will do: poses, such as grasps of an object, alignments and joint configurations.

A few descents of inverse kinematics for each goal find those that can be reached soon; poses of arms without a common
joint are reached one by one, and combined. These are then sampled as a goal
alone is (:mod:`apex_ompl.goals.goal_sampling`), and the states that are nearest in time are returned. A pose with a
region is a goal of this kind as well: poses that are drawn in the region.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable, Iterator, Mapping, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from apex_ompl.collision import CollisionChecker
from apex_ompl.goals import goal_sampling as single
from apex_ompl.goals.alignment import AlignmentGoal, relative_error, within
from apex_ompl.goals.goal_sampling import GoalSamples
from apex_ompl.goals.pose_goal import PoseGoal
from apex_ompl.robot import Robot
from apex_ompl.robot.rest_to_rest import direct_durations
from apex_ompl.types import Array

if TYPE_CHECKING:
    from apex_ompl.constraints.constraint_set import ConstraintSet

ANY = "goal"  # error term: 0 where a goal is reached, else the least error relative to the bounds
DESCENTS = 1024  # of the first search, for all goals together, within the numbers for each
LEAST_DESCENTS, MOST_DESCENTS = 4, 32  # for each
OF_ARM = 4  # states of an arm at a pose that are combined with those of others
EXAMINED = 4  # goals that are sampled in full: those with the nearest free states
ENOUGH = 32  # free states of the first search with which none is
UNTRIED = 12  # the same where the first search found no free state
NEAREST = 3  # goals that are the nearest to a state
ROUNDING = 1e-9  # of distances [m]
SHARE = 2  # states that are returned, as a multiple of those for a goal alone


class _First(NamedTuple):
    """Outcome of the first search.

    Attributes:
        states: Free states, shape (N, dof).
        members: Number of the goal that each reaches, -1 of joint configurations, shape (N,).
        order: Numbers of the goals to be sampled in full.
        attempts: Number of descents.
        converged: Number of those that reached a goal.
        blocked: A collision of a joint configuration; empty where one is free.
    """

    states: Array
    members: NDArray[np.intp]
    order: list[int]
    attempts: int
    converged: int
    blocked: str


class _OfArm(NamedTuple):
    """States in which an arm reaches a pose, the nearest ones.

    Attributes:
        free: Numbers of the joints of the arm.
        states: Shape (N, dof).
        durations: Durations to them, shape (N,) [s].
    """

    free: NDArray[np.intp]
    states: Array
    durations: Array


class AnyGoal:
    """Goals of which any will do."""

    def __init__(self, robot: Robot, members: Sequence[PoseGoal | AlignmentGoal], states: Array, start: Array) -> None:
        """Take goals in the workspace, and joint configurations.

        Args:
            robot: The robot.
            members: The goals in the workspace.
            states: The joint configurations, shape (N, dof).
            start: The start, shape (dof,).
        """
        self.robot, self.members = robot, tuple(members)
        self.start = np.clip(start, robot.limits.lower, robot.limits.upper)
        inside = ((states >= robot.limits.lower) & (states <= robot.limits.upper)).all(axis=1)
        self.states = robot.turned_to(states[inside], self.start)

    @property
    def bounds(self) -> Mapping[str, float]:
        """Tolerance of the error term."""
        return {ANY: 0.0}

    def errors(self, q: Array) -> Mapping[str, float]:
        """Return 0 where a goal is reached at a state, shape (dof,), else the least error relative to the bounds."""
        turned = self.robot.turned_to(self.states, q)
        reached = bool((np.abs(turned - q).max(axis=1, initial=0.0) <= single.TOLERANCE).any())
        least = 0.0 if reached else np.inf
        for _, errors, bounds in self._errors(q):
            if not least:
                break
            least = 0.0 if within(errors, bounds) else min(least, relative_error(errors, bounds))
        return {ANY: least}

    def _errors(
        self, q: Array, some: set[int] | None = None
    ) -> Iterator[tuple[int, Mapping[str, float], Mapping[str, float]]]:
        """Yield number, errors at a state and bounds of goals; of those with the same poses, of the first alone."""
        placed = dict[object, list[Array]]()
        for k in self._distinct:
            if some is not None and k not in some:
                continue
            goal = self.members[k]
            if isinstance(goal, PoseGoal):
                if goal.where not in placed:
                    placed[goal.where] = goal.placements(q)
                yield k, goal.errors(q, placed[goal.where]), goal.bounds
            else:
                yield k, goal.errors(q), goal.bounds

    @cached_property
    def _distinct(self) -> list[int]:
        """Numbers of the goals, without those that differ from one before in what inverse kinematics is to reach."""
        found, before = list[int](), None
        for k, goal in enumerate(self.members):
            poses = goal.poses if isinstance(goal, PoseGoal) else None
            if poses is None or poses is not before:
                found.append(k)
            before = poses
        return found

    def nearest_states(self, checker: CollisionChecker, rng: np.random.Generator, count: int) -> Array:
        """Return free states that reach goals, by a few descents for each: the nearest of each goal in turn.

        Args:
            checker: Checks the states for collision.
            rng: Source of random numbers.
            count: Most states.

        Returns:
            Shape (N, dof).
        """
        first = self._first(checker, rng)
        order = np.argsort(self._durations(first.states), kind="stable") if len(first.states) else np.empty(0, np.intp)
        ranked, seen = list[tuple[int, int]](), Counter[int]()
        for k, member in enumerate(first.members[order].tolist()):
            ranked.append((seen[member], k))
            seen[member] += 1
        return first.states[[int(order[k]) for _, k in sorted(ranked)][:count]]

    def nearest_members(self, q: Array) -> list[PoseGoal | AlignmentGoal]:
        """Return the goals whose errors at a state, shape (dof,), are least relative to their bounds, at most three."""
        errors = {k: relative_error(errors, bounds) for k, errors, bounds in self._errors(q)}
        return [self.members[k] for k in sorted(errors, key=errors.__getitem__)[:NEAREST]]

    def member_of(self, q: Array) -> int:
        """Return the number of the first goal that a state, shape (dof,), reaches, or -1 of a joint configuration."""
        return next((k for k, errors, bounds in self._errors(q, self._near(q)) if within(errors, bounds)), -1)

    def _near(self, q: Array) -> set[int]:
        """Return the numbers of the goals that may be reached at a state: those whose frames are near enough."""
        found = {k for k, goal in enumerate(self.members) if not isinstance(goal, PoseGoal)}
        for numbers, wanted, reach in self._origins:
            goal = self.members[numbers[0]]
            assert isinstance(goal, PoseGoal)
            at = np.array([pose[:3, 3] for pose in goal.placements(q)])
            found.update(numbers[(np.linalg.norm(wanted - at, axis=2) <= reach).all(axis=1)].tolist())
        return found

    @cached_property
    def _origins(self) -> list[tuple[NDArray[np.intp], Array, Array]]:
        """For poses of the same frames: numbers of the goals, origins, shape (n, frames, 3), and how far is inside."""
        alike = dict[Hashable, list[int]]()
        for k, goal in enumerate(self.members):
            if isinstance(goal, PoseGoal):
                alike.setdefault(goal.where, []).append(k)
        found = []
        for numbers in alike.values():
            poses = [goal.poses for goal in (self.members[k] for k in numbers) if isinstance(goal, PoseGoal)]
            wanted = np.array([[pose.position for pose in some] for some in poses])
            corners = [[np.maximum(np.abs(pose.lower), np.abs(pose.upper)) for pose in some] for some in poses]
            within = [[pose.tolerance.position for pose in some] for some in poses]
            found.append((np.array(numbers), wanted, np.linalg.norm(corners, axis=2) + within + ROUNDING))
        return found

    def sample(
        self, checker: CollisionChecker, rng: np.random.Generator, count: int = 8, max_attempts: int = 200
    ) -> GoalSamples:
        """Sample free states that reach a goal, the nearest to the start in time first.

        Args:
            checker: Checks the states for collision.
            rng: Source of random numbers.
            count: States to return of a goal alone; at most twice as many are returned.
            max_attempts: Most descents from random states for each goal that is sampled in full.
        """
        first = self._first(checker, rng)
        order = [] if len(first.states) >= ENOUGH else first.order
        found = [single.sample(self.members[k], checker, rng, count, max_attempts) for k in order]
        states = np.concatenate([first.states, *(one.states for one in found)])
        states = self._nearest(states, SHARE * count)
        attempts = first.attempts + sum(one.attempts for one in found)
        converged = first.converged + sum(one.converged for one in found)
        if len(states):
            return GoalSamples(states, attempts, converged, {}, "")
        blocked = next((one.blocked for one in found if one.blocked), first.blocked)
        best = min((one.best for one in found), key=lambda best: max(best.values()), default={})
        hint = next((one.hint for one in found if one.hint), "")
        return GoalSamples(states, attempts, converged, best, blocked, hint, "" if converged else self._out_of_reach())

    def _out_of_reach(self) -> str:
        """Return why no goal can be reached, where that is shown of all, or nothing."""
        shown = [goal.out_of_reach() if isinstance(goal, PoseGoal) else "" for goal in self.members]
        return shown[0] if shown and all(shown) and not len(self.states) else ""

    def sample_on(
        self, constraints: ConstraintSet, checker: CollisionChecker, rng: np.random.Generator, count: int = 8,
        max_attempts: int = 200,
    ) -> GoalSamples:  # fmt: skip
        """Sample free states that reach a goal and satisfy constraints along the path, as :meth:`sample` does."""
        first = self._first(checker, rng)
        found = list[GoalSamples]()
        for k in first.order:
            known = single.sample(self.members[k], checker, rng, count, max_attempts)
            found.append(
                single.sample_on_constraints(
                    self.members[k], constraints, checker, rng, known=known, count=count, max_attempts=max_attempts
                )
            )
        kept = self.states[[checker.is_free(q) and constraints.is_satisfied(q) for q in self.states]]
        states = self._nearest(np.concatenate([kept, *(one.states for one in found)]), SHARE * count)
        attempts = first.attempts + sum(one.attempts for one in found)
        return GoalSamples(states, attempts, len(states), {} if len(states) else {single.ON_CONSTRAINTS: np.inf}, "")

    def _first(self, checker: CollisionChecker, rng: np.random.Generator) -> _First:
        """Return free states by a few descents for each goal, and the goals to be sampled in full."""
        known = dict[Hashable, _OfArm]()
        found, attempts = list[Array](), 0
        for goal, parts in zip(self.members, self._separate, strict=True):
            if parts:
                for key, part in parts.items():
                    if key not in known:
                        tried, there = self._descended(part, self._count, rng)
                        states = self._nearest(there, OF_ARM)
                        known[key] = _OfArm(part.inverse.free, states, self._durations(states))
                        attempts += tried
                there = self._combined([known[key] for key in parts])
            else:
                tried, there = self._descended(goal, len(self.members), rng)
                attempts += tried
            if isinstance(goal, PoseGoal) and not goal.residual_decides:
                there = there[[within(goal.errors(q), goal.bounds) for q in there]]
            found.append(there)
        reached = np.array([len(there) > 0 for there in found], bool)
        states = np.concatenate([self.states[:0], *found])
        member = np.repeat(np.arange(len(found)), [len(there) for there in found])
        free = checker.are_free(states) if len(states) else np.zeros(0, bool)
        states, members = states[free], member[free]
        least = np.full(len(self.members), np.inf)  # duration to the nearest free state of each goal [s]
        np.minimum.at(least, members, self._durations(states))
        converged, blocked = len(self.states) + len(member), ""
        free = self.states[[checker.is_free(q) for q in self.states]]
        if len(self.states) and not len(free):
            blocked = str(next(iter(checker.contacts(self.states[0])), "in collision"))
        order = np.lexsort([least, ~reached])[: EXAMINED if np.isfinite(least).any() else UNTRIED]
        members = np.concatenate([np.full(len(free), -1), members])
        return _First(np.concatenate([free, states]), members, order.tolist(), attempts, converged, blocked)

    def _descended(
        self, goal: PoseGoal | AlignmentGoal, among: int, rng: np.random.Generator
    ) -> tuple[int, Array]:  # fmt: skip
        """Return the number of descents from near the start for one of some goals, and the states that reach it."""
        each = int(np.clip(DESCENTS // max(among, 1), LEAST_DESCENTS, MOST_DESCENTS))
        seeds, free = np.tile(self.start, (each, 1)), goal.inverse.free
        seeds[:, free] += np.linspace(0.0, single.FARTHEST, each)[:, None] * rng.normal(size=(each, len(free)))
        ends = goal.inverse.descend(
            seeds.clip(self.robot.limits.lower, self.robot.limits.upper),
            tolerance=single.TOLERANCE, max_steps=single.DESCENT_STEPS,
        )  # fmt: skip
        return each, self.robot.turned_to(ends.states[ends.errors <= 10.0 * single.TOLERANCE], self.start)

    @cached_property
    def _separate(self) -> list[dict[Hashable, PoseGoal]]:
        """For each goal whose poses are of arms without a common joint, goals of single poses; for others nothing."""
        known, apart = dict[Hashable, PoseGoal](), dict[Hashable, bool]()
        found = list[dict[Hashable, PoseGoal]]()
        for goal in self.members:
            found.append({})
            if not isinstance(goal, PoseGoal) or len(goal.poses) < 2 or not apart.get(goal.where, True):
                continue
            keys = list(zip(goal.where, goal.poses, goal.drawn_poses, strict=True))
            parts: dict[Hashable, PoseGoal] = {key: known.get(key) or goal.of_one(k) for k, key in enumerate(keys)}
            known |= parts
            if goal.where not in apart:
                joints = [k for part in parts.values() for k in part.inverse.free.tolist()]
                apart[goal.where] = len({*joints}) == len(joints)
            if apart[goal.where]:
                found[-1] = parts
        return found

    @cached_property
    def _count(self) -> int:
        """Number of single poses of separate arms."""
        return len({key for parts in self._separate for key in parts})

    def _combined(self, found: Sequence[_OfArm]) -> Array:
        """Return states of all arms from states of each, the nearest in time, shape (N, dof)."""
        durations = np.zeros(())
        for one in found:
            durations = np.maximum(durations[..., None], one.durations)
        chosen = np.argsort(durations, axis=None, kind="stable")[:LEAST_DESCENTS]
        states = np.tile(self.start, (len(chosen), 1))
        for one, numbers in zip(found, np.unravel_index(chosen, durations.shape), strict=True):
            states[:, one.free] = one.states[numbers][:, one.free]
        return states

    def _durations(self, states: Array) -> Array:
        return direct_durations(self.start, states, self.robot.limits)

    def _nearest(self, states: Array, count: int) -> Array:
        """Return the states that are nearest in time and apart from each other, shape (N, dof)."""
        kept = list[Array]()
        for k in np.argsort(self._durations(states), kind="stable"):
            apart = single.NEAR if len(kept) < single.NEAREST else single.APART
            if len(kept) < count and all(np.abs(q - states[k]).max() >= apart for q in kept):
                kept.append(states[k])
        return np.array(kept).reshape(-1, self.robot.dof)
