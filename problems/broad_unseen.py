"""Grammars of the suite ``unseen``, which is out of distribution: no data of training are drawn from them.

The grammars of ``broad`` give straight, standing or scattered objects; their curved objects are short and alone. Those
of ``unseen`` give connected structures: networks of pipes (``pipework``), bent tunnels to reach into (``tunnel``),
branching trees (``tree``), helices around a hand (``spiral``), sagging nets (``net``), gears and shafts in a housing
(``machine``), and ribs along a bent spine (``skeleton``).

Others repeat one element: thin blades around hubs (``blades``), wheels with spokes on axles (``wheels``), girders of
triangles (``truss``), hexagonal cells (``honeycomb``) and brushes of needles (``bristles``).
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from apex_ompl.problems.broad_parts import (
    CAPSULE,
    CYLINDER,
    FLOATING,
    Composition,
    Part,
    Parts,
    Place,
    along,
    at,
    ball,
    bend,
    box,
    by_name,
    circle,
    fan,
    hollow_box,
    joined,
    moved,
    place,
    places_at,
    random_turn,
    repeat,
    ring,
    rod,
    sagging,
    shift,
    smooth,
    tube,
    turn,
)  # fmt: skip
from apex_ompl.problems.scenes import DOWN, FORWARD
from apex_ompl.types import Array


def pipework(rng: np.random.Generator) -> Composition:
    """Draw pipes that run along the axes with elbows, flanges, valves and a vessel, crossing each other."""
    parts, places, low, high = list[Part](), list[Place](), np.array([-0.25, -0.6, 0.05]), np.array([0.3, 0.6, 0.9])
    for _ in range(int(rng.integers(3, 9))):
        radius, point = rng.uniform(0.008, 0.035), rng.uniform(low, high)
        before = -1
        for _ in range(int(rng.integers(3, 7))):
            axis = int(rng.choice([k for k in range(3) if k != before]))
            end = point.copy()
            end[axis] = rng.uniform(low[axis], high[axis])
            if abs(end[axis] - point[axis]) < 0.06:
                continue
            parts += [*rod(point, end, radius), *ball(1.15 * radius, end)]
            pose, length = along(point, end)
            if rng.random() < 0.5:
                parts += place(
                    rod((0, 0, -0.01), (0, 0, 0.01), 1.8 * radius), pose @ shift(0, 0, rng.uniform(-0.3, 0.3) * length)
                )
            if rng.random() < 0.2:
                parts += place(rod((0, 0, 0), (0, 0.08, 0), 0.006), pose)
                parts += place(ring(0.04, 0.006, 8), pose @ shift(0, 0.08, 0) @ turn("z", np.pi / 2))
            places.append(Place((point + end) / 2 + rng.normal(0, 0.1, 3)))
            point, before = end, axis
    vessel = rng.uniform(low, high)
    parts += rod(vessel, vessel + (0, 0, 0.25), rng.uniform(0.06, 0.12), CAPSULE) if rng.random() < 0.6 else []
    return Composition(parts, places)


def _frames(points: Array) -> list[Array]:
    """Return poses at the middles of the pieces of a curve, z along it, that turn about it as little as possible."""
    found: list[Array] = []
    for a, b in zip(points[:-1], points[1:], strict=True):
        pose, _ = along(a, b)
        if found:
            z = pose[:3, 2]
            x = found[-1][:3, 0] - z * (found[-1][:3, 0] @ z)
            x /= np.linalg.norm(x)
            pose[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
        found.append(pose)
    return found


def tunnel(rng: np.random.Generator) -> Composition:
    """Draw a bent tunnel of staves or of rings from the front to its end somewhere, wide enough for a hand."""
    parts, places = list[Part](), list[Place]()
    for side in ((-1, 1), (-1, 1), (-1,), (1,))[int(rng.integers(4))]:
        radius, pieces = rng.uniform(0.13, 0.18), int(rng.integers(4, 7))
        turns = np.array([[0, 0, 0], [0.16, 0, 0], [0.32, *rng.normal(0, 0.1, 2)], [0.45, *rng.normal(0, 0.18, 2)]])
        points = smooth(turns + (-0.2, side * rng.uniform(0.2, 0.4), rng.uniform(0.2, 0.6)), pieces + 1)
        ribs, poses = rng.random() < 0.5, _frames(points)
        for pose, step in zip(poses, np.linalg.norm(np.diff(points, axis=0), axis=1), strict=True):
            hoop = place(ring(radius, 0.008), turn("y", np.pi / 2)) if ribs else tube(radius, step, 0.006, 9)
            parts += place(hoop, pose)
        if ribs:
            for angle in np.arange(6) * np.pi / 3:
                offset = radius * np.array([np.cos(angle), np.sin(angle), 0.0, 0.0]) + (0, 0, 0, 1)
                parts += bend(np.array([(pose @ offset)[:3] for pose in poses]), 0.006)
        places += [Place(pose[:3, 3], (pose[0, 2], pose[1, 2], pose[2, 2])) for pose in poses[:-1]]
        places.append(at(points[0][0] - 0.1, points[0][1], points[0][2], FORWARD))
    return Composition(parts, places)


def tree(rng: np.random.Generator) -> Composition:
    """Draw trees: branches that fork three to five times, getting thinner, with fruits at some of their ends."""
    parts, places = list[Part](), list[Place]()

    def grow(a: Array, way: Array, radius: float, depth: int) -> None:
        b = a + way
        parts.extend(rod(a, b, radius, CAPSULE))
        places.append(Place(b + rng.normal(0, 0.09, 3)))
        if depth == 0:
            if rng.random() < 0.3:
                parts.extend(ball(rng.uniform(0.015, 0.04), b))
            return
        for _ in range(int(rng.integers(2, 4))):
            bent = turn(rng.normal(size=3), rng.uniform(0.3, 0.9))[:3, :3] @ way
            grow(b, bent * rng.uniform(0.6, 0.9), 0.7 * radius, depth - 1)

    for _ in range(int(rng.integers(1, 4))):
        root = np.array([*rng.uniform((-0.1, -0.5), (0.3, 0.5)), 0.0])
        hangs = rng.random() < 0.3
        root[2] = 1.1 if hangs else 0.0
        way = np.array([*rng.normal(0, 0.05, 2), (-1 if hangs else 1) * rng.uniform(0.15, 0.35)])
        grow(root, way, rng.uniform(0.012, 0.035), int(rng.integers(3, 5)))
    return Composition(parts, places)


@joined
def spiral(rng: np.random.Generator) -> Iterator[Composition]:
    """Draw helices: springs along any axis that hands are inside of, cones, and stairs that wind around a post."""
    for _ in range(int(rng.integers(1, 4))):
        radius, turns, rise = rng.uniform(0.14, 0.25), rng.uniform(1.5, 3.5), rng.uniform(0.12, 0.28)
        angle = np.linspace(0.0, 2 * np.pi * turns, int(14 * turns))
        r = radius * (1.0 + rng.choice([0.0, 0.4]) * angle / angle[-1])
        z = rise * angle / (2 * np.pi)
        if rng.random() < 0.7:
            one: Parts = bend(np.stack([r * np.cos(angle), r * np.sin(angle), z], 1), rng.uniform(0.004, 0.02))
        else:
            step = box(radius, 0.08, 0.015)
            one = [
                p
                for a, h in zip(angle[::2], z[::2], strict=True)
                for p in place(step, shift(0, 0, h) @ turn("z", a) @ shift(radius / 2 + 0.02, 0, 0))
            ]
            one += rod((0, 0, 0), (0, 0, z[-1]), 0.02)
        inside = [at(0, 0, h, DOWN) for h in rng.uniform(0, z[-1], 2)] + [at(radius + 0.1, 0, z[-1] / 2)]
        pose = shift(rng.uniform(-0.1, 0.1), rng.uniform(-0.45, 0.45), rng.uniform(0.02, 0.3))
        lying = turn("y", float(rng.choice([0.0, 0.0, 0.5, -np.pi / 2]))) @ turn("z", rng.uniform(0, 6))
        yield Composition(one, inside).placed(pose @ lying)


@joined
def net(rng: np.random.Generator) -> Iterator[Composition]:
    """Draw sagging nets and hammocks of thin ropes between posts, torn here and there, level or upright."""
    for _ in range(int(rng.integers(1, 3))):
        width, depth, sag = rng.uniform(0.5, 1.1), rng.uniform(0.3, 0.5), rng.uniform(0.02, 0.3)
        rows, columns, radius = int(rng.integers(3, 6)), int(rng.integers(4, 8)), rng.uniform(0.003, 0.008)
        knots = np.array([
            sagging((x, -width / 2, 0), (x, width / 2, 0), sag * (1 - 0.5 * abs(x) / depth), columns)
            for x in np.linspace(-depth / 2, depth / 2, rows)
        ])  # fmt: skip
        knots[1:-1, 1:-1] += rng.normal(0, 0.015, (rows - 2, columns - 2, 3))
        ropes = [(knots[i, j], knots[i, j + 1]) for i in range(rows) for j in range(columns - 1)]
        ropes += [(knots[i, j], knots[i + 1, j]) for i in range(rows - 1) for j in range(columns)]
        one = [p for a, b in ropes if rng.random() < 0.9 for p in rod(a, b, radius, CAPSULE)]
        corners = knots[[0, 0, -1, -1], [0, -1, 0, -1]]
        upright = rng.random() < 0.4
        if not upright:
            one += [p for corner in corners for p in rod(corner, corner - (0, 0, 0.8), 0.012)]
        holes = (knots[:-1, :-1] + knots[1:, 1:]) / 2
        chosen = holes.reshape(-1, 3)[rng.permutation(holes[..., 0].size)[:4]]
        ways = [*places_at(chosen + (0, 0, 0.05), DOWN), *places_at(chosen - (0, 0, 0.1))]
        ways += places_at(chosen + (0, 0, 0.15), DOWN)
        tilt = turn("y", -np.pi / 2 + rng.normal(0, 0.3)) if upright else turn("y", rng.normal(0, 0.2))
        pose = shift(rng.uniform(-0.1, 0.15), rng.normal(0, 0.15), rng.uniform(0.35, 0.75))
        yield Composition(one, ways).placed(pose @ tilt)


def machine(rng: np.random.Generator) -> Composition:
    """Draw the inside of a machine: gears with teeth on shafts, pistons, and a housing that is open in front."""
    parts, places = list[Part](), list[Place]()
    for _ in range(int(rng.integers(2, 6))):
        radius, thick, teeth = rng.uniform(0.05, 0.18), rng.uniform(0.015, 0.05), int(rng.integers(8, 18))
        gear = rod((-thick / 2, 0, 0), (thick / 2, 0, 0), radius)
        tooth = box(0.03, 0.02, thick)
        gear += place(repeat(tooth, circle(teeth, radius + 0.01)), turn("y", np.pi / 2)) if rng.random() < 0.7 else []
        gear += rod((-0.2, 0, 0), (0.25, 0, 0), rng.uniform(0.01, 0.025))
        pose = shift(*rng.uniform((-0.05, -0.5, 0.15), (0.2, 0.5, 0.75))) @ turn(
            "z", float(rng.choice([0.0, 0.0, np.pi / 2]))
        )
        parts += place(gear, pose)
        places += [Place((pose @ (x, y, 0, 1))[:3]) for x in (-0.12, 0.12) for y in (-0.5 * radius, radius + 0.12)]
    for y in rng.uniform(-0.5, 0.5, int(rng.integers(0, 4))):
        z, long = rng.uniform(0.3, 0.9), rng.uniform(0.05, 0.25)
        parts += [*rod((0.1, y, z), (0.1, y, z + long), 0.05), *rod((0.1, y, z - 0.2), (0.1, y, z), 0.012)]
        parts += box(0.08, 0.1, 0.05, at=(0.1, y, z - 0.2))
    if rng.random() < 0.6:
        sides = ("near", "top") if rng.random() < 0.5 else ("near",)
        parts += moved(hollow_box(0.5, 1.25, 0.95, 0.01, sides), 0.1, 0, 0.5)
    return Composition(parts, places)


def skeleton(rng: np.random.Generator) -> Composition:
    """Draw a bent spine with pairs of curved ribs around a hollow that hands reach into from between the ribs."""
    count, size = int(rng.integers(4, 9)), rng.uniform(0.16, 0.28)
    bends = np.array([[0, -0.45, 0], *rng.normal(0, 0.08, (2, 3)), [0, 0.45, 0]])
    bends[1, 1], bends[2, 1] = -0.15, 0.15
    spine = smooth(bends, count + 1)
    parts, places = bend(spine, rng.uniform(0.015, 0.03)), list[Place]()
    for pose in _frames(spine):
        y = np.cross((0.0, 0.0, 1.0), pose[:3, 2])
        turned = np.eye(4)
        turned[:3, :3] = np.stack([y / np.linalg.norm(y), pose[:3, 2], np.cross(y / np.linalg.norm(y), pose[:3, 2])], 1)
        turned[:3, 3] = pose[:3, 3]
        wide = size * rng.uniform(0.8, 1.15)
        for side in (-1, 1):
            angles = np.linspace(0.0, rng.uniform(2.0, 2.9), 7)
            rib = np.stack([side * wide * np.sin(angles), np.zeros(7), wide * (np.cos(angles) - 1.0)], axis=1)
            parts += place(bend(rib, rng.uniform(0.005, 0.014)), turned)
        places.append(Place((turned @ (0, 0, -wide, 1))[:3]))
        places.append(Place((turned @ (-0.5 * wide, size / 3, -wide, 1))[:3], FORWARD))
    lift = shift(0, 0, 2.2 * size + rng.uniform(0, 0.3))
    return Composition(parts, places).placed(lift @ turn("y", float(rng.choice([0.0, 0.0, -np.pi / 2, np.pi]))))


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


@joined
def wheels(rng: np.random.Generator) -> Iterator[Composition]:
    """Draw discs and wheels with spokes on axles, the hands between the spokes and beside the rims."""
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
        yield one.placed(pose @ turn("z", rng.normal(0, 0.6)) @ turn("x", rng.uniform(0, 2 * np.pi)))


@joined
def truss(rng: np.random.Generator) -> Iterator[Composition]:
    """Draw girders of triangles, three chords each, that stand, span and lean; hands reach between their bars."""
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
        yield Composition(one, inside).placed(pose @ leaning)


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


STRANGERS = by_name(
    pipework, tunnel, tree, spiral, net, machine, skeleton, blades, wheels, truss, honeycomb, bristles,
)  # fmt: skip
"""Grammars of networks, tunnels, trees, helices, nets, machines and frameworks by name."""
