"""Grammars of the suite ``unseen``, never trained for, that repeat one element.

Thin blades around hubs (``blades``), wheels with spokes on axles (``wheels``), girders of triangles (``truss``), cells
of six sides (``honeycomb``) and brushes of needles (``bristles``).
"""

from __future__ import annotations

import numpy as np

from apex_ompl.problems.broad.composition import FLOATING, Composition, Place, at
from apex_ompl.problems.broad.compounds import fan, ring, tube
from apex_ompl.problems.broad.shapes import CAPSULE, CYLINDER, Part, place, random_turn, rod, shift, turn
from apex_ompl.problems.scenes import FORWARD


def blades(rng: np.random.Generator) -> Composition:
    """Draw propellers, turbines, harrows and saws: thin blades around hubs or along shafts."""
    parts, places = list[Part](), list[Place]()
    for _ in range(int(rng.integers(1, 4))):
        count, radius, rows = int(rng.integers(3, 8)), rng.uniform(0.2, 0.42), int(rng.integers(1, 4))
        rotor = [
            p
            for row in range(rows)
            for p in place(
                fan(count, radius, rng.uniform(0.02, 0.12), 0.004, rng.uniform(-1.2, 1.2)),
                shift(0, 0, 0.22 * row) @ turn("z", rng.uniform(0, 6)),
            )
        ]
        rotor += rod((0, 0, -0.05), (0, 0, 0.22 * rows), 0.025, CYLINDER)
        gap = np.pi / count
        inside = [at(0.7 * radius * np.cos(gap), 0.7 * radius * np.sin(gap), z) for z in (-0.1, 0.0, 0.11)]
        pose = shift(rng.uniform(0, 0.2), rng.uniform(-0.5, 0.5), rng.uniform(0.2, 0.6))
        found = Composition(rotor, [*inside, at(-radius - 0.06, 0, 0)]).placed(
            pose @ turn(rng.normal(size=3), rng.uniform(0, np.pi))
        )
        parts += found.parts
        places += found.places
    return Composition(parts, places, FLOATING)


def wheels(rng: np.random.Generator) -> Composition:
    """Draw discs and wheels with spokes on axles, the hands between the spokes and beside the rims."""
    parts, places = list[Part](), list[Place]()
    for _ in range(int(rng.integers(1, 4))):
        radius, spokes, rim = rng.uniform(0.2, 0.4), int(rng.integers(3, 7)), rng.uniform(0.008, 0.03)
        wheel = ring(radius, rim, 14)
        for angle in np.arange(spokes) * 2 * np.pi / spokes:
            wheel += rod((0, 0, 0), (0, radius * np.cos(angle), radius * np.sin(angle)), rim / 2, CYLINDER)
        wheel += rod((-0.12, 0, 0), (0.12, 0, 0), rim)
        angle = np.pi / spokes
        gap = 0.62 * radius * np.array([0.0, np.cos(angle), np.sin(angle)])
        pose = shift(rng.uniform(-0.15, 0.15), rng.uniform(-0.45, 0.45), rng.uniform(0.3, 0.6))
        one = Composition(wheel, [Place(gap + (x, 0, 0), FORWARD) for x in (-0.1, 0.04)])
        one = one.placed(pose @ turn("z", rng.normal(0, 0.6)) @ turn("x", rng.uniform(0, 2 * np.pi)))
        parts += one.parts
        places += one.places
    return Composition(parts, places)


