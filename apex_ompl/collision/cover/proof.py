"""The proof that a tree of balls contains a solid.

Boxes over the solid are halved until each misses the solid or lies in a leaf and in all balls above that leaf. So a
walk down the tree that drops a ball as soon as it is far enough from the others loses nothing of the solid.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from apex_ompl.collision.cover.solids import Flags, Indices, Round, Solid
from apex_ompl.types import Array

PAD = 1e-6  # the radii are larger than what is proved by this, to stand above all rounding [m]
FINEST = 3e-4  # sides of the smallest boxes of the proof [m], or a share of the solid if that is larger
FINEST_SHARE = 1 / 400
TOO_MANY = 2_000_000  # boxes at once


@dataclass(frozen=True, eq=False)
class Cover:
    """A tree of balls in the frame of a geometry; the leaves together contain the solid.

    Attributes:
        centres: Shape (n, 3) [m].
        radii: Shape (n,) [m].
        first: Index of the first child of each ball, shape (n,); the root is ball 0, children follow their parent.
        count: Number of children, shape (n,); 0 for a leaf.
    """

    centres: Array
    radii: Array
    first: Indices
    count: Indices

    @property
    def parents(self) -> Indices:
        """The ball above each ball, shape (n,); -1 for the root."""
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
        """How many balls are above each ball, shape (n,)."""
        levels = np.zeros(len(self.radii), dtype=np.int64)
        for k, parent in enumerate(self.parents):
            levels[k] = levels[parent] + 1 if parent >= 0 else 0
        return levels


def boxes_left(solid: Solid, cover: Cover) -> Array:
    """Return the centres of the boxes that could not be proved to be covered, shape (N, 3) [m]; none: proved."""
    part = solid.parts[0]
    if isinstance(part, Round) and part.capped:
        return _discs_left(part, cover)
    return _Proof(solid, cover).run(grow=False)


def grown(solid: Solid, cover: Cover, coarser: float) -> Cover:
    """Return a cover with balls as much larger as the proof needs, by boxes ``coarser`` times the smallest."""
    proof = _Proof(solid, cover)
    proof.finest *= coarser
    proof.run(grow=True)
    return Cover(cover.centres, proof.radii + 2.5 * PAD, cover.first, cover.count)


def distances(points: Array, centres: Array) -> Array:
    """Return the distances of points, shape (N, 3), to centres, shape (M, 3): shape (N, M)."""
    square = (points[:, None, 0] - centres[None, :, 0]) ** 2
    for axis in (1, 2):
        square += (points[:, None, axis] - centres[None, :, axis]) ** 2
    return np.asarray(np.sqrt(square))


def _farthest(centres: Array, halves: Array, balls: Array) -> Array:
    """Return the distances from centres of balls, shape (n, 3), to the farthest points of boxes: shape (N, n)."""
    square = np.zeros((len(centres), len(balls)))
    for axis in range(3):
        side = np.abs(centres[:, None, axis] - balls[None, :, axis])
        side += halves[:, None, axis]
        square += side * side
    return np.asarray(np.sqrt(square, out=square))


def needs_of(far: Array, radii: Array, parents: Indices) -> Array:
    """Return by how much the worst of each ball and those above it falls short, of far and radii: shape (N, n)."""
    needs = far - radii
    for k in range(1, len(radii)):  # parents come first
        np.maximum(needs[:, k], needs[:, parents[k]], out=needs[:, k])
    return needs


class _Proof:
    """The halving of boxes over a solid, with the balls that may grow on the way."""

    def __init__(self, solid: Solid, cover: Cover) -> None:
        self.solid = solid
        self.centres, self.radii = cover.centres, cover.radii - PAD
        self.parents, self.leaves = cover.parents, cover.leaves
        self.finest = max(FINEST, float((solid.high - solid.low).max()) * FINEST_SHARE)

    def run(self, grow: bool) -> Array:
        """Return the centres of the boxes left over, shape (N, 3); with ``grow`` none, the radii grow instead."""
        which, centres, halves = self._start()
        while len(centres):
            keep = self._touching(which, centres, halves)
            which, centres, halves = which[keep], centres[keep], halves[keep]
            last = bool(len(halves)) and float(halves.max()) * 2.0 <= self.finest
            open_ = self._open(centres, halves)
            if grow and last:
                self._grow(centres[open_], halves[open_])
                return np.zeros((0, 3))
            which, centres, halves = which[open_], centres[open_], halves[open_]
            if last or len(centres) > TOO_MANY:
                return centres
            if grow:
                self._grow_points(which, centres)
            elif len(wrong := self._wrong(which, centres)):
                return wrong
            which, centres, halves = _halved(which, centres, halves)
        return np.zeros((0, 3))

    def _start(self) -> tuple[Indices, Array, Array]:
        which, centres, halves = [], [], []
        for k, part in enumerate(self.solid.parts):
            size = np.maximum(part.high - part.low, 1e-9)
            counts = np.clip(np.round(size / size.min()), 1, 8).astype(int) if len(self.solid.parts) == 1 else [1] * 3
            axes = [lo + s * (np.arange(n) + 0.5) / n for lo, s, n in zip(part.low, size, counts, strict=True)]
            grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
            which.append(np.full(len(grid), k))
            centres.append(grid)
            halves.append(np.broadcast_to(0.5 * size / counts + 1e-9, grid.shape))
        return np.concatenate(which), np.concatenate(centres), np.concatenate(halves)

    def _by_part(self, which: Indices) -> list[tuple[int, slice]]:
        """Return the parts of boxes that are sorted by part, and where theirs are."""
        if not len(which):
            return []
        edges = np.flatnonzero(np.diff(which)) + 1
        starts, stops = [0, *edges.tolist()], [*edges.tolist(), len(which)]
        return [(int(which[a]), slice(a, b)) for a, b in zip(starts, stops, strict=True)]

    def _touching(self, which: Indices, centres: Array, halves: Array) -> Flags:
        keep = np.ones(len(centres), bool)
        for k, rows in self._by_part(which):
            keep[rows] = ~self.solid.parts[k].outside(centres[rows], halves[rows])
        return keep

    def _open(self, centres: Array, halves: Array) -> Flags:
        """Which boxes lie in no leaf, or not in all balls above it."""
        result = np.ones(len(centres), bool)
        for rows in self._chunks(len(centres)):
            needs = needs_of(_farthest(centres[rows], halves[rows], self.centres), self.radii, self.parents)
            result[rows] = ~(needs[:, self.leaves] <= 0.0).any(axis=1)
        return result

    def _chunks(self, count: int) -> list[slice]:
        step = max(1, 200_000 // len(self.radii))
        return [slice(a, a + step) for a in range(0, count, step)]

    def _wrong(self, which: Indices, centres: Array) -> Array:
        """Return which centres are in the solid and in no leaf."""
        inside = self._touching(which, centres, np.zeros_like(centres))
        points = centres[inside]
        return points[self._open(points, np.zeros_like(points))]

    def _grow_points(self, which: Indices, centres: Array) -> None:
        points = self._wrong(which, centres)
        self._grow(points, np.zeros_like(points))

    def _grow(self, centres: Array, halves: Array) -> None:
        """Widen, for each box, the leaf that needs the least and the balls above it."""
        while len(centres):
            rows = self._chunks(len(centres))[0]
            far = _farthest(centres[rows], halves[rows], self.centres)
            needs = needs_of(far, self.radii, self.parents)[:, self.leaves]
            least = needs.min(axis=1)
            # The worst half first: what they widen often serves the others.
            worst = least >= max(float(np.median(least)), 0.0)
            for k, row in zip(self.leaves[needs[worst].argmin(axis=1)], far[worst], strict=True):
                ball = int(k)
                while ball >= 0:
                    self.radii[ball] = max(self.radii[ball], row[ball] + 1e-9)
                    ball = int(self.parents[ball])
            done = np.zeros(len(centres), bool)
            done[rows] = worst | (least <= 0.0)
            centres, halves = centres[~done], halves[~done]


def _halved(which: Indices, centres: Array, halves: Array) -> tuple[Indices, Array, Array]:
    """Return the eight parts of each box; boxes of one part stay together."""
    signs = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
    parts = (centres[:, None] + halves[:, None] * signs).reshape(-1, 3)
    return np.repeat(which, 8), parts, np.repeat(0.5 * halves, 8, axis=0)


def _discs_left(part: Round, cover: Cover) -> Array:
    """Prove a cover of a capsule by halving its axis: between two discs in a ball, the capsule is in the ball.

    Boxes would need to be small all over, since a tight ball touches the capsule all around.
    """
    radii, parents, leaves = cover.radii - PAD, cover.parents, cover.leaves
    across = np.hypot(cover.centres[:, 0], cover.centres[:, 1]) + part.radius
    ends = np.array([[0.0, 0.0, sign * part.half_length] for sign in (-1.0, 1.0)])
    caps = needs_of(distances(ends, cover.centres) + part.radius, radii, parents)[:, leaves]
    left = ends[(caps > 0.0).all(axis=1)]
    if part.half_length == 0.0:
        return left
    low, high = np.array([-part.half_length]), np.array([part.half_length])
    for _ in range(24):
        far = [np.hypot(z[:, None] - cover.centres[:, 2], across) for z in (low, high)]
        needs = needs_of(np.maximum(*far), radii, parents)[:, leaves]
        open_ = (needs > 0.0).all(axis=1)
        low, high = low[open_], high[open_]
        if not len(low):
            return left
        if len(low) > 1000:
            break
        middle = 0.5 * (low + high)
        low, high = np.concatenate([low, middle]), np.concatenate([middle, high])
    middle = 0.5 * (low + high)
    return np.concatenate([left, np.stack([0.0 * middle, 0.0 * middle, middle], axis=1)])
