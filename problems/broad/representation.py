"""How a scene is given: its parts as primitives, as triangle meshes of several parts each, or as clouds of points.

Files of meshes and points are made from the parts where a problem is loaded, in the user's cache, named by their
content. A mesh lies in its parts, round ones approximated by prisms; points lie on the surfaces of theirs, so that
their balls are thicker by the radius.
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

from apex_ompl.errors import ParameterError
from apex_ompl.problems.broad.shapes import BOX, CAPSULE, CYLINDER, Part
from apex_ompl.problems.broad.surfaces import mesh, surface_points
from apex_ompl.scene.bodies import Obstacle, pose_fields
from apex_ompl.util.cache import user_cache
from apex_ompl.util.files import write_atomically

MESH, SURFACE, POINTS = "mesh", "surface", "points"  # a closed mesh, an open one, and a cloud
PRIMITIVES_SHARE, MESH_SHARE, POINTS_SHARE = 0.7, 0.15, 0.1  # the others are given in several ways
SPACING = (0.01, 0.02)  # interval of the distances of points on a surface [m]
COVERAGE = 0.75  # radius of points as a share of their spacing: more than half a square's diagonal
MOST_POINTS = 40_000  # of a cloud
MOST_PARTS = 80  # of a mesh


class Group(NamedTuple):
    """Parts that are given together.

    Attributes:
        form: MESH, SURFACE or POINTS.
        first: First part.
        last: The one behind the last.
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
    """How parts are to be given, before it is known how many there are.

    Attributes:
        forms: Forms of as many runs of parts; an empty one for primitives.
        bounds: Where they end, as shares of the number of parts.
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
