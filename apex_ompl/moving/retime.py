"""Retiming: speed along a known path among dynamic obstacles, and the safe intervals of time along it.

The path keeps its shape, and only the speed along it is chosen (path-velocity decomposition, Kant and Zucker 1986;
LaValle 2006, section 7.1.3), among safe intervals of time (Phillips and Likhachev 2011).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from apex_ompl.errors import ParameterError
from apex_ompl.kernel import Kernel
from apex_ompl.kernel.moving import (
    BlockedPlaces,
    LimitArrays,
    SpeedSearch,
    blocked_intervals,
    earliest_arrivals,
    first_blocked,
    follow_profile,
    profile_places,
    push_bounds,
)
from apex_ompl.moving.dynamic_obstacles import DynamicObstacles, curve_of
from apex_ompl.robot.model import Limits
from apex_ompl.timing.trajectory import Trajectory
from apex_ompl.types import Array
from apex_ompl.util.display import fields_line
from apex_ompl.util.validation import check_number

STAGE = 0.04  # least length of a stage, in the motion's own time [s]
STAGES = (4, 64)  # least and largest number of stages
PIECES = 4  # pieces of a stage
SLOW = np.array([0.0, 0.125, 0.25, 0.375, 0.5, 0.625, 0.75, 0.875, 1.0])  # levels of the squared rate
FAST = np.array([1.25, 1.6, 2.0, 2.5, 3.2, 4.0, 5.0, 6.5, 8.0, 10.0])
UNIT = len(SLOW) - 1  # level of the motion's own rate
SPACINGS = (0.012, 0.01, 0.008, 0.006, 0.004)  # of the motion's knots [s]
SAME_PLACE = 1e-9  # [s]
LEAD = 3  # steps for which the result keeps the rate of the given motion
HEADS, EASY = 9, 0.8  # places at which the rate may start to change, and largest share of the acceleration limits there
PUSHING = 0.4  # part of a window in which the acceleration along the path may change at the largest jerk
HURRYING = 0.7  # share of the velocity limits up to which a motion may become faster
SAME_TIME = 1e-9  # [s]
CHECKED = 0.005  # spacing at which the given motion is checked [s]


class Attempt(NamedTuple):
    """Parameters of one search of a speed profile.

    Attributes:
        share: Share of the acceleration limits.
        window: Time over which the places of the profile are averaged, for lower jerks [s].
        margin: Time by which blocked intervals are longer at each end for the search [s].
        forced: Number of stages at the start that keep the motion's own rate; from rest at least two.
        hurries: Whether it may be faster than the motion.
    """

    share: float
    window: float
    margin: float
    forced: int
    hurries: bool


ATTEMPTS = (
    Attempt(0.95, 0.0, 0.015, 0, True), Attempt(0.85, 0.0, 0.02, 1, True), Attempt(0.95, 0.0, 0.02, 1, False),
    Attempt(0.9, 0.04, 0.04, 1, False), Attempt(0.7, 0.08, 0.06, 1, False), Attempt(0.5, 0.12, 0.08, 2, False),
)  # fmt: skip


class Profile(NamedTuple):
    """Speed along the stages of a path.

    Attributes:
        x: Levels of the squared rate ds/dt, shape (levels,).
        levels: Levels at the points between stages, shape (S + 1,).
        departures: Times of arrival there and of departure, shape (S + 1, 2) [s of the dynamic obstacles' stamps].
    """

    x: Array
    levels: NDArray[np.int64]
    departures: Array


class Query(NamedTuple):
    """Arguments of :func:`retime`: times of the motion and of the clock at the start, hold, horizon and deviation."""

    time: float
    clock: float
    hold: float
    horizon: float
    deviation: float


class Retimed(NamedTuple):
    """A motion along a path, retimed.

    Attributes:
        trajectory: The motion, or None.
        reason: Why there is none, one sentence.
        deviation: Largest distance of any joint from the path [rad].
    """

    trajectory: Trajectory | None
    reason: str
    deviation: float

    def __repr__(self) -> str:
        """Return the fields, arrays by their shapes."""
        return fields_line(self)


def retime(
    kernel: Kernel, dynamic: DynamicObstacles, motion: Trajectory, limits: Limits, *, time: float = 0.0,
    clock: float = 0.0,
    hold: float = 1.0, horizon: float = 20.0, deviation: float = 1.5e-3,
) -> Retimed:  # fmt: skip
    """Return the motion along the remaining path that arrives first, among dynamic obstacles.

    It starts with the state of the given motion at ``time`` exactly, ends at rest where that ends, and keeps the
    limits. Its places are kept out of the blocked intervals (:func:`apex_ompl.moving.retime.blocked`), so that
    :func:`apex_ompl.moving.dynamic_obstacles.prove_motion` seldom finds a conflict; only that is the proof.

    Args:
        kernel: The kernel of the robot with its held objects.
        dynamic: The obstacles.
        motion: A motion within the limits that ends at rest.
        limits: Limits of the joints.
        time: Time of the motion at which the result starts [s].
        clock: Time of the dynamic obstacles' stamps at which the result starts [s].
        hold: Time for which the end must stay free from the arrival on [s].
        horizon: Largest duration of the result [s].
        deviation: Largest distance of any joint from the path [rad].

    Raises:
        ParameterError: The motion is one of other joints, or a number is out of its range.
    """
    if motion.dof != kernel.robot.dof:
        raise ParameterError("motion", motion.dof, f"one of {kernel.robot.dof} joints")
    for name, value in (("time", time), ("clock", clock)):
        check_number(value, name)
    for name, value in (("hold", hold), ("horizon", horizon)):
        check_number(value, name, 0.0)
    query = Query(min(max(float(time), 0.0), motion.duration), float(clock), float(hold), float(horizon), deviation)

    def find(places: Array, start: float, end: float) -> Blocked:
        return blocked(kernel, dynamic, motion, places, start=start, end=end, slack=deviation)

    return retime_around(find, motion, limits, query)


def retime_around(
    find: Callable[[Array, float, float], Blocked], motion: Trajectory, limits: Limits, query: Query
) -> Retimed:
    """Return the motion along the remaining path that arrives first where places are blocked at known times.

    Args:
        find: Returns when places along the motion, shape (P, 2) [s], are blocked between two times.
        motion: A motion within the limits that ends at rest.
        limits: Limits of the joints.
        query: See :func:`retime`.
    """
    return _Search(find, motion, limits, query).result()


class _Search:
    """Search of the speed along the remaining part of one motion."""

    def __init__(
        self, find: Callable[[Array, float, float], Blocked], motion: Trajectory, limits: Limits, query: Query
    ) -> None:
        """Find the blocked intervals."""
        self.motion, self.limits = motion, LimitArrays.of(limits)
        self.time, self.clock, self.hold, horizon, self.deviation = query
        self.latest, time = self.clock + horizon, self.time
        left = motion.duration - time
        self.stages = int(np.clip(math.ceil(left / STAGE), *STAGES))
        self.length = left / self.stages
        self.points: Array = np.asarray(time + self.length * np.arange(self.stages + 1), float)
        edges = self.points[:-1, None] + self.length / PIECES * np.arange(PIECES)
        edges = np.append(edges.ravel(), self.points[-1])
        where = np.stack([edges[:-1], edges[1:]], axis=1), np.stack([self.points, self.points], axis=1)
        self.pieces, self.stops = (find(places, self.clock, self.latest + self.hold) for places in where)
        self.states = np.stack([motion.positions, motion.velocities, motion.accelerations])
        self.rates = motion.states(edges)[1:]
        self.rests = not np.any(self.rates[:, 0])

    def result(self) -> Retimed:
        """Return the motion of the first attempt that keeps limits, deviation and safe intervals."""
        stops, last = self.stops, self.stages
        if stops.meets(0, self.clock, self.clock):
            until = float(stops.spans[0, 0, 1]) - self.clock
            return Retimed(None, f"the start is blocked for the next {until:.3g} s", 0.0)
        ends = [self.clock, *stops.spans[last, : stops.counts[last], 1]]
        if not any(t <= self.latest and not stops.meets(last, t + 1e-6, t + self.hold) for t in ends):
            return Retimed(None, f"the end is not free for {self.hold:g} s by {self.latest - self.clock:g} s", 0.0)
        if self.length <= 0.0:
            return Retimed(self.motion.after(self.time), "", 0.0)
        reason = "no speed along the path passes between the blocked intervals of time"
        for attempt in ATTEMPTS:
            found = self._profile(attempt)
            if found is None:
                continue
            made = next(self._motions(found, attempt.window), None)
            if made is not None:
                return made
            reason = "no motion with the speeds found keeps the limits of the joints and the safe intervals"
        return Retimed(None, reason, 0.0)

    def _levels(self) -> Array:
        """Return levels of the squared rate within the velocity limits."""
        use = float((np.abs(self.rates[0]) / self.limits.velocity).max())
        return np.append(SLOW, FAST[FAST * use * use <= 1.0]) if use <= HURRYING else SLOW

    def _profile(self, attempt: Attempt) -> Profile | None:
        """Return the profile with the earliest arrival, or None."""
        x, window = self._levels() if attempt.hurries else SLOW, PUSHING * max(attempt.window, 2.0 * SPACINGS[0])
        limits = self.limits._replace(acceleration=attempt.share * self.limits.acceleration)
        search = SpeedSearch(
            self.pieces.longer(attempt.margin), self.pieces.counts, self.stops.longer(attempt.margin),
            self.stops.counts, *push_bounds(self.rates, limits, self.length / PIECES, window, x), x, self.length, UNIT,
            self.rests, max(attempt.forced, 2 * self.rests), self.clock, self.latest, self.hold, PIECES,
        )  # fmt: skip
        found = earliest_arrivals(search)
        return Profile(x, *found) if found else None

    def _motions(self, profile: Profile, window: float) -> Iterator[Retimed]:
        """Yield motions with a profile that keep the limits, the deviation and the safe intervals."""
        _, levels, departures = profile
        waits = departures[:, 1] - departures[:, 0] > SAME_TIME
        own = (levels[:-1] == UNIT) & (levels[1:] == UNIT) & ~np.append(False, waits[1:-1])
        head = self.stages if own.all() else int(np.argmin(own))
        wait = float(departures[0, 1] - self.clock) if waits[0] else 0.0
        if head == self.stages:
            motion = self._with_head(wait, self.motion.duration, np.zeros(1), self.states[:, -1:])
            if self._free(self._places(profile, self.clock, CHECKED, 0.0), self.clock, CHECKED):
                yield Retimed(motion, "", 0.0)
            return
        for start in self._starts(head * self.length - window / 2.0 - LEAD * SPACINGS[0]):
            started = self.clock + wait + start - self.time
            before = self._places(profile, self.clock, CHECKED, 0.0)[: math.ceil((started - self.clock) / CHECKED) + 1]
            if not self._free(before, self.clock, CHECKED):
                return
            for h in SPACINGS:
                places = self._places(profile, started, h, window)
                followed = self._followed(start, places, h)
                if followed is not None and self._free(places, started, h):
                    times, states, off = followed
                    yield Retimed(self._with_head(wait, start, times, states), "", off)

    def _starts(self, longest: float) -> list[float]:
        """Return places at which the rate may start to change, the latest first, where the motion has room to do so."""
        places = np.linspace(0.0, max(longest, 0.0), HEADS) + self.time
        near = places[:, None] + SPACINGS[0] * np.arange(LEAD)
        use = np.abs(self.motion(near.ravel(), 2)) / self.limits.acceleration
        easy = use.max(axis=1).reshape(near.shape).max(axis=1) <= EASY
        return list(dict.fromkeys([*places[easy][::-1].tolist()[:2], float(places[-1]), self.time]))

    def _places(self, profile: Profile, start: float, h: float, window: float) -> Array:
        """Return the places of a profile at times h apart from ``start`` on, averaged over a window in time."""
        x, levels, departures = profile
        half = round(window / h) // 2
        count = max(math.ceil((departures[-1, 0] - start) / h - SAME_TIME) + half, 2)
        places = profile_places(x, self.length, self.time, (levels, departures), start, h, count + 1)
        places[-1] = self.points[-1]
        if not half:
            return places
        lead = places[0] + (places[1] - places[0]) * np.arange(-half, 0)
        since = np.maximum(start + h * np.arange(count + half + 1) - departures[-1, 0], 0.0)
        padded = np.append(places, np.full(half, places[-1])) + math.sqrt(x[levels[-1]]) * since
        padded = np.append(lead, padded) - places[0]
        means: Array = places[0] + np.lib.stride_tricks.sliding_window_view(padded, 2 * half + 1).mean(axis=1)
        means = np.minimum(means, self.points[-1])
        means[-1] = self.points[-1]
        nearest = self.points[np.clip(np.rint((means - self.time) / self.length).astype(int), 0, self.stages)]
        means = np.where(np.abs(means - nearest) < SAME_PLACE, nearest, means)  # where it waits
        return np.maximum.accumulate(means)

    def _followed(self, start: float, places: Array, h: float) -> tuple[Array, Array, float] | None:
        """Return times, states and deviation of the motion with places h apart in time, where it keeps the limits."""
        found = follow_profile(self.motion.times, self.states, start, places, h, self.limits)
        if found is None:
            return None
        times, out, off = found
        step = float(np.diff(places).max())  # the motion and the path both curve between two knots
        off += (h * h * np.abs(out[2]).max(axis=0) + step * step * np.abs(self.states[2]).max(axis=0)) / 8.0
        return (times, out, float(off.max())) if off.max() <= self.deviation else None

    def _with_head(self, wait: float, end: float, times: Array, states: Array) -> Trajectory:
        """Return the motion that waits, follows the given motion up to a place, and then follows other states."""
        knots, lead = self.motion.times, end - self.time
        inner = (knots > self.time + SAME_TIME) & (knots < end - SAME_TIME)
        head = np.append(self.time, knots[inner]) if lead > SAME_TIME else np.empty(0)
        first = self.motion.states(head)
        moments = np.concatenate([head - self.time, times + (lead if len(head) else 0.0)]) + wait
        rows = np.concatenate([first, states], axis=1)
        if wait > 0.0:
            moments, rows = np.append(0.0, moments), np.concatenate([rows[:, :1], rows], axis=1)
        rests = np.abs(rows[1:]).max(axis=(0, 2)) == 0.0
        kept = np.ones(len(moments), bool)
        kept[1:-1] = ~(rests[:-2] & rests[1:-1] & rests[2:])
        return Trajectory.unchecked(moments[kept], np.ascontiguousarray(rows[:, kept]), self.motion.joint_names)

    def _free(self, places: Array, start: float, h: float) -> bool:
        """Whether places at times h apart are outside of blocked intervals; the end also while it must stay free."""
        blocked_places = BlockedPlaces(*self.pieces, self.points, self.stops.spans, self.stops.counts)
        step = first_blocked(blocked_places, places, start, h)
        end = start + len(places) * h
        return step < 0 and (
            places[-1] < self.points[-1] or not self.stops.meets(self.stages, end - h, end + self.hold)
        )


class Blocked(NamedTuple):
    """Intervals of time in which places along a motion are blocked.

    Attributes:
        places: Starts and ends of the places, in the motion's own time, shape (P, 2) [s].
        spans: Their blocked intervals in order, shape (P, most, 2) [s of the dynamic obstacles' stamps].
        counts: Numbers of these intervals, shape (P,).
    """

    places: Array
    spans: Array
    counts: NDArray[np.int64]

    def longer(self, by: float) -> Array:
        """Return the intervals, longer by a time at both ends [s]."""
        longer: Array = self.spans + np.array([-by, by])
        return longer

    def meets(self, place: int, first: float, last: float) -> bool:
        """Whether a place is blocked at any time between two [s]."""
        spans = self.spans[place, : self.counts[place]]
        return bool(np.any((spans[:, 0] <= last) & (spans[:, 1] >= first)))


def blocked(
    kernel: Kernel,
    dynamic: DynamicObstacles,
    motion: Trajectory,
    places: Array,
    *,
    start: float,
    end: float,
    slack: float = 0.0,
) -> Blocked:
    """Return when dynamic obstacles block places along a motion, by the sphere cover: never too short intervals.

    Args:
        kernel: The kernel of the robot with its held objects.
        dynamic: The obstacles.
        motion: The motion.
        places: Starts and ends of pieces of the motion, in its own time and in order, shape (P, 2) [s]; the same twice
            for a single state.
        start: First time [s of the dynamic obstacles' stamps].
        end: Last time [s].
        slack: Largest distance of each joint from the path [rad].
    """
    return Blocked(places, *blocked_intervals(kernel, dynamic.packed, curve_of(motion), places, (start, end), slack))
