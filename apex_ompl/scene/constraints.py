"""Constraints along a path: what problem files and callers of planners write.

Each relates a frame of the robot to the world, or to another frame, and holds along the whole path. A frame is named
after a hand, a link or a held object, see :func:`apex_ompl.constraints.frames.frame_of`. Lengths are in meters, angles
in radians, the world has z up, quaternions are ordered xyzw.
"""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal, Self

from pydantic import (
    AfterValidator,
    BeforeValidator,
    ConfigDict,
    Field,
    PositiveFloat,
    SerializerFunctionWrapHandler,
    field_validator,
    model_serializer,
    model_validator,
)

from apex_ompl.scene.bodies import Coordinate, Direction, Name, Quaternion, Vector
from apex_ompl.util.schema import StrictModel

WORLD = "world"
"""Name of the world's frame."""
LEAST_WIDTH = 2e-4  # of a region along an axis with two bounds [m]

Angle = Annotated[float, Field(gt=0.0, le=math.pi)]
Freedom = Literal["x", "y", "z", "rx", "ry", "rz"]


def _a_turn_at_most(angle: float) -> float:
    if angle > 2.0 * math.pi:
        raise ValueError("expected an angle of at most 6.2832; angles are radians")
    return angle


AngleTolerance = Annotated[PositiveFloat, AfterValidator(_a_turn_at_most)]


def is_turn(least: float, largest: float) -> bool:
    """Whether two angles are a range of at most a whole turn [rad]."""
    whole = 2.0 * math.pi
    return -whole <= least <= largest <= min(whole, least + whole)


def _no_bound(infinite: float) -> BeforeValidator:
    """Return the conversion of an infinite bound to None, which files hold as null."""
    return BeforeValidator(lambda bound: None if isinstance(bound, float) and bound == infinite else bound)


LowerBound = Annotated[Coordinate | None, _no_bound(-math.inf)]
UpperBound = Annotated[Coordinate | None, _no_bound(math.inf)]


def _with_kind(schema: dict[str, Any]) -> None:
    """Make ``kind`` a required key of files."""
    schema["required"] = ["kind", *schema.get("required", ())]


class PoseTolerance(StrictModel):
    """Tolerance of a pose: distance [m] and angle [rad]."""

    position: PositiveFloat = 1e-3
    angle: AngleTolerance = 1e-2


class Pose(StrictModel):
    """A pose: position [m] and orientation, a quaternion xyzw."""

    position: Vector = (0.0, 0.0, 0.0)
    orientation: Quaternion = (0.0, 0.0, 0.0, 1.0)


