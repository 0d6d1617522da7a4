"""Search for few balls that cover a solid closely; the result is proved afterwards, so the search may be heuristic.

The leaves come first. A ball around c that contains the points P protrudes from the solid by the gap
max |p - c| - depth(c), p in P. Greedy set cover selects balls whose gaps are within the tolerance. Then two steps
alternate as in Lloyd's algorithm: each point goes to the ball whose gap it increases least, and each ball moves to
where its gap is smallest. Balls are removed as long as the others can contain their points. Inner balls cover leaves
in the same way, with all points of a leaf as one group.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from apex_ompl.collision.cover.proof import Cover
from apex_ompl.collision.cover.solids import Solid
from apex_ompl.types import Array, Flags, Indices

RELAX = 1.25  # factor by which a tolerance is enlarged until enough candidates fit
COARSER = 2.5  # smallest ratio of the gaps of a level and the level below
FLAT_BELOW = 6  # up to so many leaves are children of the root


@dataclass
class _Level:
    """A level of the tree: balls, and for each group of points the ball that contains it."""

    centers: Array
    owner: Indices
    gap: float
    radii: Array = field(default_factory=lambda: np.zeros(0))


class _Search:
    """A search over points to be covered, sorted by group."""

    def __init__(self, solid: Solid, points: Array, groups: Indices, candidates: Array, effort: int) -> None:
        order = np.argsort(groups, kind="stable")
        self.solid, self.points, self.groups = solid, points[order], groups[order]
        self.number = int(groups.max()) + 1
        self.starts = np.searchsorted(self.groups, np.arange(self.number))
        self.single = self.number == len(points)
        self.candidates, self.effort = candidates, effort
        self.rng = np.random.default_rng(0)

    def gaps(self, centers: Array, depth: Array | None = None) -> Array:
        """Return the gap of each ball if it contained one group alone, shape (balls, groups) [m]."""
        if depth is None:
            depth = self.solid.depth(centers)
        square = np.einsum("ij,ij->i", self.points, self.points) - 2.0 * centers @ self.points.T
        square += np.einsum("ij,ij->i", centers, centers)[:, None]
        far = np.sqrt(np.maximum(square, 0.0, out=square), out=square)
        if not self.single:
            far = np.maximum.reduceat(far, self.starts, axis=1)
        far -= depth[:, None]
        return np.asarray(far)

    def greedy(self, gap: float, most: int) -> _Level:
        """Return a greedy selection of candidates; the gap is enlarged until at most ``most`` of them suffice."""
        needs = self.gaps(self.candidates)
        least = needs.min(axis=0)  # in a sharp corner even the best candidate may protrude further
        while True:
            chosen = self._pick_best(needs <= np.maximum(gap, least), most)
            if chosen is not None:
                return _Level(self.candidates[chosen], needs[chosen].argmin(axis=0), gap)
            gap *= RELAX

    def _pick_best(self, fits: Flags, most: int) -> list[int] | None:
        weights = fits.astype(np.float32)
        if weights.sum(axis=1).max() * most < fits.shape[1]:
            return None
        best = self._pick(weights, most, 0)
        for trial in range(1, (1, 3, 12)[self.effort - 1]):
            best = self._pick(weights, most if best is None else len(best) - 1, trial) or best
        return best

    def _pick(self, fits: NDArray[np.float32], most: int, trial: int) -> list[int] | None:
        gains = fits.sum(axis=1)
        left = np.ones(fits.shape[1], bool)
        chosen: list[int] = []
        while left.any():
            if len(chosen) >= most:
                return None
            noise = 1.0 + 0.1 * self.rng.random(len(gains)) * (trial > 0)
            k = int(np.argmax(gains * noise))
            chosen.append(k)
            new = left & (fits[k] > 0)
            gains = gains - fits[:, new].sum(axis=1)
            left &= ~new
        return chosen

    def refine(self, level: _Level, turns: int, steps: int) -> _Level:
        """Alternate between assigning points and moving balls, and return the best level found."""
        centers = level.centers.copy()
        best = level
        best_gap = np.inf
        reach = np.full(len(centers), 0.25 * float((self.solid.high - self.solid.low).max()))
        for _ in range(turns):
            needs = self.gaps(centers)
            owner = needs.argmin(axis=0)
            gap = float(needs.min(axis=0).max())
            if gap < best_gap - 1e-6:
                best, best_gap = _Level(centers.copy(), owner, gap), gap
            point_owner = owner[self.groups]
            for k in range(len(centers)):
                own = self.points[point_owner == k]
                if len(own):
                    centers[k], reach[k] = self._recenter(centers[k], own, reach[k], steps)
        needs = self.gaps(centers)
        gap = float(needs.min(axis=0).max())
        return _Level(centers, needs.argmin(axis=0), gap) if gap < best_gap else best

    def _recenter(self, center: Array, own: Array, reach: float, steps: int) -> tuple[Array, float]:
        """Return the center with the smallest gap around the ball's points, by random search, and the next reach."""
        count = 12 if self.effort == 1 else 24
        if len(own) > 80:  # the extreme points alone determine the radius
            own = own[np.unique((own @ DIRECTIONS.T).argmax(axis=0))]
        moved = 0.0
        step = min(reach, float(np.ptp(own, axis=0).max()) * 0.5 + 1e-4)
        for _ in range(steps):
            shift = self.rng.normal(size=(count, 3)) * (step * self.rng.random((count, 1)))
            tries = np.concatenate([center[None], center + shift])
            square = np.einsum("ij,ij->i", own, own) - 2.0 * tries @ own.T
            far = np.sqrt(np.maximum(square.max(axis=1) + np.einsum("ij,ij->i", tries, tries), 0.0))
            k = int(np.argmin(far - self.solid.depth(tries)))
            if k:
                moved = max(moved, float(np.linalg.norm(shift[k - 1])))
                center = tries[k]
            else:
                step *= 0.5
        return center, max(2.0 * moved, 1e-3)

    def remove_balls(self, level: _Level, gap: float) -> _Level:
        """Remove balls as long as the others can cover the points within the gap."""
        tries = (0, 3, 8)[self.effort - 1]
        while len(level.centers) > 1:
            needs = self.gaps(level.centers)
            needs[level.owner, np.arange(self.number)] = np.inf
            missed = np.zeros(len(level.centers))  # gap that results if other balls contain these points
            np.maximum.at(missed, level.owner, needs.min(axis=0))
            for k in np.argsort(missed, kind="stable")[:tries]:
                fewer = np.delete(level.centers, k, axis=0)
                found = self.refine(_Level(fewer, level.owner, np.inf), 8, 4)
                if found.gap <= gap:
                    level = found
                    break
            else:
                return level
        return level

    def cover(self, gap: float, most: int) -> _Level:
        """Return balls within the gap, or at most ``most`` balls with about the smallest possible gap."""
        turns, steps = ((3, 3), (8, 5), (12, 6))[self.effort - 1]
        level = self.refine(self.greedy(gap, most * 3 // 2), turns, steps)
        if self.effort > 1 and level.gap <= 1.3 * gap:  # a sharp corner may keep the gap from being met
            level = self.remove_balls(level, max(level.gap, gap))
        if len(level.centers) <= most:
            return level
        level = self.greedy(gap, most)
        wanted = max(level.gap, gap)
        level = self.refine(level, turns, steps)
        return level if wanted > gap else self.remove_balls(level, gap)


def _directions(count: int) -> Array:
    """Return unit vectors spread evenly over the sphere (golden spiral), shape (count, 3)."""
    k = np.arange(count) + 0.5
    z = 1.0 - 2.0 * k / count
    turn = np.pi * (1.0 + 5.0**0.5) * k
    across = np.sqrt(1.0 - z * z)
    return np.stack([across * np.cos(turn), across * np.sin(turn), z], axis=1)


DIRECTIONS = _directions(150)


def search(solid: Solid, gaps: Sequence[float], most: int, effort: int) -> Cover:
    """Return a tree of balls that nearly covers a solid; its radii are enlarged by the proof.

    The arguments are those of :func:`apex_ompl.collision.cover.spheres.make_cover`.
    """
    rng = np.random.default_rng(0)
    surface, inner, centers = ((350, 120, 350), (1200, 700, 1500), (3500, 1500, 4000))[effort - 1]
    candidates = solid.inside(centers)
    points = _points(solid, surface, inner, rng)
    run = _Search(solid, points, np.arange(len(points)), candidates, effort)
    if effort > 1:
        run.candidates = np.concatenate([candidates, _towards(run, candidates, rng.permutation(len(points))[:centers])])
    leaves = run.cover(0.9 * gaps[-1], most)
    if effort > 1:  # cover also what lies between the coarse points
        points = _points(solid, 6 * surface, 2 * inner, rng)
        run = _Search(solid, points, np.arange(len(points)), candidates[:1], effort)
        leaves = run.refine(leaves, 6, 5)
    levels = [_tightened(run, leaves)]
    owner = levels[0].owner
    for wanted in reversed(gaps[:-1]):
        if len(levels[-1].centers) <= FLAT_BELOW:
            break
        points, owner = _extreme_points(points, owner)
        run = _Search(solid, points, owner, candidates[:: max(1, len(candidates) // 1500)], effort)
        level = _tightened(run, run.cover(max(wanted, COARSER * levels[-1].gap), len(levels[-1].centers)))
        if len(level.centers) < 0.6 * len(levels[-1].centers):
            levels.append(level)
            points, owner = run.points, level.owner[run.groups]
    return _tree(points, levels)


def _points(solid: Solid, surface: int, inner: int, rng: np.random.Generator) -> Array:
    """Return points of the solid, about ``surface`` of them on its surface, shape (N, 3)."""
    outer = solid.surface(_spacing(solid, surface))
    if len(outer) > 4 * surface:
        outer = rng.permutation(outer)[: 4 * surface]
    return np.concatenate([outer, solid.inside(inner)])


def _towards(run: _Search, candidates: Array, chosen: Indices) -> Array:
    """Return centers between points and their best candidates, for corners finer than the grid of candidates."""
    best = candidates[run.gaps(candidates)[:, chosen].argmin(axis=0)]
    points = run.points[chosen]
    between = points + np.array([0.2, 0.4, 0.6, 0.8])[np.arange(len(points)) % 4, None] * (best - points)
    return np.asarray(between[run.solid.depth(between) > 0.0])


def _extreme_points(points: Array, owner: Indices) -> tuple[Array, Indices]:
    """Return the extreme points of each group in many directions, which determine the ball that contains it."""
    keep = []
    for k in range(int(owner.max()) + 1):
        own = np.flatnonzero(owner == k)
        keep.append(own[np.unique((points[own] @ DIRECTIONS.T).argmax(axis=0))])
    rows = np.concatenate(keep)
    return points[rows], owner[rows]


def _spacing(solid: Solid, count: int) -> float:
    size = solid.high - solid.low
    area = 2.0 * float(size[0] * size[1] + size[1] * size[2] + size[2] * size[0])
    return float(np.sqrt(area / count))


def _tightened(run: _Search, level: _Level) -> _Level:
    """Return a level without empty balls, each radius as small as the ball's points allow."""
    used, owner = np.unique(level.owner, return_inverse=True)
    radii = np.zeros(len(used))
    far = np.linalg.norm(run.points - level.centers[level.owner[run.groups]], axis=1)
    np.maximum.at(radii, owner.ravel()[run.groups], far)
    return _Level(level.centers[used], owner.ravel(), level.gap, radii)


def _tree(points: Array, levels: list[_Level]) -> Cover:
    """Return the tree of levels, finest first, under a root around all points; no ball has a single child.

    A node is (level, ball), and the level of the root is len(levels).
    """
    top = len(levels)
    children: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for height in range(top - 1, -1, -1):
        upper = levels[height + 1].owner if height + 1 < top else np.zeros(len(levels[height].centers), int)
        for ball in range(len(levels[height].centers)):
            children.setdefault((height + 1, int(upper[ball])), []).append((height, ball))
    root = (top, 0)

    def below(node: tuple[int, int]) -> list[tuple[int, int]]:
        found = []
        for child in children.get(node, []):
            last = child
            while len(children.get(last, [])) == 1:
                last = children[last][0]
            found.append(last)
        return found

    while len(children.get(root, [])) == 1:
        root = children[root][0]
    order, first, count = [root], [], []
    k = 0
    while k < len(order):
        found = below(order[k])
        first.append(len(order) if found else 0)
        count.append(len(found))
        order += found
        k += 1
    centers, radii = [], []
    middle = _enclosing_center(points)
    for height, ball in order:
        centers.append(middle if height == top else levels[height].centers[ball])
        whole = height == top
        radii.append(np.linalg.norm(points - middle, axis=1).max() if whole else levels[height].radii[ball])
    return Cover(np.array(centers), np.array(radii), np.array(first, np.int64), np.array(count, np.int64))


def _enclosing_center(points: Array) -> Array:
    """Return the approximate center of the smallest enclosing ball of points, shape (N, 3) (Badoiu, Clarkson 2003)."""
    center = 0.5 * (points.min(axis=0) + points.max(axis=0))
    for k in range(1, 300):
        far = points[np.argmax(((points - center) ** 2).sum(axis=1))]
        center = center + (far - center) / (k + 1) ** 1.2
    return np.asarray(center)
