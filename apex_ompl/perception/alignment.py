"""From frames of a camera to a task: what section III-A of the paper calls vect_align(f).

The objects in the hands are found (:mod:`apex_ompl.perception.held`), their contact faces are the vectors to be
aligned, and obstacles of a color are found (:mod:`apex_ompl.perception.obstacles`). Where something is not known well
enough for the task's tolerance there is no task, but a sentence that says why, and states from which a camera sees it
(:mod:`apex_ompl.perception.looking`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from apex_ompl.errors import ParameterError
from apex_ompl.perception.frames import Frame, looks_of, mean_frame
from apex_ompl.perception.fusion import Sighting, fused
from apex_ompl.perception.held import HeldObject, HeldObjectFinder
from apex_ompl.perception.held_settings import HeldSettings
from apex_ompl.perception.looking import LookSettings, LookState, World, look_states
from apex_ompl.perception.obstacle_settings import ObstacleSettings
from apex_ompl.perception.obstacles import ObstacleFinder, SeenObstacle
from apex_ompl.perception.registration import CorrectedFrame, corrected
from apex_ompl.perception.surfaces import RobotSurface, body_box, inverse
from apex_ompl.robot.model import Robot
from apex_ompl.scene.bodies import AttachedObject, Obstacle, pose_fields
from apex_ompl.scene.constraints import Constraint
from apex_ompl.scene.problem import ALIGNMENT_DEFAULTS, Alignment, WorldVector
from apex_ompl.types import Array
from apex_ompl.util.validation import check_integer, check_number, check_positive

LENGTH = 0.05  # of vectors in the world [m]
MOVED = (np.inf, 10.83, 13.82, 16.27, 18.47, 20.52, 22.46, 24.32)
"""Squared corrections that a camera at its place exceeds once in 1000, by their degrees of freedom (chi-squared)."""
LOOKED = 0.7  # share of the largest standard deviations that a look is expected to leave
FEWEST = 60  # pixels of the robot that tell whether the camera is at its place


@dataclass(frozen=True)
class AlignSettings:
    """How an alignment is looked for.

    Attributes:
        held: Settings of held objects.
        obstacles: What obstacles look like, or None where none are looked for.
        most_obstacles: Number of obstacles above which the task is ambiguous.
        deviations: Standard deviations of the faces that have to be within the tolerance.
        margin: Standard deviations by which obstacles grow.
        least_match: Share of the robot's visible surface that has to be where it is expected.
        look: How states to look from are sought; their standard deviations follow from the tolerance.
    """

    held: HeldSettings = field(default_factory=HeldSettings)
    obstacles: ObstacleSettings | None = field(default_factory=ObstacleSettings)
    most_obstacles: int = 20
    deviations: float = 1.0
    margin: float = 2.0
    least_match: float = 0.8
    look: LookSettings = field(default_factory=LookSettings)

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ParameterError: A number is out of its range.
        """
        check_integer(self.most_obstacles, "most_obstacles", 1)
        check_positive(self.deviations, "deviations")
        check_number(self.margin, "margin", 0.0)
        check_number(self.least_match, "least_match", 0.0, 1.0)


@dataclass(frozen=True, eq=False)
class SeenTask:
    """What frames give for a task.

    Attributes:
        reasons: Why there is no task, as sentences; empty where there is one.
        alignment: The alignment, of the objects of ``attached``, where there is one.
        attached: The held objects as they were seen.
        vectors: Contact faces of both objects as vectors in the world; empty without a task.
        obstacles: Obstacles, larger by the margin.
        held: All held objects with their covariances.
        seen: All obstacles with their covariances.
        camera: Corrected pose of the optical frame in the world, shape (4, 4) [m].
        stamp: Time of the last frame [s].
        looks: States from which what is not known well enough can be seen, the best first; empty where all is known, or
            no world was given.
        left_out: Why looks of cameras that cannot be trusted do not count, as sentences.
    """

    reasons: tuple[str, ...]
    alignment: Alignment | None
    attached: tuple[AttachedObject, ...]
    vectors: tuple[WorldVector, ...]
    obstacles: tuple[Obstacle, ...]
    held: tuple[HeldObject, ...]
    seen: tuple[SeenObstacle, ...]
    camera: Array
    stamp: float
    looks: tuple[LookState, ...] = ()
    left_out: tuple[str, ...] = ()

    def __bool__(self) -> bool:
        """Whether there is a task."""
        return not self.reasons


