"""Robot files: URDF parts, planned joints, limits, fixtures and disabled collision pairs, and where files are found."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, PositiveFloat, model_validator

from apex_ompl.errors import MissingFileError
from apex_ompl.scene.bodies import Body, Name, Quaternion, Vector, located
from apex_ompl.util.files import is_file
from apex_ompl.util.schema import StrictModel, check_version, read_yaml, validate

SCHEMA = "apex-ompl/robot/1"
HOME = "home"  # name of the pose that the homes of the joints are
PAIRS_SCHEMA = "apex-ompl/disabled-pairs/1"


WIDEST = 1e4
"""Largest position of a joint [rad or m]; sines of larger ones are not exact enough for proofs."""
DATA = Path(__file__).parent / "data"
EXTRA = "example-robot-data"  # the package of the extra


class Joint(StrictModel):
    """A planned joint and its limits [rad, rad/s, rad/s^2, rad/s^3, Nm; no limit of jerk or effort is ``.inf``].

    Positions and velocity are by default those of the URDF. Limits wider than ``WIDEST``, by which URDFs say that a
    joint has none, are narrowed to it. Efforts of URDFs are often placeholders, so that a joint whose effort the robot
    file does not give has no limit of it.
    """

    home: float = 0.0
    lower: float | None = None
    upper: float | None = None
    velocity: PositiveFloat | None = None
    acceleration: PositiveFloat
    jerk: Annotated[float, Field(gt=0.0, allow_inf_nan=True)]
    effort: Annotated[float, Field(gt=0.0, allow_inf_nan=True)] = math.inf


class Planar(StrictModel):
    """A base that drives on a plane: planned joints PART_x, PART_y and PART_yaw, which turns without end.

    Attributes:
        x: Range along x of the frame that carries the base [m].
        y: Range along y [m].
        velocity: Largest velocity along x and y, and about z [m/s, rad/s].
        acceleration: The same for accelerations [m/s^2, rad/s^2].
        jerk: The same for jerks [m/s^3, rad/s^3].
    """

    x: tuple[float, float]
    y: tuple[float, float]
    velocity: tuple[PositiveFloat, PositiveFloat] = (0.5, 1.0)
    acceleration: tuple[PositiveFloat, PositiveFloat] = (0.5, 1.0)
    jerk: tuple[PositiveFloat, PositiveFloat] = (5.0, 10.0)

    @model_validator(mode="after")
    def _ranges(self) -> Self:
        for name, (low, high) in (("x", self.x), ("y", self.y)):
            if not low < high:
                raise ValueError(f"{name}: expected a range with lowest < highest, got {low:g} and {high:g}")
        return self

    def joints(self, part: str) -> dict[str, Joint]:
        """Return the joints of the base of a part, x, y and yaw, by name."""
        found = {}
        for axis, ends, k in (("x", self.x, 0), ("y", self.y, 0), ("yaw", (None, None), 1)):
            low, high = ends
            home = 0.0 if low is None or high is None else min(max(0.0, low), high)
            found[f"{part}_{axis}"] = Joint(
                home=home, lower=low, upper=high,
                velocity=self.velocity[k], acceleration=self.acceleration[k], jerk=self.jerk[k],
            )  # fmt: skip
        return found


class Part(StrictModel):
    """A URDF that is mounted on the world or on a link of an earlier part.

    Attributes:
        name: Name of the part.
        urdf: URDF file, as a ``package://`` URI or a path relative to the robot file.
        srdf: SRDF file whose ``disable_collisions`` are used.
        prefix: Prefix of the names of all links and joints.
        rename: Old -> new start of names, replaced before ``prefix`` is added.
        remove: Links that are removed together with their descendants.
        parent: ``world``, or the link of an earlier part that carries this one.
        position: Placement of the part's root link in ``parent`` [m].
        orientation: The same, quaternion xyzw.
        planar: The root link drives on the plane z = 0 of that placement.
    """

    name: Name
    urdf: str
    srdf: str | None = None
    prefix: str = ""
    rename: dict[str, str] = {}
    remove: tuple[str, ...] = ()
    parent: str = "world"
    position: Vector = (0.0, 0.0, 0.0)
    orientation: Quaternion = (0.0, 0.0, 0.0, 1.0)
    planar: Planar | None = None


class Hand(StrictModel):
    """A hand that can hold objects.

    Attributes:
        synergy: The planned joint that closes the hand from 0 (open) to 1 (closed), or None for a rigid hand.
        palm: The link that held objects are fixed to.
        point: Grasp point in the palm's frame [m].
        axis: Outward unit normal of the palm on its closing side, in the palm's frame.
        fingers: Unit direction of the open fingers, in the palm's frame.
        jaws: Links of a parallel gripper -> their displacement from open, as they are locked, to closed, in their own
            frames [m]. Plans keep them open; in physics they close on what a step grasps.
        force: Force of each jaw [N].
    """

    synergy: str | None = None
    palm: str
    point: Vector
    axis: Vector
    fingers: Vector
    jaws: dict[Name, Vector] = {}
    force: PositiveFloat = 30.0

    @model_validator(mode="after")
    def _jaws_move(self) -> Self:
        if self.jaws and self.synergy is not None:
            raise ValueError("expected either a synergy or jaws, not both")
        for link, way in self.jaws.items():
            if not any(way):
                raise ValueError(f"expected a displacement of the jaw {link!r} that is not zero")
        return self


class RobotConfig(StrictModel):
    """The content of a robot file.

    Attributes:
        name: Name of the robot.
        description: One line about it.
        parts: The URDFs that the robot is composed of.
        fixtures: Solids that are fixed beside the robot, such as the tables that it stands on.
        joints: The planned joints in state order.
        locked: Joint name -> value of joints that become fixed joints.
        groups: Named groups of planned joints.
        hands: Hands by name.
        poses: Named states: joint name -> value; joints that one leaves out are at home. ``home`` is there already.
        disabled_pairs: File of further link pairs that are not checked for collision.
        covers: File of sphere covers of the links; without it coarser covers are made at run time.
        model: Folder of the checkpoint of a model that was trained for the robot, relative to the robot file.
        packages: Package name -> its folder, for ``package://NAME/...``; relative to the robot file.
    """

    schema_id: Literal["apex-ompl/robot/1"] = Field(alias="schema")
    name: Name
    description: str = ""
    parts: Annotated[tuple[Part, ...], Field(min_length=1)]
    fixtures: tuple[Body, ...] = ()
    joints: Annotated[dict[str, Joint], Field(min_length=1)]
    locked: dict[str, float] = {}
    groups: dict[str, tuple[str, ...]] = {}
    hands: dict[str, Hand] = {}
    poses: dict[Name, dict[str, float]] = {}
    disabled_pairs: str | None = None
    covers: str | None = None
    model: str | None = None
    packages: dict[str, str] = {}

    def package_folders(self, folder: Path) -> dict[str, Path]:
        """Return package name -> folder for a robot file in ``folder``."""
        return {name: folder / path for name, path in self.packages.items()}

    def with_bases(self) -> RobotConfig:
        """Return the same robot with the joints of its planar bases, each a group PART_base, before all others.

        Joints that the file has of a base replace those of ``planar``, at their place.
        """
        bases = {part.name: part.planar.joints(part.name) for part in self.parts if part.planar is not None}
        added = {name: joint for base in bases.values() for name, joint in base.items() if name not in self.joints}
        groups = {f"{part}_base": tuple(base) for part, base in bases.items()}
        return self.model_copy(update={"joints": added | self.joints, "groups": groups | self.groups})

    @model_validator(mode="after")
    def _known_joints(self) -> Self:
        joints = self.with_bases().joints
        for group, names in self.groups.items():
            for name in names:
                if name not in joints:
                    raise ValueError(f"group {group!r} names the unknown joint {name!r}")
        for pose, values in self.poses.items():
            for name in values:
                if name not in joints:
                    raise ValueError(f"pose {pose!r} names the unknown joint {name!r}")
        if HOME in self.poses:
            raise ValueError(f"expected {HOME!r} as the home of each joint and not among the poses")
        for hand, record in self.hands.items():
            if record.synergy is not None and record.synergy not in self.joints:
                raise ValueError(f"hand {hand!r} names the unknown joint {record.synergy!r}")
        return self


class DisabledPair(StrictModel):
    """Two links that are not checked for collision, with the reason."""

    links: tuple[str, str]
    reason: str


class DisabledPairs(StrictModel):
    """A file of disabled pairs.

    Attributes:
        command: The command that made it.
        robot: The digest of the robot that it was made for.
    """

    schema_id: Literal["apex-ompl/disabled-pairs/1"] = Field(alias="schema")
    command: str = ""
    robot: str = ""
    pairs: tuple[DisabledPair, ...]


def read_config(path: Path) -> RobotConfig:
    """Read a robot file.

    Raises:
        MissingFileError: It cannot be read.
        FileFormatError: It does not follow the schema.
    """
    data = read_yaml(path, "robot file")
    check_version(data, SCHEMA, path)
    config = validate(RobotConfig, data, str(path))
    return config.model_copy(update={"fixtures": tuple(located(f, path.parent) for f in config.fixtures)})


def read_disabled_pairs_file(path: Path) -> DisabledPairs:
    """Read a file of disabled pairs.

    Raises:
        MissingFileError: It cannot be read.
        FileFormatError: It does not follow the schema.
    """
    return validate(DisabledPairs, read_yaml(path, "file of disabled pairs"), str(path))


def read_disabled_pairs(path: Path) -> list[tuple[str, str]]:
    """Read the pairs of links of a file of disabled pairs.

    Raises:
        MissingFileError: It cannot be read.
        FileFormatError: It does not follow the schema.
    """
    return [pair.links for pair in read_disabled_pairs_file(path).pairs]


@cache
def package_roots() -> tuple[Path, ...]:
    """Folders in which ``package://NAME/...`` is looked up, in order.

    They are the entries of ``ROS_PACKAGE_PATH``, then the folder of this package that has the Panda, then the ``share``
    folder that belongs to the installed Pinocchio (the PyPI wheel of ``example-robot-data`` has no Python module and
    installs its files there).
    """
    import pinocchio

    roots = [Path(p) for p in os.environ.get("ROS_PACKAGE_PATH", "").split(os.pathsep) if p]
    roots.append(DATA / "packages")
    roots += [parent / "share" for parent in Path(pinocchio.__file__).resolve().parents]
    return tuple(root for root in roots if root.is_dir())


def resolve(uri: str, relative_to: Path, role: str, packages: Mapping[str, Path] | None = None) -> Path:
    """Return the file that ``uri`` names.

    Args:
        uri: ``package://NAME/path``, ``file:///path``, an absolute path, or a path relative to
            ``relative_to``.
        relative_to: Folder for relative paths.
        role: Description of the file for the error.
        packages: Package name -> its folder. Packages that are not named are looked up in :func:`package_roots`, then
            in the folders above ``relative_to`` and beside them.

    Raises:
        MissingFileError: No such file.
    """
    if uri.startswith("package://"):
        rest = uri.removeprefix("package://")
        package, _, inside = rest.partition("/")
        places = [packages[package] / inside] if packages and package in packages else []
        places += [root / rest for root in package_roots()]
        for above in (here := relative_to.resolve(), *here.parents):  # in the package, or in one beside it
            places += [above / inside] * (above.name == package) + [above / rest]
        found = next(filter(is_file, places), None)
        if found is not None:
            return found
        extra = ", as the extra 'robots' of apex_ompl does" if package == EXTRA else ""
        raise MissingFileError(uri, role, f"not under any package folder; is {package!r} installed{extra}?")
    path = Path(uri.removeprefix("file://"))
    path = path if path.is_absolute() else relative_to / path
    if not is_file(path):
        raise MissingFileError(str(path), role)
    return path
