"""Nearest training paths, moved to the ends of a query: the baseline of a model."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from apex_ompl.errors import ParameterError
from apex_ompl.kernel import Kernel, RobotTables
from apex_ompl.kernel.scene_builder import scene_tables
from apex_ompl.model.query import Probes, Query
from apex_ompl.training.conditions import Conditions, ConditionTable, batch_queries, pad_obstacles
from apex_ompl.training.records import Paths
from apex_ompl.types import Array

ALONG = 7  # states of the straight line at which clearances are compared
NEAR = 0.3  # clearances are clipped here [m]
PER_METRE = 3.0  # weight of clearances beside joint angles [rad/m]


class Neighbors:
    """Training paths by start, goal, and the clearances of the robot's probes along the straight line between them."""

    def __init__(self, several: Sequence[Paths], robot: RobotTables) -> None:
        """Look for neighbors among paths of ``robot``, all of the same spline."""
        self._probes, self.spline = Probes.from_robot(robot, ALONG), several[0].spline
        kernel, rows, rests = Kernel(robot, scene_tables([])), [], []
        for paths in several:
            table = ConditionTable(paths, self._probes, kernel)
            parts = (torch.arange(k, min(k + 2048, len(paths))) for k in range(0, len(paths), 2048))
            rows += [features(table.conditions(part)) for part in parts]
            control = paths.control()
            rests.append((control - self.spline.line(control[:, 0], control[:, -1])).astype(np.float32))
        self._features, self._residual = np.concatenate(rows), np.concatenate(rests)

    def refitted(self, query: Query, kernel: Kernel, count: int) -> Array:
        """Return the nearest paths' residuals from their straight lines, added to the straight line of a query.

        Args:
            query: The problem.
            kernel: The robot.
            count: How many paths.

        Returns:
            Control points, shape (count, points, dof) [rad], inside the limits.

        Raises:
            ParameterError: There are not as many paths.
        """
        if not 1 <= count <= len(self._residual):
            raise ParameterError("count", count, f"1 to {len(self._residual)}, as many as there are paths")
        mine = features(batch_queries([query], self._probes, kernel))
        apart = ((self._features - mine) ** 2).sum(axis=1)
        nearest = np.argpartition(apart, count - 1)[:count]
        nearest = nearest[np.argsort(apart[nearest], kind="stable")]
        limits = kernel.robot.arrays
        control = self.spline.line(query.start, query.goal) + self._residual[nearest]
        return self.spline.with_ends(np.clip(control, limits.lower, limits.upper), query.start, query.goal)


def features(conditions: Conditions) -> NDArray[np.float32]:
    """Return the features by which neighbors are compared, shape (B, features) [rad]."""
    least = pad_obstacles(conditions.probe_distances().clamp(-NEAR, NEAR), conditions.mask, NEAR).amin(dim=1)
    rows = torch.cat([conditions.start, conditions.goal, PER_METRE * least / least.shape[1] ** 0.5], dim=1)
    return np.asarray(rows.numpy(), np.float32)
