"""Pose goals: poses in the world for frames of hands, links or held objects."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from functools import cached_property

import numpy as np
import pinocchio as pin

from apex_ompl.constraints.frames import Frame, frame_of
from apex_ompl.constraints.links import Links, in_world
from apex_ompl.errors import ParameterError
from apex_ompl.goals.alignment import angle, within
from apex_ompl.goals.reach import too_far
from apex_ompl.kernel import IKSolver, Target, offset_target, opposition_target
from apex_ompl.kernel.products import product
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import AttachedObject, pose_matrix
from apex_ompl.scene.problem import PoseTarget
from apex_ompl.types import Array
from apex_ompl.util.forking import ProcessLock

POSITION_WEIGHT = 4.0  # weight of a position error against an angle in inverse kinematics [rad/m]
DRAWN = 24  # poses that stand for a region
TURNING = 6  # joints with which an arm reaches turns that are drawn
MEANT = "positions are meters and quaternions [x, y, z, w]"
HINTS = 32  # descents by which another reading of poses is tried
FAR = 10.0  # coordinate from which millimeters are likely [m]
STAYS = 1e-8  # range of a joint that is not planned, at most [rad]
RESIDUAL = 1e-6  # largest residual at which inverse kinematics ends


class PoseGoal:
    """Poses that frames of a robot reach together; joints that move none of the frames stay as at the start."""

    def __init__(
        self, robot: Robot, poses: Sequence[PoseTarget], attached: Sequence[AttachedObject], start: Array,
    ) -> None:  # fmt: skip
        """Find the frames.

        Args:
            robot: The robot.
            poses: The poses.
            attached: The held objects.
            start: The start, shape (dof,).

        Raises:
            UnknownNameError: A frame is not a hand, a link or a held object.
            ParameterError: The free turn of a contact face is not about its z axis.
        """
        self.robot, self._attached = robot, tuple(attached)
        self.poses = tuple(poses)
        self.start = np.clip(start, robot.limits.lower, robot.limits.upper)  # as plans clip it
        held = {a.name: a for a in attached}
        self.frames = tuple(frame_of(robot, pose.frame, held, "frame of a pose") for pose in self.poses)
        for pose, frame in zip(self.poses, self.frames, strict=True):
            if frame.axial and (pose.free_turn not in (None, "z") or pose.turn is not None):
                raise ParameterError("free_turn", pose.free_turn, f"z and no turn for {pose.frame}, a contact face")
        self._drawn = self.poses
        self._numbers = [robot.link_frame(frame.link) for frame in self.frames]
        self._data: pin.Data | None = None  # made when it is needed
        self._lock = ProcessLock()  # of the data

    def drawn(self, poses: Sequence[PoseTarget]) -> PoseGoal:
        """Return the same goal, of which inverse kinematics is to reach given poses inside of the regions."""
        other = copy(self)
        other._drawn = tuple(poses)
        other.__dict__.pop("inverse", None)
        return other

    @property
    def drawn_poses(self) -> tuple[PoseTarget, ...]:
        """The poses that inverse kinematics is to reach: those of the goal, or drawn inside of its regions."""
        return self._drawn

    def of_one(self, k: int) -> PoseGoal:
        """Return the goal of one of the poses alone."""
        return PoseGoal(self.robot, [self.poses[k]], self._attached, self.start).drawn([self._drawn[k]])

    @cached_property
    def inverse(self) -> IKSolver:
        """Inverse kinematics of the poses; hands stay as they are."""
        robot = self.robot
        names = [h.synergy for h in robot.hands.values() if h.synergy is not None]
        hands = np.array([robot.joint_names.index(name) for name in names], dtype=np.intp)
        return Links.of(robot).inverse(self.targets(), hands)

    @cached_property
    def _wanted(self) -> list[Array]:
        """The poses, shape (4, 4) each [m]."""
        return [pose_matrix(pose.position, pose.orientation or (0.0, 0.0, 0.0, 1.0)) for pose in self.poses]

    @cached_property
    def where(self) -> tuple[tuple[str, bytes], ...]:
        """The frames: two goals for which this is the same have frames in the same places."""
        return tuple((frame.link, frame.pose.tobytes()) for frame in self.frames)

    def placements(self, q: Array) -> list[Array]:
        """Return the poses of the frames in the world at a state, shape (4, 4) each [m]."""
        with self._lock:
            self._data = self._data or self.robot.model.createData()
            pin.framesForwardKinematics(self.robot.model, self._data, self.robot.to_pinocchio(np.asarray(q, float)))
            links = [np.array(self._data.oMf[number].homogeneous) for number in self._numbers]
        return [link @ frame.pose for link, frame in zip(links, self.frames, strict=True)]

    def errors(self, q: Array, placed: Sequence[Array] | None = None) -> dict[str, float]:
        """Return the error terms at a state, shape (dof,): distances [m] and angles [rad].

        Args:
            q: The state.
            placed: Its :meth:`placements`, where they are known.
        """
        errors, placed = {}, self.placements(q) if placed is None else placed
        for pose, frame, found, wanted in zip(self.poses, self.frames, placed, self._wanted, strict=True):
            inside = wanted[:3, :3].T @ (found[:3, 3] - wanted[:3, 3])
            outside = inside - np.clip(inside, pose.lower, pose.upper)
            errors[f"position of {pose.frame}"] = float(np.linalg.norm(outside))
            if pose.orientation is not None:
                errors[f"angle of {pose.frame}"] = _turned(pose, frame, found[:3, :3], wanted[:3, :3])
        return errors

    @property
    def bounds(self) -> dict[str, float]:
        """Tolerance of each error term: distances [m] and angles [rad]."""
        bounds = {}
        for pose in self.poses:
            bounds[f"position of {pose.frame}"] = pose.tolerance.position
            bounds[f"angle of {pose.frame}"] = pose.tolerance.angle
        return bounds

    @property
    def residual_decides(self) -> bool:
        """Whether the poses are reached where the residual is 0: not with a range of angles of which none is drawn."""
        return all(pose.turn is None for pose in self._drawn)

    def targets(self) -> list[Target]:
        """Return the residuals of inverse kinematics; distances are weighted by ``POSITION_WEIGHT``."""
        links, targets = Links.of(self.robot), []
        for pose, frame in zip(self._drawn, self.frames, strict=True):
            point = links.point(frame.link, frame.pose[:3, 3])
            targets.append(offset_target(in_world(pose.position), point, weight=POSITION_WEIGHT))
            if pose.orientation is None:
                continue
            wanted = pose_matrix(pose.position, pose.orientation)[:3, :3]
            for k in _axes(pose, frame):
                axis = links.direction(frame.link, frame.pose[:3, k])
                targets.append(opposition_target(axis, in_world(wanted[:, k]), -1.0))
        return targets

    def out_of_reach(self, base: Array | None = None) -> str:
        """Return why a pose is farther away than the arm is long, or not moved to, or nothing where that is not shown.

        Args:
            base: Values of the joints that do not move, shape (dof,), by default those of the start.
        """
        at, limits, free = self.start if base is None else base, self.robot.limits, self.inverse.free
        free = free[limits.upper[free] - limits.lower[free] > STAYS]
        for pose, frame, place in zip(self.poses, self.frames, self.placements(at), strict=True):
            one = PoseGoal(self.robot, [pose], self._attached, self.start)
            if not within(one.errors(at, [place]), one.bounds) and (far := too_far(self.robot, pose, frame, at, free)):
                return far
        return ""

    def hint(self) -> str:
        """Return as what poses that are out of reach may be meant, if they can be reached as that; else nothing."""
        far = max(abs(value) for pose in self.poses for value in pose.position) >= FAR
        turned = any(pose.orientation is not None for pose in self.poses)
        for millimeters, first in ((True, False), (False, True), (True, True)):
            if (far or not millimeters) and (turned or not first):
                poses = [_read(pose, millimeters, first) for pose in self.poses]
                if PoseGoal(self.robot, poses, self._attached, self.start)._is_reached():
                    said = ["in millimeters"] if millimeters else []
                    said += ["as a quaternion [w, x, y, z]"] if first else []
                    return f"{' and '.join(said)} it could be reached, but here {MEANT}"
        return ""

    def _is_reached(self) -> bool:
        """Whether one of a few descents reaches the poses."""
        free, (lower, upper) = self.inverse.free, self.robot.range_around(self.start)
        states = np.tile(self.start, (HINTS, 1))
        rng, shape = np.random.default_rng(0), (HINTS - 1, len(free))
        states[1:, free] = rng.uniform(lower[free], upper[free], shape)
        ends = self.inverse.descend(states, tolerance=RESIDUAL)
        best = ends.states[np.argsort(ends.errors)[:1]]
        return any(within(self.errors(q), self.bounds) for q in best)

    def nearest(self, q: Array) -> Array:
        """Return the result of inverse kinematics from a state, shape (dof,); it need not reach the poses."""
        found: Array = self.inverse.descend(np.asarray(q, float), tolerance=RESIDUAL).states[0]
        return found


def pose_goals(
    robot: Robot, poses: Sequence[PoseTarget], attached: Sequence[AttachedObject], start: Array
) -> list[PoseGoal]:  # fmt: skip
    """Return the goal of poses; where they are regions, goals of the nearest poses to the start and of drawn ones.

    A turn in a range is drawn, too, where there are joints enough to reach it; otherwise it stays free, and the errors
    tell whether it is in range.

    Args:
        robot: The robot.
        poses: The poses.
        attached: The held objects.
        start: The start, shape (dof,).

    Raises:
        UnknownNameError: A frame is not a hand, a link or a held object.
    """
    goal = PoseGoal(robot, poses, attached, start)
    if all(pose.is_exact for pose in poses):
        return [goal]
    rng, goals = np.random.default_rng(0), list[PoseGoal]()
    placed, turns = goal.placements(goal.start), len(goal.inverse.free) >= TURNING
    for k in range(DRAWN):
        drawn = [_drawn(pose, found, rng if k else None, turns) for pose, found in zip(poses, placed, strict=True)]
        goals.append(goal.drawn(drawn))
    return goals


def _drawn(pose: PoseTarget, placed: Array, rng: np.random.Generator | None, turns: bool) -> PoseTarget:
    """Return a pose drawn from the region of another one, or without ``rng`` the one nearest to where the frame is.

    Its turn is drawn with ``turns`` alone.
    """
    wanted = pose_matrix(pose.position, pose.orientation or (0.0, 0.0, 0.0, 1.0))
    lower, upper = np.array(pose.lower), np.array(pose.upper)
    inside = np.clip(product(wanted[:3, :3].T, (placed[:3, 3] - wanted[:3, 3])[:, None])[:, 0], lower, upper)
    if rng is not None:
        inside = lower + rng.random(3) * (upper - lower)
    update: dict[str, object] = {
        "position": tuple((product(wanted[:3, :3], inside[:, None])[:, 0] + wanted[:3, 3]).tolist()),
        "lower": (0.0, 0.0, 0.0), "upper": (0.0, 0.0, 0.0),
    }  # fmt: skip
    if turns and pose.turn is not None and pose.free_turn is not None:
        k = "xyz".index(pose.free_turn)
        by = _nearest_turn(_twist(product(wanted[:3, :3].T, placed[:3, :3]), k), pose.turn)[0]
        by = by if rng is None else float(rng.uniform(*pose.turn))
        turned = product(wanted[:3, :3], pin.exp3(by * np.eye(3)[k]))
        update |= {"orientation": tuple(pin.Quaternion(turned).coeffs().tolist()), "free_turn": None, "turn": None}
    return pose.model_copy(update=update)


def _read(pose: PoseTarget, millimeters: bool, first: bool) -> PoseTarget:
    """Return a pose whose position was given in millimeters, or whose quaternion was given with w first."""
    update: dict[str, object] = {}
    if millimeters:
        update["position"] = tuple(1e-3 * value for value in pose.position)
    if first and pose.orientation is not None:
        update["orientation"] = (*pose.orientation[1:], pose.orientation[0])
    return pose.model_copy(update=update)


def _axes(pose: PoseTarget, frame: Frame) -> tuple[int, ...]:
    """Return the axes of a frame whose directions are wanted."""
    if pose.free_turn is not None:
        return ("xyz".index(pose.free_turn),)
    return (2,) if frame.axial else (0, 2)


def _turned(pose: PoseTarget, frame: Frame, found: Array, wanted: Array) -> float:
    """Return the angle of an orientation to the wanted ones [rad].

    With a free turn, it is the angle between the axes, or that by which the turn about it is out of range, where that
    is larger.
    """
    if frame.axial or pose.free_turn is not None:
        (k,) = _axes(pose, frame)
        off = angle(found[:, k], wanted[:, k])
        if pose.turn is None or frame.axial:
            return off
        return max(off, _nearest_turn(_twist(wanted.T @ found, k), pose.turn)[1])
    return rotation_angle(found, wanted)


def _twist(rotation: Array, k: int) -> float:
    """Return the angle of the turn about an axis in a rotation, the rest of which turns the axis itself [rad]."""
    xyzw = pin.Quaternion(rotation).coeffs()
    by = 2.0 * float(np.arctan2(xyzw[k], xyzw[3]))
    return by - 2.0 * np.pi * round(by / (2.0 * np.pi))


def _nearest_turn(by: float, turn: tuple[float, float]) -> tuple[float, float]:
    """Return the angle in a range that is nearest to another one but for whole turns, and how far it is [rad]."""
    middle = (turn[0] + turn[1]) / 2.0
    by = middle + float(np.remainder(by - middle + np.pi, 2.0 * np.pi)) - np.pi
    nearest = min(max(by, turn[0]), turn[1])
    return nearest, abs(by - nearest)


def rotation_angle(first: Array, second: Array) -> float:
    """Return the angle of the rotation from one orientation to another, each of shape (3, 3) [rad]."""
    return float(np.linalg.norm(pin.log3(first.T @ second)))
