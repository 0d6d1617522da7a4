"""Estimates of obstacles that move: Kalman filters of constant velocity, and where obstacles may be.

Each obstacle has a filter of its own whose state is place and velocity, with white noise of the acceleration
(Bar-Shalom, Li and Kirubarajan 2001, section 6.2.2). The axes are alike, so that one covariance serves all three.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from apex_ompl.kernel import Kernel
from apex_ompl.live.movers import Movers, allowed_rows, clearance_in_time
from apex_ompl.loop.observation import Observation
from apex_ompl.scene.bodies import Obstacle, same_solid
from apex_ompl.types import Array

GATE = 16.0  # squared Mahalanobis distance, of three axes, behind which an obstacle has turned
AXES = 3
LEAST = 0.002  # clearance to margins that a robot has where it stands [m]


@dataclass(frozen=True)
class TrackSettings:
    """Parameters of the filters.

    Attributes:
        noise: Standard deviation of an observed place on each axis [m].
        power: Power of the noise of the acceleration [m^2/s^3].
        speed: Standard deviation of the velocity on each axis of an obstacle that is new or has turned [m/s].
        widths: Standard deviations of the place by which obstacles count as larger.
        speed_widths: Standard deviations of the velocity by which they grow behind the present.
        most: Largest such growth [m/s].
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
        stamp: When [s].
        place: Estimate of the place then, shape (3,) [m].
        velocity: Shape (3,) [m/s].
        covariance: Of place and velocity on each axis, shape (2, 2).
        seen: Number of observations since it was new or turned.
    """

    shape: Obstacle
    stamp: float
    place: Array
    velocity: Array
    covariance: Array
    seen: int = 1

    @classmethod
    def new(cls, seen: Obstacle, stamp: float, settings: TrackSettings) -> Track:
        """Begin with an observation."""
        spread = np.diag([settings.noise**2, settings.speed**2])
        return cls(seen, stamp, np.array(seen.position, float), np.zeros(AXES), spread)

    def update(self, seen: Obstacle, stamp: float, settings: TrackSettings) -> bool:
        """Take a later observation; return False where the obstacle has turned, and the velocity begins anew."""
        dt, noise = stamp - self.stamp, settings.noise**2 + 1e-12
        forward = np.array([[1.0, dt], [0.0, 1.0]])
        drift = settings.power * np.array([[dt**3 / 3.0, dt**2 / 2.0], [dt**2 / 2.0, dt]])
        expected = forward @ self.covariance @ forward.T + drift
        miss = np.array(seen.position, float) - (self.place + dt * self.velocity)
        spread = expected[0, 0] + noise
        self.shape, self.stamp = seen, stamp
        if miss @ miss > GATE * spread:
            fresh = Track.new(seen, stamp, settings)
            self.place, self.velocity, self.covariance, self.seen = fresh.place, fresh.velocity, fresh.covariance, 1
            return False
        gain = expected[:, 0] / spread
        self.place = self.place + dt * self.velocity + gain[0] * miss
        self.velocity = self.velocity + gain[1] * miss
        self.covariance = expected - np.outer(gain, expected[0])
        self.seen += 1
        return True

    def growth(self, settings: TrackSettings) -> tuple[float, float]:
        """Return by how much the obstacle counts as larger at the stamp [m], and behind it [m/s]."""
        place, speed = (math.sqrt(max(v, 0.0)) for v in np.diag(self.covariance))
        return settings.widths * place, min(settings.speed_widths * speed, settings.most)


@dataclass(eq=False)
class Tracker:
    """What the loop knows of obstacles that move.

    Attributes:
        kernel: The robot's kernel, for pairs of bodies that may touch.
        settings: Parameters of the filters.
        allowed: Pairs of names of bodies that may touch.
        tracks: Estimates by name.
        last: The newest stamp [s].
    """

    kernel: Kernel
    settings: TrackSettings = field(default_factory=TrackSettings)
    allowed: tuple[tuple[str, str], ...] = ()
    tracks: dict[str, Track] = field(default_factory=dict)
    last: float = -math.inf
    _made: Movers | None = field(default=None, init=False)
    _shapes: list[Obstacle] = field(default_factory=list, init=False)

    def take(self, observation: Observation) -> None:
        """Take an observation, by its stamp and not by its arrival; what is older than what is known says nothing.

        Stamps and places that are not finite are left out.
        """
        if not math.isfinite(observation.stamp):
            return
        self.last = max(self.last, observation.stamp)
        for seen in observation.seen:
            if not np.isfinite(seen.position).all():
                continue
            track = self.tracks.get(seen.name)
            if track is None:
                self.tracks[seen.name] = Track.new(seen, observation.stamp, self.settings)
            elif observation.stamp > track.stamp:
                track.update(seen, observation.stamp, self.settings)

    def predicted(self, margin: float, prediction: str = "cv") -> Movers:
        """Return the obstacles as they are expected to move, larger by a margin [m] and by what is uncertain."""
        if prediction == "still":
            return self._as_seen(margin, 0.0)
        some = self.tracks.values()
        growth = [(margin + first, later) for first, later in (track.growth(self.settings) for track in some)]
        return self._placed([track.place for track in some], [track.velocity for track in some], growth)

    def eased(self, movers: Movers, q: Array, times: ArrayLike) -> Movers:
        """Take so much of the margins away that the robot may stand where it is, in place, and return the obstacles.

        Args:
            movers: Obstacles with margins.
            q: The robot's state, shape (dof,).
            times: Times of the clock at which it may stand there [s].
        """
        at = np.atleast_1d(np.asarray(times, float))
        clear, _ = clearance_in_time(self.kernel, movers, np.repeat(q[None], len(at), axis=0), at, 2.0 * LEAST)
        missing = LEAST - float(np.min(clear, initial=LEAST))
        if missing > 0.0:
            movers.arrays.growth[:, 0] = np.maximum(movers.arrays.growth[:, 0] - missing, 0.0)
        return movers

    def reachable(self, error: float, fastest: float, margin: float = 0.0) -> Movers:
        """Return the obstacles as large as all that they can reach: seen within an error [m], no faster than [m/s]."""
        return self._as_seen(error + margin, fastest)

    def _as_seen(self, margin: float, growth: float) -> Movers:
        """Return the obstacles where they were seen last, with a margin [m] that grows [m/s]."""
        places = [track.shape.position for track in self.tracks.values()]
        return self._placed(places, [(0.0, 0.0, 0.0)] * len(places), [(margin, growth)] * len(places))

    def _placed(
        self, places: Sequence[ArrayLike], velocities: Sequence[ArrayLike], growth: Sequence[ArrayLike]
    ) -> Movers:
        """Return the obstacles at places and velocities at their stamps; solids are made anew where a shape changed."""
        shapes = [track.shape for track in self.tracks.values()]
        made = self._made
        if made is None or len(shapes) != len(self._shapes) or not all(map(same_solid, shapes, self._shapes)):
            made = self._made = Movers(shapes, allowed_rows(self.kernel, self.allowed, [o.name for o in shapes]))
        self._shapes = shapes
        at, along = (np.array(some, float).reshape(-1, AXES) for some in (places, velocities))
        stamps = np.array([track.stamp for track in self.tracks.values()])
        return made.placed(at, along, np.array(growth, float).reshape(-1, 2), stamps)


def as_they_are(kernel: Kernel, present: Iterable[Obstacle], time: float, allowed: Iterable[tuple[str, str]]) -> Movers:
    """Return obstacles as they truly move now, from a time on [s]."""
    some = list(present)
    return Movers(some, allowed_rows(kernel, allowed, [o.name for o in some]), stamp=time)
