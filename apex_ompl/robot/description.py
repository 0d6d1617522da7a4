"""The tree of links and joints of a URDF, and the semantic description (SRDF) beside it.

:func:`read_description` names the first fault of a URDF in one sentence, as Pinocchio's parser does not.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree as ET

import coal
import numpy as np

from apex_ompl.errors import RobotError
from apex_ompl.robot.compose import LIMITED, check_urdf, numbers, origin_of, parse_xml
from apex_ompl.types import Array
from apex_ompl.util.extras import import_extra

XACRO = ".xacro"
TURNING = ("revolute", "continuous")
ONE_DOF = (*LIMITED, "continuous")


class UrdfJoint(NamedTuple):
    """A joint of a URDF.

    Attributes:
        name: Its name.
        kind: Its type, such as ``revolute``.
        parent: The link that carries it.
        child: The link that it moves.
        lower: Lowest position [rad or m]; NaN where the URDF gives no range.
        upper: Highest position.
        velocity: Largest speed [rad/s or m/s]; NaN where the URDF gives none that is positive and finite.
        mimics: The joint that it follows, or an empty string.
        origin: Its pose in the parent where its value is 0, shape (4, 4) [m].
    """

    name: str
    kind: str
    parent: str
    child: str
    lower: float
    upper: float
    velocity: float
    mimics: str
    origin: Array

    @property
    def free(self) -> bool:
        """Whether the joint has one degree of freedom of its own."""
        return self.kind in ONE_DOF and not self.mimics


@dataclass(frozen=True)
class Description:
    """The tree of a URDF.

    Attributes:
        name: The robot's name, which may be empty.
        links: Names of its links.
        solid: Names of the links that have collision geometry.
        joints: Joints by name, in the order of the file.
    """

    name: str
    links: tuple[str, ...]
    solid: frozenset[str]
    joints: dict[str, UrdfJoint]

    @cached_property
    def above(self) -> dict[str, UrdfJoint]:
        """Link -> the joint that moves it."""
        return {joint.child: joint for joint in self.joints.values()}

    @cached_property
    def below(self) -> dict[str, list[UrdfJoint]]:
        """Link -> the joints that it carries."""
        found: dict[str, list[UrdfJoint]] = {link: [] for link in self.links}
        for joint in self.joints.values():
            found[joint.parent].append(joint)
        return found

    @cached_property
    def zero_poses(self) -> dict[str, Array]:
        """Link -> its pose in the root where all joints are 0, shape (4, 4) [m]."""
        (root,) = (link for link in self.links if link not in self.above)
        poses = {root: np.eye(4)}
        for link in self.subtree(root):
            poses |= {joint.child: poses[link] @ joint.origin for joint in self.below[link]}
        return poses

    def ancestors(self, link: str) -> Iterator[UrdfJoint]:
        """Yield the joints from a link to the root."""
        while link in self.above:
            yield self.above[link]
            link = self.above[link].parent

    def subtree(self, link: str) -> list[str]:
        """Return a link and all links below it."""
        found = [link]
        for one in found:
            found += [joint.child for joint in self.below[one]]
        return found

    def followers(self, name: str) -> list[str]:
        """Return the joints that mimic a joint."""
        return [joint.name for joint in self.joints.values() if joint.mimics == name]


def expanded(file: Path) -> str:
    """Return the URDF that a xacro file describes, by its default arguments.

    Raises:
        MissingFileError: The package xacro is not installed.
        RobotError: xacro finds a fault.
    """
    xacro: Any = import_extra("xacro", "xacro files", "xacro")
    try:
        return str(xacro.process_file(str(file)).toprettyxml(indent=" "))
    except (Exception, SystemExit) as error:  # xacro raises many kinds
        raise RobotError(f"{file}: xacro cannot expand it ({' '.join(str(error).split())})") from error


def read_description(file: Path, text: str | None = None) -> Description:
    """Read the tree of a URDF.

    Args:
        file: The file.
        text: The URDF that xacro made of it, where it did.

    Raises:
        MissingFileError: The file cannot be read.
        RobotError: It is not a URDF of one tree with joints; the message names the element.
    """
    root = parse_xml(file, text)
    links = [_name(link, "link", file) for link in root.findall("link")]
    names = [_name(joint, "joint", file) for joint in root.findall("joint")]
    for what, all_of in (("links", links), ("joints", names)):
        twice = next((name for name, count in Counter(all_of).items() if count > 1), None)
        if twice is not None:
            raise RobotError(f"{file}: expected {what} of different names, {twice!r} is given twice")
        if not all_of:
            raise RobotError(f"{file}: expected {what}, found none")
    check_urdf(root, file, names)
    joints = {name: _joint(joint, name, file) for name, joint in zip(names, root.findall("joint"), strict=True)}
    _check_tree(joints, links, file)
    solid = frozenset(str(link.get("name")) for link in root.findall("link") if link.find("collision") is not None)
    return Description(root.get("name", ""), tuple(links), solid, joints)


def _name(element: ET.Element, what: str, file: Path) -> str:
    name = element.get("name", "")
    if not name:
        raise RobotError(f"{file}: expected a name of each {what}, one has none")
    return name


def _joint(joint: ET.Element, name: str, file: Path) -> UrdfJoint:
    kind = str(joint.get("type"))
    limit, mimic = joint.find("limit"), joint.find("mimic")
    lower = upper = velocity = math.nan
    if limit is not None and kind in ONE_DOF:
        what = f"{file}: joint {name!r}: limit"
        lower, upper, velocity = (
            float(numbers(limit.get(key, "0"), 1, f"{what} {key}")[0]) for key in ("lower", "upper", "velocity")
        )
        if lower > upper:
            raise RobotError(f"{what}: expected lower <= upper, got {lower:g} and {upper:g}")
        if velocity < 0.0:
            raise RobotError(f"{what}: expected a velocity that is not negative, got {velocity:g}")
        if kind == "continuous" or not math.isfinite(upper - lower) or lower == upper:
            lower = upper = math.nan
        if not math.isfinite(velocity) or velocity == 0.0:
            velocity = math.nan
    ends = [str(end.get("link")) for key in ("parent", "child") if (end := joint.find(key)) is not None]
    mimics = "" if mimic is None or kind == "fixed" else mimic.get("joint", "")
    if mimic is not None and kind != "fixed" and not mimics:
        raise RobotError(f"{file}: joint {name!r}: mimic: expected the name of a joint")
    return UrdfJoint(name, kind, ends[0], ends[1], lower, upper, velocity, mimics, origin_of(joint, f"joint {name!r}"))


def _check_tree(joints: dict[str, UrdfJoint], links: list[str], file: Path) -> None:
    """Check that joints make one tree of all links, and that those that mimic others name one that does not.

    Raises:
        RobotError: They do not.
    """
    known, moved = set(links), dict[str, str]()
    for joint in joints.values():
        where = f"{file}: joint {joint.name!r}"
        for end in (joint.parent, joint.child):
            if end not in known:
                raise RobotError(f"{where}: expected links of the robot, got {end!r}")
        if joint.child in moved:
            raise RobotError(f"{where}: its child {joint.child!r} is that of the joint {moved[joint.child]!r} as well")
        moved[joint.child] = joint.name
        if joint.mimics and joint.mimics not in joints:
            raise RobotError(f"{where} mimics {joint.mimics!r}, which is no joint of the robot")
        if joint.mimics and joints[joint.mimics].mimics:
            raise RobotError(f"{where} mimics {joint.mimics!r}, which mimics a joint itself")
    roots = [link for link in links if link not in moved]
    if len(roots) > 1:
        raise RobotError(f"{file}: expected one root link, found {', '.join(roots)}")
    reached, children = list(roots), {link: [j.child for j in joints.values() if j.parent == link] for link in links}
    for link in reached:
        reached += children[link]
    lost = next((link for link in links if link not in set(reached)), None)
    if lost is not None:
        raise RobotError(f"{file}: expected a tree, the link {lost!r} is part of a cycle of joints")


class Semantics(NamedTuple):
    """What an SRDF says.

    Attributes:
        groups: Group -> names of its joints that have one degree of freedom of their own, parents first.
        states: Name of a state -> joint -> value [rad or m].
        palms: Links that carry end effectors.
        unknown: Names of links, joints and groups in it that the robot and the SRDF do not have.
    """

    groups: dict[str, tuple[str, ...]]
    states: dict[str, dict[str, float]]
    palms: tuple[str, ...]
    unknown: tuple[str, ...]


def read_semantics(file: Path, robot: Description) -> Semantics:
    """Read an SRDF; what names joints or links that the robot does not have is left out.

    Raises:
        MissingFileError: The file cannot be read.
        RobotError: It is not an SRDF.
    """
    root = parse_xml(file)
    elements = {group.get("name", ""): group for group in root.findall("group")}
    groups = {name: _members(name, elements, robot, ()) for name in elements}
    order = list(_in_order(robot))
    states: dict[str, dict[str, float]] = {}
    for state in root.findall("group_state"):
        values = states.setdefault(state.get("name", ""), {})
        for joint in state.findall("joint"):
            name, text = joint.get("name", ""), joint.get("value", "")
            if name in robot.joints and robot.joints[name].free and len(text.split()) == 1:
                values[name] = float(numbers(text, 1, f"{file}: state {state.get('name')!r}: {name}")[0])
    palms = [one.get("parent_link", "") for one in root.findall("end_effector")]
    return Semantics(
        {name: tuple(joint for joint in order if joint in found) for name, found in groups.items()},
        states, tuple(palm for palm in palms if palm in robot.links), tuple(_unknown(root, robot)),
    )  # fmt: skip


def _unknown(root: ET.Element, robot: Description) -> Iterator[str]:
    """Yield the names in an SRDF that are no links, joints or groups, each once."""
    links, joints = {*robot.links}, {*robot.joints}
    virtual = {one.get("name", "") for one in root.findall("virtual_joint")}
    groups = {one.get("name", "") for one in root.findall("group")}
    places = (
        ("group/link", "name", links), ("group/joint", "name", joints | virtual), ("group/chain", "base_link", links),
        ("group/chain", "tip_link", links), ("group/group", "name", groups), ("group_state", "group", groups),
        ("group_state/joint", "name", joints | virtual), ("end_effector", "parent_link", links),
        ("end_effector", "group", groups), ("disable_collisions", "link1", links),
        ("disable_collisions", "link2", links),
    )  # fmt: skip
    named = (one.get(key, "") for path, key, known in places for one in root.findall(path) if one.get(key) not in known)
    yield from dict.fromkeys(name for name in named if name)


def _in_order(robot: Description) -> Iterator[str]:
    """Yield the names of the free joints, parents before children."""
    root = next(link for link in robot.links if link not in robot.above)
    for link in robot.subtree(root):
        yield from (joint.name for joint in robot.below[link] if joint.free)


def _members(name: str, groups: dict[str, ET.Element], robot: Description, seen: tuple[str, ...]) -> set[str]:
    """Return the free joints of a group: its own, those of its links, chains and groups."""
    if name not in groups or name in seen:
        return set()
    found = {joint.get("name", "") for joint in groups[name].findall("joint")}
    for link in groups[name].findall("link"):
        above = robot.above.get(link.get("name", ""))
        found |= {above.name} if above else set()
    for chain in groups[name].findall("chain"):
        base = chain.get("base_link", "")
        path = list(robot.ancestors(chain.get("tip_link", "")))
        ends = [joint.parent for joint in path]
        found |= {joint.name for joint in path[: ends.index(base) + 1]} if base in ends else set()
    for group in groups[name].findall("group"):
        found |= _members(group.get("name", ""), groups, robot, (*seen, name))
    return {joint for joint in found if joint in robot.joints and robot.joints[joint].free}


def unreadable_mesh(urdf: str) -> str:
    """Return a clause on the first collision mesh that Coal cannot read, or an empty string."""
    for link in ET.fromstring(urdf).findall("link"):
        for mesh in link.findall("collision/geometry/mesh"):
            try:
                coal.MeshLoader().load(mesh.get("filename", "").removeprefix("file://"), np.ones(3))
            except Exception:
                return f"the collision mesh of link {link.get('name')!r} cannot be read: {mesh.get('filename')}"
    return ""
