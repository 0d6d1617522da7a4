"""Steps after the goal of a problem: what problem files write as ``after``.

Each starts at rest in the last state of the one before it, and ends at rest. A frame is named after a hand, a link or
a held object, see :func:`apex_ompl.constraints.frames.frame_of`. Lengths are in meters, the world has z up. Motions to
further goals are defined beside these, in :mod:`apex_ompl.scene.problem`.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated, Any, Literal, Self

from pydantic import (
    AfterValidator,
    BeforeValidator,
    ConfigDict,
    Field,
    SerializerFunctionWrapHandler,
    model_serializer,
    model_validator,
)

from apex_ompl.scene.bodies import BodyPair, Coordinate, Direction, Name, Size, Vector
from apex_ompl.util.schema import StrictModel

LONGEST_WAIT = 3600.0  # [s]
SHORTEST_WAY = 1e-6  # of a displacement [m]
LONGEST_APPROACH = 10.0  # from which millimeters are likely [m]

Synergy = Annotated[float, Field(ge=0.0, le=1.0)]


def _with_kind(schema: dict[str, Any]) -> None:
    """Make ``kind`` a required key of files."""
    schema["required"] = ["kind", *schema.get("required", ())]


def _one_or_many(value: Any) -> Any:
    return [value] if isinstance(value, str) else value


Names = Annotated[
    tuple[Name, ...], Field(min_length=1), BeforeValidator(_one_or_many, json_schema_input_type=Name | tuple[Name, ...])
]
"""A name, or several."""


def _an_approach(way: Vector) -> Vector:
    """Check a displacement along which a frame goes to its goal."""
    if max(map(abs, way)) < SHORTEST_WAY:
        raise ValueError("expected an approach that is not zero")
    if max(map(abs, way)) >= LONGEST_APPROACH:
        raise ValueError(f"expected a displacement of less than {LONGEST_APPROACH:g} m; lengths are meters")
    return way


Approach = Annotated[Vector, AfterValidator(_an_approach)]
"""A displacement of a frame along its own axes, by which it goes straight to its goal [m]."""


class Step(StrictModel):
    """A step after the goal; ``kind`` tells which in files."""

    model_config = ConfigDict(json_schema_extra=_with_kind)

    kind: str

    @property
    def subject(self) -> str:
        """What the step is about, for people."""
        return ""

    @property
    def title(self) -> str:
        """The kind and what it is about, in one line."""
        return f"{self.kind} {self.subject}".rstrip()

    @model_serializer(mode="wrap")
    def _kind_first(self, others: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Return the fields with the kind, which is not left out as a default, and one name without a list."""
        data = {"kind": self.kind, **others(self)}
        return {
            k: v[0] if k in ("frame", "objects", "group") and v is not None and len(v) == 1 else v
            for k, v in data.items()
        }


class MotionStep(Step):
    """A step along which frames move.

    Attributes:
        blend: Radius around its end, inside of which the origins of hands may leave its way, since the next step starts
            before it ends, where that one is a motion in the same world [m]. By default the robot rests in between.
    """

    blend: Size | None = None


