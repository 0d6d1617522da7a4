"""Primitives that together look like a grid of distances: what a model that sees shapes sees of meshes and points.

Repair begins among them, too: distances from them are smooth where those from voxels are rough.

The nodes near a surface, and those that it encloses, are taken apart into connected regions. A region that looks like a
box, ball or cylinder becomes that; in the others boxes along the axes of the grid grow from nodes until nearly all are
in one. So the same furniture gives much the same shapes whether it comes as boxes, as a mesh, as points on its surface
or as voxels. Nothing is proved by them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from apex_ompl.kernel.arrays import BOX, CYLINDER, GRID_SLACK, Integers
from apex_ompl.kernel.distance_grid import BAND, DistanceGrid
from apex_ompl.kernel.geometry import OCCUPIED, OUTSIDE, best_box, label_regions, summed_volumes
from apex_ompl.kernel.scene_builder import Primitive, primitive, scene_tables
from apex_ompl.kernel.tables import SceneTables
from apex_ompl.model.solid_fit import THINNEST, Solid, solids_like, turned_to
from apex_ompl.types import Array, Flags
from apex_ompl.util.weak_cache import weakly_cached

MOST_NODES, MOST_NODES_OF_SOLIDS = 1_000_000, 250_000  # that are looked at; of finer grids every other or third
INSIDE = 3.0  # distance inside of a surface, in spacings, by which it is known to enclose a solid
CLOSE = 0.008  # nodes are at least so far from each other among points, which are to be one surface [m]
MORE = 1.15  # distance in spacings up to which nodes count as occupied where distances are not exact
MOST_SHAPES = 48  # of a grid
ALIKE = 0.7  # volume of the intersection of a region and its primitive over that of their union, at least
HOLE = 0.03  # nodes of a primitive and not of its region are at most so far from the surface [m]
FEW = 8  # nodes of a region that is a box whatever its form
RIM = 300  # nodes of a border by which a primitive is judged
SAMPLES = 1500  # nodes by which a region and a primitive are compared
BOXY = 1.25  # by which a box must fit better than a round solid, which voxels make look like a box
LEAST_GAIN = 0.03  # side of a cube that has the volume of what the next box must hold at least [m]
RING = 0.006  # around a box there is no other to be looked for [m]
LONG = 3.0  # sides of a bar, at least
LAYER = 0.96  # share of a layer of nodes that must be occupied for a box to grow by it
SEEDS = 10  # nodes from which boxes grow


@dataclass(frozen=True, eq=False)
class FittedShapes:
    """Primitives in the frame of a grid.

    Attributes:
        kind: BOX, SPHERE or CYLINDER, shape (n,).
        rotation: Primitive to grid, shape (n, 3, 3).
        position: Centers, shape (n, 3) [m].
        size: Half edges; radius; or radius and half length along z, shape (n, 3) [m].
    """

    kind: Integers
    rotation: Array
    position: Array
    size: Array


@dataclass(frozen=True, eq=False)
class _Nodes:
    """Nodes of a grid, or every second or third one along each axis.

    Attributes:
        spacing: Of these nodes [m].
        gap: Signed distances from what the grid is about, exact near it, shape (nx, ny, nz) [m].
        reach: Distance up to which nodes count as occupied [m].
        label: OUTSIDE, or OCCUPIED and the number of a region from 1 on, likewise.
    """

    spacing: float
    gap: NDArray[np.float32]
    reach: float
    label: Integers

    @classmethod
    def of(cls, grid: DistanceGrid) -> _Nodes:
        """Return the nodes of a grid."""
        if grid.radius > 0.0:  # points may be farther from each other than nodes
            block = max(1, math.ceil(CLOSE / grid.spacing))
            reach = max((GRID_SLACK if block == 1 else MORE) * block * grid.spacing - grid.radius, 0.0)
        else:
            inside = (
                float(grid.values.min()) < -INSIDE * grid.spacing
            )  # else it is a surface, in which nodes leave gaps
            most = MOST_NODES_OF_SOLIDS if inside else MOST_NODES
            block = min(math.ceil((grid.values.size / most) ** (1.0 / 3.0)), 3 if inside else 2)
            reach = min(GRID_SLACK * block, BAND) * grid.spacing
        slack, band = np.float32(GRID_SLACK * grid.spacing), (1.0 if grid.radius > 0.0 else BAND) - 1e-3
        gap = grid.values[::block, ::block, ::block] + slack
        gap[gap > band * grid.spacing - grid.radius] += slack  # those were lowered once more
        near = gap <= reach
        near[[0, -1]] = near[:, [0, -1]] = near[:, :, [0, -1]] = False
        label = near.astype(np.int64)
        label_regions(label)
        return cls(block * grid.spacing, gap, reach, label)

    def on_border(self) -> Flags:
        """Return which nodes are occupied and have a neighbor that is not, shape (nx, ny, nz)."""
        outside = self.label == OUTSIDE
        beside = np.zeros_like(outside)
        for axis in range(3):
            ahead = [slice(None)] * 3
            behind = [slice(None)] * 3
            ahead[axis], behind[axis] = slice(1, None), slice(None, -1)
            beside[tuple(ahead)] |= outside[tuple(behind)]
            beside[tuple(behind)] |= outside[tuple(ahead)]
        return np.asarray(beside & ~outside)


@weakly_cached
def fitted_shapes(grid: DistanceGrid) -> FittedShapes:
    """Return primitives that together look like what a grid is about."""
    nodes = _Nodes.of(grid)
    border = nodes.on_border()
    places = np.argwhere(nodes.label > OCCUPIED)
    labels = nodes.label[tuple(places.T)]
    order = np.argsort(labels, kind="stable")
    parts = np.split(places[order], np.flatnonzero(np.diff(labels[order])) + 1) if len(places) else []
    parts.sort(key=len, reverse=True)
    found: list[Solid] = []
    left = np.zeros_like(nodes.label)
    for part in parts:
        fit = _one_shape(nodes, border, part) if len(found) < MOST_SHAPES else None
        if fit is None:
            left[tuple(part.T)] = 1
        else:
            found.append(fit)
    found += _boxes(nodes, border, left, MOST_SHAPES - len(found))
    return FittedShapes(
        np.array([one.kind for one in found], np.int64),
        np.array([one.rotation for one in found]).reshape(-1, 3, 3),
        grid.low + np.array([one.position for one in found]).reshape(-1, 3),
        np.array([one.size for one in found]).reshape(-1, 3),
    )


def primitives_like(solid: Primitive) -> list[Primitive]:
    """Return primitives that together look like a grid at a pose; one that is no grid as it is."""
    if solid.grid is None:
        return [solid]
    fit, found = fitted_shapes(solid.grid), []
    for kind, rotation, position, size in zip(fit.kind, fit.rotation, fit.position, fit.size, strict=True):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation, position
        found.append(Primitive(int(kind), solid.pose @ pose, tuple(size.tolist())))
    return found


@weakly_cached
def scene_of_primitives(tables: SceneTables) -> SceneTables | None:
    """Return a scene in which primitives stand for grids; None where there are no grids."""
    if all(grid is None for grid in tables.grids):
        return None
    owners = tables.arrays.owner.tolist()
    solids = [(owner, one) for k, owner in enumerate(owners) for one in primitives_like(primitive(tables, k))]
    found = scene_tables(solids)
    return replace(found, arrays=found.arrays._replace(allowed=tables.arrays.allowed))


def _one_shape(nodes: _Nodes, border: Flags, part: Integers) -> Solid | None:
    """Return the primitive that looks like connected nodes, shape (N, 3), or None.

    Of solids with the same second moments, that do not close a hole, it is the one from whose surface the nodes at the
    region's border are as far as from the grid's.
    """
    low, high = part.min(axis=0), part.max(axis=0)
    if len(part) <= FEW:
        return _box_of(nodes, low, high)
    box = tuple(slice(int(a), int(b) + 1) for a, b in zip(low, high, strict=True))
    region = np.zeros(high - low + 1, bool)
    region[tuple((part - low).T)] = True
    step = max(1, math.ceil((region.size / SAMPLES) ** (1.0 / 3.0)))
    thin = tuple(slice(None, None, step if n > 4 * step else 1) for n in region.shape)
    axes = (np.arange(n)[k] for n, k in zip(region.shape, thin, strict=True))
    places = nodes.spacing * (np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3) + low)
    wanted, apart = region[thin].ravel(), nodes.gap[box][thin].ravel()
    rim = np.argwhere(border[box] & region) + low
    rim = rim[:: max(1, len(rim) // RIM)]
    gaps, rim_places = nodes.gap[tuple(rim.T)], nodes.spacing * rim
    best: tuple[float, Solid | None] = (math.inf, None)
    for fit in solids_like(nodes.spacing * part.astype(float), nodes.spacing, nodes.reach):
        inside = fit.distances(places) <= nodes.reach
        alike = (inside & wanted).sum() / max((inside | wanted).sum(), 1)
        if alike < ALIKE or (apart[inside & ~wanted] > HOLE + nodes.reach).any():
            continue
        error = fit.distances(rim_places) - gaps
        unlike = float(error.std()) * (BOXY if fit.kind == BOX else 1.0)
        if unlike < best[0]:
            size = np.where(fit.size > 0.0, np.maximum(fit.size + error.mean(), THINNEST), 0.0)
            best = unlike, replace(fit, size=size)
    return best[1]


def _boxes(nodes: _Nodes, border: Flags, left: Integers, most: int) -> list[Solid]:
    """Return boxes along the axes that hold nearly all nodes that are not zero; ``left`` is used up."""
    least, ring = max(FEW, (LEAST_GAIN / nodes.spacing) ** 3), max(1, round(RING / nodes.spacing))
    sums = summed_volumes(left)
    rng = np.random.default_rng(0)
    found: list[Solid] = []
    remaining, uncovered = np.argwhere(left), left != 0
    while len(found) < most and len(remaining) > least:
        seeds = np.ascontiguousarray(remaining[rng.integers(len(remaining), size=SEEDS)])
        gain, best = best_box(sums, left, seeds, LAYER)
        if gain < least:
            break
        found.append(_box_or_bar(nodes, border, _open_part(uncovered, best)))
        uncovered[tuple(slice(a, b) for a, b in best.T.tolist())] = False
        left[tuple(slice(max(a - ring, 0), b + ring) for a, b in best.T.tolist())] = 0
        remaining = remaining[left[tuple(remaining.T)] != 0]
    return found


def _open_part(uncovered: Flags, box: Integers) -> Integers:
    """Return a box of nodes without the ends that lie in other boxes, as two walls that meet are mostly described."""
    inside = uncovered[tuple(slice(a, b) for a, b in box.T.tolist())]
    ends = []
    for axis in range(3):
        some = np.flatnonzero(inside.any(axis=tuple(k for k in range(3) if k != axis)))
        ends.append((box[0, axis] + some[0], box[0, axis] + some[-1] + 1))
    return np.array(ends, np.int64).T


def _box_or_bar(nodes: _Nodes, border: Flags, box: Integers) -> Solid:
    """Return the box of nodes from the first row of ``box``, shape (2, 3), to before the second, or a cylinder.

    A long box of nearly square section may have grown inside of a round bar. In the middle of its length the nodes at
    the bar's border tell.
    """
    found = _box_of(nodes, box[0], box[1] - 1)
    axis = int(found.size.argmax())
    x, y = (k for k in range(3) if k != axis)
    if found.size[axis] < LONG * max(found.size[x], found.size[y]):
        return found
    quarter = (box[1, axis] - box[0, axis]) // 4
    low, high = box[0] - 1, box[1] + 1
    low[axis], high[axis] = box[0, axis] + quarter, box[1, axis] - quarter
    middle = tuple(slice(max(int(a), 0), int(b)) for a, b in zip(low, high, strict=True))
    part = np.argwhere(nodes.label[middle] > OCCUPIED) + np.maximum(low, 0)
    rim = part[border[tuple(part.T)]]
    if len(rim) < FEW:
        return found
    places, gaps = nodes.spacing * rim, nodes.gap[tuple(rim.T)]
    spread = nodes.spacing**2 * (np.cov(part.T)[[x, y], [x, y]] + 1.0 / 12.0)
    direction = np.eye(3)[axis]
    round_one = Solid(
        CYLINDER, turned_to(direction), np.where(direction > 0.0, found.position, nodes.spacing * part.mean(axis=0)),
        np.array([math.sqrt(2.0 * spread.sum()) - nodes.reach, found.size[axis], 0.0]),
    )  # fmt: skip
    as_box, as_cylinder = (one.distances(places) - gaps for one in (found, round_one))
    if as_cylinder.std() >= BOXY * as_box.std():
        return found
    radius = max(round_one.size[0] + float(as_cylinder.mean()), THINNEST)
    return replace(round_one, size=np.array([radius, found.size[axis], 0.0]))


def _box_of(nodes: _Nodes, low: Integers, high: Integers) -> Solid:
    """Return the box whose outermost nodes are given, its sides put where the surface is, by the nodes' distances."""
    inside = tuple(slice(int(a), int(b) + 1) for a, b in zip(low, high, strict=True))
    ends = nodes.spacing * np.stack([low, high]).astype(float)
    for axis in range(3):
        for side, sign in ((0, -1), (1, 1)):
            layer = [*inside]
            at = int((low, high)[side][axis])
            layer[axis] = slice(at, at + 1)
            beyond = [*inside]
            beyond[axis] = slice(at + sign, at + sign + 1)
            open_nodes = nodes.label[tuple(beyond)] == OUTSIDE
            gaps = nodes.gap[tuple(layer)][open_nodes]
            ends[side, axis] -= sign * float(np.median(gaps) if len(gaps) else 0.0)
    half = np.maximum((ends[1] - ends[0]) / 2.0, THINNEST)
    return Solid(BOX, np.eye(3), ends.mean(axis=0), half)
