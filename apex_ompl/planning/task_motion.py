"""One motion through all steps of a task, with blends between them, and the records of the steps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from math import isnan, nan

import numpy as np

from apex_ompl.collision import CollisionChecker
from apex_ompl.constraints.links import Links
from apex_ompl.ompl.validity import full_check
from apex_ompl.planning.task_result import GOAL, TaskResult, TaskStep
from apex_ompl.planning.task_steps import StepPlan, StepPlanner, most_used, timing_in
from apex_ompl.planning.task_world import TaskWorld
from apex_ompl.result import PlanResult
from apex_ompl.robot import load_robot
from apex_ompl.scene.problem import Problem
from apex_ompl.scene.steps import DetachStep, MotionStep, ReleaseStep, Step, TakingStep, parts
from apex_ompl.timing import Timing, Trajectory
from apex_ompl.timing.combination import superposed
from apex_ompl.timing.trajectory import ROUNDING, joined
from apex_ompl.types import Array

SHARES = (0.5, 0.4, 0.3, 0.2, 0.1, 0.05)  # of the shorter motion, by which two motions may overlap
SAMPLES = 24  # at which the distance of hands from where a step ends is taken


@dataclass(frozen=True, eq=False)
class _Blend:
    """A motion that starts before the one before it ends.

    Attributes:
        overlap: For how long both go on [s].
        clearance: Least distance of a checked pair then [m].
        use: Largest share of each limit then.
    """

    overlap: float
    clearance: float
    use: Mapping[str, float]


def whole(
    planner: StepPlanner, found: PlanResult, plans: Sequence[StepPlan], problem: Problem, timing: Timing | None
) -> TaskResult:
    """Return the result of a task.

    Args:
        planner: Planner of its steps.
        found: The plan to its goal.
        plans: The plans of all steps, the motion to the goal first.
        problem: The problem.
        timing: How motions are timed, or None for paths alone.
    """
    motions = [plan.motion for plan in plans if plan.motion is not None]
    timed = timing is not None and len(motions) == len(plans)
    tried = [blend(planner, *pair, timing) if timing is not None and timed else None for pair in pairwise(plans)]
    blends = [one if isinstance(one, _Blend) else None for one in tried]
    rests = zip(plans, tried, strict=False)
    notes = [f"the robot rests after {plan.step.title}: {why}" for plan, why in rests if isinstance(why, str)]
    starts, ends, clock = list[float](), list[float](), 0.0
    for plan, after in zip(plans, [*blends, None], strict=True):
        starts.append(clock if timed else nan)
        clock += nan if plan.motion is None else plan.motion.duration
        clock -= 0.0 if after is None else after.overlap
        ends.append(clock if timed else nan)
    steps = []
    for k, plan in enumerate(plans):
        before, after = (blends[k - 1] if k else None), (blends[k] if k < len(blends) else None)
        start = starts[k] + (0.0 if before is None else before.overlap / 2.0)
        end = ends[k] + (0.0 if after is None else after.overlap / 2.0)
        one = _record(plan, starts[k], start, end, after is not None)
        if k == 0:
            one = replace(
                one, kind=GOAL, title=GOAL, scene=problem.scene, attached=problem.attached, allowed=problem.allowed
            )  # fmt: skip
        clear = [b.clearance for b in (before, after) if b is not None]
        steps.append(replace(one, clearance=min([one.clearance, *clear])))
    result = replace(TaskResult.of(found), steps=tuple(steps), notes=(*found.notes, *notes))
    if not timed:
        return result
    motion = _through(motions, starts, [one is not None for one in blends])
    uses = [found.limit_use, *(plan.use for plan in plans), *(one.use for one in blends if one is not None)]
    return replace(
        result, trajectory=motion, limit_use=most_used(uses) | dict(motion.use(planner.robot.limits)),
        motion_clearance=min(step.clearance for step in steps), deviation=max(plan.deviation for plan in plans),
    )  # fmt: skip


def _through(motions: Sequence[Trajectory], starts: Sequence[float], blended: Sequence[bool]) -> Trajectory:
    """Return one motion through others, some of which start before the one before them ends.

    Args:
        motions: The motions.
        starts: When each starts [s].
        blended: Whether each but the last one overlaps with the next one.
    """
    parts, first = list[Trajectory](), 0
    for k in range(len(motions)):
        if k + 1 < len(motions) and blended[k]:
            continue
        one = motions[k]
        if k > first:
            one = superposed([(motions[i], starts[i] - starts[first]) for i in range(first, k + 1)])
            one.positions[0], one.positions[-1] = motions[first].positions[0], motions[k].positions[-1]  # bit for bit
        parts.append(one)
        first = k + 1
    return joined(parts)


def blend(planner: StepPlanner, first: StepPlan, second: StepPlan, timing: Timing) -> _Blend | str | None:
    """Return the longest overlap of two motions that is proved, why there is none, or None where none is wanted.

    The hands stay within the radius of the first step around where they are at its end, all limits are kept, and the
    overlap is free of collision in the world of the second step.
    """
    radius = first.step.blend if isinstance(first.step, MotionStep) else None
    if radius is None:
        return None
    if not isinstance(second.step, MotionStep) or first.motion is None or second.motion is None:
        return f"{second.step.title} is no motion of the arms"
    same = dict(first.world.scene) == dict(second.world.scene) and dict(first.world.held) == dict(second.world.held)
    if not same:
        return "other objects are held then"
    if min(first.motion.duration, second.motion.duration) <= 0.0:
        return None
    world, robot = second.world, planner.robot
    how = timing_in(world, timing)
    scaled = how.limits(robot.limits, robot.joint_names)
    more = how.motion_limits(robot, tuple(world.held.values()), planner.problem.payload)
    planner.become(world)
    why = "the hand is leaving an object until its end"
    for share in SHARES:
        overlap = share * min(first.motion.duration, second.motion.duration)
        begin = first.motion.duration - overlap
        if not isnan(first.left) and begin <= first.left:
            continue
        both = superposed([(first.motion, 0.0), (second.motion, begin)]).before(first.motion.duration).after(begin)
        if _distance(planner.checker, both, first.motion.positions[-1]) > radius:
            why = f"hands would leave the radius of {radius:g} m"
            continue
        use = both.use(robot.limits) | ({} if more is None else more.use(both))
        kept = both.use(scaled) | ({} if more is None else more.use(both))
        if max(kept.values()) > 1.0 + ROUNDING:
            most = max(kept, key=lambda name: kept[name])
            why = f"the two motions at once would take {kept[most]:.2f} of the limit of {most}"
            continue
        check = full_check(planner.checker, both)
        if check and check.proof is not None:
            return _Blend(overlap, check.proof.clearance, use)
        why = check.reason
    return f"in the shortest overlap, {why}"


def _distance(checker: CollisionChecker, motion: Trajectory, corner: Array) -> float:
    """Return the largest distance of the origins of hands from where they are at a state, shape (dof,) [m]."""
    robot, worst = checker.robot, 0.0
    states = np.concatenate([corner[None], motion(np.linspace(0.0, motion.duration, SAMPLES))])
    turns, origins = checker.kernel.joint_frames(states)
    for hand in robot.hands.values():
        joint, point = Links.of(robot).point(hand.palm, hand.point)
        places = origins[:, joint] + (turns[:, joint] * np.asarray(point, float)).sum(axis=2)
        between = np.linalg.norm(np.diff(places[1:], axis=0), axis=1).max() / 2.0
        worst = max(worst, float(np.linalg.norm(places[1:] - places[0], axis=1).max() + between))
    return worst


def _record(plan: StepPlan, begin: float, start: float, end: float, blended: bool) -> TaskStep:
    """Return the record of a step that was planned.

    Args:
        plan: The step.
        begin: Time at which its own motion starts [s].
        start: Time at which it takes over from the step before it [s].
        end: Time at which the step after it does [s].
        blended: Whether the robot goes on then.
    """
    step, world, after = plan.step, plan.world, plan.after
    released, grasped = changes(step, world)
    hands = world.leaving.keys() - after.leaving.keys()
    leaving = {pair for hand in hands for pair in world.leaving_pairs(hand)}
    gone = tuple(name for name in released if name not in after.scene and name not in after.held)
    left = plan.left if plan.motion is None else begin + plan.left
    return TaskStep(
        step.kind, step.title, start, end, plan.path, plan.clearance, tuple(world.scene.values()),
        tuple(world.held.values()), tuple(sorted(world.pairs)), left, tuple(sorted(leaving)), released, grasped, gone,
        blended,
    )  # fmt: skip


def changes(step: Step, world: TaskWorld) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the objects that a step lets go of, and those that it takes."""
    released, grasped = list[str](), list[str]()
    for one in parts([step]):
        if isinstance(one, ReleaseStep):
            released += one.objects or world.held_by(one.hand)
        elif isinstance(one, DetachStep):
            released.append(one.object)
        elif isinstance(one, TakingStep):
            grasped.append(one.object)
    return tuple(released), tuple(grasped)


def task_fault(result: TaskResult, motion: Trajectory) -> str:
    """Return why a motion with the times of a task's steps is not free in the scenes of these, or an empty text.

    Args:
        result: The task.
        motion: A motion such as its own, or that at another rate.
    """
    robot = load_robot(result.problem.robot)
    for step in result.steps:
        checker = CollisionChecker(robot, step.scene, step.attached, step.allowed)
        check = full_check(checker, _between(motion, step.start, step.end))
        if check and not isnan(step.left):
            for pair in step.leaving:
                checker.allow(*pair, allowed=False)
            check = full_check(checker, _between(motion, step.left, step.end))
        if not check:
            return f"{step.title}: {check.reason}"
    return ""


def _between(motion: Trajectory, start: float, end: float) -> Trajectory:
    """Return the part of a motion between two times [s]."""
    return motion.before(end).after(start)
