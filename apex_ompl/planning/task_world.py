"""The world between the steps of a task: who holds what, what stands in the scene, and which contacts are allowed.

A world is a record; each step returns the next one. Names are checked by going through all steps once, before anything
is planned (:func:`check_steps`).
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from apex_ompl.constraints.frames import LinkFace, frame_of, holding_hand, holding_link
from apex_ompl.constraints.links import Links
from apex_ompl.errors import ApexError, FileFormatError, ParameterError, UnknownNameError
from apex_ompl.ompl.setup import workspace_goal
from apex_ompl.planning.line_query import tools_of
from apex_ompl.planning.query import planned_joints
from apex_ompl.robot import Robot
from apex_ompl.robot.model import link_of
from apex_ompl.scene.bodies import HOLDING, MOTION, AttachedObject, Body, Obstacle, given_fields, pose_fields
from apex_ompl.scene.problem import AnyStep, Goal, MoveStep, Problem
from apex_ompl.scene.steps import (
    AddStep,
    AllowStep,
    AttachStep,
    BodiesStep,
    DetachStep,
    GraspStep,
    HandedStep,
    HandStep,
    LineStep,
    ReleaseStep,
    RemoveStep,
    RetreatStep,
    Step,
    TakingStep,
    TogetherStep,
    TurnStep,
)
from apex_ompl.types import Array
from apex_ompl.util.schema import validate

Pair = tuple[str, str]


@dataclass(frozen=True)
class TaskWorld:
    """Obstacles, held objects and contacts that are allowed, during one step.

    Attributes:
        robot: The robot.
        scene: Obstacles by name, those that were released among them.
        held: Held objects by name.
        allowed: Pairs of bodies that may touch.
        leaving: Hand -> objects that it released and may still touch.
        away: Obstacles and fixtures that a step removed, by name.
    """

    robot: Robot
    scene: Mapping[str, Obstacle]
    held: Mapping[str, AttachedObject]
    allowed: frozenset[Pair]
    leaving: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    away: Mapping[str, Body] = field(default_factory=dict)

    @classmethod
    def of(cls, robot: Robot, problem: Problem) -> TaskWorld:
        """Return the world of a problem on the way to its goal."""
        scene, held = {o.name: o for o in problem.scene}, {one.name: one for one in problem.attached}
        return cls(robot, scene, held, frozenset(problem.allowed))

    @property
    def pairs(self) -> frozenset[Pair]:
        """Pairs that may touch, with those of hands and what they are leaving, and of fixtures that are away."""
        leaving = {pair for hand in self.leaving for pair in self.leaving_pairs(hand)}
        fixtures = [body.name for body in self.robot.fixtures if body.name in self.away]
        others = (*self.solid_links, *self.held) if fixtures else ()
        return self.allowed | leaving | {(other, name) for name in fixtures for other in others}

    @property
    def fixtures(self) -> tuple[Body, ...]:
        """Fixtures of the robot that no step removed."""
        return tuple(body for body in self.robot.fixtures if body.name not in self.away)

    @property
    def solid_links(self) -> frozenset[str]:
        """Names of the links that have a shape."""
        return frozenset(link_of(self.robot.model, item) for item in self.robot.geometry.geometryObjects)

    def leaving_pairs(self, hand: str) -> frozenset[Pair]:
        """Return the pairs of the links of a hand and the objects that it is leaving."""
        solid = self.solid_links
        links = [link for link in hand_links(self.robot, hand) if link in solid]
        return frozenset((link, name) for name in self.leaving.get(hand, ()) for link in links)

    def held_by(self, hand: str) -> tuple[str, ...]:
        """Return the names of the objects that a hand holds, alone or with another one."""
        links = hand_links(self.robot, hand)
        return tuple(name for name, one in self.held.items() if any(link in links for link in one.holders))

    def face(self, name: str, q: Array) -> tuple[Array, Array] | None:
        """Return center and outward axis of a contact face in the world, shape (3,) each, or None where there is none.

        Args:
            name: A hand, an obstacle or a held object.
            q: State, shape (dof,).
        """
        standing = self.scene.get(name)
        if standing is not None:
            pose, face = standing.pose, standing.contact
            if face is None:
                return None
            axis = pose[:3, :3] @ np.asarray(face.axis, float)
            return pose[:3, :3] @ np.asarray(face.point, float) + pose[:3, 3], axis / np.linalg.norm(axis)
        if name in self.robot.hands:
            fixed = LinkFace.of_hand(self.robot, name)
        elif name in self.held and self.held[name].contact is not None:
            fixed = LinkFace.of_object(self.held[name])
        else:
            return None
        pose = self.robot.link_pose(q, fixed.link)
        return pose[:3, :3] @ fixed.point + pose[:3, 3], pose[:3, :3] @ fixed.axis

    def problem(self, given: Problem, goal: Goal, q: Array) -> Problem:
        """Return the problem of going on from a state to a further goal.

        Args:
            given: The problem that the task is part of.
            goal: The goal.
            q: The state, shape (dof,).
        """
        start = dict(zip(self.robot.joint_names, q.tolist(), strict=True))
        goal = goal.with_joints(start)
        return given.model_copy(
            update={
                "scene": tuple(self.scene.values()), "attached": tuple(self.held.values()),
                "allowed": tuple(sorted(self.pairs)), "start": start, "goal": goal, "constraints": (), "after": (),
            }
        )  # fmt: skip

    def after(self, step: Step, q: Array) -> TaskWorld:
        """Return the world after a step that ends in a state, shape (dof,).

        Raises:
            ApexError: The hand or the object of the step is unknown, or not held.
        """
        if isinstance(step, ReleaseStep):
            return self._released(step, q)
        if isinstance(step, DetachStep):
            return self._let_go((step.object,), self.holder(step.object), False, q)
        if isinstance(step, AllowStep):
            pairs = {_pair(*pair) for pair in step.pairs}
            rest = {pair for pair in self.allowed if _pair(*pair) not in pairs}
            return replace(self, allowed=frozenset(rest | pairs if step.contact else rest))
        if isinstance(step, RemoveStep):
            return self._without(step.objects)
        if isinstance(step, AddStep):
            back = {name: body for name in step.objects if isinstance(body := self.away[name], Obstacle)}
            away = {name: body for name, body in self.away.items() if name not in step.objects}
            return replace(self, scene={**self.scene, **back}, away=away)
        if isinstance(step, TogetherStep):
            world = self
            for one in step.steps:
                world = world.after(one, q)
            return world
        if isinstance(step, TakingStep):
            return self.grasped(step, q)
        if isinstance(step, RetreatStep):
            return self.left((step.hand,))
        return self

    def left(self, hands: Collection[str]) -> TaskWorld:
        """Return the world in which hands have left what they released."""
        return replace(self, leaving={hand: names for hand, names in self.leaving.items() if hand not in hands})

    def during(self, step: Step, q: Array) -> TaskWorld:
        """Return the world during a step of hands that starts in a state, shape (dof,): with what it takes."""
        world = self
        for one in step.steps if isinstance(step, TogetherStep) else (step,):
            world = world.grasped(one, q) if isinstance(one, TakingStep) else world
        return world

    def _without(self, names: Sequence[str]) -> TaskWorld:
        """Return the world without obstacles and fixtures; pairs of obstacles that may touch are forgotten."""
        known = {**{body.name: body for body in self.robot.fixtures}, **self.scene}
        scene = {name: one for name, one in self.scene.items() if name not in names}
        allowed = frozenset(pair for pair in self.allowed if not {*names} & self.scene.keys() & {*pair})
        leaving = {hand: tuple(n for n in left if n not in names) for hand, left in self.leaving.items()}
        return replace(
            self, scene=scene, allowed=allowed, leaving={h: left for h, left in leaving.items() if left},
            away={**self.away, **{name: known[name] for name in names}},
        )  # fmt: skip

    def _released(self, step: ReleaseStep, q: Array) -> TaskWorld:
        names = self.held_by(step.hand) if step.objects is None else step.objects
        return self._let_go(names, step.hand, step.falls, q)

    def holder(self, name: str) -> str | None:
        """Return the hand that holds an object, or None where it is fixed to another link."""
        return holding_hand(self.robot, self.held[name].link)

    def _let_go(self, names: Sequence[str], hand: str | None, falls: bool, q: Array) -> TaskWorld:
        """Return the world without objects in a hand, or at the link that they are fixed to."""
        scene, held, gone = dict(self.scene), dict(self.held), set[str]()
        for name in names:
            one = held.pop(name)
            pose = self.robot.link_pose(q, one.link) @ one.pose
            mine = (one.link,) if hand is None else hand_links(self.robot, hand)
            others = [link for link in one.holders if link not in mine]
            if others:
                inside = np.linalg.inv(self.robot.link_pose(q, others[0])) @ pose
                fields: dict[str, Any] = given_fields(one, HOLDING)
                held[name] = _read(AttachedObject, {**fields, "link": others[0], **pose_fields(inside)})
            elif falls:
                gone.add(name)
            else:
                scene[name] = _read(Obstacle, {**given_fields(one, HOLDING), **pose_fields(pose)})
        allowed = frozenset(pair for pair in self.allowed if not gone & {*pair})
        leaving = self.leaving
        if hand is not None:
            left = (*self.leaving.get(hand, ()), *(name for name in names if name not in gone))
            leaving = {**self.leaving, hand: left} if left else self.leaving
        return replace(self, scene=scene, held=held, allowed=allowed, leaving=leaving)

    def grasped(self, step: TakingStep, q: Array) -> TaskWorld:
        """Return the world in which the object of a step is held, taken where it is at a state, shape (dof,)."""
        name, link = step.object, holding_link(self.robot, step.hand if isinstance(step, GraspStep) else step.link)
        scene, held = dict(self.scene), dict(self.held)
        if name in held:
            one = held[name]
            fields: dict[str, Any] = given_fields(one, ("links", "touch_links"))
            held[name] = _read(AttachedObject, {**fields, "links": (one.link, link)})
        else:
            obstacle = scene.pop(name)
            pose = np.linalg.inv(self.robot.link_pose(q, link)) @ obstacle.pose
            fields = {**given_fields(obstacle, MOTION), "link": link, **pose_fields(pose)}
            held[name] = _read(AttachedObject, fields)
        leaving = {hand: tuple(n for n in names if n != name) for hand, names in self.leaving.items()}
        return replace(self, scene=scene, held=held, leaving={h: n for h, n in leaving.items() if n})


def _pair(first: str, second: str) -> Pair:
    """Return two names in alphabetical order."""
    return (first, second) if first <= second else (second, first)


def hand_links(robot: Robot, hand: str) -> tuple[str, ...]:
    """Return the links of a hand by name."""
    return robot.hand_of(robot.hands[hand].palm)


def joints_above(robot: Robot, link: str) -> set[int]:
    """Return the planned joints that move a link."""
    links = Links.of(robot)
    return {*links.moved(links.point(link, np.zeros(3)).joint)}


def check_steps(robot: Robot, problem: Problem) -> None:
    """Check the names in the steps after the goal of a problem, and who holds what at each step.

    Raises:
        FileFormatError: A hand, a frame or an object is unknown, or a hand does not hold what it is to release; the
            message names the step.
    """
    world, q = TaskWorld.of(robot, problem), robot.within_limits(problem.start_state(robot.joint_names))
    if problem.after and problem.moving:
        raise FileFormatError(
            problem.source, "after", problem.moving[0], "expected no steps after the goal beside an obstacle that moves"
        )
    for k, step in enumerate(problem.after):
        for name, value, expected in _faults(world, step):
            raise FileFormatError(problem.source, f"after.{k}.{name}", value, expected)
        if isinstance(step, MoveStep):
            _check_move(world, problem, step, q, f"after.{k}")
        world = world.after(step, q)


def _check_move(world: TaskWorld, problem: Problem, step: MoveStep, q: Array, field: str) -> None:
    """Check the goal of a motion, and its joints.

    Raises:
        FileFormatError: One is unknown or faulty; the message names the step.
    """
    robot, source = world.robot, problem.source
    moved = world.problem(problem, step.goal, q)
    try:
        workspace_goal(robot, moved)
        moved.goal_states(robot.joint_names)
    except FileFormatError as error:
        raise FileFormatError(source, f"{field}.{error.field}", error.value, error.expected) from None
    except ApexError as error:
        expected = f"expected a possible goal ({error})"
        raise FileFormatError(source, f"{field}.goal", step.title, expected) from None
    try:
        planned_joints(robot, step.group or robot.joint_names)
    except UnknownNameError as error:
        expected = f"expected names of groups and joints ({error})"
        raise FileFormatError(source, f"{field}.group", error.name, expected) from None


def _faults(world: TaskWorld, step: AnyStep) -> Iterable[tuple[str, object, str]]:
    """Yield field, value and what was expected, for each fault of a step."""
    if isinstance(step, LineStep | TurnStep):
        yield from _frame_faults(world, step)
    elif isinstance(step, TogetherStep):
        for k, one in enumerate(step.steps):
            yield from ((f"steps.{k}.{name}", value, expected) for name, value, expected in _faults(world, one))
    elif isinstance(step, BodiesStep):
        yield from _body_faults(world, step)
    elif isinstance(step, HandedStep | RetreatStep):
        yield from _hand_faults(world, step)


def _body_faults(world: TaskWorld, step: BodiesStep) -> Iterable[tuple[str, object, str]]:
    if isinstance(step, AttachStep):
        if step.object not in world.scene:
            yield "object", step.object, f"expected an obstacle: {', '.join(world.scene) or 'there is none'}"
        elif world.scene[step.object].half_space is not None or world.scene[step.object].points is not None:
            yield "object", step.object, "expected a solid that can be held"
        if step.link not in (*world.robot.hands, *world.robot.link_names):
            yield "link", step.link, "expected a hand or a link of the robot"
    elif isinstance(step, DetachStep):
        if step.object not in world.held:
            yield "object", step.object, f"expected a held object: {', '.join(world.held) or 'there is none'}"
    elif isinstance(step, RemoveStep):
        there = (*world.scene, *(body.name for body in world.fixtures))
        expected = f"expected obstacles or fixtures: {', '.join(there) or 'there is none'}"
        yield from (("objects", name, expected) for name in step.objects if name not in there)
    elif isinstance(step, AddStep):
        expected = f"expected what a step removed: {', '.join(world.away) or 'nothing'}"
        yield from (("objects", name, expected) for name in step.objects if name not in world.away)
    elif isinstance(step, AllowStep):
        fixtures = [body.name for body in world.robot.fixtures]
        known = (*world.robot.link_names, *world.held, *world.scene, *fixtures)
        for name in (name for pair in step.pairs for name in pair):
            if name not in known:
                named = ", ".join((*world.held, *world.scene, *fixtures))
                yield "pairs", name, f"expected links of the robot, or: {named or 'there is no object'}"


def _hand_faults(world: TaskWorld, step: HandedStep | RetreatStep) -> Iterable[tuple[str, object, str]]:
    hands = world.robot.hands
    if step.hand not in hands:
        yield "hand", step.hand, f"expected a hand: {', '.join(hands) or 'the robot has none'}"
        return
    if isinstance(step, HandStep) and hands[step.hand].synergy is None:
        yield "hand", step.hand, "expected a hand that opens and closes"
    if isinstance(step, GraspStep):
        yield from _grasp_faults(world, step)
    if isinstance(step, ReleaseStep):
        mine = world.held_by(step.hand)
        if not mine:
            yield "hand", step.hand, "expected a hand that holds an object then"
        for name in step.objects or ():
            if name not in mine:
                yield "objects", name, f"expected an object that {step.hand} holds then: {', '.join(mine)}"


def _frame_faults(world: TaskWorld, step: LineStep | TurnStep) -> Iterable[tuple[str, object, str]]:
    robot = world.robot
    for name in step.frame:
        try:
            frame_of(robot, name, world.held)
        except UnknownNameError as error:
            yield "frame", name, f"expected a hand, a link or an object that is held then: {', '.join(error.known)}"
            return
        if isinstance(step, LineStep) and step.gap is not None and name not in world.held:
            yield "gap", step.gap, f"expected none, since {name!r} is no held object"
    try:
        tools_of(robot, step.frame, [frame_of(robot, name, world.held) for name in step.frame])
    except ParameterError as error:
        yield "frame", error.value, f"expected {error.expected}"
    onto = step.onto if isinstance(step, LineStep) else None
    for name in (step.frame[0], onto) if onto is not None else ():
        if world.face(name, robot.home) is None:
            known = name in world.held or name in world.scene
            expected = "a contact face" if known else "a hand, or a held or released object,"
            yield "onto" if name == onto else "frame", name, f"expected {expected} to align"


def _grasp_faults(world: TaskWorld, step: GraspStep) -> Iterable[tuple[str, object, str]]:
    one, synergy = world.held.get(step.object), world.robot.hands[step.hand].synergy
    if one is None and step.object not in world.scene:
        known = ", ".join((*world.held, *world.scene)) or "there is none"
        yield "object", step.object, f"expected an obstacle or a held object: {known}"
    if step.object in world.held_by(step.hand):
        yield "object", step.object, f"expected an object that {step.hand} does not hold yet"
    elif one is not None and len(one.holders) > 1:
        yield "object", step.object, "expected an object that one hand holds, not two"
    if step.to is not None and synergy is None:
        yield "to", step.to, "expected none, since the hand does not close"
    shape = world.scene.get(step.object)
    if shape is not None and (shape.half_space is not None or shape.points is not None):
        yield "object", step.object, "expected a solid that can be held"


def _read(kind: Any, given: dict[str, Any]) -> Any:
    try:
        return validate(kind, given, "task")
    except ApexError as error:
        raise AssertionError(f"a body of the world is faulty: {error}") from error
