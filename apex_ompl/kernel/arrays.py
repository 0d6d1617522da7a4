"""The arrays that compiled code takes, the constants in them, and how they are packed into flat buffers.

Kinds of shapes are BOX, SPHERE, CYLINDER, CAPSULE, HALF_SPACE, HULL and GRID; kinds of joints FIXED, REVOLUTE and
PRISMATIC. ``GRID_SLACK`` is the largest error of interpolation on a grid of distances, in spacings.
"""

from apex_ompl.kernel.compiled.arrays import (
    BOX,
    CAPSULE,
    CYLINDER,
    FIXED,
    GRID,
    GRID_ROW,
    HALF_SPACE,
    PRISMATIC,
    REVOLUTE,
    SPHERE,
    RobotArrays,
    SceneArrays,
)
from apex_ompl.kernel.compiled.geometry.grid_distance import SLACK as GRID_SLACK
from apex_ompl.kernel.compiled.geometry.shapes import HULL, POINT, TRIANGLE, ShapeArrays
from apex_ompl.kernel.compiled.layout import Bytes, Floats, Integers, Singles, pack, unpack
from apex_ompl.kernel.compiled.moving.dynamic_obstacles import DynamicArrays

__all__ = [
    "BOX",
    "CAPSULE",
    "CYLINDER",
    "FIXED",
    "GRID",
    "GRID_ROW",
    "GRID_SLACK",
    "HALF_SPACE",
    "HULL",
    "POINT",
    "PRISMATIC",
    "REVOLUTE",
    "SPHERE",
    "TRIANGLE",
    "Bytes",
    "DynamicArrays",
    "Floats",
    "Integers",
    "RobotArrays",
    "SceneArrays",
    "ShapeArrays",
    "Singles",
    "pack",
    "unpack",
]
