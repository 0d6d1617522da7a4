"""States in which cameras see the contact faces of held objects.

Where an object is hidden, out of range or not known well enough for a task, the robot looks again before it aligns.
Inverse kinematics brings the contact faces before a camera, at a distance and an angle at which depths say much, from
random states around the present one. Of those that are free, the states are kept in which a fit to a predicted frame
(:mod:`apex_ompl.perception.visibility`) has small covariances, near ones first.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from apex_ompl.collision import CollisionChecker
from apex_ompl.constraints import ConstraintSet
from apex_ompl.constraints.frames import LinkFace
from apex_ompl.constraints.links import Links, in_world
from apex_ompl.errors import ParameterError, UnknownNameError
from apex_ompl.kernel import FixedVector, Target, angle_target, offset_target
from apex_ompl.perception.camera import Camera
from apex_ompl.perception.frames import check_camera
from apex_ompl.perception.held import HeldObject
from apex_ompl.perception.held_settings import HeldSettings
from apex_ompl.perception.surfaces import RobotSurface, inverse
from apex_ompl.perception.visibility import ViewPredictor, Visible
from apex_ompl.robot.model import Robot
from apex_ompl.scene.bodies import AttachedObject, Obstacle
from apex_ompl.scene.constraints import Constraint
from apex_ompl.types import Array
from apex_ompl.util.display import fields_line
from apex_ompl.util.validation import (
    check_array,
    check_integer,
    check_number,
    check_positive,
    check_seed,
    check_states,
    finite_array,
)

POSITION_WEIGHT = 4.0  # weight of a position error against an angle in inverse kinematics [rad/m]
STEPS = 30  # of inverse kinematics at most
WIDE = 0.4  # visible share of a surface above which more says little
UNSEEN = 5.0  # what an object without an answer counts against a standard deviation that is just small enough
FACE_WEIGHT = 0.5  # of the visible share of the contact face against that of the whole surface


class HasChecker(Protocol):
    """A world with a collision checker, such as that of a planner."""

    @property
    def checker(self) -> CollisionChecker:
        """The checker."""


World = CollisionChecker | HasChecker | Sequence[Obstacle] | None
"""A collision checker, a world that has one, obstacles, or None for none."""


@dataclass(frozen=True)
class LookSettings:
    """How states to look from are searched.

    Attributes:
        place: Standard deviation of a contact face's center in any direction that is small enough [m].
        turn: Standard deviation of its axis in each direction that is small enough [rad].
        frames: Number of frames that will be taken in the state.
        distance: Least and largest distance of the faces from the camera [m].
        face_angle: Largest angle between a face's axis and the direction to the camera [rad].
        border: Share of the image on each side in which no face is to be.
        spread: Standard deviation of joints of the states that inverse kinematics starts from, of the farthest [rad].
        joint_margin: Distance that joints keep from their limits [rad].
        proposals: Number of states that inverse kinematics starts from.
        predicted: Number of free states whose covariances are predicted.
        rounds: Number of searches at most, while an object is not seen well enough from any state; all after the first
            one are farther from the present state.
        apart: Least distance of states from each other, of the joint that moves most [rad].
        avoid: The same from states that did not show enough [rad].
        least_cosine: Cosine between a surface's normal and the direction to the camera above which it is visible.
        motion: What a second of motion counts against a standard deviation that is just small enough.
        most: Number of states that are returned at most.
        seed: Seed of the search.
    """

    place: float = 0.0035
    turn: float = 0.03
    frames: int = 9
    distance: tuple[float, float] = (0.7, 1.2)
    face_angle: float = 1.05
    border: float = 0.12
    spread: float = 0.7
    joint_margin: float = 0.02
    proposals: int = 96
    predicted: int = 20
    rounds: int = 3
    apart: float = 0.1
    avoid: float = 0.3
    least_cosine: float = 0.2
    motion: float = 0.3
    most: int = 6
    seed: int = 0

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ParameterError: A number is out of its range.
        """
        for name in ("place", "turn", "spread"):
            check_positive(getattr(self, name), name)
        for name in ("frames", "proposals", "predicted", "rounds", "most"):
            check_integer(getattr(self, name), name, 1)
        distance = finite_array(self.distance, "distance")
        check_array(distance, (2,), "distance")
        low, high = distance.tolist()
        check_positive(low, "distance")
        check_number(high, "distance", low)
        check_number(self.face_angle, "face_angle", 0.0, np.pi)
        check_number(self.border, "border", 0.0, 0.4)
        check_number(self.joint_margin, "joint_margin", 0.0, 0.5)
        check_number(self.apart, "apart", 0.0)
        check_number(self.avoid, "avoid", 0.0)
        check_number(self.least_cosine, "least_cosine", 0.0, 0.99)
        check_number(self.motion, "motion", 0.0)
        check_seed(self.seed)