def truss(rng: np.random.Generator) -> Composition:
    """Draw girders of triangles, three chords each, that stand, span and lean; hands reach between their bars."""
    parts, places = list[Part](), list[Place]()
    for _ in range(int(rng.integers(1, 5))):
        radius, bays, bay = rng.uniform(0.1, 0.22), int(rng.integers(2, 6)), rng.uniform(0.18, 0.32)
        bar, chord = rng.uniform(0.004, 0.01), rng.uniform(0.008, 0.016)
        angles = np.arange(3) * 2 * np.pi / 3
        levels = (np.arange(bays + 1) - bays / 2) * bay
        nodes = np.array([[(radius * np.cos(u), radius * np.sin(u), z) for u in angles] for z in levels])
        one = list[Part]()
        for k in range(3):
            one += rod(nodes[0, k], nodes[-1, k], chord)
            for level in range(bays + 1):
                one += rod(nodes[level, k], nodes[level, (k + 1) % 3], bar)
                one += rod(nodes[level, k], nodes[level + 1, (k + 1) % 3], bar) if level < bays else []
        inside = [at(0.0, 0.0, z) for z in (levels[:-1] + levels[1:]) / 2] + [at(radius + 0.1, 0.0, 0.0)]
        pose = shift(*rng.uniform((-0.15, -0.5, 0.2), (0.25, 0.5, 0.7)))
        leaning = random_turn(rng) if rng.random() < 0.4 else turn("x", float(rng.choice([0.0, np.pi / 2])))
        found = Composition(one, inside).placed(pose @ leaning)
        parts += found.parts
        places += found.places
    return Composition(parts, places)


def honeycomb(rng: np.random.Generator) -> Composition:
    """Draw a wall of cells of six sides, their walls thin, some left out; hands reach into the cells."""
    radius, depth, share = rng.uniform(0.13, 0.18), rng.uniform(0.1, 0.35), rng.uniform(0.6, 1.0)
    cell = place(tube(radius, depth, 0.004, 6), turn("y", np.pi / 2))
    step, parts, places = 2 * radius + 0.008, list[Part](), list[Place]()
    for row in range(int(rng.integers(1, 4))):
        for column in range(int(rng.integers(2, 5))):
            y, z = (column - 1.5 + 0.5 * (row % 2)) * step, (row + 0.6) * step * np.sqrt(3.0) / 2.0
            bulge = -0.3 * y * y
            places += [at(u * depth + bulge, y, z, FORWARD) for u in (-0.7, -0.1, 0.4)]
            parts += place(cell, shift(bulge, y, z)) if rng.random() < share else []
    parts = parts or cell
    return Composition(parts, places).placed(shift(0, 0, rng.uniform(0.0, 0.25)) @ turn("y", rng.normal(0, 0.2)))


def bristles(rng: np.random.Generator) -> Composition:
    """Draw brushes, hedgehogs and beds of nails: needles that stand off balls, rods and plates."""
    parts, places = list[Part](), list[Place]()
    for _ in range(int(rng.integers(2, 6))):
        count, long, thick = int(rng.integers(12, 45)), rng.uniform(0.08, 0.25), rng.uniform(0.002, 0.006)
        core, kind = rng.uniform(0.03, 0.1), int(rng.integers(3))
        one = rod((-0.2, 0, 0), (0.2, 0, 0), core / 2) if kind else rod((0, 0, -0.01), (0, 0, 0.01), core)
        for _ in range(count):
            way = (
                rng.normal(size=3) * ((1, 1, 1), (0.1, 1, 1), (0.1, 0.1, 0))[kind]
                + ((0, 0, 0), (0, 0, 0), (0, 0, 1))[kind]
            )
            way /= np.linalg.norm(way)
            foot = (
                np.array([rng.uniform(-0.2, 0.2), rng.uniform(-0.1, 0.1) * (kind == 2), 0.0]) if kind else np.zeros(3)
            )
            one += rod(foot, foot + (long + core) * way, thick, CAPSULE)
        pose = shift(*rng.uniform((-0.2, -0.5, 0.1), (0.25, 0.5, 0.8))) @ random_turn(rng)
        parts += place(one, pose)
        places += [
            Place(pose[:3, 3] + (long + core + 0.1) * way / np.linalg.norm(way)) for way in rng.normal(size=(3, 3))
        ]
    return Composition(parts, places)
