"""The motion of a plan: duration or calm as the objective, proved along its own curve.

The motion starts from the path that was found. Where it ends at one of several goals, straight motions to others that
could be reached sooner are tried, too.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from apex_ompl.collision.path_proof import PathProof
from apex_ompl.ompl.setup import PlanningSetup
from apex_ompl.ompl.validity import FullCheck, MotionValidator, StateValidityChecker, full_check
from apex_ompl.paths.path import Path
from apex_ompl.robot.model import Limits
from apex_ompl.robot.rest_to_rest import direct_durations
from apex_ompl.timing import TimedPath, Timing, Trajectory
from apex_ompl.timing.duration import DurationOptimizer
from apex_ompl.timing.timed_spline import TimedSpline
from apex_ompl.types import Array

if TYPE_CHECKING:
    from apex_ompl.planning.steps import PlanQuery

OPTIMIZED = "optimized"  # form of a motion that is not along a path
REPAIRS = 3  # of a motion that is not proved
GOALS = 4  # other goals to which a straight motion is tried
SOONER = 0.95  # share of the duration that the lower bound of another goal must not reach
STATES_PER_KNOT = 2, 4, 8  # of the path along a motion; the first that passes the full check
SHARE = 0.5  # of the time left


Check = Callable[[Trajectory], FullCheck]
"""Full check of a motion, its limits among it."""


@dataclass(frozen=True, eq=False)
class ProvedMotion:
    """A motion, the path along it, and the certificates of both."""

    timed: TimedPath
    path: Path
    motion_proof: PathProof
    path_proof: PathProof


def knows_obstacles(setup: PlanningSetup) -> bool:
    """Whether this project's checkers alone decide what is valid."""
    si = setup.simple_setup.getSpaceInformation()
    checker, validator = si.getStateValidityChecker(), si.getMotionValidator()
    return type(checker) is StateValidityChecker and type(validator) is MotionValidator


def optimized_motion(query: PlanQuery, path: Path, timing: Timing, check: Check) -> ProvedMotion | None:
    """Return a motion by the query's objective, or None where none is proved in time.

    Args:
        query: The query.
        path: A valid path.
        timing: The limits.
        check: Full check of a motion.
    """
    setup = query.setup
    limits = timing.limits(setup.robot.limits, setup.robot.joint_names)
    held = np.zeros(setup.robot.dof, bool)
    held[setup.held] = True
    optimizer = DurationOptimizer(setup.checker.kernel, limits, held)
    reserve = query.deadline.remaining * (1.0 - SHARE)

    def stop() -> bool:
        return query.ends() or query.deadline.remaining < reserve

    found = _proved(optimizer, optimizer.fastest(path.states, stop), check, stop)
    for goal, least in _other_goals(setup, path, limits):
        most = np.inf if found is None else SOONER * found[0].duration
        if stop() or least >= most:
            break
        straight = optimizer.fastest(np.stack([setup.start, goal]), stop, most)
        other = _proved(optimizer, straight, check, stop, repairs=1)
        if other is not None and (found is None or other[0].duration < found[0].duration):
            found = other
    if found is not None:
        factor = query.calm_factor if query.objective == "calm" else 1.0
        duration = max(factor * found[0].duration, timing.minimum_duration)
        if duration > found[0].duration:
            calm = query.objective == "calm" and not stop()
            spline = found[0].lasting(duration / found[0].spans)
            same = _proved(optimizer, spline, check, stop, repairs=0)
            made = _proved(optimizer, optimizer.calmest(spline, duration), check, stop, repairs=0) if calm else None
            found = made or same
    return None if found is None else _with_path(setup, timing, *found)


Proved = tuple[TimedSpline, Trajectory, PathProof]


def _proved(
    optimizer: DurationOptimizer, spline: TimedSpline | None, check: Check, stop: Callable[[], bool],
    repairs: int = REPAIRS,
) -> Proved | None:  # fmt: skip
    """Return a motion that passed the full check, or None."""
    names = optimizer.kernel.robot.joint_names
    for turn in range(1, repairs + 2):
        if spline is None or stop():
            return None
        motion = spline.trajectory(names)
        checked = check(motion)
        if checked and checked.proof is not None:
            return spline, motion, checked.proof
        if turn <= repairs:
            spline = optimizer.cleared(spline, turn)
    return None


def _other_goals(setup: PlanningSetup, path: Path, limits: Limits) -> list[tuple[Array, float]]:
    """Return the nearest goals at which the path does not end, with the least durations to them [s]."""
    goals = setup.valid_goals
    goals = goals[(goals != path.states[-1]).any(axis=1)]
    durations = direct_durations(setup.start, goals, limits)
    return [(goals[k], float(durations[k])) for k in np.argsort(durations, kind="stable")[:GOALS]]


def _with_path(
    setup: PlanningSetup, timing: Timing, spline: TimedSpline, motion: Trajectory, proof: PathProof
) -> ProvedMotion | None:
    """Return a motion with the path through its own states, or None where none passes the full check."""
    del spline
    for count in STATES_PER_KNOT:
        times = np.linspace(0.0, motion.duration, count * (len(motion.times) - 1) + 1)
        states = motion(times)
        states = states.clip(motion.positions.min(axis=0), motion.positions.max(axis=0))  # joints that stay do
        states[0], states[-1] = motion.positions[0], motion.positions[-1]
        checked = full_check(setup.checker, states, setup.start, setup.goals)
        if checked and checked.proof is not None:
            timed = TimedPath(motion, 0.0, timing.method, OPTIMIZED)
            return ProvedMotion(timed, Path(states), proof, checked.proof)
    return None
