"""Pose goals: poses in the world for frames of hands, links or held objects."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pinocchio as pin

from apex_ompl.constraints.frames import frame_of
from apex_ompl.constraints.links import Links, in_world
from apex_ompl.goals.alignment import angle
from apex_ompl.kernel import Target, offset_target, opposition_target
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import AttachedObject, pose_matrix
from apex_ompl.scene.problem import PoseTarget
from apex_ompl.types import Array
from apex_ompl.util.forking import ProcessLock

POSITION_WEIGHT = 4.0  # weight of a position error against an angle in inverse kinematics [rad/m]
RESIDUAL = 1e-6  # largest residual at which inverse kinematics ends


class PoseGoal:
    """Poses that frames of a robot reach together; joints that move none of the frames stay as at the start."""

    def __init__(
        self, robot: Robot, poses: Sequence[PoseTarget], attached: Sequence[AttachedObject], start: Array
    ) -> None:  # fmt: skip
        """Find the frames and prepare inverse kinematics.

        Args:
            robot: The robot.
            poses: The poses.
            attached: The held objects.
            start: The start, shape (dof,).

        Raises:
            UnknownNameError: A frame is not a hand, a link or a held object.
        """
        self.robot = robot
        self.poses = tuple(poses)
        self.start = np.clip(start, robot.limits.lower, robot.limits.upper)  # as plans clip it
        held = {a.name: a for a in attached}
        self.frames = tuple(frame_of(robot, pose.frame, held, "frame of a pose") for pose in self.poses)
        self._numbers = [robot.link_frame(frame.link) for frame in self.frames]
        self._data = robot.model.createData()
        self._lock = ProcessLock()  # of the data
        names = [h.synergy for h in robot.hands.values() if h.synergy is not None]
        hands = np.array([robot.joint_names.index(name) for name in names], dtype=np.intp)
        self.inverse = Links.of(robot).inverse(self.targets(), hands)

    def placements(self, q: Array) -> list[Array]:
        """Return the poses of the frames in the world at a state, shape (4, 4) each [m]."""
        with self._lock:
            pin.framesForwardKinematics(self.robot.model, self._data, self.robot.to_pinocchio(np.asarray(q, float)))
            links = [np.array(self._data.oMf[number].homogeneous) for number in self._numbers]
        return [link @ frame.pose for link, frame in zip(links, self.frames, strict=True)]

    def errors(self, q: Array) -> dict[str, float]:
        """Return the error terms at a state, shape (dof,): distances [m] and angles [rad]."""
        errors = {}
        for pose, frame, found in zip(self.poses, self.frames, self.placements(q), strict=True):
            errors[f"position of {pose.frame}"] = float(np.linalg.norm(found[:3, 3] - pose.position))
            if pose.orientation is not None:
                wanted = pose_matrix(pose.position, pose.orientation)[:3, :3]
                turned = angle(found[:3, 2], wanted[:, 2]) if frame.axial else rotation_angle(found[:3, :3], wanted)
                errors[f"angle of {pose.frame}"] = turned
        return errors

    @property
    def bounds(self) -> dict[str, float]:
        """Tolerance of each error term: distances [m] and angles [rad]."""
        bounds = {}
        for pose in self.poses:
            bounds[f"position of {pose.frame}"] = pose.tolerance.position
            bounds[f"angle of {pose.frame}"] = pose.tolerance.angle
        return bounds

    def targets(self) -> list[Target]:
        """Return the residuals of inverse kinematics; distances are weighted by ``POSITION_WEIGHT``."""
        links, targets = Links.of(self.robot), []
        for pose, frame in zip(self.poses, self.frames, strict=True):
            point = links.point(frame.link, frame.pose[:3, 3])
            targets.append(offset_target(in_world(pose.position), point, weight=POSITION_WEIGHT))
            if pose.orientation is None:
                continue
            wanted = pose_matrix(pose.position, pose.orientation)[:3, :3]
            for k in (2,) if frame.axial else (0, 2):
                axis = links.direction(frame.link, frame.pose[:3, k])
                targets.append(opposition_target(axis, in_world(wanted[:, k]), -1.0))
        return targets

    def nearest(self, q: Array) -> Array:
        """Return the result of inverse kinematics from a state, shape (dof,); it need not reach the poses."""
        found: Array = self.inverse.descend(np.asarray(q, float), tolerance=RESIDUAL).states[0]
        return found


def rotation_angle(first: Array, second: Array) -> float:
    """Return the angle of the rotation from one orientation to another, each of shape (3, 3) [rad]."""
    return float(np.linalg.norm(pin.log3(first.T @ second)))
