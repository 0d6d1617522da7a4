"""The referee: contacts of the executed motion, its use of the limits, and whether it ends at a goal.

The motion is checked by exact shapes at samples ``SPACING`` apart, with each obstacle at its true place. Intervals of
time that the sphere covers prove clear of all dynamic obstacles need no samples. Static obstacles and self-collision
are checked continuously, along the motion's own cubic pieces.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from apex_ompl.collision import CollisionChecker
from apex_ompl.collision.path_proof import Curve
from apex_ompl.collision.scene_bodies import SceneBodies
from apex_ompl.errors import ParameterError
from apex_ompl.goals.alignment import within
from apex_ompl.loop.result import Outcome
from apex_ompl.moving.dynamic_obstacles import Piece, ScriptedDynamicObstacles, clearance_in_time, prove_motion
from apex_ompl.ompl.setup import workspace_goal
from apex_ompl.robot import Robot
from apex_ompl.robot.model import Limits
from apex_ompl.scene.bodies import Obstacle, pose_matrix
from apex_ompl.scene.problem import Problem
from apex_ompl.scene.scripts import place_at
from apex_ompl.timing import Trajectory
from apex_ompl.timing.checks import SAME_STATE
from apex_ompl.timing.rests import AT_REST, is_at_rest
from apex_ompl.types import Array
from apex_ompl.util.validation import check_number, check_states

SPACING = 1e-3  # of the samples [s]
STRETCH = 0.01  # time that is sampled before a proof is tried again [s]
LIMIT_TOLERANCE = 1e-5  # tolerated share over a limit: rounding of the jerk between knots that are 1 ns apart
MEASURED_REST = 1e-3  # largest measured velocity of a joint at rest [rad/s]
NEAR_GOAL = 0.02  # largest distance of a measured joint from the goal [rad; synergies 0..1]
NEAR = 1e-3  # largest clearance of spheres that is computed [m]


@dataclass(frozen=True)
class RunContact:
    """Two bodies that overlap.

    Attributes:
        time: Time of the first sample at which they overlap [s].
        first: Name of the link or the held object.
        second: Name of the obstacle, or of the other link or held object.
        depth: Penetration depth [m]; 0 where they are only too near to be proved apart.
        moved: Whether the robot moved at that time.
    """

    time: float
    first: str
    second: str
    depth: float
    moved: bool

    def __str__(self) -> str:
        """Return ``at 1.234 s: left_link5 <-> cube, 4 mm deep, while the robot moved``."""
        how = "while the robot moved" if self.moved else "while the robot stood"
        return f"at {self.time:.3f} s: {self.first} <-> {self.second}, {1e3 * self.depth:.3g} mm deep, {how}"


@dataclass(frozen=True)
class RefereeReport:
    """The referee's report on a run.

    Attributes:
        contact: First contact with a dynamic obstacle, or None.
        moving_contact: First contact with one while the robot moved, which may be the same, or None.
        still_contact: First contact with static obstacles or of the robot with itself, or None.
        limit_use: Largest share of each limit that the motion uses, by ``position``, ``velocity``, ``acceleration`` and
            ``jerk``.
        clearance: Lower bound of the least distance to dynamic obstacles, over all samples, by the sphere cover [m]:
            negative where only the spheres overlap, and infinite where there is no such obstacle.
        clearance_time: Time of that distance [s], NaN without an obstacle.
        at_rest: Whether the motion ends at rest.
        at_goal: Whether it ends at a goal.
    """

    contact: RunContact | None
    moving_contact: RunContact | None
    still_contact: RunContact | None
    limit_use: Mapping[str, float]
    clearance: float
    clearance_time: float
    at_rest: bool
    at_goal: bool

    @property
    def exceeded(self) -> dict[str, float]:
        """Shares of the exceeded limits, by name."""
        return {name: share for name, share in self.limit_use.items() if share > 1.0 + LIMIT_TOLERANCE}

    @property
    def outcome(self) -> Outcome | None:
        """The outcome by contacts, else LIMITS or REACHED; None where only the goal was not reached.

        It is HIT_MOVING where the robot moved in any contact with an obstacle, not only in the first one.
        """
        hits = [hit for hit in (self.contact, self.still_contact) if hit is not None]
        first = min(hits, key=lambda hit: hit.time, default=None)
        if first is not None:
            if first is self.still_contact:
                return Outcome.HIT_STILL
            return Outcome.HIT_AT_REST if self.moving_contact is None else Outcome.HIT_MOVING
        if self.exceeded:
            return Outcome.LIMITS
        return Outcome.REACHED if self.at_rest and self.at_goal else None

    @property
    def faults(self) -> tuple[str, ...]:
        """All faults of the run, a sentence each, contacts by time."""
        hits = {hit for hit in (self.contact, self.moving_contact, self.still_contact) if hit is not None}
        over = ", ".join(f"{name} {share:.4g}" for name, share in self.exceeded.items())
        return (
            *(str(hit) for hit in sorted(hits, key=lambda hit: hit.time)),
            *([f"shares of limits above 1: {over}"] if over else []),
            *([] if self.at_rest else ["the motion does not end at rest"]),
            *([] if self.at_goal else ["the motion does not end at a goal"]),
        )


def judge(
    robot: Robot, problem: Problem, trajectory: Trajectory, *, end: float | None = None,
    goals: ArrayLike | None = None, limits: Limits | None = None, dynamic: Iterable[str] = (),
    commanded: Trajectory | None = None,
) -> RefereeReport:  # fmt: skip
    """Judge the executed motion of a run by the true motions of the obstacles.

    Args:
        robot: The robot.
        problem: The problem, with the scripts of the moving obstacles.
        trajectory: The executed motion from time 0 on; after its end the robot is at rest.
        end: When the run ended [s], by default with the motion.
        goals: States of which the motion is to end in one, shape (N, dof); by default the goal of the problem.
        limits: Limits that are to be kept, by default the robot's.
        dynamic: Names of obstacles that count as moving, though they were at rest all the time.
        commanded: What was commanded, where ``trajectory`` was measured. Then limits and the rest at the goal are those
            of the command, near whose end the measured motion ends, and a robot is at rest below ``MEASURED_REST``.

    Raises:
        ParameterError: The motion is one of other joints, ``end`` is before its end, or the goals have another shape.
        ApexError: The problem does not fit the robot, or a body of it cannot be loaded.
    """
    if trajectory.joint_names != robot.joint_names:
        raise ParameterError("trajectory", ", ".join(trajectory.joint_names), f"the joints of {robot.name}")
    until = trajectory.duration if end is None else end
    check_number(until, "end", trajectory.duration)
    names = {*problem.moving, *dynamic}
    still = [o for o in problem.scene if o.name not in names]
    checker = CollisionChecker(
        robot, still, problem.attached, [pair for pair in problem.allowed if not {*pair} & names]
    )  # fmt: skip
    moving = [o for o in problem.scene if o.name in names]
    scripted = ScriptedDynamicObstacles(checker.kernel, moving, problem.allowed)
    times = np.append(SPACING * np.arange(np.ceil(until / SPACING - 1e-9)), until)
    clearances = scripted.clearances(trajectory, times)
    least = int(np.nanargmin(clearances)) if not np.isnan(clearances).all() else 0
    wanted, rest = (trajectory, AT_REST) if commanded is None else (commanded, MEASURED_REST)
    speeds, rates = np.abs(wanted.velocities[-1]), np.abs(wanted.accelerations[-1])
    off = float(np.abs(trajectory.positions[-1] - wanted.positions[-1]).max())
    exact = ExactDynamicObstacles(robot, problem, scripted, rest)
    contact, moving_contact = exact.first_contacts(trajectory, times)
    return RefereeReport(
        contact=contact,
        moving_contact=moving_contact,
        still_contact=still_contact(checker, trajectory, times, rest),
        limit_use=wanted.use(limits or robot.limits),
        clearance=float(clearances[least]),
        clearance_time=float(times[least]) if np.isfinite(clearances[least]) else np.nan,
        at_rest=bool((speeds <= AT_REST).all() and (rates <= AT_REST).all()),
        at_goal=off <= NEAR_GOAL and is_at_goal(robot, problem, wanted.positions[-1], goals),
    )


class ExactDynamicObstacles:
    """Exact shapes of a robot, its held objects and dynamic obstacles."""

    def __init__(
        self, robot: Robot, problem: Problem, scripted: ScriptedDynamicObstacles, rest: float = AT_REST
    ) -> None:  # fmt: skip
        """Take the robot, the problem with its held objects and allowed pairs, the obstacles, and a speed of rest.

        Args:
            robot: The robot.
            problem: The problem.
            scripted: The obstacles.
            rest: Largest velocity of a joint at rest [rad/s].
        """
        self._robot, self._scripted, self._rest = robot, scripted, rest
        self._obstacles: dict[str, Obstacle] = {o.name: o for o in scripted.obstacles}
        bodies = SceneBodies(robot)
        bodies.fill(scripted.obstacles, problem.attached, fixtures=False)
        self._meshes = bodies.meshes
        known = {solid.name for solid in self._meshes.solids.values()}
        for pair in problem.allowed:
            if known.issuperset(pair):
                bodies.allow(*pair)
        numbers = self._meshes.scene
        self._pairs = {name: [p for p in self._meshes.pairs if p[1] == n] for name, n in numbers.items()}

    def first_contacts(self, motion: Trajectory, times: Array) -> tuple[RunContact | None, RunContact | None]:
        """Return the first contact, and the first while the robot moves, or None.

        Args:
            motion: The motion.
            times: Times of the samples, shape (N,), increasing from 0 [s].
        """
        first = None
        for time, there in self._near(motion, times):
            if first is not None and is_at_rest(motion, time, self._rest):
                continue
            found = self.contact_at(motion, time, there)
            first = found if first is None else first
            if found is not None and found.moved:
                return first, found
        return first, None

    def _near(self, motion: Trajectory, times: Array) -> Iterator[tuple[float, tuple[str, ...]]]:
        """Yield the times at which the sphere covers do not prove the robot clear, with the names of the obstacles."""
        kernel = self._scripted.kernel
        for piece in self._scripted.pieces(float(times[-1])):
            if piece.start == piece.end:  # a single moment
                yield from self._among(motion, times, piece)
                return
            time, last = piece.start, -np.inf
            while len(piece.dynamic):
                conflict = prove_motion(kernel, piece.dynamic, motion, time, piece.end)
                if not conflict:
                    break
                time = min(conflict.time + STRETCH, piece.end)
                start = max(conflict.time - SPACING, piece.start)
                yield from self._among(motion, times[(times >= start) & (times > last) & (times <= time)], piece)
                last = time
                if time >= piece.end:
                    break

    def contact_at(self, motion: Trajectory, time: float, there: tuple[str, ...]) -> RunContact | None:
        """Return the deepest contact with one of the obstacles that exist at a time [s], or None."""
        order = self._robot.to_pinocchio(motion(time))
        if not np.isfinite(order).all():  # a hand outside its limits, which is a fault by itself
            return None
        for name in there:
            obstacle = self._obstacles[name]
            self._meshes.move(name, pose_matrix(place_at(obstacle, time), obstacle.orientation))
        if not self._meshes.any_collides(order, [pair for name in there for pair in self._pairs[name]]):
            return None
        deepest = next((c for c in self._meshes.contacts(order) if c.second in there), None)
        if deepest is None:
            return None
        moved = not is_at_rest(motion, time, self._rest)
        return RunContact(time, deepest.first, deepest.second, deepest.depth, moved)

    def _among(self, motion: Trajectory, times: Array, piece: Piece) -> Iterator[tuple[float, tuple[str, ...]]]:
        """Yield the times of a piece at which the sphere covers do not prove the robot clear."""
        if len(piece.dynamic) and len(times):
            spheres = clearance_in_time(self._scripted.kernel, piece.dynamic, motion(times), times, NEAR)[0]
            there = piece.dynamic.names
            yield from ((time, there) for time in times[~(spheres > 0.0)].tolist())


def still_contact(
    checker: CollisionChecker, motion: Trajectory, times: Array, rest: float = AT_REST
) -> RunContact | None:
    """Return the first contact of a motion with the scene of a checker or of the robot with itself, or None.

    The motion is checked continuously along its cubic pieces; the first sample in contact is sought where that fails.

    Args:
        checker: The robot among static obstacles.
        motion: The motion.
        times: Times of the samples, shape (N,), increasing [s].
        rest: Largest velocity of a joint at rest [rad/s].
    """
    curve = Curve.cubic(motion.times, motion.positions, motion.velocities, motion.accelerations)
    proof = checker.prove(curve, tolerance=0.0)
    if proof:
        return None
    where = proof.parameter if motion.duration else 0.0
    before = times[times < where].tolist()
    time = next((t for t in before if not checker.is_free(motion(t))), where)
    q = motion(time)
    contacts = checker.contacts(q) if np.isfinite(checker.robot.to_pinocchio(q)).all() else []
    names, depth = ((contacts[0].first, contacts[0].second), contacts[0].depth) if contacts else (proof.pair, 0.0)
    return RunContact(time, *names, depth, not is_at_rest(motion, time, rest))


def is_at_goal(robot: Robot, problem: Problem, q: Array, goals: ArrayLike | None = None) -> bool:
    """Whether a state is a goal.

    Args:
        robot: The robot.
        problem: The problem, whose goal is a region or some states.
        q: The state, shape (dof,).
        goals: Goal states in place of the problem's, shape (N, dof).

    Raises:
        ParameterError: The goals have another shape.
        ApexError: The problem does not fit the robot.
    """
    region = workspace_goal(robot, problem) if goals is None else None
    if region is not None:
        return within(region.errors(q), region.bounds)
    if goals is None:
        goals = robot.within_limits(problem.goal_states(robot.joint_names))
    states = np.atleast_2d(np.asarray(goals, float))
    check_states(states, robot.dof, "goals")
    return bool((np.abs(robot.turned_to(states, q) - q).max(axis=1, initial=0.0) <= SAME_STATE).any())
