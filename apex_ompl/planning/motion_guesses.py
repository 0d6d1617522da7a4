"""Motions that plans among dynamic obstacles are optimized from."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from apex_ompl.paths.optimizer import Optimizer
from apex_ompl.planning.run import PlanRun
from apex_ompl.robot.model import Limits
from apex_ompl.timing import Trajectory
from apex_ompl.types import Array

GOALS = 2  # nearest goals of which there are several
BUMPS, BUMP_SIZE = 4, 0.6  # paths with random bumps, and their amplitude [rad]


class Guess(NamedTuple):
    """A motion to start from.

    Attributes:
        states: States evenly spaced in time, shape (N, dof).
        duration: Its duration [s].
    """

    states: Array
    duration: float


def guesses(run: PlanRun, limits: Limits, motion: Trajectory, turn: int) -> Iterator[Guess]:
    """Yield motions to start from: the path's own, straight lines, and lines with bumps.

    Args:
        run: The call of ``plan``, among what stands still.
        limits: Those of the motion.
        motion: The path's own.
        turn: Number of times that guesses were asked for before; bumps become larger.
    """
    optimizer, held = Optimizer(), run.setup.held
    if turn == 0:
        yield Guess(motion(np.linspace(0.0, motion.duration, 256)), motion.duration)
    goals, rng = run.setup.valid_goals, np.random.default_rng([run.seed, turn])
    for goal in goals[np.argsort(np.linalg.norm(goals - run.setup.start, axis=1))][:GOALS]:
        for control in optimizer.starts(run.setup.start, goal, BUMPS, rng, BUMP_SIZE * (1 + turn % 3)):
            control[:, held] = run.setup.start[held]
            states = optimizer.spline.path(control)
            yield Guess(states, _least_duration(states, limits))
            if turn > 0:  # aside, back, and then along the line
                bump = states - optimizer.spline.path(optimizer.spline.line(states[0], goal))
                line = np.linspace(states[0], goal, len(states))
                yield Guess(np.concatenate([states[0] + bump, line]), _least_duration(line, limits))


def _least_duration(states: Array, limits: Limits) -> float:
    """Return about how long a path takes at an even pace of its parameter [s]."""
    speed = np.abs(np.diff(states, axis=0)) * (len(states) - 1)
    distance = np.abs(states[-1] - states[0]) / limits.acceleration
    return float(max((speed / limits.velocity).max(), 2.0 * np.sqrt(distance.max()), 0.1))
