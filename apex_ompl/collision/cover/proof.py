"""The proof that a tree of balls contains a solid.

Boxes over the solid are subdivided until each misses the solid or lies in a leaf and in all ancestors of that leaf.
A traversal may therefore prune a ball, with all balls below it, as soon as the ball is far enough from an obstacle.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from apex_ompl.collision.cover.solids import RoundBody, Solid
from apex_ompl.types import Array, Flags, Indices

PAD = 1e-6  # margin of the radii over the proved ones, which exceeds all rounding errors [m]
FINEST = 3e-4  # side of the smallest boxes of the proof [m] ...
FINEST_SHARE = 1 / 400  # ... or this share of the size of the solid where that is larger
TOO_MANY = 2_000_000  # boxes at once at which the proof is abandoned


@dataclass(frozen=True, eq=False)
class Cover:
    """A tree of balls in the frame of a geometry; the union of the leaves contains the solid.

    Attributes:
        centers: Shape (n, 3) [m].
        radii: Shape (n,) [m].
        first: Index of the first child of each ball, shape (n,); the root is ball 0, children follow their parent.
        count: Number of children, shape (n,); 0 for a leaf.
    """

    centers: Array
    radii: Array
    first: Indices
    count: Indices

    @property
    def parents(self) -> Indices:
        """Index of the parent of each ball, shape (n,); -1 for the root."""
        parents = np.full(len(self.radii), -1, dtype=np.int64)
        for k in np.flatnonzero(self.count):
            parents[self.first[k] : self.first[k] + self.count[k]] = k
        return parents

    @property
    def leaves(self) -> Indices:
        """Indices of the leaves, ascending."""
        return np.flatnonzero(self.count == 0).astype(np.int64)

    @property
    def levels(self) -> Indices:
        """Depth of each ball in the tree, shape (n,); 0 for the root."""
        levels = np.zeros(len(self.radii), dtype=np.int64)
        for k, parent in enumerate(self.parents):
            levels[k] = levels[parent] + 1 if parent >= 0 else 0
        return levels


def uncovered_boxes(solid: Solid, cover: Cover) -> Array:
    """Return the centers of boxes that are not proved to be covered, shape (N, 3) [m]; a proved cover has none."""
    part = solid.parts[0]
    if isinstance(part, RoundBody) and part.capped:
        return _uncovered_discs(part, cover)
    return _Proof(solid, cover).run(grow=False)


def grow_to_cover(solid: Solid, cover: Cover, coarser: float) -> Cover:
    """Return a cover whose radii are enlarged until the proof succeeds with boxes ``coarser`` times the smallest."""
    proof = _Proof(solid, cover)
    proof.finest *= coarser
    proof.run(grow=True)
    return Cover(cover.centers, proof.radii + 2.5 * PAD, cover.first, cover.count)


def distances(points: Array, centers: Array) -> Array:
    """Return the distances of points, shape (N, 3), to centers, shape (M, 3): shape (N, M)."""
    square = (points[:, None, 0] - centers[None, :, 0]) ** 2
    for axis in (1, 2):
        square += (points[:, None, axis] - centers[None, :, axis]) ** 2
    return np.asarray(np.sqrt(square))


def _farthest_distances(centers: Array, halves: Array, balls: Array) -> Array:
    """Return the distance of the farthest point of each box to each center of a ball: shape (N, n) [m].

    Args:
        centers: Centers of the boxes, shape (N, 3) [m].
        halves: Half sides of the boxes, shape (N, 3) [m].
        balls: Centers of the balls, shape (n, 3) [m].
    """
    square = np.zeros((len(centers), len(balls)))
    for axis in range(3):
        side = np.abs(centers[:, None, axis] - balls[None, :, axis])
        side += halves[:, None, axis]
        square += side * side
    return np.asarray(np.sqrt(square, out=square))


def worst_excess(far: Array, radii: Array, parents: Indices) -> Array:
    """Return max(far - radius) over each ball and its ancestors: shape (N, n) [m].

    A box whose farthest point is ``far`` from a center, shape (N, n), lies in the ball and in all its ancestors where
    the result is not positive.
    """
    excess = far - radii
    for k in range(1, len(radii)):  # parents precede their children
        np.maximum(excess[:, k], excess[:, parents[k]], out=excess[:, k])
    return excess


class _Proof:
    """Subdivision of boxes over a solid, with radii that may grow meanwhile."""

    def __init__(self, solid: Solid, cover: Cover) -> None:
        self.solid = solid
        self.centers, self.radii = cover.centers, cover.radii - PAD
        self.parents, self.leaves = cover.parents, cover.leaves
        self.finest = max(FINEST, float((solid.high - solid.low).max()) * FINEST_SHARE)

    def run(self, grow: bool) -> Array:
        """Return the centers of the boxes not covered, shape (N, 3); with ``grow`` none, as the radii are enlarged."""
        which, centers, halves = self._start()
        while len(centers):
            keep = self._touching(which, centers, halves)
            which, centers, halves = which[keep], centers[keep], halves[keep]
            last = bool(len(halves)) and float(halves.max()) * 2.0 <= self.finest
            uncovered = self._uncovered(centers, halves)
            if grow and last:
                self._grow(centers[uncovered], halves[uncovered])
                return np.zeros((0, 3))
            which, centers, halves = which[uncovered], centers[uncovered], halves[uncovered]
            if last or len(centers) > TOO_MANY:
                return centers
            if grow:
                self._grow_over_points(which, centers)
            elif len(found := self._counterexamples(which, centers)):
                return found
            which, centers, halves = _halved(which, centers, halves)
        return np.zeros((0, 3))

    def _start(self) -> tuple[Indices, Array, Array]:
        which, centers, halves = [], [], []
        for k, part in enumerate(self.solid.parts):
            size = np.maximum(part.high - part.low, 1e-9)
            counts = np.clip(np.round(size / size.min()), 1, 8).astype(int) if len(self.solid.parts) == 1 else [1] * 3
            axes = [lo + s * (np.arange(n) + 0.5) / n for lo, s, n in zip(part.low, size, counts, strict=True)]
            grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
            which.append(np.full(len(grid), k))
            centers.append(grid)
            halves.append(np.broadcast_to(0.5 * size / counts + 1e-9, grid.shape))
        return np.concatenate(which), np.concatenate(centers), np.concatenate(halves)

    def _by_part(self, which: Indices) -> list[tuple[int, slice]]:
        """Return each part with the slice of its boxes, which are sorted by part."""
        if not len(which):
            return []
        edges = np.flatnonzero(np.diff(which)) + 1
        starts, stops = [0, *edges.tolist()], [*edges.tolist(), len(which)]
        return [(int(which[a]), slice(a, b)) for a, b in zip(starts, stops, strict=True)]

    def _touching(self, which: Indices, centers: Array, halves: Array) -> Flags:
        keep = np.ones(len(centers), bool)
        for k, rows in self._by_part(which):
            keep[rows] = ~self.solid.parts[k].outside(centers[rows], halves[rows])
        return keep

    def _uncovered(self, centers: Array, halves: Array) -> Flags:
        """Which boxes lie in no leaf together with all its ancestors."""
        result = np.ones(len(centers), bool)
        for rows in self._chunks(len(centers)):
            excess = worst_excess(
                _farthest_distances(centers[rows], halves[rows], self.centers), self.radii, self.parents
            )
            result[rows] = ~(excess[:, self.leaves] <= 0.0).any(axis=1)
        return result

    def _chunks(self, count: int) -> list[slice]:
        step = max(1, 200_000 // len(self.radii))
        return [slice(a, a + step) for a in range(0, count, step)]

    def _counterexamples(self, which: Indices, centers: Array) -> Array:
        """Return the centers that lie in the solid and in no leaf: counterexamples to the cover."""
        inside = self._touching(which, centers, np.zeros_like(centers))
        points = centers[inside]
        return points[self._uncovered(points, np.zeros_like(points))]

    def _grow_over_points(self, which: Indices, centers: Array) -> None:
        points = self._counterexamples(which, centers)
        self._grow(points, np.zeros_like(points))

    def _grow(self, centers: Array, halves: Array) -> None:
        """Enlarge, for each box, the leaf with the smallest excess, and its ancestors."""
        while len(centers):
            rows = self._chunks(len(centers))[0]
            far = _farthest_distances(centers[rows], halves[rows], self.centers)
            excess = worst_excess(far, self.radii, self.parents)[:, self.leaves]
            least = excess.min(axis=1)
            # The worst half first: the balls that they enlarge often contain the other boxes too.
            worst = least >= max(float(np.median(least)), 0.0)
            for k, row in zip(self.leaves[excess[worst].argmin(axis=1)], far[worst], strict=True):
                ball = int(k)
                while ball >= 0:
                    self.radii[ball] = max(self.radii[ball], row[ball] + 1e-9)
                    ball = int(self.parents[ball])
            done = np.zeros(len(centers), bool)
            done[rows] = worst | (least <= 0.0)
            centers, halves = centers[~done], halves[~done]


def _halved(which: Indices, centers: Array, halves: Array) -> tuple[Indices, Array, Array]:
    """Return the eight octants of each box; boxes of one part stay together."""
    signs = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
    parts = (centers[:, None] + halves[:, None] * signs).reshape(-1, 3)
    return np.repeat(which, 8), parts, np.repeat(0.5 * halves, 8, axis=0)


def _uncovered_discs(part: RoundBody, cover: Cover) -> Array:
    """Return points of the axis of a capsule whose surroundings are not proved to be covered, shape (N, 3) [m].

    The axis is bisected. A ball is convex, so it contains the capsule between two discs that it contains. Boxes would
    have to be small everywhere, since a tight ball touches the capsule along a whole circle.
    """
    radii, parents, leaves = cover.radii - PAD, cover.parents, cover.leaves
    across = np.hypot(cover.centers[:, 0], cover.centers[:, 1]) + part.radius
    ends = np.array([[0.0, 0.0, sign * part.half_length] for sign in (-1.0, 1.0)])
    caps = worst_excess(distances(ends, cover.centers) + part.radius, radii, parents)[:, leaves]
    left = ends[(caps > 0.0).all(axis=1)]
    if part.half_length == 0.0:
        return left
    low, high = np.array([-part.half_length]), np.array([part.half_length])
    for _ in range(24):
        far = [np.hypot(z[:, None] - cover.centers[:, 2], across) for z in (low, high)]
        excess = worst_excess(np.maximum(*far), radii, parents)[:, leaves]
        uncovered = (excess > 0.0).all(axis=1)
        low, high = low[uncovered], high[uncovered]
        if not len(low):
            return left
        if len(low) > 1000:
            break
        middle = 0.5 * (low + high)
        low, high = np.concatenate([low, middle]), np.concatenate([middle, high])
    middle = 0.5 * (low + high)
    return np.concatenate([left, np.stack([0.0 * middle, 0.0 * middle, middle], axis=1)])
