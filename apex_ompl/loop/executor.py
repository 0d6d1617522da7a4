"""The executor: what the robot follows, and the safety filter that keeps a fail-safe stop at every step.

At every step the robot continues only where the next step and a stop after it are proved clear of the reachable sets of
all obstacles; else it follows the stop that was proved one step before. By induction it is at rest whenever it is
touched, as long as no obstacle is faster than assumed, and each was seen, within the assumed error, before the stop was
proved. A robot at rest that is about to be touched may step aside along a motion that is proved in the same way until
it is at rest again; that motion then is the fail-safe stop itself. Only where the user chooses so (``evade="risk"``) it
leaves without a fail-safe stop; those steps are counted. (Fail-safe maneuvers verified online: Althoff and Dolan 2014;
Pereira and Althoff 2015.)
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

BLIND_TIME = 0.15  # time that an obstacle may move unseen before the robot is at rest [s]
SHORTEST = 0.1  # remaining time of a motion below which no faster one is sought [s]
NEAR = 0.5  # time before a conflict below which the robot brakes where no answer comes at once [s]
NEARER = 0.01  # by which an obstacle within the trigger must come nearer than at the start of a motion to stop it [m]


@dataclass(eq=False)
class Executor:
    """One run's executor.

    Attributes:
        context: The robot among static obstacles, and the settings of the run.
        replanning: Answers requests for replans.
        tracker: Estimates of the obstacles.
        seed: Seed of random choices.
        following: The motion that the robot follows.
        stop: The fail-safe stop: proved from the next step on until the robot is at rest, or from now on where the
            robot follows it; None for a robot at rest, or one that leaves without.
        followed: The motions that were followed, and from which times on.
        events: What happened.
        route: The last motion to a goal, or None.
        pending: The request that is not answered yet, or None.
        asked: Number of replans so far.
        conflict: Time of the first predicted conflict of the motion [s], or infinity.
        contact: The same without margins for uncertainty, where the robot will be at rest soon; else infinity.
        unguarded: Number of steps at which the robot moved without a fail-safe stop.
        conflict_since: Time of the first prediction of a conflict until the command changes [s], or None.
        nearest: Distance of an obstacle below which the motion counts as blocked, where distance decides [m].
        closed: Whether the time is up: no motion is requested or taken any more.
        ending: Whether the robot follows the stop that ends the run.
        leaving: Whether the robot leaves a place that an obstacle comes to, without a fail-safe stop.
        aside: The last step aside that was followed, or None.
        departure: When the last answer starts [s].
        lead: How long before a step it is decided, by the observations until then [s].
        ahead: Time from the first prediction of the conflict to the conflict [s].
        doing: What the robot did at that prediction: ``going``, ``braking`` or ``standing``.
        braking: The stop that was followed last, or None.
        hastened: When a faster motion was requested last [s].
        unmeasured: Whether no state of the robot was measured yet, so that it does not start.
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
    unmeasured: bool = False

    def log(self, time: float, kind: str, **data: Any) -> None:
        """Record an event."""
        self.events.append(Event(time, kind, data))

    def follow(self, one: Following, time: float) -> None:
        """Follow another motion from a time on."""
        self.following = one
        self.followed.append((time, one))

    def step(self, now: float, predicted: DynamicObstacles, obstacles: Callable[[], tuple[Obstacle, ...]]) -> None:
        """Decide what the robot does until the next step.

        Args:
            now: Clock time [s].
            predicted: The predicted obstacles.
            obstacles: Returns their records at their places now, with velocities; called where a replan is requested.
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
        """Come to rest since the time is up, by the fail-safe stop; to be called before each further step.

        Args:
            now: Clock time [s].
        """
        self.closed, self.pending = True, None
        stop = None if self.ending or self.following.at_rest(now) else self._stop_at(now)
        if stop is None:  # there may be one at the next step
            return
        self.ending = True
        if stop is not self.following:
            self._follow_stop(now, stop)

    def _look(self, now: float, predicted: DynamicObstacles) -> None:
        """Find the first predicted conflict of the motion."""
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
        """Return what the robot does: ``going``, ``braking`` or ``standing``."""
        if not self.following.at(now).moves:
            return STANDING
        return BRAKING if self.following is self.braking else GOING

    def _distance(self, now: float, predicted: DynamicObstacles) -> float:
        """Return the distance of obstacles from the robot, at most twice the trigger [m]."""
        clear, _ = clearance_in_time(
            self.context.kernel, predicted, self.state(now)[None], np.array([now]), 2.0 * self.context.settings.trigger
        )
        return float(clear.min())

    def _brake(self, now: float, predicted: DynamicObstacles) -> None:
        """Stop where a conflict is near and no answer came within a step, unless the robot would be touched as soon.

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
        """Return the time of the first predicted conflict of a motion, or of rest at its end [s], or infinity."""
        hold = self.context.settings.hold if one.to_goal else self.context.settings.rest_hold
        return self.context.first_conflict(predicted, one, now, max(one.end, now) + hold)

    def blind(self, now: float) -> bool:
        """Whether there was no usable observation for too long."""
        return now - self.tracker.last > self.context.settings.silence

    def _stop_blind(self, now: float) -> None:
        """Stop since there was no usable observation for too long."""
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
        """Return the fail-safe stop, or an unproved one where the settings ask for none; None where there is none."""
        return self.stop if self.context.settings.guarded else self.context.unproved_stop(self.following, now)

    def _follow_stop(self, now: float, stop: Following) -> None:
        self.log(now, "stop", at=stop.end)
        self._answered(now, "stop")
        self.follow(stop, now)
        self.braking = stop

    @property
    def _patience(self) -> float:
        """Time for which an answer is awaited after its motion was to start [s]."""
        settings = self.context.settings
        return settings.stuck if settings.from_rest else settings.period

    def _guard(self, now: float, reachable: DynamicObstacles, predicted: DynamicObstacles) -> None:
        """Continue with a proved stop after the next step, or stop."""
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
            if self.leaving:  # a stop in place is no way out, nor is one where it would be touched as well
                waits = now <= self.departure or not self.following.at(now).velocity.any()
                self.leaving = waits or self._first_conflict(found, now, predicted) < now + NEAR
            self.stop = found
            return
        if self.leaving or self.following.at_rest(now):
            self.stop = None
        elif not self.following.at(now).moves:  # it has not started yet
            self.stop = None
            self.follow(Following.resting(self.state(now), now, self.context.names), now)
            self.log(now, "stop", at=now)
        elif self.stop is None:
            self.log(now, "broken assumption", what="there is no fail-safe stop")
        elif self.stop is not self.following:
            self._follow_stop(now, self.stop)

    def _proved_to_rest(self, now: float, reachable: DynamicObstacles) -> bool:
        """Whether the whole motion is proved until the robot is at rest, from the time at which it moves."""
        start = now if self.following.at(now).moves else max(now, self.departure)
        return math.isinf(self.context.first_conflict(reachable, self.following, start, self.following.end))

    def _answered(self, now: float, how: str) -> None:
        """Record how long after the first prediction of a conflict the command changed."""
        if self.conflict_since is not None:
            took = now - self.conflict_since + self.lead
            self.log(now, "reaction", seconds=took, how=how, ahead=self.ahead, doing=self.doing)
            self.conflict_since = None

    def _answer(self, now: float, predicted: DynamicObstacles, reachable: DynamicObstacles | None) -> None:
        """Take the answer of a replan that is available now, where it is useful."""
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
            leaving = risk and aside and not proved  # a stop at once is no way out
            if not (proved or leaving) and self.context.proved_stop(reachable, found, found.start_time, then) is None:
                why = "no stop after its first step is proved"
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
        """Return a request and its answer; the answer starts now where the robot is at rest and can start at once."""
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
        """Return why an answer is not useful any more, or nothing."""
        settings = self.context.settings
        if request.following is not self.following:
            return "the robot follows another motion now"
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
            return "an obstacle seen since the request is in the way"
        return ""

    def _may_leave(self, now: float, found: Following) -> bool:
        """Whether the robot may step aside along a motion, since an obstacle would soon touch it otherwise."""
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
        """Request a replan where one is useful."""
        settings = self.context.settings
        self._cancel(now)
        if self.pending is not None or not self._wants(now):
            return
        join = now + settings.budget
        self.asked += 1
        error, fastest = settings.assumed
        clearance_margin = max(settings.clearance_margin, error + BLIND_TIME * fastest)
        request = Request(
            self.asked, now, join, self.following, self.route, predicted, clearance_margin, obstacles(), self.conflict,
            self.seed, contact=self.contact, reachable=reachable,
            leaving=(self.leaving or self.following is self.aside) and not self.following.at_rest(join),
        )  # fmt: skip
        if self.replanning.submit(request):
            self.log(now, "improve" if request.hastens else "request", number=self.asked, join=join)
            self.pending, self.hastened = request, now if request.hastens else self.hastened

    def _cancel(self, now: float) -> None:
        """Cancel a request that was made before a conflict was predicted.

        It is one for a faster motion, or one of a robot that is about to be touched at rest, so that it steps aside at
        once.
        """
        settings, request = self.context.settings, self.pending
        if request is None or settings.from_rest or math.isfinite(request.conflict):
            return
        if not (settings.guarded or settings.hastens):  # a reflex, or one plan that is followed to the end
            return
        if settings.evade == "never" and not request.hastens:
            return
        if request.hastens and math.isfinite(self.conflict):
            self.log(now, request.refused, why="an obstacle is in the way", number=request.number, part="")
            self.pending = None
        elif endangered(self.following, now + settings.budget, self.contact, URGENT):
            self.log(now, request.refused, why="an obstacle comes", number=request.number, part="")
            self.pending = None

    def _wants(self, now: float) -> bool:
        """Whether the robot needs another motion."""
        settings = self.context.settings
        if self.tracker.awaited or self.blind(now) or self.unmeasured:
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
        """Whether the robot is at rest at a goal."""
        return self.following.to_goal and self.following.at_rest(now)

    def state(self, now: float) -> Array:
        """Return the robot's state, shape (dof,)."""
        return self.following.state(now)

    def state_then(self, time: float) -> Array:
        """Return the robot's state at a time that may be over, shape (dof,)."""
        known = (one for start, one in reversed(self.followed) if start <= time + SAME_TIME)
        return next(known, self.followed[0][1]).state(time)
