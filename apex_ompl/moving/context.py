"""What the closed loop keeps ready for replans: the robot among static obstacles, the motion that it follows, stops."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from apex_ompl.collision import CollisionChecker
from apex_ompl.collision.path_proof import Curve
from apex_ompl.kernel import Kernel
from apex_ompl.kernel.library import compile_for_runs
from apex_ompl.moving.compute_costs import ComputeBudget
from apex_ompl.moving.dynamic_obstacles import DynamicObstacles, curve_of, prove_motion
from apex_ompl.moving.settings import LoopSettings
from apex_ompl.moving.stopping import stop, stop_along, stops_proved
from apex_ompl.ompl.setup import PlanningSetup
from apex_ompl.robot.model import Limits
from apex_ompl.timing import MotionLimits, Timing, Trajectory
from apex_ompl.timing.checks import SAME_STATE
from apex_ompl.timing.timed_spline import Start
from apex_ompl.timing.trajectory import joined
from apex_ompl.types import Array

SAME_TIME = 1e-9  # [s]
GRAZING = 1e-4  # distance from still things and own parts, such as held objects, below which a motion is not taken [m]
TORQUE_SAMPLES = 3  # samples of a motion for each of its knots, as the check of its torques costs
LIKE_ENDS = 0.5  # share of the clearance at its start or end that a motion keeps, where that is below the margin


@dataclass(frozen=True, eq=False)
class Following:
    """A motion that a robot follows from a time on; the robot is at rest after its end.

    Attributes:
        motion: The motion, which ends at rest.
        start_time: Clock time at which it starts [s].
        to_goal: Whether it ends at a goal.
    """

    motion: Trajectory
    start_time: float
    to_goal: bool = False

    @classmethod
    def resting(cls, q: Array, time: float, joint_names: tuple[str, ...], *, to_goal: bool = False) -> Following:
        """Return rest at a state, shape (dof,), from a time on [s]."""
        still = np.zeros((1, len(q)))
        return cls(Trajectory(np.zeros(1), q[None].copy(), still, still, joint_names), time, to_goal)

    @cached_property
    def end(self) -> float:
        """Clock time from which on the robot is at rest [s]."""
        return self.start_time + self.motion.duration

    def after(self, head: Trajectory, start_time: float) -> Following:
        """Return the motion after another one, which starts at a clock time [s] and ends where this one starts."""
        return Following(joined([head, self.motion]), start_time, self.to_goal)

    def at(self, time: float) -> Start:
        """Return position, velocity and acceleration at a clock time [s]."""
        at = min(max(time - self.start_time, 0.0), self.motion.duration)
        if at >= self.motion.duration - SAME_TIME:
            return Start.at_rest(self.motion.positions[-1].copy())
        return Start(*self.motion.states(np.array([at]))[:, 0])

    def state(self, time: float) -> Array:
        """Return the robot's state at a clock time, shape (dof,)."""
        return self.at(time).position

    def at_rest(self, time: float) -> bool:
        """Whether the robot is at rest from a clock time on [s]."""
        return time >= self.end - SAME_TIME

    def piece(self, start: float, end: float) -> Trajectory:
        """Return the motion of the robot between two clock times [s]."""
        if self.at_rest(start) or end <= self.start_time + SAME_TIME:
            times = np.array([0.0, end - start] if end > start else [0.0])
            q = np.repeat(self.motion.positions[[-1 if self.at_rest(start) else 0]], len(times), axis=0)
            return Trajectory(times, q, np.zeros_like(q), np.zeros_like(q), self.motion.joint_names)
        if start < self.start_time - SAME_TIME:
            return joined([self.piece(start, self.start_time), self.piece(self.start_time, end)])
        last = min(end, self.end) - self.start_time
        first, times = start - self.start_time, self.motion.times
        inner = times[(times > first + SAME_TIME) & (times < last - SAME_TIME)]
        at = np.concatenate([[max(first, 0.0)], inner, [last]])
        q, v, a = self.motion.states(at)
        moving = Trajectory(at - at[0], q, v, a, self.motion.joint_names)
        if end - self.end <= SAME_TIME:
            return moving
        return joined([moving, self.piece(self.end, end)])


def executed(followed: list[tuple[float, Following]], end: float) -> Trajectory:
    """Return the executed motion up to a time [s].

    Args:
        followed: The motions that the robot followed, and from which clock times on [s].
        end: Clock time at which it ends [s].
    """
    ends = [start for start, _ in followed[1:]] + [end]
    pieces = [
        one.piece(start, until) for (start, one), until in zip(followed, ends, strict=True) if until > start + SAME_TIME
    ]
    return joined(pieces) if pieces else followed[-1][1].motion


