"""Grammars of thin things: walls with windows, slits, mazes, louvres, doorways in a row, fins, curtains and lids."""

from __future__ import annotations

import numpy as np

from apex_ompl.problems.broad.composition import FLOATING, Composition, Place, at
from apex_ompl.problems.broad.compounds import frame, hollow_box, window
from apex_ompl.problems.broad.shapes import Part, box, line, moved, place, repeat, rod, shift, turn
from apex_ompl.problems.scenes import DOWN, FORWARD


def windows(rng: np.random.Generator) -> Composition:
    """Draw a wall before the arms or between them with up to three windows, at each of which hands are busy."""
    width, height, thick = rng.uniform(0.7, 1.3), rng.uniform(0.7, 1.1), rng.uniform(0.005, 0.06)
    count = int(rng.integers(1, 4))
    each, parts, places = width / count, list[Part](), list[Place]()
    for k in range(count):
        size = rng.uniform(0.19, min(0.36, 0.9 * each), 2)
        y, z = rng.uniform(-1, 1, 2) * (each - size[0], 0.6 * height - size[1]) / 2
        low, high = (y - size[0] / 2, z - size[1] / 2), (y + size[0] / 2, z + size[1] / 2)
        center = (k - (count - 1) / 2) * each
        parts += moved(window(each, height, thick, low, high), 0, center, 0)
        places += [at(x, center + y, z, FORWARD) for x in (-0.12, 0.02, 0.1)]
    between = turn("z", float(rng.choice([0.0, 0.0, np.pi / 2, -np.pi / 2])))
    return Composition(parts, places).placed(shift(0, 0, height / 2) @ between)


def slits(rng: np.random.Generator) -> Composition:
    """Draw parallel plates with gaps for a hand between them, upright or level, tilted together."""
    count, gap, thick = int(rng.integers(3, 7)), rng.uniform(0.2, 0.32), rng.uniform(0.004, 0.03)
    depth, height = rng.uniform(0.2, 0.5), rng.uniform(0.3, 0.8)
    parts = repeat(box(depth, thick, height), line(count, (0, gap, 0)))
    places = [Place(p[:3, 3] + (rng.uniform(-0.5, 0.2) * depth, 0, rng.uniform(-0.2, 0.2)), FORWARD)
              for p in line(count - 1, (0, gap, 0))]  # fmt: skip
    tilt = turn("x", float(rng.choice([0.0, 0.3, -0.3, np.pi / 2])))
    return Composition(parts, places).placed(shift(0, 0, height / 2 + rng.uniform(0, 0.2)) @ tilt)


def maze(rng: np.random.Generator) -> Composition:
    """Draw upright walls on the edges of a grid, about half of them: a maze seen from above, or the front."""
    nx, ny, cell, height = (
        int(rng.integers(2, 4)),
        int(rng.integers(3, 5)),
        rng.uniform(0.24, 0.34),
        rng.uniform(0.15, 0.5),
    )
    thick, share, parts = rng.uniform(0.005, 0.02), rng.uniform(0.3, 0.65), list[Part]()
    places = []
    for i in range(nx + 1):
        for j in range(ny + 1):
            x, y = (i - nx / 2) * cell, (j - ny / 2) * cell
            if j < ny and rng.random() < share:
                parts += box(thick, cell, height, at=(x, y + cell / 2, height / 2))
            if i < nx and rng.random() < share:
                parts += box(cell, thick, height, at=(x + cell / 2, y, height / 2))
            if i < nx and j < ny:
                places.append(at(x + cell / 2, y + cell / 2, height * rng.uniform(0.3, 1.1), DOWN))
    if rng.random() < 0.3:  # seen from the front
        return Composition(parts, places).placed(shift(0.1, 0, nx * cell / 2 + 0.05) @ turn("y", -np.pi / 2))
    return Composition(parts, places)


def louvres(rng: np.random.Generator) -> Composition:
    """Draw a screen of tilted slats with some of them broken out."""
    count, step, width = int(rng.integers(5, 12)), rng.uniform(0.07, 0.13), rng.uniform(0.4, 1.0)
    slat = place(box(rng.uniform(0.05, 0.15), width, 0.006), turn("y", rng.uniform(-1.2, 1.2)))
    poses = line(count, (0, 0, step))
    first = int(rng.integers(1, count - 2))
    gap = range(first, min(count - 1, first + int(np.ceil(0.26 / step))))
    parts = repeat(slat, [pose for k, pose in enumerate(poses) if k not in gap])
    parts += [
        *box(0.03, 0.03, count * step, at=(0, -width / 2, 0)),
        *box(0.03, 0.03, count * step, at=(0, width / 2, 0)),
    ]
    middle = float(np.mean([poses[k][2, 3] for k in gap]))
    places = [at(x, y, middle, FORWARD) for x in (-0.1, 0.05, 0.12) for y in rng.uniform(-width, width, 2) / 3]
    return Composition(parts, places).placed(shift(0, 0, count * step / 2 + 0.05))


