"""Problems of tasks: approaches as lines, and problems made of steps that are given one by one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from apex_ompl.errors import ParameterError
from apex_ompl.planning.query import AnyOf, Group, goal_record, joint_values, planned_joints
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import Vector
from apex_ompl.scene.problem import AnyStep, Goal, MoveStep, Problem
from apex_ompl.scene.steps import LineStep, Step
from apex_ompl.util.schema import validate


def steps_of(robot: Robot, steps: Sequence[Step | Mapping[str, Any]]) -> list[Any]:
    """Return steps as entries of problem files; the goal of a move may be any goal that plans take.

    Args:
        robot: The robot.
        steps: Steps as records, or as entries of a problem file.

    Raises:
        ParameterError: One is neither, or there is none.
        ApexError: A goal is faulty.
    """
    if isinstance(steps, str | Mapping) or not isinstance(steps, Sequence) or not steps:
        raise ParameterError("steps", steps, "one step or more")
    found = list[Any]()
    for k, step in enumerate(steps):
        if not isinstance(step, Step | Mapping):
            raise ParameterError(f"steps[{k}]", step, "a step such as {'kind': 'move', 'goal': 'home'}")
        if isinstance(step, Mapping) and step.get("kind") == "move" and "goal" in step:
            found.append({**step, "goal": _goal(robot, step["goal"], step.get("group"))})
        else:
            found.append(dict(step) if isinstance(step, Mapping) else step)
    return found


def sequence_problem(robot: Robot, problem: Problem, steps: Sequence[Step | Mapping[str, Any]]) -> Problem:
    """Return a problem with steps after its start, the first of which is its goal if it is a motion of all joints.

    Args:
        robot: The robot.
        problem: A problem whose goal is its start.
        steps: The steps.

    Raises:
        ApexError: A step is faulty.
    """
    given = {"name": problem.name, "robot": problem.robot, "start": problem.start, "after": steps_of(robot, steps)}
    poses = {name: dict(zip(robot.joint_names, q.tolist(), strict=True)) for name, q in robot.poses.items()}
    first, *rest = read = validate(Problem, given, "steps", lambda: poses).after
    if not isinstance(first, MoveStep) or first.group is not None or first.blend is not None:
        return problem.model_copy(update={"after": read})
    goal = first.goal.with_joints(problem.start)
    return problem.model_copy(update={"goal": goal, "after": tuple(rest)})


def _goal(robot: Robot, goal: Any, group: Any) -> Any:
    """Return a goal as a record, or as it is in files; of poses of the robot the joints of a group count, if given."""
    in_files = isinstance(goal, Mapping) and set(goal) & set(Goal.model_fields)
    return goal if in_files else goal_record(robot, goal if group is None else _of_group(robot, goal, group), {})


def _of_group(robot: Robot, goal: Any, group: Group) -> Any:
    """Return a goal with the values of a group's joints in place of the names of poses."""
    if isinstance(goal, AnyOf):
        return AnyOf([_of_group(robot, one, group) for one in goal.goals])
    if not isinstance(goal, str):
        return goal
    values = joint_values(robot, goal, "goal")
    return {joint: values[joint] for joint in planned_joints(robot, group)}


def with_lines(problem: Problem) -> Problem:
    """Return a problem with a step ``line`` in place of each approach.

    Raises:
        ParameterError: The goals in an ``any_of`` have different approaches.
    """
    steps = [step for given in problem.after for step in _with_lines(given)]
    goal, *lines = _with_lines(MoveStep(goal=problem.goal))
    assert isinstance(goal, MoveStep)
    return problem.model_copy(update={"goal": goal.goal, "after": (*lines, *steps)})


def _with_lines(step: AnyStep) -> list[AnyStep]:
    """Return a step, and for each approach of its goal a line after it.

    Frames with the same approach go in step.
    """
    if not isinstance(step, MoveStep):
        return [step]
    approaches = step.goal.approaches
    if not approaches:
        return [step]
    frames = dict[Vector, list[str]]()
    for frame, by in approaches.items():
        frames.setdefault(by, []).append(frame)
    lines = [LineStep(frame=tuple(names), by=by, axes="frame") for by, names in frames.items()]
    return [step.model_copy(update={"goal": step.goal.before_approach}), *lines]
