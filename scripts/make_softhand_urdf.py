"""Write the URDFs of the right and left qb SoftHand2 Research from a table of its dimensions.

The hand has 19 joints (5 abductions, 14 flexions), all driven by one synergy (0 open, 1 closed) through
mimic joints. Dimensions are those of the maker's open description of the hand; each pair of rolling
half joints, 13 mm apart, is modeled by one hinge in the middle of the pair. Geometry is primitives: a palm
box, a flange cylinder, and capsules whose ends lie on the joint axes, so that each hand is one connected
solid at every synergy. The left hand is the mirror image (x -> -x) of the right one.

Usage: python scripts/make_softhand_urdf.py [--out apex_ompl/robot/data]
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pinocchio as pin
from scipy.spatial.transform import Rotation

from apex_ompl.util.entry_point import run_script

RADIUS = 0.007
HALF_GAP = 0.0065  # half the distance between the two rolling halves of a joint [m]
MEDIUM, SHORT, DISTAL = 0.017, 0.009, 0.0225
FLEXION_RATIO = 1.57
ABDUCTION_LIMIT = 0.524
SYNERGY_VELOCITY = 1.5  # [1/s], assumed: about one second from open to closed
PALM_XYZ, PALM_RPY = (-0.0045, 0.0145, 0.144), (1.57, 0.0, 0.0)
PALM_BOX_MIN, PALM_BOX_MAX = np.array([-0.050, -0.102, -0.008]), np.array([0.050, 0.012, 0.040])
FLANGE_RADIUS, FLANGE_Z = 0.0355, (-0.0055, 0.055)
MASSES = {"flange": 0.16, "palm": 0.55, "phalanx": 0.012}
MIRROR = np.diag([-1.0, 1.0, 1.0])


@dataclass(frozen=True)
class Finger:
    """A finger: where its knuckle sits in the palm, how far it abducts, and its phalanges."""

    name: str
    knuckle_xyz: tuple[float, float, float]
    knuckle_rpy: tuple[float, float, float]
    knuckle_axis: tuple[float, float, float]
    abduction_ratio: float
    abduction_range: tuple[float, float]
    first_xyz: tuple[float, float, float]
    first_rpy: tuple[float, float, float]
    bodies: tuple[tuple[str, float], ...]
    knuckle_geometry: bool


def _finger(name: str, xyz: tuple[float, float, float], ratio: float, first: float) -> Finger:
    lengths = (("proximal", first), ("middle", SHORT), ("distal", DISTAL))
    return Finger(
        name, xyz, (0.0, 0.0, 1.57), (0.0, 0.0, 1.0), ratio, (-ABDUCTION_LIMIT, ABDUCTION_LIMIT),
        (0.009, 0.0, 0.0), (1.57, 0.0, 0.0), lengths, False,
    )  # fmt: skip


FINGERS = (
    Finger(
        "thumb", (-0.044, -0.0465, -0.002), (-1.57, 3.14, 0.0), (0.0, 0.0, -1.0), 1.571, (0.0, 1.571),
        (0.0255, -0.0038, -0.0001), (-1.1415, 0.0, 0.0), (("proximal", SHORT), ("distal", DISTAL)), True,
    ),
    _finger("index", (-0.02, -0.007, 0.014), -0.2, MEDIUM),
    _finger("middle", (0.0, 0.0, 0.014), 0.0, MEDIUM),
    _finger("ring", (0.02, -0.007, 0.014), 0.2, MEDIUM),
    _finger("little", (0.04, -0.012, 0.014), 0.4, SHORT),
)  # fmt: skip


class HandWriter:
    """Collects links and joints of one hand, mirrored when it is a left one."""

    def __init__(self, side: str) -> None:
        """Start an empty hand; ``side`` is ``right`` or ``left``."""
        self.mirror = side == "left"
        self.root = ET.Element("robot", name=f"softhand2_{side}", version="1.2")
        self.root.append(ET.Comment(" made by scripts/make_softhand_urdf.py "))

    def origin(self, parent: ET.Element, xyz: object, rotation: Rotation) -> None:
        """Append an origin, mirrored: p -> M p and R -> M R M."""
        p, matrix = np.asarray(xyz, float), rotation.as_matrix()
        if self.mirror:
            p, matrix = MIRROR @ p, MIRROR @ matrix @ MIRROR
        rpy = pin.rpy.matrixToRpy(matrix)
        ET.SubElement(parent, "origin", xyz=_numbers(p), rpy=_numbers(rpy))

    def link(self, name: str, mass: float, size: float) -> ET.Element:
        """Append a link with the inertia of a solid sphere of radius ``size``."""
        link = ET.SubElement(self.root, "link", name=name)
        inertial = ET.SubElement(link, "inertial")
        ET.SubElement(inertial, "mass", value=f"{mass:.6g}")
        moment = f"{0.4 * mass * size**2:.6g}"
        ET.SubElement(inertial, "inertia", ixx=moment, iyy=moment, izz=moment, ixy="0", ixz="0", iyz="0")
        return link

    def shape(self, link: ET.Element, xyz: object, rotation: Rotation, kind: str, **size: str) -> None:
        """Append the same primitive as visual and as collision geometry."""
        for role in ("visual", "collision"):
            element = ET.SubElement(link, role)
            self.origin(element, xyz, rotation)
            ET.SubElement(ET.SubElement(element, "geometry"), kind, **size)

    def capsule(self, link: ET.Element, end: object) -> None:
        """Append a capsule from the link's origin to ``end``."""
        end = np.asarray(end, float)
        length = float(np.linalg.norm(end))
        rotation, _ = Rotation.align_vectors([end / length], [[0.0, 0.0, 1.0]])
        self.shape(link, end / 2, rotation, "capsule", radius=f"{RADIUS}", length=f"{length:.6g}")

    def joint(self, name: str, kind: str, parent: str, child: str, *, xyz: object, rpy: object) -> ET.Element:
        """Append a joint between two links."""
        joint = ET.SubElement(self.root, "joint", name=name, type=kind)
        self.origin(joint, xyz, Rotation.from_euler("xyz", rpy))
        ET.SubElement(joint, "parent", link=parent)
        ET.SubElement(joint, "child", link=child)
        return joint

    def hinge(self, joint: ET.Element, axis: object, ratio: float, limits: tuple[float, float]) -> None:
        """Make ``joint`` a hinge that follows the synergy; a mirrored axis is -M a."""
        direction = np.asarray(axis, float)
        if self.mirror:
            direction = -MIRROR @ direction
        ET.SubElement(joint, "axis", xyz=_numbers(direction))
        ET.SubElement(
            joint, "limit", lower=f"{limits[0]}", upper=f"{limits[1]}", effort="1",
            velocity=f"{SYNERGY_VELOCITY * max(abs(ratio), 1e-3):.6g}",
        )  # fmt: skip
        ET.SubElement(joint, "mimic", joint="synergy", multiplier=f"{ratio}", offset="0")

    def finger(self, finger: Finger) -> None:
        """Append a finger: knuckle, then one hinge and one capsule for each phalanx."""
        parent = f"{finger.name}_knuckle"
        knuckle = self.link(parent, MASSES["phalanx"], RADIUS)
        joint = self.joint(
            f"{finger.name}_abduction", "revolute", "palm", parent, xyz=finger.knuckle_xyz, rpy=finger.knuckle_rpy
        )
        self.hinge(joint, finger.knuckle_axis, finger.abduction_ratio, finger.abduction_range)
        xyz = np.asarray(finger.first_xyz) + np.array([HALF_GAP, 0.0, 0.0])
        rpy = finger.first_rpy
        if finger.knuckle_geometry:
            self.capsule(knuckle, xyz)
        for k, (body, length) in enumerate(finger.bodies):
            last = k == len(finger.bodies) - 1
            reach = length + (1 if last else 2) * HALF_GAP
            name = f"{finger.name}_{body}"
            link = self.link(name, MASSES["phalanx"], RADIUS)
            self.capsule(link, [reach - (RADIUS if last else 0.0), 0.0, 0.0])
            joint = self.joint(f"{name}_flexion", "revolute", parent, name, xyz=xyz, rpy=rpy)
            self.hinge(joint, (0.0, 0.0, -1.0), FLEXION_RATIO, (0.0, FLEXION_RATIO))
            parent, xyz, rpy = name, np.array([reach, 0.0, 0.0]), (0.0, 0.0, 0.0)


