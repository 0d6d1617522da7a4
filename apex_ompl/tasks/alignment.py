"""Alignment goals: the task as two vectors to be aligned (section III-A of the paper).

Each object has a contact face: a centre p and an outward unit axis a, fixed to the link that holds it. With
e = p2 - p1, an alignment asks for

- opposition, ``angle``: the angle between a1 and -a2 (not for pouring),
- ``lateral``: the length of e across a1, that is of (I - a1 a1^T) e,
- ``axial``: how far a1 . e is from the wanted distance,

and by its kind for

- ``vertical``, ``gravity``: the angle between a1 and up,
- ``horizontal``, ``gravity``: the angle between a1 and the horizontal plane,
- ``pour``: the first face is the lip of a vessel whose axis points out of its opening. ``lateral`` and ``axial`` are
  then measured along the upward direction from the second face (the opening to pour into) to the lip, ``angle``
  is that between a2 and up, ``tilt`` how far the vessel's angle from upright lies outside the wanted range, and
  ``roll`` the angle that the lip is away from the lowest point of the rim,
- ``handover``: nothing more; the second face is a hand's grasp point with the outward normal of its palm.

Angles are in radians, lengths in metres.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from apex_ompl.collision import CollisionChecker
from apex_ompl.errors import FileFormatError, UnknownNameError
from apex_ompl.kernel import Target, angle_target, offset_target, opposition_target
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import AttachedObject
from apex_ompl.scene.problem import ALIGNMENT_DEFAULTS, Alignment, Problem, WorldVector
from apex_ompl.tasks.inverse_kinematics import Links, in_world
from apex_ompl.types import Array

UP = np.array([0.0, 0.0, 1.0])
DEFAULT_TILT = (1.75, 2.36)  # 100 to 135 degrees from upright
RESTART_SPREAD = 0.6  # standard deviation of restarts around home [rad]
POSITION_WEIGHT = 4.0  # how much a metre counts against a radian in the descent


@dataclass(frozen=True)
class Face:
    """A contact face fixed to a link.

    Attributes:
        link: The link.
        point: Centre of the face in the link's frame, shape (3,) [m].
        axis: Outward unit axis in the link's frame, shape (3,).
    """

    link: str
    point: Array
    axis: Array

    @classmethod
    def of_object(cls, held: AttachedObject) -> Face:
        """Return the contact face of a held object."""
        assert held.contact is not None
        pose = held.pose
        axis = pose[:3, :3] @ np.asarray(held.contact.axis, float)
        point = pose[:3, :3] @ np.asarray(held.contact.point, float) + pose[:3, 3]
        return cls(held.link, point, axis / np.linalg.norm(axis))

    @classmethod
    def of_vector(cls, robot: Robot, vector: WorldVector, start: Array) -> Face:
        """Return the face that a vector in the world has in the frame of the link that holds it at ``start``.

        Raises:
            UnknownNameError: No such link.
        """
        pose = robot.link_pose(start, vector.link)
        tail, tip = np.asarray(vector.tail, float), np.asarray(vector.tip, float)
        axis = pose[:3, :3].T @ (tip - tail)
        return cls(vector.link, pose[:3, :3].T @ (tip - pose[:3, 3]), axis / np.linalg.norm(axis))

    @classmethod
    def of_hand(cls, robot: Robot, name: str) -> Face:
        """Return the grasp point of a hand with the outward normal of its palm.

        Raises:
            UnknownNameError: No such hand.
        """
        if name not in robot.hands:
            raise UnknownNameError("hand", name, robot.hands)
        hand = robot.hands[name]
        return cls(hand.palm, np.asarray(hand.point, float), np.asarray(hand.axis, float))


@dataclass(frozen=True)
class Sampling:
    """What sampling an alignment gave.

    Attributes:
        states: Free states that satisfy it, shape (found, dof).
        attempts: Descents made.
        converged: Descents that satisfied it, free or not.
        best: The errors of the best attempt.
        blocked: Why the last state that satisfied it was not free; empty when one was free, or none satisfied it.
    """

    states: Array
    attempts: int
    converged: int
    best: Mapping[str, float]
    blocked: str

    @property
    def fault(self) -> str:
        """Why there is no state, in one sentence; empty when there is one."""
        if len(self.states):
            return ""
        if self.converged:
            return f"all {self.converged} aligned states found in {self.attempts} attempts collide, {self.blocked}"
        best = ", ".join(f"{name} {value:.3g} {unit_of(name)} off" for name, value in self.best.items())
        return f"not reached in {self.attempts} attempts; the best has {best}"


class AlignmentGoal:
    """An alignment for one robot, whose held objects and start are known."""

    def __init__(self, robot: Robot, alignment: Alignment, attached: Sequence[AttachedObject], start: Array) -> None:
        """Look the two faces up.

        Args:
            robot: The robot.
            alignment: What is asked for.
            attached: The held objects.
            start: State at which vectors in the world are seen and whose hands stay as they are, shape (dof,).

        Raises:
            FileFormatError: A face names no held object with a contact, or both hang on the same link.
            UnknownNameError: A vector names an unknown link, or a handover an unknown hand.
        """
        self.robot = robot
        self.alignment = alignment
        self.start = np.asarray(start, float)
        distance, tolerance = ALIGNMENT_DEFAULTS[alignment.kind]
        self.distance = distance if alignment.distance is None else alignment.distance
        self.tolerance = alignment.tolerance or tolerance
        self.tilt = alignment.tilt or DEFAULT_TILT
        held = {a.name: a for a in attached}
        self.first = self._face("first", alignment.first, held)
        self.second = self._face("second", alignment.second, held)
        self._frames = (robot.link_frame(self.first.link), robot.link_frame(self.second.link))
        joints = [robot.model.frames[frame].parentJoint for frame in self._frames]
        if joints[0] == joints[1]:
            raise FileFormatError(
                "goal.alignment", "second", self.second.link, "expected two faces that move against each other"
            )
        self._radial = self._lip_direction(held)
        self._data = robot.model.createData()
        self._lock = threading.Lock()  # of the data
        self._inverse = Links.of(robot).inverse(self.targets(), self._hand_joints())

    def _face(self, field: str, named: str | WorldVector, held: Mapping[str, AttachedObject]) -> Face:
        if isinstance(named, WorldVector):
            return Face.of_vector(self.robot, named, self.start)
        if field == "second" and self.alignment.kind == "handover" and named not in held:
            return Face.of_hand(self.robot, named)
        if named not in held:
            raise UnknownNameError("held object in goal.alignment", named, held)
        if held[named].contact is None:
            raise FileFormatError(f"held object {named!r}", "contact", None, "expected a contact face to align")
        return Face.of_object(held[named])

    def _lip_direction(self, held: Mapping[str, AttachedObject]) -> Array | None:
        """Return the unit direction from the vessel's axis to its lip, in the link's frame, for pouring."""
        name = self.alignment.first
        if self.alignment.kind != "pour" or isinstance(name, WorldVector):
            return None
        vessel = held[name]
        assert vessel.contact is not None
        axis = np.asarray(vessel.contact.axis, float)
        axis = axis / np.linalg.norm(axis)
        point = np.asarray(vessel.contact.point, float)
        across = vessel.pose[:3, :3] @ (point - (axis @ point) * axis)
        length = float(np.linalg.norm(across))
        return across / length if length > 1e-6 else None

    def faces(self, q: Array) -> tuple[Array, Array, Array, Array]:
        """Return p1, a1, p2, a2 in the world at a state, each of shape (3,)."""
        found: list[Array] = []
        for face, pose in zip((self.first, self.second), self._poses(q), strict=True):
            found += [pose[:3, :3] @ face.point + pose[:3, 3], pose[:3, :3] @ face.axis]
        return found[0], found[1], found[2], found[3]

    def _poses(self, q: Array) -> list[Array]:
        """Return the poses of the two links in the world, shape (4, 4) each."""
        with self._lock:
            pin.framesForwardKinematics(self.robot.model, self._data, self.robot.to_pinocchio(np.asarray(q, float)))
            return [np.array(self._data.oMf[frame].homogeneous) for frame in self._frames]

    def errors(self, q: Array) -> dict[str, float]:
        """Return the error terms at a state, shape (dof,): lengths [m] and angles [rad], none negative."""
        p1, a1, p2, a2 = self.faces(q)
        e = p2 - p1
        if self.alignment.kind == "pour":
            e = -e  # from the opening up to the lip
            low, high = self.tilt
            tilt = angle(a1, UP)
            errors = {
                "lateral": float(np.linalg.norm(e[:2])),
                "axial": abs(float(e[2]) - self.distance),
                "angle": angle(a2, UP),
                "tilt": max(low - tilt, tilt - high, 0.0),
            }
            if self._radial is not None:
                out = self._poses(q)[0][:3, :3] @ self._radial
                errors["roll"] = angle(out, _lowest_direction(a1))
            return errors
        errors = {
            "lateral": float(np.linalg.norm(e - (a1 @ e) * a1)),
            "axial": abs(float(a1 @ e) - self.distance),
            "angle": angle(a1, -a2),
        }
        if self.alignment.kind == "vertical":
            errors["gravity"] = angle(a1, UP)
        elif self.alignment.kind == "horizontal":
            errors["gravity"] = abs(float(np.pi / 2 - angle(a1, UP)))
        return errors

    def is_satisfied(self, q: Array) -> bool:
        """Whether every error at a state is within its tolerance, the bound included."""
        return within(self.errors(q), self.bounds)

    @property
    def bounds(self) -> dict[str, float]:
        """Largest allowed value of each error term."""
        t = self.tolerance
        return {
            "lateral": t.lateral,
            "axial": t.axial,
            "angle": t.angle,
            "gravity": t.angle,
            "tilt": 0.0,
            "roll": t.angle,
        }

    def targets(self) -> list[Target]:
        """Return what inverse kinematics brings to zero; lengths count ``POSITION_WEIGHT`` times against angles."""
        links, up, w, d = Links.of(self.robot), in_world(UP), POSITION_WEIGHT, self.distance
        p1, p2 = (links.point(face.link, face.point) for face in (self.first, self.second))
        a1, a2 = (links.direction(face.link, face.axis) for face in (self.first, self.second))
        if self.alignment.kind == "pour":
            middle = float(np.cos((self.tilt[0] + self.tilt[1]) / 2))
            targets = [offset_target(p2, p1, up, d, w), opposition_target(a2, up, -1.0), angle_target(a1, up, middle)]
            if self._radial is not None:
                deepest = -float(np.sqrt(1.0 - middle**2))  # height of the lowest direction square to the axis
                targets.append(angle_target(links.direction(self.first.link, self._radial), up, deepest))
            return targets
        targets = [offset_target(p1, p2, a1, d, w), opposition_target(a1, a2)]
        if self.alignment.kind == "vertical":
            targets.append(opposition_target(a1, up, -1.0))
        elif self.alignment.kind == "horizontal":
            targets.append(angle_target(a1, up))
        return targets

    def attempt(self, rng: np.random.Generator) -> Array:
        """Return the end of one descent from a random state around home, hands as at the start, shape (dof,)."""
        q0 = self.robot.home + rng.normal(0.0, RESTART_SPREAD, self.robot.dof)
        hands = self._hand_joints()
        q0[hands] = self.start[hands]
        limits = self.robot.limits
        ends: Array = self._inverse.descend(np.clip(q0, limits.lower, limits.upper)).states[0]
        return ends

    def sample(
        self, checker: CollisionChecker, rng: np.random.Generator, count: int = 8, max_attempts: int = 200
    ) -> Sampling:
        """Sample free states that satisfy the alignment, by descents from random restarts.

        Args:
            checker: Judges the states.
            rng: Source of the restarts.
            count: How many states to look for.
            max_attempts: Most descents to make.
        """
        states: list[Array] = []
        best: dict[str, float] = {}
        converged = attempts = 0
        colliding: Array | None = None
        while attempts < max_attempts and len(states) < count:
            attempts += 1
            q = self.attempt(rng)
            errors = self.errors(q)
            if not best or _badness(errors, self.bounds) < _badness(best, self.bounds):
                best = errors
            if not within(errors, self.bounds):
                continue
            converged += 1
            if checker.is_free(q):
                states.append(q)
            else:
                colliding = q
        found = np.array(states).reshape(-1, self.robot.dof)
        blocked = ""
        if colliding is not None and not states:
            blocked = str(next(iter(checker.contacts(colliding)), "in collision"))
        return Sampling(found, attempts, converged, best, blocked)

    def _hand_joints(self) -> NDArray[np.intp]:
        names = [h.synergy for h in self.robot.hands.values() if h.synergy is not None]
        return np.array([self.robot.joint_names.index(name) for name in names], dtype=np.intp)


def alignment_goal(robot: Robot, problem: Problem) -> AlignmentGoal | None:
    """Return the alignment goal of a problem, or None when its goal is joint configurations.

    Raises:
        ApexError: A face, a link or a hand is unknown.
    """
    if problem.goal.alignment is None:
        return None
    return AlignmentGoal(robot, problem.goal.alignment, problem.attached, problem.start_state(robot.joint_names))


def angle(a: Array, b: Array) -> float:
    """Return the angle between two vectors, 0..pi [rad], exact also where they are nearly parallel."""
    return float(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b))


def within(errors: Mapping[str, float], bounds: Mapping[str, float]) -> bool:
    """Whether every error is at most its bound, give or take rounding."""
    return all(value <= bounds[name] + 1e-12 for name, value in errors.items())


def unit_of(name: str) -> str:
    """Return the unit of an error term."""
    return "m" if name in ("lateral", "axial") else "rad"


def _badness(errors: Mapping[str, float], bounds: Mapping[str, float]) -> float:
    """Return the largest error in multiples of its bound; terms without slack count in hundredths of a radian."""
    return max(value / max(bounds[name], 0.01) for name, value in errors.items())


def _lowest_direction(axis: Array) -> Array:
    """Return the unit direction square to an axis that points down most."""
    down = -UP + (UP @ axis) * axis
    length = float(np.linalg.norm(down))
    return down / length if length > 1e-9 else -UP