@dataclass(frozen=True)
class ObjectView:
    """What a camera is expected to see of an object.

    Attributes:
        name: Its name.
        share: Share of its surface that is visible; of a closed surface about half at most.
        face: Share of its contact face that is visible.
        place_spread: Expected standard deviation of the face's center in the worst direction [m].
        turn_spread: Expected standard deviation of its axis in each direction [rad].
        reason: Why no answer is expected, or empty.
        enough: Whether these are small enough.
    """

    name: str
    share: float
    face: float
    place_spread: float
    turn_spread: float
    reason: str
    enough: bool


@dataclass(frozen=True, eq=False)
class LookState:
    """A state to look from.

    Attributes:
        state: Shape (dof,).
        camera: Name of the camera.
        objects: What it is expected to see of each wanted object.
        duration: Least time of a straight motion there at full speed [s].
    """

    state: Array
    camera: str
    objects: tuple[ObjectView, ...]
    duration: float

    __repr__ = fields_line

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the objects that are expected to be seen well enough."""
        return tuple(one.name for one in self.objects if one.enough)


class _Candidate(NamedTuple):
    """A free state before a camera, and what is visible from there."""

    state: Array
    camera: Camera
    visible: tuple[Visible, ...]
    duration: float


def look_states(
    robot: Robot, attached: Sequence[AttachedObject], names: Sequence[str], cameras: Sequence[Camera] | Camera,
    state: ArrayLike, *, world: World = None, settings: LookSettings | None = None, held: HeldSettings | None = None,
    constraints: Sequence[Constraint] = (), avoided: Sequence[Array] = (), surface: RobotSurface | None = None,
) -> tuple[LookState, ...]:  # fmt: skip
    """Return free states in which cameras see contact faces of held objects, the best first.

    States that show all wanted objects well enough come first, then those that show some of them, each by its expected
    standard deviations and its distance. If none shows all, look from the first one, then ask again for the objects
    that it did not show, or take the order of :func:`look_plan`. Hands stay closed as they are. There is no state where
    none was found in which a fit is expected to find an object.

    Args:
        robot: The robot.
        attached: All held objects, where they are believed to be.
        names: Names of those that are to be seen.
        cameras: The cameras, each on a link or at its place in the world.
        state: Present state, shape (dof,).
        world: What states are free of, and what hides objects: a checker, a world, or obstacles.
        settings: The settings.
        held: Settings of the fit whose covariances are predicted.
        constraints: What has to hold in the states.
        avoided: States that did not show enough, shape (dof,) each.
        surface: The robot's surface, where it is known already.

    Raises:
        ApexError: A name is not that of a held object, a camera has no pose, or the state is not one of the robot.
    """
    s = settings or LookSettings()
    eyes = checked_cameras(cameras, robot)
    q = finite_array(state, "state")
    check_states(q[None] if q.ndim == 1 else q, robot.dof, "state")
    q = q.clip(robot.limits.lower, robot.limits.upper)
    wanted = _wanted(attached, names)
    checker = checker_of(world, robot, attached)
    closed = any(one.links is not None for one in attached)
    kept = ConstraintSet.of(robot, constraints, attached, q) if constraints or closed else None
    search = _Search(checker, {k: LinkFace.of_object(attached[k]) for k in wanted}, q, s, kept)
    predictor = ViewPredictor(
        robot, attached, checker.obstacles.values(), settings=held, seed=s.seed, surface=surface
    )  # fmt: skip
    looks: list[LookState] = []
    for k in range(s.rounds):
        candidates = [one for camera in eyes for one in search.candidates(camera, predictor, len(eyes), wide=k > 0)]
        candidates = [one for one in candidates if all(_apart(one.state, other) >= s.avoid for other in avoided)]
        looks += [_look(one, predictor, wanted, s) for one in _spread_over(candidates, wanted, s.predicted)]
        if {name for look in looks for name in look.names} == {attached[n].name for n in wanted}:
            break
    found: list[LookState] = []
    for look in sorted(looks, key=lambda one: _cost(one, s)):
        shows = any(not view.reason for view in look.objects)
        if shows and all(look.camera != one.camera or _apart(look.state, one.state) >= s.apart for one in found):
            found.append(look)
    return tuple(found[: s.most])


def look_plan(looks: Iterable[LookState]) -> tuple[LookState, ...]:
    """Return the states, one after the other, that together show all objects that any of them shows well enough.

    Args:
        looks: States from :func:`look_states`, the best first.
    """
    left, chosen = list(looks), list[LookState]()
    shown: set[str] = set()
    while left:
        best = max(left, key=lambda one: len({*one.names} - shown))  # the first one of several
        if not {*best.names} - shown:
            break
        chosen.append(best)
        left.remove(best)
        shown |= {*best.names}
    return tuple(chosen)


def _apart(first: Array, second: Array) -> float:
    """Return the largest difference of a joint of two states."""
    return float(np.abs(first - second).max())


def checked_cameras(cameras: Sequence[Camera] | Camera, robot: Robot) -> tuple[Camera, ...]:
    """Return cameras as a tuple.

    Raises:
        ApexError: There is none, one is no camera, has no pose or a link that does not exist, or two have one name.
    """
    eyes = (cameras,) if isinstance(cameras, Camera) else tuple(cameras)
    if not eyes:
        raise ParameterError("cameras", "none", "one camera or more")
    for camera in eyes:
        check_camera(camera, "cameras")
        if camera.link is not None:
            robot.link_frame(camera.link)
        elif np.array_equal(camera.pose, np.eye(4)):
            raise ParameterError("cameras", f"{camera.name!r} without one", "cameras with a pose, as calibrated")
    twice = [camera.name for k, camera in enumerate(eyes) if camera.name in {one.name for one in eyes[:k]}]
    if twice:
        raise ParameterError("cameras", f"{twice[0]!r} twice", "cameras with different names")
    return eyes


def checker_of(world: World, robot: Robot, attached: Sequence[AttachedObject]) -> CollisionChecker:
    """Return the collision checker of a world.

    Raises:
        ApexError: It is of another robot, or something else.
    """
    if isinstance(world, CollisionChecker):
        checker = world
    elif world is None or (isinstance(world, Iterable) and all(isinstance(one, Obstacle) for one in world)):
        checker = CollisionChecker(robot, world or (), attached)
    else:
        found = getattr(world, "checker", None)
        if not isinstance(found, CollisionChecker):
            raise ParameterError("world", world, "a World, a CollisionChecker, or obstacles")
        checker = found
    if checker.robot.joint_names != robot.joint_names:
        raise ParameterError("world", checker.robot.name, f"a world of {robot.name!r}")
    return checker


def _wanted(attached: Sequence[AttachedObject], names: Sequence[str]) -> list[int]:
    """Return the numbers of the objects that are to be seen.

    Raises:
        ApexError: There is none, or a name is not that of one held object with a contact face.
    """
    known = [one.name for one in attached]
    given = [names] if isinstance(names, str) else list(names)
    if not given:
        raise ParameterError("names", "none", "the name of a held object, or several")
    for name in given:
        if name not in known:
            raise UnknownNameError("held object", name, known)
        if known.count(name) > 1:
            raise ParameterError("names", name, f"one object of that name, not {known.count(name)}")
        if attached[known.index(name)].contact is None:
            raise ParameterError("names", name, "an object with a contact face")
    return sorted({known.index(name) for name in given})


class _Search:
    """Search for free states with contact faces before cameras."""

    def __init__(
        self, checker: CollisionChecker, faces: Mapping[int, LinkFace], state: Array, settings: LookSettings,
        constraints: ConstraintSet | None,
    ) -> None:  # fmt: skip
        """Search around a state, for faces by the numbers of their objects."""
        robot = checker.robot
        self._robot, self._faces, self._state, self._checker, self._settings = robot, faces, state, checker, settings
        self._links, self._constraints = Links.of(robot), constraints
        self._rng = np.random.default_rng(settings.seed)
        synergies = [hand.synergy for hand in robot.hands.values() if hand.synergy is not None]
        self._hands: NDArray[np.intp] = np.array([robot.joint_names.index(name) for name in synergies], np.intp)
        low, high = robot.limits.lower, robot.limits.upper
        margin = np.minimum(settings.joint_margin, (high - low) / 4.0)
        margin[self._hands] = 0.0
        self._lower, self._upper = low + margin, high - margin

    def candidates(
        self, camera: Camera, predictor: ViewPredictor, cameras: int, *, wide: bool
    ) -> list[_Candidate]:  # fmt: skip
        """Return free states before one of a number of cameras, with what is visible there; with ``wide`` far ones."""
        s = self._settings
        states = self._free(self._proposals(camera, max(1, s.proposals // cameras), wide=wide))
        found = []
        for q in states:
            visible = predictor.visible(camera, q, s.least_cosine)
            shares = tuple(visible[k] for k in self._faces)
            found.append(_Candidate(q, camera, shares, self._duration(q)))
        return found

    def _duration(self, q: Array) -> float:
        """Return the least time of a straight motion to a state at full speed [s]."""
        return float(np.max(np.abs(q - self._state) / self._robot.limits.velocity))

    def _proposals(self, camera: Camera, count: int, *, wide: bool) -> Array:
        """Return the present state and states in which faces are before a camera, shape (N, dof), near ones first.

        With several objects, half of them are states for all, and the others for each alone.
        """
        s, rng = self._settings, self._rng
        every = tuple(self._faces)
        groups = [every] if len(every) == 1 else [every, *((k,) for k in every)]
        found = [] if wide else [self._state]
        for k in range(count):
            group = groups[0] if k % 2 == 0 else groups[(k // 2) % len(groups)]
            far = 1.0 if wide else k / max(count - 1, 1)
            targets = [target for one in group for target in self._targets(camera, self._faces[one], far, rng)]
            inverse_kinematics = self._links.inverse(targets, self._hands)
            start = self._state.copy()
            free = inverse_kinematics.free
            start[free] += s.spread * far * rng.normal(size=len(free))
            start = start.clip(self._lower, self._upper)
            end = inverse_kinematics.descend(start[None], tolerance=1e-2, max_steps=STEPS).states[0]
            found.append(self._robot.turned_to(end, self._state).clip(self._lower, self._upper))
        return np.array(found)

    def _targets(self, camera: Camera, face: LinkFace, far: float, rng: np.random.Generator) -> Iterator[Target]:
        """Yield targets that bring a face before a camera, at a random place that is near its present one.

        Args:
            camera: The camera.
            face: The face.
            far: 0 for the nearest place before the camera, 1 for any.
            rng: Source of the place.
        """
        s = self._settings
        seen = inverse(camera.pose_at(self._robot, self._state)) @ self._robot.link_pose(self._state, face.link)
        point, axis = seen[:3, :3] @ face.point + seen[:3, 3], seen[:3, :3] @ face.axis
        size = np.array([camera.width, camera.height], float)
        low, high = s.border * size, (1.0 - s.border) * size
        ray = camera.focal * point[:2] / point[2] + camera.center if point[2] > 0.1 else size / 2.0
        away, own = float(np.linalg.norm(point)), rng.random(4) * far
        pixel = (1.0 - own[0]) * ray.clip(low, high) + own[0] * rng.uniform(low, high)
        distance = (1.0 - own[1]) * np.clip(away, *s.distance) + own[1] * rng.uniform(*s.distance)
        now = float(np.arccos(np.clip(-(axis @ point) / max(away, 1e-6), -1.0, 1.0)))
        turn = (1.0 - own[2]) * min(now, s.face_angle) + own[2] * rng.uniform(0.0, s.face_angle)
        direction = np.append((pixel - camera.center) / camera.focal, 1.0)
        direction /= np.linalg.norm(direction)
        place, toward = self._of_camera(camera, distance * direction, -direction)
        tip = self._links.point(face.link, face.point)
        yield offset_target(place, tip, weight=POSITION_WEIGHT)
        yield angle_target(self._links.direction(face.link, face.axis), toward, float(np.cos(turn)))

    def _of_camera(self, camera: Camera, point: Array, direction: Array) -> tuple[FixedVector, FixedVector]:
        """Return a point [m] and a direction of the optical frame, shape (3,), where the camera is."""
        pose = camera.pose
        at, along = pose[:3, :3] @ point + pose[:3, 3], pose[:3, :3] @ direction
        if camera.link is None:
            return in_world(at), in_world(along)
        return self._links.point(camera.link, at), self._links.direction(camera.link, along)

    def _free(self, states: Array) -> Array:
        """Return the states that hold the constraints and are free, shape (N, dof)."""
        if self._constraints is not None:
            ends, ok = self._constraints.project(states)
            states = ends[ok]
        return states[self._checker.are_free(states)] if len(states) else states


def _spread_over(found: Sequence[_Candidate], wanted: Sequence[int], count: int) -> list[_Candidate]:
    """Return the candidates from which most is visible: of all objects together, and of each alone."""

    def score(one: _Candidate, k: int) -> float:
        return one.visible[k].surface + FACE_WEIGHT * one.visible[k].face - 0.05 * one.duration

    everyone = range(len(wanted))
    orders = [sorted(range(len(found)), key=lambda n: -min(score(found[n], k) for k in everyone))]
    if len(wanted) > 1:
        orders += [sorted(range(len(found)), key=lambda n, k=k: -score(found[n], k)) for k in everyone]  # type: ignore[misc]
    shares = [count] if len(wanted) == 1 else [count - count // 2, *[count // (2 * len(wanted))] * len(wanted)]
    chosen: dict[int, None] = {}
    for order, share in zip(orders, shares, strict=True):
        new = [n for n in order if n not in chosen]
        chosen.update(dict.fromkeys(new[:share]))
    return [found[n] for n in chosen]


def _look(one: _Candidate, predictor: ViewPredictor, wanted: Sequence[int], settings: LookSettings) -> LookState:
    """Return a candidate with what a fit is expected to find."""
    found = predictor.predicted(one.camera, one.state, settings.frames)
    views = tuple(_view(found[k], seen, settings) for k, seen in zip(wanted, one.visible, strict=True))
    return LookState(one.state, one.camera.name, views, one.duration)


def _view(found: HeldObject, seen: Visible, settings: LookSettings) -> ObjectView:
    place, turn = found.place_spread, found.turn_spread
    enough = not found.reason and place <= settings.place and turn <= settings.turn
    return ObjectView(found.name, seen.surface, seen.face, place, turn, found.reason, enough)


def _cost(one: LookState, settings: LookSettings) -> tuple[int, float]:
    """Return the number of objects that are not seen well enough, and a sum of spreads, hidden shares and the motion.

    The larger the share that is visible, the less it matters that objects are not exactly where they are believed.
    """
    total = settings.motion * one.duration
    for view in one.objects:
        total += max(view.place_spread / settings.place, view.turn_spread / settings.turn)
        total += max(0.0, 1.0 - view.share / WIDE) + (UNSEEN if view.reason else 0.0)
    return len(one.objects) - len(one.names), total