class LineStep(MotionStep):
    """A straight line of frames by a displacement, or of a contact face to one that it is then aligned with.

    Attributes:
        frame: The frame, or several that go by the displacement at once, in step.
        by: Displacement; orientations are kept [m].
        axes: Axes of the displacement: those of the ``world``, or of each ``frame`` itself at the start of the line.
        gap: With ``by``: the line ends before its end where a held object that moves would come nearer than this to an
            obstacle or another held object [m].
        onto: Held or released object, or hand, whose contact face that of ``frame`` is brought to: with opposite axes,
            by the shortest turn, and no offset across them. The face of a hand is its grasp point with the outward
            normal of the palm.
        distance: With ``onto``: distance of the faces along the axis of ``onto``; negative inside of it [m].
        speed: Largest speed of the frames; by default the limits of the joints alone count [m/s].
    """

    kind: Literal["line"] = "line"
    frame: Names
    by: tuple[Coordinate, Coordinate, Coordinate] | None = None
    axes: Literal["world", "frame"] = "world"
    gap: Size | None = None
    onto: Name | None = None
    distance: Coordinate | None = None
    speed: Size | None = None

    @model_validator(mode="after")
    def _one_end(self) -> Self:
        if (self.by is None) == (self.onto is None):
            raise ValueError("expected either by, a displacement, or onto, a contact face")
        if self.by is not None and max(map(abs, self.by)) < SHORTEST_WAY:
            raise ValueError("expected a displacement by that is not zero")
        if self.by is not None and self.distance is not None:
            raise ValueError("distance is for onto, not for by")
        if self.onto is not None and self.distance is None:
            raise ValueError("expected a distance of the contact faces beside onto")
        if self.onto is not None and (self.gap is not None or self.axes != "world"):
            raise ValueError(f"{'gap' if self.gap is not None else 'axes'} is for by, not for onto")
        if self.onto is not None and len(self.frame) > 1:
            raise ValueError(f"expected one frame that goes onto {self.onto!r}, found {len(self.frame)}")
        if len(set(self.frame)) < len(self.frame):
            raise ValueError("expected frames that differ")
        if self.onto in self.frame:
            raise ValueError("frame and onto are the same")
        return self

    @property
    def subject(self) -> str:
        """The frames, and where to."""
        return " and ".join(self.frame) + (f" onto {self.onto}" if self.onto is not None else "")


class TurnStep(MotionStep):
    """Frames turn together, as one rigid body, about the origin of the first.

    Attributes:
        frame: The frame, or several, such as a cup in one hand and what is above it in the other.
        to: Direction in the world that the z axis of the first frame is brought to, by the shortest turn; of a held
            object with a contact face this is the outward axis of the face.
        speed: Largest speed of the frames; by default the limits of the joints alone count [m/s].
    """

    kind: Literal["turn"] = "turn"
    frame: Names
    to: Direction
    speed: Size | None = None

    @model_validator(mode="after")
    def _differ(self) -> Self:
        if len(set(self.frame)) < len(self.frame):
            raise ValueError("expected frames that differ")
        return self

    @property
    def subject(self) -> str:
        """The frames."""
        return " and ".join(self.frame)


class HandStep(Step):
    """A hand opens or closes; all else is at rest.

    Attributes:
        hand: Name of the hand.
        to: Value of its synergy at the end, from 0, open, to 1, closed.
    """

    kind: Literal["hand"] = "hand"
    hand: Name
    to: Synergy

    @property
    def subject(self) -> str:
        """The hand, and how far it closes."""
        return f"{self.hand} to {self.to:g}"


class ReleaseStep(Step):
    """A hand opens and lets objects go.

    An object that another hand holds too is then held by that one alone. Any other one stands in the scene where it was
    released, and the hand may touch it until it has left it by a ``retreat``.

    Attributes:
        hand: Name of the hand.
        objects: The objects; by default all that it holds.
        to: Value of its synergy at the end; a hand without one does not move.
        falls: Whether the objects are moved on by physics: planning then no longer knows of them.
    """

    kind: Literal["release"] = "release"
    hand: Name
    objects: Names | None = None
    to: Synergy = 0.0
    falls: bool = False

    @property
    def subject(self) -> str:
        """The objects, and the hand."""
        return f"{' and '.join(self.objects)} by {self.hand}" if self.objects else f"all by {self.hand}"


class GraspStep(Step):
    """A hand closes on an obstacle, or on an object that another hand holds, and holds it.

    An object that is farther away than the hand is long is not taken.

    Attributes:
        hand: Name of the hand.
        object: The object.
        to: Value of the hand's synergy at the end; by default just before a finger touches the object.
    """

    kind: Literal["grasp"] = "grasp"
    hand: Name
    object: Name
    to: Synergy | None = None

    @property
    def subject(self) -> str:
        """The object, and the hand."""
        return f"{self.object} by {self.hand}"


