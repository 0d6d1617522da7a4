"""Obstacles that are tracked over time: names that stay, sizes and poses fused over frames and cameras.

Each obstacle has an extended Kalman filter: a turn, its position and lengths, and a velocity with white noise of the
acceleration (Bar-Shalom, Li and Kirubarajan 2001, section 6.2.2). Lengths are constant. Frames of one view share a
part of their errors, such as the guess of how deep a box is of which one side is seen. That part is a state of its own
for each camera, so that it does not average out: a Gauss-Markov sequence over changes of the view.

This tracker tells which obstacle is which, how large it is, and whether it is there. What follows from that belongs to
the filter of the closed loop (:mod:`apex_ompl.loop.tracking`), which takes positions with errors, by name: predictions,
margins, reachable sets, and contradicting positions.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import product

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from apex_ompl.errors import ParameterError
from apex_ompl.perception.box_axes import ROUNDING, SIZE, TURN, aligned
from apex_ompl.perception.library import assignment
from apex_ompl.perception.obstacles import SeenObstacle, solid_obstacle
from apex_ompl.perception.registration import CorrectedFrame
from apex_ompl.perception.rendering import lens_of
from apex_ompl.perception.solid_fit import KnownSize
from apex_ompl.perception.solid_starts import Kind
from apex_ompl.perception.surfaces import inverse
from apex_ompl.perception.tracked_solid import next_solid
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.types import Array
from apex_ompl.util.validation import check_array, check_integer, check_number, check_positive

Mask = NDArray[np.bool_]

PLACE, SPEED = slice(3, 6), slice(9, 12)
SEEN = 9  # unknowns of an observation: turn, position, lengths
STATE = 12
HUBER = 21.67  # squared normalized innovation of 9 dimensions that is exceeded once in 100
LARGEST_MISFIT = 9.0  # of lengths, squared and normalized, that counts in the association
SHORTEST = 0.01  # of a length [m]
BEHIND = 0.03  # by which a depth is behind an obstacle that is not there [m]
PIECE = 2.0  # standard deviations within which a piece of an obstacle is inside it
KNOWN = 0.25  # standard deviation of a place that is known, of the mean length
RECENT = 0.15  # time since an obstacle was seen within which it is still about there [s]
CONFIRMED = 12  # frames in which an obstacle was seen after which it is no piece of another one
GRID = (-0.6, 0.0, 0.6)  # places in a solid that are looked through, of its half lengths


@dataclass(frozen=True)
class TrackerSettings:
    """How obstacles move, and when they are there.

    Attributes:
        births: Number of observations after which an obstacle is there ...
        of: ... of this number of frames that could show it.
        memory: Time for which its place is seen through, after which it is gone [s].
        longest: Time without an observation after which it is gone, though it may be hidden [s].
        power: Power spectral density of the noise of the acceleration [m^2/s^3].
        spin: The same of the turn [rad^2/s].
        speed: Standard deviation of the velocity on each axis of a new obstacle [m/s].
        gate: Squared Mahalanobis distance, of three axes, within which an observation may be of an obstacle.
        common: Share of the variances of an observation that frames of one view have in common.
        view: Change of the view after which that share is renewed: distance that the camera moves in the frame of the
            obstacle, over their distance.
        margin: Standard deviations by which the solid for planners is larger.
        slack: Length by which a new solid is larger than needed; it is replaced where that is more than twice as much
            [m].
    """

    births: int = 2
    of: int = 3
    memory: float = 0.5
    longest: float = 10.0
    power: float = 0.003
    spin: float = 0.003
    speed: float = 0.2
    gate: float = 16.27
    common: float = 0.7
    view: float = 0.3
    margin: float = 2.0
    slack: float = 0.01

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ParameterError: A number is out of its range.
        """
        check_integer(self.of, "of", 1)
        check_integer(self.births, "births", 1, self.of)
        for name in ("memory", "longest", "speed", "gate", "view", "slack"):
            check_positive(getattr(self, name), name)
        for name in ("power", "spin", "margin"):
            check_number(getattr(self, name), name, 0.0)
        check_number(self.common, "common", 0.0, 0.999)


