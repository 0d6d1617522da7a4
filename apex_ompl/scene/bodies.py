"""Solids of problem and robot files: shapes, poses, obstacles and held objects.

Lengths are in meters, masses in kilograms, the world has z up, quaternions are ordered xyzw.
"""

from __future__ import annotations

import base64
import os
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Annotated, Any, Self, TypeVar

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike
from pydantic import AfterValidator, ConfigDict, Field, field_validator, model_validator

from apex_ompl.types import Array
from apex_ompl.util.arrays import length
from apex_ompl.util.schema import StrictModel

MESH_SUFFIXES = (".stl", ".obj", ".ply", ".dae", ".glb", ".off")
POINT_SUFFIXES = (".npy", ".ply", ".pcd")
GRID_SUFFIXES = (".npz",)
VOXEL_SUFFIXES = (".npz", ".bt")
LARGEST = 1e4  # longer lengths and larger masses are errors [m, kg]
LONG = 50.0  # length from which a body is noted [m]
INERTIA_TOLERANCE = 1e-3  # relative error of moments of inertia, which files round


def _unit_quaternion(q: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
    if abs(float(np.linalg.norm(q)) - 1.0) > 1e-3:
        raise ValueError("expected a unit quaternion [x, y, z, w]")
    return q


def _non_zero(v: tuple[float, float, float]) -> tuple[float, float, float]:
    if float(np.linalg.norm(v)) < 1e-9:
        raise ValueError("expected a direction that is not zero")
    return v


def _two_bodies(pair: tuple[str, str]) -> tuple[str, str]:
    if pair[0] == pair[1]:
        raise ValueError(f"the body {pair[0]!r} is not checked against itself, expected two bodies")
    return pair


Coordinate = Annotated[float, Field(ge=-LARGEST, le=LARGEST)]
Time = Annotated[float, Field(ge=0.0)]
Size = Annotated[float, Field(gt=0.0, le=LARGEST)]
Mass = Annotated[float, Field(gt=0.0, le=LARGEST)]
Vector = tuple[Coordinate, Coordinate, Coordinate]
Direction = Annotated[Vector, AfterValidator(_non_zero)]
Quaternion = Annotated[tuple[float, float, float, float], AfterValidator(_unit_quaternion)]
PlaceInTime = tuple[Time, Coordinate, Coordinate, Coordinate]
BodyPair = Annotated[tuple[str, str], AfterValidator(_two_bodies)]
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_./-]*$")]


def _ending_in(known: tuple[str, ...], role: str) -> AfterValidator:
    """Return the check of a file's suffix."""

    def check(file: str) -> str:
        if not file.lower().endswith(known):
            raise ValueError(f"expected a {role} ending in {' or '.join(known)}")
        return file

    return AfterValidator(check)


class Sphere(StrictModel):
    """A ball centered on the object's origin; radius [m]."""

    radius: Size


class RoundBar(StrictModel):
    """A cylinder along z centered on the origin, or a capsule whose ``length`` excludes its end caps [m]."""

    radius: Size
    length: Size


def _base64(text: str | None) -> str | None:
    try:
        base64.b64decode(text or "", validate=True)
    except ValueError as error:
        raise ValueError(f"expected the content of the file in base64 ({error})") from error
    return text


class FileShape(StrictModel):
    """A shape from a file.

    In Python the file may be a ``Path``, the content bytes, and a name or path alone stands for a shape of it.

    Attributes:
        content: Content of the file in base64, from memory: the file is not read then, and its name tells the format.
    """

    content: Annotated[str | None, AfterValidator(_base64), Field(repr=False)] = None

    @model_validator(mode="before")
    @classmethod
    def _of_python(cls, data: Any) -> Any:
        fields = {"file": data} if isinstance(data, (str, os.PathLike)) else data
        if not isinstance(fields, Mapping):
            return fields
        found = dict(fields)
        if isinstance(found.get("file"), os.PathLike):
            found["file"] = os.fspath(found["file"])
        if isinstance(found.get("content"), (bytes, bytearray)):
            found["content"] = base64.b64encode(found["content"]).decode("ascii")
        return found


