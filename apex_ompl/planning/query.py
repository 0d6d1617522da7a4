"""Input of plans: starts, goals, groups of joints and dynamic obstacles."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, TypeGuard, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from apex_ompl.collision.proved_share import share_note
from apex_ompl.errors import ParameterError
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.scene.problem import GOALS, Alignment, Goal, PoseTarget, Problem
from apex_ompl.types import Array
from apex_ompl.util.schema import validate
from apex_ompl.util.validation import check_name, finite_array

State = str | Mapping[str, float] | ArrayLike
"""A state: the name of one of the robot's poses, values by joint name, or all of them in the robot's order, shape
(dof,) [rad; synergies 0..1]."""

GOAL_STATES, GOAL_ATTEMPTS = 8, 200  # states that are taken of a user's sampler, and draws for them


@runtime_checkable
class GoalSampler(Protocol):
    """A goal that a user's object draws states of."""

    def sample(self, rng: np.random.Generator) -> ArrayLike | None:
        """Return a state that reaches the goal, shape (dof,), or None where this draw finds none."""


@dataclass(frozen=True)
class AnyOf:
    """Goals of which any will do, such as hundreds of grasps; which one, the motion to it decides.

    Attributes:
        goals: The goals: states, by name, joint or in order, poses, lists of poses that are reached together,
            alignments, or goals of problems, as records or as in files.
    """

    goals: Sequence[Any]

    def __post_init__(self) -> None:
        """Check that there are several.

        Raises:
            ParameterError: It is one goal, or none.
        """
        if isinstance(self.goals, str | Mapping) or not isinstance(self.goals, Iterable):
            raise ParameterError("goal", self.goals, "several goals in AnyOf")
        object.__setattr__(self, "goals", tuple(self.goals))


Group = str | Sequence[str]
"""Joints that a plan moves: name of a group of the robot, or names of groups and joints."""

GoalFields = Mapping[str, Any]
"""A goal as in problem files, such as ``{"grasp": {"object": "box", "hand": "hand"}}``."""

Target = (
    State | Sequence[State] | PoseTarget | Sequence[PoseTarget] | Alignment | Goal | GoalFields | AnyOf | GoalSampler
)
"""A goal: a state, several of which any will do, shape (goals, dof), poses of one frame or more, an alignment of held
objects, the goal of a problem, any of several goals, or an object that draws states."""


def joint_values(robot: Robot, state: State, name: str) -> dict[str, float]:
    """Return a state as values by joint name; names are not checked.

    Args:
        robot: The robot.
        state: The state.
        name: What the state is called in errors.

    Raises:
        ParameterError: It has not the robot's shape, or a number that is not finite.
        UnknownNameError: The robot has no pose of that name.
    """
    if isinstance(state, str):
        state = robot.poses[check_name(state, f"pose of {robot.name} as {name}", robot.poses)]
    if isinstance(state, Mapping):
        given = {str(joint): finite_array(value, f"{name}.{joint}") for joint, value in state.items()}
        for joint, value in given.items():
            if value.ndim:
                raise ParameterError(f"{name}.{joint}", value.shape, "a number")
        return {joint: float(value) for joint, value in given.items()}
    values = finite_array(state, name)
    if values.shape != (robot.dof,):
        raise ParameterError(name, values.shape, f"a state of shape ({robot.dof},), or values by joint name")
    return dict(zip(robot.joint_names, values.tolist(), strict=True))


def state_array(robot: Robot, state: State, name: str) -> Array:
    """Return a state in the robot's order, shape (dof,).

    Raises:
        ParameterError: It has not the robot's shape, or a number that is not finite; a joint is missing.
        UnknownNameError: The robot has no such joint.
    """
    values = joint_values(robot, state, name)
    for joint in values:
        check_name(joint, "joint", robot.joint_names)
    for joint in robot.joint_names:
        if joint not in values:
            raise ParameterError(name, f"{len(values)} of {robot.dof} joints", f"all; {joint!r} is missing")
    return np.array([values[joint] for joint in robot.joint_names])


def pose_targets(targets: PoseTarget | Sequence[PoseTarget]) -> tuple[PoseTarget, ...]:
    """Return one pose or several as a tuple.

    Raises:
        ParameterError: They are no poses, or there is none.
        FileFormatError: Two poses are given for one frame.
    """
    several = (targets,) if isinstance(targets, PoseTarget) else targets
    if not isinstance(several, Sequence) or not several or not all(isinstance(one, PoseTarget) for one in several):
        raise ParameterError("targets", targets, "a PoseTarget, or several")
    return validate(Goal, {"poses": tuple(several)}, "targets").poses or ()


def goal_record(robot: Robot, target: Target, held: Mapping[str, float]) -> Goal:
    """Return a goal as the record of a problem.

    Args:
        robot: The robot.
        target: The goal.
        held: Values of joints that stay; a goal by joint names may leave them out, and poses of the robot do not count
            there.

    Raises:
        ParameterError: A state has not the robot's shape, or there is none.
        FileFormatError: Two poses are given for one frame, or a goal as in files is faulty.
    """
    if isinstance(target, Goal):
        return target
    if _is_in_files(target):
        return _read_goal(robot, target, held)
    if isinstance(target, AnyOf):
        records = [goal_record(robot, one, held) for one in target.goals]
        return validate(Goal, {"any_of": tuple(records)}, "goal")
    if isinstance(target, Alignment):
        return Goal(alignment=target)
    if isinstance(target, PoseTarget):
        return Goal(poses=(target,))
    if isinstance(target, GoalSampler):
        raise ParameterError("goal", target, "no object that draws states, which is a goal of plans alone")
    if isinstance(target, Sequence) and target and all(isinstance(one, PoseTarget) for one in target):
        return validate(Goal, {"poses": tuple(target)}, "goal")
    several = list[dict[str, float]]()
    for one in _several(target):
        values = joint_values(robot, one, "goal")
        several.append(values | dict(held) if isinstance(one, str) else dict(held) | values)
    if not several:
        raise ParameterError("goal", target, "a state, or several")
    return Goal(joints=tuple(several))


