"""Robots: kinematic model, collision geometry and checked pairs, limits, hands, and identity.

The identity of a robot is a digest of everything that plans depend on. It tells whether the robot that a file describes
is the one that a result was made with.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import combinations
from pathlib import Path

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from apex_ompl.errors import FileFormatError, RobotError, UnknownNameError
from apex_ompl.robot.compose import compose
from apex_ompl.robot.config import DATA, HOME, WIDEST, Hand, RobotConfig, read_config, read_disabled_pairs, resolve
from apex_ompl.robot.description import unreadable_mesh
from apex_ompl.robot.joint_order import name_back, names_in_order
from apex_ompl.scene.bodies import Body
from apex_ompl.scene.meshes import extent_fault
from apex_ompl.types import Array, Flags
from apex_ompl.util.arrays import narrowed
from apex_ompl.util.cache import weakly_cached
from apex_ompl.util.display import counted, html_table, one_line
from apex_ompl.util.forking import ProcessLock
from apex_ompl.util.validation import degrees_hint, number_array, shape_error

SHORTEST_RAMP = 1e-6  # from no acceleration to the largest, for motions whose knots have distinct times [s]
LIMIT_SLACK = 1e-3  # by which a joint of a start or a goal may be outside its limits [rad; synergies 0..1]
TURN = 2.0 * np.pi  # of a continuous joint [rad]
SPEED = 2.0  # of turning joints, for weights of a robot without any [rad/s]


def link_of(model: pin.Model, item: pin.GeometryObject) -> str:
    """Return the name of the link that a geometry belongs to."""
    return str(model.frames[item.parentFrame].name)


def check_geometry(model: pin.Model, geometry: pin.GeometryModel, urdf: str, path: Path) -> None:
    """Raise a RobotError if Pinocchio has dropped collision geometry, or if a collision mesh is not a solid."""
    found = Counter(link_of(model, item) for item in geometry.geometryObjects)
    for link in ET.fromstring(urdf).findall("link"):
        name, wanted = str(link.get("name")), len(link.findall("collision"))
        if found[name] != wanted:
            raise RobotError(f"{path}: link {name!r} has {wanted} collision geometries, {found[name]} can be read")
    for item in geometry.geometryObjects:
        mesh = item.geometry
        fault = extent_fault(np.array(mesh.vertices())) if mesh.getObjectType() == coal.OT_BVH else ""
        if fault:
            raise RobotError(f"{path}: the collision mesh of link {link_of(model, item)!r} has {fault}")


def pair_up(model: pin.Model, geometry: pin.GeometryModel, disabled: Sequence[tuple[str, str]]) -> None:
    """Add a collision pair for any two geometries that move relative to each other and are not disabled."""
    skip = {frozenset(pair) for pair in disabled}
    items = list(geometry.geometryObjects)
    for i, j in combinations(range(len(items)), 2):
        a, b = items[i], items[j]
        if a.parentJoint == b.parentJoint:  # rigidly joined, or both fixed to the world
            continue
        if frozenset((link_of(model, a), link_of(model, b))) in skip:
            continue
        geometry.addCollisionPair(pin.CollisionPair(i, j))


@dataclass(frozen=True)
class Limits:
    """Limits of the planned joints, each of shape (dof,).

    Attributes:
        lower: Lowest position [rad; synergies 0..1].
        upper: Highest position.
        velocity: Largest speed [rad/s].
        acceleration: Largest acceleration [rad/s^2].
        jerk: Largest jerk [rad/s^3]; infinity for no limit. A jerk that reaches the largest acceleration in
            less than ``SHORTEST_RAMP`` is lowered to that.
    """

    lower: Array
    upper: Array
    velocity: Array
    acceleration: Array
    jerk: Array

    def __post_init__(self) -> None:
        """Lower jerks that are too large to be told from no limit."""
        object.__setattr__(self, "jerk", np.minimum(self.jerk, np.asarray(self.acceleration) / SHORTEST_RAMP))

    def __repr__(self) -> str:
        """Return the number of joints and the range of their largest speeds."""
        slowest, fastest = np.min(self.velocity), np.max(self.velocity)
        return one_line(
            "Limits", counted(len(self.velocity), "joint"), f"velocity {slowest:.3g} to {fastest:.3g} rad/s or m/s"
        )


@dataclass(frozen=True, eq=False)
class Robot:
    """A robot to plan for.

    Attributes:
        name: Name of the robot.
        joint_names: Planned joints in state order, the order of every state outside this module.
        limits: Limits in state order.
        effort: Largest torques or forces that the robot file gives, shape (dof,) [Nm, N]; infinite where it gives none.
        home: A collision-free resting state, shape (dof,).
        poses: Name -> state, shape (dof,): ``home``, and the poses of the robot file.
        groups: Group name -> indices into a state.
        hands: Hand name -> palm, grasp point and synergy.
        model: Pinocchio model; the order of its q differs from that of states, see :meth:`to_pinocchio`.
        geometry: Collision geometry of the links with the self-collision pairs, without a scene.
        fixtures: Solids that are fixed beside the robot, such as its tables.
        weights: What a unit of each joint counts in distances between states and lengths of paths, shape (dof,): 1 of
            turning joints; see :func:`weights_of` [rad/rad, rad/m].
        continuous: Which joints turn without end, shape (dof,): states that differ by whole turns of them are alike.
        part_links: Part name -> names of its links.
        urdf: The composed URDF with absolute mesh paths.
        disabled_pairs: File of pairs of links that are not checked besides those of SRDFs, or None.
        covers: File of the links' sphere covers, or None.
        checkpoint: Folder of the model that the robot file names, which need not exist, or None.
        files: Files that the robot was read from, meshes among them.
    """

    name: str
    joint_names: tuple[str, ...]
    limits: Limits
    effort: Array
    home: Array
    poses: Mapping[str, Array]
    groups: Mapping[str, NDArray[np.intp]]
    hands: Mapping[str, Hand]
    model: pin.Model
    geometry: pin.GeometryModel
    fixtures: tuple[Body, ...]
    weights: Array
    continuous: Flags
    part_links: Mapping[str, tuple[str, ...]]
    urdf: str
    disabled_pairs: Path | None
    covers: Path | None
    checkpoint: Path | None
    files: tuple[Path, ...]
    _order: NDArray[np.intp]

    def __repr__(self) -> str:
        """Return the name and the number of planned joints."""
        return one_line("Robot", repr(self.name), f"{self.dof} dof")

    def _repr_html_(self) -> str:
        """Return the joints with their limits as a table for notebooks."""
        limits = self.limits
        columns = limits.lower, limits.upper, limits.velocity, limits.acceleration, limits.jerk
        rows = [
            (name, *(f"{value:.4g}" for value in values))
            for name, *values in zip(self.joint_names, *columns, strict=True)
        ]
        head = ("joint", "lower [rad, m]", "upper", "velocity [1/s]", "acceleration [1/s^2]", "jerk [1/s^3]")
        return html_table(f"{self.name}, {counted(self.dof, 'joint')}", rows, head)

    @property
    def dof(self) -> int:
        """Number of planned joints."""
        return len(self.joint_names)

    @property
    def link_names(self) -> tuple[str, ...]:
        """Names of all links."""
        return tuple(f.name for f in self.model.frames if f.type == pin.FrameType.BODY)

    @property
    def state_order(self) -> NDArray[np.intp]:
        """Indices into a state in Pinocchio's order, shape (dof,)."""
        return self._order

    @property
    def last_links(self) -> tuple[str, ...]:
        """Last link on each joint that moves no other joint."""
        model = self.model
        ends = set(range(1, model.njoints)) - {*list(model.parents)[1:]}
        return tuple(
            {
                f.parentJoint: f.name for f in model.frames if f.type == pin.FrameType.BODY and f.parentJoint in ends
            }.values()
        )

    def to_pinocchio(self, q: Array) -> Array:
        """Return a state, shape (dof,), or states, shape (N, dof), in Pinocchio's order, as a new array.

        Raises:
            ParameterError: The number of joint values differs from ``dof``.
        """
        q = number_array(q, "state")
        if q.ndim == 0 or q.shape[-1] != len(self._order):
            raise shape_error(q, ("...", len(self._order)), "state")
        return q[..., self._order]

    def link_frame(self, link: str) -> int:
        """Return the Pinocchio frame of a link.

        Raises:
            UnknownNameError: No such link.
        """
        if not isinstance(link, str) or not self.model.existBodyName(link):
            raise UnknownNameError("link", link, self.link_names)
        return int(self.model.getFrameId(link, pin.FrameType.BODY))

    def link_pose(self, q: Array, link: str) -> Array:
        """Return the pose of a link in the world at state ``q``, shape (4, 4) [m].

        Raises:
            UnknownNameError: No such link.
            ParameterError: The state has another shape.
        """
        frame = self.model.frames[self.link_frame(link)]
        lock, data = _data_of(self.model)
        with lock:
            pin.forwardKinematics(self.model, data, self.to_pinocchio(q))
            return np.array((data.oMi[frame.parentJoint] * frame.placement).homogeneous)

    def part_of(self, link: str) -> str:
        """Return the part that a link belongs to.

        Raises:
            UnknownNameError: No such link.
        """
        for part, links in self.part_links.items():
            if link in links:
                return part
        raise UnknownNameError("link", link, self.link_names)

    def hand_of(self, link: str) -> tuple[str, ...]:
        """Return the links of the hand that a link belongs to.

        They are all links below the nearest ancestor joint of ``link`` that does not mimic another joint. For a palm
        or a finger these are the links of the wrist and of the hand.

        Raises:
            UnknownNameError: No such link.
        """
        known = _hands_of(self.model)
        if link not in known:
            known[link] = self._hand_of(link)
        return known[link]

    def _hand_of(self, link: str) -> tuple[str, ...]:
        model = self.model
        joint = model.frames[self.link_frame(link)].parentJoint
        while joint > 0 and model.joints[joint].nq == 0:
            joint = model.parents[joint]
        if joint == 0:  # fixed to the world
            return tuple(f.name for f in model.frames if f.type == pin.FrameType.BODY and f.parentJoint == 0)
        below = {joint}
        for k in range(1, model.njoints):  # parents come before their children
            if model.parents[k] in below:
                below.add(k)
        bodies = (f for f in model.frames if f.type == pin.FrameType.BODY)
        return tuple(f.name for f in bodies if f.parentJoint in below)

    def limit_fault(self, q: Array) -> str | None:
        """Return a sentence on the first joint of ``q`` outside its limits, or None when all are inside."""
        q = number_array(q, "state")
        if q.shape != (self.dof,):
            return f"the state has shape {q.shape}, expected ({self.dof},)"
        low, high = self.limits.lower, self.limits.upper
        bad = ~((q >= low) & (q <= high))  # NaN is never inside
        if not bad.any():
            return None
        k = int(np.argmax(bad))
        by = max(low[k] - q[k], q[k] - high[k])
        amount = f"{by:.2g} " if by < LIMIT_SLACK else ""  # which may not show in the rounded value
        hint = degrees_hint(q[k], lambda angle: low[k] <= angle <= high[k])
        return f"{self.joint_names[k]} = {q[k]:.6g} is {amount}outside its limits [{low[k]:.6g}, {high[k]:.6g}]{hint}"

    def within_limits(self, states: Array) -> Array:
        """Return states, shape (..., dof), with joints that are a little outside their limits moved to them.

        Encoders and controllers are off by some tenths of a milliradian, and rounded limits by less; joints that are
        further out are left as they are.
        """
        return _nearly_inside(self.limits, states)

    def range_around(self, q: Array | float = 0.0, turns: float = 0.5) -> tuple[Array, Array]:
        """Return the limits, of continuous joints so many turns to either side of ``q`` and inside their limits.

        Args:
            q: A state, shape (dof,).
            turns: Turns to either side.

        Returns:
            Lowest and highest values, shape (dof,) each.
        """
        half = TURN * turns
        return narrowed((self.limits.lower, self.limits.upper), self.continuous, q - half, q + half)

    def random_state(self, rng: np.random.Generator, size: int | None = None) -> Array:
        """Return states drawn uniformly inside the limits, continuous joints within a turn; (dof,) or (size, dof)."""
        shape = (self.dof,) if size is None else (size, self.dof)
        return rng.uniform(*self.range_around(), shape)

    def turned_to(self, states: Array, q: Array) -> Array:
        """Return states with continuous joints turned by whole turns, so that they are the nearest to ``q``.

        Args:
            states: Shape (..., dof).
            q: Shape (dof,), or that of the states.
        """
        if not self.continuous.any():
            return states
        turns = np.where(self.continuous, np.rint((q - states) / TURN), 0.0)
        return np.asarray(np.where(turns == 0.0, states, states + TURN * turns))


