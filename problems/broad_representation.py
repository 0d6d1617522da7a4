"""How a scene is given: its parts as primitives, as triangle meshes of several parts each, or as point clouds.

Files of meshes and points are made from the parts when a problem is loaded, in the user's cache, named by their
content. A mesh lies in its parts, round parts approximated by prisms; points lie on the surfaces of their parts, so
that their balls are thicker by the radius.
"""

from __future__ import annotations

import hashlib
import io
import tempfile
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from apex_ompl.errors import ParameterError
from apex_ompl.kernel.geometry import primitive_distances
from apex_ompl.problems.broad_parts import BOX, CAPSULE, CYLINDER, Part, kernel_columns
from apex_ompl.scene.bodies import Obstacle, pose_fields
from apex_ompl.types import Array
from apex_ompl.util.cache import user_cache
from apex_ompl.util.files import write_atomically

SIDES, STACKS = 24, 6  # around a round part, and from the middle to the pole of a half ball
HIDDEN = 1e-3  # depth in another part at which a triangle is left out of an open mesh [m]
MESH, SURFACE, POINTS = "mesh", "surface", "points"  # a closed mesh, an open one, and a cloud
PRIMITIVES_SHARE, MESH_SHARE, POINTS_SHARE = 0.7, 0.15, 0.1  # the others are given in several ways
SPACING = (0.01, 0.02)  # interval of the distances of points on a surface [m]
COVERAGE = 0.75  # radius of points as a share of their spacing: more than half a square's diagonal
MOST_POINTS = 40_000  # of a cloud
MOST_PARTS = 80  # of a mesh


def distances(parts: Sequence[Part], points: Array) -> Array:
    """Return the signed distances of points, shape (n, 3), to each part, shape (parts, n) [m]."""
    columns = zip(*kernel_columns(parts), strict=True)
    rows = [
        primitive_distances(np.ascontiguousarray((points - offset) @ rotation), int(kind), size)
        for kind, rotation, offset, size in columns
    ]
    return np.array(rows).reshape(len(parts), len(points))


def triangles(part: Part) -> tuple[Array, NDArray[np.int64]]:
    """Return the vertices, shape (V, 3) [m], and the triangles, shape (T, 3), of a part; they lie on its surface."""
    from trimesh import creation  # takes half a second

    if part.kind == BOX:
        made = creation.box(part.size)
    else:
        made = creation.revolve(_profile(part), sections=SIDES)
    return made.vertices @ part.pose[:3, :3].T + part.pose[:3, 3], np.asarray(made.faces, np.int64)


def _profile(part: Part) -> Array:
    """Return radius and height of the rings of a round part, from the lower pole to the upper, shape (n, 2) [m]."""
    radius, half = part.size[0], part.size[1] / 2.0
    if part.kind == CYLINDER:
        return np.array([[0.0, -half], [radius, -half], [radius, half], [0.0, half]])
    angles = np.linspace(0.0, np.pi / 2, STACKS + 1)
    upper = np.stack([radius * np.cos(angles), half + radius * np.sin(angles)], axis=1)
    upper[-1, 0] = 0.0
    lower = (upper * (1.0, -1.0))[::-1]
    return np.concatenate([lower, upper if part.kind == CAPSULE else upper[1:]])


def mesh(parts: Sequence[Part], *, is_open: bool) -> tuple[Array, NDArray[np.int64]]:
    """Return one mesh of parts: vertices, shape (V, 3) [m], and triangles, shape (T, 3).

    Args:
        parts: The parts.
        is_open: Whether triangles inside of other parts are left out; the union of the parts keeps its surface.
    """
    vertices, faces, count = [], [], 0
    for k, part in enumerate(parts):
        own, corners = triangles(part)
        if is_open and len(parts) > 1:
            others = [*parts[:k], *parts[k + 1 :]]
            near = [o for o in others if _reach(o) + _reach(part) > np.linalg.norm(o.pose[:3, 3] - part.pose[:3, 3])]
            if near:
                inside = distances(near, own) < -HIDDEN
                corners = corners[~inside[:, corners].all(axis=2).any(axis=0)]  # parts are convex
        vertices.append(own)
        faces.append(corners + count)
        count += len(own)
    return np.concatenate(vertices), np.concatenate(faces)


def _reach(part: Part) -> float:
    """Return the radius of a ball around a part [m]."""
    if part.kind == BOX:
        return float(np.linalg.norm(part.size)) / 2.0
    return part.size[0] + part.size[1] / 2.0


