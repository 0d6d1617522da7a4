"""Whether a task ended as it should in physics: where the objects are, not where the joints are.

The checks are derived from the problem and from where its plan has the objects at the end:

- an object that a hand is to hold is in it,
- an object that was released is at rest where it was to be; one that was to fall is inside the object that it was
  aligned with, or on an obstacle below,
- an object that is aligned with another one, or was brought onto its face, and is still held is so,
- what stands on a tray stands on it,
- of a body of revolution its axis counts, and of a ball its place alone,
- a liquid is in the vessels that were to stay upright, or for the most part in the one that it was poured into,
- no object is on the floor, liquids apart,
- hands, or without hands the joints, are where the plan ends, and where none holds an object, no link touched an
  obstacle or a fixture.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np

from apex_ompl.drivers.grasps import turned
from apex_ompl.drivers.mujoco import MujocoDriver
from apex_ompl.drivers.vessels import Vessel, filled, vessels
from apex_ompl.kernel.perception import AXIS, BALL
from apex_ompl.perception.held_shapes import symmetry
from apex_ompl.robot.model import Robot
from apex_ompl.scene.bodies import AttachedObject
from apex_ompl.scene.problem import ALIGNMENT_DEFAULTS, Problem, Tolerance
from apex_ompl.scene.steps import LineStep
from apex_ompl.types import Array

HELD, HELD_ANGLE = 0.02, 0.35  # most distance and angle of held objects from where the problem has them [m, rad]
PLACED, PLACED_ANGLE = 0.025, 0.2  # of released objects from where they were to be
STANDING, STANDING_ANGLE = 0.03, 0.2  # of what stands on a tray from where it stood
FALLEN = 0.15  # level distance between where an object was released and where it fell [m]
ALIGNED, ALIGNED_ANGLE = 0.015, 0.2  # of faces beyond the tolerance of the alignment
SPEED = 0.02  # of objects at rest [m/s]
EXACT = Tolerance(lateral=1e-3, axial=1e-3, angle=1e-3)  # of faces that a line brings together
REACHED, REACHED_ANGLE = 0.01, 0.01  # of palms from where the plan ends, without hands of joints [m, rad]
STAYED, POURED = 1.0, 0.75  # least shares of a liquid


@dataclass(frozen=True)
class Intended:
    """Where the plan has an object at the end.

    Attributes:
        name: Name of the object.
        link: Link that holds it; an empty string where it was released.
        pose: Pose in the frame of the link, or in the world, shape (4, 4) [m].
        falls: Whether it falls from there.
    """

    name: str
    link: str
    pose: Array
    falls: bool = False


@dataclass(frozen=True)
class Check:
    """One condition.

    Attributes:
        name: What is to be.
        passed: Whether it is.
        found: What was found.
    """

    name: str
    passed: bool
    found: str


@dataclass(frozen=True, eq=False)
class Judge:
    """Checks of a task.

    Attributes:
        problem: The problem, without liquids.
        driver: The robot, at the end.
        intended: Where the objects were to be.
        end: State in which the plan ends, shape (dof,) [rad].
        standing: Object that stands on another one -> that one, and its pose in the frame of it at the start.
        touched: Pairs of a link and an obstacle that touched.
    """

    problem: Problem
    driver: MujocoDriver
    intended: Mapping[str, Intended]
    end: Array
    standing: Mapping[str, tuple[str, Array]] = field(default_factory=dict)
    touched: Collection[tuple[str, str]] = ()

    def checks(self) -> tuple[Check, ...]:
        """Return all checks."""
        return tuple(self._checks())

    def _checks(self) -> Iterator[Check]:
        for name, one in self.intended.items():
            if name in self.standing:
                yield self._stands(name)
            elif one.link:
                yield self._held(one)
            elif one.falls:
                yield self._fell(one)
            else:
                yield self._placed(one)
        yield from self._aligned()
        yield from self._liquids()
        yield from self._reached()
        low = [held.name for held in self.problem.attached if self._on_floor(held.name)]
        yield Check("no object is on the floor", not low, f"{', '.join(low)} on the floor" if low else "none")
        if not self.problem.attached:
            pairs = "; ".join(f"{a} and {b}" for a, b in sorted(self.touched))
            yield Check("no link touched an obstacle", not pairs, pairs or "none")

    def _reached(self) -> Iterator[Check]:
        robot, driver = self.driver.robot, self.driver
        for name, hand in robot.hands.items():
            off = driver.pose(hand.palm)[:3, 3] - robot.link_pose(self.end, hand.palm)[:3, 3]
            away = float(np.linalg.norm(off))
            yield Check(f"{name} is where the plan ends", away <= REACHED, f"{1e3 * away:.1f} mm off")
        if not robot.hands:
            most = float(np.abs(driver.state().positions - self.end).max())
            yield Check("the robot is where the plan ends", most <= REACHED_ANGLE, f"a joint is {most:.4f} rad off")

    def _held(self, one: Intended) -> Check:
        pose = np.linalg.inv(self.driver.pose(one.link)) @ self.driver.pose(one.name)
        what = f"{one.name} is held by {_hand(self.driver.robot, one.link)}"
        return self._near(one.name, what, (pose, one.pose), HELD, HELD_ANGLE)

    def _placed(self, one: Intended) -> Check:
        poses = self.driver.pose(one.name), one.pose
        found = self._near(one.name, f"{one.name} is where it was put", poses, PLACED, PLACED_ANGLE)
        speed = self._speed(one.name)
        return Check(found.name, found.passed and speed < SPEED, f"{found.found}, {speed:.3f} m/s")

    def _fell(self, one: Intended) -> Check:
        into = self._partner(one.name)
        pose = self.driver.pose(one.name)
        vessel = next((v for v in vessels(self.problem) if v.name == into), None)
        if vessel is not None:
            inside = self._inside(vessel, [one.name]) == 1
            return Check(f"{one.name} is in {into}", inside, "in it" if inside else f"at {_text(pose[:3, 3])}")
        away = float(np.linalg.norm((pose - one.pose)[:2, 3]))
        under = sorted(self._touched(one.name) & {body.name for body in self.problem.scene})
        speed = self._speed(one.name)
        passed = bool(under) and away <= FALLEN and speed < SPEED
        found = f"{1e3 * away:.0f} mm from there, {speed:.3f} m/s, touches {', '.join(under) or 'no obstacle'}"
        return Check(f"{one.name} lies on an obstacle below its hand", passed, found)

    def _stands(self, name: str) -> Check:
        carrier, first = self.standing[name]
        pose = np.linalg.inv(self.driver.pose(carrier)) @ self.driver.pose(name)
        return self._near(name, f"{name} stands on {carrier}", (pose, first), STANDING, STANDING_ANGLE)

    def _near(self, name: str, what: str, poses: tuple[Array, Array], most: float, most_angle: float) -> Check:
        """Return whether the pose of an object is near a wanted one."""
        pose, wanted = poses
        kind = next((symmetry(one) for one in self.problem.attached if one.name == name), 0)
        angle = turned(pose, wanted)
        if kind == AXIS:
            angle = float(np.arccos(np.clip(pose[:3, 2] @ wanted[:3, 2], -1.0, 1.0)))
        distance = float(np.linalg.norm(pose[:3, 3] - wanted[:3, 3]))
        passed = distance <= most and (angle <= most_angle or kind == BALL)
        return Check(what, passed, f"{1e3 * distance:.1f} mm, {angle:.3f} rad off")

    def _aligned(self) -> Iterator[Check]:
        """Yield the check of two faces that are held at the end and were brought together last."""
        goal, steps = self.problem.goal.alignment, self.problem.after
        onto = [one for one in steps if isinstance(one, LineStep) and one.onto is not None]
        if onto and onto[-1] is steps[-1] and onto[-1].distance is not None:
            yield from self._faces(str(onto[-1].onto), onto[-1].frame[0], onto[-1].distance, EXACT)
        elif not steps and goal is not None and goal.kind not in ("pour", "handover"):
            default, tolerance = ALIGNMENT_DEFAULTS[goal.kind]
            distance = default if goal.distance is None else goal.distance
            yield from self._faces(str(goal.first), str(goal.second), distance, goal.tolerance or tolerance)

    def _faces(self, first: str, second: str, distance: float, bounds: Tolerance) -> Iterator[Check]:
        held = {one.name: one for one in self.problem.attached if one.contact is not None}
        if first not in held or second not in held:
            return
        (p1, a1), (p2, a2) = self._face(held[first]), self._face(held[second])
        e = p2 - p1
        lateral, axial = float(np.linalg.norm(e - (a1 @ e) * a1)), abs(float(a1 @ e) - distance)
        angle = float(np.arccos(np.clip(-a1 @ a2, -1.0, 1.0)))
        passed = lateral <= bounds.lateral + ALIGNED and axial <= bounds.axial + ALIGNED
        found = f"{1e3 * lateral:.1f} mm across, {1e3 * axial:.1f} mm along, {angle:.3f} rad off"
        what = f"{second} is {1e3 * distance:.0f} mm from the face of {first}"
        yield Check(what, passed and angle <= bounds.angle + ALIGNED_ANGLE, found)

    def _face(self, one: AttachedObject) -> tuple[Array, Array]:
        assert one.contact is not None
        pose, axis = self.driver.pose(one.name), np.asarray(one.contact.axis, float)
        axis = pose[:3, :3] @ axis / np.linalg.norm(axis)
        return pose[:3, :3] @ np.asarray(one.contact.point, float) + pose[:3, 3], axis

    def _liquids(self) -> Iterator[Check]:
        full = filled(self.problem)
        if not full:
            return
        goal = self.problem.goal.alignment
        poured = goal is not None and goal.kind == "pour"
        known = {vessel.name: vessel for vessel in vessels(self.problem)}
        for name in full:
            balls = [one.name for one in self.driver.twin.held if one.name.startswith(f"{name}/")]
            target = str(goal.second) if goal is not None and poured and name == goal.first else name
            inside, least = self._inside(known[target], balls), POURED if target != name else STAYED
            verb = "was poured into" if target != name else "stayed in"
            passed = inside >= least * len(balls)
            yield Check(f"{least:.0%} of the liquid {verb} {target}", passed, f"{inside} of {len(balls)} balls")

    def _inside(self, vessel: Vessel, names: list[str]) -> int:
        inverse = np.linalg.inv(self.driver.pose(vessel.name))
        points = np.array([(inverse @ self.driver.pose(name))[:3, 3] for name in names])
        return int(vessel.contains(points).sum())

    def _partner(self, name: str) -> str:
        goal = self.problem.goal.alignment
        if goal is None:
            return ""
        return str(goal.second) if goal.first == name else str(goal.first) if goal.second == name else ""

    def _touched(self, name: str) -> set[str]:
        pairs = (pair for pair in self.driver.twin.contacts(self.driver.data) if name in pair)
        return {other for pair in pairs for other in pair if other != name}

    def _on_floor(self, name: str) -> bool:
        low = self.driver.twin.settings.floor + 0.5
        return bool(self.driver.pose(name)[2, 3] < low) or "world" in self._touched(name)

    def _speed(self, name: str) -> float:
        at = self.driver.twin.model.joint(name).dofadr[0]
        return float(np.linalg.norm(self.driver.data.qvel[at : at + 3]))


def _hand(robot: Robot, link: str) -> str:
    return next((name for name, hand in robot.hands.items() if link in robot.hand_of(hand.palm)), link)


def _text(point: Array) -> str:
    return "(" + ", ".join(f"{value:.2f}" for value in point) + ") m"
