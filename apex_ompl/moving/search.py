"""The search of one replan: what its parts share, sources of initial motions, and obstacles placed for a source."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from apex_ompl.collision import CollisionChecker
from apex_ompl.moving.compute_costs import ComputeBudget
from apex_ompl.moving.context import Following, RunContext
from apex_ompl.moving.dynamic_obstacles import clearance_in_time
from apex_ompl.moving.motion_optimizer import (
    InitialMotion,
    MotionOptimizer,
    MotionPool,
    MotionSettings,
    shortest_duration,
)
from apex_ompl.moving.replanner import Request
from apex_ompl.scene.bodies import Obstacle, same_solid
from apex_ompl.scene.scripts import standing, vector
from apex_ompl.timing import Trajectory
from apex_ompl.timing.ruckig_method import between
from apex_ompl.timing.timed_spline import Start
from apex_ompl.types import Array

MOTIONS = MotionSettings(samples=2)
STATES = 64  # states of an initial motion
EARLIER = 0.02  # time by which a motion must arrive earlier than one without a conflict to replace it [s]
GUARDED, AGE = 0.04, 0.08  # time between the predicted stops of a motion, and age of the observations then [s]
SOON = 0.8  # time before a conflict below which a motion is taken that the safety filter may stop in the way [s]
TOGETHER = 16  # stops that are predicted in one call
SPREAD = 0.01  # difference of observed places from predicted ones [m]
NARROW = 1.0  # time that a motion without proved stops must gain over one with proved stops [s]
GOOD = 1.2  # duration of a motion with which a replan ends, as a multiple of the direct motion's
ENOUGH_TIME = 0.2  # share of the budget after which it ends with any motion whose stops are proved
BETTER = 0.97  # share of the duration of the best motion below which another one is sought
LOOKS = 16  # states of the straight line at which the nearest obstacle is sought


@dataclass(eq=False)
class Search:
    """One replan: what its parts share.

    Attributes:
        context: The robot among static obstacles, and the settings of the run.
        request: The request.
        budget: Its compute budget.
        start: State of the robot when the motion starts.
        rng: Source of random choices.
        best: The best motion so far, or None.
        part: Name of the part that found it.
        cost: Its duration, and more where the safety filter may stop it [s].
        least: Duration of the direct motion without obstacles [s].
        until: Time of the budget at which to end [s].
    """

    context: RunContext
    request: Request
    budget: ComputeBudget
    start: Start = field(init=False)
    rng: np.random.Generator = field(init=False)
    best: Following | None = None
    part: str = ""
    cost: float = np.inf
    least: float = np.inf
    until: float = np.inf

    def __post_init__(self) -> None:
        """Read the request."""
        self.start, self.rng = self.request.following.at(self.request.join), self.request.rng

    @property
    def goals(self) -> Array:
        """Goal states, shape (goals, dof), the nearest first."""
        goals = self.context.goals
        order: Array = goals[np.argsort(np.linalg.norm(goals - self.start.position, axis=1), kind="stable")]
        return order

    def wanted(self) -> float:
        """Return the duration that a motion must be shorter than to be useful [s]."""
        return min(self.most, BETTER * self.cost)

    @property
    def most(self) -> float:
        """Remaining duration of the motion, less ``EARLIER``, where only a faster one is useful; else infinite [s]."""
        return self.request.following.end - self.request.join - EARLIER if self.request.hastens else np.inf

    def direct(self, goal: Array, least: float = 0.0) -> Trajectory | None:
        """Return the fastest motion to a goal without obstacles, or None within the limits.

        Args:
            goal: Where it ends, shape (dof,).
            least: Least duration [s].
        """
        self.budget.spend("direct motion")
        rest = np.zeros_like(goal)
        q, v, a = self.start
        made = between(np.stack([[q, goal], [v, rest], [a, rest]]), self.context.limits, self.context.names, least)
        if made is not None:
            self.least = min(self.least, made.duration)
        return made

    def shaped(self, states: Array, goal: Array, least: float) -> tuple[Array, float] | None:
        """Return a motion near a path, as fast as the direct one or slower, or None.

        The deviation of the path from the straight line is added to the direct motion, by its progress.

        Args:
            states: States of the path, shape (N, dof).
            goal: Where it ends, shape (dof,).
            least: Least duration [s].

        Returns:
            States evenly spaced in time, shape (STATES, dof), and the duration [s].
        """
        direct = self.direct(goal, least)
        if direct is None or direct.duration <= 0.0:
            return None
        moved = direct(np.linspace(0.0, direct.duration, STATES))
        way = goal - self.start.position
        progress = np.clip((moved - self.start.position) @ way / max(float(way @ way), 1e-12), 0.0, 1.0)
        arc = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(states, axis=0), axis=1)))
        share = arc / max(float(arc[-1]), 1e-12)
        ends = self.start.position + share[:, None] * way
        off = states + (1.0 - share[:, None]) * (self.start.position - states[0]) - ends
        strays = np.stack([np.interp(progress, share, column) for column in off.T], axis=1)
        return moved + strays, direct.duration

    def following(self, motion: Trajectory) -> Following:
        """Return a motion that starts at the time of joining."""
        return Following(motion, self.request.join, self.context.is_goal(motion.positions[-1]))

    def accepts(self, motion: Trajectory) -> bool:
        """Whether a motion is proved clear, with the time for which its end must stay clear."""
        one, settings = self.following(motion), self.context.settings
        until = one.end + (settings.hold if one.to_goal else settings.rest_hold)
        conflict = self.context.first_conflict(self.request.predicted, one, one.start_time, until, self.budget)
        return not np.isfinite(conflict) and self.context.clear_of_static(motion, self.budget)

    def over(self) -> bool:
        """Whether the time is up, or a good motion was found: a faster one is sought while the robot follows it."""
        if self.budget.over() or self.budget.spent >= self.until:
            return True
        if self.cost == np.inf or self.request.hastens or not self.context.settings.hastens:
            return False
        return self.cost <= GOOD * self.least or self.budget.spent > ENOUGH_TIME * self.budget.limit

    def delay(self, motion: Trajectory) -> float:
        """Return the time by which a motion counts as longer since the safety filter may stop it [s].

        It is 0 where stops from all of the motion are predicted to be proved. It is infinite where the robot would stop
        in the way of an obstacle, unless it is about to be touched anyway.
        """
        at = self.unguarded_from(motion)
        if math.isinf(at):
            return 0.0
        stop = self.context.unproved_stop(self.following(motion), max(at - GUARDED, self.request.join))
        until = stop.end + self.context.settings.rest_hold
        conflict = self.context.first_conflict(self.request.predicted, stop, stop.start_time, until, self.budget)
        return NARROW if math.isinf(conflict) or self.request.conflict < self.request.join + SOON else math.inf

    def unguarded_from(self, motion: Trajectory) -> float:
        """Return the clock time from which on stops of a motion cannot be predicted to be proved, or infinity [s]."""
        settings, one, predicted = self.context.settings, self.following(motion), self.request.predicted
        if not settings.guarded:
            return math.inf
        moments = np.arange(one.start_time, one.end, GUARDED)
        for first in range(0, len(moments), TOGETHER):
            if self.budget.over():
                return float(moments[first])
            some = moments[first : first + TOGETHER]
            proved, by_joints = self.context.foreseen_stops(predicted, one, some, AGE, SPREAD)
            self.budget.spend("foreseen stop", min(proved + 1, len(some)))
            self.budget.spend("stop joint by joint", by_joints)
            if proved < len(some):
                return float(some[proved])
        return math.inf

    @property
    def soonest(self) -> float:
        """Earliest clock time at which a motion starts: a robot at rest does not wait [s]."""
        request = self.request
        soon = request.asked + self.budget.spent + self.context.settings.period
        return min(soon, request.join) if request.following.at_rest(request.asked) else request.join

    def may_begin(self, motion: Trajectory) -> bool:
        """Whether there is a fail-safe stop after the first step of a motion, by the observations so far."""
        reachable, one = self.request.reachable, Following(motion, self.soonest)
        if reachable is None:
            return True
        self.budget.spend("foreseen stop")
        then = one.start_time + self.context.settings.period
        return self.context.proved_stop(reachable, one, one.start_time, then) is not None

    def take(self, motion: Trajectory, part: str) -> bool:
        """Keep a proved motion where its cost is less than that of the best one; return whether it is kept."""
        if motion.duration >= min(self.most, self.cost) or not self.may_begin(motion):
            return False
        delay = self.delay(motion)
        cost = motion.duration + delay
        if cost >= self.cost or ((self.request.hastens or self.request.leaving) and delay > 0.0):
            return False
        self.best, self.part, self.cost = self.following(motion), part, cost
        return True

    def pool(self, clearance_margin: bool = True) -> MotionPool:
        """Return an empty pool of motions, which are optimized with a clearance margin around obstacles or without.

        The margin of a request is larger among fast obstacles. A proof is tried of motions that keep what exceeds the
        settings' margin, since the safety filter stops a robot that comes nearer. (Trying all motions changes times by
        0.0 % in 40 validation worlds.)
        """
        request, context = self.request, self.context
        dynamic = request.predicted.larger(request.clearance_margin) if clearance_margin else request.predicted
        optimizer = MotionOptimizer(context.kernel, dynamic, context.limits, MOTIONS)
        beyond = context.settings.clearance_margin if clearance_margin else 0.0
        return MotionPool(optimizer, self.start, request.join, self.budget, self.accepts, clearance_margin=beyond)


class Source(Protocol):
    """A source of initial motions."""

    @property
    def name(self) -> str:
        """Its name."""

    def prepare(self, context: RunContext) -> None:
        """Load what it needs, before a run; nothing by default."""
        return

    def initial_motions(self, search: Search) -> Iterator[InitialMotion]:
        """Yield initial motions, and spend what they cost."""


def fresh_checker(context: RunContext) -> CollisionChecker:
    """Return a checker of static obstacles."""
    setup = context.setup
    return CollisionChecker(setup.robot, setup.problem.scene, setup.problem.attached, setup.problem.allowed)


def place(checker: CollisionChecker, obstacle: Obstacle, position: ArrayLike) -> None:
    """Place an obstacle at a position, shape (3,) [m], as a static one; its shape may be another than before."""
    if checker.is_obstacle(obstacle.name):
        if same_solid(checker.obstacle(obstacle.name), obstacle):
            checker.move(obstacle.name, vector(position))
            return
        checker.remove(obstacle.name)
    checker.add(standing(obstacle).model_copy(update={"position": vector(position)}))


def place_nearest(checker: CollisionChecker, search: Search, goal: Array) -> None:
    """Place each obstacle where it is at the time at which one comes nearest to the straight motion to a goal."""
    request = search.request
    line = np.linspace(search.start.position, goal, LOOKS)
    duration = shortest_duration(line, search.context.limits)
    times = request.join + np.linspace(0.0, duration, LOOKS)
    clear, _ = clearance_in_time(search.context.kernel, request.predicted, line, times)
    nearest = float(times[int(np.argmin(clear))])
    search.budget.spend("clearance in time", LOOKS)
    for o in request.obstacles:
        way = np.multiply(o.velocity or (0.0, 0.0, 0.0), nearest - request.asked)
        place(checker, o, np.add(o.position, way))


def rest_of_route(search: Search) -> Array | None:
    """Return states of the remaining part of the last motion to a goal, shape (N, dof), or None."""
    route = search.request.route
    if route is None:
        return None
    states = route.motion(np.linspace(0.0, route.motion.duration, 256))
    nearest = int(np.argmin(np.linalg.norm(states - search.start.position, axis=1)))
    rest = states[nearest:]
    if len(rest) < 2:
        return None
    wanted = np.linspace(0.0, len(rest) - 1.0, STATES)
    return np.stack([np.interp(wanted, np.arange(len(rest)), column) for column in rest.T], axis=1)
