"""Estimates of dynamic obstacles: Kalman filters of constant velocity, and reachable sets.

Each obstacle has a filter of its own whose state is position and velocity, with white noise of the acceleration
(Bar-Shalom, Li and Kirubarajan 2001, section 6.2.2). The axes are alike, so that one covariance serves all three.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from apex_ompl.kernel import Kernel
from apex_ompl.loop.bounds import change, gap, protrusion
from apex_ompl.loop.environment import Observation
from apex_ompl.loop.sensor import CUT
from apex_ompl.moving.dynamic_obstacles import DynamicObstacles, allowed_rows, clearance_in_time
from apex_ompl.scene.bodies import Obstacle, same_solid
from apex_ompl.types import Array

LOOKS = 16  # observations of an obstacle that are kept
MOST_TRACKS = 64  # obstacles that are tracked at a time
MOST_DOUBTED = 8  # contradicting places of one obstacle that are all kept
GAP = 0.1  # longest time between two observations that counts as observed [s]
GATE = 16.0  # squared Mahalanobis distance, of three axes, after which an obstacle has turned
AXES = 3
ASYMMETRY = 1e-6  # of a covariance that counts as rounding, as a share of its largest entry
LEAST = 0.002  # clearance beyond the margins that a robot has where it is at rest [m]


@dataclass(frozen=True)
class TrackSettings:
    """Parameters of the filters.

    Attributes:
        noise: Standard deviation of an observed position on each axis [m].
        power: Power spectral density of the noise of the acceleration [m^2/s^3].
        speed: Standard deviation of the velocity on each axis of an obstacle that is new or has turned [m/s].
        widths: Margin of obstacles, in standard deviations of the position.
        speed_widths: Growth of the margin after the present, in standard deviations of the velocity.
        most: Largest growth of the margin [m/s].
    """

    noise: float = 0.008
    power: float = 0.003
    speed: float = 0.2
    widths: float = 2.0
    speed_widths: float = 1.0
    most: float = 0.1


@dataclass(eq=False)
class Track:
    """Estimate of an obstacle.

    Attributes:
        shape: The obstacle where it was seen last.
        stamp: Time of that observation [s].
        place: Estimated position then, shape (3,) [m].
        velocity: Estimated velocity, shape (3,) [m/s].
        covariance: Covariance of position and velocity on each axis, shape (2, 2).
        seen: Number of observations since it was new or turned.
        unseen: Time for which the sensor looked and did not see it since the last observation [s].
        bounds: Whether the shape is a bound that contains the obstacle.
        looks: Observed positions with its shape of now, the oldest first, rows of a stamp [s], a position [m], and its
            largest error, NaN for that of the settings [m].
    """

    shape: Obstacle
    stamp: float
    place: Array
    velocity: Array
    covariance: Array
    seen: int = 1
    unseen: float = 0.0
    bounds: bool = False
    looks: list[tuple[float, float, float, float, float]] = field(default_factory=list)

    @classmethod
    def new(
        cls, seen: Obstacle, stamp: float, settings: TrackSettings, error: float = math.nan, *, bounds: bool = False
    ) -> Track:  # fmt: skip
        """Start with an observation, whose largest error is NaN for that of the settings [m]."""
        spread = np.diag([_noise(settings, error) ** 2, settings.speed**2])
        looks = [(stamp, *seen.position, error)]
        place = np.array(seen.position, float)
        return cls(seen, stamp, place, np.zeros(AXES), spread, bounds=bounds, looks=looks)

    def update(self, seen: Obstacle, stamp: float, settings: TrackSettings, error: float = math.nan) -> bool:
        """Take a later observation; return False where the obstacle has turned, and the filter is reset.

        Args:
            seen: The obstacle.
            stamp: When it was there [s].
            settings: Parameters of the filter.
            error: Largest error of the position, NaN for that of the settings [m].
        """
        same, noise = same_solid(seen, self.shape), _noise(settings, error) ** 2 + 1e-12
        moved = 0.0 if same or not self.bounds else change(seen, self.shape)  # its center within the obstacle, at most
        other, noise = moved**2 > noise, noise + moved**2
        dt = stamp - self.stamp
        forward = np.array([[1.0, dt], [0.0, 1.0]])
        drift = settings.power * np.array([[dt**3 / 3.0, dt**2 / 2.0], [dt**2 / 2.0, dt]])
        expected = forward @ self.covariance @ forward.T + drift
        miss = np.array(seen.position, float) - (self.place + dt * self.velocity)
        spread = expected[0, 0] + noise
        before = self.looks[1 - LOOKS :] if same else []  # a position of another shape does not bound this one
        self.shape, self.stamp, self.unseen, self.looks = seen, stamp, 0.0, [*before, (stamp, *seen.position, error)]
        turned = miss @ miss > GATE * spread
        if other or (turned and moved > 0.0):  # the center of another bound tells nothing of the velocity
            self.place, self.seen = np.array(seen.position, float), self.seen + 1
            self.covariance = np.diag([noise, expected[1, 1]])
            return True
        if turned:
            fresh = Track.new(seen, stamp, settings, error)
            self.place, self.velocity, self.covariance, self.seen = fresh.place, fresh.velocity, fresh.covariance, 1
            return False
        gain = expected[:, 0] / spread
        self.place = self.place + dt * self.velocity + gain[0] * miss
        self.velocity = self.velocity + gain[1] * miss
        self.covariance = expected - np.outer(gain, expected[0])
        self.seen += 1
        return True

    def take_velocity(self, velocity: ArrayLike, deviation: float) -> None:
        """Take a velocity that a sensor tells, where it is better known than by the filter and nothing turned just now.

        Args:
            velocity: The velocity, shape (3,) [m/s].
            deviation: Its standard deviation on each axis [m/s].
        """
        turned = self.seen == 1 and len(self.looks) > 1  # which the sensor's own filter may not know yet
        if deviation**2 < self.covariance[1, 1] and not turned:
            self.velocity = np.array(velocity, float)
            self.covariance = np.diag([self.covariance[0, 0], deviation**2])

    def growth(self, settings: TrackSettings) -> tuple[float, float]:
        """Return the margin of the obstacle at the stamp [m], and its growth after that [m/s]."""
        place, speed = (math.sqrt(max(v, 0.0)) for v in np.diag(self.covariance))
        return settings.widths * place, min(settings.speed_widths * speed, settings.most)


def _noise(settings: TrackSettings, error: float) -> float:
    """Return the standard deviation of an observed position on each axis [m]."""
    return settings.noise if math.isnan(error) else error / CUT


def error_fault(error: Any) -> str:
    """Return why an error of an observation is none (:class:`apex_ompl.loop.environment.Observation`), or nothing."""
    try:
        given = np.asarray(error, float)
    except (TypeError, ValueError):
        return "is no number and no matrix"
    if given.shape not in ((), (3, 3)):
        return f"has the shape {given.shape}"
    if not np.isfinite(given).all():
        return "is not finite"
    if given.ndim == 0:
        return "" if given >= 0.0 else "is negative"
    rounding = ASYMMETRY * np.abs(given).max()
    if np.abs(given - given.T).max() > rounding or np.linalg.eigvalsh(given)[0] < -rounding:
        return "is not symmetric and positive semidefinite"
    return ""


def velocity_fault(told: Any) -> str:
    """Return why a velocity of an observation is none (:class:`apex_ompl.loop.environment.Observation`), or nothing."""
    try:
        velocity, deviation = told
        given, spread = np.asarray(velocity, float), float(deviation)
    except (TypeError, ValueError):
        return "is no velocity and its standard deviation"
    if given.shape != (AXES,):
        return f"has the shape {given.shape}"
    if not (np.isfinite(given).all() and math.isfinite(spread)):
        return "is not finite"
    return "has a negative standard deviation" if spread < 0.0 else ""


def largest_error(error: ArrayLike) -> float:
    """Return the largest error of a position [m]: of a covariance, three standard deviations along its longest axis."""
    given = np.asarray(error, float)
    return float(given) if given.ndim == 0 else CUT * math.sqrt(max(float(np.linalg.eigvalsh(given)[-1]), 0.0))


class Taken(NamedTuple):
    """How an observation was taken.

    Attributes:
        refused: Why it was refused as a whole, or nothing.
        doubted: Places in it that contradict what was known, a sentence each.
    """

    refused: str = ""
    doubted: tuple[str, ...] = ()


@dataclass(eq=False)
class Tracker:
    """Estimates of all dynamic obstacles.

    A place that an obstacle cannot have reached since the last observation contradicts an assumption: either
    observation may be wrong. Both places count as possible, until a later observation confirms one of them.

    Attributes:
        kernel: The robot's kernel, for pairs of bodies that may touch.
        settings: Parameters of the filters.
        allowed: Pairs of names of bodies that may touch.
        error: Largest error of an observed place [m].
        fastest: Largest speed of any obstacle [m/s].
        memory: Time of unseen after which an obstacle is forgotten [s].
        awaited: Names of the initial obstacles that were not seen yet.
        tracks: Estimates by name.
        doubted: Other estimates of obstacles, which contradict those of ``tracks``.
        last: The newest stamp of a usable observation [s].
    """

    kernel: Kernel
    settings: TrackSettings = field(default_factory=TrackSettings)
    allowed: tuple[tuple[str, str], ...] = ()
    error: float = math.inf
    fastest: float = math.inf
    memory: float = math.inf
    awaited: set[str] = field(default_factory=set)
    tracks: dict[str, Track] = field(default_factory=dict)
    doubted: list[Track] = field(default_factory=list)
    last: float = -math.inf
    _made: DynamicObstacles | None = field(default=None, init=False)
    _shapes: list[Obstacle] = field(default_factory=list, init=False)

    def take(self, observation: Observation, now: float = math.inf) -> Taken:
        """Take an observation, by its stamp and not by its arrival; older ones than the last change nothing.

        An observation that cannot be true is refused as a whole, so that earlier ones age. One whose places contradict
        earlier ones is taken.

        Args:
            observation: The observation.
            now: Clock time [s].
        """
        fault = self._fault(observation, now)
        if fault:
            return Taken(refused=fault)
        stamp, found = observation.stamp, []
        watched = min(max(stamp - self.last, 0.0), GAP)
        self.last = max(self.last, stamp)
        for seen in observation.seen:
            self.awaited.discard(seen.name)
            track, error = self.tracks.get(seen.name), math.nan
            if seen.name in observation.errors:
                error = largest_error(observation.errors[seen.name])
            if track is None:
                self.tracks[seen.name] = Track.new(seen, stamp, self.settings, error, bounds=observation.bounds)
            elif stamp > track.stamp and not self._take_place(track, seen, stamp, error):
                way = float(np.linalg.norm(np.subtract(seen.position, track.shape.position)))
                found.append(f"{seen.name} was {way:.3g} m away {stamp - track.stamp:.3g} s before")
            if seen.name in observation.velocities and self.tracks[seen.name].stamp == stamp:
                self.tracks[seen.name].take_velocity(*observation.velocities[seen.name])
        self._remove(observation.gone, stamp)
        self._forget({seen.name for seen in observation.seen}, watched)
        return Taken(doubted=tuple(found))

    def _fault(self, observation: Observation, now: float) -> str:
        """Return why an observation cannot be true, or nothing."""
        stamp, names = observation.stamp, [seen.name for seen in observation.seen]
        if not math.isfinite(stamp):
            return f"its stamp is {stamp}"
        if stamp > now + 1e-9:
            return f"its stamp is {stamp - now:.3g} s in the future"
        for seen in observation.seen:
            if not np.isfinite(seen.position).all():
                return f"the place of {seen.name} is not finite"
            if seen.half_space is not None:
                return f"{seen.name} has no bounds"
        for name, error in observation.errors.items():
            fault = error_fault(error) if name in (*names, *observation.gone) else "has no obstacle"
            if fault:
                return f"the error of {name} {fault}"
        for name, told in observation.velocities.items():
            fault = velocity_fault(told) if name in names else "has no obstacle"
            if fault:
                return f"the velocity of {name} {fault}"
        if len({*names}) < len(names):
            return "it has a name twice"
        if len({*names, *self.tracks}) > MOST_TRACKS:
            return f"there are more than {MOST_TRACKS} obstacles"
        return ""

    def _take_place(self, track: Track, seen: Obstacle, stamp: float, error: float) -> bool:
        """Take a later place of an obstacle, with its error [m]; return whether it agrees with earlier ones."""
        others = [one for one in self.doubted if one.shape.name == seen.name]
        own = self.error if math.isnan(error) else error
        known = next((one for one in (track, *others) if self.may_be(one, seen, stamp, own)), None)
        if known is not None:
            known.update(seen, stamp, self.settings, error)
            self.tracks[seen.name] = known
            self.doubted = [one for one in self.doubted if one.shape.name != seen.name]
            return True
        kept = [*others, track]
        del kept[1 : 1 + max(len(kept) - MOST_DOUBTED, 0)]  # the oldest and the newest ones stay
        self.doubted = [one for one in self.doubted if one.shape.name != seen.name] + kept
        self.tracks[seen.name] = Track.new(seen, stamp, self.settings, error, bounds=track.bounds)
        return False

    def may_be(self, track: Track, seen: Obstacle, stamp: float, error: float = 0.0) -> bool:
        """Whether an obstacle can have moved from the place of a track to where it is seen at a later time [s].

        Args:
            track: The track.
            seen: The obstacle.
            stamp: The time [s].
            error: Largest error of the later place [m].
        """
        way = float(np.linalg.norm(np.subtract(seen.position, track.shape.position)))
        most = self._reach(track, stamp) + error
        return way <= most or (track.bounds and gap(track.shape, seen) <= most)

    def may_contain(self, track: Track, there: Obstacle, stamp: float) -> bool:
        """Whether an obstacle at a time [s] is where a track allows it to be.

        Args:
            track: The track.
            there: The obstacle.
            stamp: The time [s].
        """
        if not track.bounds:
            return self.may_be(track, there, stamp)
        return protrusion(there, track.shape) <= self._reach(track, stamp)

    def _reach(self, track: Track, stamp: float) -> float:
        """Return how far an obstacle can be at a time [s] from where a track has seen it [m]."""
        own = track.looks[-1][-1]
        return (self.error if math.isnan(own) else own) + self.fastest * (stamp - track.stamp) + 1e-9

    def _remove(self, names: Collection[str], stamp: float) -> None:
        """Remove obstacles that are not there any more at a time [s]."""
        for name in names:
            self.awaited.discard(name)
            if name in self.tracks and self.tracks[name].stamp < stamp:
                del self.tracks[name]
                self.doubted = [track for track in self.doubted if track.shape.name != name]

    def _forget(self, seen: set[str], watched: float) -> None:
        """Forget obstacles that were not seen for ``memory``; those of points stay until they are ``gone``.

        A cloud is all that a camera saw, so that one that is not followed by another tells that the camera is silent.

        Args:
            seen: Names of those that were seen now.
            watched: Time since the last observation [s].
        """
        for track in (*self.tracks.values(), *self.doubted):
            track.unseen += watched if track.shape.name not in seen and track.shape.points is None else 0.0
        self.tracks = {name: track for name, track in self.tracks.items() if track.unseen <= self.memory}
        self.doubted = [track for track in self.doubted if track.unseen <= self.memory]

    def predicted(self, margin: float, prediction: str = "cv") -> DynamicObstacles:
        """Return the predicted obstacles, larger by a margin [m] and by their uncertainty."""
        if prediction == "still":
            return self._as_seen(margin, 0.0)
        some = self.tracks.values()
        growth = [(margin + first, later) for first, later in (track.growth(self.settings) for track in some)]
        return self._placed([track.place for track in some], [track.velocity for track in some], growth)

    def ease_margins(self, dynamic: DynamicObstacles, q: Array, times: ArrayLike) -> DynamicObstacles:
        """Reduce the margins, in place, as far as the robot needs to rest where it is, and return the obstacles.

        Args:
            dynamic: Obstacles with margins.
            q: The robot's state, shape (dof,).
            times: Clock times at which it rests there [s].
        """
        at = np.atleast_1d(np.asarray(times, float))
        clear, _ = clearance_in_time(self.kernel, dynamic, np.repeat(q[None], len(at), axis=0), at, 2.0 * LEAST)
        missing = LEAST - float(np.min(clear, initial=LEAST))
        if missing > 0.0:
            dynamic.arrays.growth[:, 0] = np.maximum(dynamic.arrays.growth[:, 0] - missing, 0.0)
        return dynamic

    def reachable(self, error: float, fastest: float, margin: float = 0.0, q: Array | None = None) -> DynamicObstacles:
        """Return the reachable sets of the obstacles: seen within an error [m], and no faster than a speed [m/s].

        An observation with an error of its own has that one. Each observation bounds the place of an obstacle by a ball
        that grows with time. The ball that leaves a robot at a state, shape (dof,), most room counts. Where
        observations contradict each other, an obstacle can be at each of the places, which are obstacles of their own
        here.
        """
        tracks = (*self.tracks.values(), *self.doubted)
        if not tracks:
            return self._as_seen(error + margin, fastest)
        some = [track.looks[-1] if q is None else self._best_look(track, error, fastest, q) for track in tracks]
        looks, own = np.split(np.array(some), [1 + AXES], axis=1)
        still, growth = np.zeros((len(tracks), AXES)), np.tile((error + margin, fastest), (len(tracks), 1))
        growth[:, 0] = np.where(np.isnan(own[:, 0]), growth[:, 0], own[:, 0] + margin)
        if not self.doubted:
            return self._dynamic().placed(looks[:, 1:], still, growth, looks[:, 0])
        names = [f"{k}: {track.shape.name}" for k, track in enumerate(tracks)]
        pairs = [(row, names[k]) for k, track in enumerate(tracks) for row, _ in self._allowed_rows(track.shape.name)]
        shapes = [t.shape.model_copy(update={"name": name}) for t, name in zip(tracks, names, strict=True)]
        return DynamicObstacles(shapes, pairs).placed(looks[:, 1:], still, growth, looks[:, 0])

    def _best_look(self, track: Track, error: float, fastest: float, q: Array) -> Array:
        """Return the observation whose ball leaves a robot at a state most room, by the nearest ball of its cover.

        Args:
            track: The track.
            error: Largest error of observations without one of their own [m].
            fastest: Largest speed [m/s].
            q: The state, shape (dof,).
        """
        looks = np.array(track.looks)
        places, own = looks[:, 1 : 1 + AXES], looks[:, -1]
        centers, radii = self._balls(q)
        nearest = centers[np.argmin(np.linalg.norm(centers - places[-1], axis=1) - radii)]
        larger = np.where(np.isnan(own), 0.0, own - error)  # than the assumed error
        room = np.linalg.norm(places - nearest, axis=1) + fastest * looks[:, 0] - larger
        found: Array = looks[np.argmax(room)]
        return found

    def _balls(self, q: Array) -> tuple[Array, Array]:
        """Return centers, shape (N, 3), and radii, shape (N,), of balls that contain the robot's bodies [m]."""
        a = self.kernel.robot.arrays
        rotation, origin = (value[0] for value in self.kernel.joint_frames(q[None]))
        joint = a.body_joint
        root = a.body_root
        centers = np.einsum("nij,nj->ni", rotation[joint], a.node_center[root]) + origin[joint]
        return centers, a.node_radius[root]

    def _allowed_rows(self, name: str) -> list[tuple[int, str]]:
        return allowed_rows(self.kernel, self.allowed, [name])

    def _as_seen(self, margin: float, growth: float) -> DynamicObstacles:
        """Return the obstacles where they were seen last, with a margin [m] and its growth [m/s]."""
        places = [track.shape.position for track in self.tracks.values()]
        return self._placed(places, [(0.0, 0.0, 0.0)] * len(places), [(margin, growth)] * len(places))

    def _placed(
        self, places: Sequence[ArrayLike], velocities: Sequence[ArrayLike], growth: Sequence[ArrayLike]
    ) -> DynamicObstacles:
        """Return the obstacles at places and velocities at their stamps."""
        made = self._dynamic()
        at, along = (np.array(some, float).reshape(-1, AXES) for some in (places, velocities))
        stamps = np.array([track.stamp for track in self.tracks.values()])
        return made.placed(at, along, np.array(growth, float).reshape(-1, 2), stamps)

    def _dynamic(self) -> DynamicObstacles:
        """Return the obstacles; they are built again where a shape changed."""
        shapes, made = [track.shape for track in self.tracks.values()], self._made
        if made is None or len(shapes) != len(self._shapes) or not all(map(same_solid, shapes, self._shapes)):
            made = self._made = DynamicObstacles(
                shapes, allowed_rows(self.kernel, self.allowed, [o.name for o in shapes])
            )
        self._shapes = shapes
        return made


def true_motions(
    kernel: Kernel, present: Iterable[Obstacle], time: float, allowed: Iterable[tuple[str, str]]
) -> DynamicObstacles:
    """Return obstacles with their true motions from a time on [s]."""
    some = list(present)
    return DynamicObstacles(some, allowed_rows(kernel, allowed, [o.name for o in some]), stamp=time)
