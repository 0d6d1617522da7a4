"""Steps of a task at the same time: each arm goes on as soon as what it needs is done.

A task is planned one step after the other. Here its steps, in that order, are moved to the earliest time at which they
can start: after the steps before them of the same arms, or that hold, change or still touch the same objects, and where
all that goes on at once then is proved, in the world as it is at each time (sequential plans are executed so by
APEX-MR, Huang et al. 2025). A step that fits nowhere before starts when all others have ended, as it was planned. Steps
of the scene, and waits, are for all arms.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from math import isnan
from typing import NamedTuple

import numpy as np

from apex_ompl.constraints.links import Links
from apex_ompl.ompl.validity import full_check
from apex_ompl.paths.path import Path
from apex_ompl.planning.task_motion import changes
from apex_ompl.planning.task_result import AT_ONCE, GOAL, TaskResult, TaskStep
from apex_ompl.planning.task_steps import StepPlan, StepPlanner
from apex_ompl.planning.task_waypoints import LATE, StepFailed
from apex_ompl.planning.task_world import TaskWorld
from apex_ompl.result import PlanResult
from apex_ompl.robot import Robot
from apex_ompl.scene.problem import Problem
from apex_ompl.scene.steps import (
    AttachStep,
    DetachStep,
    SceneStep,
    TakingStep,
    TogetherStep,
    WaitStep,
)
from apex_ompl.timing import Trajectory
from apex_ompl.timing.combination import superposed
from apex_ompl.types import Array

SAME = 1e-9  # time between events that are one [s]
PARTS = 8  # of the time between the earliest start of a step and the last, at whose ends it is tried


@dataclass(frozen=True, eq=False)
class PlacedStep:
    """A step with its start.

    Attributes:
        plan: The step.
        start: When it starts [s].
    """

    plan: StepPlan
    start: float

    @property
    def motion(self) -> Trajectory:
        """Its motion."""
        assert self.plan.motion is not None
        return self.plan.motion

    @property
    def end(self) -> float:
        """When it ends [s]."""
        return self.start + self.motion.duration

    @property
    def done(self) -> float:
        """When the world changes by it [s]: a retreating hand leaves an object before its end."""
        return self.end if isnan(self.plan.left) else self.start + self.plan.left


@dataclass(frozen=True, eq=False)
class Interval:
    """A time in which the world stays the same.

    Attributes:
        start: When it starts [s].
        end: When it ends [s].
        steps: What goes on.
        ending: Steps that change the world at its end; of the first interval those at its start, too.
        world: The world.
        after: The world after it.
        motion: All motion in it.
        clearance: Least distance of a checked pair [m], NaN before it is proved.
    """

    start: float
    end: float
    steps: tuple[PlacedStep, ...]
    ending: tuple[PlacedStep, ...]
    world: TaskWorld
    after: TaskWorld
    motion: Trajectory
    clearance: float

    @property
    def title(self) -> str:
        """The titles of what goes on."""
        return " + ".join(one.plan.step.title for one in self.steps) or "rest"

    @property
    def changed(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Objects that are let go of at its end, and those that are taken."""
        pairs = [changes(one.plan.step, one.plan.world) for one in self.ending]
        return tuple(n for released, _ in pairs for n in released), tuple(n for _, grasped in pairs for n in grasped)