def doorways(rng: np.random.Generator) -> Composition:
    """Draw frames one behind the other, each shifted, turned and smaller, through which a hand reaches."""
    count, size, bar = int(rng.integers(2, 5)), rng.uniform(0.24, 0.42), rng.uniform(0.01, 0.06)
    parts, places, pose = list[Part](), list[Place](), np.eye(4)
    for _ in range(count):
        height = size * rng.uniform(0.8, 1.2)
        parts += place(frame(size, height, bar), pose)
        places += [Place(pose[:3, 3] + pose[:3, 0] * u, (pose[0, 0], pose[1, 0], pose[2, 0])) for u in (-0.1, 0.06)]
        pose = pose @ shift(rng.uniform(0.1, 0.2), *rng.normal(0, 0.03, 2)) @ turn(rng.normal(size=3), 0.2)
        size *= rng.uniform(0.85, 1.0)
    yaw = turn("z", rng.choice([0.0, -1.2, 1.2]))
    return Composition(parts, places).placed(shift(-0.15, 0, rng.uniform(0.25, 0.6)) @ yaw)


def lids(rng: np.random.Generator) -> Composition:
    """Draw boxes with lids ajar, shelves that fold, and flaps, held open at odd angles."""
    parts, places = list[Part](), list[Place]()
    for side in (-1, 1):
        x, y, z, thick = rng.uniform(0.25, 0.4), rng.uniform(0.28, 0.45), rng.uniform(0.15, 0.4), 0.01
        one = hollow_box(x, y, z, thick, ("top",))
        for far in (-1.0, 1.0):
            leaf = moved(box(x / 2 if rng.random() < 0.6 else x, y, thick), -far * x / 4, 0, 0)
            one += place(leaf, shift(far * x / 2, 0, z / 2 + thick) @ turn("y", far * rng.uniform(0.5, 2.5)))
        at_this = Composition(one, [at(0, 0, u * z, DOWN) for u in (-0.05, 0.25, 0.6)])
        pose = shift(rng.uniform(-0.1, 0.1), side * rng.uniform(0.22, 0.4), z / 2) @ turn("z", rng.normal(0, 0.6))
        parts += at_this.placed(pose).parts
        places += at_this.placed(pose).places
    return Composition(parts, places)


def curtains(rng: np.random.Generator) -> Composition:
    """Draw rows of strips and rods that hang from a rail, or stand up from the tables."""
    rows, count, width = int(rng.integers(1, 4)), int(rng.integers(4, 12)), rng.uniform(0.5, 1.1)
    parts, places, top = list[Part](), list[Place](), rng.uniform(0.6, 1.0)
    for row in range(rows):
        x = (row - (rows - 1) / 2) * rng.uniform(0.18, 0.3)
        parts += rod((x, -width / 2, top), (x, width / 2, top), 0.012)
        for y in rng.uniform(-width / 2, width / 2, count):
            long = rng.uniform(0.15, 0.8) * top
            strip = rod((0, 0, 0), (0, 0, -long), rng.uniform(0.004, 0.02))
            strip = strip if rng.random() < 0.5 else moved(box(0.003, 0.05, long), 0, 0, -long / 2)
            parts += place(strip, shift(x, y, top) @ turn("x", rng.normal(0, 0.15)))
        places += [at(x + u, y, rng.uniform(0.2, 0.9) * top) for u in (-0.1, 0.1) for y in rng.uniform(-0.4, 0.4, 2)]
    standing = Composition(parts, places)
    return standing.placed(shift(0, 0, top) @ turn("x", np.pi)) if rng.random() < 0.25 else standing


def shards(rng: np.random.Generator) -> Composition:
    """Draw large thin plates at all angles that cut through each other, as after a collapse."""
    parts, places = list[Part](), list[Place]()
    for _ in range(int(rng.integers(4, 14))):
        pose = shift(*rng.uniform((-0.3, -0.6, -0.4), (0.3, 0.6, 0.4))) @ turn(
            rng.normal(size=3), rng.uniform(0, np.pi)
        )
        parts += place(box(rng.uniform(0.15, 0.6), rng.uniform(0.1, 0.4), rng.uniform(0.003, 0.02)), pose)
        places.append(Place((pose @ (0, 0, 0.12, 1))[:3]))
    return Composition(parts, places, FLOATING)
