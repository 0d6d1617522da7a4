"""Combinations of parts that bound spaces or follow curves: shells, tubes, windows, grilles, bent bars and sheets."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from apex_ompl.problems.broad.shapes import (
    CAPSULE,
    Part,
    Parts,
    Point,
    box,
    circle,
    line,
    moved,
    place,
    repeat,
    rod,
    shift,
    turn,
)  # fmt: skip
from apex_ompl.types import Array

SIDES = ("near", "far", "right", "left", "bottom", "top")  # -x, +x, -y, +y, -z, +z


def hollow_box(x: float, y: float, z: float, thick: float, open_sides: Sequence[str] = ("near",)) -> Parts:
    """Return the walls of a box about the origin, by its inner edges and their thickness [m], without some sides."""
    inner, found = np.array([x, y, z]), list[Part]()
    for k, side in enumerate(SIDES):
        if side in open_sides:
            continue
        axis, sign = k // 2, 2 * (k % 2) - 1
        edges, center = inner + 2 * thick, np.zeros(3)
        edges[axis] = thick
        center[axis] = sign * (inner[axis] + thick) / 2.0
        x, y, z = edges
        found += box(x, y, z, at=center)
    return found


def window(width: float, height: float, thick: float, low: Point, high: Point) -> Parts:
    """Return a panel across x about the origin with a window: up to four boxes around it.

    Args:
        width: Of the panel along y [m].
        height: Of the panel along z [m].
        thick: Of the panel along x [m].
        low: Corner (y, z) of the window [m].
        high: The opposite corner [m].
    """
    (y0, z0), (y1, z1), found = low, high, list[Part]()
    columns = ((-width / 2, y0, -height / 2, height / 2), (y1, width / 2, -height / 2, height / 2))
    beams = ((y0, y1, -height / 2, z0), (y0, y1, z1, height / 2))
    for a, b, c, d in (*columns, *beams):
        if b - a > 1e-3 and d - c > 1e-3:
            found += box(thick, b - a, d - c, at=(0.0, (a + b) / 2, (c + d) / 2))
    return found


def frame(width: float, height: float, bar: float) -> Parts:
    """Return a rectangular frame of bars across x about the origin, by its inner width and height [m]."""
    return window(width + 2 * bar, height + 2 * bar, bar, (-width / 2, -height / 2), (width / 2, height / 2))


def tube(radius: float, length: float, thick: float, staves: int = 10, span: float = 2.0 * np.pi) -> Parts:
    """Return a tube along z of staves, or a part of one, by its inner radius [m]."""
    each = span / staves
    stave = box(thick, 2.0 * (radius + thick) * float(np.tan(each / 2.0)), length)
    return repeat(stave, [turn("z", (k + 0.5) * each) @ shift(radius + thick / 2.0, 0, 0) for k in range(staves)])


def grille(width: float, height: float, columns: int, rows: int, radius: float) -> Parts:
    """Return a grille across x about the origin: upright and level bars [m]."""
    upright = rod((0, 0, -height / 2), (0, 0, height / 2), radius)
    level = rod((0, -width / 2, 0), (0, width / 2, 0), radius)
    return [
        *repeat(upright, line(columns, (0, width / max(columns - 1, 1), 0))),
        *repeat(level, line(rows, (0, 0, height / max(rows - 1, 1)))),
    ]


def lattice(counts: tuple[int, int, int], step: float, radius: float) -> Parts:
    """Return the edges of a grid of cubes about the origin, by the number of nodes along each axis, as bars [m]."""
    found = list[Part]()
    for axis in range(3):
        u, v = (k for k in range(3) if k != axis)
        for j in range(counts[u]):
            for k in range(counts[v]):
                end = np.zeros(3)
                end[axis], end[u], end[v] = counts[axis] - 1, 2 * j - counts[u] + 1, 2 * k - counts[v] + 1
                start = end.copy()
                start[axis] *= -1.0
                found += rod(start * step / 2, end * step / 2, radius)
    return found


def bend(points: Array, radius: float, kind: int = CAPSULE) -> Parts:
    """Return a bar or a pipe through points, shape (n, 3) [m]: a chain of capsules or cylinders."""
    return [part for a, b in zip(points[:-1], points[1:], strict=True) for part in rod(a, b, radius, kind)]


def bent_sheet(points: Array, width: float, thick: float) -> Parts:
    """Return a sheet along points of the plane y = 0, shape (n, 3) [m], as wide along y: a chain of boxes."""
    found = list[Part]()
    for a, b in zip(points[:-1], points[1:], strict=True):
        rise, run = float(b[2] - a[2]), float(b[0] - a[0])
        pose = turn("y", -np.arctan2(rise, run))
        pose[:3, 3] = (a + b) / 2.0
        found += place(box(float(np.hypot(rise, run)) + thick, width, thick), pose)
    return found


def arc(radius: float, first: float, last: float, count: int) -> Array:
    """Return points on a circle in the plane y = 0, angles from x towards z [rad], shape (count, 3) [m]."""
    angles = np.linspace(first, last, count)
    return np.stack([radius * np.cos(angles), np.zeros(count), radius * np.sin(angles)], axis=1)


def smooth(points: Point | Array, count: int) -> Array:
    """Return points on a Catmull-Rom spline through points, shape (n, 3), at even parameters, shape (count, 3)."""
    through = np.asarray(points, float)
    p = np.concatenate([2 * through[:1] - through[1:2], through, 2 * through[-1:] - through[-2:-1]])
    at = np.linspace(0.0, len(through) - 1.0, count)
    k = np.minimum(at.astype(int), len(through) - 2)
    t = (at - k)[:, None]
    a, b, c, d = (p[k + j] for j in range(4))
    found: Array = b + 0.5 * t * (c - a + t * (2 * a - 5 * b + 4 * c - d + t * (3 * (b - c) + d - a)))
    return found


def ring(radius: float, thick: float, count: int = 12, span: float = 2.0 * np.pi) -> Parts:
    """Return a ring, or a part of one, across x about the origin: a chain of capsules of radius ``thick`` [m]."""
    angles = np.linspace(0.0, span, count + 1)
    points = np.stack([np.zeros(count + 1), radius * np.cos(angles), radius * np.sin(angles)], axis=1)
    return bend(points, thick)


def table(x: float, y: float, height: float, thick: float, leg: float) -> Parts:
    """Return a top on four legs that stand on z = 0, by the edges of the top and its height [m]."""
    legs = [(sx * (x - leg) / 2, sy * (y - leg) / 2) for sx in (-1, 1) for sy in (-1, 1)]
    posts = [part for u, v in legs for part in box(leg, leg, height - thick, at=(u, v, (height - thick) / 2))]
    return [*box(x, y, thick, at=(0, 0, height - thick / 2)), *posts]


def stack(rng: np.random.Generator, count: int, size: float) -> Parts:
    """Return boxes of random edges on top of each other on z = 0 [m]."""
    found, z = list[Part](), 0.0
    for _ in range(count):
        x, y, height = rng.uniform(0.3 * size, size, 3)
        found += place(moved(box(x, y, height), 0, 0, z + height / 2), turn("z", rng.uniform(0, np.pi)))
        z += height
    return found


def fan(count: int, radius: float, width: float, thick: float, tilt: float) -> Parts:
    """Return blades around z, by their length, width and thickness [m] and the angle that they are tilted [rad]."""
    blade = place(box(radius, width, thick), turn("x", tilt))
    return repeat(blade, circle(count, radius / 2.0))


def between(a: Point, b: Point, count: int) -> Array:
    """Return points evenly from one to another, shape (count, 3)."""
    return np.linspace(np.asarray(a, float), np.asarray(b, float), count)


def sagging(a: Point, b: Point, sag: float, count: int) -> Array:
    """Return points on a parabola that hangs between two points by ``sag`` [m] in its middle, shape (count, 3)."""
    found = between(a, b, count)
    u = np.linspace(0.0, 1.0, count)
    found[:, 2] -= 4.0 * sag * u * (1.0 - u)
    return found
