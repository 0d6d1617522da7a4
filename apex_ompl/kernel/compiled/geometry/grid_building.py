"""Distances on the nodes of a grid to triangles and points: exact near them, by a distance transform elsewhere.

All lengths are in units of the grid's spacing, so that node (i, j, k) is at (i, j, k). A whole grid is tabulated by one
call that needs no lock of the interpreter.
"""

from __future__ import annotations

import math

from apex_ompl.kernel.compiled.compilation import entry_point, inlined, outlined
from apex_ompl.kernel.compiled.geometry.triangles import closest_squared
from apex_ompl.kernel.compiled.layout import Floats, Integers, Singles

FAR = 2.0**40  # squared distance that stands for none; exact in single precision


@outlined
def raster_triangles(corners: Floats, band: float, squared: Singles) -> None:
    """Lower the squared distances of nodes to what they are to triangles, all that are within ``band`` of one.

    Args:
        corners: Corners of the triangles, shape (T, 3, 3).
        band: Distance up to which nodes are examined.
        squared: Squared distances, shape (nx, ny, nz); FAR at the start.
    """
    for t in range(len(corners)):
        a, b, c = corners[t, 0], corners[t, 1], corners[t, 2]
        nx = (b[1] - a[1]) * (c[2] - a[2]) - (b[2] - a[2]) * (c[1] - a[1])
        ny = (b[2] - a[2]) * (c[0] - a[0]) - (b[0] - a[0]) * (c[2] - a[2])
        nz = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        # Along the axis that is nearest to the normal, nodes near the triangle are near its plane.
        axis = 2 if abs(nz) >= abs(nx) and abs(nz) >= abs(ny) else 1 if abs(ny) >= abs(nx) else 0
        u, v = (1 if axis == 0 else 0), (1 if axis == 2 else 2)
        along = nx if axis == 0 else ny if axis == 1 else nz
        across_u, across_v = (ny if axis == 0 else nx), (ny if axis == 2 else nz)
        length = math.sqrt(nx * nx + ny * ny + nz * nz)
        i0 = max(0, math.ceil(min(a[u], b[u], c[u]) - band))
        i1 = min(squared.shape[u] - 1, math.floor(max(a[u], b[u], c[u]) + band))
        j0 = max(0, math.ceil(min(a[v], b[v], c[v]) - band))
        j1 = min(squared.shape[v] - 1, math.floor(max(a[v], b[v], c[v]) + band))
        low, high = min(a[axis], b[axis], c[axis]) - band, max(a[axis], b[axis], c[axis]) + band
        half = band * length / abs(along) if abs(along) > 0.0 else math.inf
        for i in range(int(i0), int(i1) + 1):
            for j in range(int(j0), int(j1) + 1):
                first, last = low, high
                if half < math.inf:
                    middle = a[axis] - (across_u * (i - a[u]) + across_v * (j - a[v])) / along
                    first, last = max(low, middle - half), min(high, middle + half)
                for k in range(max(0, int(math.ceil(first))), min(squared.shape[axis] - 1, int(math.floor(last))) + 1):
                    x, y, z = (k, i, j) if axis == 0 else (i, k, j) if axis == 1 else (i, j, k)
                    squared[x, y, z] = min(squared[x, y, z], closest_squared(corners, t, x, y, z))


@outlined
def raster_points(points: Floats, squared: Singles) -> None:
    """Lower the squared distances of nodes to what they are to the points in the cells around them.

    Args:
        points: Shape (N, 3), inside of the grid.
        squared: Squared distances, shape (nx, ny, nz); FAR at the start. Those up to 1 are exact afterwards.
    """
    for n in range(len(points)):
        i, j, k = int(points[n, 0]), int(points[n, 1]), int(points[n, 2])
        for x in range(i, min(i + 2, squared.shape[0])):
            for y in range(j, min(j + 2, squared.shape[1])):
                for z in range(k, min(k + 2, squared.shape[2])):
                    d = (points[n, 0] - x) ** 2 + (points[n, 1] - y) ** 2 + (points[n, 2] - z) ** 2
                    squared[x, y, z] = min(squared[x, y, z], d)


