"""Sphere covers: trees of balls that provably contain a solid, made, measured, written and read.

Two solids are apart where their covers are, which is far cheaper to check than their meshes. :func:`make_cover`
searches for a cover (``search``) and proves it (``proof``); :func:`unproved` repeats the proof.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import coal
import numpy as np

from apex_ompl.collision.cover.proof import PAD, Cover, distances, grow_to_cover, uncovered_boxes
from apex_ompl.collision.cover.search import search
from apex_ompl.collision.cover.solids import RoundBody, solid_of
from apex_ompl.collision.shapes import is_shell, is_surface
from apex_ompl.errors import FileFormatError, ParameterError
from apex_ompl.scene.meshes import triangles
from apex_ompl.types import Array
from apex_ompl.util.cache import weakly_cached
from apex_ompl.util.files import write_atomically
from apex_ompl.util.schema import check_version, read_json

__all__ = [
    "GAPS",
    "Cover",
    "make_cover",
    "quality",
    "read_covers",
    "read_efforts",
    "shape_key",
    "unproved",
    "write_covers",
]

SCHEMA = "apex-ompl/spheres/1"
COLUMNS = ["x", "y", "z", "radius", "first child", "children"]
LARGEST = 1e6  # numbers of a file beyond are a fault [m]
GAPS = (0.02, 0.007, 0.0025)  # how far the balls of each level may protrude from the solid [m]
MOST = (64, 96, 256)  # most leaves of a quick cover, of other covers, and of a mesh that is not convex
FULL = 3  # the most thorough effort of a search
QUICK_DEPTHS = 20_000  # grid points of a quick cover at which the depth of a mesh that is not convex is sampled
QUICK = 4.0  # size of the boxes in which a quick cover is grown, relative to those of its proof


@weakly_cached
def shape_key(geometry: coal.CollisionGeometry) -> str:
    """Return the identifier of a shape, 16 hexadecimal digits of a hash of its kind and sizes or of its triangles.

    Raises:
        ParameterError: The kind of geometry has no cover.
    """
    kind = geometry.getNodeType()
    names = {coal.GEOM_BOX: "box", coal.GEOM_SPHERE: "sphere", coal.GEOM_CYLINDER: "cylinder"}
    names |= {coal.GEOM_CAPSULE: "capsule", coal.GEOM_CONVEX: "convex"}
    digest = hashlib.sha256()
    if is_shell(geometry):
        vertices, faces = triangles(geometry)
        digest.update(b"surface" if is_surface(geometry) else b"mesh")
        digest.update((np.round(vertices, 9) + 0.0).tobytes() + faces.astype(np.int64).tobytes())
    elif kind not in names:
        raise ParameterError("geometry", kind, "a box, sphere, cylinder, capsule, convex body or mesh")
    else:
        sizes: list[Any] = [getattr(geometry, name) for name in ("radius", "halfLength") if hasattr(geometry, name)]
        if kind == coal.GEOM_BOX:
            sizes = [geometry.halfSide]
        if kind == coal.GEOM_CONVEX:
            sizes = [np.round(np.array(geometry.points()), 9) + 0.0]
        digest.update(names[kind].encode() + b"".join(np.asarray(s, float).tobytes() for s in sizes))
    return digest.hexdigest()[:16]


def make_cover(
    geometry: coal.CollisionGeometry,
    gaps: Sequence[float] = GAPS,
    *,
    most: int | None = None,
    effort: int | None = None,
) -> Cover:
    """Return a proved cover of a geometry.

    Args:
        geometry: Box, sphere, cylinder, capsule, convex body or mesh.
        gaps: How far the balls of each level below the root may protrude from the solid [m], descending. The gap is
            enlarged where it would need more than ``most`` leaves.
        most: Largest number of leaves, by default 64 with effort 1, 96 with more, 256 for a mesh that is not convex.
        effort: Effort of the search, 1 (tens of milliseconds) to 3 (seconds); by default 1 for simple shapes and 3
            for meshes.

    Raises:
        ParameterError: The gaps are not positive and descending, or the kind of geometry has no cover.
    """
    if not gaps or min(gaps) <= 0.0 or sorted(gaps, reverse=True) != list(gaps):
        raise ParameterError("gaps", gaps, "positive numbers, descending")
    solid = solid_of(geometry)
    if effort is None:
        effort = 3 if is_shell(geometry) else 1
    if most is None:
        most = MOST[2] if len(solid.parts) > 1 else MOST[min(effort, 2) - 1]
    part = solid.parts[0]
    if isinstance(part, RoundBody) and part.capped:
        return _capsule(part, gaps[-1], most)
    if effort == 1:
        solid = replace(solid, depths=QUICK_DEPTHS)
    cover = search(solid, gaps, most, effort)
    made = _rounded(grow_to_cover(solid, cover, QUICK if effort == 1 else 1.0))
    if len(uncovered_boxes(solid, made)):
        raise AssertionError("a cover that was grown until its proof succeeded is not proved")
    return made


def unproved(geometry: coal.CollisionGeometry, cover: Cover) -> Array:
    """Return the centers of boxes that are not proved to be covered, shape (N, 3) [m]; a proved cover has none."""
    return uncovered_boxes(solid_of(geometry), cover)


def quality(
    geometry: coal.CollisionGeometry, cover: Cover, rng: np.random.Generator, samples: int = 20_000
) -> tuple[float, float, float]:
    """Return the tightness of the leaves: their volume relative to the solid, mean and largest gap [m].

    The gaps are distances to the solid from ``samples`` / 10 points on the surface of the union of the leaves. Each
    volume is a Monte Carlo estimate from ``samples`` points. The volume of a mesh that is not convex is that of the
    convex parts that represent it; its gaps are distances to its triangles.
    """
    solid = solid_of(geometry)
    centers, radii = cover.centers[cover.leaves], cover.radii[cover.leaves]
    low, high = (centers - radii[:, None]).min(axis=0), (centers + radii[:, None]).max(axis=0)
    points = rng.uniform(low, high, (samples, 3))
    in_leaf = (distances(points, centers) <= radii).any(axis=1)
    inner = rng.uniform(solid.low, solid.high, (samples, 3))
    volume = float(solid.contains(inner).mean() * np.prod(solid.high - solid.low))
    ratio = float(in_leaf.mean() * np.prod(high - low)) / max(volume, 1e-12)
    chosen = rng.choice(len(radii), samples, p=radii**2 / (radii**2).sum())
    directions = rng.normal(size=(samples, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    points = centers[chosen] + radii[chosen, None] * directions
    gaps_to = distances(points, centers) - radii
    gaps_to[np.arange(samples), chosen] = np.inf
    points = points[(gaps_to > 0.0).all(axis=1)][: max(samples // 10, 1)]
    dot, request = coal.Sphere(1e-9), coal.DistanceRequest()
    gaps = []
    for point in points:
        result = coal.DistanceResult()
        place = coal.Transform3s(np.eye(3), point)
        gaps.append(max(0.0, coal.distance(geometry, coal.Transform3s.Identity(), dot, place, request, result)))
    return ratio, float(np.mean(gaps)), float(np.max(gaps))


def write_covers(path: Path | str, covers: Mapping[str, Cover], efforts: Mapping[str, int] | None = None) -> None:
    """Write covers by the keys of their shapes, rounded outward to micrometers so that they stay proved.

    Args:
        path: The file.
        covers: Shape key -> cover.
        efforts: Shape key -> effort of the search where it was less than the full one.

    Raises:
        MissingFileError: The file cannot be written.
    """
    rows = []
    for key in sorted(covers):
        cover = _rounded(covers[key])
        balls = [
            [*(round(float(x), 6) + 0.0 for x in c), round(float(r), 6), int(f), int(n)]
            for c, r, f, n in zip(cover.centers, cover.radii, cover.first, cover.count, strict=True)
        ]
        rows.append(f"  {json.dumps(key)}: [\n" + ",\n".join(f"   {json.dumps(ball)}" for ball in balls) + "\n  ]")
    text = f'{{\n "schema": {json.dumps(SCHEMA)},\n "columns": {json.dumps(COLUMNS)},\n'
    less = {key: efforts[key] for key in sorted(covers) if efforts and efforts.get(key, FULL) < FULL}
    text += f' "efforts": {json.dumps(less)},\n' if less else ""
    text += ' "covers": {\n'
    write_atomically(Path(path), (text + ",\n".join(rows) + "\n }\n}\n").encode())


def read_covers(path: Path | str) -> dict[str, Cover]:
    """Read a file of covers: shape key -> cover.

    Raises:
        MissingFileError: The file cannot be read.
        FileFormatError: It does not hold covers.
    """
    name, data = str(path), _covers_in(path)
    return {key: _cover_of(rows, name, f"covers.{key}") for key, rows in data["covers"].items()}


def read_efforts(path: Path | str) -> dict[str, int]:
    """Read the efforts by which the covers of a file were made: shape key -> 1, 2 or 3.

    Raises:
        MissingFileError: The file cannot be read.
        FileFormatError: It does not hold covers.
    """
    data = _covers_in(path)
    less = data.get("efforts", {})
    if not isinstance(less, dict) or any(type(effort) is not int for effort in less.values()):
        raise FileFormatError(str(path), "efforts", less, "expected a mapping of shape keys to 1, 2 or 3")
    return {key: less.get(key, FULL) for key in data["covers"]}


def _covers_in(path: Path | str) -> dict[str, Any]:
    """Return the content of a file of covers, without a look at the covers."""
    name = str(path)
    data = read_json(Path(path), "sphere covers")
    check_version(data, SCHEMA, path)
    if data.get("columns") != COLUMNS:
        raise FileFormatError(name, "columns", data.get("columns"), f"expected {COLUMNS}")
    if not isinstance(data.get("covers"), dict):
        raise FileFormatError(name, "covers", data.get("covers"), "expected a mapping of shape keys to balls")
    return data


def _is_number(value: Any) -> bool:
    return type(value) in (int, float) and abs(value) < LARGEST


def _cover_of(rows: Any, file: str, field: str) -> Cover:
    """Return the cover in the rows of a file.

    Raises:
        FileFormatError: The rows do not describe a tree of balls.
    """
    if not isinstance(rows, list) or not rows:
        raise FileFormatError(file, field, rows, "expected a list of balls")
    following = 1
    for k, row in enumerate(rows):
        where = f"{field}.{k}"
        numbers = isinstance(row, list) and len(row) == len(COLUMNS) and all(_is_number(x) for x in row)
        if not numbers:
            raise FileFormatError(file, where, row, f"expected the numbers {', '.join(COLUMNS)}")
        if row[3] <= 0.0:
            raise FileFormatError(file, where, row[3], "expected a positive radius")
        first, count = row[4], row[5]
        if type(first) is not int or type(count) is not int or count < 0:
            raise FileFormatError(file, where, row[4:], "expected the first child and the number of children")
        if count and (first != following or first <= k or first + count > len(rows)):
            raise FileFormatError(file, where, row[4:], "expected children that follow those of the balls before")
        following += count
    if following != len(rows):
        raise FileFormatError(file, field, len(rows), f"expected {following} balls below one root")
    table = np.array([row[:4] for row in rows], float)
    links = np.array([row[4:] for row in rows], np.int64)
    return Cover(table[:, :3].copy(), table[:, 3].copy(), links[:, 0].copy(), links[:, 1].copy())


def _capsule(part: RoundBody, gap: float, most: int) -> Cover:
    """Return balls of equal size along the axis of a capsule of radius r and half length h.

    A ball that protrudes by e has the radius r + e, and the center of the last one is e before the end of the axis.
    A ball contains the cylinder up to s = sqrt(2 r e + e^2) on either side of its center, so n balls cover the
    capsule when e + (n - 1) s = h, which is solved for e by bisection.
    """
    gap = min(gap, max(0.5 * part.radius, 1e-3))
    number = 1
    while True:
        low, high = 0.0, part.half_length
        for _ in range(60):
            e = 0.5 * (low + high)
            reach = e + (number - 1) * np.sqrt(2 * part.radius * e + e * e)
            low, high = (low, e) if reach >= part.half_length else (e, high)
        if high <= gap or number >= most:
            break
        number += 1
    step = np.sqrt(2 * part.radius * high + high * high)
    z = (2.0 * np.arange(number) - (number - 1)) * step
    centers = np.stack([0.0 * z, 0.0 * z, z], axis=1)
    radii = np.full(number, part.radius + high)
    if number > 1:
        centers = np.concatenate([np.zeros((1, 3)), centers])
        radii = np.concatenate([[part.half_length + part.radius], radii])
    first, count = np.zeros(len(radii), np.int64), np.zeros(len(radii), np.int64)
    if number > 1:
        first[0], count[0] = 1, number
    return _rounded(Cover(centers, radii + 4 * PAD, first, count))


def _rounded(cover: Cover) -> Cover:
    """Return a cover rounded to micrometers whose balls contain the given ones."""
    centers = np.round(cover.centers, 6)
    shift = np.linalg.norm(centers - cover.centers, axis=1)
    radii = np.round(np.ceil((cover.radii + shift) * 1e6 - 1e-4) / 1e6, 6)
    return Cover(centers, radii, cover.first, cover.count)