class MeshFile(FileShape):
    """A triangle mesh from a file; a relative path is relative to the problem file.

    A ``solid`` has an inside and must be closed; with ``solid`` false the mesh is a surface. By default a mesh is a
    solid, and its holes count as closed.
    """

    file: Annotated[str, _ending_in(MESH_SUFFIXES, "mesh file")]
    scale: Vector = (1.0, 1.0, 1.0)
    solid: bool | None = None

    @field_validator("scale")
    @classmethod
    def _positive_scale(cls, scale: Vector) -> Vector:
        if min(scale) <= 0.0:
            raise ValueError("expected three positive factors")
        return scale


class PointFile(FileShape):
    """Balls of one radius [m] around the points of a file; a relative path is relative to the problem file."""

    file: Annotated[str, _ending_in(POINT_SUFFIXES, "file of points")]
    radius: Size


class GridFile(FileShape):
    """Cells of a grid from a file (:mod:`apex_ompl.scene.grids`); a relative path is relative to the problem file."""

    file: Annotated[str, _ending_in(GRID_SUFFIXES, "file of a grid")]


class VoxelFile(GridFile):
    """Cells of a grid that are full, from a file, which may be a map of OctoMap (:mod:`apex_ompl.scene.grids`)."""

    file: Annotated[str, _ending_in(VOXEL_SUFFIXES, "file of voxels")]


class HalfSpace(StrictModel):
    """All points x of the object's frame with normal . x <= offset [m]; the normal points out of the solid."""

    normal: Direction
    offset: Coordinate = 0.0


class Body(StrictModel):
    """A named solid with exactly one shape and a pose."""

    name: Name
    box: tuple[Size, Size, Size] | None = None
    sphere: Sphere | None = None
    cylinder: RoundBar | None = None
    capsule: RoundBar | None = None
    mesh: MeshFile | None = None
    points: PointFile | None = None
    voxels: VoxelFile | None = None
    distance_grid: GridFile | None = None
    half_space: HalfSpace | None = None
    position: Vector = (0.0, 0.0, 0.0)
    orientation: Quaternion = (0.0, 0.0, 0.0, 1.0)

    @model_validator(mode="after")
    def _one_shape(self) -> Self:
        given = [k for k in SHAPES if getattr(self, k) is not None]
        if len(given) != 1:
            found = " and ".join(given) or "none"
            raise ValueError(f"{self.name!r}: expected exactly one of {', '.join(SHAPES)}; found {found}")
        return self

    @property
    def shape(self) -> str:
        """The kind of the shape: one of ``SHAPES``."""
        return next(k for k in SHAPES if getattr(self, k) is not None)

    @property
    def pose(self) -> Array:
        """Homogeneous transform, shape (4, 4) [m]."""
        return pose_matrix(self.position, self.orientation)


BodyT = TypeVar("BodyT", bound=Body)
SHAPES = ("box", "sphere", "cylinder", "capsule", "mesh", "points", "voxels", "distance_grid", "half_space")
SOLID = ("name", *SHAPES, "orientation")  # fields of a solid that do not change as it moves
MOTION = ("velocity", "trajectory", "appears")  # fields of the motion of an obstacle
HOLDING = ("link", "links", "touch_links")  # fields that an object has only while it is held
FILES = ("mesh", "points", "voxels", "distance_grid")  # shapes that are read from files


class ContactFace(StrictModel):
    """The face of an object that is brought into contact: center [m] and outward axis, in the object's frame."""

    point: Vector = (0.0, 0.0, 0.0)
    axis: Direction = (0.0, 0.0, 1.0)


class HandGrasp(StrictModel):
    """A pose at which a hand takes an object, in the object's frame.

    Attributes:
        position: Position of the hand's grasp point [m].
        orientation: Orientation of the hand's palm, a quaternion xyzw.
        hand: Name of the hand; any by default.
    """

    position: Vector
    orientation: Quaternion
    hand: Name | None = None

    @property
    def pose(self) -> Array:
        """Homogeneous transform, shape (4, 4) [m]."""
        return pose_matrix(self.position, self.orientation)