def surface_points(part: Part, spacing: float) -> Array:
    """Return points, shape (n, 3) [m], on a part, every point of its surface at most ``spacing / sqrt(2)`` away."""
    if part.kind == BOX:
        local = _box_points(np.array(part.size), spacing)
    else:
        profile = _profile_points(part, spacing)
        rows = []
        for r, z in profile:
            count = max(1, int(np.ceil(2.0 * np.pi * r / spacing)))
            angles = np.arange(count) * 2.0 * np.pi / count
            rows.append(np.stack([r * np.cos(angles), r * np.sin(angles), np.full(count, z)], axis=1))
        local = np.concatenate(rows)
    found: Array = local @ part.pose[:3, :3].T + part.pose[:3, 3]
    return found


def _steps(length: float, spacing: float) -> Array:
    """Return coordinates from one end of a length to the other, at most ``spacing`` apart, about 0 [m]."""
    return np.linspace(-length / 2, length / 2, int(np.ceil(length / spacing)) + 1)


def _box_points(size: Array, spacing: float) -> Array:
    found = []
    for axis in range(3):
        u, v = (k for k in range(3) if k != axis)
        across, up = np.meshgrid(_steps(size[u], spacing), _steps(size[v], spacing), indexing="ij")
        for side in (-0.5, 0.5):
            points = np.empty((across.size, 3))
            points[:, axis], points[:, u], points[:, v] = side * size[axis], across.ravel(), up.ravel()
            found.append(points)
    return np.unique(np.concatenate(found), axis=0)


def _profile_points(part: Part, spacing: float) -> Array:
    """Return radius and height of circles on a round part, at most ``spacing`` apart along it, shape (n, 2) [m]."""
    radius, half = part.size[0], part.size[1] / 2.0
    if part.kind == CYLINDER:
        rays = np.linspace(0.0, radius, int(np.ceil(radius / spacing)) + 1)
        walls = np.stack([np.full(len(z := _steps(2 * half, spacing)), radius), z], axis=1)
        caps = [np.stack([rays[:-1], np.full(len(rays) - 1, z)], axis=1) for z in (-half, half)]
        return np.concatenate([walls, *caps])
    angles = np.linspace(0.0, np.pi / 2, int(np.ceil(np.pi / 2 * radius / spacing)) + 1)
    upper = np.stack([radius * np.cos(angles), half + radius * np.sin(angles)], axis=1)
    walls = np.stack([np.full(len(z := _steps(2 * half, spacing)), radius), z], axis=1)
    return np.concatenate([upper, upper * (1.0, -1.0), walls if half else upper[:0]])


class Group(NamedTuple):
    """Parts that are given together.

    Attributes:
        form: MESH, SURFACE or POINTS.
        first: First part.
        last: Index after the last part.
        spacing: Of points; 0 for meshes [m].
    """

    form: str
    first: int
    last: int
    spacing: float = 0.0

    @property
    def radius(self) -> float:
        """Radius of the points [m]."""
        return round(COVERAGE * self.spacing, 4)


class Representation(NamedTuple):
    """How parts are given, before their number is known.

    Attributes:
        forms: Form of each run of parts; empty for primitives.
        bounds: Ends of the runs, as shares of the number of parts.
        spacing: Of points [m].
    """

    forms: tuple[str, ...]
    bounds: tuple[float, ...]
    spacing: float

    @property
    def swelling(self) -> float:
        """By how much obstacles may be thicker than their parts [m]."""
        return round(COVERAGE * self.spacing, 4) if POINTS in self.forms else 0.0

    def groups(self, count: int) -> tuple[Group, ...]:
        """Return the groups of ``count`` parts."""
        ends = [0, *(round(share * count) for share in self.bounds)]
        found = list[Group]()
        for form, first, last in zip(self.forms, ends[:-1], ends[1:], strict=True):
            if form == POINTS and last > first:
                found.append(Group(form, first, last, self.spacing))
            elif form and last > first:
                found += [Group(form, k, min(k + MOST_PARTS, last)) for k in range(first, last, MOST_PARTS)]
        return tuple(found)


def draw_representation(rng: np.random.Generator) -> Representation:
    """Draw how the parts of a problem are given."""
    share, spacing = rng.random(), round(float(rng.uniform(*SPACING)), 4)
    a_mesh = MESH if rng.random() < 0.5 else SURFACE
    if share < PRIMITIVES_SHARE:
        return Representation(("",), (1.0,), spacing)
    if share < PRIMITIVES_SHARE + MESH_SHARE:
        pieces = int(rng.integers(1, 4))
        return Representation((a_mesh,) * pieces, tuple(np.linspace(0, 1, pieces + 1)[1:].tolist()), spacing)
    if share < PRIMITIVES_SHARE + MESH_SHARE + POINTS_SHARE:
        return Representation((POINTS,), (1.0,), spacing)
    forms = [str(form) for form in rng.permutation(["", a_mesh, POINTS])]
    return Representation(tuple(forms), (*np.sort(np.round(rng.uniform(size=2), 2)).tolist(), 1.0), spacing)