@dataclass(frozen=True, eq=False)
class TrackedObstacle:
    """An obstacle as all frames so far show it.

    Attributes:
        name: Its name, which stays: ``seen_1``, ``seen_2``, ...
        kind: ``box`` or ``cylinder`` along z.
        pose: Pose in the world at the time of the update, shape (4, 4) [m].
        size: Lengths along its axes, of a cylinder diameter, diameter and length, shape (3,) [m].
        velocity: Shape (3,) [m/s].
        covariance: Of a turn about its center and a shift, both in the axes of the world, of the lengths and of the
            velocity, [rad, m, m, m/s], shape (12, 12).
        stamp: Time at which it was seen last [s].
        frames: Number of frames in which it was seen.
        observed: The observation of this update with the axes of the track, or None where there is none.
        solid: The obstacle for planners, larger by the margin of the settings, which covers errors of the position,
            too. Its shape and orientation change only where they have to.
    """

    name: str
    kind: Kind
    pose: Array
    size: Array
    velocity: Array
    covariance: Array
    stamp: float
    frames: int
    observed: SeenObstacle | None
    solid: Obstacle

    @property
    def place_covariance(self) -> Array:
        """Covariance of the center in the axes of the world, shape (3, 3) [m^2]."""
        return self.covariance[PLACE, PLACE]

    @property
    def speed_deviation(self) -> float:
        """Standard deviation of the velocity along its least certain axis [m/s]."""
        return math.sqrt(max(float(np.linalg.eigvalsh(self.covariance[SPEED, SPEED])[-1]), 0.0))

    def known_size(self) -> KnownSize:
        """Return its size for :meth:`apex_ompl.perception.ObstacleFinder.find` in later frames."""
        return KnownSize(self.kind, self.size, float(np.sqrt(np.diag(self.covariance)[SIZE].max())))

    def obstacle(self, deviations: float = 0.0) -> Obstacle:
        """Return the obstacle of a scene, larger by some standard deviations of each of its ends.

        Args:
            deviations: Number of standard deviations.
        """
        return solid_obstacle(
            self.name, self.kind, self.pose, self.size, self.covariance[:SEEN, :SEEN], deviations=deviations
        )


@dataclass(eq=False)
class _Track:
    """The filter of an obstacle.

    Attributes:
        kind: Its kind.
        rotation: Of its frame in the world, shape (3, 3).
        place: Its center, shape (3,) [m].
        size: Its lengths, shape (3,) [m].
        velocity: Shape (3,) [m/s].
        shared: Estimates of the errors that the frames of each camera share, of unit variance, shape (9,).
        views: Camera of the last frame of each camera in the frame of the obstacle, shape (3,) [m], or None.
        covariance: Of turn, position, lengths, velocity, and of ``shared`` in its order.
        stamp: Time of the estimate [s].
        last: Time of the last observation [s].
        hits: Whether it was seen in the last frames that could show it.
        votes: Number of observations of its kind minus those of the other.
        name: Its name, or nothing before it has one.
        frames: Number of observations.
        unseen: Time for which its place was seen through [s].
        observed: Observation of the last update.
        solid: What planners were given last.
    """

    kind: Kind
    rotation: Array
    place: Array
    size: Array
    velocity: Array
    covariance: Array
    stamp: float
    last: float
    hits: deque[bool]
    shared: dict[str, Array] = field(default_factory=dict)
    views: dict[str, Array | None] = field(default_factory=dict)
    votes: int = 1
    name: str = ""
    frames: int = 1
    unseen: float = 0.0
    observed: SeenObstacle | None = None
    solid: Obstacle | None = None

    def block(self, camera: str) -> slice:
        """Return the rows of a camera's shared errors in the covariance."""
        first = STATE + SEEN * list(self.shared).index(camera)
        return slice(first, first + SEEN)

    def pose(self) -> Array:
        """Return the pose, shape (4, 4) [m]."""
        found = np.eye(4)
        found[:3, :3], found[:3, 3] = self.rotation, self.place
        return found