@dataclass(eq=False)
class RunContext:
    """The robot among static obstacles, and the settings of the run.

    Attributes:
        setup: The problem without the dynamic obstacles.
        limits: Limits of motions; at most those of stops.
        stopping: Limits of stops.
        settings: Parameters of the loop.
    """

    setup: PlanningSetup
    limits: Limits
    stopping: Limits
    settings: LoopSettings

    def __post_init__(self) -> None:
        """Compile the functions of runs, where that was not done yet."""
        compile_for_runs()

    @property
    def checker(self) -> CollisionChecker:
        """The collision checker."""
        return self.setup.checker

    @property
    def kernel(self) -> Kernel:
        """The kernel."""
        return self.setup.checker.kernel

    @cached_property
    def torques(self) -> MotionLimits | None:
        """Limits of torques with what the robot holds, or None where there are none.

        Raises:
            RobotError: Torques are limited, and no link has a mass.
        """
        problem = self.setup.problem
        return Timing().motion_limits(self.setup.robot, problem.attached, problem.payload)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the joints."""
        return self.setup.robot.joint_names

    @property
    def goals(self) -> Array:
        """Valid goal states, shape (goals, dof)."""
        return self.setup.valid_goals

    @property
    def fingers(self) -> list[int]:
        """Indices of the planned joints that close hands, which do not move where nothing is grasped."""
        synergies = (hand.synergy for hand in self.setup.robot.hands.values())
        return [self.names.index(name) for name in synergies if name in self.names]

    def is_goal(self, q: Array) -> bool:
        """Whether a state, shape (dof,), is a goal within the referee's tolerance."""
        return bool(len(self.goals)) and bool((np.abs(self.goals - q).max(axis=1) <= SAME_STATE).any())

    def clear_of_static(self, motion: Trajectory, budget: ComputeBudget | None = None) -> bool:
        """Whether a motion keeps the limits, those of torques too, and is clear by :meth:`is_clear`."""
        clear = self.keeps_limits(motion) and self.is_clear(curve_of(motion), budget)
        return clear and self.keeps_torques(motion, budget)

    def is_clear(self, curve: Curve, budget: ComputeBudget | None = None) -> bool:
        """Whether a curve is proved clear of static obstacles and of self-collision.

        Its clearance is ``GRAZING`` or more, as far as states show it, and ``settings.still_margin`` or more, or not
        much less than where it starts or ends. One that starts with less than ``GRAZING`` has any: pieces of a motion
        are proved again at joining.
        """
        proof, margin = self.checker.prove(curve, tolerance=0.0), self.settings.still_margin
        if budget is not None:
            budget.spend("proof interval", proof.intervals)
            budget.spend("exact proof", int(proof.by_spheres < 1.0))
        if not proof:
            return False
        if proof.clearance < GRAZING and self._clearance(curve.states[0]) >= GRAZING:
            return False
        return margin is None or self._keeps_away(curve, margin)

    def line_is_clear(self, first: Array, last: Array, budget: ComputeBudget | None = None) -> bool:
        """Whether the straight motion between two states, shape (dof,), is clear by :meth:`is_clear`."""
        return self.is_clear(Curve.polyline(np.stack([first, last])), budget)

    def _keeps_away(self, curve: Curve, margin: float) -> bool:
        """Whether a curve keeps a distance [m] from static obstacles and own parts, or half of that at its ends."""
        least = self.checker.prove(curve, tolerance=0.5 * margin).clearance_bound
        if least >= margin:
            return True
        ends = [self._clearance(q, 0.1 * margin) for q in (curve.states[0], curve.states[-1])]
        return least >= LIKE_ENDS * min(margin, *ends)

    def _clearance(self, q: Array, tolerance: float = 0.0) -> float:
        """Return the clearance at a state, shape (dof,), 0 where it is not free [m]."""
        states, still = np.stack([q, q]), np.zeros((2, len(q)))
        proof = self.checker.prove(Curve.cubic(np.array([0.0, 1.0]), states, still, still), tolerance=tolerance)
        return proof.clearance if proof else 0.0

    def keeps_limits(self, motion: Trajectory) -> bool:
        """Whether a motion keeps the limits."""
        return max(motion.use(self.limits).values()) <= 1.0 + 1e-9

    def keeps_torques(self, motion: Trajectory, budget: ComputeBudget | None = None) -> bool:
        """Whether a motion keeps the limits of torques, where there are any.

        A motor that is asked for more falls behind, and the robot leaves the motion that is proved.
        """
        if self.torques is None:
            return True
        if budget is not None:
            budget.spend("sample of a motion", TORQUE_SAMPLES * len(motion.times))
        return not self.torques.fault(motion)

    def first_conflict(
        self,
        dynamic: DynamicObstacles,
        following: Following,
        start: float,
        until: float,
        budget: ComputeBudget | None = None,
    ) -> float:
        """Return the clock time at which a motion can no longer be proved clear of dynamic obstacles [s], or infinity.

        Args:
            dynamic: The obstacles.
            following: The motion.
            start: Clock time at which the check starts [s].
            until: Clock time at which it ends [s], which may be after the end of the motion.
            budget: Counts the intervals.
        """
        zero = following.start_time
        found = prove_motion(self.kernel, dynamic, following.motion, start - zero, until - zero, clock=zero)
        if budget is not None:
            budget.spend("interval among dynamic obstacles", found.intervals)
        return found.time + zero

    def proved_to_rest(
        self, reachable: DynamicObstacles, following: Following, budget: ComputeBudget | None = None
    ) -> bool:
        """Whether a motion is proved clear of reachable sets until the robot is at rest again.

        Args:
            reachable: The reachable sets of the obstacles.
            following: The motion.
            budget: Counts the intervals.
        """
        return bool(np.isinf(self.first_conflict(reachable, following, following.start_time, following.end, budget)))

    def proved_stop(
        self, reachable: DynamicObstacles, following: Following, now: float, then: float
    ) -> Following | None:
        """Return a proved stop from a motion at a later time, or None.

        The motion until that time and the stop are proved clear of the reachable sets.

        Args:
            reachable: The reachable sets of the obstacles.
            following: The motion.
            now: Clock time [s].
            then: Clock time at which the stop starts [s].
        """
        if following.at_rest(then):
            stopped = Following.resting(following.motion.positions[-1], then, self.names, to_goal=following.to_goal)
            clear = following.at_rest(now) or np.isinf(self.first_conflict(reachable, following, now, following.end))
            return stopped if clear else None
        if np.isfinite(self.first_conflict(reachable, following, now, then)):
            return None
        for along in (True, False):
            found = self.clear_stop(following, then, along)
            if found is not None and np.isinf(self.first_conflict(reachable, found, then, found.end)):
                return found
        return None

    def foreseen_stops(
        self, predicted: DynamicObstacles, following: Following, moments: Array, age: float, spread: float
    ) -> tuple[int, int]:
        """Return how many of some clock times, from the first on, have a stop that is predicted to be proved.

        The prediction takes the observations that will be known then (:func:`stops_proved`).

        Args:
            predicted: The predicted obstacles.
            following: The motion.
            moments: Clock times, shape (N,) [s].
            age: Age of the observations then [s].
            spread: Difference of places from predicted ones, beyond the assumed error [m].

        Returns:
            Their number; and the number of joint-by-joint stops among the checked ones.
        """
        settings = self.settings
        error, fastest = settings.assumed
        count, by_joints = stops_proved(
            self.kernel, predicted, following.motion, self.stopping, moments - following.start_time,
            clock=following.start_time, age=age, growth=(error + spread, fastest), period=settings.period,
        )  # fmt: skip
        left = np.flatnonzero(by_joints[:count])
        for done, k in enumerate(left):
            if self.clear_stop(following, float(moments[k]) + settings.period, along=False) is None:
                return int(k), done + 1
        return count, len(left)

    def unproved_stop(self, following: Following, then: float) -> Following:
        """Return a stop along the path of a motion from a clock time on [s], unproved."""
        made = stop_along(following.motion, then - following.start_time, self.stopping)
        return Following(made.trajectory, then, self.is_goal(made.trajectory.positions[-1]))

    def clear_stop(self, following: Following, then: float, along: bool) -> Following | None:
        """Return a stop along the path of a motion, or joint by joint, that is clear of static obstacles, or None."""
        at = then - following.start_time
        if along:
            made = stop_along(following.motion, at, self.stopping)
            ends_there = abs(made.trajectory.duration - (following.motion.duration - at)) < 1e-9
            if ends_there:  # the rest of the motion itself, which is proved
                return Following(made.trajectory, then, following.to_goal)
        else:
            start = following.at(then)
            made = stop(self.stopping, self.names, *start)
            if not made.within_limits:
                return None
        curve = Curve.cubic(
            made.trajectory.times, made.trajectory.positions, made.trajectory.velocities, made.trajectory.accelerations
        )
        if not self.is_clear(curve):
            return None
        return Following(made.trajectory, then, self.is_goal(made.trajectory.positions[-1]))
