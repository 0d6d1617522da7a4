"""Bounds of obstacles: bodies that contain them, as sensors give them that see an obstacle from one side at first."""

from __future__ import annotations

from itertools import product

import coal
import numpy as np
import pinocchio as pin

from apex_ompl.collision.hulls import convex_hull
from apex_ompl.collision.shapes import world_geometry
from apex_ompl.collision.solids import transform
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.scene.meshes import triangles
from apex_ompl.types import Array
from apex_ompl.util.arrays import bounding_box

DOT = coal.Sphere(1e-9)  # a point
AROUND = 32  # points around a circle
BELTS = 8  # circles of points on half a ball


def gap(first: Obstacle, second: Obstacle) -> float:
    """Return the distance between the convex hulls of two obstacles, 0 where they overlap [m]."""
    return _distance(*_convex(first), *_convex(second))


def protrusion(inner: Obstacle, bound: Obstacle) -> float:
    """Return how far an obstacle reaches out of the convex hull of another, 0 where it is inside [m].

    The distance from a convex body is a convex function, so that corners decide. Round surfaces have corners outside
    of them, at most 0.5 % of the radius.
    """
    shape, there = _convex(bound)
    return max(_distance(DOT, pin.SE3(np.eye(3), corner), shape, there) for corner in _corners(inner))


def change(first: Obstacle, second: Obstacle) -> float:
    """Return the largest difference of the half extents of two obstacles along the axes of the world [m].

    Where both contain the same obstacle, their centers show its way up to this, as one of its ends is seen.
    """
    return float(np.abs(np.ptp(_corners(first), axis=0) - np.ptp(_corners(second), axis=0)).max()) / 2.0


def _convex(obstacle: Obstacle) -> tuple[coal.CollisionGeometry, pin.SE3]:
    shape, pose = world_geometry(obstacle)
    return convex_hull(shape) if isinstance(shape, coal.BVHModelBase) else shape, pin.SE3(pose)


def _distance(first: coal.CollisionGeometry, at: pin.SE3, second: coal.CollisionGeometry, there: pin.SE3) -> float:
    found = coal.distance(first, transform(at), second, transform(there), coal.DistanceRequest(), coal.DistanceResult())
    return max(0.0, float(found))


def _corners(obstacle: Obstacle) -> Array:
    """Return points in the world whose convex hull contains an obstacle, shape (N, 3) [m]."""
    shape, pose = world_geometry(obstacle)
    local = np.empty((0, 3))
    angle = 2.0 * np.pi * np.arange(AROUND) / AROUND
    ring = np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1) / np.cos(np.pi / AROUND)
    if isinstance(shape, coal.BVHModelBase):
        local = triangles(shape)[0]
    elif isinstance(shape, coal.Box):
        local = np.array(list(product((-1.0, 1.0), repeat=3))) * shape.halfSide
    elif isinstance(shape, coal.Cylinder):
        ends = ring * shape.radius
        local = np.concatenate([ends + (0.0, 0.0, side * shape.halfLength) for side in (-1.0, 1.0)])
    elif isinstance(shape, coal.Sphere | coal.Capsule):
        tilt = np.linspace(-np.pi / 2.0, np.pi / 2.0, 2 * BELTS + 1)
        ball = np.concatenate([ring * (np.cos(t), np.cos(t), 0.0) + (0.0, 0.0, np.sin(t)) for t in tilt])
        ball *= shape.radius / np.cos(np.pi / (4 * BELTS))
        half = shape.halfLength if isinstance(shape, coal.Capsule) else 0.0
        local = np.concatenate([ball + (0.0, 0.0, side * half) for side in (-1.0, 1.0)])
    else:
        low, high = bounding_box(np.array([[shape.aabb_local.min_, shape.aabb_local.max_]]))
        local = np.array(list(product(*zip(low, high, strict=True))))
    return np.asarray(local @ pose[:3, :3].T + pose[:3, 3])
