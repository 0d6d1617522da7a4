"""Stages of a plan: its parts between the times at which hands close or open, where the robot has to be at rest.

A stage is a step of a plan, or some that are blended. Where arms do steps at once, one arm may be moving while the hand
of the other one closes: there the whole motion stops along its path (:func:`apex_ompl.timing.rests.from_rest_to_rest`),
since what is proved is where the arms are at the same time.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from operator import itemgetter

import numpy as np

from apex_ompl.drivers.grasps import holder_of
from apex_ompl.drivers.vessels import filled
from apex_ompl.physics.judges import Intended
from apex_ompl.planning.task_result import TaskResult, TaskStep
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import AttachedObject
from apex_ompl.scene.problem import Problem
from apex_ompl.scene.steps import (
    AddStep,
    AttachStep,
    DetachStep,
    GraspStep,
    ReleaseStep,
    RemoveStep,
    Step,
    parts,
)
from apex_ompl.timing.rests import from_rest_to_rest
from apex_ompl.timing.trajectory import Trajectory

STEEPEST = 0.3  # ratio of level acceleration to gravity of what stands on a tray, and of liquids, at most
GRAVITY = 9.81  # [m/s^2]
SAMPLES = 400  # of a motion
SAME = 1e-6  # between times that are one [s]

ActingStep = GraspStep | ReleaseStep | AttachStep | DetachStep | RemoveStep | AddStep
"""A step in which something happens besides the motion."""


@dataclass(frozen=True, eq=False)
class Stage:
    """A part of a plan from rest to rest.

    Attributes:
        title: What is done, in one line.
        motion: Its motion.
        attached: Objects held at its end.
        allowed: Pairs of bodies that may touch during it.
        begun: Steps that begin in it and last, and when [s].
        done: Steps that are done at its end.
    """

    title: str
    motion: Trajectory
    attached: tuple[AttachedObject, ...]
    allowed: tuple[tuple[str, str], ...]
    begun: tuple[tuple[float, Step], ...] = ()
    done: tuple[Step, ...] = ()


def stages(robot: Robot, plan: TaskResult) -> list[Stage]:
    """Return the stages of a plan with a motion, slowed down where what stands or flows would fall or spill.

    Args:
        robot: The robot.
        plan: The plan.

    Raises:
        ParameterError: The motion cannot stop along its path within the limits of the robot.
    """
    return list(_at_once(robot, plan) if plan.schedule else _in_turn(robot, plan))


def _in_turn(robot: Robot, plan: TaskResult) -> Iterator[Stage]:
    """Yield the stages of steps one after the other."""
    assert plan.trajectory is not None
    start: float | None = None  # of motions that go over into each other
    for planned, step in zip(plan.steps, (None, *plan.problem.after), strict=True):
        start = planned.start if start is None else start
        if planned.blended:
            continue
        motion = motion_of(robot, plan.problem, plan.trajectory, replace(planned, start=start))
        steps = parts([step])
        begun = tuple((0.0, one) for one in steps) if motion.duration > 0.0 else ()
        yield Stage(planned.title, motion, planned.attached, planned.allowed, begun, steps)
        start = None


def _at_once(robot: Robot, plan: TaskResult) -> Iterator[Stage]:
    """Yield the stages of steps of several arms at once."""
    assert plan.trajectory is not None
    steps = list(zip(plan.schedule[1:], plan.problem.after, strict=True))
    acting = [when.done for when, step in steps if any(isinstance(one, ActingStep) for one in parts([step]))]
    ends = sorted([*acting, plan.trajectory.duration])
    stops = [time for k, time in enumerate(ends) if ends[k + 1 :] == [] or ends[k + 1] > time + SAME]
    for start, end in pairwise([-np.inf, *stops]):
        begin = max(start, 0.0)
        during = [one for one in plan.steps if one.start < end - SAME and one.end > begin + SAME]
        planned = during or [plan.steps[0]]  # as nothing lasts before a stop at 0
        motion, there, times = from_rest_to_rest(plan.trajectory, begin, end, robot.limits)
        slow = 1.0 / min(_gentle_speed(robot, plan.problem, one.attached, motion) for one in planned)
        begun = [
            (slow * float(np.interp(when.start, there, times)), one) for when, step in steps for one in parts([step])
            if begin - SAME < when.start < end - SAME and when.done > when.start + SAME
        ]  # fmt: skip
        yield Stage(
            ", ".join(dict.fromkeys(one.title for one in planned)), motion.slower(slow), planned[-1].attached,
            tuple({pair: None for one in planned for pair in one.allowed}), tuple(sorted(begun, key=itemgetter(0))),
            parts(step for when, step in steps if start + SAME < when.done <= end + SAME),
        )  # fmt: skip


def motion_of(robot: Robot, problem: Problem, motion: Trajectory, step: TaskStep) -> Trajectory:
    """Return the part of a motion that is a step, slowed down where what stands or flows would fall or spill.

    Args:
        robot: The robot.
        problem: The problem.
        motion: The motion through all steps.
        step: The step, at rest at both ends.
    """
    first, last = (int(np.argmin(np.abs(motion.times - time))) for time in (step.start, step.end))
    inside = slice(first, last + 1)
    times = motion.times[inside] - motion.times[first]
    part = Trajectory(
        times, motion.positions[inside], motion.velocities[inside], motion.accelerations[inside], motion.joint_names
    )  # fmt: skip
    return part.slower(1.0 / _gentle_speed(robot, problem, step.attached, part))


def _gentle_speed(robot: Robot, problem: Problem, attached: Iterable[AttachedObject], motion: Trajectory) -> float:
    """Return the factor of the speed of a motion at which nothing that stands or flows falls or spills."""
    full = filled(problem)
    loose = [held for held in attached if held.touch_links == () or held.name in full]
    return min((_gentle(robot, held, motion) for held in loose), default=1.0)


def _gentle(robot: Robot, held: AttachedObject, motion: Trajectory) -> float:
    """Return the factor of the speed of a motion at which an object's level acceleration is small enough."""
    if motion.duration <= 0.0:
        return 1.0
    times = np.linspace(0.0, motion.duration, SAMPLES)
    places = np.array([(robot.link_pose(q, held.link) @ held.pose)[:3, 3] for q in motion(times)])
    a = np.diff(places, 2, axis=0) / (times[1] - times[0]) ** 2
    need = np.linalg.norm(a[:, :2], axis=1) - STEEPEST * a[:, 2]
    return float(min(1.0, np.sqrt(STEEPEST * GRAVITY / max(float(need.max()), 1e-9))))