def _nearly_inside(limits: Limits, states: Array) -> Array:
    """Return states, shape (..., dof), with joints at most LIMIT_SLACK outside their limits moved to them."""
    inside = np.clip(states, limits.lower, limits.upper)
    return np.where(np.abs(inside - states) <= LIMIT_SLACK, inside, states)


def robot_names() -> tuple[str, ...]:
    """Names of the robots that ship with the package."""
    return tuple(sorted(path.name.removesuffix(".robot.yaml") for path in DATA.glob("*.robot.yaml")))


def load_robot(name_or_path: str | Path, relative_to: Path | None = None) -> Robot:
    """Load a robot by name, or from a robot file; one that ships is read once, since robots do not change.

    Args:
        name_or_path: A name out of :func:`robot_names`, or the path of a ``.yaml`` file.
        relative_to: Folder for a relative path; the current one by default.

    Raises:
        UnknownNameError: No robot of that name ships with the package.
        MissingFileError: The robot file, a URDF, an SRDF or a collision mesh is missing.
        FileFormatError: A file does not follow its schema.
        RobotError: The description is not valid.
    """
    text = str(name_or_path)
    if text in robot_names():
        return _shipped_robot(text)
    if text.endswith((".yaml", ".yml")):
        path = resolve(text, relative_to or Path.cwd(), "robot file")
    else:
        raise UnknownNameError("robot", text, robot_names())
    return build_robot(read_config(path), path)


