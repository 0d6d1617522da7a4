"""What frames show of a problem: held objects and obstacles, with or without an alignment."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from apex_ompl.errors import ParameterError
from apex_ompl.perception.alignment import AlignSettings, SeenTask, vect_align
from apex_ompl.perception.frames import STILL, Frame, mean_frame
from apex_ompl.perception.held import HeldObject
from apex_ompl.perception.obstacles import SeenObstacle
from apex_ompl.robot.model import Robot
from apex_ompl.scene.bodies import AttachedObject, pose_fields
from apex_ompl.scene.problem import Alignment
from apex_ompl.types import Array


@dataclass(frozen=True, eq=False)
class Sight:
    """What frames of one camera or several show.

    Attributes:
        frames: The last frame of each camera, with the mean depths of those that were used.
        counts: Number of frames of each that were used.
        cameras: Poses of their optical frames in the world, of the last one corrected, each of shape (4, 4) [m].
        task: What was found.
        reasons: Why there is no task, or what was not found, as sentences.
    """

    frames: tuple[Frame, ...]
    counts: tuple[int, ...]
    cameras: tuple[Array, ...]
    task: SeenTask
    reasons: tuple[str, ...]

    def __bool__(self) -> bool:
        """Whether all was found that the problem needs."""
        return not self.reasons

    def as_dict(self) -> dict[str, Any]:
        """Return all numbers as plain data, in meters and radians."""
        parts = zip(self.frames, self.counts, self.cameras, strict=True)
        cameras: list[dict[str, Any]] = [
            dict(pose_fields(pose), name=frame.camera.name, stamp=frame.stamp, frames=count)
            for frame, count, pose in parts
        ]
        return {
            "cameras": cameras,
            "reasons": list(self.reasons), "left_out": list(self.task.left_out),
            "objects": [_held_dict(one) for one in self.task.held],
            "obstacles": [_obstacle_dict(one) for one in self.task.seen],
        }  # fmt: skip


def _held_dict(one: HeldObject) -> dict[str, Any]:
    found: dict[str, Any] = {"name": one.name, "link": one.body.link, "reason": one.reason, **pose_fields(one.pose)}
    found |= {"face": one.face.tolist(), "axis": one.axis.tolist(), "scale": one.scale.tolist()}
    found |= {"face_spread": one.face_spread, "axis_spread": one.axis_spread, "seen": float(one.seen)}
    return {**found, "points": int(one.points), "covariance": one.covariance.tolist()}


def _obstacle_dict(one: SeenObstacle) -> dict[str, Any]:
    found: dict[str, Any] = {
        "kind": one.kind,
        **pose_fields(one.pose),
        "size": one.size.tolist(),
        "place_spread": one.place_spread,
    }
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
    """Return what frames show, of each camera the last ones in which the robot is at rest.

    Args:
        frames: Frames of one camera or several, with the positions of all joints.
        robot: The robot.
        attached: The objects that it holds, at the poses that grasps give them.
        alignment: What is to be aligned; with two names :func:`vect_align` tells whether they are known well enough.
        settings: The settings.

    Raises:
        ApexError: There is no frame, frames do not fit together or lack a joint, or a name is not that of a held
            object.
    """
    if not frames:
        raise ParameterError("frames", 0, "one frame or more")
    names = dict.fromkeys(frame.camera.name for frame in frames)
    views = [still_frames([frame for frame in frames if frame.camera.name == name]) for name in names]
    named = alignment is not None and isinstance(alignment.first, str) and isinstance(alignment.second, str)
    used = [frame for shots in views for frame in shots]
    task = vect_align(used, robot, attached, alignment if named else None, settings)
    means = [mean_frame(shots) for shots in views]
    poses = [frame.camera.pose_at(robot, frame.state(robot.joint_names)) for frame in means[:-1]]
    reasons = list(task.reasons)
    if not attached and not task.seen and not reasons:
        reasons.append(f"no obstacle of the color is seen by {' and '.join(map(repr, names))}")
    counts = tuple(len(shots) for shots in views)
    return Sight(tuple(means), counts, (*poses, task.camera), task, tuple(reasons))
