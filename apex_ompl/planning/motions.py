"""The motion of a plan: duration or calm as the objective, proved along its own curve.

The motion starts from the path that was found. Where it ends at one of several goals, straight motions to others that
could be reached sooner are tried, too, and other paths where it takes a detour in time. An anytime plan goes on with
other paths and goals (:mod:`apex_ompl.planning.anytime`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from apex_ompl.collision import CollisionChecker
from apex_ompl.collision.path_proof import PathProof
from apex_ompl.errors import TimingError
from apex_ompl.kernel.search import RESOLUTION, TreePair, shortcut
from apex_ompl.ompl.setup import PlanningSetup
from apex_ompl.ompl.validity import FullCheck, MotionValidator, StateValidityChecker, full_check
from apex_ompl.paths.path import SEARCH_RESOLUTION, Path
from apex_ompl.planning.anytime import TREE_RANGE, OtherPaths, tree_path
from apex_ompl.planning.step_records import PlanQuery
from apex_ompl.robot.model import Limits
from apex_ompl.robot.rest_to_rest import direct_durations
from apex_ompl.timing import MotionLimits, TimedPath, Timing, Trajectory
from apex_ompl.timing import warm_up as warm_up_timing
from apex_ompl.timing.duration import DurationOptimizer
from apex_ompl.timing.parameterization import fitted
from apex_ompl.timing.ruckig_method import calm as calm_motion
from apex_ompl.timing.spline_method import whole_nanoseconds
from apex_ompl.timing.timed_spline import TimedSpline
from apex_ompl.types import Array

OPTIMIZED = "optimized"  # form of a motion that is not along a path
REPAIRS = 3  # of a motion that is not proved
GOALS = 4  # other goals to which a straight motion is tried
SOONER = 0.95  # share of the duration that the lower bound of another goal must not reach
STATES_PER_KNOT = 2, 4, 8  # of the path along a motion; the first that passes the full check
DETOUR, WAYS = 1.15, 2  # ratio of a duration to the direct one, beyond which so many other paths are tried
AS_SOON = 0.99  # share of the duration that these must not reach
SLIGHTLY = 0.998  # the same of an anytime plan
ROUNDED = 1e-6  # to whole nanoseconds of each span [s]
LAST = 0.05  # time of such a plan in which no further path is tried [s]
SHARE = 0.5  # of the time left
FITTED = 0.02  # largest deviation of a motion that is timed anew for limits of torques and tool speeds [rad]


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


_warm: set[str] = set()  # robots of which the code is loaded


def warm_up(checker: CollisionChecker) -> None:
    """Load or compile the code that motions need, so that no plan waits for it."""
    robot = checker.robot
    if robot.name in _warm:
        return
    ends = np.stack([robot.home, robot.home + np.where(np.arange(robot.dof) == 0, 0.1, 0.0)])
    warm_up_timing()
    kernel, rng = CollisionChecker(robot).kernel, np.random.default_rng(0)
    spline = DurationOptimizer(kernel, robot.limits).fastest(ends)
    if spline is not None:
        calm_motion(spline.trajectory(robot.joint_names), robot.limits)
    TreePair(kernel, ends[:1], ends[1:], TREE_RANGE, SEARCH_RESOLUTION, rng).grow(1)
    shortcut(kernel, np.stack([ends[0]] * 3), 1, RESOLUTION, rng)
    _warm.add(robot.name)


def optimized_motion(
    query: PlanQuery, path: Path, timing: Timing, check: Check, more: MotionLimits | None = None
) -> ProvedMotion | None:
    """Return a motion by the query's objective, or None where none is proved in time.

    Where the query improves its motion, this takes all of its time but for a little; half of it until one is proved.

    Args:
        query: The query.
        path: A valid path.
        timing: The limits.
        check: Full check of a motion.
        more: Limits of torques and tool speeds.
    """
    setup = query.setup
    limits = timing.limits(setup.robot.limits, setup.robot.joint_names)
    held = np.zeros(setup.robot.dof, bool)
    held[setup.held] = True
    rows = None if setup.constraints is None else setup.constraints.rows
    optimizer = DurationOptimizer(setup.checker.kernel, limits, held, rows)
    reserve = query.deadline.remaining * (1.0 - SHARE)

    def stop() -> bool:
        return query.ends() or query.deadline.remaining < reserve

    search = _Search(query, timing, limits, more, optimizer, check, stop)
    found = search.proved(optimizer.fastest(path.states, stop))
    if found is None:
        found = search.proved(optimizer.fastest(path.states, stop, narrow=True))
    for goal, least in _other_goals(setup, path, limits):
        if found is not None and least >= SOONER * found.spline.duration:
            break
        found = search.sooner(np.stack([setup.start, goal]), _share(SOONER, found)) or found
    for other in _other_ways(setup, path, found, limits, stop):
        found = search.sooner(other, _share(AS_SOON, found)) or found
    made = None if found is None else search.finished(found)
    if query.improves_motion and made is not None:
        search = search._replace(stop=lambda: query.ends() or query.deadline.remaining < LAST)
    return _improved(search, made) if query.improves_motion else made


def _improved(search: _Search, made: ProvedMotion | None) -> ProvedMotion | None:
    """Return the fastest of a motion and of those from other paths, each of which is to undercut it."""
    others = OtherPaths(search.query, search.limits, search.stop)

    def keep(motion: ProvedMotion) -> ProvedMotion:
        others.best = motion.timed.trajectory
        others.most = SLIGHTLY * others.best.duration / search.factor
        return motion

    made = None if made is None else keep(made)
    for path in others.paths():
        if others.best is not None and others.best.duration <= search.timing.minimum_duration + ROUNDED:
            break
        found = search.sooner(path, others.most)
        better = None if found is None else search.finished(found)
        if better is not None and better.timed.trajectory.duration < search.factor * others.most:
            made = keep(better)
    return made


class _Proved(NamedTuple):
    """A motion that passed the full check."""

    spline: TimedSpline
    timed: TimedPath
    proof: PathProof


def _share(share: float, found: _Proved | None) -> float:
    """Return a share of the duration of a motion; infinite without one [s]."""
    return np.inf if found is None else share * found.spline.duration


class _Search(NamedTuple):
    """Proves motions, and repairs those that are not."""

    query: PlanQuery
    timing: Timing
    limits: Limits
    more: MotionLimits | None
    optimizer: DurationOptimizer
    check: Check
    stop: Callable[[], bool]

    @property
    def factor(self) -> float:
        """Duration of the motion that is asked for, as a multiple of the fastest one's."""
        return self.query.calm_factor if self.query.objective == "calm" else 1.0

    def proved(self, spline: TimedSpline | None, repairs: int = REPAIRS) -> _Proved | None:
        """Return a motion that passed the full check, or None."""
        for turn in range(1, repairs + 2):
            timed = None if spline is None or self.stop() else self._timed(spline)
            if spline is None or timed is None:
                return None
            checked = self.check(timed.trajectory)
            if checked and checked.proof is not None:
                return _Proved(spline, timed, checked.proof)
            if turn <= repairs:
                spline = self.optimizer.cleared(spline, turn)
        return None

    def sooner(self, states: Array, most: float) -> _Proved | None:
        """Return the motion from another path, shape (N, dof), where it undercuts a duration [s]."""
        spline = None if self.stop() else self.optimizer.fastest(states, self.stop, most)
        found = None if spline is None or spline.duration >= most else self.proved(spline, repairs=1)
        return None if found is None or found.spline.duration >= most else found

    def finished(self, found: _Proved) -> ProvedMotion | None:
        """Return a motion as it is asked for, within all limits and with the path along it, or None."""
        lasting = self._lasting(found)
        timed = None if lasting is None else self._kept(lasting)
        return None if timed is None else _with_path(self.query.setup, *timed)

    def _lasting(self, found: _Proved) -> _Proved | None:
        """Return a motion of the duration asked for: a calm one if asked and proved, or along the same curve."""
        duration = max(self.factor * found.spline.duration, self.timing.minimum_duration)
        if duration <= found.spline.duration:
            return found
        slower = found.spline.lasting(whole_nanoseconds(duration / found.spline.spans))
        calm = self.query.objective == "calm" and not self.stop()
        made = self.proved(self.optimizer.calmest(slower), repairs=0) if calm else None
        return made or self.proved(slower, repairs=0)

    def _kept(self, found: _Proved) -> tuple[TimedPath, PathProof] | None:
        """Return the motion within limits of torques and tool speeds, and its certificate, or None."""
        motion, more = found.timed.trajectory, self.more
        if more is None or more.stretch(motion) == 1.0:
            return found.timed, found.proof
        try:
            near = replace(self.timing, deviation=min(self.timing.deviation, FITTED))
            faster = fitted(motion, self.limits, more, near, stop=self.stop)
        except TimingError:  # gravity overloads it
            return None
        slower = replace(found.timed, trajectory=motion.slower(more.stretch(motion)).merged())
        for candidate in (faster, slower):
            checked = self.check(candidate.trajectory)
            if checked and checked.proof is not None:
                return replace(candidate, deviation=0.0), checked.proof
        return None

    def _timed(self, spline: TimedSpline) -> TimedPath | None:
        """Return the motion of a spline by the method."""
        motion = spline.trajectory(self.optimizer.kernel.robot.joint_names)
        if self.timing.method != "ruckig":
            return TimedPath(motion, 0.0, self.timing.method, OPTIMIZED)
        made = calm_motion(motion, self.optimizer.limits, self.stop)
        return None if made is None else TimedPath(made.trajectory, 0.0, made.method, OPTIMIZED)