@inlined
def _crossing(corners: Floats, t: int, y: float, z: float) -> tuple[int, float]:
    """Return the direction in which a line along x crosses triangle ``t``, 0 where it does not, and the place.

    Edges are half open (Sunday's winding number), so that a line through one or through a corner is counted once.
    """
    turn = 0
    for e in range(3):
        f = e + 1 if e < 2 else 0
        y0, z0, y1, z1 = corners[t, e, 1], corners[t, e, 2], corners[t, f, 1], corners[t, f, 2]
        if y0 <= y < y1 or y1 <= y < y0:
            # From the lower end, so that neighbors compute the same side bit for bit.
            swap = y1 < y0
            if swap:
                y0, z0, y1, z1 = y1, z1, y0, z0
            side = (y1 - y0) * (z - z0) - (y - y0) * (z1 - z0)
            if side < 0.0:
                turn += -1 if swap else 1
    if turn == 0:
        return 0, 0.0
    a, b, c = corners[t, 0], corners[t, 1], corners[t, 2]
    nx = (b[1] - a[1]) * (c[2] - a[2]) - (b[2] - a[2]) * (c[1] - a[1])
    ny = (b[2] - a[2]) * (c[0] - a[0]) - (b[0] - a[0]) * (c[2] - a[2])
    nz = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
    low, high = min(a[0], b[0], c[0]), max(a[0], b[0], c[0])
    place = a[0] - (ny * (y - a[1]) + nz * (z - a[2])) / nx if abs(nx) > 0.0 else 0.5 * (low + high)
    return turn, min(max(place, low), high)


@outlined
def mark_crossings(corners: Floats, turns: Singles) -> None:
    """Add to each node the number of times that a closed surface is left between it and the node before it along x.

    The sum from the first node on is then the winding number of the surface around a node, but for its sign; nodes
    that are nearer to the surface than rounding may have the one of either side.

    Args:
        corners: Corners of the triangles, shape (T, 3, 3).
        turns: Shape (nx, ny, nz); zeros at the start.
    """
    nx, ny, nz = turns.shape
    for t in range(len(corners)):
        j0 = max(0, int(math.ceil(min(corners[t, 0, 1], corners[t, 1, 1], corners[t, 2, 1]))))
        j1 = min(ny - 1, int(math.floor(max(corners[t, 0, 1], corners[t, 1, 1], corners[t, 2, 1]))))
        k0 = max(0, int(math.ceil(min(corners[t, 0, 2], corners[t, 1, 2], corners[t, 2, 2]))))
        k1 = min(nz - 1, int(math.floor(max(corners[t, 0, 2], corners[t, 1, 2], corners[t, 2, 2]))))
        for j in range(j0, j1 + 1):
            for k in range(k0, k1 + 1):
                turn, place = _crossing(corners, t, j, k)
                if turn != 0:
                    i = max(0, int(math.ceil(place)))
                    if i < nx:
                        turns[i, j, k] += turn


@inlined
def _envelope(line: Floats, n: int, at: Integers, ends: Floats) -> None:
    """Replace f, the first ``n`` numbers of a line, by min_j f(j) + (i - j)^2 (Felzenszwalb and Huttenlocher 2012)."""
    count = 0
    for q in range(n):
        if line[q] >= FAR:
            continue
        cross = -math.inf
        while count > 0:
            p = at[count - 1]
            cross = ((line[q] + q * q) - (line[p] + p * p)) / (2.0 * (q - p))
            if cross > ends[count - 1]:
                break
            count -= 1
            cross = -math.inf
        at[count], ends[count] = q, cross
        count += 1
    if count == 0:
        return
    for k in range(count):
        line[2 * n + k] = line[at[k]]
    piece = 0
    for q in range(n):
        while piece + 1 < count and ends[piece + 1] < q:
            piece += 1
        line[n + q] = line[2 * n + piece] + (q - at[piece]) ** 2
    for q in range(n):
        line[q] = line[n + q]


@outlined
def transform_lines(squared: Singles, axis: int, line: Floats, at: Integers, ends: Floats) -> None:
    """Replace squared distances f by min_m f(m) + |n - m|^2 over the nodes m of each line; FAR stands for infinity.

    Args:
        squared: Shape (nx, ny, nz).
        axis: Axis that the lines are along, of n nodes.
        line: Buffer, shape (3 n,).
        at: Buffer, shape (n,).
        ends: Buffer, shape (n,).
    """
    nx, ny, nz = squared.shape
    n = nx if axis == 0 else ny if axis == 1 else nz
    for i in range(ny if axis == 0 else nx):
        for k in range(ny if axis == 2 else nz):
            for j in range(n):
                line[j] = squared[j, i, k] if axis == 0 else squared[i, j, k] if axis == 1 else squared[i, k, j]
            _envelope(line, n, at, ends)
            for j in range(n):
                if axis == 0:
                    squared[j, i, k] = line[j]
                elif axis == 1:
                    squared[i, j, k] = line[j]
                else:
                    squared[i, k, j] = line[j]


@outlined
def split_near(squared: Singles, band: float, seed: float, near: Singles) -> None:
    """Keep the distances of nodes near something, and prepare the others for :func:`transform_lines`.

    Args:
        squared: Squared distances, shape (nx, ny, nz); gets 0 where they are at most ``seed``, elsewhere FAR.
        band: Largest distance that is kept.
        seed: Largest squared distance of nodes that others are measured from.
        near: Gets the distances that are kept, -1 elsewhere, shape (nx, ny, nz).
    """
    nx, ny, nz = squared.shape
    for i in range(nx):
        for j in range(ny):
            for k in range(nz):
                d = squared[i, j, k]
                near[i, j, k] = math.sqrt(d) if d <= band * band else -1.0
                squared[i, j, k] = 0.0 if d <= seed else FAR


