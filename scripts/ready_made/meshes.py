"""Meshes of held objects as OBJ text: a cup, and a block with a hole."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


def cup_obj(radius: float = 0.04, wall: float = 0.004, height: float = 0.13, sides: int = 24) -> str:
    """Return a cup as OBJ text: a closed surface around z, opening towards +z, centered on the origin."""
    low, high, inner = -height / 2, height / 2, radius - wall
    profile = [(0.0, low), (radius, low), (radius, high), (inner, high), (inner, low + wall), (0.0, low + wall)]
    return _lathe(profile, sides)


def _lathe(profile: Sequence[tuple[float, float]], sides: int) -> str:
    """Return the solid of revolution of a profile (radius, z) that starts and ends on the axis, as OBJ text."""
    lines = [f"v 0 0 {profile[0][1]:.6g}", f"v 0 0 {profile[-1][1]:.6g}"]
    rings = profile[1:-1]
    for radius, z in rings:
        for k in range(sides):
            turn = 2 * np.pi * k / sides
            lines.append(f"v {radius * np.cos(turn):.6g} {radius * np.sin(turn):.6g} {z:.6g}")

    def at(ring: int, k: int) -> int:
        return 3 + ring * sides + k % sides

    for k in range(sides):
        lines.append(f"f 1 {at(0, k + 1)} {at(0, k)}")
        lines.append(f"f 2 {at(len(rings) - 1, k)} {at(len(rings) - 1, k + 1)}")
        for ring in range(len(rings) - 1):
            a, b, c, d = at(ring, k), at(ring, k + 1), at(ring + 1, k + 1), at(ring + 1, k)
            lines += [f"f {a} {b} {c}", f"f {a} {c} {d}"]
    return "\n".join(lines) + "\n"


def block_obj(
    edge: float = 0.08, hole: float = 0.042, depth: float = 0.07, floor: float = 0.01,
    chamfer: tuple[float, float] = (0.0, 0.0),
) -> str:  # fmt: skip
    """Return a block with a square blind hole as OBJ text, opening towards +z, centered on the origin.

    Args:
        edge: Edge of its square cross-section [m].
        hole: Edge of that of the hole [m].
        depth: Height of the block [m].
        floor: Thickness below the hole [m].
        chamfer: Width and depth of the chamfer of the hole [m].
    """
    low, high = -depth / 2, depth / 2
    corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    levels = [(edge / 2, low), (edge / 2, high), (hole / 2, high - chamfer[1]), (hole / 2, low + floor)]
    if chamfer[0] > 0.0:
        levels.insert(2, (hole / 2 + chamfer[0], high))
    lines = [f"v {x * half:.6g} {y * half:.6g} {z:.6g}" for half, z in levels for x, y in corners]
    last = 4 * (len(levels) - 1)
    lines += ["f 1 3 2", "f 1 4 3", f"f {last + 1} {last + 2} {last + 3}", f"f {last + 1} {last + 3} {last + 4}"]
    for level in range(len(levels) - 1):
        for k in range(4):
            a, b = 1 + 4 * level + k, 1 + 4 * level + (k + 1) % 4
            lines += [f"f {a} {b} {b + 4}", f"f {a} {b + 4} {a + 4}"]
    return "\n".join(lines) + "\n"