class ObstacleTracker:
    """Tracks obstacles over frames of one camera or several.

    Attributes:
        settings: The settings.
        gone: Names of obstacles that the last update found to be gone.
    """

    def __init__(self, settings: TrackerSettings | None = None) -> None:
        """Start without obstacles, and load SciPy.

        Raises:
            MissingFileError: The extra ``perception`` is not installed.
        """
        self.settings = settings or TrackerSettings()
        self.gone: tuple[str, ...] = ()
        self._assign = assignment()
        self._tracks: list[_Track] = []
        self._last = -math.inf
        self._names = 0

    def update(
        self, stamp: float, seen: Sequence[SeenObstacle], frame: CorrectedFrame | None = None,
        robot: Mask | None = None,
    ) -> tuple[TrackedObstacle, ...]:  # fmt: skip
        """Take what was seen in a frame, and return all obstacles that are there.

        Args:
            stamp: Time of the frame [s], not before that of the last update.
            seen: Obstacles that were found in it.
            frame: The frame. It tells which camera saw them, and whether an obstacle that was not found is hidden.
                Without it all frames are of one camera, and what is not found is not there.
            robot: Pixels of the robot, where it hides what is farther, shape (height, width). Where depths
                of the robot are measured they tell that, too.

        Raises:
            ParameterError: The stamp is before the last one, numbers are not finite, or ``robot`` has another shape.
        """
        self._check(stamp, seen, frame, robot)
        for track in self._tracks:
            self._predict(track, stamp)
        passed = max(0.0, stamp - self._last) if math.isfinite(self._last) else 0.0
        self._last = stamp
        camera = "" if frame is None else frame.camera.name
        eye = None if frame is None else frame.registration.pose[:3, 3]
        for track in self._tracks:
            track.observed = None
        left = list(seen)
        for _ in range(2):  # what an obstacle no longer holds, now that its place is known, may be another one
            rest = [track for track in self._tracks if track.observed is None]
            for track, one in self._pairs(rest, left):
                self._take(track, one, camera, eye)
                left = [other for other in left if other is not one]
            left = [one for one in left if not any(self._sure(track) and _holds(track, one) for track in self._tracks)]
        for track in self._tracks:
            if track.observed is None and (frame is None or _open(track, frame, robot)):
                track.hits.append(False)
                track.unseen += passed
        taken = [track for track in self._tracks if track.observed is not None and self._sure(track)]
        self._tracks += [self._new(stamp, one, camera, eye) for one in left]
        self._name_and_forget(taken)
        return tuple(self._answer(track) for track in self._tracks if track.name)

    def _check(
        self, stamp: float, seen: Sequence[SeenObstacle], frame: CorrectedFrame | None, robot: Mask | None
    ) -> None:
        check_number(stamp, "stamp")
        if stamp < self._last:
            raise ParameterError("stamp", stamp, f"at least {self._last:g}, as in the last update")
        for k, one in enumerate(seen):
            for name, shape in (("pose", (4, 4)), ("size", (3,)), ("covariance", (SEEN, SEEN))):
                check_array(getattr(one, name), shape, f"seen[{k}].{name}", finite=True)
        if robot is not None:
            if frame is None:
                raise ParameterError("frame", None, "the frame whose pixels are the robot's")
            if robot.shape != frame.depth.shape or robot.dtype != bool:
                raise ParameterError("robot", robot.shape, f"a mask of shape {frame.depth.shape}")

    def _predict(self, track: _Track, stamp: float) -> None:
        """Move an estimate to a later time [s]."""
        dt, s = stamp - track.stamp, self.settings
        if dt <= 0.0:
            return
        forward = np.eye(len(track.covariance))
        forward[PLACE, SPEED] = dt * np.eye(3)
        drift = np.zeros_like(forward)
        drift[TURN, TURN] = s.spin * dt * np.eye(3)
        drift[PLACE, PLACE] = s.power * dt**3 / 3.0 * np.eye(3)
        drift[PLACE, SPEED] = drift[SPEED, PLACE] = s.power * dt**2 / 2.0 * np.eye(3)
        drift[SPEED, SPEED] = s.power * dt * np.eye(3)
        track.covariance = forward @ track.covariance @ forward.T + drift
        track.place = track.place + dt * track.velocity
        track.stamp = stamp

    def _pairs(self, tracks: Sequence[_Track], seen: Sequence[SeenObstacle]) -> list[tuple[_Track, SeenObstacle]]:
        """Return tracks and observations of the same obstacles, of the least sum of distances."""
        if not tracks or not seen:
            return []
        cost = np.full((len(tracks), len(seen)), np.inf)
        sure = [track for track in self._tracks if self._sure(track)]
        for j, one in enumerate(seen):
            holding = [track for track in sure if _holds(track, one)]
            for i, track in enumerate(tracks):
                if not holding or track in holding:  # what is inside an obstacle is no other one
                    cost[i, j] = self._cost(track, one)
        far = 1e6
        rows, columns = self._assign(np.where(np.isfinite(cost), cost, far))
        return [(tracks[i], seen[j]) for i, j in zip(rows, columns, strict=True) if np.isfinite(cost[i, j])]

    def _sure(self, track: _Track) -> bool:
        """Return whether an obstacle is about where its track is: it was seen lately, and its place is known."""
        deviation = math.sqrt(np.diag(track.covariance)[PLACE].max())
        return bool(track.name) and self._last - track.last <= RECENT and deviation <= KNOWN * track.size.mean()

    def _cost(self, track: _Track, one: SeenObstacle) -> float:
        """Return the distance of an observation from a track, infinite where it cannot be the same obstacle."""
        off = one.pose[:3, 3] - track.place
        spread = track.covariance[PLACE, PLACE] + one.covariance[PLACE, PLACE]
        distance = float(off @ np.linalg.solve(spread, off))
        if distance > self.settings.gate and np.linalg.norm(off) > track.size.min() / 2.0:
            return math.inf
        misfit = 0.0
        if one.kind == track.kind:
            like = aligned(one, track.rotation, track.size, track.covariance[:SEEN, :SEEN])
            off = like.size - track.size
            spreads = track.covariance[SIZE, SIZE] + like.covariance[SIZE, SIZE] + ROUNDING * np.eye(3)
            misfit = float(off @ np.linalg.solve(spreads, off))
        return distance + min(misfit, LARGEST_MISFIT) + float(np.linalg.slogdet(spread)[1])

    def _new(self, stamp: float, one: SeenObstacle, camera: str, eye: Array | None) -> _Track:
        """Return a track that starts with an observation."""
        track = _Track(
            one.kind, one.pose[:3, :3].copy(), one.pose[:3, 3].copy(), one.size.copy(), np.zeros(3),
            np.zeros((STATE, STATE)), stamp, stamp, deque([True], maxlen=self.settings.of), observed=one,
        )  # fmt: skip
        track.covariance[SPEED, SPEED] = self.settings.speed**2 * np.eye(3)
        self._see_anew(track, one, camera, eye)
        return track

    def _see_anew(self, track: _Track, one: SeenObstacle, camera: str, eye: Array | None) -> None:
        """Take turn and lengths of an observation, and its position where there is none, without earlier ones."""
        moving = track.covariance[PLACE.start : STATE, PLACE.start : STATE].copy()
        known = track.frames > 1
        track.kind, track.rotation, track.size = one.kind, one.pose[:3, :3].copy(), one.size.copy()
        track.shared, track.views = {camera: np.zeros(SEEN)}, {camera: _view(track, eye)}
        covariance = np.zeros((STATE + SEEN, STATE + SEEN))
        covariance[:SEEN, :SEEN] = one.covariance
        covariance[STATE:, STATE:] = np.eye(SEEN)
        lever = -math.sqrt(self.settings.common) * _root(one.covariance)
        covariance[:SEEN, STATE:], covariance[STATE:, :SEEN] = lever, lever.T
        covariance[SPEED, SPEED] = moving[6:, 6:]
        if known:  # the position is not of this observation
            for rows in (PLACE, SPEED):
                covariance[rows] = covariance[:, rows] = 0.0
            both = [*range(3, 6), *range(9, 12)]
            own = [k - PLACE.start for k in both]
            covariance[np.ix_(both, both)] = moving[np.ix_(own, own)]
        track.covariance = covariance

    def _take(self, track: _Track, one: SeenObstacle, camera: str, eye: Array | None) -> None:
        """Update a track with an observation."""
        track.last, track.unseen, track.frames = track.stamp, 0.0, track.frames + 1
        track.hits.append(True)
        self._view_from(track, camera, eye)
        same = one.kind == track.kind
        track.votes += 1 if same else -1
        like = aligned(one, track.rotation, track.size, track.covariance[:SEEN, :SEEN]) if same else one
        track.observed = like
        root = _root(like.covariance)
        part = slice(0, SEEN) if same else PLACE  # of another kind, only the position counts
        miss = np.concatenate([pin.log3(like.pose[:3, :3] @ track.rotation.T), like.pose[:3, 3] - track.place])
        miss = np.concatenate([miss, like.size - track.size])
        seen_by = np.zeros((SEEN, len(track.covariance)))
        seen_by[:, :SEEN] = np.eye(SEEN)
        seen_by[:, track.block(camera)] = math.sqrt(self.settings.common) * root
        miss -= math.sqrt(self.settings.common) * root @ track.shared[camera]
        noise = (1.0 - self.settings.common) * like.covariance
        self._correct(track, miss[part], seen_by[part], noise[part, part])
        if track.votes < 0:
            track.votes = 1
            self._see_anew(track, one, camera, eye)

    def _correct(self, track: _Track, miss: Array, seen_by: Array, noise: Array) -> None:
        """Take an innovation (Kalman); the covariance of one that is too large grows (Huber)."""
        lever = track.covariance @ seen_by.T
        spread = seen_by @ lever + noise + ROUNDING * np.eye(len(miss))
        squared = float(miss @ np.linalg.solve(spread, miss))
        spread *= max(1.0, squared / HUBER)
        gain = np.linalg.solve(spread, lever.T).T
        step = gain @ miss
        covariance = track.covariance - gain @ lever.T
        track.covariance = (covariance + covariance.T) / 2.0
        track.rotation = pin.exp3(step[TURN]) @ track.rotation
        track.place = track.place + step[PLACE]
        track.size = np.maximum(track.size + step[SIZE], SHORTEST)
        track.velocity = track.velocity + step[SPEED]
        for name in track.shared:
            track.shared[name] = track.shared[name] + step[track.block(name)]

    def _view_from(self, track: _Track, camera: str, eye: Array | None) -> None:
        """Renew the shared errors of a camera as far as its view changed."""
        now = _view(track, eye)
        n = len(track.covariance)
        if camera not in track.shared:
            track.shared[camera] = np.zeros(SEEN)
            grown = np.eye(n + SEEN)
            grown[:n, :n] = track.covariance
            track.covariance = grown
        else:
            before = track.views[camera]
            if before is not None and now is not None:
                change = float(np.linalg.norm(now - before)) / max(float(np.linalg.norm(now)), SHORTEST)
                kept, rows = math.exp(-change / self.settings.view), track.block(camera)
                track.shared[camera] = kept * track.shared[camera]
                track.covariance[rows] *= kept
                track.covariance[:, rows] *= kept
                track.covariance[rows, rows] += (1.0 - kept * kept) * np.eye(SEEN)
        track.views[camera] = now

    def _name_and_forget(self, sure: Sequence[_Track]) -> None:
        """Name obstacles that were seen often enough, and forget those that are gone, or pieces of those seen now."""
        s, kept, gone = self.settings, [], []
        for track in self._tracks:
            if not track.name and sum(track.hits) >= s.births:
                self._names += 1
                track.name = f"seen_{self._names}"
            lost = not track.name and len(track.hits) - sum(track.hits) > s.of - s.births
            new = track.observed is None and track.frames < CONFIRMED
            piece = new and any(other.frames > track.frames and _holds(other, track) for other in sure)
            if lost or piece or track.unseen > s.memory or track.stamp - track.last > s.longest:
                gone += [track.name] if track.name else []
            else:
                kept.append(track)
        self._tracks, self.gone = kept, tuple(gone)

    def _answer(self, track: _Track) -> TrackedObstacle:
        covariance = track.covariance[:SEEN, :SEEN]
        needed = solid_obstacle(
            track.name, track.kind, track.pose(), track.size, covariance, deviations=self.settings.margin
        )
        track.solid = next_solid(track.solid, needed, self.settings.slack)
        return TrackedObstacle(
            track.name, track.kind, track.pose(), track.size.copy(), track.velocity.copy(),
            track.covariance[:STATE, :STATE].copy(), track.last, track.frames, track.observed, track.solid,
        )  # fmt: skip