def named_poses(name_or_path: str) -> dict[str, dict[str, float]]:
    """Return the named poses of a robot: name -> joint name -> value.

    Raises:
        ApexError: As :func:`load_robot`.
    """
    robot = load_robot(name_or_path)
    return {name: dict(zip(robot.joint_names, q.tolist(), strict=True)) for name, q in robot.poses.items()}


def bare_robot(name_or_path: str) -> tuple[Robot, RobotConfig, Path]:
    """Return a robot without its files of disabled pairs and covers, which may not exist yet, and its own file.

    Args:
        name_or_path: A name out of :func:`robot_names`, or the path of a robot file.

    Raises:
        ApexError: As :func:`load_robot`.
    """
    path = DATA / f"{name_or_path}.robot.yaml" if name_or_path in robot_names() else Path(name_or_path).resolve()
    config = read_config(path)
    return build_robot(config.model_copy(update={"disabled_pairs": None, "covers": None}), path), config, path


@cache
def _shipped_robot(name: str) -> Robot:
    path = DATA / f"{name}.robot.yaml"
    return build_robot(read_config(path), path)


def build_robot(config: RobotConfig, path: Path) -> Robot:
    """Build a robot from a robot file that was read from ``path``.

    Raises:
        MissingFileError: A URDF, an SRDF or a collision mesh is missing.
        RobotError: The description cannot be made into a robot.
    """
    config = config.with_bases()
    both = next((name for name in config.locked if name in config.joints), None)
    if both is not None:
        raise FileFormatError(str(path), "locked", both, "expected joints that are not planned (joints)")
    composition = compose(config, path.parent)
    try:
        urdf, old = names_in_order(composition.urdf)
        model = pin.buildModelFromXML(urdf, mimic=True)
        name_back(model, old)
        geometry = pin.buildGeomFromUrdfString(model, composition.urdf, pin.GeometryType.COLLISION)
    except Exception as error:  # Pinocchio's parser raises several kinds
        said = " ".join(str(error).split())
        fault = unreadable_mesh(composition.urdf) or f"Pinocchio cannot read the composed URDF ({said})"
        raise RobotError(f"{path}: {fault}") from error
    check_geometry(model, geometry, composition.urdf, path)
    order = _state_order(config, model, path)
    disabled, files, pairs_file = list(composition.disabled_pairs), [path, *composition.files], None
    if config.disabled_pairs:
        pairs_file = resolve(config.disabled_pairs, path.parent, "file of disabled pairs")
        files.append(pairs_file)
        disabled += read_disabled_pairs(pairs_file)
    pair_up(model, geometry, disabled)
    covers = resolve(config.covers, path.parent, "file of sphere covers") if config.covers else None
    files += [covers] if covers else []
    files += [Path(body.mesh.file) for body in config.fixtures if body.mesh is not None]
    names = tuple(config.joints)
    for hand in config.hands.values():
        if not model.existBodyName(hand.palm):
            raise FileFormatError(str(path), "hands", hand.palm, "expected a link of the robot as palm")
        for link in hand.jaws:
            if not model.existBodyName(link):
                raise FileFormatError(str(path), "hands", link, "expected links of the robot as jaws")
    groups = {g: np.array([names.index(n) for n in members]) for g, members in config.groups.items()}
    limits = _limits(config, model, path)
    effort = np.array([joint.effort for joint in config.joints.values()])
    turning = np.array(["P" not in model.joints[model.getJointId(name)].shortname() for name in names])
    home = _nearly_inside(limits, np.array([joint.home for joint in config.joints.values()]))
    outside = ~((home >= limits.lower) & (home <= limits.upper))
    if outside.any():
        k = int(np.argmax(outside))
        expected = _expected(limits, k, home[k], turning[k])
        raise FileFormatError(str(path), f"joints.{names[k]}.home", float(home[k]), expected)
    poses = {HOME: home, **{pose: _posed(config, limits, turning, pose, path) for pose in config.poses}}
    continuous = turning & (limits.lower <= -WIDEST) & (limits.upper >= WIDEST)
    weights = weights_of(limits, turning)
    for array in (weights, continuous, effort, *poses.values(), *vars(limits).values(), *groups.values(), order):
        array.flags.writeable = False
    return Robot(
        name=config.name, joint_names=names, limits=limits, effort=effort, home=home, poses=poses, groups=groups,
        hands=config.hands, model=model, geometry=geometry, fixtures=config.fixtures, weights=weights,
        continuous=continuous, part_links=composition.part_links, urdf=composition.urdf, disabled_pairs=pairs_file,
        covers=covers, checkpoint=None if config.model is None else path.parent / config.model, files=tuple(files),
        _order=order,
    )  # fmt: skip


