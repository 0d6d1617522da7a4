"""Groups of constraint rows on random trees and real robots, and their residuals by Pinocchio or by definition."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol

import numpy as np
import pinocchio as pin
from apex_ompl.goals.inverse_kinematics import Links
from random_robots import frames, pose, random_robot

from apex_ompl.kernel import RobotTables
from apex_ompl.kernel.constraints import AXIS, POSITION, ROTATION, ConstraintGroup, ConstraintRows, JointFrame
from apex_ompl.kernel.joint_tree import JointTree
from apex_ompl.robot import Robot

WHOLE = {POSITION: 3, AXIS: 2, ROTATION: 3}


class Placed(NamedTuple):
    """A frame that is fixed to a link or joint by a pose in its frame, shape (4, 4)."""

    link: str | int
    pose: np.ndarray


class Mechanism(Protocol):
    """Kernel tables, and frames of the same robot without the kernel."""

    tables: RobotTables

    def links(self) -> Sequence[str | int]: ...
    def frame(self, placed: Placed) -> JointFrame: ...
    def placement(self, placed: Placed, q: np.ndarray) -> np.ndarray: ...


class Tree:
    """A random tree of revolute, prismatic, fixed and mimic joints, placed by products of exponentials."""

    def __init__(self, seed: int, joints: int = 9) -> None:
        self.tables, self._specs, *_ = random_robot(seed, joints)
        self._turns = JointTree(self._specs).turns

    def links(self) -> Sequence[str | int]:
        return range(len(self._specs))

    def frame(self, placed: Placed) -> JointFrame:
        inside = self._turns[int(placed.link)].T @ placed.pose
        return JointFrame(int(placed.link), inside[:3, :3], inside[:3, 3])

    def placement(self, placed: Placed, q: np.ndarray) -> np.ndarray:
        return frames(self._specs, q)[int(placed.link)] @ placed.pose


class Real:
    """A robot, placed by Pinocchio; link 0 is the world."""

    def __init__(self, robot: Robot) -> None:
        self._robot, self._data, self._links = robot, robot.model.createData(), Links.of(robot)
        self.tables = self._links.tables

    def links(self) -> Sequence[str | int]:
        return [0, *(f.name for f in self._robot.model.frames if f.type == pin.FrameType.BODY and f.parentJoint > 0)]

    def frame(self, placed: Placed) -> JointFrame:
        if placed.link == 0:
            return JointFrame(0, placed.pose[:3, :3], placed.pose[:3, 3])
        name = str(placed.link)
        axes = [np.asarray(self._links.direction(name, axis).vector) for axis in placed.pose[:3, :3].T]
        at = self._links.point(name, placed.pose[:3, 3])
        return JointFrame(at.joint, np.array(axes).T, np.asarray(at.vector))

    def placement(self, placed: Placed, q: np.ndarray) -> np.ndarray:
        if placed.link == 0:
            return placed.pose
        pin.framesForwardKinematics(self._robot.model, self._data, self._robot.to_pinocchio(q))
        found: np.ndarray = self._data.oMf[self._robot.link_frame(str(placed.link))].homogeneous @ placed.pose
        return found


class Sample(NamedTuple):
    """Groups, and the frames that they are about."""

    mechanism: Mechanism
    groups: list[ConstraintGroup]
    frames: list[tuple[Placed, Placed]]

    def rows(self, **options: Sequence[int]) -> ConstraintRows:
        return ConstraintRows(self.mechanism.tables, self.groups, **options)

    def with_tolerances(self, tolerances: np.ndarray | Sequence[float]) -> ConstraintRows:
        groups = [
            ConstraintGroup(g.kind, g.rows, g.first, g.second, float(most), g.value)
            for g, most in zip(self.groups, tolerances, strict=True)
        ]
        return ConstraintRows(self.mechanism.tables, groups)

    def residuals(self, q: np.ndarray) -> list[np.ndarray]:
        """Residuals of the groups at a state, by definition."""
        return [
            residual(g, self.mechanism.placement(a, q), self.mechanism.placement(b, q))
            for g, (a, b) in zip(self.groups, self.frames, strict=True)
        ]

    def norms(self, states: np.ndarray) -> np.ndarray:
        return np.array([[np.linalg.norm(r) for r in self.residuals(q)] for q in states])


def residual(group: ConstraintGroup, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Residual of a group whose frames have the poses a and b, shape (4, 4) each."""
    seen = np.linalg.inv(a) @ b
    if group.kind == POSITION:
        return seen[: group.rows, 3] - np.asarray(group.value)[: group.rows]
    if group.kind == ROTATION:
        return np.asarray(pin.log3(seen[:3, :3]))
    sine = np.hypot(seen[0, 2], seen[1, 2])
    return math.atan2(sine, seen[2, 2]) * (seen[:2, 2] / sine if sine > 0.0 else np.array([1.0, 0.0]))


def sample(
    mechanism: Mechanism, rng: np.random.Generator, kinds: Sequence[int] = (POSITION, AXIS, ROTATION),
    links: Callable[[], tuple[str | int, str | int]] | None = None, near: np.ndarray | None = None,
) -> Sample:  # fmt: skip
    """One group of each kind between random frames.

    Args:
        mechanism: The robot.
        rng: Source of the frames.
        kinds: Kinds of the groups.
        links: Returns the links of the two frames; random ones by default.
        near: A state at which residuals are to be small; by default they are arbitrary.
    """
    groups, placed = [], []
    for kind in kinds:
        names = mechanism.links()
        one, two = links() if links else (names[int(k)] for k in rng.choice(len(names), 2, replace=False))
        a, b = Placed(one, pose(rng, 0.2)), Placed(two, pose(rng, 0.2))
        count, value = int(rng.integers(1, 4)) if kind == POSITION else WHOLE[kind], rng.normal(0.0, 0.3, 3)
        if near is not None:
            away = pose(rng, 0.01)
            away[:3, :3] = pin.exp3(0.05 * pin.log3(away[:3, :3]))
            inside = np.linalg.inv(mechanism.placement(Placed(two, np.eye(4)), near))
            b = Placed(two, inside @ mechanism.placement(a, near) @ away)
            value = rng.normal(0.0, 0.01, 3)
        groups.append(ConstraintGroup(kind, count, mechanism.frame(a), mechanism.frame(b), 1.0, value))
        placed.append((a, b))
    return Sample(mechanism, groups, placed)
