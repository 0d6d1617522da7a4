"""Primitives that together approximate a grid of distances, for models that see shapes of meshes and points.

Repair starts among them, too: distances from primitives are smooth where those from voxels are rough.

The nodes near a surface, and those that it encloses, are divided into connected regions. A region close to a box, a
ball or a cylinder of the same second moments becomes that primitive. In the other regions boxes along the axes of the
grid grow from nodes until nearly all nodes are in one. The same furniture therefore gives similar primitives whether it
comes as boxes, as a mesh, as points on its surface or as voxels. Nothing is proved by them.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from apex_ompl.kernel.arrays import BOX, CYLINDER, GRID_SLACK, SPHERE, Integers
from apex_ompl.kernel.distance_grid import BAND, DistanceGrid
from apex_ompl.kernel.geometry import OCCUPIED, OUTSIDE, best_box, label_regions, summed_volumes
from apex_ompl.kernel.scene_builder import Primitive, primitive, scene_tables
from apex_ompl.kernel.tables import SceneTables
from apex_ompl.model.geometry import signed_distances
from apex_ompl.types import Array, Flags
from apex_ompl.util.weak_cache import weakly_cached

PLACES, POINTS = 3000, 300  # most points for moments, and for orientations
THINNEST = 0.002  # least half side or radius [m]
TURNS = np.radians(np.arange(0.0, 90.0, 5.0))
ORDERS = [list(order) for order in itertools.permutations(range(3))]
FINE_TURNS = np.radians(np.arange(-4.0, 4.5, 1.0))
MOST_NODES, MOST_NODES_OF_SOLIDS = 1_000_000, 250_000  # in use; of finer grids every second or third
INSIDE = 3.0  # depth below a surface, in spacings, from which it is known to enclose a solid
CLOSE = 0.008  # least distance of nodes among points, so that the points form one surface [m]
MORE = 1.15  # distance in spacings up to which nodes count as occupied where distances are not exact
MOST_SHAPES = 48  # of a grid
ALIKE = 0.7  # least intersection over union of the volumes of a region and its primitive
HOLE = 0.03  # largest distance from the surface of nodes of a primitive outside of its region [m]
FEW = 8  # most nodes of a region that becomes a box whatever its form
RIM = 300  # border nodes by which a primitive is compared with its region
SAMPLES = 1500  # nodes by which a region and a primitive are compared
BOXY = 1.25  # factor by which a box must fit better than a round solid, since voxels make that look like a box
LEAST_GAIN = 0.03  # side of a cube with the least volume that the next box must cover [m]
RING = 0.006  # width around a box in which no other box starts [m]
LONG = 3.0  # least ratio of the sides of a bar
LAYER = 0.96  # least occupied share of a layer of nodes by which a box grows
SEEDS = 10  # nodes from which boxes grow


@dataclass(frozen=True, eq=False)
class Solid:
    """A box, a ball or a cylinder.

    Attributes:
        kind: BOX, SPHERE or CYLINDER.
        rotation: From its frame, shape (3, 3).
        position: Of its center, shape (3,) [m].
        size: Half edges; radius; or radius and half length along z; shape (3,), padded with 0 [m].
    """

    kind: int
    rotation: Array
    position: Array
    size: Array

    def distances(self, places: Array) -> Array:
        """Return signed distances of places, shape (N, 3) [m]."""
        rows = (np.array([self.kind]), self.position[None], self.rotation[None], self.size[None])
        return np.asarray(signed_distances(*rows, places[None])[0])


def solids_like(places: Array, spacing: float, less: float) -> list[Solid]:
    """Return boxes, a ball and cylinders with the second moments of given points.

    Args:
        places: Nodes of a lattice inside of a solid, shape (N, 3) [m].
        spacing: Spacing of the lattice [m].
        less: Length by which radii and half sides are reduced [m].
    """
    places = places[:: max(1, len(places) // PLACES)]
    middle = places.mean(axis=0)
    spread = np.cov(places.T) + spacing**2 / 12.0 * np.eye(3)
    variances, axes = np.linalg.eigh(spread)

    def fit(kind: int, rotation: Array, *size: float) -> Solid:
        row = np.zeros(3)
        row[: len(size)] = np.maximum(np.array(size) - less, THINNEST)
        return Solid(kind, rotation, middle, row)

    fits = [
        fit(BOX, np.eye(3), *np.sqrt(3.0 * np.diag(spread))),
        fit(SPHERE, np.eye(3), math.sqrt(5.0 * variances.mean())),
    ]
    some = places[:: max(1, len(places) // POINTS)] - middle
    for z in range(3):
        x, y = (z + 1) % 3, (z + 2) % 3
        frame = np.stack([axes[:, x], axes[:, y], axes[:, z]], axis=1)
        frame[:, 0] *= np.sign(np.linalg.det(frame))
        radius = math.sqrt(2.0 * (variances[x] + variances[y]))
        fits.append(fit(CYLINDER, turned_to(frame[:, 2]), radius, math.sqrt(3.0 * variances[z])))
        turned = _nearest_axes(frame @ _smallest_rectangle(some @ frame))
        fits.append(fit(BOX, turned, *np.sqrt(3.0 * np.diag(turned.T @ spread @ turned))))
    return fits


def turned_to(axis: Array) -> Array:
    """Return the smallest rotation, shape (3, 3), that takes the z axis to an axis or its opposite."""
    x, y, z = axis if axis[2] >= 0.0 else -axis
    return np.array(
        [
            [1.0 - x * x / (1.0 + z), -x * y / (1.0 + z), x],
            [-x * y / (1.0 + z), 1.0 - y * y / (1.0 + z), y],
            [-x, -y, z],
        ]
    )


def _nearest_axes(rotation: Array) -> Array:
    """Return the rotation nearest to the identity among those with the same axes in any order and direction."""
    order = max(ORDERS, key=lambda some: float(np.abs(np.diag(rotation[:, some])).sum()))
    found = rotation[:, order]
    found = found * np.where(np.diag(found) < 0.0, -1.0, 1.0)
    if np.linalg.det(found) < 0.0:
        found[:, int(np.abs(np.diag(found)).argmin())] *= -1.0
    return found


def _smallest_rectangle(local: Array) -> Array:
    """Return the rotation about z, shape (3, 3), after which the rectangle around points, shape (N, 3), is smallest."""
    best = 0.0
    for turns in (TURNS, FINE_TURNS):
        angles = best + turns
        axes = np.stack([np.cos(angles), np.sin(angles)])
        sides = np.ptp(local[:, :2] @ axes, axis=0) * np.ptp(local[:, :2] @ np.stack([-axes[1], axes[0]]), axis=0)
        best = float(angles[sides.argmin()])
    c, s = math.cos(best), math.sin(best)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


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
        gap: Signed distances of the grid, exact near the surface, shape (nx, ny, nz) [m].
        reach: Distance up to which nodes count as occupied [m].
        label: OUTSIDE, or OCCUPIED plus the number of a region from 1 on, shape (nx, ny, nz).
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
    """Return primitives that together approximate a grid of distances."""
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
    """Return primitives that together approximate a grid at a pose; any other primitive is returned as it is."""
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
    """Return a scene in which primitives replace grids; None where there are no grids."""
    if all(grid is None for grid in tables.grids):
        return None
    owners = tables.arrays.owner.tolist()
    solids = [(owner, one) for k, owner in enumerate(owners) for one in primitives_like(primitive(tables, k))]
    found = scene_tables(solids)
    return replace(found, arrays=found.arrays._replace(allowed=tables.arrays.allowed))


def _one_shape(nodes: _Nodes, border: Flags, part: Integers) -> Solid | None:
    """Return the primitive that approximates connected nodes, shape (N, 3), or None.

    Candidates are solids with the same second moments that do not close a hole. The one is chosen for which the
    distances of the region's border nodes from its surface are closest to those of the grid.
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
    """Return boxes along the axes that cover nearly all nonzero nodes of ``left``, which is overwritten."""
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
    """Return a box of nodes cut to its part outside of other boxes, so that two walls that meet do not overlap."""
    inside = uncovered[tuple(slice(a, b) for a, b in box.T.tolist())]
    ends = []
    for axis in range(3):
        some = np.flatnonzero(inside.any(axis=tuple(k for k in range(3) if k != axis)))
        ends.append((box[0, axis] + some[0], box[0, axis] + some[-1] + 1))
    return np.array(ends, np.int64).T


def _box_or_bar(nodes: _Nodes, border: Flags, box: Integers) -> Solid:
    """Return the box of nodes from the first row of ``box``, shape (2, 3), to before the second, or a cylinder.

    A long box of nearly square section may have grown inside of a round bar. The border nodes in the middle of its
    length decide which of the two fits better.
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
    """Return the box with given outermost nodes, its sides moved to the surface by the distances of these nodes."""
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
