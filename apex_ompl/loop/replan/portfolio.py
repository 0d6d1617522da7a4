"""Replanning while the robot moves: the speed along the path, and splines in space and time from several sources."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from apex_ompl.loop.replan.evasion import URGENT, endangered, step_aside, threatened, wait_nearer
from apex_ompl.moving.compute_costs import ComputeBudget
from apex_ompl.moving.context import RunContext
from apex_ompl.moving.motion_optimizer import MOST_ROUNDS, MotionCandidate, MotionPool
from apex_ompl.moving.replanner import Answer, Request
from apex_ompl.moving.retime import retime
from apex_ompl.moving.search import Search, Source
from apex_ompl.timing import Trajectory
from apex_ompl.timing.ruckig_method import through
from apex_ompl.types import Array

FACTORS = ((1.3, 2.5), (1.0, 1.8))  # durations that are tried, as multiples of the shortest one; by turns
GOALS = 2  # nearest goals that are tried directly
ENOUGH = 10  # candidates at which no further source is asked
ASIDE = 0.7  # share of the budget for the other parts where a step aside may follow
WAITING = 0.85  # and where a motion to a waiting state may follow
CARRIED = 6  # candidates that are carried over to the next replan
SHARE = 0.5  # share of the remaining time for the candidates before the next source is asked
TRIES = ((2, 1.25), (3, 1.25), (2, 1.0), (4, 1.1), (3, 1.0))  # numbers of pieces, and factors on the speed between them
LIMIT_SHARE = 0.98  # largest share of the limits of speeds and accelerations between pieces


@dataclass(eq=False)
class Portfolio:
    """Retiming, and a pool of motions in space and time from several sources; what arrives first is taken.

    Candidates of a failed replan are carried over to the next one of the same run. Where only a faster motion is
    useful, none are, and each replan starts with another source.

    Attributes:
        sources: Sources of initial motions, those that gain most for their time first.
        retimes: Whether the remaining motion is retimed.
        evades: Whether a robot at rest steps aside from an obstacle that comes.
        waits: Whether a robot at rest moves to a waiting state nearer to a goal where no motion to a goal is found.
    """

    sources: Sequence[Source]
    retimes: bool = True
    evades: bool = True
    waits: bool = True
    carried: list[tuple[MotionCandidate, float]] = field(default_factory=list)

    def prepare(self, context: RunContext) -> None:
        """Load what the sources need, and forget earlier runs."""
        self.carried = []
        for source in self.sources:
            source.prepare(context)

    def replan(self, context: RunContext, request: Request, budget: ComputeBudget) -> Answer:
        """Return a motion from the time of joining on that is proved among the predicted obstacles, or none."""
        search = Search(context, request, budget)
        evade, danger = context.settings.evade, (request.following, request.join, request.contact)
        comes = self.evades and evade != "never" and endangered(*danger)
        urgent = comes and endangered(*danger, URGENT)
        if urgent and self._step_aside(search):
            return Answer(search.best, search.part, budget)
        aside, waits = comes and not urgent, not comes and self.waits and not request.hastens
        waits = waits and request.following.at_rest(request.join)
        fallback = step_aside(search, proved=True) if aside and evade == "proved" else None
        flees = self.evades and evade != "never" and threatened(request.following, request.join, request.conflict)
        aside = aside or (flees and request.reachable is not None)
        if (aside and fallback is None) or waits:
            search.until = (WAITING if waits else ASIDE) * budget.limit  # the rest of the time is kept for that
        if self.retimes:
            motion = retimed(search)
            if motion is not None:
                search.take(motion, "retime")
        for goal in search.goals[:GOALS] if self.sources else ():
            motion = straight(search, goal)
            if motion is not None:
                search.take(motion, "direct")
        if self.sources and search.request.hastens:
            take_faster(search, request.following.piece(request.join, request.following.end))
        if self.sources and not search.over():
            self._optimize(search)
        if search.best is None and fallback is not None:
            search.best, search.part = search.following(fallback), "evade"
        if search.best is None and aside:
            self._step_aside(search)
        if search.best is None and waits:
            self._wait_nearer(search)
        return Answer(search.best, search.part, budget)

    @staticmethod
    def _step_aside(search: Search) -> bool:
        """Take a step aside; return whether there is one."""
        aside = step_aside(search)
        if aside is not None:
            search.best, search.part = search.following(aside), "evade"
        return aside is not None

    @staticmethod
    def _wait_nearer(search: Search) -> None:
        """Take a motion to a waiting state, where there is one."""
        nearer = wait_nearer(search)
        if nearer is not None:
            search.best, search.part = search.following(nearer), "wait"

    def _optimize(self, search: Search) -> None:
        """Improve motions in space and time while there is time."""
        pool, goals = search.pool(), search.goals
        if not len(goals):
            return
        hastens = search.request.hastens
        if not hastens:
            carried, self.carried = self.carried, []
            for one, started in carried:
                pool.carry(one, search.request.join - started)
        turn = search.request.number % len(self.sources) if hastens else 0
        sources = iter([*self.sources[turn:], *self.sources[:turn]])
        while not search.over():
            source = next(sources, None)
            if source is None and not pool.candidates:
                break
            if source is not None and len(pool.candidates) < ENOUGH:
                self._ask(source, search, pool)
            left = search.budget.limit - search.budget.spent
            until = search.budget.spent + (SHARE * left if source is not None else left)
            if not self._improve(search, pool, min(until, search.until)) and source is None:
                break
        if hastens:
            return
        open_ones = [one for one in pool.candidates if not one.given_up and one.rounds < MOST_ROUNDS]
        open_ones.sort(key=lambda one: one.priority)
        self.carried = [(one, search.request.join) for one in open_ones[:CARRIED]]

    @staticmethod
    def _ask(source: Source, search: Search, pool: MotionPool) -> None:
        """Add the initial motions of a source to the pool."""
        for initial in source.initial_motions(search):
            for factor in (1.0,) if initial.timed else FACTORS[search.request.number % len(FACTORS)]:
                if search.budget.over():
                    return
                least = factor * initial.duration
                if least >= search.wanted():
                    continue
                timed = initial.states, least
                made = timed if initial.timed else search.shaped(initial.states, initial.goal, least)
                if made is not None and made[1] < search.wanted():
                    pool.add(*made, initial.goal, source.name)

    @staticmethod
    def _improve(search: Search, pool: MotionPool, until: float) -> bool:
        """Improve motions until a time of the budget [s]; return whether there is more to improve."""
        while True:
            found = pool.improve(search.wanted, until)
            if found is None:
                return search.budget.spent >= until
            if search.take(found[1], found[0].origin):
                take_faster(search, found[1])
            if search.over():
                return False


def take_faster(search: Search, motion: Trajectory) -> None:
    """Take a proved faster motion through states of a proved motion, where there is one."""
    for faster in faster_motions(search, motion):
        if search.accepts(faster) and search.take(faster, "quicken"):
            return


def straight(search: Search, goal: Array) -> Trajectory | None:
    """Return a proved direct motion to a goal, the fastest or a retimed one, or None."""
    context, request = search.context, search.request
    fastest = search.direct(goal)
    if fastest is None or fastest.duration <= 0.0 or fastest.duration >= search.wanted():
        return None
    if not context.clear_of_static(fastest, search.budget):
        return None
    if search.accepts(fastest):
        return fastest
    made = retime(
        context.kernel, request.predicted, fastest, context.limits, clock=request.join, hold=context.settings.hold
    )
    search.budget.spend("retiming")
    slow = made.trajectory
    if slow is not None and slow.duration < search.wanted() and search.accepts(slow):
        return slow
    return None


def retimed(search: Search) -> Trajectory | None:
    """Return the remaining motion to a goal, retimed and proved, or None."""
    context, request = search.context, search.request
    following = request.following
    if not following.to_goal or following.at_rest(request.join):
        return None
    made = retime(
        context.kernel, request.predicted, following.motion, context.limits, time=request.join - following.start_time,
        clock=request.join, hold=context.settings.hold,
    )  # fmt: skip
    search.budget.spend("retiming")
    return made.trajectory if made.trajectory is not None and search.accepts(made.trajectory) else None


def faster_motions(search: Search, motion: Trajectory) -> Iterator[Trajectory]:
    """Yield faster motions through states of a motion, which starts at the time of joining and ends at rest.

    Each has a few pieces, the fastest between their states by Ruckig (Berscheid and Kroeger 2021). Splines cannot
    change their acceleration as quickly as the jerk limits allow.

    Args:
        search: The replan.
        motion: The motion.
    """
    limits, names, duration = search.context.limits, search.context.names, motion.duration
    solve = partial(search.budget.spend, "piece of a motion")
    for pieces, factor in TRIES:
        if search.over() or duration <= 0.0:
            return
        states = motion.states(np.linspace(0.0, duration, pieces + 1))
        for order, most in ((1, limits.velocity), (2, limits.acceleration)):
            states[order] = np.clip(factor**order * states[order], -LIMIT_SHARE * most, LIMIT_SHARE * most)
        states[:, 0], states[:, -1] = search.start, (motion.positions[-1], 0.0 * most, 0.0 * most)
        faster = through(states, limits, names, search.wanted(), solve)
        if faster is not None and faster.duration > 0.0:
            search.budget.spend("joined motion")
            yield faster
