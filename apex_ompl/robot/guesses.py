"""Guesses of what a URDF does not tell: which joints are arms, where palms are, which limits are missing.

Every guess is noted in one line, which :mod:`apex_ompl.robot.new` writes into the robot file as a comment.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

from apex_ompl.robot.description import TURNING, Description, Semantics, UrdfJoint
from apex_ompl.types import Array
from apex_ompl.util.display import counted

LEAST, FEWEST = 4, 2  # joints of an arm, and where no chain has as many: necks and torsos have up to three
FINGER = re.compile(r"finger|gripper|thumb|index|middle|ring_|little|pinky|hand_|jaw|knuckle|grip", re.I)
LEG = re.compile(r"(?<![a-z])legs?(?![a-z])|hip_|_hip|knee|ankle|foot|thigh|calf|wheel|caster|steer|_leg|leg_", re.I)
WHEEL = re.compile(r"wheel|caster", re.I)
RANGE = {"revolute": 3.141593, "prismatic": 0.5}  # assumed to either side where the URDF has none [rad, m]
SPEED = {"revolute": 2.0, "continuous": 2.0, "prismatic": 0.1}  # assumed where the URDF has none [rad/s, m/s]
FASTEST = 50.0  # speeds beyond are placeholders [rad/s]
RAMP, JERK = 4.0, 80.0  # acceleration and jerk assumed, relative to the velocity [1/s, 1/s^2]
HOMES = ("home", "ready", "default", "rest", "start", "reference", "half_sitting", "standing")


class Arm(NamedTuple):
    """A group of joints to plan for.

    Attributes:
        group: Name of the group.
        hand: Name of its hand.
        joints: Its joints, parents first.
        palm: The link that holds objects.
        note: How it was found.
    """

    group: str
    hand: str
    joints: tuple[str, ...]
    palm: str
    note: str


def arms_of(robot: Description, semantics: Semantics | None) -> list[Arm]:
    """Return the arms of a robot: groups of its SRDF that are chains, else chains of its joints.

    They are chains of LEAST joints or more, or groups of FEWEST that carry an end effector of the SRDF; where there are
    none of either, all of FEWEST or more.
    """
    chains, source = dict[str, tuple[str, ...]](), ""
    for least in (LEAST, FEWEST):
        if semantics is not None and not chains:
            chains, source = dict(_chosen_groups(robot, semantics, least)), "a group of the SRDF"
        if not chains:
            found = _limbs(robot, least)
            chains = dict(zip(_group_names(robot, found), found, strict=True))
            source = f"guessed, as a chain of {least} or more joints"
    return [
        Arm(
            group, re.sub(r"_?arm$", "", group) or "hand", joints, palm_of(robot, joints, semantics),
            f"{len(joints)} joints {joints[0]} to {joints[-1]}, {source}",
        )
        for group, joints in chains.items()
    ]  # fmt: skip


def _chosen_groups(robot: Description, semantics: Semantics, least: int) -> Iterable[tuple[str, tuple[str, ...]]]:
    """Yield the smallest groups that are chains of so many joints and share none, then those with an end effector."""
    taken: set[str] = set()
    last = {next((joint.name for joint in robot.ancestors(palm) if joint.free), "") for palm in semantics.palms}
    order = sorted(semantics.groups.items(), key=lambda one: (len(one[1]) < least, len(one[1]), one[0]))
    for name, members in order:
        joints = tuple(joint for joint in members if not is_finger(robot, joint))
        if len(joints) < FEWEST or taken & {*joints} or not _is_chain(robot, joints):
            continue
        if len(joints) < least and joints[-1] not in last:
            continue
        if not any(LEG.search(joint) for joint in (name, *joints)):
            taken |= {*joints}
            yield name, joints


def _is_chain(robot: Description, joints: tuple[str, ...]) -> bool:
    last = robot.joints[joints[-1]]
    return {*joints} <= {joint.name for joint in robot.ancestors(last.child)}


def is_finger(robot: Description, name: str) -> bool:
    """Whether a joint is one of a hand: by its name, or the last of a chain and prismatic, or as others follow it."""
    joint = robot.joints[name]
    last = not any(one.kind != "fixed" for link in robot.subtree(joint.child) for one in robot.below[link])
    if FINGER.search(name) or (last and joint.kind == "prismatic") or (last and FINGER.search(joint.child)):
        return True
    return any(robot.joints[other].parent != joint.child for other in robot.followers(name))


def _limbs(robot: Description, least: int) -> list[tuple[str, ...]]:
    """Return the chains of at least so many joints between branches, without fingers, legs and wheels."""
    kept = [
        joint for joint in robot.joints.values()
        if joint.free and not is_finger(robot, joint.name) and not _is_leg(robot, joint)
    ]  # fmt: skip
    names = {joint.name for joint in kept}
    up: dict[str, str | None] = {
        joint.name: next((one.name for one in robot.ancestors(joint.parent) if one.name in names), None)
        for joint in kept
    }
    down: dict[str | None, list[str]] = {}
    for name, above in up.items():
        down.setdefault(above, []).append(name)
    found = []
    for name, above in up.items():
        if above is not None and len(down[above]) == 1:
            continue
        chain = [name]
        while len(down.get(chain[-1], [])) == 1:
            chain += down[chain[-1]]
        if len(chain) >= least and any(robot.joints[one].kind in TURNING for one in chain):
            found.append(tuple(chain))
    return found


def _is_leg(robot: Description, joint: UrdfJoint) -> bool:
    above = [joint, *robot.ancestors(joint.parent)]
    return any(LEG.search(one.name) or LEG.search(one.child) for one in above if one.free)


def _group_names(robot: Description, chains: list[tuple[str, ...]]) -> list[str]:
    """Return names by sides where the names of joints or links have them, else by letters."""
    sides = [_side(robot, chain) for chain in chains]
    if len(chains) == 1:
        return ["arm"]
    if all(sides) and len(set(sides)) == len(sides):
        return [f"{side}_arm" for side in sides]
    return [f"{chr(ord('a') + k)}_arm" for k in range(len(chains))]


def _side(robot: Description, chain: tuple[str, ...]) -> str:
    words = [word for name in chain for word in (name, robot.joints[name].child)]
    for side in ("left", "right"):
        pattern = re.compile(rf"{side}|(?<![a-z]){side[0]}(?![a-z])", re.I)
        if sum(bool(pattern.search(word)) for word in words) * 2 > len(words):
            return side
    return ""


def palm_of(robot: Description, joints: tuple[str, ...], semantics: Semantics | None) -> str:
    """Return the link of an arm that holds objects.

    It is that of the SRDF's end effector, else the one that carries fingers, else the last one that is fixed to the
    last joint.
    """
    last = robot.joints[joints[-1]].child
    below = robot.subtree(last)
    for palm in semantics.palms if semantics else ():
        if palm in below:
            return palm
    fingers = [joint for link in below for joint in robot.below[link] if joint.kind != "fixed"]
    if fingers:
        return fingers[0].parent
    while len(robot.below[last]) == 1:
        last = robot.below[last][0].child
    return last


def hand_of(robot: Description, arm: Arm) -> tuple[dict[str, Any], str]:
    """Return the record of an arm's hand, and how it was found; fingers as they are where all joints are 0."""
    poses = robot.zero_poses
    below = robot.subtree(arm.palm)
    ends = [link for link in below if not robot.below[link] and link != arm.palm]
    palm = np.linalg.inv(poses[arm.palm])
    tips = np.array([(palm @ poses[link])[:3, 3] for link in ends]) if ends else np.zeros((1, 3))
    point = tips.mean(axis=0)
    axis = point if np.linalg.norm(point) > 0.01 else np.array([0.0, 0.0, 1.0])
    axis = _direction(axis)
    record = {"palm": arm.palm, "point": _rounded(point, 4), "axis": axis, "fingers": axis}
    towards = f"towards the middle of {counted(len(ends), 'tip')}" if np.linalg.norm(point) > 0.01 else "the palm's z"
    return record, f"palm {arm.palm}, axis and fingers {towards}"