def _other_goals(setup: PlanningSetup, path: Path, limits: Limits) -> list[tuple[Array, float]]:
    """Return the nearest goals at which the path does not end, with the least durations to them [s]."""
    goals = setup.valid_goals
    goals = goals[(goals != path.states[-1]).any(axis=1)]
    durations = direct_durations(setup.start, goals, limits)
    return [(goals[k], float(durations[k])) for k in np.argsort(durations, kind="stable")[:GOALS]]


def _other_ways(
    setup: PlanningSetup, path: Path, found: _Proved | None, limits: Limits, stop: Callable[[], bool]
) -> Iterator[Array]:
    """Yield other paths, by new trees and shortcuts, where the motion takes much longer than a direct one to a goal."""
    goals = np.concatenate([path.states[-1:], setup.valid_goals])
    durations = direct_durations(setup.start, goals, limits)
    most = np.inf if found is None else found.spline.duration / DETOUR
    goals = goals[durations < most][: GOALS + 1]
    if setup.constraints is not None:  # the planner has tried others
        return
    kernel, rng = setup.checker.kernel.within(*setup.bounds), np.random.default_rng([setup.seed, WAYS])
    for one in rng.spawn(WAYS) if len(goals) else ():
        if stop():
            return
        way = tree_path(kernel, setup.start, goals, one, stop)
        if way is not None:
            yield way


def _with_path(setup: PlanningSetup, timed: TimedPath, proof: PathProof) -> ProvedMotion | None:
    """Return a motion with the path through its own states, or None where none passes the full check."""
    motion = timed.trajectory
    for count in STATES_PER_KNOT:
        states = motion(np.linspace(0.0, motion.duration, count * (len(motion.times) - 1) + 1))
        states[:, setup.held] = setup.start[setup.held]
        states[0], states[-1] = motion.positions[0], motion.positions[-1]
        checked = full_check(setup.checker, states, setup.start, setup.goals, constraints=setup.constraints)
        if checked and checked.proof is not None:
            return ProvedMotion(timed, Path(states), proof, checked.proof)
    return None
