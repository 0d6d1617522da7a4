"""Collision geometry of a robot: links, checks, and the pairs that are checked against each other."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Sequence
from itertools import combinations
from pathlib import Path

import coal
import numpy as np
import pinocchio as pin

from apex_ompl.errors import RobotError
from apex_ompl.scene.meshes import extent_fault


def link_of(model: pin.Model, item: pin.GeometryObject) -> str:
    """Return the name of the link that a geometry belongs to."""
    return str(model.frames[item.parentFrame].name)


def check_geometry(model: pin.Model, geometry: pin.GeometryModel, urdf: str, path: Path) -> None:
    """Raise a RobotError if Pinocchio has dropped collision geometry, or if a collision mesh is not a solid."""
    found = Counter(link_of(model, item) for item in geometry.geometryObjects)
    for link in ET.fromstring(urdf).findall("link"):
        name, wanted = str(link.get("name")), len(link.findall("collision"))
        if found[name] != wanted:
            raise RobotError(f"{path}: link {name!r} has {wanted} collision geometries, {found[name]} can be read")
    for item in geometry.geometryObjects:
        mesh = item.geometry
        fault = extent_fault(np.array(mesh.vertices())) if mesh.getObjectType() == coal.OT_BVH else ""
        if fault:
            raise RobotError(f"{path}: the collision mesh of link {link_of(model, item)!r} has {fault}")


def pair_up(model: pin.Model, geometry: pin.GeometryModel, disabled: Sequence[tuple[str, str]]) -> None:
    """Add a collision pair for any two geometries that move relative to each other and are not disabled."""
    skip = {frozenset(pair) for pair in disabled}
    items = list(geometry.geometryObjects)
    for i, j in combinations(range(len(items)), 2):
        a, b = items[i], items[j]
        if a.parentJoint == b.parentJoint:  # rigidly joined, or both fixed to the world
            continue
        if frozenset((link_of(model, a), link_of(model, b))) in skip:
            continue
        geometry.addCollisionPair(pin.CollisionPair(i, j))
