"""The nearest training paths, moved to the ends of a query: what a model has to be better than."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from apex_ompl.diffusion.conditions import Conditions, Probes, Query, Table, batched, distances
from apex_ompl.kernel import Kernel, RobotTables
from apex_ompl.kernel.scene import scene_tables
from apex_ompl.records import Paths

Array = NDArray[np.float64]

ALONG = 7  # states of the straight line at which clearances are compared
NEAR = 0.3  # clearances are told apart up to here [m]
PER_METRE = 3.0  # rad that a metre of clearance counts as much as


class Neighbours:
    """Training paths by start, goal, and the clearances of the robot's probes along the straight line between them."""

    def __init__(self, paths: Paths, robot: RobotTables) -> None:
        """Look for neighbours among ``paths`` of ``robot``."""
        self._probes = Probes.of(robot, ALONG)
        kernel = Kernel(robot, scene_tables([]))
        table = Table(paths, self._probes, kernel)
        parts = (torch.arange(k, min(k + 2048, len(paths))) for k in range(0, len(paths), 2048))
        self._features = np.concatenate([features(table.batch(part)) for part in parts])
        self.spline = paths.spline
        control = paths.control()
        self._residual = (control - self.spline.line(control[:, 0], control[:, -1])).astype(np.float32)

    def refitted(self, query: Query, kernel: Kernel, count: int) -> Array:
        """Return what the nearest paths differ in from their straight lines, put on that of a query.

        Args:
            query: The problem.
            kernel: The robot.
            count: How many paths.

        Returns:
            Control points, shape (count, points, dof) [rad], inside the limits.
        """
        mine = features(batched([query], self._probes, kernel))
        apart = ((self._features - mine) ** 2).sum(axis=1)
        nearest = np.argpartition(apart, count)[:count]
        nearest = nearest[np.argsort(apart[nearest], kind="stable")]
        limits = kernel.robot.arrays
        control = self.spline.line(query.start, query.goal) + self._residual[nearest]
        return self.spline.with_ends(np.clip(control, limits.lower, limits.upper), query.start, query.goal)


def features(given: Conditions) -> NDArray[np.float32]:
    """Return what neighbours are compared by, shape (B, features) [rad]."""
    there = given.there
    points = given.probes.flatten(1, 2)
    owner = there.nonzero()[:, 0]
    apart = distances(given.shape[there], given.position[there], given.turn[there], given.size[there], points[owner])
    nearest = torch.full((*there.shape, points.shape[1]), NEAR)
    nearest[there] = apart.clamp(-NEAR, NEAR)
    least = torch.cat([nearest, torch.full((len(there), 1, points.shape[1]), NEAR)], dim=1).amin(dim=1)
    rows = torch.cat([given.start, given.goal, PER_METRE * least / least.shape[1] ** 0.5], dim=1)
    return np.asarray(rows.numpy(), np.float32)