def _posed(config: RobotConfig, limits: Limits, turning: Flags, pose: str, path: Path) -> Array:
    """Return a named pose as a state, shape (dof,).

    Raises:
        FileFormatError: A value is outside the limits.
    """
    values = config.poses[pose]
    q = _nearly_inside(limits, np.array([values.get(name, joint.home) for name, joint in config.joints.items()]))
    for k, name in enumerate(config.joints):
        if not limits.lower[k] <= q[k] <= limits.upper[k]:
            expected = _expected(limits, k, q[k], turning[k])
            raise FileFormatError(str(path), f"poses.{pose}.{name}", float(q[k]), expected)
    return q


def _expected(limits: Limits, k: int, value: float, turns: bool) -> str:
    """Return what was expected in place of a value of the joint of number k, which may be one that turns."""
    low, high = float(limits.lower[k]), float(limits.upper[k])
    radians = "; angles are radians" if turns and abs(value) > TURN else ""
    hint = degrees_hint(value, lambda angle: low <= angle <= high) or radians
    return f"expected a value inside the limits [{low:.6g}, {high:.6g}]{hint}"


def _state_order(config: RobotConfig, model: pin.Model, path: Path) -> NDArray[np.intp]:
    """Return the indices ``order``, shape (nq,), with ``q_pinocchio = q_state[order]``."""
    order = np.full(model.nq, -1, dtype=np.intp)
    for k, name in enumerate(config.joints):
        if not model.existJointName(name):
            known = list(model.names)[1:]
            raise FileFormatError(str(path), "joints", name, f"expected joints of the URDF ({', '.join(known)})")
        joint = model.joints[model.getJointId(name)]
        if joint.nq != 1 or joint.idx_q < 0:
            raise FileFormatError(str(path), "joints", name, "expected revolute or prismatic joints")
        order[joint.idx_q] = k
    free = [n for n in list(model.names)[1:] if n not in config.joints and model.joints[model.getJointId(n)].nq > 0]
    if (order < 0).any():
        raise RobotError(f"{path}: the joint {free[0]!r} is neither planned (joints) nor held (locked)")
    return order


