"""The commands ``apex-ompl plan`` and ``apex-ompl sequence``."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from apex_ompl.api import load_problem, plan, plan_task
from apex_ompl.cli.options import LIMITS, name_value_pairs, numbers_by_name
from apex_ompl.errors import ParameterError
from apex_ompl.ompl.setup import assemble
from apex_ompl.ompl.validity import full_check
from apex_ompl.planning.options import check_arguments
from apex_ompl.planning.task_motion import task_fault
from apex_ompl.planning.task_result import TaskResult
from apex_ompl.result import SUFFIXES, PlanResult, PlanStatus
from apex_ompl.robot import Robot, load_robot
from apex_ompl.timing import Timing, Trajectory
from apex_ompl.timing.files import MESSAGES
from apex_ompl.util.files import check_writable, suffix_of
from apex_ompl.util.schema import read_yaml
from apex_ompl.util.validation import check_name, check_positive

MOTIONS = (*MESSAGES, ".csv")  # files of motions alone

EXIT_CODES = {
    PlanStatus.EXACT_SOLUTION: 0,
    PlanStatus.INVALID_START: 3,
    PlanStatus.INVALID_GOAL: 3,
    PlanStatus.APPROXIMATE_SOLUTION: 4,
}


def _tool_speeds(given: Sequence[str]) -> float | dict[str, float] | None:
    """Return the largest speed of all tools, or those by name."""
    if len(given) == 1 and "=" not in given[0]:
        try:
            return float(given[0])
        except ValueError as error:
            raise ParameterError("--max-tool-speed", given[0], "a number or NAME=NUMBER") from error
    return numbers_by_name("--max-tool-speed", given) or None


def run(parsed: argparse.Namespace) -> int:
    """Plan, write the result, print it, and return the exit code."""
    if parsed.out is not None:
        suffix_of(parsed.out, SUFFIXES)
        check_writable(parsed.out)
    params = {} if parsed.params is None else read_yaml(parsed.params, "file of planner parameters")
    unnamed = [key for key in params if not isinstance(key, str)]
    if unnamed:
        raise ParameterError(str(parsed.params), unnamed[0], "names of parameters, in quotes where YAML reads others")
    if parsed.model is not None:
        params["model"] = parsed.model
    params |= {name.replace("-", "_"): value for name, value in name_value_pairs("--set", parsed.set).items()}
    if parsed.controllers and (parsed.out is None or not parsed.out.name.endswith(MESSAGES)):
        raise ParameterError("--controllers", str(parsed.out), f"--out with a name ending in {' or '.join(MESSAGES)}")
    if parsed.no_timing and parsed.out is not None and parsed.out.name.endswith(MESSAGES):
        raise ParameterError("--no-timing", str(parsed.out), "timing, without which there is no motion to write")
    if parsed.rate is not None:
        check_positive(parsed.rate, "--rate", "a positive number of points a second")
    for option in ("rate", "joints"):
        if getattr(parsed, option) is not None and (parsed.out is None or not parsed.out.name.endswith(MOTIONS)):
            raise ParameterError(f"--{option}", str(parsed.out), f"--out with a name ending in {', '.join(MOTIONS)}")
        if getattr(parsed, option) is not None and parsed.no_timing:
            raise ParameterError(f"--{option}", "--no-timing", "timing, without which there is no motion")
    scales: dict[str, Any] = {f"{limit}_scale": getattr(parsed, f"{limit}_scale") for limit in LIMITS}
    lower: dict[str, Any] = {
        f"max_{limit}": numbers_by_name(f"--max-{limit}", getattr(parsed, f"max_{limit}")) for limit in LIMITS
    }
    timing = Timing(
        method=parsed.timing_method, **scales, **lower, minimum_duration=parsed.minimum_duration,
        torque_limits=not parsed.no_torque_limits, torque_scale=parsed.torque_scale,
        max_torque=numbers_by_name("--max-torque", parsed.max_torque),
        payload=numbers_by_name("--payload", parsed.payload), max_tool_speed=_tool_speeds(parsed.max_tool_speed),
    )  # fmt: skip
    check_arguments(parsed.timeout, parsed.seed)
    problem = load_problem(parsed.problem)
    whole = parsed.command == "sequence"
    if problem.after and not whole:
        print("apex-ompl: note: the steps after the goal are left out; apex-ompl sequence plans them", file=sys.stderr)
    planned: Callable[..., PlanResult] = plan
    if whole:
        from apex_ompl.planning import TaskSearch

        planned = partial(plan_task, search=TaskSearch(asynchronous=parsed.asynchronous))
    result = planned(
        problem,
        planner=parsed.planner,
        timeout=parsed.timeout,
        seed=parsed.seed,
        simplify=not parsed.no_simplify,
        params=params,
        snapshot=parsed.snapshot,
        timing=timing if not parsed.no_timing else False,
        objective=parsed.objective,
        calm_factor=parsed.calm_factor,
        leave_contact=parsed.leave_contact,
    )
    if parsed.out is not None:
        _save(result, parsed, timing)
    print(json.dumps(result.as_dict()) if parsed.json else result)
    return EXIT_CODES.get(result.status, 1)


def _save(result: PlanResult, parsed: argparse.Namespace, timing: Timing) -> None:
    """Write a result, its motion or its path, as the suffix asks; print a note when there is none."""
    out, timed = parsed.out, not parsed.no_timing
    wanted: object = result
    if suffix_of(out, SUFFIXES) in MOTIONS:
        wanted = result.trajectory if timed else result.path
    if wanted is None:
        print(f"apex-ompl: note: no {'motion' if timed else 'path'}, so {out} is not written", file=sys.stderr)
    elif isinstance(wanted, Trajectory):
        robot = load_robot(result.problem.robot)
        chosen = _chosen(parsed.joints, robot)
        groups = {
            f"{name}_controller": [robot.joint_names[k] for k in group if robot.joint_names[k] in chosen]
            for name, group in robot.groups.items()
        }
        controllers = {name: joints for name, joints in groups.items() if joints} if parsed.controllers else None
        limits = timing.limits(robot.limits, robot.joint_names)
        if parsed.rate is not None:
            _prove(result, wanted.resampled(parsed.rate, limits), parsed.rate)
        wanted.save(out, controllers, rate=parsed.rate, joints=chosen, limits=limits)
    else:
        result.save(out)


def _prove(result: PlanResult, motion: Trajectory, rate: float) -> None:
    """Check that a motion at another rate is proved free, too.

    Raises:
        ParameterError: It is not, or obstacles move.
    """
    if result.dynamic_obstacles:
        raise ParameterError("--rate", rate, "none among dynamic obstacles, where the motion's own knots are proved")
    if isinstance(result, TaskResult):
        reason = task_fault(result, motion)
    else:
        reason = full_check(assemble(result.problem).checker, motion).reason
    if reason:
        raise ParameterError("--rate", rate, f"one at which the motion is proved free; it is not, {reason}")


def _chosen(given: str | None, robot: Robot) -> list[str]:
    """Return the names of joints in a list of joints and groups of joints, by default all."""
    if given is None:
        return list(robot.joint_names)
    groups = {name: [robot.joint_names[k] for k in group] for name, group in robot.groups.items()}
    known = (*groups, *robot.joint_names)
    names = [check_name(name.strip(), "joint", known) for name in given.split(",")]
    return list(dict.fromkeys(joint for name in names for joint in groups.get(name, [name])))
