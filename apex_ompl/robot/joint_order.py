"""Order of joints for Pinocchio's parser, which needs joints before those that mimic them.

The parser goes through the tree depth first, the joints of a link by their names. Where a joint would come before the
one that it mimics, the joints of the link at which their chains part are renamed for the parser, and named back in the
model.
"""

from __future__ import annotations

from graphlib import CycleError, TopologicalSorter
from xml.etree import ElementTree as ET

import pinocchio as pin


def names_in_order(urdf: str) -> tuple[str, dict[str, str]]:
    """Return a URDF whose joints Pinocchio reads in order, and the old name of each joint that is renamed in it.

    Where no order will do, as with joints that mimic each other's children, the names stay.
    """
    root = ET.fromstring(urdf)
    joints = {str(joint.get("name")): joint for joint in root.findall("joint")}
    ends = {name: (_end(joint, "parent"), _end(joint, "child")) for name, joint in joints.items()}
    above = {child: name for name, (_, child) in ends.items()}

    def chain(name: str) -> list[str]:
        found = [name]
        while (parent := above.get(ends[found[-1]][0])) is not None:
            found.append(parent)
        return found[::-1]

    before: dict[str, dict[str, set[str]]] = {}  # link -> its joints -> those that are to come first
    for name, joint in joints.items():
        mimic = joint.find("mimic")
        driver = None if mimic is None else mimic.get("joint")
        if driver is None or driver not in joints or joint.get("type") == "fixed":
            continue
        for mine, other in zip(chain(name), chain(driver), strict=False):
            if mine != other:
                before.setdefault(ends[mine][0], {}).setdefault(mine, set()).add(other)
                break
    new: dict[str, str] = {}
    for link, needed in before.items():
        if all(other < name for name, others in needed.items() for other in others):
            continue
        siblings = sorted(name for name, (parent, _) in ends.items() if parent == link)
        try:
            order = list(TopologicalSorter({name: sorted(needed.get(name, ())) for name in siblings}).static_order())
        except CycleError:
            continue
        new |= {name: f"{k:04d}/{name}" for k, name in enumerate(order)}
    if not new:
        return urdf, {}
    for name, joint in joints.items():
        joint.set("name", new.get(name, name))
        mimic = joint.find("mimic")
        if mimic is not None:
            mimic.set("joint", new.get(mimic.get("joint", ""), mimic.get("joint", "")))
    return ET.tostring(root, encoding="unicode"), {changed: name for name, changed in new.items()}


def name_back(model: pin.Model, old: dict[str, str]) -> None:
    """Give the joints of a model, and their frames, the names that they had."""
    for k, name in enumerate(list(model.names)):
        model.names[k] = old.get(name, name)
    for k in range(model.nframes):
        model.frames[k].name = old.get(model.frames[k].name, model.frames[k].name)


def _end(joint: ET.Element, tag: str) -> str:
    end = joint.find(tag)
    return "" if end is None else end.get("link", "")
