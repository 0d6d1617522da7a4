"""What frames of a camera show of a problem: held objects and obstacles, with or without an alignment."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pinocchio as pin

from apex_ompl.perception.alignment import (
    AlignSettings,
    SeenTask,
    _as_seen,
    _camera_reasons,
    _obstacles,
    _tolerance_reasons,
    _vector,
    _wanted,
    vect_align,
)
from apex_ompl.perception.frames import STILL, Frame, mean_frame
from apex_ompl.perception.held import HeldObject, HeldObjectFinder
from apex_ompl.perception.obstacles import ObstacleFinder, SeenObstacle
from apex_ompl.perception.registration import CorrectedFrame, corrected
from apex_ompl.perception.surfaces import RobotSurface, body_surface
from apex_ompl.robot.model import Robot
from apex_ompl.scene.bodies import AttachedObject, pose_fields
from apex_ompl.scene.problem import Alignment
from apex_ompl.types import Array

APART = 22.5  # squared difference of six dimensions that answers of two cameras exceed once in 1000

@dataclass(frozen=True, eq=False)
class Sight:
    """What frames of one camera show.

    Attributes:
        frame: The last frame, with the mean depths of those that were used.
        count: Number of frames that were used.
        camera: Corrected pose of the optical frame in the world, shape (4, 4) [m].
        held: Held objects with their covariances; those that were not found have a reason.
        seen: Obstacles with their covariances.
        reasons: Why there is no task, or what was not found, as sentences.
    """

    frame: Frame
    count: int
    camera: Array
    held: tuple[HeldObject, ...]
    seen: tuple[SeenObstacle, ...]
    reasons: tuple[str, ...]

    def __bool__(self) -> bool:
        """Whether all was found that the problem needs."""
        return not self.reasons

    def as_dict(self) -> dict[str, Any]:
        """Return all numbers as plain data, in meters and radians."""
        return {
            "camera": self.frame.camera.name, "stamp": self.frame.stamp, "frames": self.count,
            "camera_pose": pose_fields(self.camera), "reasons": list(self.reasons),
            "objects": [_held_dict(one) for one in self.held], "obstacles": [_seen_dict(one) for one in self.seen],
        }  # fmt: skip


def _held_dict(one: HeldObject) -> dict[str, Any]:
    found = {"name": one.name, "link": one.body.link, "reason": one.reason, **pose_fields(one.pose)}
    found |= {"face": one.face.tolist(), "axis": one.axis.tolist(), "scale": one.scale.tolist()}
    found |= {"face_spread": one.face_spread, "axis_spread": one.axis_spread, "seen": float(one.seen)}
    return {**found, "points": int(one.points), "covariance": one.covariance.tolist()}


def _seen_dict(one: SeenObstacle) -> dict[str, Any]:
    found = {"kind": one.kind, **pose_fields(one.pose), "size": one.size.tolist(), "place_spread": one.place_spread}
    return {**found, "cut": bool(one.cut), "points": int(one.points), "covariance": one.covariance.tolist()}


def still_frames(frames: Sequence[Frame]) -> list[Frame]:
    """Return the last frames of a sequence in which neither the camera nor the robot moves."""
    last = frames[-1]
    found: list[Frame] = []
    for frame in reversed(frames):
        same = frame.camera == last.camera and frame.joints.keys() == last.joints.keys()
        if not same or any(abs(frame.joints[name] - value) > STILL for name, value in last.joints.items()):
            break
        found.insert(0, frame)
    return found


def see(
    frames: Sequence[Frame], robot: Robot, attached: Sequence[AttachedObject] = (),
    alignment: Alignment | None = None, settings: AlignSettings | None = None,
) -> Sight:  # fmt: skip
    """Return what the last frames of a sequence show in which the robot stands still.

    Args:
        frames: Frames of one camera, with the positions of all joints.
        robot: The robot.
        attached: The objects that it holds, at the poses that grasps give them.
        alignment: What is to be aligned; with two names :func:`vect_align` tells whether they are known well enough.
        settings: The settings.

    Raises:
        ApexError: Frames do not fit together, or lack a joint, or a name is not that of a held object.
    """
    s, shots = settings or AlignSettings(), still_frames(frames)
    frame = mean_frame(shots)
    if alignment is not None and isinstance(alignment.first, str) and isinstance(alignment.second, str):
        task = vect_align(shots, robot, attached, alignment, s)
        return Sight(frame, len(shots), task.camera, task.held, task.seen, task.reasons)
    given = corrected(frame, RobotSurface(robot), s.held.registration, len(shots))
    held = HeldObjectFinder(robot, attached, s.held).find_in(given)
    reasons = [one.reason for one in held if one.reason]
    seen: tuple[SeenObstacle, ...] = ()
    if frame.color is None:
        reasons.append(f"{frame.camera.name!r} gave no colors, without which no obstacle is found")
    elif s.obstacles is not None:
        spread = [2.0 * float(np.sqrt(np.trace(one.covariance[3:, 3:]))) for one in held]
        balls = [
            (one.pose[:3, 3], body_surface(one.body).radius + more) for one, more in zip(held, spread, strict=True)
        ]
        seen = ObstacleFinder(s.obstacles).find(given, frame.color, balls)
    if not held and not seen and not reasons:
        reasons.append(f"{frame.camera.name!r} sees no obstacle of the color")
    return Sight(frame, len(shots), given.registration.pose, held, seen, tuple(reasons))


def align_together(
    views: Sequence[Sequence[Frame]], robot: Robot, attached: Sequence[AttachedObject],
    alignment: Alignment | None = None, settings: AlignSettings | None = None,
) -> SeenTask:  # fmt: skip
    """Return the task that several cameras show; each object and obstacle may be seen by any of them.

    Poses of an object by several cameras are fused by their covariances, with the grasp's counted once. Obstacles of
    all cameras count. A camera that was moved does not, unless all were.

    Args:
        views: Frames of each camera, the robot at rest.
        robot: The robot.
        attached: The objects that it holds, at the poses that grasps give them.
        alignment: What is to be aligned; without it all objects have to be found.
        settings: The settings.

    Raises:
        ApexError: As :func:`vect_align`.
    """
    s = settings or AlignSettings()
    surface, finder = RobotSurface(robot), HeldObjectFinder(robot, attached, s.held)
    named = alignment is not None and isinstance(alignment.first, str) and isinstance(alignment.second, str)
    wanted = _wanted(alignment, [one.name for one in attached], robot) if named else {one.name for one in attached}
    moved: list[str] = []
    each: list[tuple[CorrectedFrame, Frame, tuple[HeldObject, ...]]] = []
    for shots in views:
        frame = mean_frame(shots)
        given = corrected(frame, surface, s.held.registration, len(shots))
        reasons = _camera_reasons(given, frame, robot, s)
        moved += reasons
        if not reasons:
            each.append((given, frame, finder.find_in(given)))
    prior = finder.by_grasp(mean_frame(views[0]))
    held = tuple(_fused([found[k] for _, _, found in each], prior[k]) for k in range(len(attached)))
    reasons = [] if each else moved
    reasons += [one.reason for one in held if one.reason and one.name in wanted]
    chosen = [one for one in held if one.name in wanted]
    if alignment is not None and named and not reasons:
        reasons += _tolerance_reasons(chosen, alignment, s)
    seen: list[SeenObstacle] = []
    for given, frame, _ in each if s.obstacles is not None else ():
        found, missing = _obstacles(given, frame, held, s)
        seen += found
        reasons += missing
    state = (each[0][0].registration.state if each else views[0][-1].state(robot.joint_names))
    links = {one.name: robot.link_pose(state, one.link) for one in attached}
    return SeenTask(
        tuple(reasons), alignment, tuple(_as_seen(one, links[one.name]) for one in held),
        tuple(map(_vector, chosen)) if not reasons else (),
        tuple(one.obstacle(f"seen_{k + 1}", s.margin) for k, one in enumerate(seen)), held, tuple(seen),
        each[0][0].registration.pose if each else views[0][-1].camera.pose_at(robot, state), views[-1][-1].stamp,
    )  # fmt: skip


def _fused(answers: Sequence[HeldObject], prior: HeldObject) -> HeldObject:
    """Return the answer of several cameras on one object, whose grasp alone gives a prior.

    Answers that contradict each other are a reason.
    """
    found = sorted((one for one in answers if not one.reason), key=lambda one: one.face_spread)
    if not found:
        return replace(prior, reason="; ".join(dict.fromkeys(one.reason for one in answers)) or prior.reason)
    best, weak = found[0], np.linalg.inv(prior.covariance)
    information, vector = np.linalg.inv(best.covariance), np.zeros(6)
    for one in found[1:]:
        off = _difference(one, best)
        if off @ np.linalg.solve(one.covariance + best.covariance, off) > APART:
            text = f"{1e3 * np.linalg.norm(off[3:]):.0f} mm and {np.degrees(np.linalg.norm(off[:3])):.0f} degrees"
            return replace(best, reason=f"{best.name!r} is seen {text} apart by two cameras")
        more = np.linalg.inv(one.covariance)
        own = more - weak
        if np.linalg.eigvalsh(own)[0] > 0.0:  # it says more than the grasp in all directions
            information, vector = information + own, vector + more @ off - weak @ _difference(prior, best)
    covariance = np.linalg.inv(information)
    step = covariance @ vector
    pose = best.pose.copy()
    pose[:3, :3] = pin.exp3(step[:3]) @ pose[:3, :3]
    pose[:3, 3] += step[3:]
    return replace(best, pose=pose, covariance=covariance)


def _difference(one: HeldObject, other: HeldObject) -> Array:
    """Return the turn and the shift from a pose to another one in the axes of the world, shape (6,) [rad, m]."""
    turn = pin.log3(one.pose[:3, :3] @ other.pose[:3, :3].T)
    return np.concatenate([turn, one.pose[:3, 3] - other.pose[:3, 3]])
