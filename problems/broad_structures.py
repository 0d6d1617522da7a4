"""Grammars of panels, of curved objects that stand alone, and of scattered solids.

Panels: walls with windows, slits, mazes, louvers, doorways in a row, fins, curtains and lids. Curved objects: arches,
hoops, domes, half pipes, and bent handles and hooks. Scattered solids lie, hang or stand at random; random programs
combine parts.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from apex_ompl.problems.broad_parts import (
    BOX,
    CAPSULE,
    CYLINDER,
    FLOATING,
    Composition,
    Part,
    Parts,
    Place,
    arc,
    at,
    ball,
    bend,
    bent_sheet,
    bounds,
    box,
    by_name,
    circle,
    frame,
    grid,
    grille,
    hollow_box,
    jitter,
    joined,
    lattice,
    line,
    mirror,
    moved,
    nest,
    place,
    places_at,
    random_turn,
    repeat,
    ring,
    rod,
    scale,
    shift,
    smooth,
    stack,
    tube,
    turn,
    walk,
    window,
    without,
)  # fmt: skip  # fmt: skip
from apex_ompl.problems.scenes import DOWN, FORWARD

LOW, HIGH = np.array([-0.35, -0.75, 0.02]), np.array([0.35, 0.75, 0.9])  # of what is scattered
MOST = 120  # parts of a random program


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
    """Draw frames in a row, each shifted, turned and smaller, through which a hand reaches."""
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


@joined
def lids(rng: np.random.Generator) -> Iterator[Composition]:
    """Draw boxes with lids ajar, shelves that fold, and flaps, held open at odd angles."""
    for side in (-1, 1):
        x, y, z, thick = rng.uniform(0.25, 0.4), rng.uniform(0.28, 0.45), rng.uniform(0.15, 0.4), 0.01
        one = hollow_box(x, y, z, thick, ("top",))
        for far in (-1.0, 1.0):
            leaf = moved(box(x / 2 if rng.random() < 0.6 else x, y, thick), -far * x / 4, 0, 0)
            one += place(leaf, shift(far * x / 2, 0, z / 2 + thick) @ turn("y", far * rng.uniform(0.5, 2.5)))
        at_this = Composition(one, [at(0, 0, u * z, DOWN) for u in (-0.05, 0.25, 0.6)])
        pose = shift(rng.uniform(-0.1, 0.1), side * rng.uniform(0.22, 0.4), z / 2) @ turn("z", rng.normal(0, 0.6))
        yield at_this.placed(pose)


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


@joined
def arches(rng: np.random.Generator) -> Iterator[Composition]:
    """Draw arches of boxes in a row, or crossing, to reach under and over."""
    for _ in range(int(rng.integers(1, 5))):
        radius, thick = rng.uniform(0.15, 0.4), rng.uniform(0.01, 0.05)
        arch = bent_sheet(arc(radius, 0.0, np.pi, int(rng.integers(6, 12))), rng.uniform(0.02, 0.25), thick)
        pose = shift(rng.uniform(-0.2, 0.2), rng.uniform(-0.35, 0.35), rng.uniform(0, 0.15)) @ turn(
            "z", np.pi / 2 + rng.normal(0, 0.6)
        )
        yield Composition(arch, [at(0, 0, 0.55 * radius), at(0, 0, radius + 0.12, DOWN)]).placed(pose)


def hoops(rng: np.random.Generator) -> Composition:
    """Draw rings of all sizes in the air, some on posts; hands go through them and between them."""
    parts, places = list[Part](), list[Place]()
    for _ in range(int(rng.integers(2, 7))):
        radius, thick = rng.uniform(0.13, 0.28), rng.uniform(0.005, 0.03)
        pose = shift(*rng.uniform((-0.2, -0.5, 0.15), (0.2, 0.5, 0.8))) @ turn(rng.normal(size=3), rng.normal(0, 0.7))
        one = Composition(ring(radius, thick), [at(-0.08, 0, 0, FORWARD), at(0.06, 0, 0, FORWARD)]).placed(pose)
        parts += one.parts
        if rng.random() < 0.5:
            foot = pose[:3, 3] - pose[:3, 2] * radius
            parts += rod((foot[0], foot[1], 0), foot, 0.01)
        places += one.places
    return Composition(parts, places)


def domes(rng: np.random.Generator) -> Composition:
    """Draw a dome of plates with gaps, or of ribs, over the tables; hands reach under and into it."""
    radius, thick, rows = rng.uniform(0.22, 0.42), rng.uniform(0.004, 0.02), 4
    ribs, parts = int(rng.integers(7, 13)), list[Part]()
    share = rng.uniform(0.45, 0.85)
    for row in range(rows):
        low, high = row * np.pi / 2 / rows, (row + 1) * np.pi / 2 / rows
        r, z = radius * np.cos((low + high) / 2), radius * np.sin((low + high) / 2)
        width = 2 * np.pi * radius * np.cos(low) / ribs * 0.95
        plate = place(box(thick, width, radius * (high - low)), turn("y", -(low + high) / 2))
        for pose in circle(ribs, r):
            if rng.random() < share:
                parts += place(plate, shift(0, 0, z) @ pose)
    places = [at(*rng.uniform((-0.5, -0.5, 0.25), (0.3, 0.5, 0.6)) * radius) for _ in range(3)]
    places += [at(-radius - 0.1, 0, 0.15, FORWARD), at(0, 0, radius + 0.1, DOWN)]
    return Composition(parts, places).placed(shift(0, 0, rng.uniform(0, 0.15)))


@joined
def gutters(rng: np.random.Generator) -> Iterator[Composition]:
    """Draw half pipes, troughs and cradles, open upwards, downwards or to the front."""
    for _ in range(int(rng.integers(1, 4))):
        radius, length = rng.uniform(0.13, 0.25), rng.uniform(0.25, 0.8)
        half = tube(radius, length, rng.uniform(0.004, 0.02), 8, np.pi * rng.uniform(0.8, 1.4))
        one = Composition(half, [at(-0.02, 0, u * length) for u in (-0.3, 0.0, 0.3)])
        pose = shift(rng.uniform(-0.15, 0.15), rng.uniform(-0.4, 0.4), rng.uniform(0.15, 0.6))
        yield one.placed(pose @ turn("x", np.pi / 2 + rng.normal(0, 0.4)) @ turn("z", rng.uniform(0, 2 * np.pi)))


def hooks(rng: np.random.Generator) -> Composition:
    """Draw bars bent along random curves that stand on the tables or hang: hooks, handles, coat stands."""
    parts, places = list[Part](), list[Place]()
    for _ in range(int(rng.integers(4, 12))):
        foot = np.array([*rng.uniform((-0.25, -0.6), (0.25, 0.6)), float(rng.choice([0.0, 0.9]))])
        up = 1.0 if foot[2] == 0.0 else -1.0
        turns = rng.uniform((-0.15, -0.15, 0.08), (0.15, 0.15, 0.25), (int(rng.integers(3, 5)), 3)) * (1, 1, up)
        points = foot + np.cumsum(np.concatenate([np.zeros((1, 3)), turns]), axis=0)
        if rng.random() < 0.5:
            points[-1] = points[-2] + (*rng.normal(0, 0.1, 2), -up * 0.1)
        parts += bend(smooth(points, 3 * len(points)), rng.uniform(0.004, 0.025))
        places.append(Place(points[len(points) // 2] + rng.normal(0, 0.1, 3)))
    return Composition(parts, places)


@joined
def bowls(rng: np.random.Generator) -> Iterator[Composition]:
    """Draw bowls and funnels of tilted plates around an axis, upright, tipped over or upside down."""
    for _ in range(int(rng.integers(1, 4))):
        radius, height, slope = rng.uniform(0.13, 0.2), rng.uniform(0.12, 0.28), rng.uniform(0.1, 0.7)
        count = int(rng.integers(8, 13))
        wide = radius + height * np.tan(slope)
        plate = box(0.006, 2.1 * wide * np.tan(np.pi / count), height / np.cos(slope))
        bowl = [p for pose in circle(count, (radius + wide) / 2) for p in place(plate, pose @ turn("y", slope))]
        bowl += rod((0, 0, -height / 2 - 0.01), (0, 0, -height / 2), radius) if rng.random() < 0.7 else []
        one = Composition(bowl, [at(0, 0, u * height, DOWN) for u in (0.0, 0.4, 0.9)], FLOATING)
        pose = shift(rng.uniform(-0.1, 0.1), rng.uniform(-0.45, 0.45), height / 2 + rng.choice([0.02, 0.3]))
        tipped = turn("y", -float(rng.choice([0.0, 0.3, np.pi / 2])))
        yield one.placed(pose @ turn("z", rng.normal(0, 0.8)) @ tipped)


def solid(rng: np.random.Generator, low: float, high: float) -> Parts:
    """Return a primitive of a random kind and turn about the origin, its sizes evenly on a log scale [m]."""
    sizes = np.exp(rng.uniform(np.log(low), np.log(high), 3))
    kind = int(rng.integers(4))
    if kind == BOX:
        one = box(*sizes)
    elif kind in (CYLINDER, CAPSULE):
        one = rod((0, 0, -sizes[1] / 2), (0, 0, sizes[1] / 2), sizes[0] / 2, kind)
    else:
        one = ball(sizes[0] / 2)
    return place(one, random_turn(rng))


def _scattered(rng: np.random.Generator, count: int, low: float, high: float) -> Composition:
    parts = [p for _ in range(count) for p in place(solid(rng, low, high), shift(*rng.uniform(LOW, HIGH)))]
    return Composition(parts, places_at(rng.uniform(LOW, HIGH, (8, 3))))


def clutter(rng: np.random.Generator) -> Composition:
    """Draw primitives of all sizes anywhere, a few or a hundred."""
    return _scattered(rng, int(np.exp(rng.uniform(np.log(5), np.log(110)))), 0.02, 0.3)


def pebbles(rng: np.random.Generator) -> Composition:
    """Draw up to 280 tiny solids in clouds."""
    found = _scattered(rng, int(np.exp(rng.uniform(np.log(30), np.log(280)))), 0.008, 0.06)
    centers = rng.uniform(LOW, HIGH, (int(rng.integers(2, 9)), 3))
    spread = rng.uniform(0.06, 0.25)
    if rng.random() < 0.7:
        parts = list[Part]()
        for kind, size, pose in found.parts:
            there = pose.copy()
            there[:3, 3] = centers[int(rng.integers(len(centers)))] + rng.normal(0, spread, 3)
            parts.append(Part(kind, size, there))
        return Composition(parts, [*places_at(centers), *places_at(rng.uniform(LOW, HIGH, (3, 3)))])
    return found


def boulders(rng: np.random.Generator) -> Composition:
    """Draw a few huge solids that leave narrow ways between them."""
    return _scattered(rng, int(rng.integers(2, 9)), 0.2, 0.6)


def posts(rng: np.random.Generator) -> Composition:
    """Draw a forest of posts, upright or leaning, some only stumps."""
    count, lean, parts = int(rng.integers(6, 40)), rng.choice([0.0, 0.1, 0.4]), list[Part]()
    while len(parts) < count:
        x, y = rng.uniform((-0.3, -0.8), (0.35, 0.8))
        long, radius = rng.uniform(0.2, 1.1), rng.uniform(0.006, 0.035)
        post = rod((0, 0, 0), (0, 0, long), radius) if rng.random() < 0.7 else box(radius, 2 * radius, 2 * long)
        parts += place(post, shift(x, y, 0) @ turn(rng.normal(size=3), rng.normal(0, lean)))
    return Composition(parts, places_at(rng.uniform((-0.1, -0.6, 0.12), (0.35, 0.6, 0.6), (8, 3))))


def mikado(rng: np.random.Generator) -> Composition:
    """Draw long sticks at all angles through a common region, dense or loose."""
    parts, spread = list[Part](), rng.uniform(0.15, 0.4)
    for _ in range(int(rng.integers(8, 60))):
        middle, way = rng.normal(0, spread, 3) * (0.6, 1.2, 0.8) + (0, 0, 0.4), rng.normal(size=3)
        way *= rng.uniform(0.1, 0.6) / np.linalg.norm(way)
        parts += rod(middle - way, middle + way, rng.uniform(0.003, 0.015), CAPSULE)
    return Composition(parts, places_at(rng.normal(0, 0.22, (8, 3)) * (0.6, 1.2, 0.6) + (0, 0, 0.4)))


def blobs(rng: np.random.Generator) -> Composition:
    """Draw random walks of balls and boxes that touch: sponges, worms, corals with holes."""
    parts, places = list[Part](), list[Place]()
    for _ in range(int(rng.integers(2, 7))):
        size = rng.uniform(0.03, 0.12)
        one = ball(size / 2) if rng.random() < 0.6 else box(size, size, size)
        poses = walk(rng, int(rng.integers(6, 30)), 0.8 * size, rng.uniform(0.3, 1.5))
        pose = shift(*rng.uniform(0.7 * LOW, 0.9 * HIGH))
        parts += place(repeat(one, poses), pose)
        places.append(Place((pose @ poses[len(poses) // 2])[:3, 3] + rng.normal(0, size + 0.08, 3)))
    return Composition(parts, [*places, *places_at(rng.uniform(LOW, HIGH, (3, 3)))])


def program(rng: np.random.Generator) -> Composition:
    """Draw what nobody would build: a random program, two to four deep, of the combinators on random parts."""
    parts = _program(rng, int(rng.integers(2, 5)))
    parts = nest(parts, (-0.4, -0.6, 0.0), (0.4, 0.6, 0.9)) if rng.random() < 0.7 else parts
    low, high = bounds(parts)
    points = rng.uniform(low, high, (6, 3))
    if rng.random() < 0.7:  # a room for a hand
        for point in points[:2]:
            remaining = without(parts, point - 0.1, point + 0.1)
            parts = remaining or parts
    return Composition(parts, places_at(points), FLOATING)


def _leaf(rng: np.random.Generator) -> Parts:
    """Return a simple composition of about 0.3 m."""
    u, v, w = rng.uniform(0.1, 0.4, 3)
    thick, n = rng.uniform(0.004, 0.03), int(rng.integers(3, 8))
    low, high = (-0.1, -0.1), (0.1, 0.1)
    leaves = (
        lambda: solid(rng, 0.02, 0.4),
        lambda: hollow_box(u, v, w, thick, tuple(rng.choice(["near", "top", "left"], 2))),
        lambda: window(u + 0.25, v + 0.25, thick, low, high),
        lambda: frame(u, v, thick),
        lambda: grille(u, v, n, 3, thick / 3),
        lambda: lattice((2, 2, 2), u, thick / 2),
        lambda: tube(0.1 + u / 3, v, thick, n + 4, np.pi * rng.uniform(0.5, 2.0)),
        lambda: ring(0.1 + u / 3, thick, 10, np.pi * rng.uniform(0.5, 2.0)),
        lambda: bent_sheet(arc(u, 0.0, rng.uniform(1.0, 4.0), n), v, thick),
        lambda: bend(smooth(rng.uniform(-0.3, 0.3, (4, 3)), 10), thick),
        lambda: stack(rng, n, u),
    )
    return leaves[int(rng.integers(len(leaves)))]()


def _program(rng: np.random.Generator, depth: int) -> Parts:
    """Return parts of a random program; at most ``MOST``."""
    if depth == 0:
        return _leaf(rng)
    inner = _program(rng, depth - 1)
    size = float((bounds(inner)[1] - bounds(inner)[0]).max())
    n = int(rng.integers(2, 6))
    step = rng.normal(size=3)
    step *= size * rng.uniform(0.4, 1.2) / np.linalg.norm(step)
    way = shift(*rng.normal(0, 0.5 * size, 3)) @ random_turn(rng)
    ways = (
        lambda: repeat(inner, line(n, step)),
        lambda: repeat(inner, [pose @ way for pose in circle(n, size * rng.uniform(0.4, 1.0))]),
        lambda: repeat(inner, grid((1, 2, 2), (0.0, size, size))),
        lambda: repeat(inner, walk(rng, n, 0.7 * size)),
        lambda: [*place(inner, way), *mirror(place(inner, way), int(rng.integers(3)))],
        lambda: [*inner, *place(_program(rng, depth - 1), way)],
        lambda: [*inner, *nest(_leaf(rng), -step / 3 - size / 6, -step / 3 + size / 6)],
        lambda: jitter(rng, repeat(inner, line(2, step)), 0.03, 0.3),
        lambda: [*inner, *scale(place(inner, way), rng.uniform(0.4, 0.8))],
    )
    found = ways[int(rng.integers(len(ways)))]()
    if len(found) > MOST:
        found = [found[k] for k in rng.permutation(len(found))[:MOST]]
    return found


STRUCTURES = by_name(
    windows, slits, maze, louvres, doorways, lids, curtains, shards, arches, hoops, domes, gutters, hooks, bowls,
    clutter, pebbles, boulders, posts, mikado, blobs, program,
)  # fmt: skip
"""Grammars of panels, single curved objects and scattered solids by name."""
