"""Covers of cylinders in closed form, made in a millisecond."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from apex_ompl.collision.cover.proof import PAD, Cover
from apex_ompl.types import Array

LEAVES = 48  # most leaves
GAPS = np.linspace(0.1, 0.8, 29)[:, None, None, None]  # of the ball behind an end, as shares of the radius
IN_RING = np.arange(4, 15)[:, None, None]  # balls around an edge
RING_RADII = np.linspace(0.55, 0.98, 16)[:, None]  # of their centers, as shares of the radius
SUNK = np.linspace(0.5, 1.5, 6)  # of their centers below the end, as shares of the height of the ring


class _End(NamedTuple):
    """Balls of one end, with the radius of the cylinder as the unit of length.

    Attributes:
        gap: Gap of the ball behind the end.
        in_ring: Number of balls around the edge.
        ring: Radius of the ring of their centers.
        sunk: Distance of these from the end.
        ball: Their radius.
    """

    gap: float
    in_ring: int
    ring: float
    sunk: float
    ball: float


def cylinder_cover(radius: float, half_length: float) -> Cover:
    """Return a cover of a cylinder along z that is at least as long as wide.

    With the radius as the unit of length, a ball of radius 1 + g at depth 1 behind each end sticks out of it by the gap
    g. It contains the disc of radius p = sqrt((1 + g)^2 - 1) at the end, and the whole cross-section at depths from
    1 - p to 1 + p. The ring that is left there, from p to 1 and as deep as 1 - p, is covered by balls around equal
    sectors of it, and the middle by balls around equal lengths. The numbers are those of the least gap.

    Args:
        radius: Radius [m].
        half_length: Half of the length, at least the radius [m].
    """
    end, middle = _choose(half_length / radius)
    reach = math.sqrt((1.0 + end.gap) ** 2 - 1.0)
    angles = 2.0 * np.pi * np.arange(end.in_ring) / end.in_ring
    rim = np.stack([end.ring * np.cos(angles), end.ring * np.sin(angles), np.full(end.in_ring, -end.sunk)], axis=1)
    top = np.concatenate([[[0.0, 0.0, -1.0]], rim]) + [0.0, 0.0, half_length / radius]
    top_radii = np.array([1.0 + end.gap, *[end.ball] * end.in_ring])
    inner = max(0.0, half_length / radius - 1.0 - reach)  # half the length of the middle
    places = inner * ((2.0 * np.arange(middle) + 1.0) / max(middle, 1) - 1.0)
    between = np.stack([np.zeros(middle), np.zeros(middle), places], axis=1)
    between_radii = np.full(middle, math.hypot(1.0, inner / max(middle, 1)))
    parts = [(top, top_radii), (top * [1.0, 1.0, -1.0], top_radii), *([(between, between_radii)] if middle else [])]
    low = inner if middle else 0.0  # the parts of the cylinder that the groups answer for
    spans = [(low, half_length / radius), (-half_length / radius, -low), (-inner, inner)][: len(parts)]
    centers, radii = [np.zeros(3)], [math.hypot(1.0, half_length / radius)]
    for lower, upper in spans:
        centers.append(np.array([0.0, 0.0, (lower + upper) / 2.0]))
        radii.append(math.hypot(1.0, (upper - lower) / 2.0))
    sizes = [len(part) for _, part in parts]
    firsts = 1 + len(parts) + np.cumsum([0, *sizes])[:-1]
    return Cover(
        radius * np.concatenate([np.array(centers), *(part for part, _ in parts)]),
        radius * np.concatenate([radii, *(part for _, part in parts)]) + PAD,
        np.array([1, *firsts, *[0] * sum(sizes)], np.int64),
        np.array([len(parts), *sizes, *[0] * sum(sizes)], np.int64),
    )


def _choose(half_length: float) -> tuple[_End, int]:
    """Return the balls of an end, and the number of balls in the middle, for a cylinder of radius 1."""
    reach = np.sqrt((1.0 + GAPS) ** 2 - 1.0)
    height = 1.0 - reach
    wide = np.maximum(reach, 0.0)
    cosine = np.cos(np.pi / IN_RING)
    corner = np.maximum(
        1.0 + RING_RADII**2 - 2.0 * RING_RADII * cosine, wide**2 + RING_RADII**2 - 2.0 * wide * RING_RADII * cosine
    )
    across: Array = np.maximum(corner, np.maximum((1.0 - RING_RADII) ** 2, (RING_RADII - wide) ** 2))
    deep = SUNK * height
    ball = np.sqrt(across + np.maximum(deep, height - deep) ** 2)
    ring_gap = np.maximum(ball - deep, RING_RADII + ball - 1.0)
    most = np.maximum(LEAVES - 2 * (IN_RING + 1), 1)
    inner = np.maximum(half_length - 1.0 - reach, 0.0)
    gap = np.maximum(np.maximum(ring_gap, GAPS), np.hypot(1.0, inner / most) - 1.0)
    gap = np.where(height > 0.0, gap, np.inf)
    at = np.unravel_index(int(np.argmin(gap)), gap.shape)
    chosen = [float(np.broadcast_to(x, gap.shape)[at]) for x in (GAPS, IN_RING, RING_RADII, deep, ball, inner, gap)]
    middle = math.ceil(chosen[5] / math.sqrt((1.0 + chosen[6]) ** 2 - 1.0) - 1e-9)
    return _End(chosen[0], int(chosen[1]), *chosen[2:5]), middle
