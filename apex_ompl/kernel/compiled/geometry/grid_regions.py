"""Regions of the cells of a grid: holes are filled, connected cells are told apart, and boxes grow inside of them."""

from __future__ import annotations

from apex_ompl.kernel.compiled.compilation import entry_point, inlined
from apex_ompl.kernel.compiled.layout import Integers

OUTSIDE, FREE, OCCUPIED = -1, 0, 1


@inlined
def _flood(cells: Integers, i: int, j: int, k: int, old: int, new: int, stack: Integers) -> None:
    """Give a cell, and all that are connected with it by faces and have the value ``old``, the value ``new``."""
    ny, nz = cells.shape[1], cells.shape[2]
    cells[i, j, k] = new
    stack[0] = (i * ny + j) * nz + k
    count = 1
    while count > 0:
        count -= 1
        at = stack[count]
        x, y, z = at // (ny * nz), (at // nz) % ny, at % nz
        for side in range(6):
            step = 1 if side % 2 else -1
            u = x + step if side < 2 else x
            v = y + step if 2 <= side < 4 else y
            w = z + step if side >= 4 else z
            inside = 0 <= u < cells.shape[0] and 0 <= v < ny and 0 <= w < nz
            if inside and cells[u, v, w] == old:
                cells[u, v, w] = new
                stack[count] = (u * ny + v) * nz + w
                count += 1


@entry_point
def label_regions(cells: Integers, stack: Integers) -> int:
    """Fill what occupied cells enclose, and number the regions of connected cells; return how many there are.

    Args:
        cells: FREE or OCCUPIED, shape (nx, ny, nz), with free cells on all sides; gets OUTSIDE, or OCCUPIED and the
            number of the region from 1 on.
        stack: Buffer, shape (nx ny nz,).
    """
    nx, ny, nz = cells.shape
    _flood(cells, 0, 0, 0, FREE, OUTSIDE, stack)
    for i in range(nx):
        for j in range(ny):
            for k in range(nz):
                if cells[i, j, k] == FREE:
                    cells[i, j, k] = OCCUPIED
    count = 0
    for i in range(nx):
        for j in range(ny):
            for k in range(nz):
                if cells[i, j, k] == OCCUPIED:
                    count += 1
                    _flood(cells, i, j, k, OCCUPIED, OCCUPIED + count, stack)
    return count


@entry_point
def add_up(cells: Integers, sums: Integers) -> None:
    """Write the numbers of cells before each corner that are not zero (a summed volume table, Crow 1984).

    Args:
        cells: Shape (nx, ny, nz).
        sums: Shape (nx + 1, ny + 1, nz + 1); zeros at the start.
    """
    nx, ny, nz = cells.shape
    for i in range(nx):
        for j in range(ny):
            row = 0
            for k in range(nz):
                row += cells[i, j, k] != 0
                sums[i + 1, j + 1, k + 1] = row + sums[i, j + 1, k + 1] + sums[i + 1, j, k + 1] - sums[i, j, k + 1]


@inlined
def _inside(sums: Integers, low: Integers, high: Integers) -> int:
    """Return the number of marked cells of a box from cell ``low`` to before cell ``high``."""
    a, b, c, d, e, f = low[0], low[1], low[2], high[0], high[1], high[2]
    upper = sums[d, e, f] - sums[a, e, f] - sums[d, b, f] + sums[a, b, f]
    return int(upper - (sums[d, e, c] - sums[a, e, c] - sums[d, b, c] + sums[a, b, c]))


@inlined
def _grow(sums: Integers, low: Integers, high: Integers, axis: int, share: float) -> None:
    """Grow a box along an axis by layers of which at least a share is marked."""
    b, c = (1 if axis == 0 else 0), (1 if axis == 2 else 2)
    layer = share * (high[b] - low[b]) * (high[c] - low[c])
    first, last = low[axis], high[axis]
    low[axis], high[axis] = first - 1, first
    while low[axis] >= 0 and _inside(sums, low, high) >= layer:
        low[axis], high[axis] = low[axis] - 1, low[axis]
    first = low[axis] + 1
    low[axis], high[axis] = last, last + 1
    while high[axis] < sums.shape[axis] and _inside(sums, low, high) >= layer:
        low[axis], high[axis] = high[axis], high[axis] + 1
    low[axis], high[axis] = first, high[axis] - 1


@entry_point
def best_box(sums: Integers, left: Integers, seeds: Integers, share: float, box: Integers, best: Integers) -> int:
    """Find the box, grown from a cell, that holds the most cells that are left; return how many.

    From each cell a box grows along the three axes in all orders.

    Args:
        sums: What :func:`add_up` wrote of all cells that boxes may hold.
        left: Not zero where a cell is in no box yet, shape (nx, ny, nz).
        seeds: Cells to start from, shape (N, 3).
        share: Of a layer of cells, how many must be marked for a box to grow by it.
        box: Buffer, shape (2, 3).
        best: Gets the first cell of the best box and the one after its last, shape (2, 3).
    """
    most = 0
    low, high = box[0], box[1]
    for n in range(len(seeds)):
        for order in range(6):
            first = order // 2
            second = (first + 1 + order % 2) % 3
            for a in range(3):
                low[a], high[a] = seeds[n, a], seeds[n, a] + 1
            _grow(sums, low, high, first, share)
            _grow(sums, low, high, second, share)
            _grow(sums, low, high, 3 - first - second, share)
            if (high[0] - low[0]) * (high[1] - low[1]) * (high[2] - low[2]) <= most:
                continue
            count = 0
            for i in range(low[0], high[0]):
                for j in range(low[1], high[1]):
                    for k in range(low[2], high[2]):
                        count += left[i, j, k] != 0
            if count > most:
                most = count
                for a in range(3):
                    best[0, a], best[1, a] = low[a], high[a]
    return most
