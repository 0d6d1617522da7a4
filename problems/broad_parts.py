"""Parts of scenes: an algebra on lists of them, compounds of them, and compositions with places for hands.

A part is a primitive with a pose. Lengths are in meters; poses are homogeneous transforms, shape (4, 4). Every function
returns new parts and leaves its arguments as they are. Compounds bound spaces or follow curves: shells, tubes, windows,
grilles, bent bars and sheets.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import wraps
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from apex_ompl.goals.state_sampling import Direction
from apex_ompl.kernel import arrays
from apex_ompl.kernel.scene_builder import boxes_around
from apex_ompl.types import Array, Flags

BOX, SPHERE, CYLINDER, CAPSULE = range(4)
KINDS = np.array([arrays.BOX, arrays.SPHERE, arrays.CYLINDER, arrays.CAPSULE])  # the kernel's
THINNEST = 0.002  # least edge and radius [m]
SIDES = ("near", "far", "right", "left", "bottom", "top")  # -x, +x, -y, +y, -z, +z
STANDING, FLOATING = "standing", "floating"


class Part(NamedTuple):
    """A solid primitive.

    Attributes:
        kind: BOX, SPHERE, CYLINDER or CAPSULE.
        size: Edges of a box; radius of a ball; radius and length along z of the others, without caps [m].
        pose: Homogeneous transform, shape (4, 4) [m].
    """

    kind: int
    size: tuple[float, float, float]
    pose: Array


Parts = list[Part]
Point = Sequence[float] | Array


def shift(x: float, y: float, z: float) -> Array:
    """Return the translation by a vector, shape (4, 4)."""
    pose = np.eye(4)
    pose[:3, 3] = x, y, z
    return pose


def turn(axis: str | Point, angle: float) -> Array:
    """Return the rotation about an axis through the origin, shape (4, 4).

    Args:
        axis: ``x``, ``y``, ``z``, or a direction.
        angle: [rad].
    """
    direction = np.eye(3)["xyz".index(axis)] if isinstance(axis, str) else np.asarray(axis, float)
    pose = np.eye(4)
    pose[:3, :3] = pin.exp3(angle / np.linalg.norm(direction) * direction)
    return pose


def along(a: Point, b: Point) -> tuple[Array, float]:
    """Return a pose in the middle of two points whose z points from one to the other, and their distance [m]."""
    a, b = np.asarray(a, float), np.asarray(b, float)
    length = float(np.linalg.norm(b - a))
    z = (b - a) / max(length, 1e-9)
    helper = np.eye(3)[2 if abs(z[2]) < 0.9 else 0]
    x = np.cross(helper, z)
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
    pose[:3, 3] = (a + b) / 2.0
    return pose, length


def random_turn(rng: np.random.Generator) -> Array:
    """Return a rotation drawn evenly from all, shape (4, 4)."""
    pose, q = np.eye(4), rng.normal(size=4)
    pose[:3, :3] = pin.Quaternion(q / np.linalg.norm(q)).toRotationMatrix()
    return pose


def box(x: float, y: float, z: float, at: Point = (0.0, 0.0, 0.0)) -> Parts:
    """Return an upright box by its edges and its center [m]."""
    return [Part(BOX, (max(x, THINNEST), max(y, THINNEST), max(z, THINNEST)), shift(*at))]


def ball(radius: float, at: Point = (0.0, 0.0, 0.0)) -> Parts:
    """Return a ball by its radius and center [m]."""
    return [Part(SPHERE, (max(radius, THINNEST), 0.0, 0.0), shift(*at))]


def rod(a: Point, b: Point, radius: float, kind: int = CYLINDER) -> Parts:
    """Return a cylinder, or a capsule, between two points, by its radius [m]."""
    pose, length = along(a, b)
    return [Part(kind, (max(radius, THINNEST), max(length, THINNEST), 0.0), pose)]


def place(parts: Iterable[Part], pose: Array) -> Parts:
    """Return parts moved by a pose, shape (4, 4)."""
    return [Part(part.kind, part.size, pose @ part.pose) for part in parts]


def moved(parts: Iterable[Part], x: float, y: float, z: float) -> Parts:
    """Return parts moved by a vector [m]."""
    return place(parts, shift(x, y, z))


def repeat(parts: Sequence[Part], poses: Iterable[Array]) -> Parts:
    """Return a copy of the parts at each of some poses."""
    return [part for pose in poses for part in place(parts, pose)]


def line(count: int, step: Point) -> list[Array]:
    """Return poses in a row about the origin, by the vector from one to the next [m]."""
    return [shift(*((k - (count - 1) / 2.0) * np.asarray(step, float))) for k in range(count)]


def grid(counts: tuple[int, int, int], steps: Point) -> list[Array]:
    """Return poses on a grid about the origin, by the numbers and the distances along each axis [m]."""
    rows = np.stack(np.meshgrid(*(np.arange(n) - (n - 1) / 2.0 for n in counts), indexing="ij"), -1).reshape(-1, 3)
    return [shift(*(row * np.asarray(steps, float))) for row in rows]


def circle(count: int, radius: float, span: float = 2.0 * np.pi, first: float = 0.0) -> list[Array]:
    """Return poses on an arc about z whose x points outwards.

    Args:
        count: Number of poses.
        radius: [m].
        span: Angle of the arc; a full circle has no pose twice [rad].
        first: Angle of the first pose [rad].
    """
    steps = count if span >= 2.0 * np.pi - 1e-9 else max(count - 1, 1)
    return [turn("z", first + span * k / steps) @ shift(radius, 0.0, 0.0) for k in range(count)]


def walk(rng: np.random.Generator, count: int, step: float, spread: float = 0.7) -> list[Array]:
    """Return the poses of a random walk from the origin, by its step [m] and the spread of its turns [rad]."""
    pose, found = random_turn(rng), []
    for _ in range(count):
        found.append(pose)
        pose = pose @ turn(rng.normal(size=3), rng.normal(0.0, spread)) @ shift(0.0, 0.0, step)
    return found


def mirror(parts: Iterable[Part], axis: int = 1) -> Parts:
    """Return parts mirrored at the plane through the origin across axis 0, 1 or 2; primitives are symmetric."""
    signs = np.ones(4)
    signs[axis] = -1.0
    flip = np.array([-1.0, 1.0, 1.0, 1.0])  # each primitive is its own mirror image along its x
    return [Part(part.kind, part.size, signs[:, None] * part.pose * flip) for part in parts]


def scale(parts: Iterable[Part], factor: float) -> Parts:
    """Return parts larger by a factor about the origin, none thinner than ``THINNEST``."""
    found = []
    for kind, size, before in parts:
        pose = before.copy()
        pose[:3, 3] *= factor
        x, y, z = (max(v * factor, THINNEST) if v else 0.0 for v in size)
        found.append(Part(kind, (x, y, z), pose))
    return found


def kernel_columns(parts: Sequence[Part], swelling: float = 0.0) -> tuple[NDArray[np.int64], Array, Array, Array]:
    """Return kind, rotation, offset and size of parts as the kernel has them, a row each.

    Args:
        parts: The parts.
        swelling: By how much every part is thicker on each side [m].
    """
    poses = np.array([part.pose for part in parts]).reshape(-1, 4, 4)
    shape, rows = np.array([part.kind for part in parts], int), np.array([p.size for p in parts]).reshape(-1, 3)
    bars, boxes = np.isin(shape, (CYLINDER, CAPSULE)), shape == BOX
    size = np.zeros((len(parts), 3))
    size[:, 0] = rows[:, 0] + swelling
    size[bars, 1] = rows[bars, 1] / 2.0 + swelling * (shape[bars] == CYLINDER)
    size[boxes] = rows[boxes] / 2.0 + swelling
    return KINDS[shape], poses[:, :3, :3].copy(), poses[:, :3, 3].copy(), size


def extents(parts: Sequence[Part]) -> Array:
    """Return the axis-aligned box around each part, shape (n, 2, 3) [m]."""
    return boxes_around(*kernel_columns(parts)) if parts else np.empty((0, 2, 3))


def bounds(parts: Sequence[Part]) -> Array:
    """Return the axis-aligned box around all parts together, shape (2, 3) [m]."""
    boxes = extents(parts)
    return np.stack([boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)])


def nest(parts: Sequence[Part], low: Point, high: Point) -> Parts:
    """Return parts moved and scaled as a whole to fit into a box, by its corners [m]."""
    low, high, own = np.asarray(low, float), np.asarray(high, float), bounds(parts)
    factor = float(((high - low) / np.maximum(own[1] - own[0], 1e-6)).min())
    return place(scale(parts, factor), shift(*((low + high) / 2.0 - factor * own.mean(axis=0))))


def without(parts: Sequence[Part], low: Point, high: Point) -> Parts:
    """Return those parts whose axis-aligned boxes do not meet a box, by its corners [m]."""
    boxes = extents(parts)
    meets = ((boxes[:, 0] < np.asarray(high)) & (boxes[:, 1] > np.asarray(low))).all(axis=1)
    return kept(parts, np.asarray(~meets))


def kept(parts: Sequence[Part], which: Flags) -> Parts:
    """Return those parts of which ``which``, shape (n,), is true."""
    return [part for part, wanted in zip(parts, which, strict=True) if wanted]


def jitter(rng: np.random.Generator, parts: Iterable[Part], position: float, angle: float) -> Parts:
    """Return parts each moved by N(0, position^2) [m] and turned about its middle by N(0, angle^2) [rad]."""
    found = []
    for kind, size, before in parts:
        pose = before @ turn(rng.normal(size=3), rng.normal(0.0, angle))
        pose[:3, 3] += rng.normal(0.0, position, 3)
        found.append(Part(kind, size, pose))
    return found


def hollow_box(x: float, y: float, z: float, thick: float, open_sides: Sequence[str] = ("near",)) -> Parts:
    """Return the walls of a box about the origin, by its inner edges and their thickness [m], without some sides."""
    inner, found = np.array([x, y, z]), list[Part]()
    for k, side in enumerate(SIDES):
        if side in open_sides:
            continue
        axis, sign = k // 2, 2 * (k % 2) - 1
        edges, center = inner + 2 * thick, np.zeros(3)
        edges[axis] = thick
        center[axis] = sign * (inner[axis] + thick) / 2.0
        x, y, z = edges
        found += box(x, y, z, at=center)
    return found


def window(width: float, height: float, thick: float, low: Point, high: Point) -> Parts:
    """Return a panel across x about the origin with a window: up to four boxes around it.

    Args:
        width: Of the panel along y [m].
        height: Of the panel along z [m].
        thick: Of the panel along x [m].
        low: Corner (y, z) of the window [m].
        high: The opposite corner [m].
    """
    (y0, z0), (y1, z1), found = low, high, list[Part]()
    columns = ((-width / 2, y0, -height / 2, height / 2), (y1, width / 2, -height / 2, height / 2))
    beams = ((y0, y1, -height / 2, z0), (y0, y1, z1, height / 2))
    for a, b, c, d in (*columns, *beams):
        if b - a > 1e-3 and d - c > 1e-3:
            found += box(thick, b - a, d - c, at=(0.0, (a + b) / 2, (c + d) / 2))
    return found


def frame(width: float, height: float, bar: float) -> Parts:
    """Return a rectangular frame of bars across x about the origin, by its inner width and height [m]."""
    return window(width + 2 * bar, height + 2 * bar, bar, (-width / 2, -height / 2), (width / 2, height / 2))


def tube(radius: float, length: float, thick: float, staves: int = 10, span: float = 2.0 * np.pi) -> Parts:
    """Return a tube along z of staves, or a part of one, by its inner radius [m]."""
    each = span / staves
    stave = box(thick, 2.0 * (radius + thick) * float(np.tan(each / 2.0)), length)
    return repeat(stave, [turn("z", (k + 0.5) * each) @ shift(radius + thick / 2.0, 0, 0) for k in range(staves)])


def grille(width: float, height: float, columns: int, rows: int, radius: float) -> Parts:
    """Return a grille across x about the origin: upright and level bars [m]."""
    upright = rod((0, 0, -height / 2), (0, 0, height / 2), radius)
    level = rod((0, -width / 2, 0), (0, width / 2, 0), radius)
    return [
        *repeat(upright, line(columns, (0, width / max(columns - 1, 1), 0))),
        *repeat(level, line(rows, (0, 0, height / max(rows - 1, 1)))),
    ]


def lattice(counts: tuple[int, int, int], step: float, radius: float) -> Parts:
    """Return the edges of a grid of cubes about the origin, by the number of nodes along each axis, as bars [m]."""
    found = list[Part]()
    for axis in range(3):
        u, v = (k for k in range(3) if k != axis)
        for j in range(counts[u]):
            for k in range(counts[v]):
                end = np.zeros(3)
                end[axis], end[u], end[v] = counts[axis] - 1, 2 * j - counts[u] + 1, 2 * k - counts[v] + 1
                start = end.copy()
                start[axis] *= -1.0
                found += rod(start * step / 2, end * step / 2, radius)
    return found


def bend(points: Array, radius: float, kind: int = CAPSULE) -> Parts:
    """Return a bar or a pipe through points, shape (n, 3) [m]: a chain of capsules or cylinders."""
    return [part for a, b in zip(points[:-1], points[1:], strict=True) for part in rod(a, b, radius, kind)]


def bent_sheet(points: Array, width: float, thick: float) -> Parts:
    """Return a sheet along points of the plane y = 0, shape (n, 3) [m], as wide along y: a chain of boxes."""
    found = list[Part]()
    for a, b in zip(points[:-1], points[1:], strict=True):
        rise, run = float(b[2] - a[2]), float(b[0] - a[0])
        pose = turn("y", -np.arctan2(rise, run))
        pose[:3, 3] = (a + b) / 2.0
        found += place(box(float(np.hypot(rise, run)) + thick, width, thick), pose)
    return found


def arc(radius: float, first: float, last: float, count: int) -> Array:
    """Return points on a circle in the plane y = 0, angles from x towards z [rad], shape (count, 3) [m]."""
    angles = np.linspace(first, last, count)
    return np.stack([radius * np.cos(angles), np.zeros(count), radius * np.sin(angles)], axis=1)


def smooth(points: Point | Array, count: int) -> Array:
    """Return points on a Catmull-Rom spline through points, shape (n, 3), at even parameters, shape (count, 3)."""
    through = np.asarray(points, float)
    p = np.concatenate([2 * through[:1] - through[1:2], through, 2 * through[-1:] - through[-2:-1]])
    at = np.linspace(0.0, len(through) - 1.0, count)
    k = np.minimum(at.astype(int), len(through) - 2)
    t = (at - k)[:, None]
    a, b, c, d = (p[k + j] for j in range(4))
    found: Array = b + 0.5 * t * (c - a + t * (2 * a - 5 * b + 4 * c - d + t * (3 * (b - c) + d - a)))
    return found


def ring(radius: float, thick: float, count: int = 12, span: float = 2.0 * np.pi) -> Parts:
    """Return a ring, or a part of one, across x about the origin: a chain of capsules of radius ``thick`` [m]."""
    angles = np.linspace(0.0, span, count + 1)
    points = np.stack([np.zeros(count + 1), radius * np.cos(angles), radius * np.sin(angles)], axis=1)
    return bend(points, thick)


def table(x: float, y: float, height: float, thick: float, leg: float) -> Parts:
    """Return a top on four legs that stand on z = 0, by the edges of the top and its height [m]."""
    legs = [(sx * (x - leg) / 2, sy * (y - leg) / 2) for sx in (-1, 1) for sy in (-1, 1)]
    posts = [part for u, v in legs for part in box(leg, leg, height - thick, at=(u, v, (height - thick) / 2))]
    return [*box(x, y, thick, at=(0, 0, height - thick / 2)), *posts]


def stack(rng: np.random.Generator, count: int, size: float) -> Parts:
    """Return boxes of random edges on top of each other on z = 0 [m]."""
    found, z = list[Part](), 0.0
    for _ in range(count):
        x, y, height = rng.uniform(0.3 * size, size, 3)
        found += place(moved(box(x, y, height), 0, 0, z + height / 2), turn("z", rng.uniform(0, np.pi)))
        z += height
    return found


def fan(count: int, radius: float, width: float, thick: float, tilt: float) -> Parts:
    """Return blades around z, by their length, width and thickness [m] and the angle that they are tilted [rad]."""
    blade = place(box(radius, width, thick), turn("x", tilt))
    return repeat(blade, circle(count, radius / 2.0))


def between(a: Point, b: Point, count: int) -> Array:
    """Return points evenly from one to another, shape (count, 3)."""
    return np.linspace(np.asarray(a, float), np.asarray(b, float), count)


def sagging(a: Point, b: Point, sag: float, count: int) -> Array:
    """Return points on a parabola that hangs between two points by ``sag`` [m] in its middle, shape (count, 3)."""
    found = between(a, b, count)
    u = np.linspace(0.0, 1.0, count)
    found[:, 2] -= 4.0 * sag * u * (1.0 - u)
    return found


class Place(NamedTuple):
    """A place that a hand may be sent to: inside, beyond or between parts.

    Attributes:
        point: Where the grasp point is to be, shape (3,) [m].
        fingers: Direction that the fingers point along; None for any.
    """

    point: Array
    fingers: Direction | None = None


@dataclass(frozen=True)
class Composition:
    """Parts and places in a frame of their own: the front faces -x, what stands stands on z = 0.

    Attributes:
        parts: The parts.
        places: Interesting places.
        stance: STANDING for what has a foot, FLOATING for what may have any pose.
    """

    parts: Parts
    places: Sequence[Place]
    stance: str = STANDING

    def placed(self, pose: Array) -> Composition:
        """Return the composition moved by a pose, shape (4, 4)."""
        return Composition(place(self.parts, pose), [_placed(pose, p) for p in self.places], self.stance)

    def mirrored(self) -> Composition:
        """Return the composition mirrored at the plane y = 0."""
        flip = np.diag([1.0, -1.0, 1.0, 1.0])
        return Composition(mirror(self.parts, 1), [_placed(flip, p) for p in self.places], self.stance)


Grammar = Callable[[np.random.Generator], Composition]


def joined(draw: Callable[[np.random.Generator], Iterable[Composition]]) -> Grammar:
    """Return a function that draws one composition of all those that ``draw`` yields."""

    @wraps(draw)
    def drawn(rng: np.random.Generator) -> Composition:
        found = list(draw(rng))
        return Composition([p for one in found for p in one.parts], [p for one in found for p in one.places])

    return drawn


def by_name(*grammars: Grammar) -> dict[str, Grammar]:
    """Return grammars by their names."""
    return {grammar.__name__: grammar for grammar in grammars}


def _placed(pose: Array, one: Place) -> Place:
    fingers = one.fingers
    if fingers is not None:
        x, y, z = (float(v) for v in pose[:3, :3] @ np.asarray(fingers))
        fingers = (x, y, z)
    return Place(pose[:3, :3] @ np.asarray(one.point, float) + pose[:3, 3], fingers)


def at(x: float, y: float, z: float, fingers: Direction | None = None) -> Place:
    """Return a place by its coordinates [m]."""
    return Place(np.array([x, y, z], float), fingers)


def places_at(points: Sequence[Point] | Array, fingers: Direction | None = None) -> list[Place]:
    """Return a place at each of some points, shape (n, 3) [m]."""
    return [Place(np.asarray(point, float), fingers) for point in points]


def site(rng: np.random.Generator, composition: Composition) -> Array:
    """Return a random pose in the workspace of both arms for a composition, shape (4, 4).

    What stands faces the robot more or less, on the tables or raised above them; sometimes it lies or leans like what
    floats.
    """
    pose = np.eye(4)
    pose[:3, 3] = rng.uniform(0.42, 0.68), rng.uniform(-0.55, 0.55), 0.0
    if composition.stance == STANDING and rng.random() < 0.9:
        pose[2, 3] = max(0.0, rng.uniform(-0.2, 0.35))
        return pose @ turn("z", rng.normal(0.0, 0.4)) @ turn(rng.normal(size=3), rng.normal(0.0, 0.06))
    pose[2, 3] = rng.uniform(0.15, 0.75)
    axis = rng.normal(size=3)
    return pose @ turn(axis, rng.uniform(-np.pi, np.pi))
