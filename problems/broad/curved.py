"""Grammars of curved things that stand alone: arches, hoops, domes, half pipes, and bent handles and hooks."""

from __future__ import annotations

import numpy as np

from apex_ompl.problems.broad.composition import FLOATING, Composition, Place, at
from apex_ompl.problems.broad.compounds import arc, bend, bent_sheet, ring, smooth, tube
from apex_ompl.problems.broad.shapes import Part, box, circle, place, rod, shift, turn
from apex_ompl.problems.scenes import DOWN, FORWARD


def arches(rng: np.random.Generator) -> Composition:
    """Draw arches of boxes one behind the other, or crossing, to reach under and over."""
    parts, places = list[Part](), list[Place]()
    for _ in range(int(rng.integers(1, 5))):
        radius, thick = rng.uniform(0.15, 0.4), rng.uniform(0.01, 0.05)
        arch = bent_sheet(arc(radius, 0.0, np.pi, int(rng.integers(6, 12))), rng.uniform(0.02, 0.25), thick)
        pose = shift(rng.uniform(-0.2, 0.2), rng.uniform(-0.35, 0.35), rng.uniform(0, 0.15)) @ turn(
            "z", np.pi / 2 + rng.normal(0, 0.6)
        )
        one = Composition(arch, [at(0, 0, 0.55 * radius), at(0, 0, radius + 0.12, DOWN)]).placed(pose)
        parts += one.parts
        places += one.places
    return Composition(parts, places)


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


def gutters(rng: np.random.Generator) -> Composition:
    """Draw half pipes, troughs and cradles, open upwards, downwards or to the front."""
    parts, places = list[Part](), list[Place]()
    for _ in range(int(rng.integers(1, 4))):
        radius, length = rng.uniform(0.13, 0.25), rng.uniform(0.25, 0.8)
        half = tube(radius, length, rng.uniform(0.004, 0.02), 8, np.pi * rng.uniform(0.8, 1.4))
        one = Composition(half, [at(-0.02, 0, u * length) for u in (-0.3, 0.0, 0.3)])
        pose = shift(rng.uniform(-0.15, 0.15), rng.uniform(-0.4, 0.4), rng.uniform(0.15, 0.6))
        one = one.placed(pose @ turn("x", np.pi / 2 + rng.normal(0, 0.4)) @ turn("z", rng.uniform(0, 2 * np.pi)))
        parts += one.parts
        places += one.places
    return Composition(parts, places)


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


def bowls(rng: np.random.Generator) -> Composition:
    """Draw bowls and funnels of tilted plates around an axis, upright, tipped over or upside down."""
    parts, places = list[Part](), list[Place]()
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
        one = one.placed(pose @ turn("z", rng.normal(0, 0.8)) @ tipped)
        parts += one.parts
        places += one.places
    return Composition(parts, places)
