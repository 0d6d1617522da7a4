"""Clearance of a robot's sphere covers among its fixtures and obstacles."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from apex_ompl.collision.shapes import world_geometry
from apex_ompl.collision.tables import primitives
from apex_ompl.kernel import Kernel, RobotTables
from apex_ompl.kernel.scene_builder import Solids, tables_of
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.types import Array


def scene_kernel(robot: Robot, tables: RobotTables, scene: Sequence[Obstacle]) -> Kernel:
    """Return the kernel for ``tables`` of a robot among its fixtures and obstacles; moving ones are at time 0."""
    bodies = enumerate((*robot.fixtures, *scene))
    return Kernel(tables, tables_of({n: Solids.of(primitives(*world_geometry(body))) for n, body in bodies}))


def has_clearance(kernel: Kernel, states: Array, margin: float) -> NDArray[np.bool_]:
    """Whether states have a clearance of at least ``margin``, to the scene and between bodies of the robot.

    The spheres contain the bodies, so that the true clearance is at least the one tested.

    Args:
        kernel: The robot in its scene.
        states: Shape (N, dof).
        margin: [m].

    Returns:
        Shape (N,).
    """
    clear: NDArray[np.bool_] = kernel.clearance(states, margin).min(axis=1) >= margin
    return clear
