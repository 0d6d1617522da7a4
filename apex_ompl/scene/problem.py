"""Planning problems: the robot, a scene, held objects, a start and a goal, as records and as YAML files.

The file format is ``schema: apex-ompl/problem/1``. Joints go by name [rad; hand synergies 0 open to 1
closed]; lengths are in meters, the world has z up, quaternions are ordered xyzw.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import (
    BeforeValidator,
    ConfigDict,
    Field,
    PositiveFloat,
    PrivateAttr,
    ValidationInfo,
    field_validator,
    model_validator,
)

from apex_ompl.errors import FileFormatError, ParameterError, nearest_name
from apex_ompl.scene.bodies import (
    AttachedObject,
    BodyPair,
    Mass,
    Name,
    Obstacle,
    Quaternion,
    Vector,
    located,
    pose_matrix,
)
from apex_ompl.scene.constraints import AngleTolerance, AnyConstraint, PoseTolerance, is_turn
from apex_ompl.scene.steps import Approach, MotionStep, Names, SceneStep, SimultaneousStep, TogetherStep
from apex_ompl.types import Array
from apex_ompl.util.display import counted, one_line
from apex_ompl.util.files import path_text, write_atomically
from apex_ompl.util.schema import StrictModel, check_version, dump_yaml, read_yaml, validate
from apex_ompl.util.validation import degrees_hint

SCHEMA = "apex-ompl/problem/1"


GOALS = ("joints", "alignment", "poses", "grasp", "any_of", "all_of")
"""Kinds of goals."""

Poses = Mapping[str, Mapping[str, float]]
"""Named poses of a robot: name -> joint name -> value."""


def _posed(value: Any, info: ValidationInfo) -> Any:
    """Return the values of a pose in place of its name."""
    if not isinstance(value, str):
        return value
    if info.context is None:
        raise ValueError("expected values by joint name; names of poses are read by apex_ompl.load_problem")
    poses = info.context()
    if value not in poses:
        raise ValueError(f"unknown pose, {_hint(value, poses)}")
    return dict(poses[value])


JointValues = Annotated[dict[str, float], BeforeValidator(_posed, json_schema_input_type=dict[str, float] | str)]
"""Joint name -> value; in files the name of a pose of the robot, too."""


def _one_or_many(value: Any) -> Any:
    return [value] if isinstance(value, str | Mapping) else value


class WorldVector(StrictModel):
    """A vector given in the world at the start state and fixed to a link, as in section III-A of the paper.

    ``tip`` is the point of contact [m], and the direction from ``tail`` to ``tip`` is the outward axis.
    """

    link: Name
    tail: Vector
    tip: Vector

    @model_validator(mode="after")
    def _not_a_point(self) -> Self:
        if float(np.linalg.norm(np.subtract(self.tip, self.tail))) < 1e-6:
            raise ValueError("expected a tail and a tip that differ")
        return self


class Tolerance(StrictModel):
    """Tolerance of an alignment: across and along the axis [m], and of the angle [rad]."""

    lateral: PositiveFloat
    axial: PositiveFloat
    angle: AngleTolerance


ALIGNMENT_DEFAULTS: dict[str, tuple[float, Tolerance]] = {
    "vertical": (0.01, Tolerance(lateral=0.01, axial=0.01, angle=float(np.radians(5)))),
    "horizontal": (0.03, Tolerance(lateral=0.01, axial=0.01, angle=float(np.radians(8)))),
    "pour": (0.05, Tolerance(lateral=0.015, axial=0.02, angle=float(np.radians(10)))),
    "handover": (0.01, Tolerance(lateral=0.015, axial=0.01, angle=float(np.radians(12)))),
}
"""Kind of alignment -> default distance [m] and tolerance."""


class Alignment(StrictModel):
    """An alignment of two contact faces (section III-A of the paper), defined in ``apex_ompl.goals.alignment``.

    Attributes:
        kind: ``vertical`` (stacking), ``horizontal`` (insertion), ``pour`` or ``handover``.
        first: Name of a held object that has a contact face, or a vector in the world.
        second: The same; for a handover the name of the receiving hand.
        distance: Distance of the faces along the axis; for ``pour`` the height of the lip above the opening [m].
        tolerance: Tolerance; that of the kind by default.
        tilt: Smallest and largest angle between the axis of ``first`` and up, for ``pour`` [rad].
    """

    kind: Literal["vertical", "horizontal", "pour", "handover"]
    first: Name | WorldVector
    second: Name | WorldVector
    distance: float | None = None
    tolerance: Tolerance | None = None
    tilt: tuple[float, float] | None = None

    @model_validator(mode="after")
    def _tilt_of_pouring(self) -> Self:
        if self.tilt is not None and self.kind != "pour":
            raise ValueError(f"tilt is for pour only, not for {self.kind}")
        if self.tilt is not None and not 0.0 <= self.tilt[0] < self.tilt[1] <= float(np.pi):
            raise ValueError("expected a tilt range [least, largest] inside [0, 3.1416]")
        if self.first == self.second:
            raise ValueError("first and second are the same")
        return self


class PoseTarget(StrictModel):
    """A pose in the world that a frame of the robot is to reach.

    With ``free_turn``, ``lower`` and ``upper`` it is a region of poses, by the axes of the wanted pose.

    Attributes:
        frame: Name of a hand, whose frame is that of its palm with the grasp point as origin; of a link; or of a held
            object, whose frame is its own, or its contact face with the outward axis as z where it has one.
        position: Position of the frame's origin [m].
        orientation: Orientation of the frame, a quaternion xyzw; any by default. Of a contact face its z axis counts.
        tolerance: How far from it counts as reached.
        free_turn: Axis of the frame about which it may be turned.
        turn: Least and largest angle by which it may be turned about that axis, as 2.6 and 3.6 [rad]; by default any.
        lower: Least position of the frame's origin relative to ``position``, along the axes of the wanted pose [m].
        upper: Largest one.
        approach: Displacement along the frame's own axes by which it goes to the pose, straight, without turning [m].
    """

    frame: Name
    position: Vector
    orientation: Quaternion | None = None
    tolerance: PoseTolerance = PoseTolerance()
    free_turn: Literal["x", "y", "z"] | None = None
    turn: tuple[float, float] | None = None
    lower: Vector = (0.0, 0.0, 0.0)
    upper: Vector = (0.0, 0.0, 0.0)
    approach: Approach | None = None

    @model_validator(mode="after")
    def _a_region(self) -> Self:
        if self.free_turn is not None and self.orientation is None:
            raise ValueError("expected an orientation beside free_turn")
        if self.turn is not None and (self.free_turn is None or not is_turn(*self.turn)):
            wanted = "[least, largest] inside [-6.2832, 6.2832], at most 6.2832 apart, beside a free_turn"
            raise ValueError(f"expected turn: {wanted}{degrees_hint(self.turn, is_turn)}")
        if not all(low <= 0.0 <= high for low, high in zip(self.lower, self.upper, strict=True)):
            raise ValueError("expected a lower of 0 or less and an upper of 0 or more")
        if self.approach is not None and self.orientation is None:
            raise ValueError("expected an orientation beside an approach")
        if self.approach is not None and self.free_turn is not None:
            along = ["xyz"[k] for k in range(3) if self.approach[k]]
            if along != [self.free_turn]:
                raise ValueError(f"expected an approach along the axis of the free turn, {self.free_turn}")
        return self

    @property
    def before_approach(self) -> PoseTarget:
        """The pose where the approach starts, without one."""
        if self.approach is None:
            return self
        wanted = pose_matrix(self.position, self.orientation or (0.0, 0.0, 0.0, 1.0))
        by = [sum(wanted[i, k] * self.approach[k] for k in range(3)) for i in range(3)]
        position = tuple(float(self.position[i] - by[i]) for i in range(3))
        return self.model_copy(update={"position": position, "approach": None})

    @property
    def is_exact(self) -> bool:
        """Whether it is one pose but for a free turn, and no region of positions or angles."""
        return self.turn is None and not any(self.lower) and not any(self.upper)


class GraspGoal(StrictModel):
    """A hand at any of the grasps of an object, an obstacle or one that another hand holds, where that is at the start.

    Attributes:
        object: The object, which has ``grasps``.
        hand: The hand.
        approach: Displacement along the hand's own axes, by which it goes straight to the grasp after the goal [m].
        remaining: Displacement from the goal to the grasp, by which a later step goes [m].
    """

    object: Name
    hand: Name
    approach: Approach | None = None
    remaining: Vector | None = None


def _named(value: Any) -> Any:
    """Return the goal of a pose in place of its name."""
    return {"joints": value} if isinstance(value, str) else value


class Goal(StrictModel):
    """A goal: joint configurations of which one is to be reached, an alignment of held objects, poses, or several.

    Poses are reached all at once, by one frame each; joints that move none of the frames stay as they are at the start.
    Of the goals in ``any_of``, any will do; poses and grasps in ``all_of`` are reached together.
    """

    joints: (
        Annotated[
            tuple[JointValues, ...],
            Field(min_length=1),
            BeforeValidator(_one_or_many, json_schema_input_type=JointValues | tuple[JointValues, ...]),
        ]
        | None
    ) = None
    alignment: Alignment | None = None
    poses: Annotated[tuple[PoseTarget, ...], Field(min_length=1)] | None = None
    grasp: GraspGoal | None = None
    any_of: Annotated[tuple[NamedGoal, ...], Field(min_length=1)] | None = None
    all_of: Annotated[tuple[Goal, ...], Field(min_length=2)] | None = None

    @model_validator(mode="after")
    def _one_kind(self) -> Self:
        given = [kind for kind in GOALS if getattr(self, kind) is not None]
        if len(given) != 1:
            raise ValueError(f"expected exactly one of {', '.join(GOALS)}; found {' and '.join(given) or 'none'}")
        frames = [pose.frame for pose in self.poses or ()]
        twice = sorted({name for name in frames if frames.count(name) > 1})
        if twice:
            raise ValueError(f"more than one pose is given for {twice[0]!r}")
        if any(one.any_of is not None for one in self.any_of or ()):
            raise ValueError("expected no any_of inside of any_of")
        if any(one.joints or one.alignment or one.all_of for one in self.all_of or ()):
            raise ValueError("expected poses, grasps or any_of inside of all_of")
        return self

    @property
    def approaches(self) -> dict[str, Vector]:
        """Frames that go straight to their poses -> displacement along their own axes [m].

        Raises:
            ParameterError: The goals in ``any_of`` have different ones.
        """
        if self.all_of is not None:
            return {frame: by for one in self.all_of for frame, by in one.approaches.items()}
        if self.grasp is not None:
            return {} if self.grasp.approach is None else {self.grasp.hand: self.grasp.approach}
        each = [one.approaches for one in self.any_of or ()]
        each = each or [{pose.frame: pose.approach for pose in self.poses or () if pose.approach is not None}]
        if any(one != each[0] for one in each):
            raise ParameterError("approach", each, "the same frames and approaches in all goals of any_of")
        return each[0]

    @property
    def before_approach(self) -> Goal:
        """The goal with the poses where approaches start, and without these."""
        for kind in ("any_of", "all_of"):
            if (several := getattr(self, kind)) is not None:
                return self.model_copy(update={kind: tuple(one.before_approach for one in several)})
        if self.grasp is not None and self.grasp.approach is not None:
            moved = {"approach": None, "remaining": self.grasp.approach}
            return self.model_copy(update={"grasp": self.grasp.model_copy(update=moved)})
        poses = None if self.poses is None else tuple(pose.before_approach for pose in self.poses)
        return self.model_copy(update={"poses": poses})

    def with_joints(self, values: Mapping[str, float]) -> Goal:
        """Return the goal with values of joints that its joint configurations leave out."""
        if self.any_of is not None:
            return Goal(any_of=tuple(one.with_joints(values) for one in self.any_of))
        return self if self.joints is None else Goal(joints=tuple({**values, **given} for given in self.joints))


NamedGoal = Annotated[Goal, BeforeValidator(_named, json_schema_input_type=Goal | str)]
"""A goal; in files the name of a pose of the robot, too."""


class MoveStep(MotionStep):
    """A motion to a further goal, by the planner.

    Attributes:
        goal: The goal; joints that one by joint names leaves out stay.
        group: Groups and joints that may move; all by default.
    """

    kind: Literal["move"] = "move"
    goal: NamedGoal
    group: Names | None = None

    @property
    def subject(self) -> str:
        """What is moved, or the kind of goal."""
        if self.goal.any_of is not None:
            return counted(len(self.goal.any_of), "goal")
        if self.goal.all_of is not None:
            return " and ".join(MoveStep(goal=one).subject for one in self.goal.all_of)
        if self.goal.grasp is not None:
            return f"{self.goal.grasp.hand} to {self.goal.grasp.object}"
        if self.goal.poses is not None:
            return " and ".join(pose.frame for pose in self.goal.poses)
        if self.goal.alignment is None:
            return "joints"
        sides = self.goal.alignment.first, self.goal.alignment.second
        return " and ".join(one.link if isinstance(one, WorldVector) else one for one in sides)


AnyStep = Annotated[MoveStep | SimultaneousStep | SceneStep | TogetherStep, Field(discriminator="kind")]
"""A step after the goal in a problem file."""


def _goal_or_steps(schema: dict[str, Any]) -> None:
    """Require a goal or steps in files."""
    schema["required"].remove("goal")
    schema["anyOf"] = [{"required": ["goal"]}, {"required": ["after"]}]


class Problem(StrictModel):
    """A motion planning problem.

    Attributes:
        name: Name of the problem.
        robot: Name of a robot that ships with the package, or path of a robot file.
        scene: Obstacles in the world frame, besides the robot's own fixtures.
        attached: Held objects.
        payload: Name of a hand or a link -> mass that is held there beside the held objects [kg], at the grasp point of
            a hand and at the origin of a link.
        allowed: Pairs of bodies that may touch and overlap: names of links, held objects, obstacles and fixtures.
        start: Joint name -> value of the start state.
        goal: The goal; by default the start, where ``after`` lists steps.
        constraints: What holds along the whole path to the goal.
        after: Steps after the goal, which :func:`apex_ompl.plan_task` plans too.
    """

    model_config = ConfigDict(json_schema_extra=_goal_or_steps)

    schema_id: Literal["apex-ompl/problem/1"] = Field(default="apex-ompl/problem/1", alias="schema")
    name: Name
    robot: str
    scene: tuple[Obstacle, ...] = ()
    attached: tuple[AttachedObject, ...] = ()
    payload: dict[Name, Mass] = {}
    allowed: tuple[BodyPair, ...] = ()
    start: JointValues
    goal: NamedGoal
    constraints: tuple[AnyConstraint, ...] = ()
    after: tuple[AnyStep, ...] = ()

    @field_validator("scene", "attached", "allowed", "constraints", "after", mode="before")
    @classmethod
    def _nothing_is_empty(cls, value: Any) -> Any:
        return () if value is None else value

    @model_validator(mode="before")
    @classmethod
    def _from_the_start(cls, data: Any) -> Any:
        if isinstance(data, Mapping) and "goal" not in data and data.get("after") and "start" in data:
            return {**data, "goal": {"joints": data["start"]}}
        return data

    @model_validator(mode="after")
    def _unique_names(self) -> Self:
        counts = Counter(body.name for body in (*self.scene, *self.attached))
        twice = min((name for name, count in counts.items() if count > 1), default=None)
        if twice is not None:
            raise ValueError(f"the name {twice!r} is given to more than one object")
        return self

    _file: str = PrivateAttr("")

    def __repr__(self) -> str:
        """Return the name, the robot, the numbers of bodies, and the kind of goal."""
        obstacles, goal = (
            counted(len(self.scene), "obstacle"),
            next(kind for kind in GOALS if getattr(self.goal, kind) is not None),
        )
        held = f"{len(self.attached)} attached" if self.attached else ""
        return one_line("Problem", repr(self.name), f"robot {self.robot!r}", obstacles, held, f"goal {goal}")

    def __eq__(self, other: object) -> bool:
        """Whether another problem is the same, wherever it was read."""
        return isinstance(other, Problem) and dict(self) == dict(other)

    __hash__ = None  # type: ignore[assignment]

    @property
    def source(self) -> str:
        """The file that the problem was read from, else its name; stands in errors."""
        return self._file or self.name

    @property
    def moving(self) -> tuple[str, ...]:
        """Names of the obstacles that move."""
        return tuple(o.name for o in self.scene if o.moving)

    @property
    def still(self) -> Problem:
        """The problem without the obstacles that move, and without pairs that name them."""
        pairs = tuple(pair for pair in self.allowed if not {*pair} & {*self.moving})
        return self.model_copy(update={"scene": tuple(o for o in self.scene if not o.moving), "allowed": pairs})

    def start_state(self, joint_names: Sequence[str]) -> Array:
        """Return the start in the order of ``joint_names``, shape (dof,).

        Raises:
            FileFormatError: A joint is missing or unknown.
        """
        return _in_order(self.start, joint_names, self.source, "start")

    def goal_states(self, joint_names: Sequence[str]) -> Array:
        """Return the goals in the order of ``joint_names``, shape (goals, dof); none for other kinds of goals.

        Raises:
            FileFormatError: A joint is missing or unknown.
        """
        several = len(self.goal.joints or ()) > 1
        rows = []
        for k, values in enumerate(self.goal.joints or ()):
            field = f"goal.joints.{k}" if several else "goal.joints"
            rows.append(_in_order(values, joint_names, self.source, field))
        return np.array(rows).reshape(-1, len(joint_names))

    @classmethod
    def load(cls, path: str | os.PathLike[str], poses_of: Callable[[str], Poses] | None = None) -> Problem:
        """Read a problem file; its paths become absolute, and ``poses_of`` returns the named poses of a robot.

        Raises:
            MissingFileError: The file, or a mesh that it names, cannot be read.
            FileFormatError: The file does not follow the schema; the message names the field.
        """
        path = Path(path_text(path))
        data, folder = read_yaml(path, "problem file"), path.resolve().parent
        check_version(data, SCHEMA, path)
        poses = None if poses_of is None else partial(_poses, poses_of, data.get("robot"), folder)
        problem = validate(cls, data, str(path), poses)
        problem._file = str(path)
        return problem._located(folder)

    @classmethod
    def parse(cls, data: dict[str, Any], source: str) -> Problem:
        """Return the problem in the content of a file; ``source`` is the file, for errors.

        Raises:
            FileFormatError: The content does not follow the schema; the message names the field.
        """
        problem = validate(cls, data, source)
        problem._file = source
        return problem

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the problem as YAML, under a temporary name first.

        Raises:
            MissingFileError: The folder is missing or cannot be written.
        """
        write_atomically(Path(path_text(path)), self.to_yaml().encode())

    def to_yaml(self) -> str:
        """Return the YAML text of the problem."""
        return dump_yaml(self.as_dict())

    def as_dict(self) -> dict[str, Any]:
        """Return the problem as plain data in the form of its file."""
        data = self.model_dump(by_alias=True, exclude_none=True, exclude_defaults=True)
        head = {"schema": SCHEMA, "name": data.pop("name"), "robot": data.pop("robot")}
        goals = data["goal"].get("joints", ())
        if goals:
            data["goal"]["joints"] = goals[0] if len(goals) == 1 else list(goals)
        return head | data

    def _located(self, folder: Path) -> Problem:
        update: dict[str, Any] = {
            "scene": tuple(located(o, folder) for o in self.scene),
            "attached": tuple(located(o, folder) for o in self.attached),
        }
        return self.model_copy(update=update | {"robot": _robot_file(self.robot, folder)})


def _robot_file(robot: str, folder: Path) -> str:
    """Return the name of a robot, or the path of its file from that in a folder."""
    return os.path.normpath(folder / robot) if robot.endswith((".yaml", ".yml")) else robot


def _poses(poses_of: Callable[[str], Poses], robot: Any, folder: Path) -> Poses:
    """Return the named poses of the robot of a file; none where its field is faulty, which is reported then."""
    return poses_of(_robot_file(robot, folder)) if isinstance(robot, str) else {}


def _hint(name: str, known: Iterable[str]) -> str:
    near = nearest_name(name, known)
    return f"did you mean {near!r}?" if near else f"known: {', '.join(known)}"


def _in_order(values: Mapping[str, float], joint_names: Sequence[str], source: str, field: str) -> Array:
    unknown = [name for name in values if name not in joint_names]
    if unknown:
        raise FileFormatError(source, field, unknown[0], f"unknown joint, {_hint(unknown[0], joint_names)}")
    missing = [name for name in joint_names if name not in values]
    if missing:
        raise FileFormatError(
            source, field, f"{len(values)} of {len(joint_names)} joints", f"joint {missing[0]!r} is missing"
        )
    return np.array([values[name] for name in joint_names], float)
