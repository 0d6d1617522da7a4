"""Settings of a model in MuJoCo, and what is in it by default: servos, masses, joints that mimic others."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field

import numpy as np
import pinocchio as pin

from apex_ompl.collision.mass import held_load
from apex_ompl.collision.shapes import coal_geometry
from apex_ompl.errors import ParameterError
from apex_ompl.robot.dynamics import Load
from apex_ompl.robot.model import Robot
from apex_ompl.scene.bodies import AttachedObject
from apex_ompl.scene.problem import Problem
from apex_ompl.util.validation import check_number, check_positive, finite_numbers

PANDA_EFFORT = (87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0)  # by which the joints of a Panda are known [Nm]
PANDA_STIFFNESS = (4500.0, 4500.0, 3500.0, 3500.0, 2000.0, 2000.0, 2000.0)  # of MuJoCo Menagerie [Nm/rad]
BANDWIDTH = 60.0  # natural frequency of the servos of other joints [rad/s]
PAYLOAD_RADIUS = 0.03  # of the ball that a payload is [m]
LEADER_ARMATURE, LEADER_DAMPING = 0.02, 0.05  # of joints that others mimic, such as the synergy of a hand
LEAST_MASS, LEAST_INERTIA = 1e-3, 1e-6  # of links that move and have none in the URDF [kg, kg m^2]


@dataclass(frozen=True)
class TwinSettings:
    """Settings of a twin. What a robot file does not say is assumed.

    Attributes:
        step: Time step [s].
        gains: Joint name -> stiffness kp [Nm/rad] and damping kd [Nm s/rad] of its servo. By default kp is that of
            Menagerie for the joints of a Panda; for other joints it is m w^2, with w = 60 rad/s and the inertia m of
            the joint in the home state. The damping is critical, kd = 2 sqrt(kp m).
        armature: Inertia of the rotor of each joint, at the joint [kg m^2].
        damping: Viscous friction of each joint [Nm s/rad].
        friction: Coefficient of friction of all surfaces.
        frictionless: Names of held objects without friction, such as the balls of a liquid.
        density: Density of held objects without a mass [kg/m^3].
        floor: Height of the floor, which only objects that fall can touch [m].
        finger_stiffness: Stiffness of springs by which joints that mimic others follow them, so that fingers yield to
            what they grasp, and held objects collide with the hands that hold them [Nm/rad]. Without it such joints
            follow exactly, and held objects only collide with other links.
        grip: Largest torque of the joints that others mimic, where fingers yield [Nm].
    """

    step: float = 0.001
    gains: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    armature: float = 0.1
    damping: float = 1.0
    friction: float = 0.8
    frictionless: Collection[str] = ()
    density: float = 300.0
    floor: float = -0.75
    finger_stiffness: float | None = None
    grip: float = 6.0

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ParameterError: A number is out of its range.
        """
        for name in ("step", "armature", "density", "grip"):
            check_positive(getattr(self, name), name)
        if self.finger_stiffness is not None:
            check_positive(self.finger_stiffness, "finger_stiffness")
        for name in ("damping", "friction"):
            check_number(getattr(self, name), name, 0.0)
        finite_numbers({"floor": self.floor}, "settings")
        for joint, pair in self.gains.items():
            if len(pair) != 2 or not all(math.isfinite(gain) and gain > 0.0 for gain in pair):
                raise ParameterError(f"gains.{joint}", pair, "a stiffness and a damping, both positive")


@dataclass(frozen=True)
class Mimic:
    """A joint that follows another one: q = multiplier * q_leader + offset."""

    joint: str
    leader: str
    multiplier: float
    offset: float


def mimic_joints(urdf: str) -> tuple[Mimic, ...]:
    """Return the joints of a URDF that mimic others, each with a leader that mimics none."""
    found = {}
    for joint in ET.fromstring(urdf).findall("joint"):
        mimic = joint.find("mimic")
        if mimic is not None and joint.get("type") != "fixed":
            name, leader = str(joint.get("name")), str(mimic.get("joint"))
            found[name] = Mimic(name, leader, float(mimic.get("multiplier", 1)), float(mimic.get("offset", 0)))
    for name, own in list(found.items()):
        chain = own
        while (over := found.get(chain.leader)) is not None:
            m, b = chain.multiplier, chain.offset
            chain = Mimic(name, over.leader, m * over.multiplier, m * over.offset + b)
        found[name] = chain
    return tuple(found.values())


def with_mass(held: AttachedObject, density: float) -> AttachedObject:
    """Return a held object with a mass; without one it has that of its shape at a density [kg/m^3]."""
    if held.mass is not None:
        return held
    volume = abs(float(coal_geometry(held).computeVolume()))
    return held.model_copy(update={"mass": max(LEAST_MASS, density * volume)})


def payloads(robot: Robot, problem: Problem) -> tuple[Load, ...]:
    """Return the payload of a problem: balls at the grasp points of hands, or at the origins of links.

    Raises:
        UnknownNameError: There is no such hand or link.
    """
    points = {name: (hand.palm, np.asarray(hand.point)) for name, hand in robot.hands.items()}
    for name in problem.payload:
        robot.link_frame(points.get(name, (name,))[0])
    found = ((*points.get(name, (name, np.zeros(3))), mass) for name, mass in problem.payload.items())
    inertia = 0.4 * PAYLOAD_RADIUS**2 * np.eye(3)
    return tuple(Load(link, mass, point, mass * inertia) for link, point, mass in found)


def held_loads(robot: Robot, problem: Problem, settings: TwinSettings) -> tuple[Load, ...]:
    """Return the masses that the robot holds in a problem: held objects and the payload."""
    loads = (held_load(with_mass(held, settings.density)) for held in problem.attached)
    return (*(load for load in loads if load is not None), *payloads(robot, problem))


def servo_gains(robot: Robot, settings: TwinSettings) -> dict[str, tuple[float, float]]:
    """Return the stiffness and the damping of the servo of each planned joint (:class:`TwinSettings`)."""
    data = robot.model.createData()
    inertia = np.empty(robot.dof)
    inertia[robot.state_order] = np.diag(pin.crba(robot.model, data, robot.to_pinocchio(robot.home)))
    leaders = {one.leader for one in mimic_joints(robot.urdf)}
    found = {}
    for k, name in enumerate(robot.joint_names):
        stem, number = name[:-1], name[-1:]
        rotor = LEADER_ARMATURE if name in leaders else settings.armature
        mass = float(inertia[k]) + rotor
        stiffness = mass * BANDWIDTH**2
        if stem.endswith("joint") and number in "1234567" and robot.effort[k] == PANDA_EFFORT[int(number) - 1]:
            stiffness = PANDA_STIFFNESS[int(number) - 1]
        found[name] = stiffness, 2.0 * math.sqrt(stiffness * mass)
    return found | {name: (float(kp), float(kd)) for name, (kp, kd) in settings.gains.items()}
