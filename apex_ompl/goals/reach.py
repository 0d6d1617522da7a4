"""Poses that are out of reach by the length of an arm, or since no joint moves the frame: shown, and not tried."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from apex_ompl.constraints.frames import Frame
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import pose_matrix
from apex_ompl.scene.problem import PoseTarget
from apex_ompl.types import Array

ROUNDING = 1e-6  # by which a pose out of reach is farther than the arm is long [m]


def too_far(robot: Robot, pose: PoseTarget, frame: Frame, base: Array, free: NDArray[np.int64]) -> str:
    """Return why a pose is out of reach by the length of the links, or since no joint moves its frame, or nothing.

    A frame that none of the joints moves is taken to be somewhere else.
    The distance between the origins of the first and the last moved joint is at most the sum of the offsets between
    joints in between; an orientation that is given without a free turn places the origin of the last one, and otherwise
    the frame's own.
    """
    model, number = robot.model, robot.link_frame(frame.link)
    whole = pose.orientation is not None and pose.free_turn is None and not frame.axial
    data = model.createData()
    pin.framesForwardKinematics(model, data, robot.to_pinocchio(base))
    chain, joint = list[int](), int(model.frames[number].parentJoint)
    while joint > 0:
        chain.insert(0, joint)
        joint = int(model.parents[joint])
    planned = [int(robot.state_order[model.joints[j].idx_q]) if model.joints[j].nq else -1 for j in chain]
    moved = [k for k, one in enumerate(planned) if one in {*free.tolist()}]
    if not moved:
        return f"{pose.frame} is moved by none of the joints that are planned"
    if any("R" not in model.joints[j].shortname() for j in chain):
        return ""
    first, last = chain[moved[0]], chain[-1]
    length = sum(float(np.linalg.norm(model.jointPlacements[j].translation)) for j in chain[moved[0] + 1 :])
    local = np.array(model.frames[number].placement.homogeneous) @ frame.pose
    wanted, slack = np.asarray(pose.position, float), pose.tolerance.position
    at = pose_matrix(pose.position, pose.orientation or (0.0, 0.0, 0.0, 1.0))
    if whole:
        wanted = (at @ np.linalg.inv(local))[:3, 3]
        slack += pose.tolerance.angle * float(np.linalg.norm(local[:3, 3]))
    else:
        length += float(np.linalg.norm(local[:3, 3]))
    away = at[:3, :3].T @ (data.oMi[first].translation - wanted)
    distance = float(np.linalg.norm(away - np.clip(away, pose.lower, pose.upper)))
    if distance <= length + slack + ROUNDING:
        return ""
    what = pose.frame if last == first or not whole else f"the joint {model.names[last]}"
    return (
        f"{pose.frame} is out of reach: {what} has to be {distance:.3f} m from {model.names[first]}, "
        f"and the links in between are {length:.3f} m long"
    )
