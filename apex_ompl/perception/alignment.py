"""From frames of a camera to a task: what section III-A of the paper calls vect_align(f).

The objects in the hands are found (:mod:`apex_ompl.perception.held`), their contact faces are the vectors to be
aligned, and obstacles of a color are found (:mod:`apex_ompl.perception.obstacles`). Where something is not known well
enough for the task's tolerance there is no task, but a sentence that says why.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from apex_ompl.errors import ParameterError
from apex_ompl.perception.frames import Frame, mean_frame
from apex_ompl.perception.held import HeldObject, HeldObjectFinder, HeldSettings
from apex_ompl.perception.obstacles import ObstacleFinder, ObstacleSettings, SeenObstacle
from apex_ompl.perception.registration import CorrectedFrame, corrected
from apex_ompl.perception.surfaces import RobotSurface, body_surface, inverse
from apex_ompl.robot.model import Robot
from apex_ompl.scene.bodies import AttachedObject, Obstacle, pose_fields
from apex_ompl.scene.problem import ALIGNMENT_DEFAULTS, Alignment, WorldVector
from apex_ompl.types import Array
from apex_ompl.util.validation import check_number, check_positive

LENGTH = 0.05  # of vectors in the world [m]
MOVED = (np.inf, 10.83, 13.82, 16.27, 18.47, 20.52, 22.46, 24.32)
"""Squared corrections that a camera at its place exceeds once in 1000, by their degrees of freedom (chi-squared)."""
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
    """

    held: HeldSettings = field(default_factory=HeldSettings)
    obstacles: ObstacleSettings | None = field(default_factory=ObstacleSettings)
    most_obstacles: int = 20
    deviations: float = 1.0
    margin: float = 2.0
    least_match: float = 0.8

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ParameterError: A number is out of its range.
        """
        check_positive(self.most_obstacles, "most_obstacles")
        check_positive(self.deviations, "deviations")
        check_number(self.margin, "margin", 0.0)
        check_number(self.least_match, "least_match", 0.0, 1.0)


@dataclass(frozen=True, eq=False)
class SeenTask:
    """What frames give for a task.

    Attributes:
        reasons: Why there is no task, as sentences; empty where there is one.
        alignment: The alignment, of the objects of ``attached``.
        attached: The held objects as they were seen.
        vectors: Contact faces of both objects as vectors in the world; empty without a task.
        obstacles: Obstacles, larger by the margin; of boxes seen from one side it may be too small.
        held: All held objects with their covariances.
        seen: All obstacles with their covariances.
        camera: Corrected pose of the optical frame in the world, shape (4, 4) [m].
        stamp: Time of the last frame [s].
    """

    reasons: tuple[str, ...]
    alignment: Alignment
    attached: tuple[AttachedObject, ...]
    vectors: tuple[WorldVector, ...]
    obstacles: tuple[Obstacle, ...]
    held: tuple[HeldObject, ...]
    seen: tuple[SeenObstacle, ...]
    camera: Array
    stamp: float

    def __bool__(self) -> bool:
        """Whether there is a task."""
        return not self.reasons


def vect_align(
    frames: Frame | Sequence[Frame], robot: Robot, attached: Sequence[AttachedObject], alignment: Alignment,
    settings: AlignSettings | None = None,
) -> SeenTask:  # fmt: skip
    """Return the task that frames of a camera show: faces to be aligned, held objects and obstacles.

    Args:
        frames: A frame, or several of a camera and a robot that stand still, with the positions of all joints.
        robot: The robot.
        attached: The objects that it holds, at the poses that grasps give them.
        alignment: What is to be aligned: the names of two of these objects, or of one and a hand.
        settings: The settings.

    Raises:
        ApexError: A name is not that of a held object, frames do not fit together, or lack a joint.
    """
    s = settings or AlignSettings()
    shots = [frames] if isinstance(frames, Frame) else list(frames)
    frame = mean_frame(shots)
    names = [one.name for one in attached]
    wanted = _wanted(alignment, names, robot)
    surface = RobotSurface(robot)
    given = corrected(frame, surface, s.held.registration, len(shots))
    held = HeldObjectFinder(robot, attached, s.held).find_in(given)
    reasons = [*_camera_reasons(given, frame, robot, s)]
    reasons += [one.reason for one in held if one.reason and one.name in wanted]
    chosen = [one for one in held if one.name in wanted]
    if not reasons:
        reasons += _tolerance_reasons(chosen, alignment, s)
    found: tuple[SeenObstacle, ...] = ()
    if s.obstacles is not None:
        found, missing = _obstacles(given, frame, held, s)
        reasons += missing
    links = {one.name: robot.link_pose(given.registration.state, one.link) for one in attached}
    vectors = tuple(_vector(one) for one in chosen) if not reasons else ()
    return SeenTask(
        tuple(reasons), alignment, tuple(_as_seen(one, links[one.name]) for one in held), vectors,
        tuple(one.obstacle(f"seen_{k + 1}", s.margin) for k, one in enumerate(found)), held, found,
        given.registration.pose, frame.stamp,
    )  # fmt: skip


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


def _tolerance_reasons(chosen: Sequence[HeldObject], alignment: Alignment, settings: AlignSettings) -> list[str]:
    """Return which objects are not known well enough for the tolerance."""
    tolerance = alignment.tolerance or ALIGNMENT_DEFAULTS[alignment.kind][1]
    share, length = settings.deviations * np.sqrt(len(chosen)), min(tolerance.lateral, tolerance.axial)
    reasons = []
    for one in chosen:
        place = float(np.sqrt(np.linalg.eigvalsh(one.face_covariance)[-1]))
        place, turn = share * place, share * one.axis_spread / np.sqrt(2.0)
        if place > length or (one.body.sphere is None and turn > tolerance.angle):
            reasons.append(
                f"{one.name!r} is known to {1e3 * place:.1f} mm and {np.degrees(turn):.1f} degrees only, the tolerance "
                f"is {1e3 * length:.1f} mm and {np.degrees(tolerance.angle):.1f} degrees"
            )
    return reasons


def _obstacles(
    given: CorrectedFrame, frame: Frame, held: Sequence[HeldObject], settings: AlignSettings
) -> tuple[tuple[SeenObstacle, ...], list[str]]:
    """Return the obstacles seen, and why they are not all."""
    name = frame.camera.name
    if frame.color is None:
        return (), [f"{name!r} gave no colors, without which no obstacle is found"]
    balls = [(one.pose[:3, 3], _radius(one)) for one in held]
    found = ObstacleFinder(settings.obstacles).find(given, frame.color, balls)
    reasons = []
    if len(found) > settings.most_obstacles:
        reasons.append(f"{len(found)} obstacles of the color are seen, at most {settings.most_obstacles} are expected")
    cut = sum(one.cut for one in found)
    if cut:
        reasons.append(f"the image of {name!r} cuts {cut} of {len(found)} obstacles")
    return found, reasons


def _radius(one: HeldObject) -> float:
    """Return the radius of a ball around an object's origin that holds it, with two standard deviations [m]."""
    return body_surface(one.body).radius + 2.0 * float(np.sqrt(np.trace(one.covariance[3:, 3:])))


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
