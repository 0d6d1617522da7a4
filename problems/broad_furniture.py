"""Grammars of furniture and of containers.

Furniture: racks, cabinets, drawers, tables, stairs, benches and chairs. Containers: crates, pigeonholes, barrels,
cages, bottle crates, and boxes inside of boxes.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from apex_ompl.goals.state_sampling import Direction
from apex_ompl.problems.broad_parts import (
    CAPSULE,
    FLOATING,
    SIDES,
    Composition,
    Part,
    Place,
    at,
    ball,
    between,
    bounds,
    box,
    by_name,
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
    repeat,
    ring,
    rod,
    shift,
    stack,
    table,
    tube,
    turn,
)  # fmt: skip  # fmt: skip
from apex_ompl.problems.scenes import DOWN, FORWARD


def rack(rng: np.random.Generator) -> Composition:
    """Draw a rack of boards on four posts or between walls, with objects on its boards."""
    depth, width, thick = rng.uniform(0.2, 0.45), rng.uniform(0.35, 1.0), rng.uniform(0.008, 0.03)
    heights = np.cumsum([rng.uniform(0.02, 0.15), *rng.uniform(0.24, 0.38, int(rng.integers(2, 4)))])
    parts, places = list[Part](), list[Place]()
    for z in heights:
        parts += box(depth, width, thick, at=(0, 0, z))
    top = float(heights[-1])
    if rng.random() < 0.5:
        parts += repeat(box(depth, thick, top), line(2 + int(rng.integers(2)), (0, width / 2, 0)))
        parts = [*parts[: len(heights)], *moved(parts[len(heights) :], 0, 0, top / 2)]
    else:
        post = rod((0, 0, 0), (0, 0, top), 0.012)
        parts += repeat(post, [shift(x * depth / 2, y * width / 2, 0) for x in (-1, 1) for y in (-1, 1)])
    if rng.random() < 0.4:
        parts += box(thick, width, top, at=(depth / 2, 0, top / 2))
    for low, high in zip(heights[:-1], heights[1:], strict=True):
        for y in rng.uniform(-width / 2, width / 2, 2):
            places.append(at(rng.uniform(-depth / 2, depth / 6), y, (low + high) / 2, FORWARD))
            if rng.random() < 0.5:
                pile = stack(rng, 2, 0.1)
                parts += moved(pile, rng.uniform(-depth / 3, depth / 3), rng.uniform(-width / 2, width / 2), low)
    return Composition(parts, places)


def drawers(rng: np.random.Generator) -> Composition:
    """Draw a chest with drawers pulled out by different lengths."""
    rows, columns, depth = int(rng.integers(2, 4)), int(rng.integers(1, 4)), rng.uniform(0.25, 0.4)
    width, height, thick = rng.uniform(0.26, 0.34), rng.uniform(0.18, 0.26), 0.012
    parts = moved(hollow_box(depth, columns * width, rows * height, 0.015), 0, 0, rows * height / 2)
    places = []
    for row in range(rows):
        for column in range(columns):
            out = float(rng.choice([0.0, 1.0])) * rng.uniform(0.3, 0.9) * depth
            y, z = (column - (columns - 1) / 2) * width, row * height
            tray = hollow_box(depth - 0.03, width - 0.05, 0.6 * height, thick, ("top",))
            parts += moved(tray, -out, y, z + 0.35 * height)
            if out > 0.0:
                places.append(at(-out - depth / 4, y, z + 0.5 * height, DOWN))
                places.append(at(-depth / 2 - out - 0.08, y, z + 0.4 * height, FORWARD))
    places += [at(-depth / 2 - 0.1, y, 0.15, DOWN) for y in (-width, width)]
    return Composition(parts, places)


def cabinet(rng: np.random.Generator) -> Composition:
    """Draw a cabinet with doors ajar, its hinges at its sides or its top."""
    depth, width, height, thick = rng.uniform(0.2, 0.4), rng.uniform(0.4, 0.8), rng.uniform(0.3, 0.6), 0.015
    parts = hollow_box(depth, width, height, thick)
    if rng.random() < 0.5:
        parts += box(depth, width, thick, at=(0, 0, rng.uniform(-0.1, 0.1)))
    if rng.random() < 0.7:
        for side in (-1.0, 1.0):
            leaf = moved(box(thick, width / 2, height), 0, -side * width / 4, 0)
            ajar = turn("z", -side * rng.uniform(0.6, 2.4))
            parts += place(leaf, shift(-depth / 2 - thick, side * (width / 2 + thick), 0) @ ajar)
    else:
        leaf = moved(box(thick, width, height), 0, 0, -height / 2)
        parts += place(leaf, shift(-depth / 2 - thick, 0, height / 2) @ turn("y", rng.uniform(0.7, 1.9)))
    points = rng.uniform((-depth / 2, -width / 3, -height / 3), (depth / 8, width / 3, height / 3), (4, 3))
    raised = shift(0, 0, height / 2 + rng.uniform(0.0, 0.3))
    return Composition(parts, [Place(p, FORWARD) for p in points]).placed(raised)


@joined
def tables(rng: np.random.Generator) -> Iterator[Composition]:
    """Draw tables and stools under and beside each other, with objects on and beneath them."""
    for _ in range(int(rng.integers(1, 4))):
        x, y, height = rng.uniform(0.2, 0.5), rng.uniform(0.25, 0.7), rng.uniform(0.2, 0.6)
        pose = shift(rng.uniform(-0.15, 0.15), rng.uniform(-0.4, 0.4), 0) @ turn("z", rng.normal(0, 0.5))
        one = table(x, y, height, rng.uniform(0.01, 0.05), rng.uniform(0.015, 0.04))
        one += moved(stack(rng, int(rng.integers(1, 5)), 0.12), rng.uniform(-x, x) / 2, rng.uniform(-y, y) / 2, height)
        around = Composition(one, [at(0, rng.uniform(-y, y) / 2.5, 0.55 * height), at(0, 0, height + 0.12, DOWN)])
        yield around.placed(pose)


def stairs(rng: np.random.Generator) -> Composition:
    """Draw steps, solid or of boards, with a railing; they rise to the front, the back or a side."""
    count, rise, run = int(rng.integers(3, 7)), rng.uniform(0.06, 0.13), rng.uniform(0.08, 0.16)
    width, solid = rng.uniform(0.3, 0.6), bool(rng.integers(2))
    parts, places = list[Part](), list[Place]()
    for k in range(count):
        x, z = (k - count / 2) * run, (k + 1) * rise
        parts += box(run, width, z if solid else 0.02, at=(x, 0, z / 2 if solid else z))
        parts += rod((x, width / 2, z), (x, width / 2, z + 0.2), 0.008) if rng.random() < 0.8 else []
        places.append(at(x, rng.uniform(-width, width) / 2, z + rng.uniform(0.08, 0.2), DOWN))
        if not solid and z > 0.2:
            places.append(at(x, 0, z - 0.13))
    half = count / 2 * run
    parts += rod((-half, width / 2, rise + 0.2), (half, width / 2, (count + 1) * rise + 0.2), 0.015, CAPSULE)
    return Composition(parts, places).placed(turn("z", float(rng.choice([0.0, np.pi / 2, np.pi, -np.pi / 2]))))


def bench(rng: np.random.Generator) -> Composition:
    """Draw a bench with a board of tools on its back, a lamp and a vice."""
    width, depth, height = rng.uniform(0.6, 1.1), rng.uniform(0.25, 0.4), rng.uniform(0.05, 0.25)
    back = rng.uniform(0.4, 0.7)
    parts = [*box(depth, width, 0.03, at=(0, 0, height)), *box(0.02, width, back, at=(depth / 2, 0, height + back / 2))]
    places = [at(depth / 2 - 0.12, y, height + rng.uniform(0.15, back), FORWARD) for y in rng.uniform(-0.4, 0.4, 3)]
    for y in np.linspace(-width / 2, width / 2, int(rng.integers(5, 12))):
        z, long = height + back * rng.uniform(0.4, 0.9), rng.uniform(0.08, 0.25)
        parts += rod((depth / 2, y, z), (depth / 2 - 0.06, y, z), 0.005)
        tool = box(0.02, rng.uniform(0.02, 0.06), long)
        parts += place(tool, shift(depth / 2 - 0.05, y, z - long / 2) @ turn("x", rng.normal(0, 0.3)))
    jaw = box(0.12, 0.03, 0.14, at=(-depth / 3, 0.08, height + 0.07))
    vice = [*jaw, *mirror(jaw), *rod((-depth / 3, -0.2, height + 0.05), (-depth / 3, 0.2, height + 0.05), 0.012)]
    parts += moved(vice, 0, rng.uniform(-0.25, 0.25), 0)
    elbow = np.array([-depth / 2, rng.uniform(-0.3, 0.3), height + rng.uniform(0.35, 0.6)])
    parts += rod((depth / 2, elbow[1], height), elbow, 0.012, CAPSULE)
    parts += rod(elbow, elbow + (-0.05, 0.05, -0.12), 0.05)
    return Composition(parts, [*places, at(-depth / 3, 0, height + 0.16, DOWN)])


@joined
def chairs(rng: np.random.Generator) -> Iterator[Composition]:
    """Draw chairs that stand, lie, and are stacked upside down, the legs among each other."""
    for _ in range(int(rng.integers(2, 5))):
        seat, height = rng.uniform(0.22, 0.35), rng.uniform(0.2, 0.35)
        chair = table(seat, seat, height, 0.02, 0.025)
        for y in between((0, -seat / 2, 0), (0, seat / 2, 0), int(rng.integers(2, 6)))[:, 1]:
            chair += rod((seat / 2, y, height), (seat / 2 + 0.05, y, 2 * height), 0.01)
        chair += box(0.02, seat, 0.06, at=(seat / 2 + 0.05, 0, 2 * height))
        lying = float(rng.choice([0.0, np.pi / 2, np.pi]))
        pose = shift(rng.uniform(-0.15, 0.15), rng.uniform(-0.45, 0.45), height * (lying > 1.0)) @ turn(
            "z", rng.normal(0, 2)
        )
        one = Composition(chair, [at(0, 0, height / 2), at(0, 0, height + 0.12)])
        yield one.placed(pose @ turn("x", lying))


@joined
def crates(rng: np.random.Generator) -> Iterator[Composition]:
    """Draw open boxes, upright and tilted, next to and above each other, with objects in them."""
    for k in range(int(rng.integers(2, 6))):
        x, y, z = rng.uniform(0.22, 0.36), rng.uniform(0.22, 0.36), rng.uniform(0.1, 0.36)
        side, fingers = (("near",), FORWARD) if rng.random() < 0.4 else (("top",), DOWN)
        crate = hollow_box(x, y, z, rng.uniform(0.004, 0.02), side)
        if rng.random() < 0.5:
            crate += ball(rng.uniform(0.02, 0.05), at=(rng.uniform(-x, x) / 3, rng.uniform(-y, y) / 3, -z / 2 + 0.04))
        mouth = np.array([-x / 2 if side == ("near",) else 0.0, 0.0, z / 2 if side == ("top",) else 0.0])
        inside = [Place(mouth * u, fingers) for u in (0.2, 0.6, 1.1)]
        pose = shift(rng.uniform(-0.12, 0.12), 0.36 * (k - 2) + rng.normal(0, 0.04), z / 2 + rng.choice([0.0, 0.3]))
        yield Composition(crate, inside).placed(pose @ turn(rng.normal(size=3), rng.normal(0, 0.25)))


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


@joined
def barrels(rng: np.random.Generator) -> Iterator[Composition]:
    """Draw barrels of staves that stand, lie and lean, some with a bottom and with hoops."""
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
        yield Composition(barrel, inside).placed(pose @ turn("z", rng.normal(0, 0.4)) @ lying)


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


FURNITURE = by_name(
    rack, drawers, cabinet, tables, stairs, bench, chairs, crates, pigeonholes, barrels, cage, bottles, nested,
    packed,
)  # fmt: skip
"""Grammars of furniture and containers by name."""
