"""Motions that a robot follows by a clock, and what it did in the end."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from apex_ompl.moving.timed_spline import Start
from apex_ompl.timing import Trajectory
from apex_ompl.timing.trajectory import concatenate
from apex_ompl.types import Array

SAME_TIME = 1e-9  # [s]


@dataclass(frozen=True, eq=False)
class Following:
    """A motion that a robot follows; behind its end it stands.

    Attributes:
        motion: The motion, which ends at rest.
        begin: Time of the clock at its begin [s].
        to_goal: Whether it ends at a goal.
    """

    motion: Trajectory
    begin: float
    to_goal: bool = False

    @classmethod
    def standing(cls, q: Array, time: float, joint_names: tuple[str, ...], *, to_goal: bool = False) -> Following:
        """Return rest at a state, shape (dof,), from a time on [s]."""
        still = np.zeros((1, len(q)))
        return cls(Trajectory(np.zeros(1), q[None].copy(), still, still, joint_names), time, to_goal)

    @cached_property
    def end(self) -> float:
        """Time of the clock from which on the robot stands [s]."""
        return self.begin + self.motion.duration

    def behind(self, head: Trajectory, begin: float) -> Following:
        """Return the motion behind another one, which begins at a time of the clock [s] and ends where it begins."""
        return Following(concatenate([head, self.motion]), begin, self.to_goal)

    def start(self, time: float) -> Start:
        """Return what the robot does at a time of the clock [s]."""
        at = min(max(time - self.begin, 0.0), self.motion.duration)
        if at >= self.motion.duration - SAME_TIME:
            return Start.at_rest(self.motion.positions[-1].copy())
        return Start(*self.motion.states(np.array([at]))[:, 0])

    def state(self, time: float) -> Array:
        """Return the robot's state at a time of the clock, shape (dof,)."""
        return self.start(time).position

    def at_rest(self, time: float) -> bool:
        """Whether the robot stands from a time of the clock on [s]."""
        return time >= self.end - SAME_TIME

    def piece(self, begin: float, end: float) -> Trajectory:
        """Return what the robot does between two times of the clock [s]."""
        if self.at_rest(begin) or end <= self.begin + SAME_TIME:
            times = np.array([0.0, end - begin] if end > begin else [0.0])
            q = np.repeat(self.motion.positions[[-1 if self.at_rest(begin) else 0]], len(times), axis=0)
            return Trajectory(times, q, np.zeros_like(q), np.zeros_like(q), self.motion.joint_names)
        if begin < self.begin - SAME_TIME:
            return concatenate([self.piece(begin, self.begin), self.piece(self.begin, end)])
        last = min(end, self.end) - self.begin
        first, times = begin - self.begin, self.motion.times
        inner = times[(times > first + SAME_TIME) & (times < last - SAME_TIME)]
        at = np.concatenate([[max(first, 0.0)], inner, [last]])
        q, v, a = self.motion.states(at)
        moving = Trajectory(at - at[0], q, v, a, self.motion.joint_names)
        if end - self.end <= SAME_TIME:
            return moving
        return concatenate([moving, self.piece(self.end, end)])


def executed(followed: list[tuple[float, Following]], end: float) -> Trajectory:
    """Return what a robot did up to a time, of what it followed from which times on."""
    ends = [begin for begin, _ in followed[1:]] + [end]
    pieces = [
        one.piece(begin, until) for (begin, one), until in zip(followed, ends, strict=True) if until > begin + SAME_TIME
    ]
    return concatenate(pieces) if pieces else followed[-1][1].motion
