"""Steps of a task at the same time: each arm goes on as soon as what it needs is done.

A task is planned one step after the other. Here its steps, in that order, are moved to the earliest time at which they
can start: after the steps before them of the same arms, or that hold, change or still touch the same objects, and where
all that goes on at once then is proved, in the world as it is at each time (sequential plans are executed so by
APEX-MR, Huang et al. 2025). A step that fits nowhere before starts when all others have ended, as it was planned. The
motion to the goal, steps of the scene, and waits are for all arms.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from math import isnan
from typing import NamedTuple

import numpy as np

from apex_ompl.constraints.frames import holding_link
from apex_ompl.errors import RobotError
from apex_ompl.goals.arms import Arm, arms_of
from apex_ompl.paths.path import Path
from apex_ompl.planning.task_motion import changes
from apex_ompl.planning.task_result import AT_ONCE, StepTimes, TaskResult, TaskStep
from apex_ompl.planning.task_steps import StepPlan, StepPlanner, most_used
from apex_ompl.planning.task_waypoints import LATE, StepFailed
from apex_ompl.planning.task_world import TaskWorld, joints_above
from apex_ompl.result import PlanResult
from apex_ompl.robot import Robot
from apex_ompl.scene.steps import (
    AttachStep,
    DetachStep,
    HandedStep,
    RetreatStep,
    SceneStep,
    Step,
    TakingStep,
    WaitStep,
    parts,
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

    def recorded(self) -> TaskStep:
        """Return it as a step of a result."""
        kind = self.steps[0].plan.step.kind if len(self.steps) == 1 else AT_ONCE
        title = " + ".join(one.plan.step.title for one in self.steps) or "rest"
        pairs = [changes(one.plan.step, one.plan.world) for one in self.ending]
        released, grasped = (tuple(name for pair in pairs for name in pair[k]) for k in range(2))
        gone = tuple(name for name in released if name not in self.after.scene and name not in self.after.held)
        return TaskStep(
            kind, title, self.start, self.end, Path(self.motion.positions), self.clearance,
            tuple(self.world.scene.values()), tuple(self.world.held.values()), tuple(sorted(self.world.pairs)),
            released=released, grasped=grasped, gone=gone,
        )  # fmt: skip


def whole_at_once(
    planner: StepPlanner, made: TaskResult, found: PlanResult, plans: Sequence[StepPlan]
) -> TaskResult:  # fmt: skip
    """Return the result of a task whose steps start as early as they can, or the given one where that is not shorter.

    After the motion to the goal, which is done alone, its steps are the times between events.

    Args:
        planner: Planner of its steps.
        made: The result with one step after the other, timed.
        found: The plan to its goal.
        plans: The timed plans of all steps, the motion to the goal first.
    """
    assert made.trajectory is not None
    try:
        placed = overlapped(planner, plans)
        motion = whole_motion(placed)
        if motion.duration >= made.trajectory.duration:
            return made
        times = proved(planner, placed)
    except StepFailed:  # no time is left
        return made
    goal, steps = made.steps[0], [one.recorded() for one in times]
    goal = replace(goal, end=placed[0].end, clearance=plans[0].clearance, blended=False)
    if goal.end > SAME:
        first = steps.pop(0)
        goal = replace(goal, released=first.released, grasped=first.grasped, gone=first.gone)
    steps.insert(0, goal)
    uses = most_used([found.limit_use, *(plan.use for plan in plans)])
    return replace(
        made, steps=tuple(steps), trajectory=motion, limit_use=uses | dict(motion.use(planner.robot.limits)),
        motion_clearance=min(step.clearance for step in steps), notes=found.notes,
        schedule=tuple(StepTimes(one.start, one.end, one.done) for one in placed),
    )  # fmt: skip


def overlapped(planner: StepPlanner, plans: Sequence[StepPlan]) -> list[PlacedStep]:
    """Return the steps of a task, each at the earliest time that is found.

    Args:
        planner: Planner of the steps; its checker is used.
        plans: The timed steps in their order, the motion to the goal first.

    Raises:
        StepFailed: No time is left.
    """
    placed, first = list[PlacedStep](), plans[0].world
    needs = [None, *(_needs(planner.robot, plan) for plan in plans[1:])]
    for k, plan in enumerate(plans):
        waited = [_free_at(one, its, needs[k]) for one, its in zip(placed, needs, strict=False)]
        earliest, last = max(waited, default=0.0), max((one.end for one in placed), default=0.0)
        for start in (*_starts(placed, earliest, last), last):
            if planner.ends():
                raise StepFailed(LATE)
            trial = [*placed, PlacedStep(plan, start)]
            if start >= last or _is_free(planner, _intervals(first, trial, start)):
                placed = trial
                break
    return placed


def proved(planner: StepPlanner, placed: Sequence[PlacedStep]) -> list[Interval]:
    """Return the times between the events of steps, each proved.

    Raises:
        StepFailed: One is not free, or no time is left.
    """
    times = _intervals(placed[0].plan.world, placed, 0.0)
    return [replace(one, clearance=planner.proved(one.world, one.motion).clearance) for one in times]


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


def _is_free(planner: StepPlanner, times: Iterable[Interval]) -> bool:
    """Whether all that goes on in some times is free."""
    try:
        for one in times:
            planner.proved(one.world, one.motion)
    except StepFailed:
        return False
    return True


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
        for one in parts([placed[k].plan.step]):
            if done != isinstance(one, TakingStep):
                world = world.after(one, motion(min(time, motion.duration)))
        plan = placed[k].plan
        world = world.left(plan.world.leaving.keys() - plan.after.leaving.keys() if done else plan.parted)
    return world


def joints_needed(robot: Robot, start: Array, goals: Sequence[Array]) -> list[str] | None:
    """Return names of the joints of the arms that move from a start to goals, or None where all joints are needed.

    Args:
        robot: The robot.
        start: The start, shape (dof,).
        goals: The goals, shape (dof,) each.
    """
    arms = _arms_with(robot, set(np.flatnonzero((np.array(goals) != start).any(axis=0)).tolist()))
    joints = set[int]().union(*(arm.joints for arm in arms or ()))
    return None if not arms or len(joints) == robot.dof else [robot.joint_names[k] for k in sorted(joints)]


class _Needs(NamedTuple):
    """What a step needs for itself.

    Attributes:
        arms: Names of the arms that it moves, or whose hands it opens or closes.
        objects: Objects that these hold, take, let go of, or still touch.
    """

    arms: frozenset[str]
    objects: frozenset[str]


def _free_at(one: PlacedStep, its: _Needs | None, mine: _Needs | None) -> float:
    """Return the time from which on a step leaves free what another one needs [s]; None needs all."""
    if its is None or mine is None or its.arms & mine.arms:
        return one.end
    return one.done if its.objects & mine.objects else 0.0


def _needs(robot: Robot, plan: StepPlan) -> _Needs | None:
    """Return what a step needs for itself, or None where it needs all."""
    steps, states = parts([plan.step]), plan.path.states
    if any(isinstance(one, WaitStep | SceneStep) for one in steps):
        return None
    moved = set(np.flatnonzero((states != states[0]).any(axis=0)).tolist())
    links = [_link_of(robot, one, plan.world) for one in steps]
    arms = _arms_with(robot, moved, [link for link in links if link is not None])
    if not arms:
        return None
    mine, objects = set[int]().union(*(arm.joints for arm in arms)), set[str]()
    for world in (plan.world, plan.after):
        objects.update(
            name for name, held in world.held.items() if any(joints_above(robot, link) & mine for link in held.holders)
        )
        left = world.leaving.items()
        objects.update(n for hand, names in left if joints_above(robot, robot.hands[hand].palm) & mine for n in names)
    objects.update(*(name for one in steps for name in changes(one, plan.world)))
    return _Needs(frozenset(arm.name for arm in arms), frozenset(objects))


def _link_of(robot: Robot, step: Step, world: TaskWorld) -> str | None:
    """Return the link whose hand a step moves, or that takes or leaves an object; None of other steps."""
    if isinstance(step, DetachStep):
        return world.held[step.object].link
    if isinstance(step, AttachStep):
        return holding_link(robot, step.link)
    return robot.hands[step.hand].palm if isinstance(step, HandedStep | RetreatStep) else None


def _arms_with(robot: Robot, moved: set[int], links: Sequence[str] = ()) -> list[Arm] | None:
    """Return the arms that have some joints or links, or None where one is of no arm."""
    try:
        arms = arms_of(robot)
    except RobotError:  # it has none
        return None
    above = [joints_above(robot, link) for link in links]
    of_arms = set[int]().union(*(arm.joints for arm in arms))
    if not moved <= of_arms or not all(joints & of_arms for joints in above):
        return None
    return [arm for arm in arms if {*arm.joints} & moved.union(*above)]
