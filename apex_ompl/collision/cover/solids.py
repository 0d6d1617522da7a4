"""Solids in their own frame, as the proof of a cover needs them.

A solid is a union of convex parts: one for a box, a cylinder, a capsule, a sphere or a convex mesh. A mesh that is
not convex is cut into the cells of a grid. By the theorem of Krein and Milman, the part of the solid in a cell lies in
the convex hull of its extreme points. Each extreme point is on the surface or a corner of the cell, since any other
point is interior to a segment inside the part. The hull of the surface clipped to the cell and of the corners inside
the solid therefore contains the part, and the hulls of all cells contain the solid.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import coal
import numpy as np

from apex_ompl.collision.containment import EnclosingMesh
from apex_ompl.collision.hulls import convex_hull
from apex_ompl.collision.shapes import is_shell
from apex_ompl.errors import ParameterError
from apex_ompl.kernel.geometry import BallTree, EnclosingSurface, surface_distances, tree_order
from apex_ompl.scene.meshes import capped, is_watertight, triangles
from apex_ompl.types import Array, Flags

FLAT = 1e-6  # points that spread less than this lie in one plane and have no hull [m]
CELLS = 14  # cells of the grid along the longest side of a mesh that is not convex
SMALLEST_CELL, LARGEST_CELL = 0.005, 0.06  # [m]
FIELD = 100_000  # grid points at which the depth of a mesh that is not convex is sampled


class Part(Protocol):
    """A convex part of a solid, in the frame of the geometry."""

    @property
    def low(self) -> Array:
        """Lower corner of the bounding box, shape (3,) [m]."""

    @property
    def high(self) -> Array:
        """Upper corner of the bounding box, shape (3,) [m]."""

    def outside(self, centers: Array, halves: Array) -> Flags:
        """Which axis-parallel boxes, centers and half sides of shape (N, 3) [m], are proved disjoint from the part."""

    def depth(self, points: Array) -> Array:
        """Return the depth of points, shape (N, 3), below the surface; negative outside, shape (N,) [m]."""

    def surface(self, spacing: float) -> Array:
        """Return points on the surface about ``spacing`` apart, all corners included, shape (N, 3) [m]."""


@dataclass(frozen=True, eq=False)
class Polytope:
    """The points x with normals @ x <= offsets; ``faces`` are triangles of its surface, shape (F, 3, 3) [m]."""

    normals: Array
    offsets: Array
    faces: Array
    low: Array
    high: Array

    @classmethod
    def around(cls, points: Array) -> Polytope:
        """Return a polytope that contains points, shape (N, 3): their hull, or a slab if they are flat.

        Every offset is the largest over all points, so the polytope contains them whatever the normals are.
        """
        low, high = points.min(axis=0), points.max(axis=0)
        middle = points.mean(axis=0)
        _, spread, axes = np.linalg.svd(points - middle, full_matrices=False)
        normals = [np.eye(3), -np.eye(3)]
        faces = np.zeros((0, 3, 3))
        if len(points) >= 4 and spread[2] > FLAT:
            vector = coal.StdVec_Vec3s()
            vector.extend(list(points))
            hull = coal.Convex.convexHull(vector, True, "Qt")
            corners = np.array(hull.points())
            rows = np.array([[t[0], t[1], t[2]] for t in (hull.polygons(k) for k in range(hull.num_polygons))])
            faces = corners[rows]
            cross = np.cross(faces[:, 1] - faces[:, 0], faces[:, 2] - faces[:, 0])
            size = np.linalg.norm(cross, axis=1)
            keep = size > 1e-12
            normal = cross[keep] / size[keep, None]
            side = np.einsum("ij,ij->i", normal, faces[keep, 0] - middle)
            normal *= np.where(side < 0, -1.0, 1.0)[:, None]
            # One of several nearly parallel faces is enough; leaving planes out only enlarges the polytope.
            order = np.argsort(-size[keep], kind="stable")
            _, first = np.unique(np.round(normal[order] / 0.02), axis=0, return_index=True)
            normals.append(normal[order][np.sort(first)])
        else:
            normals += [axes, -axes]
            if len(points) >= 3:
                faces = np.stack([points, np.roll(points, 1, axis=0), np.roll(points, 2, axis=0)], axis=1)
        stacked = np.concatenate(normals)
        return cls(stacked, (points @ stacked.T).max(axis=0), faces, low, high)

    @classmethod
    def box(cls, half: Array) -> Polytope:
        """Return a box around the origin from its half sides, shape (3,) [m]."""
        signs = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
        quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
        rows = np.array([[q[0], q[k], q[k + 1]] for q in quads for k in (1, 2)])
        normals = np.concatenate([np.eye(3), -np.eye(3)])
        return cls(normals, np.tile(half, 2), (signs * half)[rows], -half, half)

    def outside(self, centers: Array, halves: Array) -> Flags:
        """See :class:`Part`."""
        nearest = centers @ self.normals.T - halves @ np.abs(self.normals).T
        return np.asarray((nearest > self.offsets).any(axis=1))

    def depth(self, points: Array) -> Array:
        """See :class:`Part`; outside, the distance is at least the negative depth."""
        result: Array = (self.offsets - points @ self.normals.T).min(axis=1)
        return result

    def surface(self, spacing: float) -> Array:
        """See :class:`Part`."""
        return triangle_points(self.faces, spacing)


@dataclass(frozen=True, eq=False)
class RoundBody:
    """A cylinder or, with ``capped``, a capsule along z around the origin; a sphere is a capsule without length."""

    radius: float
    half_length: float
    capped: bool

    @property
    def low(self) -> Array:
        """See :class:`Part`."""
        return -self.high

    @property
    def high(self) -> Array:
        """See :class:`Part`."""
        return np.array([self.radius, self.radius, self.half_length + self.capped * self.radius])

    def outside(self, centers: Array, halves: Array) -> Flags:
        """See :class:`Part`."""
        near = np.maximum(np.abs(centers) - halves, 0.0)
        across = np.hypot(near[:, 0], near[:, 1])
        along = near[:, 2] - self.half_length
        if self.capped:
            return np.asarray(np.hypot(across, np.maximum(along, 0.0)) > self.radius)
        return np.asarray((across > self.radius) | (along > 0.0))

    def depth(self, points: Array) -> Array:
        """See :class:`Part`; outside a cylinder, the distance is at least the negative depth."""
        across = np.hypot(points[:, 0], points[:, 1])
        along = np.abs(points[:, 2]) - self.half_length
        if self.capped:
            return np.asarray(self.radius - np.hypot(across, np.maximum(along, 0.0)))
        return np.asarray(np.minimum(self.radius - across, -along))

    def surface(self, spacing: float) -> Array:
        """See :class:`Part`."""
        turns = max(8, int(np.ceil(2 * np.pi * self.radius / spacing)))
        heights = np.linspace(-1.0, 1.0, max(2, int(np.ceil(2 * self.half_length / spacing)) + 1)) * self.half_length
        rings = [(self.radius, z) for z in heights]
        steps = max(2, int(np.ceil((1.6 if self.capped else 1.0) * self.radius / spacing)))
        for k in range(steps):
            if self.capped:
                angle = 0.5 * np.pi * (k + 1) / steps
                ring = (self.radius * np.cos(angle), self.half_length + self.radius * np.sin(angle))
            else:
                ring = (self.radius * k / steps, self.half_length)
            rings += [ring, (ring[0], -ring[1])]
        points = []
        for k, (size, z) in enumerate(rings):
            count = max(1, int(np.ceil(turns * size / self.radius - 1e-9)))
            angles = 2 * np.pi * (np.arange(count) + 0.5 * (k % 2)) / count
            points.append(np.stack([size * np.cos(angles), size * np.sin(angles), np.full(count, z)], axis=1))
        return np.concatenate(points)


def triangle_points(corners: Array, spacing: float) -> Array:
    """Return points on triangles, shape (T, 3, 3), at most ``spacing`` apart, with all corners, shape (N, 3)."""
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    steps = np.maximum(1, np.ceil(longest / spacing)).astype(int)
    points = [np.zeros((0, 3))]
    for n in np.unique(steps):
        weights = np.array([(i, j, n - i - j) for i in range(n + 1) for j in range(n + 1 - i)]) / n
        points.append(np.einsum("wk,tkd->twd", weights, corners[steps == n]).reshape(-1, 3))
    stacked = np.concatenate(points)
    # One of the points that coincide, on shared edges and in slivers.
    _, first = np.unique(np.round(stacked / (0.5 * spacing)), axis=0, return_index=True)
    return np.concatenate([corners.reshape(-1, 3), stacked[np.sort(first)]])


@dataclass(frozen=True, eq=False)
class Field:
    """Depths on a regular grid, interpolated between grid points: an estimate for solids of several parts."""

    low: Array
    step: Array
    values: Array

    @classmethod
    def over(cls, low: Array, high: Array, skin: Array, contains: Callable[[Array], Flags], count: int) -> Field:
        """Sample depths at about ``count`` grid points, by distances to the triangles ``skin``, shape (T, 3, 3) [m]."""
        spacing = float(np.prod(high - low) / count) ** (1 / 3)
        numbers = np.maximum(np.ceil((high - low) / spacing).astype(int), 2)
        lines = [np.linspace(a, b, n + 1) for a, b, n in zip(low, high, numbers, strict=True)]
        grid = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, 3)
        tree = BallTree.over(np.ascontiguousarray(skin[tree_order(skin.mean(axis=1))]))
        depths = np.where(contains(grid), 1.0, -1.0) * surface_distances(grid, tree, np.inf)
        return cls(low, (high - low) / numbers, depths.reshape(numbers + 1))

    def __call__(self, points: Array) -> Array:
        """Return depths at points, shape (N, 3): shape (N,) [m], by trilinear interpolation."""
        last = np.array(self.values.shape) - 2
        place = (points - self.low) / self.step
        cell = np.clip(np.floor(place).astype(int), 0, last)
        share = np.clip(place - cell, 0.0, 1.0)
        depths = np.zeros(len(points))
        for corner in np.ndindex(2, 2, 2):
            weight = np.where(corner, share, 1.0 - share).prod(axis=1)
            depths += weight * self.values[tuple((cell + corner).T)]
        return depths


@dataclass(frozen=True, eq=False)
class Solid:
    """A union of convex parts.

    Attributes:
        parts: The parts.
        skin: Triangles of the surface of a solid of several parts, shape (T, 3, 3) [m]; None for a single part.
        depths: Number of grid points at which the depth of a solid of several parts is sampled.
    """

    parts: tuple[Part, ...]
    skin: Array | None = None
    depths: int = FIELD

    @property
    def low(self) -> Array:
        """Lower corner of the bounding box, shape (3,) [m]."""
        return np.asarray(np.min([part.low for part in self.parts], axis=0))

    @property
    def high(self) -> Array:
        """Upper corner of the bounding box, shape (3,) [m]."""
        return np.asarray(np.max([part.high for part in self.parts], axis=0))

    def contains(self, points: Array) -> Flags:
        """Which points, shape (N, 3), lie in the union of the parts, shape (N,)."""
        if len(self.parts) == 1:
            return np.asarray(self.parts[0].depth(points) >= 0.0)
        found = np.zeros(len(points), bool)
        for part in self.parts:
            near = np.flatnonzero(((points >= part.low) & (points <= part.high)).all(axis=1) & ~found)
            found[near] = part.depth(points[near]) >= 0.0
        return found

    def depth(self, points: Array) -> Array:
        """Return the depth of points below the surface, shape (N,) [m]; for several parts an estimate, not a bound."""
        return self.parts[0].depth(points) if self.skin is None else self._field(points)

    @cached_property
    def _field(self) -> Field:
        assert self.skin is not None
        return Field.over(self.low, self.high, self.skin, self.contains, self.depths)

    def surface(self, spacing: float) -> Array:
        """Return points on the surfaces of the parts about ``spacing`` apart, shape (N, 3) [m]."""
        return np.concatenate([part.surface(spacing) for part in self.parts])

    def inside(self, count: int) -> Array:
        """Return the points inside the solid of a grid of about ``count`` points over its bounding box, (N, 3)."""
        low, high = self.low, self.high
        size = np.maximum(high - low, 1e-9)
        spacing = float(np.prod(size) / count) ** (1 / 3)
        numbers = [max(3, int(round(s / spacing))) for s in size]
        axes = [lo + s * (np.arange(n) + 0.5) / n for lo, s, n in zip(low, size, numbers, strict=True)]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        return grid[self.contains(grid)]


def solid_of(geometry: coal.CollisionGeometry) -> Solid:
    """Return the solid of a box, sphere, cylinder, capsule, convex body or mesh.

    Raises:
        ParameterError: Another kind of geometry.
    """
    kind = geometry.getNodeType()
    if kind == coal.GEOM_BOX:
        return Solid((Polytope.box(np.array(geometry.halfSide, float)),))
    if kind == coal.GEOM_SPHERE:
        return Solid((RoundBody(float(geometry.radius), 0.0, capped=True),))
    if kind in (coal.GEOM_CYLINDER, coal.GEOM_CAPSULE):
        capsule = bool(kind == coal.GEOM_CAPSULE)
        return Solid((RoundBody(float(geometry.radius), float(geometry.halfLength), capped=capsule),))
    if kind == coal.GEOM_CONVEX:
        return Solid((Polytope.around(np.array(geometry.points())),))
    if not is_shell(geometry):
        raise ParameterError("geometry", kind, "a box, sphere, cylinder, capsule, convex body or mesh")
    if EnclosingMesh.of(geometry).convex:
        return Solid((Polytope.around(np.array(convex_hull(geometry).points())),))
    return _cells(capped(*triangles(geometry)))


def _cells(corners: Array) -> Solid:
    """Return the solid inside a closed surface, triangles of shape (T, 3, 3) [m], cut into the cells of a grid."""
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    size = float(np.clip((high - low).max() / CELLS, SMALLEST_CELL, LARGEST_CELL))
    # Cells that overlap the box by an odd fraction keep the planes of the grid off planar surfaces.
    counts = np.ceil((high - low) / size + 0.3).astype(int)
    lines = [
        0.5 * (a + b) + size * (np.arange(n + 1) - 0.5 * n + 0.0137) for a, b, n in zip(low, high, counts, strict=True)
    ]
    grid = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1)
    surface = EnclosingSurface(np.ascontiguousarray(corners), np.stack([low, high]), is_watertight(corners))
    within = np.array([surface.encloses(p) for p in grid.reshape(-1, 3)]).reshape(grid.shape[:3])
    triangle_low, triangle_high = corners.min(axis=1), corners.max(axis=1)
    parts: list[Part] = []
    for i, j, k in np.ndindex(*(int(n) for n in counts)):
        start, stop = grid[i, j, k], grid[i + 1, j + 1, k + 1]
        box = np.ix_([i, i + 1], [j, j + 1], [k, k + 1])
        near = np.flatnonzero(((triangle_low <= stop) & (triangle_high >= start)).all(axis=1))
        inner = ((triangle_low[near] >= start) & (triangle_high[near] <= stop)).all(axis=1)
        points = [grid[box].reshape(-1, 3)[within[box].ravel()], corners[near[inner]].reshape(-1, 3)]
        points += [_clip(triangle, start, stop) for triangle in corners[near[~inner]]]
        stacked = np.concatenate(points)
        if len(stacked):
            parts.append(Polytope.around(stacked))
    return Solid(tuple(parts), corners)


def _clip(triangle: Array, low: Array, high: Array) -> Array:
    """Return the corners of a triangle, shape (3, 3), clipped to a box, shape (N, 3) (Sutherland, Hodgman 1974)."""
    polygon = list(triangle)
    for axis in range(3):
        for sign, bound in ((1.0, high[axis]), (-1.0, -low[axis])):
            beyond = [sign * p[axis] - bound for p in polygon]
            kept: list[Array] = []
            for k, point in enumerate(polygon):
                before, here = beyond[k - 1], beyond[k]
                if (before > 0.0) != (here > 0.0):
                    kept.append(polygon[k - 1] + before / (before - here) * (point - polygon[k - 1]))
                if here <= 0.0:
                    kept.append(point)
            polygon = kept
            if not polygon:
                return np.zeros((0, 3))
    return np.array(polygon)
