"""Inverse kinematics in a world: free states that reach poses, one for each branch, or why there is none.

Poses of frames that share no joint, such as those of two hands, are solved one after the other and combined. The states
of a redundant arm are those along its self-motions (:mod:`apex_ompl.goals.self_motions`). Of a region, these are the
self-motions at poses that are drawn in it (:func:`apex_ompl.goals.pose_goal.pose_goals`).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import overload

import numpy as np
from numpy.typing import NDArray

from apex_ompl.collision import CollisionChecker
from apex_ompl.collision.tables import with_range
from apex_ompl.constraints.links import Links
from apex_ompl.errors import ParameterError
from apex_ompl.goals.alignment import within
from apex_ompl.goals.pose_goal import pose_goals
from apex_ompl.goals.self_motions import DESCENT_STEPS, EXACT, REACHED, SelfMotions, search
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import AttachedObject
from apex_ompl.scene.problem import PoseTarget
from apex_ompl.types import Array
from apex_ompl.util.arrays import distinct
from apex_ompl.util.display import counted, one_line

MOST_STATES = 4096  # of one arm, and of combinations of two
WANTED_CLEARANCE = 0.3  # beyond which clearances by spheres are not told apart [m]
DIGITS = 3  # of clearances that are told apart [m]
BLAMED = 64  # states in collision, and descents, whose cause is determined


@dataclass(frozen=True, eq=False)
class IKSolution:
    """A free state that reaches poses.

    Attributes:
        state: The state, shape (dof,).
        clearance: Distance of the nearest pair of bodies that is checked [m].
        distance: Distance from the state that was given as ``near``, or from home [rad].
        branch: Number of its self-motion: states with the same number are joined by motions that keep the poses.
    """

    state: Array
    clearance: float
    distance: float
    branch: int

    def __repr__(self) -> str:
        """Return the branch, the clearance and the distance."""
        return one_line(
            "IKSolution",
            f"branch {self.branch}",
            f"clearance {1e3 * self.clearance:.1f} mm",
            f"{self.distance:.2f} rad",
        )


@dataclass(frozen=True, eq=False)
class IKResult(Sequence[IKSolution]):
    """Outcome of :meth:`apex_ompl.MotionPlanner.ik`: a sequence of solutions, the best first; false where none is.

    Attributes:
        solutions: The solutions.
        reason: Why there is none, in one sentence; empty where there is one.
        descents: Number of descents from random states.
        reached: Number of states that reach the poses inside the limits, free or in collision.
        causes: What stood in the way -> share of the states that it stopped: names of bodies, joints at their limits.
    """

    solutions: tuple[IKSolution, ...]
    reason: str
    descents: int
    reached: int
    causes: Mapping[str, float] = field(default_factory=dict)

    @overload
    def __getitem__(self, k: int) -> IKSolution: ...
    @overload
    def __getitem__(self, k: slice) -> tuple[IKSolution, ...]: ...
    def __getitem__(self, k: int | slice) -> IKSolution | tuple[IKSolution, ...]:
        """Return a solution, or several."""
        return self.solutions[k]

    def __len__(self) -> int:
        """Return the number of solutions."""
        return len(self.solutions)

    def __iter__(self) -> Iterator[IKSolution]:
        """Return an iterator over the solutions."""
        return iter(self.solutions)

    @property
    def states(self) -> Array:
        """The states of the solutions, shape (N, dof)."""
        return np.array([one.state for one in self.solutions])

    def __repr__(self) -> str:
        """Return the number of solutions, or why there is none."""
        return one_line("IKResult", counted(len(self), "solution"), self.reason or repr(self.solutions[0]))


def solve(
    checker: CollisionChecker, poses: Sequence[PoseTarget], base: Array, fixed: NDArray[np.intp], *,
    by_distance: bool, count: int, descents: int, seed: int,
) -> IKResult:  # fmt: skip
    """Return the free states that reach poses.

    Args:
        checker: Checker of the world.
        poses: The poses, all of which are to be reached.
        base: Values of the joints that move none of the frames; distances are from it, shape (dof,).
        fixed: Numbers of the joints that stay as there.
        by_distance: Whether the nearest come first, and not those with the largest clearance.
        count: Most solutions.
        descents: Most descents for each arm.
        seed: Seed of the random states.

    Raises:
        UnknownNameError: A frame is not a hand, a link or a held object.
        ParameterError: No joint moves a frame.
    """
    robot, held = checker.robot, tuple(checker.held.values())
    checker.prepare()
    parts = [_Part(robot, group, held, base, fixed) for group in _groups(robot, poses, held, base, fixed)]
    for part in parts:
        if far := part.out_of_reach():
            return IKResult((), _hinted(far, part), 0, 0)
    rng = np.random.default_rng(seed)
    found = [part.search(rng, descents) for part in parts]
    tried = sum(one.descents for one in found)
    for part, motions in zip(parts, found, strict=True):
        if not len(motions.states):
            causes = part.limits_in_the_way(motions.missed)
            reason = _reason(f"none found for {part.names}", tried, causes)
            return IKResult((), _hinted(reason, part), tried, 0, causes)
    states, branches = _combined(found, parts, base)
    free = checker.are_free(states)
    if not free.any():
        causes = blame(checker, states)
        reason = _reason(f"none of {counted(len(states), 'state')} that reach the poses is free", tried, causes)
        return IKResult((), reason, tried, len(states), causes)
    states, branches, reached = states[free], branches[free], len(states)
    distances = np.linalg.norm(states - base, axis=1)
    least = np.zeros(len(states)) if by_distance else checker.kernel.clearance(states, WANTED_CLEARANCE).min(axis=1)
    best = np.lexsort([distances, -np.round(least, DIGITS)])[:count]
    clearances = checker.clearances(states[best]).tolist()
    solutions = [
        IKSolution(states[k], clearance, distances[k], int(branches[k]))
        for k, clearance in zip(best, clearances, strict=True)
    ]
    if not by_distance:
        solutions.sort(key=lambda one: (-round(one.clearance, DIGITS), one.distance))
    return IKResult(tuple(solutions), "", tried, reached)


def blame(checker: CollisionChecker, states: Array) -> dict[str, float]:
    """Return what states in collision collide with, and the share of the states for which that is deepest."""
    chosen = states[np.linspace(0, len(states) - 1, min(BLAMED, len(states))).astype(int)]
    scene = {*checker.obstacles, *(body.name for body in checker.robot.fixtures)}
    causes = Counter[str]()
    for q in chosen:
        contact = next(iter(checker.contacts(q)), None)
        names = () if contact is None else (contact.first, contact.second)
        causes[next((name for name in names if name in scene), "self-collision")] += 1
    return {cause: number / len(chosen) for cause, number in causes.most_common()}


def _reason(what: str, descents: int, causes: Mapping[str, float]) -> str:
    shares = ", ".join(f"{cause} ({100.0 * share:.0f} %)" for cause, share in causes.items())
    return f"{what} in {counted(descents, 'descent')}" + (f"; in the way: {shares}" if shares else "")


def _hinted(reason: str, part: _Part) -> str:
    """Return a reason with a hint, where the poses could be reached in another unit or order."""
    hint = part.goal.hint()
    return f"{reason}; {hint}" if hint else reason


def _groups(
    robot: Robot, poses: Sequence[PoseTarget], held: Sequence[AttachedObject], base: Array, fixed: NDArray[np.intp]
) -> list[list[PoseTarget]]:
    """Return poses in groups of which no two share a joint that moves.

    Raises:
        ParameterError: No joint that moves a frame may move.
    """
    groups = list[tuple[set[int], list[PoseTarget]]]()
    for pose in poses:
        free = {*_Part(robot, [pose], held, base, fixed).inverse.free.tolist()}
        if not free:
            raise ParameterError("group", pose.frame, "joints that move the frame")
        shared = [one for one in groups if one[0] & free]
        groups = [one for one in groups if not one[0] & free]
        joints, together = free.union(*(one[0] for one in shared)), [p for one in shared for p in one[1]]
        groups.append((joints, [*together, pose]))
    return [group for _, group in groups]


class _Part:
    """Poses whose frames share joints."""

    def __init__(
        self,
        robot: Robot,
        poses: Sequence[PoseTarget],
        held: Sequence[AttachedObject],
        base: Array,
        fixed: NDArray[np.intp],
    ) -> None:
        self.robot, self.base, self.fixed = robot, base, fixed
        self.goals = pose_goals(robot, poses, held, base)
        self.goal = self.goals[0]
        hands = [robot.joint_names.index(h.synergy) for h in robot.hands.values() if h.synergy is not None]
        self.stays = np.array(sorted({*fixed.tolist(), *hands}), np.intp)
        self.inverses = [Links.of(robot).inverse(goal.targets(), self.stays) for goal in self.goals]
        self.inverse = self.inverses[0]

    def search(self, rng: np.random.Generator, descents: int) -> SelfMotions:
        """Return states that reach the poses; of a region, in equal shares for the poses drawn in it."""
        each, most, found = -(-descents // len(self.goals)), MOST_STATES // len(self.goals), list[SelfMotions]()
        for goal, inverse in zip(self.goals, self.inverses, strict=True):
            one = search(inverse, self.robot, self.base, rng, descents=each, most=most)
            if not goal.residual_decides:
                inside = np.array([within(goal.errors(q), goal.bounds) for q in one.states], bool)
                one = replace(one, states=one.states[inside], curves=one.curves[inside])
            found.append(one)
        return SelfMotions.together(found)

    @property
    def names(self) -> str:
        """Names of the frames."""
        return " and ".join(pose.frame for pose in self.goal.poses)

    def out_of_reach(self) -> str:
        """Return why a pose is farther away than the arm is long, or nothing where that is not shown."""
        return self.goal.out_of_reach(self.base)

    def limits_in_the_way(self, missed: Array) -> dict[str, float]:
        """Return the joints that have to leave their limits, and for which share of the descents without limits.

        Args:
            missed: Ends of descents within the limits, which did not reach the poses, shape (N, dof).
        """
        free, missed = self.inverse.free, missed[:BLAMED]
        lower, upper = self.robot.limits.lower.copy(), self.robot.limits.upper.copy()
        lower[free], upper[free] = -2.0 * np.pi, 2.0 * np.pi
        wide = with_range(self.robot, lower, upper)
        ends = (
            Links(wide)
            .inverse(self.goal.targets(), self.stays)
            .descend(missed, tolerance=EXACT, max_steps=DESCENT_STEPS)
        )
        causes = Counter[str]()
        narrow = self.robot.limits
        for q in ends.states[ends.errors <= REACHED]:
            turned = narrow.lower + np.mod(q - narrow.lower, 2.0 * np.pi)
            for k in free[turned[free] > narrow.upper[free]]:
                causes[f"limit of {self.robot.joint_names[k]}"] += 1
        return {cause: n / len(missed) for cause, n in causes.most_common()}


def _combined(found: Sequence[SelfMotions], parts: Sequence[_Part], base: Array) -> tuple[Array, NDArray[np.intp]]:
    """Return combinations of the states of parts, shape (N, dof), and numbers of their branches, shape (N,)."""
    states, branches = found[0].states, found[0].curves
    for part, motions in zip(parts[1:], found[1:], strict=True):
        share = min(1.0, np.sqrt(MOST_STATES / (len(states) * len(motions.states))))
        rows = [distinct(np.linspace(0, n - 1, max(int(share * n), 1)).astype(int)) for n in
                (len(states), len(motions.states))]  # fmt: skip
        first, second = (grid.ravel() for grid in np.meshgrid(*rows, indexing="ij"))
        states = states[first].copy()
        states[:, part.inverse.free] = motions.states[second][:, part.inverse.free]
        branches = branches[first] * (int(motions.curves.max()) + 1) + motions.curves[second]
    return states, branches
