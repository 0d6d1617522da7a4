"""Figures of motions that benchmarks/timing/motions.py reports: smoothness, torque, and whether a motion is valid."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pinocchio as pin

from apex_ompl.goals.alignment import within
from apex_ompl.ompl.setup import PlanningSetup, workspace_goal
from apex_ompl.ompl.validity import full_check
from apex_ompl.robot import Robot
from apex_ompl.robot.model import Limits
from apex_ompl.timing import Trajectory
from apex_ompl.timing.trajectory import ROUNDING
from apex_ompl.types import Array

ARMS = 14  # the first joints of the robot of the suites
PULSE = 0.3  # share of the acceleration limit
TORQUE_SPACING = 0.002  # of the states at which the torque is computed [s]


class Smoothness(NamedTuple):
    """Smoothness of a motion.

    Attributes:
        pulses: Number of intervals in which |a| > 0.3 a_max without change of sign, a second, shape (joints,).
        rms_jerk: Root mean square over time and joints of j / j_max.
        knots: Number of knots a second.
    """

    pulses: Array
    rms_jerk: float
    knots: float


def smoothness(motion: Trajectory, limits: Limits, joints: int = ARMS) -> Smoothness:
    """Return the smoothness of a motion's first joints.

    Between knots the acceleration is linear. So an interval that starts or ends there starts or ends between a knot
    that is in it and one that is not, and the knots alone tell the number of intervals.
    """
    share = motion.accelerations[:, :joints] / limits.acceleration[:joints]
    pulses = np.zeros(share.shape[1])
    for inside in (share > PULSE, share < -PULSE):
        pulses += inside[0] + (inside[1:] & ~inside[:-1]).sum(axis=0)
    squares = np.mean((motion.jerks[:, :joints] / limits.jerk[:joints]) ** 2, axis=1)
    rms = float(np.sqrt(squares @ np.diff(motion.times) / motion.duration))
    return Smoothness(pulses / motion.duration, rms, (len(motion.times) - 1) / motion.duration)


def loaded_model(robot: Robot, payload: float) -> pin.Model:
    """Return the robot's model with a point mass [kg] at the grasp point of each hand."""
    model = pin.Model(robot.model)
    for hand in robot.hands.values():
        frame = model.frames[robot.link_frame(hand.palm)]
        point = frame.placement.act(np.array(hand.point))
        held = pin.Inertia(payload, point, np.zeros((3, 3)))
        model.inertias[frame.parentJoint] = model.inertias[frame.parentJoint] + held
    return model


def torque_use(motion: Trajectory, robot: Robot, payload: float, joints: int = ARMS) -> float:
    """Return the largest share of the torque limits of the first joints, by Pinocchio's recursive Newton-Euler.

    Args:
        motion: The motion of the robot's joints.
        robot: The robot.
        payload: Mass at the grasp point of each hand [kg].
        joints: Number of joints.
    """
    model = loaded_model(robot, payload)
    data, columns = model.createData(), robot.to_pinocchio(np.arange(robot.dof, dtype=float)).astype(int)
    chosen = columns < joints
    states = motion.sample(TORQUE_SPACING)
    rows = zip(states.position[:, columns], states.velocity[:, columns], states.acceleration[:, columns], strict=True)
    torques = np.array([pin.rnea(model, data, *row)[chosen] for row in rows])
    return float((np.abs(torques) / model.effortLimit[chosen]).max())


def motion_fault(setup: PlanningSetup, motion: Trajectory, limits: Limits) -> str:
    """Return why a motion is no solution, or an empty text; checked by a checker of the benchmark's own.

    Args:
        setup: The problem, assembled anew.
        motion: The motion.
        limits: Limits that it has to keep.
    """
    over = [f"{name} {share:.6f}" for name, share in motion.use(limits).items() if share > 1.0 + ROUNDING]
    if over:
        return f"over the limits: {', '.join(over)}"
    if np.abs(motion.velocities[[0, -1]]).max() > ROUNDING or np.abs(motion.accelerations[[0, -1]]).max() > ROUNDING:
        return "the motion is not from rest to rest"
    goal = workspace_goal(setup.robot, setup.problem)
    if goal is not None and not within(goal.errors(motion.positions[-1]), goal.bounds):
        return "the motion does not end at the goal"
    return full_check(setup.checker, motion, setup.start, setup.goals if goal is None else ()).reason