class RetreatStep(MotionStep):
    """A hand leaves what it released along a straight line, with its orientation kept.

    Attributes:
        hand: Name of the hand.
        distance: Length of the line [m].
        direction: Its direction in the frame of the hand's palm; by default against the outward normal of the palm.
        speed: Largest speed of the grasp point [m/s].
    """

    kind: Literal["retreat"] = "retreat"
    hand: Name
    distance: Size
    direction: Direction | None = None
    speed: Size | None = None

    @property
    def subject(self) -> str:
        """The hand."""
        return self.hand


class WaitStep(Step):
    """The robot is at rest for a time.

    Attributes:
        seconds: The time [s].
    """

    kind: Literal["wait"] = "wait"
    seconds: Annotated[float, Field(gt=0.0, le=LONGEST_WAIT)]

    @property
    def subject(self) -> str:
        """The time."""
        return f"{self.seconds:g} s"


class AttachStep(Step):
    """An obstacle becomes part of a link, where it is; nothing moves.

    Attributes:
        object: The obstacle.
        link: The link, or a hand, whose palm it is then.
    """

    kind: Literal["attach"] = "attach"
    object: Name
    link: Name

    @property
    def subject(self) -> str:
        """The object, and the link."""
        return f"{self.object} to {self.link}"


class DetachStep(Step):
    """A held object stands in the scene where it is; nothing moves, and its hand may touch it until it retreats.

    Attributes:
        object: The object.
    """

    kind: Literal["detach"] = "detach"
    object: Name

    @property
    def subject(self) -> str:
        """The object."""
        return self.object


class AllowStep(Step):
    """Bodies may touch and overlap from now on, or no longer.

    Attributes:
        pairs: Pairs of links, held objects, obstacles and fixtures.
        contact: Whether they may.
    """

    kind: Literal["allow"] = "allow"
    pairs: Annotated[tuple[BodyPair, ...], Field(min_length=1)]
    contact: bool = True

    @property
    def subject(self) -> str:
        """The pairs."""
        pairs = ", ".join(" <-> ".join(pair) for pair in self.pairs)
        return pairs if self.contact else f"{pairs} no longer"


class RemoveStep(Step):
    """Obstacles or fixtures of the robot are gone from now on.

    Attributes:
        objects: Their names.
    """

    kind: Literal["remove"] = "remove"
    objects: Names

    @property
    def subject(self) -> str:
        """The objects."""
        return " and ".join(self.objects)


class AddStep(Step):
    """Obstacles or fixtures that a step removed are back where they were, from now on.

    Attributes:
        objects: Their names.
    """

    kind: Literal["add"] = "add"
    objects: Names

    @property
    def subject(self) -> str:
        """The objects."""
        return " and ".join(self.objects)


SceneStep = AllowStep | RemoveStep | AddStep
"""A step that changes what the robot may touch; nothing moves."""
StraightStep = LineStep | TurnStep | RetreatStep
"""A step along which frames go straight, or turn."""
HandedStep = HandStep | ReleaseStep | GraspStep
"""A step in which a hand opens or closes."""
TakingStep = GraspStep | AttachStep
"""A step after which an object is held."""
BodiesStep = AttachStep | DetachStep | SceneStep
"""A step in which bodies change and nothing moves."""
SimultaneousStep = (
    LineStep | TurnStep | HandStep | ReleaseStep | GraspStep | RetreatStep | WaitStep | AttachStep | DetachStep
)
"""A step that may happen beside others."""


class TogetherStep(Step):
    """Steps that start at once, of arms that share no joint; it ends when the longest of them does.

    Attributes:
        steps: The steps.
    """

    kind: Literal["together"] = "together"
    steps: Annotated[tuple[Annotated[SimultaneousStep, Field(discriminator="kind")], ...], Field(min_length=2)]

    @property
    def subject(self) -> str:
        """The steps."""
        return f"({', '.join(step.title for step in self.steps)})"


def parts(steps: Iterable[Step | None]) -> tuple[Step, ...]:
    """Return steps with those that happen together one by one; None is left out."""
    found = list[Step]()
    for step in steps:
        found += step.steps if isinstance(step, TogetherStep) else () if step is None else (step,)
    return tuple(found)