def vect_align(
    frames: Frame | Sequence[Frame], robot: Robot, attached: Sequence[AttachedObject], alignment: Alignment | None,
    settings: AlignSettings | None = None, *, world: World = None, constraints: Sequence[Constraint] = (),
) -> SeenTask:  # fmt: skip
    """Return the task that frames show: faces to be aligned, held objects and obstacles.

    Frames of a camera and a robot at rest are one look. Looks in several states and of several cameras are fused, but
    for those whose camera cannot be trusted; all is returned where it is in the state of the last frame.

    Args:
        frames: A frame, or several, with the positions of all joints.
        robot: The robot.
        attached: The objects that it holds, at the poses that grasps give them.
        alignment: What is to be aligned: the names of two of these objects, or of one and a hand. Without one all
            objects have to be found.
        settings: The settings.
        world: What states to look from are free of: a checker, a planner's world or obstacles. Without one no states
            are sought.
        constraints: What has to hold in these states.

    Raises:
        ApexError: A name is not that of a held object, frames do not fit together, or lack a joint.
    """
    s = settings or AlignSettings()
    shots = [frames] if isinstance(frames, Frame) else list(frames)
    names = [one.name for one in attached]
    wanted = {*names} if alignment is None else _wanted(alignment, names, robot)
    surface = RobotSurface(robot)
    finder = HeldObjectFinder(robot, attached, s.held, surface)
    looks = [_look(own, finder, surface, s) for own in looks_of(shots)]
    trusted = [look for look in looks if not look.reasons]
    untrusted = tuple(reason for look in looks for reason in look.reasons)
    now, used = looks[-1].seen.registration, trusted or looks
    links = [robot.link_pose(now.state, one.link) for one in attached]
    held = tuple(
        fused([Sighting(look.held[k], robot.link_pose(look.seen.registration.state, one.link), look.seen)
               for look in used], links[k], s.held)
        for k, one in enumerate(attached)
    )  # fmt: skip
    chosen = [one for one in held if one.name in wanted]
    unknown = {one.name: why for one in chosen if (why := one.reason or _tolerance_reason(one, chosen, alignment, s))}
    reasons = [*unknown.values()] if trusted else [*untrusted, *(one.reason for one in chosen if one.reason)]
    found: tuple[SeenObstacle, ...] = ()
    if s.obstacles is not None:
        found, missing = _obstacles(used, s)
        reasons += missing
    seen = tuple(_as_seen(one, link) for one, link in zip(held, links, strict=True))
    states: tuple[LookState, ...] = ()
    sought = [one.name for one in chosen if one.name in unknown and one.body.contact is not None]
    if world is not None and trusted and sought:
        place, turn = (s.look.place, s.look.turn) if alignment is None else _limits(alignment, len(chosen), s)
        cameras = {look.frame.camera.name: look.frame.camera for look in trusted}
        reported = [look.frame.state(robot.joint_names) for look in looks]
        states = look_states(
            robot, seen, sought, list(cameras.values()), reported[-1], world=world, held=s.held, avoided=reported,
            constraints=constraints, surface=surface,
            settings=replace(s.look, place=LOOKED * place, turn=LOOKED * turn, seed=s.look.seed + len(looks)),
        )  # fmt: skip
        if not states:
            reasons.append(f"no free state was found from which a camera sees {' or '.join(map(repr, sought))}")
    vectors = tuple(_vector(one) for one in chosen) if not reasons else ()
    obstacles = tuple(one.obstacle(f"seen_{k + 1}", s.margin) for k, one in enumerate(found))
    return SeenTask(
        tuple(reasons), alignment, seen, vectors, obstacles, held, found, now.pose, shots[-1].stamp, states,
        untrusted if trusted else (),
    )  # fmt: skip


class _Look(NamedTuple):
    """A look: the mean of its frames, its corrected depths, what it found, and why its camera cannot be trusted."""

    frame: Frame
    seen: CorrectedFrame
    held: tuple[HeldObject, ...]
    reasons: tuple[str, ...]


def _look(
    frames: Sequence[Frame], finder: HeldObjectFinder, surface: RobotSurface, settings: AlignSettings
) -> _Look:  # fmt: skip
    """Return the look that frames of a camera and a robot at rest are."""
    frame = mean_frame(frames)
    seen = corrected(frame, surface, settings.held.registration, len(frames))
    return _Look(frame, seen, finder.find_in(seen), tuple(_camera_reasons(seen, frame, finder.robot, settings)))


def _wanted(alignment: Alignment, names: Sequence[str], robot: Robot) -> set[str]:
    """Return the names of the objects that an alignment is about.

    Raises:
        ParameterError: A name is not that of a held object or a hand, or two objects have it.
    """
    wanted = set()
    for side in ("first", "second"):
        named = getattr(alignment, side)
        if not isinstance(named, str):
            raise ParameterError(
                f"alignment.{side}", "a vector", "the name of a held object, which the camera is to find"
            )
        if names.count(named) > 1:
            raise ParameterError(f"alignment.{side}", named, f"one object of that name, not {names.count(named)}")
        if named in names:
            wanted.add(named)
        elif named not in robot.hands:
            raise ParameterError(
                f"alignment.{side}",
                named,
                f"one of {', '.join([*names, *robot.hands]) or 'the held objects and hands, of which there is none'}",
            )
    return wanted


