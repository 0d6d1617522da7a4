"""Alignment goals: the task as two vectors to be aligned (section III-A of the paper).

Each object has a contact face with the center p and the outward unit axis a, fixed to the link that holds it. With
e = p2 - p1 and the wanted distance d, the error terms of an alignment are

- ``angle``: the angle between a1 and -a2 (not for pouring),
- ``lateral``: |(I - a1 a1^T) e|,
- ``axial``: |a1 . e - d|,

and, depending on its kind,

- ``vertical``: ``gravity``, the angle between a1 and up,
- ``horizontal``: ``gravity``, the angle between a1 and the horizontal plane,
- ``pour``: the first face is the lip of a vessel, and its axis points out of the opening. ``lateral`` and ``axial``
  are measured along the upward direction from the second face, the opening to pour into, to the lip. ``angle`` is
  the angle between a2 and up, ``tilt`` the violation of the range of the angle between a1 and up, and ``roll`` the
  angle between the lip and the lowest point of the rim,
- ``handover``: no further term. The second face is the grasp point of a hand with the outward normal of its palm.

Angles are in radians, lengths in meters.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from apex_ompl.constraints.frames import LinkFace
from apex_ompl.constraints.links import Links, in_world
from apex_ompl.errors import FileFormatError, UnknownNameError
from apex_ompl.kernel import Target, angle_target, offset_target, opposition_target
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import AttachedObject
from apex_ompl.scene.problem import ALIGNMENT_DEFAULTS, Alignment, Problem, WorldVector
from apex_ompl.types import Array
from apex_ompl.util.arrays import length
from apex_ompl.util.forking import ProcessLock

UP = np.array([0.0, 0.0, 1.0])
"""Upward direction of the world."""
DEFAULT_TILT = (1.75, 2.36)  # 100 to 135 degrees from upright
RESTART_SPREAD = 0.6  # standard deviation of initial states around home [rad]
POSITION_WEIGHT = 4.0  # weight of a position error against an angle in inverse kinematics [rad/m]


def angle(a: Array, b: Array) -> float:
    """Return the angle between two vectors, atan2(|a x b|, a . b) [rad], accurate for nearly parallel vectors too."""
    return float(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b))


def within(errors: Mapping[str, float], bounds: Mapping[str, float]) -> bool:
    """Whether every error is at most its bound, up to rounding."""
    return all(value <= bounds[name] + 1e-12 for name, value in errors.items())


def lowest_direction(axis: Array) -> Array:
    """Return the lowest unit vector orthogonal to a unit axis, shape (3,); down itself for a vertical axis."""
    down = -UP + (UP @ axis) * axis
    length = float(np.linalg.norm(down))
    return down / length if length > 1e-9 else -UP


def lip_direction(vessel: AttachedObject) -> Array | None:
    """Return the unit direction from the axis of a vessel to its lip, in the link's frame, shape (3,).

    It is the part of the contact point across the contact axis; None where the point lies on the axis.
    """
    assert vessel.contact is not None
    axis = np.asarray(vessel.contact.axis, float)
    axis = axis / length(axis)
    point = np.asarray(vessel.contact.point, float)
    across = vessel.pose[:3, :3] @ (point - float((axis * point).sum()) * axis)
    size = length(across)
    return across / size if size > 1e-6 else None


class AlignmentGoal:
    """An alignment of the held objects of a robot."""

    def __init__(self, robot: Robot, alignment: Alignment, attached: Sequence[AttachedObject], start: Array) -> None:
        """Find the two faces and prepare inverse kinematics.

        Args:
            robot: The robot.
            alignment: The alignment.
            attached: The held objects.
            start: State at which vectors in the world are given, shape (dof,); its hand synergies are kept.

        Raises:
            FileFormatError: A face names no held object with a contact, or both faces move together.
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
        pours = alignment.kind == "pour" and not isinstance(alignment.first, WorldVector)
        self._radial = lip_direction(held[str(alignment.first)]) if pours else None
        self._data = robot.model.createData()
        self._lock = ProcessLock()  # of the data
        self.inverse = Links.of(robot).inverse(self.targets(), self._hand_joints())

    def _face(self, field: str, named: str | WorldVector, held: Mapping[str, AttachedObject]) -> LinkFace:
        if isinstance(named, WorldVector):
            return LinkFace.of_vector(self.robot, named, self.start)
        if field == "second" and self.alignment.kind == "handover" and named not in held:
            return LinkFace.of_hand(self.robot, named)
        if named not in held:
            raise UnknownNameError("held object in goal.alignment", named, held)
        if held[named].contact is None:
            raise FileFormatError(f"held object {named!r}", "contact", None, "expected a contact face to align")
        return LinkFace.of_object(held[named])

    def faces(self, q: Array) -> tuple[Array, Array, Array, Array]:
        """Return p1, a1, p2 and a2 in the world at a state, each of shape (3,) [m]."""
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
        """Return the error terms at a state, shape (dof,): lengths [m] and angles [rad], all 0 or more."""
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
                errors["roll"] = angle(out, lowest_direction(a1))
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
        """Whether every error at a state is at most its tolerance."""
        return within(self.errors(q), self.bounds)

    @property
    def bounds(self) -> dict[str, float]:
        """Tolerance of each error term: lengths [m] and angles [rad]."""
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
        """Return the residuals of inverse kinematics; lengths are weighted by ``POSITION_WEIGHT``."""
        links, up, w, d = Links.of(self.robot), in_world(UP), POSITION_WEIGHT, self.distance
        p1, p2 = (links.point(face.link, face.point) for face in (self.first, self.second))
        a1, a2 = (links.direction(face.link, face.axis) for face in (self.first, self.second))
        if self.alignment.kind == "pour":
            middle = float(np.cos((self.tilt[0] + self.tilt[1]) / 2))
            targets = [offset_target(p2, p1, up, d, w), opposition_target(a2, up, -1.0), angle_target(a1, up, middle)]
            if self._radial is not None:
                deepest = -float(np.sqrt(1.0 - middle**2))  # z of the lowest unit vector orthogonal to the axis
                targets.append(angle_target(links.direction(self.first.link, self._radial), up, deepest))
            return targets
        targets = [offset_target(p1, p2, a1, d, w), opposition_target(a1, a2)]
        if self.alignment.kind == "vertical":
            targets.append(opposition_target(a1, up, -1.0))
        elif self.alignment.kind == "horizontal":
            targets.append(angle_target(a1, up))
        return targets

    def _hand_joints(self) -> NDArray[np.intp]:
        names = [h.synergy for h in self.robot.hands.values() if h.synergy is not None]
        return np.array([self.robot.joint_names.index(name) for name in names], dtype=np.intp)


def alignment_goal(robot: Robot, problem: Problem) -> AlignmentGoal | None:
    """Return the alignment goal of a problem, or None when its goal is joint configurations.

    Raises:
        UnknownNameError: A held object, a link or a hand is unknown.
        FileFormatError: The alignment does not fit the held objects.
    """
    if problem.goal.alignment is None:
        return None
    return AlignmentGoal(robot, problem.goal.alignment, problem.attached, problem.start_state(robot.joint_names))


def unit_of(name: str) -> str:
    """Return the unit of an error term."""
    return "m" if name in ("lateral", "axial") or name.startswith("position") else "rad"


def relative_error(errors: Mapping[str, float], bounds: Mapping[str, float]) -> float:
    """Return the largest ratio of an error to its bound, where a bound of zero counts as 0.01."""
    return max(value / max(bounds[name], 0.01) for name, value in errors.items())
