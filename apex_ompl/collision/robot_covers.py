"""Sphere covers of the solids of a robot and of what it holds: from its file, or rough ones made when needed."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import coal

from apex_ompl.collision.cover.cylinder import cylinder_cover
from apex_ompl.collision.cover.proof import Cover
from apex_ompl.collision.cover.rough import rough_cover
from apex_ompl.collision.cover.spheres import make_cover, read_covers, shape_key
from apex_ompl.collision.shapes import is_shell
from apex_ompl.robot import Robot
from apex_ompl.util.bounded_cache import kept
from apex_ompl.util.weak_cache import weakly_cached

MOST_KEPT = 1024  # covers made at run time that are kept
QUICK_GAPS, LEAVES = (0.02, 0.005), 32  # of covers made at run time

_quick: dict[str, Cover] = {}  # by shape key


def covers_of(robot: Robot, shapes: Sequence[coal.CollisionGeometry]) -> list[Cover]:
    """Return a cover of each shape: one from the robot's file, or a rough one made now.

    Covers in files are not checked here: ``scripts/make_covers.py`` writes only proved covers, and the tests prove
    again those that ship.

    Raises:
        MissingFileError: The robot names a file of covers that cannot be read.
        FileFormatError: That file does not follow its schema.
    """
    given = _covers_in_file(robot)
    found = []
    for shape in shapes:
        key = shape_key(shape)
        found.append(given[key] if key in given else kept(_quick, key, partial(_quick_cover, shape), MOST_KEPT))
    return found


@weakly_cached
def _covers_in_file(robot: Robot) -> dict[str, Cover]:
    return read_covers(robot.covers) if robot.covers is not None else {}


def _quick_cover(shape: coal.CollisionGeometry) -> Cover:
    kind = shape.getNodeType()
    if kind == coal.GEOM_CYLINDER and shape.halfLength >= shape.radius:
        return cylinder_cover(float(shape.radius), float(shape.halfLength))
    if is_shell(shape) or kind in (coal.GEOM_BOX, coal.GEOM_CYLINDER):
        return rough_cover(shape)
    return make_cover(shape, QUICK_GAPS, effort=1, most=LEAVES)