def _limits(config: RobotConfig, model: pin.Model, path: Path) -> Limits:
    rows = []
    for name, joint in config.joints.items():
        item = model.joints[model.getJointId(name)]
        low = model.lowerPositionLimit[item.idx_q] if joint.lower is None else joint.lower
        high = model.upperPositionLimit[item.idx_q] if joint.upper is None else joint.upper
        speed = model.velocityLimit[item.idx_v] if joint.velocity is None else joint.velocity
        if not (np.isfinite([low, high, speed]).all() and low < high and speed > 0):
            expected = "expected finite limits with lower < upper and velocity > 0"
            raise FileFormatError(str(path), f"joints.{name}", [low, high, speed], expected)
        low, high = max(low, -WIDEST), min(high, WIDEST)
        if not low < high:
            raise FileFormatError(str(path), f"joints.{name}", [low, high], f"expected limits within {WIDEST:g}")
        rows.append((low, high, speed, joint.acceleration, joint.jerk))
    return Limits(*(np.array(column, float) for column in zip(*rows, strict=True)))


def weights_of(limits: Limits, turning: Flags) -> Array:
    """Return what a unit of each joint counts in distances between states, shape (dof,) [rad/rad, rad/m].

    A radian of a turning joint counts 1. A meter of a prismatic joint of velocity v counts as many radians as turning
    joints move meanwhile, w = median(v_turning) / v, 2 rad/s without any. So the distance is one of time. But its whole
    range counts at most as a turn, or as a radian for each meter: slow joints would hold back all others in a search.

    Args:
        limits: Limits of the joints.
        turning: Which of them turn, shape (dof,).
    """
    speed = float(np.median(limits.velocity[turning])) if turning.any() else SPEED
    most = np.maximum(TURN / (limits.upper - limits.lower), 1.0)
    return np.where(turning, 1.0, np.minimum(speed / limits.velocity, most))


@weakly_cached
def _data_of(model: pin.Model) -> tuple[ProcessLock, pin.Data]:
    """Return Pinocchio's data of a model, and the lock of those who use it."""
    return ProcessLock(), model.createData()


@weakly_cached
def _hands_of(model: pin.Model) -> dict[str, tuple[str, ...]]:
    """Return the hands that links belong to, as far as they are known; robots of one model share them."""
    return {}
