"""Parts of scenes, and an algebra on lists of them: placed, repeated, mirrored, scaled, nested, cut and jittered.

A part is a primitive with a pose. Lengths are in meters; poses are homogeneous transforms, shape (4, 4). Every function
returns new parts and leaves its arguments as they are.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from apex_ompl.kernel import arrays
from apex_ompl.kernel.scene_builder import boxes_around
from apex_ompl.types import Array, Flags

BOX, SPHERE, CYLINDER, CAPSULE = range(4)
KINDS = np.array([arrays.BOX, arrays.SPHERE, arrays.CYLINDER, arrays.CAPSULE])  # the kernel's
THINNEST = 0.002  # least edge and radius [m]


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
