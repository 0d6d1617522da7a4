"""Geometry without a robot: trees over triangles and points, distances to them, meshes that enclose, and grid cells."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from apex_ompl.kernel.compiled.geometry import (
    bounding_trees,
    cloud_distance,
    convex_distance,
    grid_regions,
    triangles,
)
from apex_ompl.kernel.compiled.layout import Integers
from apex_ompl.types import Array

STACK = 128  # nodes that wait in a traversal of a tree
OUTSIDE, OCCUPIED = grid_regions.OUTSIDE, grid_regions.OCCUPIED  # labels of cells


class BallTree(NamedTuple):
    """A binary tree of balls over triangles, or over points; nodes stand level by level.

    Attributes:
        corners: Triangles in the tree's order, shape (T, 3, 3), or points, shape (T, 1, 3) [m].
        balls: Center and radius of a ball around the items below each node, shape (2 T - 1, 4) [m].
        halves: Half edges of their bounding box, which has the same center, shape (2 T - 1, 3) [m].
        child: First child of each node, the second follows it; -1 for leaves, shape (2 T - 1,).
        leaf: Item of each leaf, -1 for inner nodes, shape (2 T - 1,).
    """

    corners: Array
    balls: Array
    halves: Array
    child: Integers
    leaf: Integers

    @classmethod
    def over(cls, corners: Array) -> BallTree:
        """Return the tree over items in the order of :func:`tree_order`, shape (T, k, 3) [m].

        Each node holds a range of items, its children the two halves.
        """
        first, last = np.zeros(1, np.int64), np.array([len(corners)])
        firsts, lasts, child, leaf, count = [], [], [], [], 1
        while len(first):
            firsts.append(first)
            lasts.append(last)
            inner = last - first > 1
            number = np.full(len(first), -1, np.int64)
            number[inner] = count + 2 * np.arange(int(inner.sum()))
            child.append(number)
            leaf.append(np.where(inner, -1, first))
            count += 2 * int(inner.sum())
            middle = (first + last)[inner] // 2
            first = np.stack([first[inner], middle], axis=1).ravel()
            last = np.stack([middle, last[inner]], axis=1).ravel()
        balls, halves = np.empty((count, 4)), np.empty((count, 3))
        items = np.ascontiguousarray(corners)
        bounding_trees.node_balls(items, np.concatenate(firsts), np.concatenate(lasts), balls, halves)
        return cls(corners, balls, halves, np.concatenate(child), np.concatenate(leaf))


def tree_order(centers: Array) -> Integers:
    """Return points, shape (N, 3) [m], in the order of a tree whose nodes are halved across their longest sides."""
    order = np.arange(len(centers))
    bounding_trees.median_order(np.ascontiguousarray(centers), order, np.empty((STACK, 2), np.int64))
    return order


class EnclosingSurface(NamedTuple):
    """A surface that may enclose points.

    Attributes:
        corners: Corners of its triangles, shape (T, 3, 3) [m].
        box: Its bounding box, shape (2, 3) [m].
        watertight: Whether each edge occurs equally often in both directions, bit for bit: winding numbers are whole
            numbers then, which crossings of a ray give.
    """

    corners: Array
    box: Array
    watertight: bool

    def encloses(self, point: Array) -> bool:
        """Whether its winding number around a point that is not on it exceeds 1/2, without its sign.

        Args:
            point: Shape (3,) [m].
        """
        x, y, z = point.tolist()
        return bool(triangles.encloses(self.corners, self.box, self.watertight, x, y, z))


def surface_distances(points: Array, tree: BallTree, limit: float) -> Array:
    """Return the distances of points, shape (N, 3) [m], from the nearest triangle, at most a limit, shape (N,) [m]."""
    distances, stack = np.empty(len(points)), np.empty(STACK, np.int64)
    corners, balls, _, child, leaf = tree
    triangles.surface_distances(
        points, np.ascontiguousarray(corners), balls, child, leaf, stack, limit, distances
    )  # fmt: skip
    return distances


def primitive_distances(points: Array, kind: int, size: Array) -> Array:
    """Return the signed distances of points from a primitive in its frame, shape (N,) [m].

    Args:
        points: Shape (N, 3) [m].
        kind: BOX, SPHERE, CYLINDER or CAPSULE.
        size: Half edges; radius; or radius and half length along z, shape (3,) [m].
    """
    distances = np.empty(len(points))
    cloud_distance.primitive_distances(points, kind, size, distances)
    return distances


def near_primitive(cloud: BallTree, kind: int, size: Array, pose: Array, limit: float) -> bool:
    """Whether any point of a cloud is within a distance of a primitive, or inside of it.

    Args:
        cloud: Points, as items of shape (N, 1, 3) [m].
        kind: BOX, SPHERE, CYLINDER or CAPSULE.
        size: Half edges; radius; or radius and half length along z, shape (3,) [m].
        pose: Pose of the primitive in the frame of the points, shape (4, 4) [m].
        limit: The distance [m].
    """
    corners, balls, _, child, leaf = cloud
    stack = np.empty((STACK, 2), np.int64)
    return bool(cloud_distance.near_primitive(corners, balls, child, leaf, kind, size, pose, limit, stack))


def near_mesh(cloud: BallTree, mesh: BallTree, pose: Array, limit: float) -> bool:
    """Whether any point of a cloud is within a distance of any triangle of a mesh.

    Args:
        cloud: Points, as items of shape (N, 1, 3) [m].
        mesh: Triangles, shape (T, 3, 3) [m].
        pose: Pose of the mesh in the frame of the points, shape (4, 4) [m].
        limit: The distance [m].
    """
    return bool(cloud_distance.near_mesh(*cloud, *mesh, pose, limit, np.empty((STACK, 2), np.int64)))


def any_inside(cloud: BallTree, mesh: EnclosingSurface, planes: tuple[Array, Array], pose: Array) -> bool:
    """Whether any point of a cloud is inside of a mesh, none being on its surface.

    Args:
        cloud: Points, as items of shape (N, 1, 3) [m].
        mesh: The mesh.
        planes: Outward unit normals of the planes of its convex hull, shape (P, 3), and their offsets, shape (P,) [m].
        pose: Pose of the mesh in the frame of the points, shape (4, 4) [m].
    """
    corners, balls, _, child, leaf = cloud
    stack = np.empty((STACK, 2), np.int64)
    return bool(cloud_distance.any_inside(corners, balls, child, leaf, *mesh, *planes, pose, stack))


def column_boxes(corners: Array, low: Array, width: Array, pad: float, columns: int) -> Array:
    """Return the bounding boxes of the parts of a surface in columns along each axis.

    A triangle is cut to each column that it reaches into, widened by ``pad``.

    Args:
        corners: Corners of the triangles, shape (T, 3, 3) [m].
        low: Least corner of the surface, shape (3,) [m].
        width: Widths of columns, shape (3,) [m].
        pad: Margin of columns against rounding [m].
        columns: Number C of columns along each of the two other axes.

    Returns:
        Shape (3, C, C, 2, 3) [m]: along which axis, the places along the other two axes in ascending order, least and
        largest corner; inf and -inf for empty columns.
    """
    boxes = np.full((3, columns, columns, 2, 3), np.inf)
    boxes[..., 1, :] = -np.inf
    room = np.empty((2, triangles.CORNERS, 3))
    triangles.column_boxes(np.ascontiguousarray(corners), low, width, pad, room, boxes)
    return boxes


def farthest_points(directions: Array, points: Array, first: Integers, middles: Array, half: float) -> Integers:
    """Return the number of the point that is farthest in each direction, shape (D,).

    Of points in cells only those in cells that may hold it are examined.

    Args:
        directions: Shape (D, 3).
        points: Points in the order of their cells, shape (N, 3) [m].
        first: First point of each cell, and N, shape (cells + 1,).
        middles: Middles of the cells, shape (cells, 3) [m].
        half: Half of a cell's side, and what rounding may add [m].
    """
    found = np.empty(len(directions), np.int64)
    convex_distance.farthest_points(np.ascontiguousarray(directions), points, first, middles, half, found)
    return found


def label_regions(cells: Integers) -> int:
    """Fill what occupied cells enclose, number the regions of connected cells in place, and return their number.

    Args:
        cells: 0 or OCCUPIED, shape (nx, ny, nz), with free cells on all sides; gets OUTSIDE, or OCCUPIED and the number
            of the region from 1 on.
    """
    return int(grid_regions.label_regions(cells, np.empty(cells.size, np.int64)))


def summed_volumes(cells: Integers) -> Integers:
    """Return the numbers of cells before each corner that are not zero (a summed volume table, Crow 1984).

    Args:
        cells: Shape (nx, ny, nz).

    Returns:
        Shape (nx + 1, ny + 1, nz + 1).
    """
    sums = np.zeros(tuple(n + 1 for n in cells.shape), np.int64)
    grid_regions.add_up(cells, sums)
    return sums


def best_box(sums: Integers, left: Integers, seeds: Integers, share: float) -> tuple[int, Integers]:
    """Return the number of cells in the best box, and its first cell and the one after its last, shape (2, 3).

    From each seed boxes grow along the three axes in all orders; the best holds the most cells that are left.

    Args:
        sums: Summed volumes of all cells that boxes may hold.
        left: Not zero where a cell is in no box yet, shape (nx, ny, nz).
        seeds: Cells to start from, shape (N, 3).
        share: Share of a layer of cells that must be marked for a box to grow by it.
    """
    box, best = np.empty((2, 3), np.int64), np.empty((2, 3), np.int64)
    return int(grid_regions.best_box(sums, left, seeds, share, box, best)), best
