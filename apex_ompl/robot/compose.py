"""Composition of several URDFs into one: renaming, pruning, locking, mounting, absolute mesh paths.

Each URDF is checked before it is parsed: an error names the element, where the parser only prints to standard error.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pinocchio as pin

from apex_ompl.errors import MissingFileError, RobotError
from apex_ompl.robot.config import WIDEST, Joint, Part, RobotConfig, resolve
from apex_ompl.scene.bodies import pose_matrix
from apex_ompl.scene.mesh_files import UPRIGHT, collada_asset
from apex_ompl.types import Array
from apex_ompl.util.files import opened, read_file

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

WORLD = "world"  # the root link; a link of a part that has this name gets that of the part before it
LIMITED = ("revolute", "prismatic")  # joints that need limits
CONTINUOUS = "continuous"
AT_BASE = ("plane", "along_x", "along_y")  # links of a planar base, from its mount on
MOVING = (*LIMITED, CONTINUOUS, "planar")  # joints that need an axis
TYPES = (*MOVING, "fixed", "floating")
LENGTHS = {"box": ("size",), "cylinder": ("radius", "length"), "sphere": ("radius",), "capsule": ("radius", "length")}
LEAST_LENGTH = 1e-9  # of shapes [m]
SIGNS = {0.0: "0 or more", LEAST_LENGTH: "lengths above 0"}


def check_urdf(tree: ET.Element, file: Path, locked: Collection[str] = ()) -> None:
    """Check the links and joints of a URDF.

    Args:
        tree: Its root.
        file: The file, for errors.
        locked: Names of joints that become fixed, whose limits do not matter.

    Raises:
        RobotError: An element is missing or has another content than expected.
    """
    for link in tree.findall("link"):
        what = f"{file}: link {link.get('name')!r}"
        inertial = link.find("inertial")
        if inertial is not None:
            _check_numbers(inertial, POSE, f"{what}: inertial")
            _required(inertial, "mass", ("value",), f"{what}: inertial")
            _required(inertial, "inertia", INERTIA, f"{what}: inertial")
            _check_signs(inertial, {"mass": ("value",), "inertia": ("ixx", "iyy", "izz")}, f"{what}: inertial")
        for kind in ("visual", "collision"):
            for holder in link.findall(kind):
                _check_numbers(holder, POSE, f"{what}: {kind}")
                for geometry in holder.findall("geometry"):
                    _check_numbers(geometry, SIZES, f"{what}: {kind}")
                    if kind == "collision":
                        _check_signs(geometry, LENGTHS, f"{what}: {kind}", least=LEAST_LENGTH)
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


def _check_signs(element: ET.Element, known: Mapping[str, Sequence[str]], what: str, least: float = 0.0) -> None:
    for name, attributes in known.items():
        for inner in element.findall(name):
            for attribute in attributes:
                text = inner.get(attribute, "")
                if any(float(word) < least for word in text.split()):
                    raise RobotError(f"{what}: {name} {attribute}: expected {SIGNS[least]}, got {text}")


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


@dataclass(frozen=True)
class Composition:
    """A composed robot description.

    Attributes:
        urdf: The URDF text, with absolute mesh paths and root link ``world``. Where a part has a link of that name, it
            is called ``PART_world``.
        disabled_pairs: Link pairs that the SRDFs of the parts disable.
        part_links: Part name -> names of its links.
    """

    urdf: str
    disabled_pairs: list[tuple[str, str]]
    part_links: dict[str, tuple[str, ...]]
    files: tuple[Path, ...]


def compose(config: RobotConfig, folder: Path) -> Composition:
    """Compose the parts of a robot into one URDF.

    Args:
        config: The robot file.
        folder: Folder for relative paths.

    Raises:
        MissingFileError: A URDF, SRDF or collision mesh is missing.
        RobotError: A part cannot be composed; the message names the part and the reason.
    """
    # Version 1.2 is the first in which URDF has capsules.
    root = ET.Element("robot", name=config.name, version="1.2")
    ET.SubElement(root, "link", name=WORLD)
    links = {WORLD}
    disabled: list[tuple[str, str]] = []
    part_links: dict[str, tuple[str, ...]] = {}
    files: list[Path] = []
    packages = config.package_folders(folder)
    for part in config.parts:
        rename = _renamer(part)
        urdf = resolve(part.urdf, folder, f"URDF of part {part.name!r}", packages)
        files.append(urdf)
        tree = parse_xml(urdf)
        _prune(tree, part)
        for joint in tree.findall("joint"):
            _give_limits(joint, config.joints.get(rename(joint.get("name", ""))))
        check_urdf(tree, urdf, [n for j in tree.findall("joint") if rename(n := j.get("name", "")) in config.locked])
        names = []
        for element in [*tree.findall("link"), *tree.findall("joint")]:
            _rename_element(element, rename)
            _locate_meshes(element, (urdf.parent, folder), packages)
            if element.tag == "link":
                names.append(element.get("name", ""))
            for limit in element.findall("limit") if element.get("type") in LIMITED else ():
                # 0 by the specification; the parser asks for both.
                limit.attrib.setdefault("lower", "0")
                limit.attrib.setdefault("upper", "0")
            root.append(element)
        clash = links.intersection(names)
        if clash:
            raise RobotError(f"part {part.name!r}: the link {min(clash)!r} exists already; give a prefix")
        children = {c.get("link") for c in root.iterfind("joint/child")}
        if part.parent not in links:
            raise RobotError(f"part {part.name!r}: no link {part.parent!r} to mount it on")
        roots = [n for n in names if n not in children]
        if len(roots) != 1:
            raise RobotError(f"part {part.name!r}: expected one root link, found {', '.join(roots) or 'none'}")
        names += _mount(root, part, roots[0])
        links.update(names)
        part_links[part.name] = tuple(names)
        if part.srdf:
            files.append(resolve(part.srdf, folder, f"SRDF of part {part.name!r}", packages))
            found = parse_xml(files[-1]).iter("disable_collisions")
            pairs = [(rename(e.get("link1", "")), rename(e.get("link2", ""))) for e in found]
            disabled += [(a, b) for a, b in pairs if a in names and b in names]
    _check_followers(root)
    _lock_all(root, config.locked)
    files += [Path(mesh.get("filename", "").removeprefix("file://")) for mesh in root.iter("mesh")]
    return Composition(ET.tostring(root, encoding="unicode"), disabled, part_links, tuple(dict.fromkeys(files)))


def parse_xml(path: Path, text: str | None = None) -> ET.Element:
    """Return the root of a URDF or an SRDF, whose element is ``robot``.

    Args:
        path: The file.
        text: Its content, where it is not that of the file: what xacro made of it.

    Raises:
        MissingFileError: The file cannot be read.
        RobotError: It is not XML, or its root is another element.
    """
    try:
        root = ET.fromstring(read_file(path, "robot description") if text is None else text)
    except (ET.ParseError, ValueError, LookupError) as error:
        raise RobotError(f"{path}: not valid XML ({error})") from error
    if root.tag != "robot":
        raise RobotError(f"{path}: expected the element <robot>, got <{root.tag}>")
    return root


def _give_limits(joint: ET.Element, given: Joint | None) -> None:
    """Write limits of the robot file into a planned joint; one that is continuous becomes revolute.

    Without a range in the robot file, the limits of a continuous joint are the widest.

    Raises:
        RobotError: Only one end of the range of a continuous joint is given.
    """
    if given is None or joint.get("type") not in (*LIMITED, CONTINUOUS):
        return
    values = {"lower": given.lower, "upper": given.upper, "velocity": given.velocity}
    known = {name: f"{value:.17g}" for name, value in values.items() if value is not None}
    if joint.get("type") == CONTINUOUS:
        ends = {"lower", "upper"} & known.keys()
        if len(ends) == 1:
            expected = "expected lower and upper, or neither of them for a joint that turns without end"
            raise RobotError(f"joint {joint.get('name')!r} is continuous and has {ends.pop()} alone, {expected}")
        known = {"lower": f"{-WIDEST:g}", "upper": f"{WIDEST:g}"} | known
        joint.set("type", "revolute")
    if {"lower", "upper"} <= known.keys():
        limit = joint.find("limit")
        limit = ET.SubElement(joint, "limit") if limit is None else limit
        limit.attrib.update(known)
        if "velocity" in known:
            limit.attrib.setdefault("effort", "0")


def _renamer(part: Part) -> Callable[[str], str]:
    def rename(name: str) -> str:
        for old, new in part.rename.items():
            if name.startswith(old):
                name = new + name.removeprefix(old)
                break
        name = part.prefix + name
        return f"{part.name}_{WORLD}" if name == WORLD else name

    return rename


def _prune(tree: ET.Element, part: Part) -> None:
    """Remove the links of ``part.remove`` and their descendants."""
    known = {link.get("name") for link in tree.findall("link")}
    removed = set(part.remove)
    if removed - known:
        raise RobotError(f"part {part.name!r}: no link {min(removed - known)!r} to remove")
    edges = [(j, j.find("parent"), j.find("child")) for j in tree.findall("joint")]
    arcs = [(j, p.get("link"), c.get("link")) for j, p, c in edges if p is not None and c is not None]
    grown = True
    while grown:
        below = {str(child) for _, parent, child in arcs if parent in removed}
        grown = not below <= removed
        removed |= below
    for joint, _, child in arcs:
        if child in removed:
            tree.remove(joint)
    for link in tree.findall("link"):
        if link.get("name") in removed:
            tree.remove(link)


def _rename_element(element: ET.Element, rename: Callable[[str], str]) -> None:
    element.set("name", rename(element.get("name", "")))
    for tag, key in (("parent", "link"), ("child", "link"), ("mimic", "joint")):
        for inner in element.findall(tag):
            inner.set(key, rename(inner.get(key, "")))


def _locate_meshes(element: ET.Element, folders: tuple[Path, Path], packages: Mapping[str, Path]) -> None:
    """Put the paths of mesh files into place: they start at the URDF's folder, else at the robot file's."""
    for kind in ("visual", "collision"):
        for holder in element.findall(kind):
            for mesh in holder.iter("mesh"):
                role = f"{kind} mesh of link {element.get('name')!r}"
                try:
                    path = _resolved(mesh.get("filename", ""), folders, role, packages)
                except MissingFileError:
                    if kind == "collision":
                        raise
                    element.remove(holder)
                    break
                mesh.set("filename", str(path))
                _scale_and_turn(holder, mesh, path, role)


def _scale_and_turn(holder: ET.Element, mesh: ET.Element, path: Path, role: str) -> None:
    """Scale a COLLADA mesh to meters, and turn a glTF mesh so that z is up, as RViz shows them; Pinocchio does neither.

    The ``<up_axis>`` of COLLADA is ignored: links are modeled in their own frames, and RViz,
    MoveIt and Gazebo ignore it as well (rviz#1045, geometric_shapes#52). RViz 2 and Drake turn glTF (rviz#1482).
    """
    given = numbers(mesh.get("scale", "1 1 1"), 3, role)
    scale = given.copy()
    if path.suffix.lower() == ".dae":
        try:
            with opened(path, role) as file:  # a visual mesh may be long, and its unit is near the start
                scale *= collada_asset(file)[0]
        except ValueError as error:
            raise RobotError(f"{role}: {path} has {error}, expected COLLADA") from error
    elif path.suffix.lower() in (".glb", ".gltf"):
        upright = np.eye(4)
        upright[:3, :3] = UPRIGHT["Y_UP"]
        pose, scale = origin_of(holder, role) @ upright, scale[[0, 2, 1]]  # in the axes of the file
        for origin in holder.findall("origin"):
            holder.remove(origin)
        _set_origin(holder, pose)
    if not np.array_equal(scale, given):
        mesh.set("scale", " ".join(f"{v:.17g}" for v in scale))


def _resolved(name: str, folders: tuple[Path, Path], role: str, packages: Mapping[str, Path]) -> Path:
    with suppress(MissingFileError):
        return resolve(name, folders[0], role, packages)
    return resolve(name, folders[1], role, packages)


def _mount(root: ET.Element, part: Part, child: str) -> list[str]:
    """Fix a part to its parent, or let it drive on a plane there; return the names of the links that are added."""
    planar, name = part.planar, part.name
    ends = [part.parent, child] if planar is None else [part.parent, *(f"{name}_{at}" for at in AT_BASE), child]
    for link in ends[1:-1]:
        ET.SubElement(root, "link", name=link)
    joint = _joint_between(root, f"{name}_mount", "fixed", ends[0], ends[1])
    _set_origin(joint, pose_matrix(part.position, part.orientation))
    if planar is None:
        return []
    axes = (("x", "1 0 0", planar.x), ("y", "0 1 0", planar.y), ("yaw", "0 0 1", (-WIDEST, WIDEST)))
    for (axis, along, (low, high)), first, second in zip(axes, ends[1:-1], ends[2:], strict=True):
        joint = _joint_between(root, f"{name}_{axis}", "revolute" if axis == "yaw" else "prismatic", first, second)
        ET.SubElement(joint, "axis", xyz=along)
        ET.SubElement(joint, "limit", lower=f"{low:.17g}", upper=f"{high:.17g}", velocity="1", effort="0")
    return ends[1:-1]


def _joint_between(root: ET.Element, name: str, kind: str, parent: str, child: str) -> ET.Element:
    joint = ET.SubElement(root, "joint", name=name, type=kind)
    ET.SubElement(joint, "parent", link=parent)
    ET.SubElement(joint, "child", link=child)
    return joint


def _check_followers(root: ET.Element) -> None:
    """Make continuous joints that mimic others revolute, and check those that mimic joints that turn without end.

    Raises:
        RobotError: After a whole turn of a joint that turns without end, one that mimics it is elsewhere.
    """
    joints = {joint.get("name"): joint for joint in root.findall("joint")}
    for name, joint in joints.items():
        mimic = joint.find("mimic")
        if mimic is None:
            continue
        if joint.get("type") == CONTINUOUS:
            joint.set("type", "revolute")
            for old in joint.findall("limit"):
                joint.remove(old)
            ends = {"lower": f"{-WIDEST:g}", "upper": f"{WIDEST:g}"}
            ET.SubElement(joint, "limit", ends | {"velocity": "1", "effort": "0"})
        driver = joints.get(mimic.get("joint"))
        limit = None if driver is None else driver.find("limit")
        if driver is None or limit is None or driver.get("type") != "revolute" or joint.get("type") == "fixed":
            continue
        endless = float(limit.get("lower", "0")) <= -WIDEST and float(limit.get("upper", "0")) >= WIDEST
        whole = joint.get("type") == "revolute" and float(mimic.get("multiplier", "1")).is_integer()
        if endless and not whole:
            expected = f"expected limits of {driver.get('name')!r}, or a revolute joint with a whole multiplier"
            raise RobotError(f"joint {name!r} mimics {driver.get('name')!r}, which turns without end, {expected}")


def _lock_all(root: ET.Element, locked: Mapping[str, float]) -> None:
    """Turn joints into fixed joints at their values, and joints that mimic them at the values that follow."""
    joints = {str(joint.get("name")): joint for joint in root.findall("joint")}
    mimics = {
        name: mimic
        for name, joint in joints.items()
        if (mimic := joint.find("mimic")) is not None and joint.get("type") != "fixed"
    }
    for name, mimic in mimics.items():
        if mimic.get("joint") not in joints:
            raise RobotError(f"the joint {name!r} mimics {mimic.get('joint')!r}, which is no joint of the robot")
    waiting = dict(locked)
    while waiting:
        name, value = next(iter(waiting.items()))
        del waiting[name]
        _lock(root, name, value)
        for follower, mimic in mimics.items():
            if mimic.get("joint") == name and follower not in locked:
                waiting[follower] = float(mimic.get("multiplier", "1")) * value + float(mimic.get("offset", "0"))


def _lock(root: ET.Element, name: str, value: float) -> None:
    """Turn a revolute or prismatic joint into a fixed one at ``value`` [rad or m]."""
    joint = next((j for j in root.findall("joint") if j.get("name") == name), None)
    if joint is None:
        raise RobotError(f"locked: no joint {name!r} in the URDF")
    kind = joint.get("type")
    if kind in ("floating", "planar") and value == 0.0:
        _fix(joint, origin_of(joint, f"joint {name!r}"))
        return
    if kind not in (*LIMITED, CONTINUOUS):
        expected = "0 for a floating or planar joint, else revolute, continuous or prismatic"
        raise RobotError(f"locked: the joint {name!r} is {kind} and its value {value:g}, expected {expected}")
    axis_element = joint.find("axis")
    text = "1 0 0" if axis_element is None else axis_element.get("xyz", "1 0 0")
    axis = numbers(text, 3, f"axis of joint {name!r}")
    axis /= np.linalg.norm(axis)
    motion = np.eye(4)
    if kind == "prismatic":
        motion[:3, 3] = value * axis
    else:
        motion[:3, :3] = pin.exp3(value * axis)
    _fix(joint, origin_of(joint, f"joint {name!r}") @ motion)


def _fix(joint: ET.Element, pose: Array) -> None:
    """Make a joint fixed, its child at a pose in its parent, shape (4, 4) [m]."""
    for tag in ("origin", "axis", "limit", "mimic", "dynamics", "safety_controller"):
        for element in joint.findall(tag):
            joint.remove(element)
    joint.set("type", "fixed")
    _set_origin(joint, pose)


def origin_of(element: ET.Element, what: str) -> Array:
    """Return the pose given by the origin of an element, shape (4, 4) [m]."""
    origin, pose = element.find("origin"), np.eye(4)
    if origin is not None:
        pose[:3, 3] = numbers(origin.get("xyz", "0 0 0"), 3, f"origin of {what}")
        pose[:3, :3] = pin.rpy.rpyToMatrix(*numbers(origin.get("rpy", "0 0 0"), 3, f"origin of {what}"))
    return pose


def _set_origin(element: ET.Element, pose: Array) -> None:
    xyz, rpy = pose[:3, 3], pin.rpy.matrixToRpy(pose[:3, :3])
    text = {"xyz": " ".join(f"{v:.17g}" for v in xyz), "rpy": " ".join(f"{v:.17g}" for v in rpy)}
    element.insert(0, ET.Element("origin", text))