def _camera_reasons(given: CorrectedFrame, frame: Frame, robot: Robot, settings: AlignSettings) -> list[str]:
    """Return why the camera's pose cannot be trusted."""
    name, found = frame.camera.name, given.registration
    if not np.any(given.depth):
        return [f"{name!r} measured no depth at all"]
    if settings.held.registration is None:
        return []
    if found.pixels + found.apart < FEWEST:
        return [f"{name!r} does not see enough of the robot to tell whether it is where it was calibrated"]
    share = found.pixels / (found.pixels + found.apart)
    off = inverse(frame.camera.pose_at(robot, found.state)) @ found.pose
    turn = np.arccos(np.clip((np.trace(off[:3, :3]) - 1.0) / 2.0, -1.0, 1.0))
    shift = float(np.linalg.norm(off[:3, 3]))
    if share >= settings.least_match and found.surprise < MOVED[found.freedoms]:
        return []
    return [
        f"{name!r} has moved since it was calibrated: {100 * share:.0f} % of the robot's surface is where it is "
        f"expected, after a correction of {1e3 * shift:.0f} mm and {np.degrees(turn):.1f} degrees"
    ]


def _limits(alignment: Alignment, count: int, settings: AlignSettings) -> tuple[float, float]:
    """Return the largest standard deviations of a face [m] and an axis [rad], of a number of faces."""
    tolerance = alignment.tolerance or ALIGNMENT_DEFAULTS[alignment.kind][1]
    share = settings.deviations * float(np.sqrt(count))
    return min(tolerance.lateral, tolerance.axial) / share, tolerance.angle / share


def _tolerance_reason(
    one: HeldObject, chosen: Sequence[HeldObject], alignment: Alignment | None, settings: AlignSettings
) -> str:  # fmt: skip
    """Return why an object is not known well enough for the tolerance, or an empty text."""
    if alignment is None:
        return ""
    place, turn = _limits(alignment, len(chosen), settings)
    if one.place_spread <= place and one.turn_spread <= turn:
        return ""
    share = settings.deviations * float(np.sqrt(len(chosen)))
    return (
        f"{one.name!r} is known to {1e3 * share * one.place_spread:.1f} mm and "
        f"{np.degrees(share * one.turn_spread):.1f} degrees only, the tolerance is {1e3 * share * place:.1f} mm and "
        f"{np.degrees(share * turn):.1f} degrees"
    )


def _obstacles(looks: Sequence[_Look], settings: AlignSettings) -> tuple[tuple[SeenObstacle, ...], list[str]]:
    """Return the obstacles of all looks, and why they are not all."""
    colored = [look for look in looks if look.frame.color is not None]
    if not colored:
        return (), [f"{looks[-1].frame.camera.name!r} gave no colors, without which no obstacle is found"]
    finder, found, reasons = ObstacleFinder(settings.obstacles), list[SeenObstacle](), []
    for look in colored:
        boxes = [(one.pose, _box(one)) for one in look.held]
        assert look.frame.color is not None
        for new in finder.find(look.seen, look.frame.color, boxes):
            known = next((k for k, one in enumerate(found) if _same(one, new)), None)
            if known is None:
                found.append(new)
            elif (new.cut, new.place_spread) < (found[known].cut, found[known].place_spread):
                found[known] = new
    if len(found) > settings.most_obstacles:
        reasons.append(f"{len(found)} obstacles of the color are seen, at most {settings.most_obstacles} are expected")
    cut = sum(one.cut for one in found)
    if cut:
        reasons.append(f"the image of {colored[-1].frame.camera.name!r} cuts {cut} of {len(found)} obstacles")
    return tuple(found), reasons


def _same(first: SeenObstacle, second: SeenObstacle) -> bool:
    """Whether obstacles of two looks are one: their centers are nearer than half of their sizes."""
    apart = float(np.linalg.norm(first.pose[:3, 3] - second.pose[:3, 3]))
    return apart < 0.5 * min(float(np.max(first.size)), float(np.max(second.size)))


def _box(one: HeldObject) -> Array:
    """Return the box around an object in its frame, with two standard deviations of its place [m]."""
    return body_box(one.body, 2.0 * float(np.sqrt(np.trace(one.covariance[3:, 3:]))))


def _vector(one: HeldObject) -> WorldVector:
    """Return the contact face of an object as a vector in the world."""
    tip, tail = one.face, one.face - LENGTH * one.axis
    return WorldVector(link=one.body.link, tail=(tail[0], tail[1], tail[2]), tip=(tip[0], tip[1], tip[2]))


def _as_seen(one: HeldObject, link: Array) -> AttachedObject:
    """Return an object at the pose and of the size at which it was seen, on its link at a pose, shape (4, 4) [m]."""
    body, (x, y, z) = one.body, one.scale.tolist()
    changes: dict[str, object] = dict(pose_fields(inverse(link) @ one.pose))
    if body.contact is not None:
        point = tuple((np.array(body.contact.point) * one.scale).tolist())
        changes["contact"] = body.contact.model_copy(update={"point": point})
    if body.box is not None:
        changes["box"] = (body.box[0] * x, body.box[1] * y, body.box[2] * z)
    for kind in ("sphere", "cylinder", "capsule"):
        shape = getattr(body, kind)
        if shape is not None:
            larger = {"radius": shape.radius * x} | ({"length": shape.length * z} if kind != "sphere" else {})
            changes[kind] = shape.model_copy(update=larger)
    if body.mesh is not None:
        a, b, c = body.mesh.scale
        changes["mesh"] = body.mesh.model_copy(update={"scale": (a * x, b * y, c * z)})
    return body.model_copy(update=changes)