def _direction(vector: Array) -> list[float]:
    """Return a unit vector, an axis of the frame where it is close to one."""
    unit = vector / np.linalg.norm(vector)
    near = int(np.argmax(np.abs(unit)))
    if abs(unit[near]) > 0.98:
        return [float(np.sign(unit[near])) if k == near else 0.0 for k in range(3)]
    return _rounded(unit, 9)


def _rounded(values: Array, digits: int) -> list[float]:
    return [round(float(value), digits) + 0.0 for value in values]


def joint_record(joint: UrdfJoint) -> tuple[dict[str, float], list[str]]:
    """Return the record of a planned joint without its home, and what of it is assumed."""
    record: dict[str, float] = {}
    notes = []
    if joint.kind == "continuous":
        notes.append("turns without end; give lower and upper if cables or hoses do not allow that")
    elif math.isnan(joint.lower):
        record |= {"lower": -RANGE[joint.kind], "upper": RANGE[joint.kind]}
        notes.append("no range in the URDF, assumed")
    velocity = joint.velocity
    if math.isnan(velocity) or velocity > FASTEST:
        velocity = record["velocity"] = SPEED[joint.kind]
        notes.append("no velocity in the URDF, assumed")
    if joint.kind == "continuous" or {"lower", "upper"} <= record.keys():
        record["velocity"] = velocity
    record |= {"acceleration": float(f"{RAMP * velocity:.4g}"), "jerk": float(f"{JERK * velocity:.4g}")}
    return record, notes


def locked_values(robot: Description, planned: Iterable[str], state: dict[str, float]) -> dict[str, float]:
    """Return name -> value of the joints that are not planned: those of a state, else 0 or the closest that may be."""
    planned = set(planned)
    values: dict[str, float] = {}
    for joint in robot.joints.values():
        if joint.kind == "fixed" or joint.name in planned or joint.mimics:
            continue
        value = state.get(joint.name, 0.0) if joint.free else 0.0
        if not math.isnan(joint.lower):
            value = min(max(value, joint.lower), joint.upper)
        values[joint.name] = round(value, 6) + 0.0
    return values


def carriers(robot: Description, arms: Iterable[Arm]) -> list[str]:
    """Return the joints with one degree of freedom that carry arms and are in none, such as those of a torso."""
    arms = list(arms)
    planned = {joint for arm in arms for joint in arm.joints}
    first = (robot.joints[arm.joints[0]].parent for arm in arms)
    above = (joint for link in first for joint in reversed(list(robot.ancestors(link))))
    return list(dict.fromkeys(joint.name for joint in above if joint.free and joint.name not in planned))


def drives(robot: Description) -> bool:
    """Whether a robot has a base that drives: planar or floating joints, or wheels."""
    return any(joint.kind in ("planar", "floating") or WHEEL.search(joint.name) for joint in robot.joints.values())


def preferred_state(semantics: Semantics | None, joints: Iterable[str]) -> tuple[str, dict[str, float]]:
    """Return the state of an SRDF that serves best as home, and its name; an empty one where none has all joints."""
    if semantics is None:
        return "", {}
    wanted = set(joints)
    whole = [name for name, values in semantics.states.items() if wanted <= values.keys()]
    for name in HOMES:
        for one in whole:
            if one.lower().startswith(name):
                return one, semantics.states[one]
    return (whole[0], semantics.states[whole[0]]) if whole else ("", {})
