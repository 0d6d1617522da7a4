"""Problems whose obstacles are meshes, points or voxels in place of shapes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from apex_ompl.collision.cloud_contact import signed_distances
from apex_ompl.collision.shapes import coal_geometry
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.scene.problem import Problem

SPACING, RADIUS, CELL = 0.005, 0.004, 0.01  # of points and voxels [m]
VERSIONS = ("shapes", "meshes", "points", "voxels")


def solid_of(body: Obstacle, shrunk: float = 0.0) -> trimesh.Trimesh:
    """Return the mesh of an obstacle in its own frame, smaller on all sides by a length [m]."""
    if body.box is not None:
        return trimesh.creation.box(np.maximum(np.array(body.box) - 2.0 * shrunk, 1e-4))
    if body.sphere is not None:
        return trimesh.creation.icosphere(4, max(body.sphere.radius - shrunk, 1e-4))
    bar = body.cylinder or body.capsule
    assert bar is not None
    radius, length = max(bar.radius - shrunk, 1e-4), bar.length
    if body.cylinder is not None:
        return trimesh.creation.cylinder(radius, max(length - 2.0 * shrunk, 1e-4), sections=64)
    return trimesh.creation.capsule(length, radius, count=[64, 64])


def version(problem: Problem, kind: str, folder: Path) -> Problem:
    """Return a problem in which the obstacles are meshes, points or voxels."""
    if kind == "shapes":
        return problem
    scene: list[Obstacle] = []
    clouds: list[np.ndarray] = []
    cells: list[Obstacle] = []
    for k, body in enumerate(problem.scene):
        if kind == "meshes":
            file = folder / f"{k}.stl"
            solid_of(body).export(file)
            fields: dict[str, Any] = {"position": body.position, "orientation": body.orientation}
            scene.append(Obstacle(name=body.name, mesh={"file": str(file)}, **fields))
        elif kind == "points":
            solid = solid_of(body, RADIUS)
            points = trimesh.sample.sample_surface_even(solid, int(2.0 * solid.area / SPACING**2) + 20, seed=k)[0]
            clouds.append(points @ body.pose[:3, :3].T + body.pose[:3, 3])
        else:
            cells.append(body)
    if clouds:
        np.save(folder / "cloud.npy", np.concatenate(clouds).astype(np.float32))
        scene.append(Obstacle(name="cloud", points={"file": str(folder / "cloud.npy"), "radius": RADIUS}))
    if cells:
        low, occupied = voxels(cells)
        np.savez_compressed(folder / "map.npz", occupied=occupied, resolution=CELL, origin=low)
        scene.append(Obstacle(name="map", voxels={"file": str(folder / "map.npz")}))
    return problem.model_copy(update={"scene": tuple(scene), "name": f"{problem.name} {kind}"})


def voxels(bodies: Sequence[Obstacle]) -> tuple[np.ndarray, np.ndarray]:
    """Return the outer corner of the first cell, and which cells have their centers inside of obstacles."""
    boxes = []
    for body in bodies:
        low, high = solid_of(body).bounds
        middle = body.pose[:3, :3] @ (low + high) / 2.0 + body.pose[:3, 3]
        reach = np.abs(body.pose[:3, :3]) @ (high - low) / 2.0
        boxes.append((middle - reach, middle + reach))
    low = CELL * np.floor(np.min([box[0] for box in boxes], axis=0) / CELL)
    count = np.ceil((np.max([box[1] for box in boxes], axis=0) - low) / CELL).astype(int) + 1
    inside = np.zeros(count, bool)
    for body, (least, most) in zip(bodies, boxes, strict=True):
        first = np.maximum(np.floor((least - low) / CELL).astype(int), 0)
        last = np.minimum(np.ceil((most - low) / CELL).astype(int) + 1, count)
        cells = np.stack(np.meshgrid(*[np.arange(a, b) for a, b in zip(first, last, strict=True)], indexing="ij"), -1)
        local = (low + CELL * (cells + 0.5) - body.pose[:3, 3]) @ body.pose[:3, :3]
        inside[tuple(slice(a, b) for a, b in zip(first, last, strict=True))] |= (
            signed_distances(coal_geometry(body), local.reshape(-1, 3), 1.0).reshape(local.shape[:-1]) <= 0.0
        )
    return low, inside
