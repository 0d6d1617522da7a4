"""Axes of boxes, whose names and signs an observation has by chance."""

from __future__ import annotations

from itertools import permutations, product

import numpy as np
import pinocchio as pin

from apex_ompl.perception.obstacles import SeenObstacle
from apex_ompl.types import Array, Indices

TURN, SIZE = slice(0, 3), slice(6, 9)  # of an observation
ROUNDING = 1e-10  # of variances of innovations, which are singular for cylinders [m^2; rad^2]


def _turns() -> tuple[Indices, Array]:
    """Return the axes of a box in another order, shape (24, 3), and these rotations, shape (24, 3, 3)."""
    orders, turns = [], []
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            turn = np.zeros((3, 3))
            turn[list(order), range(3)] = signs
            if np.linalg.det(turn) > 0.0:
                orders.append(order)
                turns.append(turn)
    return np.array(orders), np.array(turns)


ORDERS, TURNS = _turns()


def aligned(one: SeenObstacle, rotation: Array, size: Array, covariance: Array) -> SeenObstacle:
    """Return an observation with its axes in the order and with the signs that are most like known ones.

    Args:
        one: The observation.
        rotation: Known axes in the world, shape (3, 3).
        size: Known lengths along them, shape (3,) [m].
        covariance: Of turn, position and lengths, shape (9, 9).
    """
    pose = one.pose.copy()
    if one.kind == "cylinder":
        axis, own = rotation[:, 2], one.pose[:3, 2]
        turned = pin.Quaternion.FromTwoVectors(axis, own if axis @ own > 0.0 else -own).matrix()
        pose[:3, :3] = turned @ rotation
        return SeenObstacle(one.kind, pose, one.size, one.covariance, one.cut, one.points)
    rotations, sizes = pose[:3, :3] @ TURNS, one.size[ORDERS]
    angle = np.array([pin.log3(turned @ rotation.T) for turned in rotations])
    spread = one.covariance[TURN, TURN] + covariance[TURN, TURN] + ROUNDING * np.eye(3)
    variances = np.diag(one.covariance)[SIZE][ORDERS] + np.diag(covariance)[SIZE] + ROUNDING
    distance = np.einsum("ij,ij->i", angle, np.linalg.solve(spread, angle.T).T)
    distance += ((sizes - size) ** 2 / variances).sum(axis=1)
    best = int(np.argmin(distance))
    order = [*range(6), *(6 + ORDERS[best])]
    pose[:3, :3] = rotations[best]
    return SeenObstacle(one.kind, pose, sizes[best], one.covariance[np.ix_(order, order)], one.cut, one.points)