def feasible(parts: Sequence[Part], groups: Sequence[Group]) -> bool:
    """Whether no cloud has too many points."""
    return all(len(_cloud(parts[g.first : g.last], g.spacing)) <= MOST_POINTS for g in groups if g.form == POINTS)


def obstacles(parts: Sequence[Part]) -> tuple[Obstacle, ...]:
    """Return parts as obstacles ``part_0`` ..., their numbers rounded to a tenth of a millimeter."""
    return tuple(_obstacle(f"part_{k}", part) for k, part in enumerate(parts))


def _obstacle(name: str, part: Part) -> Obstacle:
    x, y, z = (round(float(v), 4) for v in part.size)
    shapes: tuple[dict[str, Any], ...] = (
        {"box": (x, y, z)}, {"sphere": {"radius": x}}, {"cylinder": {"radius": x, "length": y}},
        {"capsule": {"radius": x, "length": y}},
    )  # fmt: skip
    pose = pose_fields(part.pose)
    position = tuple(round(float(v), 4) for v in pose["position"])
    orientation = tuple(round(float(v), 4) for v in pose["orientation"])
    return Obstacle.model_validate(
        {"name": name, **shapes[part.kind], "position": position, "orientation": orientation}
    )


def part_of(obstacle: Obstacle) -> Part:
    """Return the part that an obstacle is.

    Raises:
        ParameterError: It is no primitive.
    """
    if obstacle.box is not None:
        return Part(BOX, obstacle.box, obstacle.pose)
    if obstacle.sphere is not None:
        return Part(1, (obstacle.sphere.radius, 0.0, 0.0), obstacle.pose)
    bar, kind = (obstacle.cylinder, CYLINDER) if obstacle.cylinder is not None else (obstacle.capsule, CAPSULE)
    if bar is None:
        raise ParameterError("obstacle", obstacle.name, "a primitive")
    return Part(kind, (bar.radius, bar.length, 0.0), obstacle.pose)


def given(primitives: Sequence[Obstacle], groups: Sequence[Group]) -> tuple[Obstacle, ...]:
    """Return obstacles as they are given: primitives, and the groups among them as files in the user's cache."""
    found = list[Obstacle]()
    grouped = {k for group in groups for k in range(group.first, group.last)}
    for number, group in enumerate(groups):
        parts = [part_of(one) for one in primitives[group.first : group.last]]
        if group.form == POINTS:
            shape: dict[str, Any] = {"points": {"file": _points_file(parts, group.spacing), "radius": group.radius}}
        else:
            shape = {"mesh": {"file": _mesh_file(parts, group.form == SURFACE), "solid": group.form == MESH}}
        found.append(Obstacle.model_validate({"name": f"{group.form}_{number}", **shape}))
    return (*(one for k, one in enumerate(primitives) if k not in grouped), *found)


def swollen(primitives: Sequence[Obstacle], groups: Sequence[Group]) -> tuple[Obstacle, ...]:
    """Return primitives of which those that are given as points contain the balls around these."""
    found = list(primitives)
    for group in groups:
        if group.form != POINTS:
            continue
        for k in range(group.first, group.last):
            kind, (x, y, z), pose = part_of(found[k])
            more = group.radius
            size = (x + 2 * more, y + 2 * more, z + 2 * more) if kind == BOX else (x + more, y, z)
            size = (x + more, y + 2 * more, z) if kind == CYLINDER else size
            found[k] = _obstacle(found[k].name, Part(kind, size, pose))
    return tuple(found)


def _cloud(parts: Sequence[Part], spacing: float) -> Any:
    return np.concatenate([surface_points(part, spacing) for part in parts])


def _points_file(parts: Sequence[Part], spacing: float) -> str:
    stream = io.BytesIO()
    np.save(stream, np.unique(np.round(_cloud(parts, spacing), 4), axis=0), allow_pickle=False)
    return _kept(stream.getvalue(), ".npy")


def _mesh_file(parts: Sequence[Part], is_open: bool) -> str:
    vertices, faces = mesh(parts, is_open=is_open)
    lines = ["v {:.5f} {:.5f} {:.5f}".format(*row) for row in vertices.tolist()]
    lines += ["f {} {} {}".format(*row) for row in (faces + 1).tolist()]
    return _kept("\n".join([*lines, ""]).encode(), ".obj")


def _kept(content: bytes, suffix: str) -> str:
    """Return the path of a file with some content in the user's cache; it is written where it is not there."""
    path = _folder() / (hashlib.sha256(content).hexdigest()[:24] + suffix)
    if not path.exists():
        write_atomically(path, content)
    return str(path)


@cache
def _folder() -> Path:
    return user_cache("shapes") or Path(tempfile.mkdtemp(prefix="apex_ompl_"))