def _numbers(values: object) -> str:
    return " ".join(f"{v + 0.0:.9g}" for v in np.round(np.asarray(values, float), 12))


def hand_urdf(side: str) -> str:
    """Return the URDF of one hand as text; ``side`` is ``right`` or ``left``."""
    writer = HandWriter(side)
    none = Rotation.identity()
    base = writer.link("base", MASSES["flange"], FLANGE_RADIUS)
    low, high = FLANGE_Z
    writer.shape(
        base, [0, 0, (low + high) / 2], none, "cylinder", radius=f"{FLANGE_RADIUS}", length=f"{high - low:.6g}"
    )
    writer.link("actuator", 1e-3, RADIUS)
    # Pinocchio must meet the synergy before the joints that mimic it, and visits siblings in
    # alphabetical order: "actuator" and "synergy" sort before "palm" and "to_palm".
    synergy = writer.joint("synergy", "revolute", "base", "actuator", xyz=(0, 0, 0), rpy=(0, 0, 0))
    ET.SubElement(synergy, "axis", xyz="0 0 1")
    ET.SubElement(synergy, "limit", lower="0", upper="1", effort="1", velocity=f"{SYNERGY_VELOCITY}")
    palm = writer.link("palm", MASSES["palm"], 0.04)
    size = PALM_BOX_MAX - PALM_BOX_MIN
    writer.shape(palm, (PALM_BOX_MAX + PALM_BOX_MIN) / 2, none, "box", size=_numbers(size))
    writer.joint("to_palm", "fixed", "base", "palm", xyz=PALM_XYZ, rpy=PALM_RPY)
    for finger in FINGERS:
        writer.finger(finger)
    ET.indent(writer.root)
    return ET.tostring(writer.root, encoding="unicode") + "\n"


def main() -> None:
    """Write both hands."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("apex_ompl/robot/data"))
    out = parser.parse_args().out
    for side in ("right", "left"):
        (out / f"softhand2_{side}.urdf").write_text(hand_urdf(side))


if __name__ == "__main__":
    run_script(main)
