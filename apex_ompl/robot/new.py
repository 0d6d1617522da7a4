"""New robot files from URDFs: groups, home, hands and locked joints, by the SRDF where there is one, else guessed."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from string import ascii_lowercase, ascii_uppercase
from typing import Any, NamedTuple

import numpy as np

from apex_ompl.errors import ParameterError, RobotError
from apex_ompl.robot import guesses
from apex_ompl.robot.config import PAIRS_SCHEMA, SCHEMA, RobotConfig, resolve
from apex_ompl.robot.description import XACRO, Description, Semantics, expanded, read_description, read_semantics
from apex_ompl.robot.home import Home, find_home
from apex_ompl.robot.model import build_robot
from apex_ompl.robot.self_collision import ALWAYS, SelfCollision, shares_by_links
from apex_ompl.util.display import counted
from apex_ompl.util.files import check_writable, suffix_of, write_atomically
from apex_ompl.util.schema import validate, yaml_value
from apex_ompl.util.validation import number_array

SUFFIX = ".robot.yaml"
SAMPLES = 1000  # random states of the search for pairs that always touch, and for a home
OFTEN = 0.02  # share of states from which a pair that touches is named
PLACE = "x,y,z,yaw, finite numbers [m, rad]"  # as --at expects it
NAMED = 5  # unknown names of an SRDF that a note has
NUMBERS = ("dual", "three", "four", "five", "six")


class Source(NamedTuple):
    """A URDF of a new robot.

    Attributes:
        urdf: Its path, ``package://`` URI, or a xacro file.
        srdf: Its SRDF, or None.
        place: x, y, z [m] and yaw [rad] of its root in the world.
    """

    urdf: str
    srdf: str | None = None
    place: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)


class NewRobot(NamedTuple):
    """Files of a new robot, and what was guessed.

    Attributes:
        file: The robot file.
        files: All files that were written.
        notes: What was guessed, a sentence each.
        dof: Number of planned joints.
    """

    file: Path
    files: tuple[Path, ...]
    notes: tuple[str, ...]
    dof: int


@dataclass
class _Part:
    """A URDF with its prefix and what was read."""

    source: Source
    file: Path  # of the URDF, or of what xacro made of it
    urdf: str  # as the robot file names it
    text: str | None  # of the URDF that is to be written
    robot: Description
    semantics: Semantics | None
    name: str = ""
    prefix: str = ""
    arms: list[guesses.Arm] = field(default_factory=list)


def sources_of(urdfs: Sequence[str], srdfs: Sequence[str] = (), places: Sequence[Sequence[float]] = ()) -> list[Source]:
    """Return the URDFs of a robot with their SRDFs and places.

    Args:
        urdfs: One or several.
        srdfs: None, one for all, or one for each.
        places: x, y, z, yaw of each; may be left out for a single one.

    Raises:
        ParameterError: The numbers of them do not agree, or a place is not four finite numbers.
    """
    if not urdfs:
        raise ParameterError("URDF", list(urdfs), "one or more")
    if len(srdfs) not in (0, 1, len(urdfs)):
        raise ParameterError("--srdf", list(srdfs), f"none, one for all, or one for each of {len(urdfs)} URDFs")
    if len(places) != len(urdfs) and (places or len(urdfs) > 1):
        raise ParameterError("--at", list(places), f"one for each of {len(urdfs)} URDFs")
    found = []
    for k, urdf in enumerate(urdfs):
        place = number_array(list(places[k]), "--at", "x,y,z,yaw") if places else np.zeros(4)
        if place.shape not in ((3,), (4,)) or not np.isfinite(place).all():
            raise ParameterError("--at", list(places[k]), PLACE)
        x, y, z, yaw = (*map(float, place), 0.0)[:4]
        srdf = None if not srdfs else srdfs[0] if len(srdfs) == 1 else srdfs[k]
        found.append(Source(urdf, srdf, (x, y, z, yaw)))
    return found


def new_robot(
    sources: Sequence[Source], output: Path | None = None, packages: Mapping[str, Path] | None = None, seed: int = 0
) -> NewRobot:
    """Write the robot file of one or several URDFs, and its file of disabled pairs where there are some.

    Args:
        sources: The URDFs.
        output: The robot file; by default NAME.robot.yaml in the current folder.
        packages: Package name -> folder, for ``package://NAME/...``.
        seed: Of the search for a home.

    Raises:
        ParameterError: The output has another suffix, or exists.
        MissingFileError: A file is missing, or the output cannot be written.
        RobotError: A URDF is faulty, or no joints to plan for are found.
    """
    packages = packages or {}
    parts = [_read(source, packages) for source in sources]
    for part in parts:
        part.arms = guesses.arms_of(part.robot, part.semantics)
        if not part.arms:
            raise RobotError(
                f"{part.file}: expected a chain of {guesses.FEWEST} or more joints that are no fingers, legs or wheels"
                ", or a group of them in an SRDF"
            )
    _name_parts(parts)
    name = _robot_name(parts) if output is None else _stem(output)
    output = Path(f"{name}{SUFFIX}") if output is None else output
    suffix_of(output, (".yaml", ".yml"))
    check_writable(output)
    if output.exists():
        raise ParameterError("output", str(output), "a new file, this one exists")
    return _Writer(parts, name, output, packages, seed).write()


def _stem(output: Path) -> str:
    stem = re.sub(r"(\.robot)?\.ya?ml$", "", output.name)
    return re.sub(r"[^A-Za-z0-9_.-]", "_", stem).lstrip("_.-") or "robot"


def _read(source: Source, packages: Mapping[str, Path]) -> _Part:
    file = resolve(source.urdf, Path.cwd(), "URDF", packages).resolve()
    text = expanded(file) if file.suffix.lower() == XACRO else None
    given = source.urdf if source.urdf.startswith("package://") and text is None else str(file)
    robot = read_description(file, text)
    srdf = resolve(source.srdf, Path.cwd(), "SRDF", packages).resolve() if source.srdf else None
    return _Part(source, file, given, text, robot, read_semantics(srdf, robot) if srdf else None)


def _name_parts(parts: list[_Part]) -> None:
    """Give parts their names, and prefixes where names of links, joints, groups or hands collide."""
    letters = ascii_lowercase + ascii_uppercase
    if len(parts) > len(letters):
        raise ParameterError("URDF", f"{len(parts)} of them", f"at most {len(letters)}")
    names = [
        {*part.robot.links, *part.robot.joints, *(name for arm in part.arms for name in (arm.group, arm.hand))}
        for part in parts
    ]
    common = any(names[i] & names[j] for i in range(len(names)) for j in range(i))
    for k, part in enumerate(parts):
        part.name = _part_name(part)
        if common:
            part.prefix = f"{letters[k]}_"
    if common and len(parts) == 2:
        across = [part.source.place[1] for part in parts]
        left = int(np.argmax(across))
        for k, part in enumerate(parts):
            part.prefix = "left_" if k == left else "right_"
    if common or len({part.name for part in parts}) < len(parts):
        for k, part in enumerate(parts):
            part.name = (part.prefix or f"{letters[k]}_") + part.name


def _part_name(part: _Part) -> str:
    given = part.robot.name or part.file.stem
    return re.sub(r"[^A-Za-z0-9_]", "_", given).strip("_") or "robot"


def _robot_name(parts: list[_Part]) -> str:
    first = _part_name(parts[0])
    if len(parts) == 1:
        return first
    count = NUMBERS[len(parts) - 2] if len(parts) - 2 < len(NUMBERS) else str(len(parts))
    return f"{count}_{first}"


class _Writer:
    """Composes the robot file."""

    def __init__(
        self, parts: list[_Part], name: str, output: Path, packages: Mapping[str, Path], seed: int
    ) -> None:  # fmt: skip
        self.parts, self.name, self.output, self.seed = parts, name, output.resolve(), seed
        self.packages = packages
        self.notes: list[str] = []
        self.comments: dict[str, str] = {}  # of joints, hands and groups
        self.carriers: dict[str, dict[str, float]] = {}  # locked joints that carry arms
        self.states: dict[str, float] = {}  # of the SRDFs
        self.texts: dict[Path, str] = {}
        self.data: dict[str, Any] = {
            "schema": SCHEMA, "name": name, "parts": [], "joints": {}, "locked": {}, "groups": {}, "hands": {}
        }  # fmt: skip
        if packages:
            self.data["packages"] = {key: str(path) for key, path in packages.items()}

    def write(self) -> NewRobot:
        """Write the files; none of them where something fails."""
        for part in self.parts:
            self._add(part)
        temporary: list[Path] = []
        try:
            for path, text in self.texts.items():  # URDFs by xacro, which the robot is built from
                if path.exists():
                    raise ParameterError("output", str(path), "a new file, this one exists")
                write_atomically(path, text.encode())
                temporary.append(path)
            pairs, dof = self._search()
            files = [self.output, *temporary]
            if pairs:
                files.append(self._pairs_file())
                write_atomically(files[-1], pairs_text(pairs, "apex-ompl robot new").encode())
                temporary.append(files[-1])
                self.data["disabled_pairs"] = files[-1].name
            write_atomically(self.output, self._text().encode())
        except BaseException:
            for path in temporary:
                path.unlink(missing_ok=True)
            raise
        return NewRobot(self.output, tuple(files), tuple(self.notes), dof)

    def _pairs_file(self) -> Path:
        return self.output.with_name(f"{_stem(self.output)}.pairs.yaml")

    def _add(self, part: _Part) -> None:
        robot, prefix = part.robot, part.prefix
        urdf = part.urdf
        if part.text is not None:
            path = self.output.with_name(f"{part.name}.urdf")
            self.texts[path] = _absolute(part.text, part.file.parent)
            urdf = path.name
            self.notes.append(f"{part.file} was expanded by xacro with its default arguments into {path.name}")
        record: dict[str, Any] = {"name": part.name, "urdf": _relative(urdf, self.output.parent)}
        if part.source.srdf:
            srdf = part.source.srdf
            record["srdf"] = srdf if "://" in srdf else _relative(str(Path(srdf).resolve()), self.output.parent)
        if prefix:
            record["prefix"] = prefix
        x, y, z, yaw = part.source.place
        if (x, y, z) != (0.0, 0.0, 0.0):
            record["position"] = [x, y, z]
        if yaw:
            record["orientation"] = [0.0, 0.0, math.sin(yaw / 2.0), math.cos(yaw / 2.0)]
        self.data["parts"].append(record)
        state: dict[str, float] = {}
        if part.semantics is not None and part.semantics.unknown:
            some, more = part.semantics.unknown[:NAMED], len(part.semantics.unknown) - NAMED
            names = ", ".join(some) + f" and {more} more" * (more > 0)
            self.notes.append(f"{part.source.srdf} names what the URDF does not have: {names}")
        for arm in part.arms:
            self._add_arm(part, arm)
            title, values = guesses.preferred_state(part.semantics, arm.joints)
            if title:
                self.notes.append(f"{prefix}{arm.group}: home by the state {title!r} of the SRDF")
            state |= values
        planned = [joint for arm in part.arms for joint in arm.joints]
        self.states |= {prefix + joint: state[joint] for joint in planned if joint in state}
        locked = guesses.locked_values(robot, planned, state)
        self.data["locked"] |= {prefix + joint: value for joint, value in locked.items()}
        for joint in guesses.carriers(robot, part.arms):
            self.carriers[prefix + joint] = {"home": locked[joint]} | guesses.joint_record(robot.joints[joint])[0]
            self.notes.append(f"{prefix}{joint} carries arms and is locked; a commented line in the file plans it")
        if guesses.drives(robot):
            self.notes.append(f"{part.name} stands still; planar: {{x: [-2, 2], y: [-2, 2]}} in its part lets it drive")

    def _add_arm(self, part: _Part, arm: guesses.Arm) -> None:
        group, hand = part.prefix + arm.group, part.prefix + arm.hand
        self.data["groups"][group] = [part.prefix + joint for joint in arm.joints]
        self.comments[f"groups.{group}"] = arm.note
        self.notes.append(f"{group}: {arm.note}")
        record, note = guesses.hand_of(part.robot, arm)
        self.data["hands"][hand] = record | {"palm": self._link(part, record["palm"])}
        self.comments[f"hands.{hand}"] = f"guessed: {note}"
        self.notes.append(f"{hand}: {note}, guessed")
        for joint in arm.joints:
            name = part.prefix + joint
            self.data["joints"][name], assumed = guesses.joint_record(part.robot.joints[joint])
            if assumed:
                self.comments[f"joints.{name}"] = "; ".join(assumed)
                self.notes.append(f"{name}: {'; '.join(assumed)}")

    def _link(self, part: _Part, link: str) -> str:
        name = part.prefix + link
        return f"{part.name}_world" if name == "world" else name

    def _search(self) -> tuple[list[tuple[tuple[str, str], str]], int]:
        """Find pairs that always touch and a home; return the pairs with their reasons, and the number of joints."""
        config = validate(RobotConfig, self._with_homes(), str(self.output))
        robot = build_robot(config, self.output)
        checks = SelfCollision(robot)
        states = _near(robot.random_state(np.random.default_rng(self.seed), SAMPLES))
        states = np.clip(states, robot.limits.lower, robot.limits.upper)
        hits = checks.hits(states)
        shares = shares_by_links(robot, checks.pairs, hits)
        always = {links: share for links, share in shares.items() if share >= ALWAYS}
        for links, share in sorted(shares.items(), key=lambda one: -one[1]):
            if OFTEN < share < ALWAYS and _adjacent(self.parts, links):
                self.notes.append(
                    f"{' and '.join(links)} are adjacent and touch in {share:.0%} of random states: check"
                )
        home = find_home(robot, always, states, hits, self.states)
        self._note_home(home)
        for name, value in zip(robot.joint_names, home.q, strict=True):
            self.data["joints"][name] = {"home": value} | self.data["joints"][name]
        pairs = [(links, f"touch in {share:.0%} of {SAMPLES} random states") for links, share in sorted(always.items())]
        if pairs:
            self.notes.append(
                f"{counted(len(pairs), 'pair')} of links that touch at {ALWAYS:.0%} or more of random states: disabled"
            )
        return pairs, robot.dof

    def _with_homes(self) -> dict[str, Any]:
        """Return the data with a home inside the limits of each joint."""
        homes = {}
        for part in self.parts:
            for arm in part.arms:
                for joint in arm.joints:
                    record = self.data["joints"][part.prefix + joint]
                    low = record.get("lower", part.robot.joints[joint].lower)
                    high = record.get("upper", part.robot.joints[joint].upper)
                    homes[part.prefix + joint] = {"home": min(max(0.0, low), high)} | record
        return self.data | {"joints": homes}

    def _note_home(self, home: Home) -> None:
        self.comments["home"] = home.note
        self.notes.append(home.note)

    def _text(self) -> str:
        """Return the robot file."""
        data = self.data
        lines = [
            "# by apex-ompl robot new; lines marked (guessed) are worth a look", f"schema: {data['schema']}",
            f"name: {data['name']}", "parts:",
        ]  # fmt: skip
        lines += [f"  - {_flow(record)}" for record in data["parts"]]
        if "packages" in data:
            lines.append(f"packages: {_flow(data['packages'])}")
        lines += [
            "# Limits of position and velocity are the URDF's unless they are given here. Accelerations and jerks are",
            f"# assumed (guessed): {guesses.RAMP:g} and {guesses.JERK:g} times the velocity.",
            f"# Home: {_on_one_line(self.comments['home'])}.", "joints:",
        ]  # fmt: skip
        lines += [self._line("joints", name, record, " (guessed)") for name, record in data["joints"].items()]
        lines += [
            f"  # {_flow(name)}: {_flow(record)}  # carries arms; to plan it, delete it from locked"
            for name, record in self.carriers.items()
        ]
        if data["locked"]:
            lines += [
                "# Joints that are not planned for; those that mimic them are locked with them. (guessed)",
                "locked:",
            ]
            lines += [self._line("locked", name, value) for name, value in data["locked"].items()]
        lines.append("groups:")
        lines += [self._line("groups", name, members) for name, members in data["groups"].items()]
        lines.append("hands:  # palm link; in its frame grasp point, closing side and direction of the fingers")
        lines += [self._line("hands", name, record) for name, record in data["hands"].items()]
        if "disabled_pairs" in data:
            lines.append(f"disabled_pairs: {_flow(data['disabled_pairs'])}")
        return "\n".join(lines) + "\n"

    def _line(self, section: str, name: str, value: Any, mark: str = "") -> str:
        comment = self.comments.get(f"{section}.{name}", "")
        return f"  {_flow(name)}: {_flow(value)}" + (f"  # {_on_one_line(comment)}{mark}" if comment else "")


def _near(states: np.ndarray) -> np.ndarray:
    """Return states with turning joints within half a turn where they have more."""
    return np.where(np.abs(states) > math.pi, np.mod(states + math.pi, 2.0 * math.pi) - math.pi, states)


def _adjacent(parts: list[_Part], links: tuple[str, str]) -> bool:
    """Whether one joint that is not fixed is between two links."""
    for part in parts:
        names = [link.removeprefix(part.prefix) for link in links if link.startswith(part.prefix)]
        if len(names) == 2 and {*names} <= {*part.robot.links}:
            chains = [[joint for joint in part.robot.ancestors(name) if joint.kind != "fixed"] for name in names]
            between = {joint.name for joint in chains[0]} ^ {joint.name for joint in chains[1]}
            return len(between) == 1
    return False


def _on_one_line(text: str) -> str:
    """Return a comment on one line."""
    return " ".join(text.split())


def _relative(path: str, folder: Path) -> str:
    """Return a path relative to a folder where it is inside, else as it is."""
    if "://" in path or not Path(path).is_absolute():
        return path
    return str(Path(path).relative_to(folder)) if Path(path).is_relative_to(folder) else path


def _absolute(text: str, folder: Path) -> str:
    """Return a URDF with absolute paths of meshes in place of those relative to a folder."""

    def moved(match: re.Match[str]) -> str:
        path = match[1]
        return match[0] if "://" in path or Path(path).is_absolute() else f'filename="{folder / path}"'

    return re.sub(r'filename="([^"]*)"', moved, text)


def _flow(value: Any) -> str:
    """Return plain data as YAML on one line."""
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{_flow(key)}: {_flow(inner)}" for key, inner in value.items()) + "}"
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(map(_flow, value)) + "]"
    if isinstance(value, float):
        return f"{value:.12g}"
    text = str(value)
    plain = re.fullmatch(r"[A-Za-z0-9_./+-][A-Za-z0-9_./:+ -]*", text) and ": " not in text and text == text.strip()
    return text if plain and yaml_value(text) == text else json.dumps(text)


def pairs_text(pairs: Sequence[tuple[tuple[str, str], str]], command: str, robot: str = "") -> str:
    """Return a file of disabled pairs.

    Args:
        pairs: Links of each, and the reason.
        command: The command that makes it.
        robot: The digest of the robot that it is made for.
    """
    lines = [f"schema: {PAIRS_SCHEMA}", f"command: {_flow(command)}"]
    lines += [f"robot: {json.dumps(robot)}"] if robot else []
    lines.append("pairs:" if pairs else "pairs: []")
    lines += [f"  - {{links: {_flow(list(links))}, reason: {json.dumps(reason)}}}" for links, reason in pairs]
    return "\n".join(lines) + "\n"
