"""Grammars of containers: crates, pigeonholes, barrels, cages, bottle crates, and boxes inside of boxes."""

from __future__ import annotations

import numpy as np

from apex_ompl.goals.state_sampling import Direction
from apex_ompl.problems.broad.composition import FLOATING, Composition, Place, at
from apex_ompl.problems.broad.compounds import SIDES, frame, grille, hollow_box, lattice, ring, tube
from apex_ompl.problems.broad.shapes import (
    Part,
    ball,
    bounds,
    box,
    grid,
    jitter,
    moved,
    nest,
    place,
    repeat,
    rod,
    shift,
    turn,
)  # fmt: skip
from apex_ompl.problems.scenes import DOWN, FORWARD


def crates(rng: np.random.Generator) -> Composition:
    """Draw open boxes, upright and tilted, next to and above each other, with things in them."""
    parts, places = list[Part](), list[Place]()
    for k in range(int(rng.integers(2, 6))):
        x, y, z = rng.uniform(0.22, 0.36), rng.uniform(0.22, 0.36), rng.uniform(0.1, 0.36)
        side, fingers = (("near",), FORWARD) if rng.random() < 0.4 else (("top",), DOWN)
        crate = hollow_box(x, y, z, rng.uniform(0.004, 0.02), side)
        if rng.random() < 0.5:
            crate += ball(rng.uniform(0.02, 0.05), at=(rng.uniform(-x, x) / 3, rng.uniform(-y, y) / 3, -z / 2 + 0.04))
        mouth = np.array([-x / 2 if side == ("near",) else 0.0, 0.0, z / 2 if side == ("top",) else 0.0])
        inside = [Place(mouth * u, fingers) for u in (0.2, 0.6, 1.1)]
        pose = shift(rng.uniform(-0.12, 0.12), 0.36 * (k - 2) + rng.normal(0, 0.04), z / 2 + rng.choice([0.0, 0.3]))
        one = Composition(crate, inside).placed(pose @ turn(rng.normal(size=3), rng.normal(0, 0.25)))
        parts += one.parts
        places += one.places
    return Composition(parts, places)


def pigeonholes(rng: np.random.Generator) -> Composition:
    """Draw a wall of cells, some of them blocked, filled or deeper than others."""
    columns, rows = int(rng.integers(2, 5)), int(rng.integers(1, 4))
    size, depth, thick = rng.uniform(0.22, 0.34), rng.uniform(0.15, 0.4), rng.uniform(0.005, 0.02)
    parts, places = list[Part](), list[Place]()
    for pose in grid((1, columns, rows), (0, size + thick, size + thick)):
        cell = hollow_box(depth, size, size, thick, ("near", "far") if rng.random() < 0.3 else ("near",))
        content = rng.random()
        if content < 0.15:
            cell += box(0.01, size, size * rng.uniform(0.3, 1.0), at=(-depth / 2, 0, 0))
        elif content < 0.35:
            cell += rod((-depth / 2, rng.uniform(-0.1, 0.1), -size / 2), (depth / 2, 0, size / 2), 0.01)
        parts += place(cell, pose)
        places.append(Place(pose[:3, 3] - (rng.uniform(-0.1, 0.5) * depth, 0, 0), FORWARD))
    raised = shift(0, 0, rows * size / 2 + rng.uniform(0.02, 0.25))
    return Composition(parts, places).placed(raised)


def barrels(rng: np.random.Generator) -> Composition:
    """Draw barrels of staves that stand, lie and lean, some with a bottom and with hoops."""
    parts, places = list[Part](), list[Place]()
    for k in range(int(rng.integers(1, 4))):
        radius, length = rng.uniform(0.13, 0.2), rng.uniform(0.15, 0.4)
        barrel = tube(radius, length, rng.uniform(0.006, 0.02), int(rng.integers(7, 14)))
        if rng.random() < 0.7:
            barrel += rod((0, 0, -length / 2 - 0.02), (0, 0, -length / 2), radius)
        if rng.random() < 0.4:
            barrel += place(ring(radius + 0.02, 0.01), shift(0, 0, length / 3) @ turn("y", np.pi / 2))
        inside = [at(0, 0, z * length, DOWN) for z in (-0.1, 0.2, 0.5)]
        lying = turn("y", -rng.choice([0.0, 0.4, np.pi / 2]))  # its mouth to the front
        pose = shift(rng.uniform(-0.1, 0.1), 0.45 * (k - 1) + rng.normal(0, 0.05), length / 2 + rng.uniform(0, 0.2))
        one = Composition(barrel, inside).placed(pose @ turn("z", rng.normal(0, 0.4)) @ lying)
        parts += one.parts
        places += one.places
    return Composition(parts, places)


