"""Convex parts of solids, in the frame of the geometry: polytopes, cylinders, capsules and spheres."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import coal
import numpy as np

from apex_ompl.types import Array, Flags

FLAT = 1e-6  # points that spread less than this lie in one plane and have no hull [m]


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
