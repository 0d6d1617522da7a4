"""Jaws of parallel grippers in MuJoCo: links that slide between open and closed, in step, by the force of a motor.

Plans keep such grippers open. A motor pushes each jaw against a damper, so that jaws that touch nothing go at
:data:`SPEED`, and those that do press with the force of the hand. The jaws of a hand are coupled, as by its gear.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from apex_ompl.robot.model import Robot

SPEED = 0.1  # of jaws that nothing stops, as that of a Franka hand [m/s]
ARMATURE = 0.5  # of the motor, at the jaw [kg]
MASS, INERTIA = 0.015, 1e-6  # of jaws that have none in the URDF [kg, kg m^2]
RIGID = {"solref": [0.002, 1.0], "solimp": [0.99, 0.999, 0.001, 0.5, 2.0]}  # of limits, mimic joints and welds


def jaw_joint(link: str) -> str:
    """Return the name of the joint, and of the motor, of a jaw."""
    return f"{link} jaw"


def add_jaws(mj: Any, spec: Any, robot: Robot) -> int:
    """Let the jaws of all hands slide, and return the number of equalities that couple them.

    Args:
        mj: The package ``mujoco``.
        spec: A model with the links of the robot, fixed where the hands are open.
        robot: The robot.
    """
    count = 0
    for hand in robot.hands.values():
        first: tuple[str, float] | None = None
        for link, way in hand.jaws.items():
            body, name, length = spec.body(link), jaw_joint(link), float(np.linalg.norm(way))
            if not body.mass > 0.0:
                body.mass, body.inertia, body.explicitinertial = MASS, [INERTIA] * 3, True
                body.ipos = np.zeros(3)
            joint = body.add_joint(name=name, type=mj.mjtJoint.mjJNT_SLIDE, axis=np.asarray(way) / length)
            joint.limited, joint.range, joint.armature = 1, [0.0, length], ARMATURE
            joint.solref_limit, joint.solimp_limit = RIGID["solref"], RIGID["solimp"]
            damping = hand.force / SPEED
            joint.damping = [damping, 0.0, 0.0] if np.ndim(joint.damping) else damping
            spec.add_actuator(name=name, trntype=mj.mjtTrn.mjTRN_JOINT, target=name)
            if first is None:
                first = name, length
                continue
            equality = spec.add_equality(name=name, type=mj.mjtEq.mjEQ_JOINT, objtype=mj.mjtObj.mjOBJ_JOINT)
            equality.name1, equality.name2 = name, first[0]
            equality.data[:5] = [0.0, length / first[1], 0.0, 0.0, 0.0]
            equality.solref, equality.solimp = RIGID["solref"], RIGID["solimp"]
            count += 1
    return count


def set_jaws(model: Any, data: Any, robot: Robot, hand: str, closed: bool) -> None:
    """Close or open the jaws of a hand by its force."""
    record = robot.hands[hand]
    for link in record.jaws:
        data.ctrl[model.actuator(jaw_joint(link)).id] = record.force if closed else -record.force