@outlined
def lower_bounds(squared: Singles, near: Singles, band: float, slack: float, spacing: float, less: float) -> None:
    """Put lower bounds that hold between nodes, too, into ``near`` [m].

    Args:
        squared: Squared distances to the nearest seed, shape (nx, ny, nz).
        near: Distances that are exact, -1 elsewhere, shape (nx, ny, nz).
        band: What distances that are not exact are at least.
        slack: What distances to seeds, and interpolation, are wrong by at most.
        spacing: Of the nodes [m].
        less: What is subtracted from all [m].
    """
    nx, ny, nz = squared.shape
    for i in range(nx):
        for j in range(ny):
            for k in range(nz):
                d = near[i, j, k]
                if d < 0.0:
                    d = max(math.sqrt(squared[i, j, k]) - slack, band)
                near[i, j, k] = spacing * (d - slack) - less


@outlined
def negate_inside(turns: Singles, values: Singles, band: float, slack: float, spacing: float, less: float) -> None:
    """Give nodes inside of a closed surface lower bounds of their negative distances [m].

    Args:
        turns: What :func:`mark_crossings` wrote, shape (nx, ny, nz).
        values: What :func:`lower_bounds` wrote, shape (nx, ny, nz) [m].
        band: See there.
        slack: See there.
        spacing: See there [m].
        less: See there [m].
    """
    nx, ny, nz = turns.shape
    for j in range(ny):
        for k in range(nz):
            winding = 0.0
            for i in range(nx):
                winding += turns[i, j, k]
                if winding != 0.0:
                    d = (values[i, j, k] + less) / spacing + slack
                    if d >= band - 1e-3:  # it was lowered by the slack of seeds, which is to be added here
                        d += 2.0 * slack
                    values[i, j, k] = spacing * (-d - slack) - less


@inlined
def _fill(values: Singles, value: float) -> None:
    """Set all numbers of an array of three axes."""
    for i in range(values.shape[0]):
        for j in range(values.shape[1]):
            for k in range(values.shape[2]):
                values[i, j, k] = value


@inlined
def _bounds(
    squared: Singles, near: Singles, band: float, seed: float, slack: float, spacing: float, less: float,
    line: Floats, at: Integers, ends: Floats,
) -> None:  # fmt: skip
    """Put lower bounds into ``near`` from squared distances that are exact up to ``band``; see :func:`lower_bounds`."""
    split_near(squared, band, seed, near)
    for axis in (2, 1, 0):  # one axis after the other (Felzenszwalb and Huttenlocher 2012)
        transform_lines(squared, axis, line, at, ends)
    lower_bounds(squared, near, band, slack, spacing, less)


@entry_point
def tabulate_triangles(
    corners: Floats, solid: bool, band: float, seed: float, slack: float, spacing: float, less: float,
    squared: Singles, values: Singles, line: Floats, at: Integers, ends: Floats,
) -> None:  # fmt: skip
    """Put lower bounds of the distance to triangles into ``values``, negative inside of a solid [m].

    Args:
        corners: Corners of the triangles, shape (T, 3, 3) [spacings].
        solid: Whether they are a closed surface.
        band: Distance up to which distances are exact [spacings].
        seed: Largest squared distance of nodes that others are measured from [spacings].
        slack: What distances to these, and interpolation, are wrong by at most [spacings].
        spacing: Of the nodes [m].
        less: What is subtracted from all [m].
        squared: Buffer, shape (nx, ny, nz).
        values: Gets the bounds, shape (nx, ny, nz) [m].
        line: Buffer, shape (3 n,) for the longest axis.
        at: Buffer, shape (n,).
        ends: Buffer, shape (n,).
    """
    _fill(squared, FAR)
    raster_triangles(corners, band, squared)
    _bounds(squared, values, band, seed, slack, spacing, less, line, at, ends)
    if solid:
        _fill(squared, 0.0)
        mark_crossings(corners, squared)
        negate_inside(squared, values, band, slack, spacing, less)


@entry_point
def tabulate_points(
    points: Floats, seed: float, slack: float, spacing: float, less: float,
    squared: Singles, values: Singles, line: Floats, at: Integers, ends: Floats,
) -> None:  # fmt: skip
    """Put lower bounds of the distance to points, shape (N, 3) [spacings], into ``values`` [m].

    See :func:`tabulate_triangles`; distances are exact up to a spacing.
    """
    _fill(squared, FAR)
    raster_points(points, squared)
    _bounds(squared, values, 1.0, seed, slack, spacing, less, line, at, ends)