def cage(rng: np.random.Generator) -> Composition:
    """Draw a cage of bars, of any number and spacing, some bars missing or bent aside."""
    x, y, z = rng.uniform(0.3, 0.5), rng.uniform(0.3, 0.6), rng.uniform(0.35, 0.7)
    spacing, radius = rng.uniform(0.16, 0.28), rng.uniform(0.004, 0.015)
    columns, rows = max(2, round(y / spacing) + 1), int(rng.integers(2, 4))
    front = grille(y, z, columns, rows, radius)
    side = grille(x, z, max(2, round(x / spacing) + 1), rows, radius)
    parts = [*moved(front, -x / 2, 0, 0), *place(side, shift(0, -y / 2, 0) @ turn("z", np.pi / 2))]
    parts += place(side, shift(0, y / 2, 0) @ turn("z", np.pi / 2))
    parts += moved(front, x / 2, 0, 0) if rng.random() < 0.5 else []
    parts += box(x, y, 0.01, at=(0, 0, z / 2)) if rng.random() < 0.7 else []
    parts = jitter(rng, parts, 0.004, rng.choice([0.0, 0.1]))
    parts = [part for part in parts if rng.random() < 0.93]
    points = rng.uniform((-x / 2, -y / 3, -z / 3), (x / 4, y / 3, z / 3), (4, 3))
    return Composition(parts, [Place(p, FORWARD) for p in points]).placed(shift(0, 0, z / 2 + rng.uniform(0, 0.2)))


def bottles(rng: np.random.Generator) -> Composition:
    """Draw a crate or a tray of bottles, cans and candles in rows, some fallen."""
    counts, step = (int(rng.integers(2, 5)), int(rng.integers(3, 8)), 1), rng.uniform(0.09, 0.2)
    parts, places = list[Part](), list[Place]()
    for pose in grid(counts, (step, step, 0)):
        radius, height = rng.uniform(0.2, 0.42) * step, rng.uniform(0.08, 0.3)
        bottle = rod((0, 0, 0), (0, 0, height), radius)
        bottle += rod((0, 0, height), (0, 0, 1.4 * height), radius / 3) if rng.random() < 0.6 else []
        if rng.random() < 0.15:
            places.append(Place(pose[:3, 3] + (0, 0, 0.12), DOWN))
            continue
        parts += place(bottle, pose @ turn(rng.normal(size=3), rng.choice([0.0, 0.15])))
        places.append(Place(pose[:3, 3] + (step / 2, step / 2, height + 0.05), DOWN))
    low, high = bounds(parts)
    if rng.random() < 0.6:
        (x, y, _), (u, v, _) = high - low, (low + high) / 2
        parts += moved(hollow_box(x, y, rng.uniform(0.05, 0.2), 0.01, ("top",)), u, v, 0.08)
    return Composition(parts, places)


def nested(rng: np.random.Generator) -> Composition:
    """Draw an open box inside another one, three deep, the openings turned to different sides."""
    directions: dict[str, Direction] = {
        "near": (1.0, 0.0, 0.0), "far": (-1.0, 0.0, 0.0), "left": (0.0, -1.0, 0.0), "right": (0.0, 1.0, 0.0),
        "bottom": (0.0, 0.0, 1.0), "top": (0.0, 0.0, -1.0),
    }  # fmt: skip
    size, parts, places = rng.uniform(0.5, 0.8), list[Part](), list[Place]()
    offset = np.zeros(3)
    for depth in range(int(rng.integers(2, 4))):
        side = str(rng.choice(["near", "top", "left", "right"] if depth else ["near", "top"]))
        shell = rng.random()
        open_sides = (side, str(rng.choice(SIDES)))
        one = hollow_box(size, size, size, 0.01, open_sides) if shell < 0.7 else lattice((2, 2, 2), size, 0.012)
        if shell > 0.9:
            one = place(frame(size, size, 0.02), turn("z", rng.uniform(0, 1)))
        parts += moved(one, *offset)
        fingers = np.array(directions[side])
        places += [Place(offset - u * size * fingers, directions[side]) for u in (0.1, 0.35, 0.6)]
        size *= rng.uniform(0.5, 0.65)
        offset = offset + rng.uniform(-0.06, 0.06, 3)
    return Composition(parts, places, FLOATING)


def packed(rng: np.random.Generator) -> Composition:
    """Draw a dense pack of small boxes, balls and rods with holes and aisles in it."""
    counts = (int(rng.integers(2, 5)), int(rng.integers(4, 8)), int(rng.integers(3, 6)))
    step, hollow = rng.uniform(0.09, 0.13), rng.uniform(0.3, 0.7)
    parts, places = list[Part](), list[Place]()
    kinds = [*box(step, step, step), *ball(step / 2), *rod((0, 0, -step / 2), (0, 0, step / 2), step / 2.2)]
    small = nest(kinds, (-step / 2,) * 3, (step / 2,) * 3)
    low = rng.uniform(-0.5, 0.2, 3) * np.array(counts) * step
    high = low + rng.uniform(0.25, 0.4, 3)
    for pose in grid(counts, (step, step, step)):
        where = pose[:3, 3]
        if ((where > low) & (where < high)).all() or rng.random() < hollow:
            if rng.random() < 0.1:
                places.append(Place(where, FORWARD))
            continue
        parts += repeat(
            [small[int(rng.integers(3))]] if rng.random() < 0.3 else box(step * 0.9, step * 0.9, step * 0.9), [pose]
        )
    places += [Place((low + high) / 2, FORWARD), Place((low + high) / 2, DOWN)]
    return Composition(parts, places).placed(shift(0, 0, counts[2] * step / 2))