def _is_in_files(target: Any) -> TypeGuard[GoalFields]:
    """Whether a goal is a mapping of the kinds of goals in files, not of joints."""
    return isinstance(target, Mapping) and any(kind in target for kind in GOALS)


def _read_goal(robot: Robot, target: GoalFields, held: Mapping[str, float]) -> Goal:
    """Return a goal in files as a record; states in it are those of plans, with joints that stay.

    Raises:
        ApexError: It is faulty.
    """
    if set(target) == {"joints"}:
        return goal_record(robot, target["joints"], held)
    if set(target) == {"any_of"}:
        return goal_record(robot, AnyOf(target["any_of"]), held)
    return validate(Goal, dict(target), "goal")


def sampled_goals(
    sampler: GoalSampler, robot: Robot, rng: np.random.Generator, is_free: Callable[[Array], bool]
) -> list[Array]:  # fmt: skip
    """Return free states of a sampler, at most GOAL_STATES, or one in collision where none of its states is free.

    Args:
        sampler: The sampler, which is called GOAL_ATTEMPTS times at most.
        robot: The robot.
        rng: Handed to the sampler.
        is_free: Whether a state is inside the limits and free of collision.

    Raises:
        ParameterError: A state has not the robot's shape, or there is none.
    """
    free, others = list[Array](), list[Array]()
    for _ in range(GOAL_ATTEMPTS):
        drawn = sampler.sample(rng)
        if drawn is not None:
            q = state_array(robot, drawn, "goal")
            (free if is_free(q) else others).append(q)
        if len(free) == GOAL_STATES:
            break
    if not free and not others:
        raise ParameterError("goal", sampler, f"a sampler that returns a state in {GOAL_ATTEMPTS} draws")
    return free or others[:1]


def _several(target: Any) -> Sequence[Any]:
    if isinstance(target, str | Mapping):
        return [target]
    records = PoseTarget | Alignment | Goal | AnyOf
    if isinstance(target, Sequence) and any(isinstance(one, records) or _is_in_files(one) for one in target):
        raise ParameterError("goal", target, "states alone, poses alone, or AnyOf of both")
    if isinstance(target, Sequence) and target and any(isinstance(one, str | Mapping) for one in target):
        return target
    values = finite_array(target, "goal")
    return list(np.atleast_2d(values)) if values.size else []


def planned_joints(robot: Robot, group: Group) -> tuple[str, ...]:
    """Return the names of the joints of a group, in the robot's order.

    Raises:
        UnknownNameError: No such group or joint.
        ParameterError: No joint is left.
    """
    wanted: set[str] = set()
    if not isinstance(group, Iterable):
        raise ParameterError("group", group, "the name of a group or joint, or several of them")
    for name in [group] if isinstance(group, str) else group:
        check_name(name, "group or joint", (*robot.groups, *robot.joint_names))
        wanted |= {robot.joint_names[k] for k in robot.groups[name]} if name in robot.groups else {name}
    if not wanted:
        raise ParameterError("group", group, "at least one group or joint")
    return tuple(name for name in robot.joint_names if name in wanted)


def dynamic_of(obstacles: Iterable[Obstacle]) -> tuple[Obstacle, ...]:
    """Return the dynamic obstacles, which a plan avoids in time.

    Raises:
        ParameterError: One does not move at constant velocity from time 0 on.
    """
    dynamic = tuple(o for o in obstacles if o.moving)
    scripted = next((o.name for o in dynamic if o.scripted), None)
    if scripted is not None:
        raise ParameterError(
            "snapshot", False, f"True, since the obstacle {scripted!r} follows a script, which `apex-ompl run` runs"
        )
    return dynamic


def check_problem(problem: Problem) -> None:
    """Check that a problem is one.

    Raises:
        ParameterError: It is something else, such as its name.
    """
    if not isinstance(problem, Problem):
        raise ParameterError("problem", problem, "a Problem, as load_problem returns")


def check_is_no_line(problem: Problem) -> None:
    """Check that a goal has no approach.

    Raises:
        ParameterError: It has one.
    """
    for frame, approach in problem.goal.approaches.items():
        raise ParameterError(
            "goal", f"the approach {approach} of {frame}", "no approach, or a plan by plan_task (apex-ompl sequence)"
        )


def check_still(obstacles: Iterable[Obstacle]) -> None:
    """Check that no obstacle moves.

    Raises:
        ParameterError: One does.
    """
    for obstacle in obstacles:
        if obstacle.moving:
            raise ParameterError("world", f"the moving obstacle {obstacle.name!r}", "obstacles that stand still")


def robot_notes(robot: Robot) -> list[str]:
    """Return notes on a robot that is planned for more slowly than others."""
    note = share_note(robot)
    return [note] if note else []


def snapshot_notes(obstacles: Sequence[Obstacle]) -> list[str]:
    """Return notes on dynamic obstacles, for a plan that takes them as they are at time 0."""
    later = [o.name for o in obstacles if o.appears > 0.0]
    still = [o.name for o in obstacles if o.moving and not o.appears > 0.0]
    notes = ((still, "taken to stand still"), (later, "left out, not there yet"))
    return [f"snapshot: {', '.join(names)} {what}" for names, what in notes if names]
