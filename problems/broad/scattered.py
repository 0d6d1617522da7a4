"""Grammars of what lies, hangs or stands around at random, and random programs of the combinators."""

from __future__ import annotations

import numpy as np

from apex_ompl.problems.broad.composition import FLOATING, Composition, Place, places_at
from apex_ompl.problems.broad.compounds import (
    arc,
    bend,
    bent_sheet,
    frame,
    grille,
    hollow_box,
    lattice,
    ring,
    smooth,
    stack,
    tube,
    window,
)  # fmt: skip
from apex_ompl.problems.broad.shapes import (
    BOX,
    CAPSULE,
    CYLINDER,
    Part,
    Parts,
    ball,
    bounds,
    box,
    circle,
    grid,
    jitter,
    line,
    mirror,
    nest,
    place,
    random_turn,
    repeat,
    rod,
    scale,
    shift,
    turn,
    walk,
    without,
)  # fmt: skip

LOW, HIGH = np.array([-0.35, -0.75, 0.02]), np.array([0.35, 0.75, 0.9])  # of what is scattered
MOST = 120  # parts of a random program


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