class MassiveBody(Body):
    """A solid that may be held and have a mass; its shape, of uniform density, determines what is not given.

    Attributes:
        mass: Mass [kg]; without it the solid counts as weightless.
        center_of_mass: Center of mass in the object's frame [m].
        inertia: Inertia about the center of mass along the axes of the object's frame, in URDF's order ixx, ixy, ixz,
            iyy, iyz, izz [kg m^2].
        contact: Its contact face.
        grasps: Where hands may take it.
    """

    mass: Mass | None = None
    center_of_mass: Vector | None = None
    inertia: tuple[float, float, float, float, float, float] | None = None
    contact: ContactFace | None = None
    grasps: tuple[HandGrasp, ...] = ()

    @model_validator(mode="after")
    def _possible_inertia(self) -> Self:
        if self.mass is None and (self.center_of_mass is not None or self.inertia is not None):
            raise ValueError(f"{self.name!r}: expected a mass beside center_of_mass and inertia")
        if self.mass is not None and self.half_space is not None:
            raise ValueError(f"{self.name!r}: expected no mass of a half_space")
        if self.inertia is not None:
            moments = np.linalg.eigvalsh(symmetric(self.inertia))
            if moments[0] < 0.0 or moments[0] + moments[1] < moments[2] * (1.0 - INERTIA_TOLERANCE):
                raise ValueError(
                    f"{self.name!r}: expected an inertia whose principal moments are not negative, none of them larger "
                    "than the sum of the others"
                )
        return self


class Obstacle(MassiveBody):
    """A solid in the world frame, which may translate from time 0 on; see :mod:`apex_ompl.scene.scripts`.

    Attributes:
        velocity: Constant velocity [m/s]; ``position`` is the position at time 0.
        trajectory: Rows of a time [s] and a position [m], joined by straight lines; the obstacle stands still after the
            last row. Times increase from 0. ``position`` is set to the first position.
        appears: Time at which the obstacle appears [s]; its trajectory runs from time 0 all the same.
    """

    velocity: Vector | None = None
    trajectory: Annotated[tuple[PlaceInTime, ...], Field(min_length=1)] | None = None
    appears: Time = 0.0

    @model_validator(mode="after")
    def _from_first_place(self) -> Self:
        if self.trajectory is None:
            return self
        times, place = [row[0] for row in self.trajectory], self.trajectory[0][1:]
        if self.velocity is not None:
            raise ValueError(f"{self.name!r}: expected a velocity or a trajectory, found both")
        if times[0] != 0.0 or any(b <= a for a, b in zip(times, times[1:], strict=False)):
            raise ValueError(f"{self.name!r}: expected times of the trajectory that increase from 0")
        if "position" in self.model_fields_set and self.position != place:
            raise ValueError(f"{self.name!r}: expected no position, or the first place of the trajectory")
        object.__setattr__(self, "position", place)
        return self

    @property
    def scripted(self) -> bool:
        """Whether it appears after time 0, or has a trajectory whose positions differ."""
        return self.appears > 0.0 or len({row[1:] for row in self.trajectory or ()}) > 1

    @property
    def moving(self) -> bool:
        """Whether it is scripted, or has a velocity other than zero."""
        return self.scripted or any(self.velocity or ())


def same_solid(first: Body, second: Body) -> bool:
    """Whether two bodies differ in nothing but their positions and how they move."""
    return first is second or all(getattr(first, field) == getattr(second, field) for field in SOLID)


def _one_of_both(schema: dict[str, Any]) -> None:
    """Require a link or links."""
    schema["required"].remove("link")
    schema["anyOf"] = [{"required": ["link"]}, {"required": ["links"]}]