def whole_at_once(
    planner: StepPlanner, found: PlanResult, plans: Sequence[StepPlan], problem: Problem
) -> TaskResult | None:  # fmt: skip
    """Return the result of a task whose steps start as early as they can, or None where no time is left for that.

    Its steps are the times between events.

    Args:
        planner: Planner of its steps.
        found: The plan to its goal.
        plans: The timed plans of all steps, the motion to the goal first.
        problem: The problem.
    """
    try:
        placed = overlapped(planner, plans)
        intervals = proved(planner, placed)
    except StepFailed:
        return None
    motion, steps = whole_motion(placed), list[TaskStep]()
    for one in intervals:
        released, grasped = one.changed
        gone = tuple(name for name in released if name not in one.after.scene and name not in one.after.held)
        steps.append(TaskStep(
            one.steps[0].plan.step.kind if len(one.steps) == 1 else AT_ONCE, one.title, one.start, one.end,
            Path(one.motion.positions), one.clearance, tuple(one.world.scene.values()),
            tuple(one.world.held.values()), tuple(sorted(one.world.pairs)), released=released, grasped=grasped,
            gone=gone,
        ))  # fmt: skip
    steps[0] = replace(
        steps[0], kind=GOAL, title=GOAL if len(placed) == 1 else steps[0].title, scene=problem.scene,
        attached=problem.attached, allowed=problem.allowed,
    )  # fmt: skip
    uses = [found.limit_use, *(plan.use for plan in plans)]
    use = {name: max(one.get(name, 0.0) for one in uses) for name in dict.fromkeys(n for one in uses for n in one)}
    return replace(
        TaskResult.of(found), steps=tuple(steps), trajectory=motion,
        limit_use=use | dict(motion.use(planner.robot.limits)),
        motion_clearance=min(step.clearance for step in steps), deviation=max(plan.deviation for plan in plans),
    )  # fmt: skip


def shorter(first: TaskResult, second: TaskResult) -> bool:
    """Whether one result has a shorter motion than another one."""
    assert first.trajectory is not None and second.trajectory is not None
    return first.trajectory.duration < second.trajectory.duration


def overlapped(planner: StepPlanner, plans: Sequence[StepPlan]) -> list[PlacedStep]:
    """Return the steps of a task, each at the earliest time that is found.

    Args:
        planner: Planner of the steps; its checker is used.
        plans: The timed steps in their order.

    Raises:
        StepFailed: No time is left.
    """
    placed, first = list[PlacedStep](), plans[0].world
    needs = [_needs(planner.robot, plan) for plan in plans]
    for k, plan in enumerate(plans):
        waited = [_free_at(one, its, needs[k]) for one, its in zip(placed, needs, strict=False)]
        earliest, last = max(waited, default=0.0), max((one.end for one in placed), default=0.0)
        for start in (*_starts(placed, earliest, last), last):
            if planner.ended:
                raise StepFailed(LATE)
            trial = [*placed, PlacedStep(plan, start)]
            if start >= last or all(_clearance(planner, one) is not None for one in _intervals(first, trial, start)):
                placed = trial
                break
    return placed


def proved(planner: StepPlanner, placed: Sequence[PlacedStep]) -> list[Interval]:
    """Return the times between the events of steps, each proved.

    Raises:
        StepFailed: One is not free.
    """
    found = list[Interval]()
    for one in _intervals(placed[0].plan.world, placed, 0.0):
        clearance = _clearance(planner, one)
        if clearance is None:
            raise StepFailed(f"{one.title} cannot be done at once")
        found.append(replace(one, clearance=clearance))
    return found


def whole_motion(placed: Sequence[PlacedStep]) -> Trajectory:
    """Return the motion of all joints through all steps."""
    motion = superposed([(one.motion, one.start) for one in sorted(placed, key=lambda one: one.start)])
    motion.positions[0] = placed[0].motion.positions[0]  # bit for bit
    return motion


def _starts(placed: Sequence[PlacedStep], earliest: float, last: float) -> list[float]:
    """Return times before the last one at which a step may start, in their order."""
    events = {one.end for one in placed if earliest < one.end < last}
    parts = set((earliest + (last - earliest) * np.arange(PARTS) / PARTS).tolist()) if earliest < last else set()
    return sorted(events | parts)


def _clearance(planner: StepPlanner, interval: Interval) -> float | None:
    """Return the least distance of a checked pair in an interval [m], or None where it is not free."""
    planner.become(interval.world)
    check = full_check(planner.checker, interval.motion)
    return check.proof.clearance if check and check.proof is not None else None