def let_go(robot: Robot, stage: Stage, step: ReleaseStep | DetachStep) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the objects that a step at the end of a stage lets go of, and the links that hold them no more."""
    held = {one.name: one for one in stage.attached}
    if isinstance(step, DetachStep):
        return (step.object,), holder_of(robot, held[step.object])[1]
    links = robot.hand_of(robot.hands[step.hand].palm)
    names = held if step.objects is None else step.objects
    return tuple(name for name in names if set(held[name].holders) & set(links)), links


def intended(robot: Robot, made: Sequence[Stage]) -> Mapping[str, Intended]:
    """Return where a plan has the objects at the end."""
    found: dict[str, Intended] = {}
    for stage in made:
        held = {one.name: one for one in stage.attached}
        found |= {name: Intended(name, one.link, one.pose) for name, one in held.items()}
        for step in stage.done:
            if not isinstance(step, ReleaseStep | DetachStep):
                continue
            names, links = let_go(robot, stage, step)
            end, falls = stage.motion.positions[-1], isinstance(step, ReleaseStep) and step.falls
            for name in names:
                pose = robot.link_pose(end, held[name].link) @ held[name].pose
                others = [link for link in held[name].holders if link not in links]
                if others:
                    pose = np.linalg.inv(robot.link_pose(end, others[0])) @ pose
                found[name] = Intended(name, others[0] if others else "", pose, falls and not others)
    return found