def _root(covariance: Array) -> Array:
    """Return the symmetric square root of a covariance."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray((vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T)


def _view(track: _Track, eye: Array | None) -> Array | None:
    """Return the place of a camera in the frame of an obstacle, shape (3,) [m]."""
    return None if eye is None else track.rotation.T @ (eye - track.place)


def _holds(track: _Track, one: SeenObstacle | _Track) -> bool:
    """Return whether half of what was seen is inside an obstacle that is known: a piece of it behind something."""
    pose = one.pose() if isinstance(one, _Track) else one.pose
    points = np.array(list(product(GRID, repeat=3))) * one.size / 2.0 @ pose[:3, :3].T + pose[:3, 3]
    margin = PIECE * np.sqrt(np.diag(track.covariance)[SIZE] + np.diag(track.covariance)[PLACE].max())
    off = np.abs((points - track.place) @ track.rotation) <= track.size / 2.0 + margin
    return bool(off.all(axis=1).mean() >= 0.5)


def _open(track: _Track, frame: CorrectedFrame, robot: Mask | None) -> bool:
    """Return whether most of an obstacle's place is seen through: depths there are farther."""
    half = track.size / 2.0
    corners = np.array(list(product((-1.0, 1.0), repeat=3))) * half
    inside = np.array(list(product(GRID, repeat=3))) * half
    pose = inverse(frame.registration.pose) @ track.pose()
    corners, inside = (some @ pose[:3, :3].T + pose[:3, 3] for some in (corners, inside))
    if inside[:, 2].min() <= 0.0:
        return False
    lens = lens_of(frame.camera)
    pixels = np.round(inside[:, :2] / inside[:, 2:] * lens[:2] + lens[2:]).astype(np.int64)
    height, width = frame.depth.shape
    within = np.all((pixels >= 0) & (pixels < (width, height)), axis=1, keepdims=True)
    column, row = np.where(within, pixels, 0).T
    far = float(corners[:, 2].max())
    sight = frame.registration.pose[:3, 2]
    spread = math.sqrt(sight @ track.covariance[PLACE, PLACE] @ sight)
    depth = frame.depth if robot is None else np.where(robot, 0.0, frame.depth)
    through = depth[row, column] > far + BEHIND + 3.0 * frame.noise * far * far + spread
    return bool(np.mean(within[:, 0] & through) >= 0.5)
