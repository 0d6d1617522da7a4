"""The command ``apex-ompl plan``."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from apex_ompl.api import plan
from apex_ompl.cli.options import LIMITS, name_value_pairs, numbers_by_name
from apex_ompl.errors import ParameterError
from apex_ompl.result import SUFFIXES, PlanResult, PlanStatus
from apex_ompl.robot import load_robot
from apex_ompl.timing import Timing
from apex_ompl.timing.files import MESSAGES
from apex_ompl.util.files import check_writable, suffix_of
from apex_ompl.util.schema import read_yaml

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
    params |= {name.replace("-", "_"): value for name, value in name_value_pairs("--set", parsed.set).items()}
    if parsed.controllers and (parsed.out is None or not parsed.out.name.endswith(MESSAGES)):
        raise ParameterError("--controllers", str(parsed.out), f"--out with a name ending in {' or '.join(MESSAGES)}")
    if parsed.no_timing and parsed.out is not None and parsed.out.name.endswith(MESSAGES):
        raise ParameterError("--no-timing", str(parsed.out), "timing, without which there is no motion to write")
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
    result = plan(
        parsed.problem,
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
        _save(result, parsed.out, timed=not parsed.no_timing, controllers=parsed.controllers)
    print(json.dumps(result.as_dict()) if parsed.json else result)
    return EXIT_CODES.get(result.status, 1)


def _save(result: PlanResult, out: Path, *, timed: bool, controllers: bool) -> None:
    """Write a result, its motion or its path, as the suffix asks; print a note when there is none."""
    suffix = suffix_of(out, SUFFIXES)
    wanted: object = result
    if suffix in (*MESSAGES, ".csv"):
        wanted = result.trajectory if timed else result.path
    if wanted is None:
        print(f"apex-ompl: note: no {'motion' if timed else 'path'}, so {out} is not written", file=sys.stderr)
    elif controllers and result.trajectory is not None:
        robot = load_robot(result.problem.robot)
        groups = {f"{name}_controller": [robot.joint_names[k] for k in group] for name, group in robot.groups.items()}
        result.trajectory.save(out, groups)
    else:
        result.save(out)
