"""Candidates for a motion in space and time, the most promising one improved first."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from apex_ompl.moving.charges import Charges
from apex_ompl.moving.timed_spline import MotionOptimizer, Start, TimedSpline
from apex_ompl.timing import Trajectory
from apex_ompl.timing.spline_method import least_knot_spacing
from apex_ompl.types import Array

ROUND, ROUNDS = 4, 8  # optimizer steps in a round, and rounds that a candidate has at most
PENALTY = 2.0  # factor on the priority of a candidate for every round spent on it
CLEAR = -0.003  # clearance at the samples from which on a proof is tried; spheres protrude [m]
ENOUGH = 0.03  # at which a round ends early [m]
REFIT = 64  # states of a candidate that begins from elsewhere
SLOWER = 1.02  # least factor on the duration of a candidate over its limits
FASTER = 0.9  # factor on the duration of a motion that is found, from which a faster one is looked for
LONGEST = 60.0  # duration at which a candidate is of no use [s]
LEAST = 1e-6  # clearance cost that counts as none


@dataclass(eq=False)
class MotionCandidate:
    """A motion under repair.

    Attributes:
        spline: The motion.
        goal: Where it ends, shape (dof,).
        origin: Name of what made it.
        cost: Part of its cost that is due to clearance.
        clear: Whether a proof is worth its while: no sample is in contact.
        damping: Of the next step.
        rounds: Number of rounds that it had.
        given_up: Whether it is of no use any more.
    """

    spline: TimedSpline
    goal: Array
    origin: str
    cost: float
    clear: bool
    damping: float | None = None
    rounds: int = 0
    given_up: bool = False

    @property
    def priority(self) -> float:
        """Clearance cost times duration, doubled for every round; the least is improved next."""
        return (self.cost + LEAST) * self.spline.duration * PENALTY**self.rounds


class MotionPool:
    """Candidates for a motion from one start.

    Attributes:
        candidates: All candidates.
    """

    def __init__(
        self, optimizer: MotionOptimizer, start: Start, clock: float, charges: Charges,
        accepts: Callable[[Trajectory], bool], *, berth: float = 0.0,
    ) -> None:  # fmt: skip
        """Start an empty pool.

        Args:
            optimizer: Improves motions among the obstacles.
            start: What the robot does when the motions begin.
            clock: Time of the clock then [s].
            charges: Gets the samples that are looked at.
            accepts: The proof.
            berth: How much nearer than the obstacles of the optimizer motions may come, of which a proof is tried [m].
        """
        self._optimizer, self._start, self._clock, self._charges = optimizer, start, clock, charges
        self._accepts, self._least = accepts, CLEAR - berth
        self.candidates: list[MotionCandidate] = []
        self._own: dict[bytes, float] = {}

    def add(self, states: Array, duration: float, goal: Array, origin: str) -> MotionCandidate:
        """Take a motion in.

        Args:
            states: States evenly spaced in time, shape (N, dof).
            duration: Its duration [s].
            goal: Where it ends, shape (dof,).
            origin: Name of what made it.
        """
        spline = TimedSpline.along(states, duration, self._start, goal)
        one = MotionCandidate(spline, goal, origin, np.inf, False)
        self._improve(one, 0)
        self.candidates.append(one)
        return one

    def carry(self, one: MotionCandidate, shift: float) -> None:
        """Take a candidate of an earlier pool in, whose motion began some time before [s].

        It goes on as it is where the robot stands where it stood, and begins from where the robot is now else.
        """
        old, now = one.spline.start, self._start
        resting = not (old.velocity.any() or now.velocity.any() or now.acceleration.any())
        if resting and np.array_equal(old.position, now.position):
            same = replace(one, damping=None)
            self._improve(same, 0)
            self.candidates.append(same)
            return
        motion = one.spline.trajectory(self._optimizer.kernel.robot.joint_names)
        begin = min(shift, 0.5 * motion.duration)
        rest = motion(np.linspace(begin, motion.duration, REFIT))
        self.add(rest, motion.duration - begin, one.goal, one.origin)

    def improve(self, shorter: Callable[[], float], until: float = np.inf) -> tuple[MotionCandidate, Trajectory] | None:
        """Improve candidates until one is proved, or time is up.

        Args:
            shorter: Returns the duration that motions must be shorter than to be of use [s].
            until: Time by the charges at which to pause [s].
        """
        while not self._charges.over() and self._charges.spent < until:
            open_ones = [
                one
                for one in self.candidates
                if one.rounds < ROUNDS and not one.given_up and one.spline.duration < shorter()
            ]
            if not open_ones:
                return None
            one = min(open_ones, key=lambda one: one.priority)
            if not one.clear or one.rounds:
                self._improve(one, ROUND)
            one.rounds += 1
            least = least_knot_spacing(one.spline.control, self._optimizer.limits)
            if least > one.spline.spacing:
                one.spline = one.spline.lasting(max(least, SLOWER * one.spline.spacing))
                one.given_up = one.spline.duration > LONGEST
                if least_knot_spacing(one.spline.control, self._optimizer.limits) > one.spline.spacing:
                    continue
                self._improve(one, 0)
            if not one.clear or one.spline.duration >= shorter():
                continue
            motion = one.spline.trajectory(self._optimizer.kernel.robot.joint_names)
            if self._accepts(motion):
                one.spline, one.rounds = one.spline.lasting(FASTER * one.spline.spacing), 0  # it is found; now faster
                self._improve(one, 0)
                return one, motion
        return None

    def _own_clearance(self, goal: Array) -> float:
        """Return the least clearance of the robot's own spheres at the start and a goal [m]: held objects may touch."""
        key = goal.tobytes()
        if key not in self._own:
            ends = np.stack([self._start.position, goal])
            self._own[key] = float(self._optimizer.kernel.clearance(ends, 0.1)[:, 1].min())
        return self._own[key]

    def _improve(self, one: MotionCandidate, steps: int) -> None:
        before = self._optimizer.samples
        one.spline, report = self._optimizer.improve(
            one.spline, clock=self._clock, steps=steps, enough=ENOUGH, damping=one.damping
        )
        self._charges.charge("sample of a motion", self._optimizer.samples - before)
        one.cost = report.clearance_cost
        ends = self._own_clearance(one.goal)
        one.clear = report.scene_clearance >= self._least and report.own_clearance >= min(0.0, ends) + CLEAR
        one.damping = report.damping if steps else one.damping
