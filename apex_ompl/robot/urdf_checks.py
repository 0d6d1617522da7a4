"""Checks of a URDF before it is parsed: faults are named with the element; the parser prints them on stderr alone."""

from __future__ import annotations

import math
from collections.abc import Collection
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np

from apex_ompl.errors import RobotError
from apex_ompl.types import Array

INERTIA = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
POSE = {"origin": {"xyz": 3, "rpy": 3}}
SIZES = {
    "box": {"size": 3}, "sphere": {"radius": 1}, "cylinder": {"radius": 1, "length": 1},
    "capsule": {"radius": 1, "length": 1}, "mesh": {"scale": 3},
}  # fmt: skip
JOINT = {
    **POSE, "axis": {"xyz": 3}, "limit": {"lower": 1, "upper": 1, "velocity": 1, "effort": 1},
    "mimic": {"multiplier": 1, "offset": 1}, "dynamics": {"damping": 1, "friction": 1},
    "safety_controller": {"k_velocity": 1, "k_position": 1, "soft_lower_limit": 1, "soft_upper_limit": 1},
}  # fmt: skip
"""Elements -> their attributes that hold numbers, and how many."""

LIMITED = ("revolute", "prismatic")  # joints that need limits
MOVING = (*LIMITED, "continuous", "planar")  # joints that need an axis
TYPES = (*MOVING, "fixed", "floating")


def check_urdf(tree: ET.Element, file: Path, locked: Collection[str] = ()) -> None:
    """Check the links and joints of a URDF.

    Args:
        tree: Its root.
        file: The file, for errors.
        locked: Names of joints that become fixed ones, whose limits do not matter.

    Raises:
        RobotError: An element is missing, or holds something else than it must.
    """
    for link in tree.findall("link"):
        what = f"{file}: link {link.get('name')!r}"
        inertial = link.find("inertial")
        if inertial is not None:
            _check_numbers(inertial, POSE, f"{what}: inertial")
            _required(inertial, "mass", ("value",), f"{what}: inertial")
            _required(inertial, "inertia", INERTIA, f"{what}: inertial")
        for kind in ("visual", "collision"):
            for holder in link.findall(kind):
                _check_numbers(holder, POSE, f"{what}: {kind}")
                for geometry in holder.findall("geometry"):
                    _check_numbers(geometry, SIZES, f"{what}: {kind}")
    for joint in tree.findall("joint"):
        _check_joint(joint, f"{file}: joint {joint.get('name')!r}", joint.get("name") in locked)


def _check_joint(joint: ET.Element, what: str, locked: bool) -> None:
    kind = joint.get("type")
    if kind not in TYPES:
        raise RobotError(f"{what}: type: expected one of {', '.join(TYPES)}, got {kind!r}")
    for end in ("parent", "child"):
        found = joint.find(end)
        if found is None or not found.get("link"):
            raise RobotError(f"{what}: expected a {end} link")
    _check_numbers(joint, JOINT, what)
    axis = joint.find("axis")
    text = "1 0 0" if axis is None else axis.get("xyz", "1 0 0")
    if kind in MOVING and not np.linalg.norm(numbers(text, 3, f"{what}: axis xyz")) > 0.0:
        raise RobotError(f"{what}: axis xyz: expected a direction, got {text!r}")
    if kind in LIMITED and not locked:
        _required(joint, "limit", ("velocity", "effort"), what)
        limit = joint.find("limit")
        assert limit is not None
        lower, upper = (float(limit.get(end, "0")) for end in ("lower", "upper"))
        if not lower <= upper:
            raise RobotError(
                f"{what}: limit: expected lower <= upper, 0 where one is omitted, got {lower:g} and {upper:g}"
            )


def _check_numbers(element: ET.Element, known: dict[str, dict[str, int]], what: str) -> None:
    for name, attributes in known.items():
        for inner in element.findall(name):
            for attribute, count in attributes.items():
                if (text := inner.get(attribute)) is not None:
                    numbers(text, count, f"{what}: {name} {attribute}")


def _required(element: ET.Element, name: str, attributes: Collection[str], what: str) -> None:
    """Check that an element has an inner one with numbers."""
    inner = element.find(name)
    for attribute in attributes:
        text = None if inner is None else inner.get(attribute)
        if text is None:
            raise RobotError(f"{what}: expected <{name}> with {' and '.join(attributes)}, {attribute} is missing")
        numbers(text, 1, f"{what}: {name} {attribute}")


def numbers(text: str, count: int, what: str) -> Array:
    """Return so many numbers of an attribute, shape (count,).

    Raises:
        RobotError: The text holds something else.
    """
    try:
        values = [float(word) for word in text.split()]
    except ValueError:
        values = []
    if len(values) != count or any(map(math.isnan, values)):
        expected = "a number" if count == 1 else f"{count} numbers"
        raise RobotError(f"{what}: expected {expected}, got {text!r}")
    return np.array(values)
