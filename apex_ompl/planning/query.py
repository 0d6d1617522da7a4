"""Starts and goals as users give them, as records of a problem."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from apex_ompl.errors import ParameterError
from apex_ompl.robot import Robot
from apex_ompl.scene.problem import Alignment, Goal, PoseTarget
from apex_ompl.types import Array
from apex_ompl.util.schema import validate
from apex_ompl.util.validation import check_name, finite_array

State = Mapping[str, float] | ArrayLike
"""A state: values by joint name, or all of them in the robot's order, shape (dof,) [rad; synergies 0..1]."""

Target = State | Sequence[State] | PoseTarget | Sequence[PoseTarget] | Alignment | Goal
"""A goal: a state, several of which any will do, shape (goals, dof), poses of one frame or more, an alignment of held
objects, or the goal of a problem."""

Group = str | Sequence[str]
"""Joints that a plan moves: name of a group of the robot, or names of groups and joints."""


def joint_values(robot: Robot, state: State, name: str) -> dict[str, float]:
    """Return a state as values by joint name; names are not checked.

    Args:
        robot: The robot.
        state: The state.
        name: What the state is called in errors.

    Raises:
        ParameterError: It has not the robot's shape, or a number that is not finite.
    """
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


def goal_record(robot: Robot, target: Target, held: Mapping[str, float]) -> Goal:
    """Return a goal as the record of a problem.

    Args:
        robot: The robot.
        target: The goal.
        held: Values of joints that stay; a goal by joint names may leave them out.

    Raises:
        ParameterError: A state has not the robot's shape, or there is none.
        FileFormatError: Two poses are given for one frame.
    """
    if isinstance(target, Goal):
        return target
    if isinstance(target, Alignment):
        return Goal(alignment=target)
    if isinstance(target, PoseTarget):
        return Goal(poses=(target,))
    if isinstance(target, Sequence) and target and all(isinstance(one, PoseTarget) for one in target):
        return validate(Goal, {"poses": tuple(target)}, "goal")
    several = [dict(held) | joint_values(robot, one, "goal") for one in _several(target)]
    if not several:
        raise ParameterError("goal", target, "a state, or several")
    return Goal(joints=tuple(several))


def _several(target: Any) -> Sequence[Any]:
    if isinstance(target, Mapping):
        return [target]
    if isinstance(target, Sequence) and target and isinstance(target[0], Mapping):
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
