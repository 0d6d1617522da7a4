"""The executor: what the robot follows, and the proved stop that is always in hand.

At every step the robot goes on only where the next step and a stop behind it are proved clear of all that obstacles of
bounded speed can reach; else it follows the stop that was proved a step before. By induction it is at rest whenever it
is touched, as long as no obstacle is faster than was assumed, and each was seen, within the error assumed, not longer
ago than what was known when the stop was proved. A robot at rest that is about to be touched may step aside along a
motion that is proved like that until it is at rest again, which then is the fail-safe stop itself. Only where the user
chooses so (``evade="risk"``) it leaves without; the steps at which it moves without a fail-safe stop are counted. (A
fail-safe maneuver that is verified online, Althoff and Dolan 2014; Pereira and Althoff 2015.)
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from apex_ompl.loop.replan.evasion import GAIN, SOON, URGENT, endangered
from apex_ompl.loop.replanning import Replanning
from apex_ompl.loop.result import BRAKING, GOING, STANDING, Event
from apex_ompl.loop.tracking import Tracker
from apex_ompl.moving.context import SAME_TIME, Following, RunContext
from apex_ompl.moving.dynamic_obstacles import DynamicObstacles, clearance_in_time
from apex_ompl.moving.replanner import Request, joining_fault
from apex_ompl.moving.search import EARLIER
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.types import Array

BLIND_TIME = 0.15  # for which an obstacle may go anywhere before the robot stands [s]
SHORTEST = 0.1  # rest of a motion for which no faster one is looked for [s]
NEAR = 0.5  # time before a conflict from which on the robot brakes where no answer comes at once [s]
NEARER = 0.01  # by which an obstacle must come nearer than where a motion began, within the trigger, to stop it [m]


@dataclass(eq=False)
class Executor:
    """One run's executor.

    Attributes:
        context: The robot among what stands still.
        replanning: Who plans motions anew.
        tracker: What is known of the obstacles.
        seed: Of random choices.
        following: What the robot follows.
        stop: The fail-safe stop: what is proved from the next step on until the robot is at rest, or from now on where
            it is what the robot follows; None where it is at rest, or leaves without.
        followed: What was followed from which times on.
        events: What happened.
        route: The last motion to a goal, or None.
        pending: What was asked for and is not answered yet, or None.
        asked: Number of replans so far.
        conflict: Time of the first conflict of what is followed [s], or infinity.
        contact: The same without margins for what is uncertain, where the robot will be at rest soon; else infinity.
        unguarded: Number of steps at which the robot moved without a fail-safe stop.
        conflict_since: Since when a conflict is known that the command does not answer yet [s], or None.
        nearest: Distance of an obstacle below which the motion counts as blocked, where that goes by distance [m].
        closed: Whether the time is up: no motion is asked for or taken any more.
        ending: Whether the robot follows the stop that ends the run.
        leaving: Whether the robot leaves a place that an obstacle comes to, and goes on without a proved stop.
        aside: The last step aside that was followed, or None.
        departure: When it does [s].
        lead: How long before a step it is decided, by what was seen until then [s].
        ahead: How long before the conflict that was [s].
        doing: What the robot did then: it was ``going``, ``braking`` already, or ``standing``.
        braking: The stop that was followed last, or None.
        hastened: When a faster motion was asked for last [s].
    """

    context: RunContext
    replanning: Replanning
    tracker: Tracker
    seed: int
    following: Following
    stop: Following | None = None
    closed: bool = False
    ending: bool = False
    followed: list[tuple[float, Following]] = field(default_factory=list)
    events: list[Event] = field(default_factory=list)
    route: Following | None = None
    pending: Request | None = None
    asked: int = 0
    conflict: float = math.inf
    contact: float = math.inf
    unguarded: int = 0
    conflict_since: float | None = None
    nearest: float = 0.0
    leaving: bool = False
    aside: Following | None = None
    departure: float = -math.inf
    lead: float = 0.0
    ahead: float = math.inf
    doing: str = ""
    braking: Following | None = None
    hastened: float = -math.inf

    def log(self, time: float, kind: str, **data: Any) -> None:
        """Note an event."""
        self.events.append(Event(time, kind, data))

    def follow(self, one: Following, time: float) -> None:
        """Follow another motion from a time on."""
        self.following = one
        self.followed.append((time, one))

    def step(self, now: float, predicted: DynamicObstacles, obstacles: Callable[[], tuple[Obstacle, ...]]) -> None:
        """Decide what the robot does until the next step.

        Args:
            now: Time of the clock [s].
            predicted: The obstacles as they are expected to move.
            obstacles: Returns their records where they are now, with velocities; called where a replan is asked for.
        """
        settings = self.context.settings
        reachable = self.tracker.reachable(*settings.assumed, q=self.state(now)) if settings.guarded else None
        if not self.closed:
            self._answer(now, predicted, reachable)
        if settings.monitored:
            self._look(now, predicted)
            if settings.from_rest:
                self._halt(now)
            if self.blind(now):
                self._stop_blind(now)
        if reachable is not None:
            self._brake(now, predicted)
            self._guard(now, reachable, predicted)
        self.unguarded += self.stop is None and self._moves(now)
        if not self.closed:
            self._ask(now, predicted, reachable, obstacles)

    def _moves(self, now: float) -> bool:
        """Whether the robot moves in the step from now on."""
        return self.following.at(now).moves or self.following.at(now + self.context.settings.period).moves

    def close(self, now: float) -> None:
        """Come to rest, since the time is up: follow the stop in hand. To be called before each step from then on.

        Args:
            now: Time of the clock [s].
        """
        self.closed, self.pending = True, None
        stop = None if self.ending or self.following.at_rest(now) else self._stop_at(now)
        if stop is None:  # where there is none in hand yet, there may be one at the next step
            return
        self.ending = True
        if stop is not self.following:
            self._follow_stop(now, stop)

    def _look(self, now: float, predicted: DynamicObstacles) -> None:
        """Find the first conflict of what is followed."""
        if self.context.settings.by_distance:
            found = now if self._distance(now, predicted) < self.nearest else math.inf
        else:
            found = self._first_conflict(self.following, now, predicted)
        if math.isfinite(found) and not math.isfinite(self.conflict):
            self.log(now, "conflict", at=found)
            self.conflict_since, self.ahead, self.doing = now, found - now, self._doing(now)
        if not math.isfinite(found):
            self.conflict_since = None
        self.conflict, self.contact = found, math.inf
        if math.isfinite(found) and self.following.at_rest(now + self.context.settings.budget):
            self.contact = self._first_conflict(self.following, now, predicted.nominal(self.context.settings.margin))

    def _doing(self, now: float) -> str:
        """Return whether the robot is going, braking, or standing."""
        if not self.following.at(now).moves:
            return STANDING
        return BRAKING if self.following is self.braking else GOING

    def _distance(self, now: float, predicted: DynamicObstacles) -> float:
        """Return how far obstacles are from the robot, at most twice the trigger [m]."""
        looked = np.array([now])
        clear, _ = clearance_in_time(
            self.context.kernel, predicted, self.state(now)[None], looked, 2.0 * self.context.settings.trigger
        )
        return float(clear.min())

    def _brake(self, now: float, predicted: DynamicObstacles) -> None:
        """Stop where a conflict is near and no answer came within a step, if it is not touched as soon there.

        A robot that leaves without a fail-safe stop does not wait for an answer.
        """
        waited = self.conflict_since is not None and now > self.conflict_since + SAME_TIME
        if not (waited or self.leaving) or self.conflict >= now + NEAR or self.following.at_rest(now):
            return
        if not self.following.at(now).moves or self.following in (self.stop, self.braking):
            return
        stop = self.context.unproved_stop(self.following, now) if self.stop is None else self.stop
        if self._first_conflict(stop, now, predicted) > self.conflict + GAIN:
            self._follow_stop(now, stop)

    def _first_conflict(self, one: Following, now: float, predicted: DynamicObstacles) -> float:
        """Return the time of the first conflict of a motion, or of standing where it ends [s], or infinity."""
        hold = self.context.settings.hold if one.to_goal else self.context.settings.rest_hold
        return self.context.first_conflict(predicted, one, now, max(one.end, now) + hold)

    def blind(self, now: float) -> bool:
        """Whether there was no look of use for too long."""
        return now - self.tracker.last > self.context.settings.silence

    def _stop_blind(self, now: float) -> None:
        """Stop, since there was no look of use for too long."""
        if self.following.at_rest(now):
            return
        stop = self._stop_at(now)
        if stop is not None and self.following not in (stop, self.braking):
            self.log(now, "blind", last=self.tracker.last)
            self._follow_stop(now, stop)

    def _halt(self, now: float) -> None:
        """Stop where the way to a goal is blocked."""
        if not (math.isfinite(self.conflict) and self.following.to_goal) or self.following.at_rest(now):
            return
        stop = self._stop_at(now)
        if stop is not None and not stop.to_goal:
            self._follow_stop(now, stop)

    def _stop_at(self, now: float) -> Following | None:
        """Return the stop in hand, or one that is not proved where none is wanted; None where there is none."""
        return self.stop if self.context.settings.guarded else self.context.unproved_stop(self.following, now)

    def _follow_stop(self, now: float, stop: Following) -> None:
        self.log(now, "stop", at=stop.end)
        self._answered(now, "stop")
        self.follow(stop, now)
        self.braking = stop

    @property
    def _patience(self) -> float:
        """Time behind which a motion was to begin for which its answer is waited for [s]."""
        settings = self.context.settings
        return settings.stuck if settings.from_rest else settings.period

    def _guard(self, now: float, reachable: DynamicObstacles, predicted: DynamicObstacles) -> None:
        """Go on with a proved stop behind the next step, or stop."""
        if self.following.at_rest(now):
            self.leaving = False
        elif self.stop is self.following:
            return  # all of it is proved
        elif self.following is self.aside and self._proved_to_rest(now, reachable):
            self.stop = self.following
            return
        then = now + self.context.settings.period
        found = self.context.proved_stop(reachable, self.following, now, then)
        if found is not None:
            if self.leaving:  # a stop in place is not what it leaves for, nor one where it would be touched as well
                waits = now <= self.departure or not self.following.at(now).velocity.any()
                self.leaving = waits or self._first_conflict(found, now, predicted) < now + NEAR
            self.stop = found
            return
        if self.leaving or self.following.at_rest(now):
            self.stop = None
        elif not self.following.at(now).moves:  # it did not set out yet
            self.stop = None
            self.follow(Following.standing(self.state(now), now, self.context.names), now)
            self.log(now, "stop", at=now)
        elif self.stop is None:
            self.log(now, "broken assumption", what="no stop is in hand")
        elif self.stop is not self.following:
            self._follow_stop(now, self.stop)

    def _proved_to_rest(self, now: float, reachable: DynamicObstacles) -> bool:
        """Whether all that the robot follows is proved until it is at rest, from when it moves on."""
        start = now if self.following.at(now).moves else max(now, self.departure)
        return math.isinf(self.context.first_conflict(reachable, self.following, start, self.following.end))

    def _answered(self, now: float, how: str) -> None:
        """Note how long after a conflict was known the command changed."""
        if self.conflict_since is not None:
            took = now - self.conflict_since + self.lead
            self.log(now, "reaction", seconds=took, how=how, ahead=self.ahead, doing=self.doing)
            self.conflict_since = None

    def _answer(self, now: float, predicted: DynamicObstacles, reachable: DynamicObstacles | None) -> None:
        """Take the answer of a replan that is known by now, where it is of use."""
        reply, request = self.replanning.reply(now), self.pending
        faults = self.replanning.faults()
        for fault in faults:
            self.log(now, "planner fault", what=fault)
        if request is None:
            return
        if faults and reply is None:  # it was lost
            self.log(now, request.refused, why="the planner was lost", number=request.number, part="")
            self.pending = None
            return
        if reply is None or reply.number != request.number:
            if now > request.join + self._patience + 1e-9:
                self.log(now, request.refused, why="no answer came in time", number=request.number, part="")
                self.pending = None
            return
        self.pending, found, part = None, reply.answer.found, reply.answer.part
        took = {"number": request.number, "part": part, "took": reply.answer.budget.spent}
        if found is None:
            self.log(now, request.refused, why=reply.failed, **took)
            return
        request, found = self._at_once(now, request, found, predicted)
        why, aside, leaving = self._fault(now, request, found, predicted), False, False
        if not why and reachable is not None:
            aside, then = self._may_leave(now, found), found.start_time + self.context.settings.period
            proved = aside and self.context.proved_to_rest(reachable, found)
            risk = self.context.settings.evade == "risk" and self.following.at_rest(found.start_time)
            leaving = risk and aside and not proved  # a stop at once is no way to leave
            if not (proved or leaving) and self.context.proved_stop(reachable, found, found.start_time, then) is None:
                why = "no stop behind its first step is proved"
        if why:
            self.log(now, request.refused, why=why, **took)
            return
        self.log(now, request.taken, **took, arrival=found.end, to_goal=found.to_goal, leaving=leaving)
        self._answered(now, part)
        if found.to_goal:
            self.route = found
        head = self.following.piece(now, request.join) if request.join > now + 1e-9 else None
        self.leaving = leaving or (self.leaving and not self.following.at_rest(now))
        self.follow(found if head is None else found.after(head, now), now)
        self.departure, self.stop = found.start_time, None if self.leaving else self.stop
        self.aside = self.following if aside else None
        if self.context.settings.by_distance:
            self.nearest = min(self.context.settings.trigger, self._distance(now, predicted) - NEARER)

    def _at_once(
        self, now: float, request: Request, found: Following, predicted: DynamicObstacles
    ) -> tuple[Request, Following]:
        """Return a request and its answer, which begins now where a robot that stands can set out at once."""
        if request.following is not self.following or abs(found.start_time - request.join) > SAME_TIME:
            return request, found
        earlier = replace(request, join=now), replace(found, start_time=now)
        if self.following.at_rest(now) and now < request.join and not self._fault(now, *earlier, predicted):
            return earlier
        if self.context.settings.from_rest and self.following.at_rest(request.join):  # or wait
            join = max(request.join, now)
            return replace(request, join=join), replace(found, start_time=join)
        return request, found

    def _fault(self, now: float, request: Request, found: Following, predicted: DynamicObstacles) -> str:
        """Return why an answer is of no use any more, or nothing."""
        settings = self.context.settings
        if request.following is not self.following:
            return "the robot follows another motion by now"
        if self.leaving and found.to_goal and not self.following.at_rest(now):
            return "the robot leaves without a fail-safe stop"
        if now > request.join + 1e-9:
            return "it came too late"
        unfit = joining_fault(self.context, found, request)
        if unfit or not settings.verified:
            return unfit
        if not math.isfinite(self.conflict) and self.following.to_goal and found.to_goal:
            if found.end > self.following.end - EARLIER + SAME_TIME:
                return "it is hardly faster"
        conflict = self._first_conflict(found, found.start_time, predicted)
        gains = self._may_leave(now, found) and conflict > self.conflict + GAIN
        if math.isfinite(conflict) and not gains:
            return "what was seen since then is in the way"
        return ""

    def _may_leave(self, now: float, found: Following) -> bool:
        """Whether the robot may step aside along a motion, since what comes would touch it where it is, or goes."""
        if found.to_goal or self.context.settings.evade == "never":
            return False
        return (self.contact if self.following.at_rest(found.start_time) else self.conflict) < now + SOON

    def _ask(
        self,
        now: float,
        predicted: DynamicObstacles,
        reachable: DynamicObstacles | None,
        obstacles: Callable[[], tuple[Obstacle, ...]],
    ) -> None:
        """Ask for a replan where one is of use."""
        settings = self.context.settings
        self._give_up(now)
        if self.pending is not None or not self._wants(now):
            return
        join = now + settings.budget
        self.asked += 1
        error, fastest = settings.assumed
        clearance_margin = max(settings.clearance_margin, error + BLIND_TIME * fastest)
        request = Request(
            self.asked, now, join, self.following, self.route, predicted, clearance_margin, obstacles(), self.conflict, self.seed,
            contact=self.contact, reachable=reachable,
            leaving=(self.leaving or self.following is self.aside) and not self.following.at_rest(join),
        )  # fmt: skip
        if self.replanning.submit(request):
            self.log(now, "improve" if request.hastens else "request", number=self.asked, join=join)
            self.pending, self.hastened = request, now if request.hastens else self.hastened

    def _give_up(self, now: float) -> None:
        """Give up a request that knows nothing of what is in the way by now.

        It is one for a faster motion, or one of a robot that is about to be touched where it stands, so that it steps
        aside at once.
        """
        settings, request = self.context.settings, self.pending
        if request is None or settings.from_rest or math.isfinite(request.conflict):
            return
        if not (settings.guarded or settings.hastens):  # a reflex, or one plan that is followed blindly
            return
        if settings.evade == "never" and not request.hastens:
            return
        if request.hastens and math.isfinite(self.conflict):
            self.log(now, request.refused, why="something is in the way", number=request.number, part="")
            self.pending = None
        elif endangered(self.following, now + settings.budget, self.contact, URGENT):
            self.log(now, request.refused, why="an obstacle comes", number=request.number, part="")
            self.pending = None

    def _wants(self, now: float) -> bool:
        """Whether the robot needs another motion."""
        settings = self.context.settings
        if self.tracker.awaited or self.blind(now):
            return False
        if not settings.monitored:
            return self.route is None
        if settings.from_rest and not self.following.at_rest(now + settings.budget):
            return False
        if math.isfinite(self.conflict) and not settings.by_distance:
            return True
        if not self.following.to_goal:
            return True
        if not settings.hastens or now + settings.budget + SHORTEST > self.following.end:
            return False
        return now >= self.hastened + settings.budget - SAME_TIME

    def done(self, now: float) -> bool:
        """Whether the robot stands at a goal."""
        return self.following.to_goal and self.following.at_rest(now)

    def state(self, now: float) -> Array:
        """Return the robot's state, shape (dof,)."""
        return self.following.state(now)