def _intervals(world: TaskWorld, placed: Sequence[PlacedStep], since: float) -> Iterator[Interval]:
    """Yield the times between events from one on, not proved yet."""
    motion = whole_motion(placed)
    events = sorted(
        [(one.start, k, False) for k, one in enumerate(placed)] + [(one.done, k, True) for k, one in enumerate(placed)]
    )
    times = sorted({time for time, *_ in events} | {one.end for one in placed})
    times = [time for k, time in enumerate(times) if not k or time - times[k - 1] > SAME]
    for start, end in pairwise(times):
        world = _changed(world, placed, motion, [one for one in events if one[0] <= start + SAME])
        events = [one for one in events if one[0] > start + SAME]
        if end > since + SAME:
            going = tuple(one for one in placed if one.start < end - SAME and one.end > start + SAME)
            after = _changed(world, placed, motion, [one for one in events if one[0] <= end + SAME])
            begin = start + SAME if start > times[0] else -np.inf
            ending = tuple(one for one in placed if begin < one.done <= end + SAME)
            yield Interval(start, end, going, ending, world, after, motion.before(end).after(start), float("nan"))


def _changed(
    world: TaskWorld, placed: Sequence[PlacedStep], motion: Trajectory, events: Sequence[tuple[float, int, bool]]
) -> TaskWorld:
    """Return the world after events: objects are taken when a step starts, and let go of when it is done."""
    for time, k, done in sorted(events, key=lambda event: (event[1], event[2])):
        step = placed[k].plan.step
        for one in step.steps if isinstance(step, TogetherStep) else (step,):
            if done != isinstance(one, TakingStep):
                world = world.after(one, motion(min(time, motion.duration)))
    return world


def joints_of_hands(robot: Robot) -> dict[str, set[int]]:
    """Return the numbers of the planned joints of each hand: those that move its palm, and its own."""
    links, found = Links.of(robot), dict[str, set[int]]()
    for name, hand in robot.hands.items():
        found[name] = {*links.moved(links.point(hand.palm, np.zeros(3)).joint)}
        if hand.synergy is not None:
            found[name].add(robot.joint_names.index(hand.synergy))
    return found


def joints_needed(robot: Robot, start: Array, goals: Sequence[Array]) -> list[str] | None:
    """Return names of the joints of the hands that move from a start to goals, or None where all joints are needed.

    Args:
        robot: The robot.
        start: The start, shape (dof,).
        goals: The goals, shape (dof,) each.
    """
    moved = set(np.flatnonzero((np.array(goals) != start).any(axis=0)).tolist())
    joints = set[int]().union(*(mine for mine in joints_of_hands(robot).values() if mine & moved))
    if not moved or not moved <= joints or len(joints) == robot.dof:
        return None
    return [robot.joint_names[k] for k in sorted(joints)]


class _Needs(NamedTuple):
    """What a step needs for itself.

    Attributes:
        hands: Hands that it moves, opens or closes.
        objects: Objects that these hold, take, let go of, or still touch.
    """

    hands: frozenset[str]
    objects: frozenset[str]


def _free_at(one: PlacedStep, its: _Needs | None, mine: _Needs | None) -> float:
    """Return the time from which on a step leaves free what another one needs [s]; None needs all."""
    if its is None or mine is None or its.hands & mine.hands:
        return one.end
    return one.done if its.objects & mine.objects else 0.0


def _needs(robot: Robot, plan: StepPlan) -> _Needs | None:
    """Return what a step needs for itself, or None where it needs all."""
    step, moved = plan.step, set(np.flatnonzero((plan.path.states != plan.path.states[0]).any(axis=0)).tolist())
    parts = step.steps if isinstance(step, TogetherStep) else (step,)
    if any(isinstance(one, WaitStep | SceneStep) for one in parts):
        return None
    detached = {plan.world.holder(one.object) for one in parts if isinstance(one, DetachStep)}
    fixed = [one for one in parts if isinstance(one, AttachStep) and one.link not in robot.hands]
    hands = {
        name for name, joints in joints_of_hands(robot).items()
        if joints & moved or name in detached
        or any(name in (getattr(one, "hand", None), getattr(one, "link", None)) for one in parts)
    }  # fmt: skip
    if not hands or fixed or None in detached:
        return None
    worlds, objects = (plan.world, plan.after), set[str]()
    for hand in hands:
        objects.update(*(world.held_by(hand) for world in worlds), *(world.leaving.get(hand, ()) for world in worlds))
    for one in parts:
        objects.update(*changes(one, plan.world))
    return _Needs(frozenset(hands), frozenset(objects))