class Constraint(StrictModel):
    """A constraint along a path; ``kind`` tells which in files."""

    model_config = ConfigDict(json_schema_extra=_with_kind)

    kind: str

    @model_serializer(mode="wrap")
    def _kind_first(self, others: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Return the fields with the kind, which is not left out as a default."""
        return {"kind": self.kind, **others(self)}


class Upright(Constraint):
    """An axis of a frame stays within an angle of a direction of the world, such as that of a cup within one of up.

    Attributes:
        frame: The frame.
        axis: The axis in the frame.
        angle: Largest angle between the two [rad].
        up: The direction in the world.
    """

    kind: Literal["upright"] = "upright"
    frame: Name
    axis: Direction = (0.0, 0.0, 1.0)
    angle: Angle = 0.1
    up: Direction = (0.0, 0.0, 1.0)


class RelativePose(Constraint):
    """The pose of a frame in another one stays the same, but for some freedoms.

    Attributes:
        first: The other frame, or ``world``.
        second: The frame.
        pose: Pose of the second frame in the first; by default that at the start.
        free: ``x``, ``y``, ``z`` for slides along axes of the first frame; and none, one or all of ``rx``, ``ry`` and
            ``rz`` for turns: about that axis of the second frame, or of any kind.
        tolerance: Largest distance and angle from it.
    """

    kind: Literal["relative_pose"] = "relative_pose"
    first: Name
    second: Name
    pose: Pose | None = None
    free: tuple[Freedom, ...] = ()
    tolerance: PoseTolerance = PoseTolerance()

    @model_validator(mode="after")
    def _two_frames(self) -> Self:
        if self.first == self.second:
            raise ValueError("first and second are the same")
        if self.second == WORLD:
            raise ValueError(f"expected a frame of the robot as second; first may be {WORLD!r}")
        return self

    @field_validator("free")
    @classmethod
    def _known_freedoms(cls, free: tuple[Freedom, ...]) -> tuple[Freedom, ...]:
        twice = sorted({one for one in free if free.count(one) > 1})
        if twice:
            raise ValueError(f"{twice[0]!r} is given twice")
        turns = [one for one in free if one in ("rx", "ry", "rz")]
        if len(turns) == 2:
            raise ValueError("expected none, one or all of rx, ry, rz")
        if len(free) == 6:
            raise ValueError("expected at least one of x, y, z, rx, ry, rz that is not free")
        return free


class OnPlane(Constraint):
    """The origin of a frame stays on a plane of the world.

    Attributes:
        frame: The frame.
        normal: Normal of the plane.
        point: A point of the plane [m]; by default the origin of the frame at the start.
        tolerance: Largest distance from it [m].
    """

    kind: Literal["on_plane"] = "on_plane"
    frame: Name
    normal: Direction
    point: Vector | None = None
    tolerance: PositiveFloat = 1e-3


class OnLine(Constraint):
    """The origin of a frame stays on a line of the world.

    Attributes:
        frame: The frame.
        direction: Direction of the line.
        point: A point of the line [m]; by default the origin of the frame at the start.
        tolerance: Largest distance from it [m].
    """

    kind: Literal["on_line"] = "on_line"
    frame: Name
    direction: Direction
    point: Vector | None = None
    tolerance: PositiveFloat = 1e-3


class FixedOrientation(Constraint):
    """The orientation of a frame in the world stays the same.

    Attributes:
        frame: The frame.
        orientation: The orientation; by default that at the start.
        angle: Largest angle of the rotation from it [rad].
    """

    kind: Literal["fixed_orientation"] = "fixed_orientation"
    frame: Name
    orientation: Quaternion | None = None
    angle: Angle = 1e-2


class ToolRegion(Constraint):
    """The origin of a frame stays in a box that is fixed in the world: a task space region.

    Attributes:
        frame: The frame.
        lower: Least coordinates along the axes of the box [m]; None or -inf for no bound.
        upper: Largest coordinates; None or inf for no bound.
        position: Origin of the frame that the box is given in [m].
        orientation: Orientation of that frame.
        angle: Largest angle of the rotation from ``orientation`` to that of the frame [rad]; any by default.
    """

    kind: Literal["tool_region"] = "tool_region"
    frame: Name
    lower: tuple[LowerBound, LowerBound, LowerBound] = (None, None, None)
    upper: tuple[UpperBound, UpperBound, UpperBound] = (None, None, None)
    position: Vector = (0.0, 0.0, 0.0)
    orientation: Quaternion = (0.0, 0.0, 0.0, 1.0)
    angle: Angle | None = None

    @model_validator(mode="after")
    def _not_empty(self) -> Self:
        bounds = list(zip("xyz", self.lower, self.upper, strict=True))
        for axis, lower, upper in bounds:
            if lower is None or upper is None:
                continue
            if lower > upper:
                raise ValueError(
                    f"expected a lower bound that is at most the upper one, found {lower} > {upper} of {axis}"
                )
            if upper - lower < LEAST_WIDTH:
                raise ValueError(
                    f"expected bounds of {axis} that are at least {LEAST_WIDTH} m apart; on_plane and on_line keep less"
                )
        if self.angle is None and all(lower is None and upper is None for _, lower, upper in bounds):
            raise ValueError("expected a bound or an angle")
        return self


AnyConstraint = Annotated[
    Upright | RelativePose | OnPlane | OnLine | FixedOrientation | ToolRegion, Field(discriminator="kind")
]
"""A constraint in a problem file."""
