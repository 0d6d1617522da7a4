"""Depth images of primitives by closed forms, and maps by brute force: what occupancy maps are tested with."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import coal
import numpy as np
import pinocchio as pin

from apex_ompl.collision.shapes import world_geometry
from apex_ompl.perception import Camera, OccupancyMap
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import AttachedObject, Body

Placed = tuple[coal.CollisionGeometry, np.ndarray]


def placed_bodies(bodies: Iterable[Body]) -> list[Placed]:
    return [world_geometry(body) for body in bodies]


def placed_robot(robot: Robot, q: np.ndarray, held: Sequence[AttachedObject] = ()) -> list[Placed]:
    """The robot's primitives and its held boxes in a state."""
    data = robot.model.createData()
    pin.forwardKinematics(robot.model, data, robot.to_pinocchio(q))
    found = [
        (item.geometry, (data.oMi[item.parentJoint] * item.placement).homogeneous)
        for item in robot.geometry.geometryObjects
    ]
    return found + [(world_geometry(one)[0], robot.link_pose(q, one.link) @ one.pose) for one in held]


def _entry(shape: coal.CollisionGeometry, start: np.ndarray, along: np.ndarray) -> np.ndarray:
    """Parameter at which rays from one point enter a solid, inf where they do not, shape (N,)."""
    with np.errstate(divide="ignore", invalid="ignore"):
        if isinstance(shape, coal.Box):
            a, b = (-shape.halfSide - start) / along, (shape.halfSide - start) / along
            low, high = np.minimum(a, b).max(axis=1), np.maximum(a, b).min(axis=1)
        elif isinstance(shape, coal.Sphere):
            low, high = _roots((along**2).sum(axis=1), along @ start, start @ start - shape.radius**2)
        else:
            assert isinstance(shape, coal.Cylinder), shape
            flat, at = along[:, :2], start[:2]
            low, high = _roots((flat**2).sum(axis=1), flat @ at, at @ at - shape.radius**2)
            a, b = ((s * shape.halfLength - start[2]) / along[:, 2] for s in (-1.0, 1.0))
            low, high = np.maximum(low, np.minimum(a, b)), np.minimum(high, np.maximum(a, b))
    return np.where((low <= high) & (low > 0.0), low, np.inf)


def _roots(a: np.ndarray, b: np.ndarray, c: float) -> tuple[np.ndarray, np.ndarray]:
    turn = np.sqrt(b * b - a * c)
    return (-b - turn) / a, (-b + turn) / a


def true_depth(solids: Iterable[Placed], camera: Camera, pose: np.ndarray) -> np.ndarray:
    """What the camera sees, shape (height, width) [m]; 0 where there is nothing."""
    rays = np.concatenate([camera.grid.reshape(-1, 2), np.ones((camera.width * camera.height, 1))], axis=1)
    along, found = rays @ pose[:3, :3].T, np.full(len(rays), np.inf)
    for shape, at in solids:
        start = at[:3, :3].T @ (pose[:3, 3] - at[:3, 3])
        found = np.minimum(found, _entry(shape, start, along @ at[:3, :3]))
    return np.where(np.isfinite(found), found, 0.0).reshape(camera.height, camera.width)


def free_by_rays(grid: OccupancyMap, depth: np.ndarray, camera: Camera, pose: np.ndarray) -> np.ndarray:
    """Voxels that some pixel's ray passes through before its depth, in steps of a tenth of a voxel; brute force."""
    seen, side = np.zeros(grid.evidence.shape, bool), grid.resolution
    rays = np.concatenate([camera.grid.reshape(-1, 2), np.ones((depth.size, 1))], axis=1) @ pose[:3, :3].T
    for ray, far in zip(rays, depth.ravel(), strict=True):
        steps = np.arange(0.0, far, 0.1 * side / np.linalg.norm(ray))
        cells = np.floor((pose[:3, 3] + steps[:, None] * ray - grid.origin) / side).astype(int)
        cells = cells[((cells >= 0) & (cells < seen.shape)).all(axis=1)]
        seen[tuple(cells.T)] = True
    return seen