class AttachedObject(MassiveBody):
    """A held solid, with its pose in the frame of the link that holds it.

    Attributes:
        link: The link that holds it, by default the first of ``links``.
        links: Two links that hold it together: it is attached to the first, and the second one keeps its pose relative
            to that along the whole path.
        touch_links: Links that it may touch; None means all links of the hands that hold it.
    """

    model_config = ConfigDict(json_schema_extra=_one_of_both)

    link: Name
    links: tuple[Name, Name] | None = None
    touch_links: tuple[Name, ...] | None = None

    @model_validator(mode="before")
    @classmethod
    def _first_of_links(cls, data: Any) -> Any:
        if isinstance(data, Mapping) and "link" not in data:
            links = data.get("links")
            if isinstance(links, (list, tuple)) and links:
                return {**data, "link": links[0]}
        return data

    @model_validator(mode="after")
    def _two_links(self) -> Self:
        if self.links is None:
            return self
        if self.links[0] == self.links[1]:
            raise ValueError(f"{self.name!r}: expected two links that differ")
        if self.links[0] != self.link:
            raise ValueError(f"{self.name!r}: expected {self.link!r}, the link, as the first of links")
        missing = [link for link in self.links if self.touch_links is not None and link not in self.touch_links]
        if missing:
            raise ValueError(f"{self.name!r}: expected {missing[0]!r}, which holds it, among touch_links")
        return self

    @model_validator(mode="after")
    def _bounded(self) -> Self:
        if self.half_space is not None or self.points is not None:
            raise ValueError(f"{self.name!r}: {'a half_space' if self.half_space else 'points'} cannot be held")
        return self

    @property
    def holders(self) -> tuple[str, ...]:
        """The links that hold it: one or two."""
        return self.links or (self.link,)


def given_fields(body: Body, left_out: Collection[str] = ()) -> dict[str, Any]:
    """Return the fields of a body that have a value, by name; what they hold is not copied."""
    fields = ((name, getattr(body, name)) for name in type(body).model_fields if name not in left_out)
    return {name: value for name, value in fields if value is not None}


def size_note(body: Body, longest: float = 0.0) -> str:
    """Return a sentence on a body that is so long that another unit is likely; else nothing.

    Args:
        body: The body.
        longest: Length of a shape in a file [m].
    """
    bar = body.cylinder or body.capsule
    lengths = [*(body.box or ()), *([2.0 * body.sphere.radius] if body.sphere is not None else [])]
    lengths += [2.0 * bar.radius, bar.length] if bar is not None else []
    longest = max([longest, *lengths])
    return f"{body.name} is {longest:g} m long; lengths are meters" if longest >= LONG else ""


def file_shape(body: Body) -> MeshFile | PointFile | GridFile | None:
    """Return the shape of a body that is in a file, or None for one of another shape."""
    return body.mesh or body.points or body.voxels or body.distance_grid


def located(body: BodyT, folder: Path) -> BodyT:
    """Return a body whose file, if any, has an absolute path; a relative path is relative to ``folder``."""
    for name in FILES:
        shape = getattr(body, name)
        if shape is not None and shape.content is None:
            file = os.path.abspath(folder / shape.file)
            return body.model_copy(update={name: shape.model_copy(update={"file": file})})
    return body


def pose_matrix(position: ArrayLike, orientation: ArrayLike) -> Array:
    """Return the homogeneous transform of a position [m] and a quaternion xyzw, shape (4, 4)."""
    x, y, z, w = np.asarray(orientation, float) / length(orientation)
    pose = np.eye(4)
    pose[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    pose[:3, 3] = position
    return pose


def symmetric(entries: ArrayLike) -> Array:
    """Return the symmetric matrix with entries xx, xy, xz, yy, yz, zz, shape (3, 3)."""
    xx, xy, xz, yy, yz, zz = np.asarray(entries, float)
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def pose_fields(pose: Array) -> dict[str, tuple[float, ...]]:
    """Return the fields ``position`` [m] and ``orientation`` (quaternion xyzw) of a transform of shape (4, 4)."""
    turn = pin.Quaternion(pose[:3, :3]).coeffs()
    return {"position": tuple(pose[:3, 3].tolist()), "orientation": tuple(turn.tolist())}
