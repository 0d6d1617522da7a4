"""The command ``apex-ompl plan``."""

from __future__ import annotations

import argparse
import json
import math
import sys
from pathlib import Path

from apex_ompl.cli.options import PROBLEM_HELP, name_value_pairs
from apex_ompl.errors import ParameterError
from apex_ompl.result import INSIDE, SUFFIXES, PlanResult, PlanStatus
from apex_ompl.trajectory import Timing
from apex_ompl.trajectory.files import MESSAGES
from apex_ompl.util.files import check_writable, suffix_of
from apex_ompl.util.schema import read_yaml

EXIT_CODES = {
    PlanStatus.EXACT_SOLUTION: 0,
    PlanStatus.INVALID_START: 3,
    PlanStatus.INVALID_GOAL: 3,
    PlanStatus.APPROXIMATE_SOLUTION: 4,
}
LIMITS = ("velocity", "acceleration", "jerk")


def add_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command and its options."""
    parser = commands.add_parser("plan", help="plan a path for a problem")
    parser.add_argument("problem", help=PROBLEM_HELP)
    parser.add_argument("--planner", help="see 'apex-ompl planners' (default: apex)")
    parser.add_argument("--timeout", type=float, default=5.0, metavar="SECONDS", help="default: %(default)s")
    parser.add_argument("--seed", type=int, default=0, help="default: %(default)s")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help="a planner parameter")
    parser.add_argument(
        "--params", type=Path, metavar="FILE", help="planner parameters in YAML; --set goes before them"
    )
    parser.add_argument("--no-simplify", action="store_true", help="keep the path as the planner found it")
    parser.add_argument("--snapshot", action="store_true", help="take moving obstacles to stand still")
    parser.add_argument("--no-timing", action="store_true", help="leave the path without times")
    for limit in LIMITS:
        parser.add_argument(
            f"--{limit}-scale", type=float, default=1.0, metavar="SHARE", help="of the limits (default: %(default)s)"
        )
    parser.add_argument("--minimum-duration", type=float, default=0.0, metavar="SECONDS", help="of the motion")
    parser.add_argument(
        "--out", type=Path, metavar="FILE",
        help="write the result: .npz, .json, .yaml; or the timed motion: .traj.yaml, .traj.json, .csv",
    )  # fmt: skip
    parser.add_argument(
        "--controllers", action="store_true", help="one ROS 2 message for each group of joints in .traj files"
    )
    parser.add_argument("--json", action="store_true", help="print the whole result as JSON")
    parser.set_defaults(run=run)


def run(parsed: argparse.Namespace) -> int:
    """Plan, write the result, print it, and return the exit code."""
    from apex_ompl.api import plan

    if parsed.out is not None:
        suffix_of(parsed.out, SUFFIXES)
        check_writable(parsed.out)
    params = {} if parsed.params is None else read_yaml(parsed.params, "file of planner parameters")
    params |= {name.replace("-", "_"): value for name, value in name_value_pairs("--set", parsed.set).items()}
    if parsed.controllers and (parsed.out is None or not parsed.out.name.endswith(MESSAGES)):
        raise ParameterError("--controllers", str(parsed.out), f"--out with a name ending in {' or '.join(MESSAGES)}")
    if parsed.no_timing and parsed.out is not None and parsed.out.name.endswith(MESSAGES):
        raise ParameterError("--no-timing", str(parsed.out), "timing, without which there is no motion to write")
    scales = {f"{limit}_scale": getattr(parsed, f"{limit}_scale") for limit in LIMITS}
    timing = Timing(**scales, minimum_duration=parsed.minimum_duration)
    result = plan(
        parsed.problem,
        planner=parsed.planner,
        timeout=parsed.timeout,
        seed=parsed.seed,
        simplify=not parsed.no_simplify,
        params=params,
        snapshot=parsed.snapshot,
        timing=timing if not parsed.no_timing else False,
    )
    if parsed.out is not None:
        _save(result, parsed.out, timed=not parsed.no_timing, controllers=parsed.controllers)
    print(json.dumps(result.as_dict()) if parsed.json else _summary(result))
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
        from apex_ompl.robot import load_robot

        robot = load_robot(result.robot)
        groups = {f"{name}_controller": [robot.joint_names[k] for k in group] for name, group in robot.groups.items()}
        result.trajectory.save(out, groups)
    else:
        result.save(out)


def _clearance(result: PlanResult) -> str:
    """Return the words for the clearance of a path."""
    if math.isnan(result.clearance):
        return "not proved"
    pair = " <-> ".join(name for name in result.clearance_pair if name)
    spheres = f"{100.0 * result.proved_by_spheres:.0f} % of the path proved by spheres, the rest by exact shapes"
    return f"{result.clearance * 1e3:.2f} mm" + (f" ({pair})" if pair else "") + f"; {spheres}"


def _summary(result: PlanResult) -> str:
    """Return the lines printed about a result."""
    times = [(name, f"{seconds:.3f}") for name, seconds in result.times.items() if name != "total"]
    stages = ", ".join(f"{name} {text}" for name, text in times if not name.startswith(INSIDE))
    inside = ", ".join(f"{name.removeprefix(INSIDE)} {text}" for name, text in times if name.startswith(INSIDE))
    lines = [f"{result.problem.name}: {result.status}" + (f" by {result.solved_by}" if result.solved_by else "")]
    if result.reason:
        lines.append(f"  reason     {result.reason}")
    lines.append(f"  time       {result.times['total']:.3f} s ({stages})")
    if inside:
        lines.append(f"  solve      {inside}")
    if result.path is not None:
        lines.append(f"  length     {result.length:.3f} rad over {len(result.path)} states")
        lines.append(f"  clearance  {_clearance(result)}")
    if result.trajectory is not None:
        uses = ", ".join(f"{name} {share:.3f}" for name, share in result.limit_use.items() if name != "position")
        lines.append(
            f"  motion     {result.trajectory.duration:.3f} s, at most {result.deviation:.4f} rad off the path, "
            f"{result.motion_clearance * 1e3:.2f} mm clear"
        )
        lines.append(f"  limits     {uses} used")
    lines.append(f"  checks     {result.checks} states checked, planner {result.planner}, seed {result.seed}")
    lines += [f"  note       {note}" for note in result.notes]
    return "\n".join(lines)
