"""Depths along rays without a renderer: closed forms, and sphere tracing by distances of Coal."""

from __future__ import annotations

from collections.abc import Sequence

import coal
import numpy as np
import pinocchio as pin

from apex_ompl.collision.shapes import coal_geometry
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import Body

CAUTION, CLOSE, FARTHEST, STEPS = 0.9, 2e-5, 6.0, 1000  # shares of distances, and [m]


def box_depths(origin: np.ndarray, rays: np.ndarray, center: Sequence[float], size: Sequence[float]) -> np.ndarray:
    """Return where rays, shape (N, 3), enter an upright box, as multiples of the rays; infinity without a hit."""
    with np.errstate(divide="ignore"):
        ends = (np.asarray(center) + np.multiply.outer([-0.5, 0.5], size) - origin)[:, None] / rays
    enters, leaves = ends.min(axis=0).max(axis=1), ends.max(axis=0).min(axis=1)
    return np.where((enters < leaves) & (enters > 0.0), enters, np.inf)


def ball_depths(origin: np.ndarray, rays: np.ndarray, center: Sequence[float], radius: float) -> np.ndarray:
    """Return where rays, shape (N, 3), enter a ball, as multiples of the rays; infinity without a hit."""
    apart = np.asarray(origin) - center
    a, b, c = (rays * rays).sum(axis=1), rays @ apart, apart @ apart - radius**2
    inner = b * b - a * c
    return np.where(inner > 0.0, (-b - np.sqrt(np.maximum(inner, 0.0))) / a, np.inf)


def floor_depths(origin: np.ndarray, rays: np.ndarray, height: float, half: float) -> np.ndarray:
    """Return where rays, shape (N, 3), meet a square of a height with half an edge around the z axis."""
    with np.errstate(divide="ignore", invalid="ignore"):
        at = (height - origin[2]) / rays[:, 2]
        hits = origin + at[:, None] * rays
    return np.where((at > 0.0) & (np.abs(hits[:, :2]) < half).all(axis=1), at, np.inf)


class Tracer:
    """The robot in a state, and bodies at poses."""

    def __init__(self, robot: Robot, q: np.ndarray, bodies: Sequence[tuple[Body, np.ndarray]]) -> None:
        """Place them."""
        data, placed = robot.model.createData(), robot.geometry.createData()
        pin.updateGeometryPlacements(robot.model, data, robot.geometry, placed, robot.to_pinocchio(q))
        items = [(item.geometry, place) for item, place in zip(robot.geometry.geometryObjects, placed.oMg, strict=True)]
        items += [(coal_geometry(body), pin.SE3(pose)) for body, pose in bodies]
        self._objects = [
            coal.CollisionObject(shape, coal.Transform3s(at.rotation, at.translation)) for shape, at in items
        ]
        self._manager = coal.DynamicAABBTreeCollisionManager()
        for item in self._objects:
            self._manager.registerObject(item)
        self._manager.setup()

    def distance(self, point: np.ndarray) -> float:
        """Return the distance of a point from the next surface [m]."""
        ball = coal.CollisionObject(coal.Sphere(1e-6), coal.Transform3s(np.eye(3), point))
        callback = coal.DistanceCallBackDefault()
        self._manager.distance(ball, callback)
        return float(callback.data.result.min_distance)

    def depths(self, origin: np.ndarray, rays: np.ndarray) -> np.ndarray:
        """Return where rays, shape (N, 3), meet a surface, as multiples of the rays; infinity without a hit."""
        found = np.full(len(rays), np.inf)
        for k, ray in enumerate(rays):
            length, t = np.linalg.norm(ray), 0.0
            for _ in range(STEPS):
                apart = self.distance(origin + t * ray / length)
                t += CAUTION * apart
                if apart < CLOSE:
                    found[k] = t / length
                if apart < CLOSE or t > FARTHEST:
                    break
        return found
