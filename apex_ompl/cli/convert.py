"""The command ``apex-ompl convert``."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from apex_ompl.cli.options import name_value_pairs
from apex_ompl.errors import ParameterError


def add_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command and its options."""
    parser = commands.add_parser("convert", help="make a problem of a MoveIt or MotionBenchMaker scene and request")
    parser.add_argument("scene", type=Path, help="YAML of a moveit_msgs/PlanningScene")
    parser.add_argument("request", type=Path, help="YAML of a moveit_msgs/MotionPlanRequest")
    parser.add_argument("-o", "--out", type=Path, required=True, metavar="FILE", help="problem file to write (.yaml)")
    parser.add_argument("--robot", default="dual_panda_softhand", help="robot name or file (default: %(default)s)")
    parser.add_argument("--joint", action="append", default=[], metavar="THEIRS=OURS", help="a joint by another name")
    parser.add_argument("--frame", action="append", default=[], metavar="THEIRS=OURS", help="a frame by another name")
    parser.set_defaults(run=run)


def run(parsed: argparse.Namespace) -> int:
    """Convert a MoveIt scene and request to a problem file."""
    from apex_ompl.robot import load_robot
    from apex_ompl.tasks.moveit import convert

    if parsed.out.suffix not in (".yaml", ".yml"):
        raise ParameterError("output", str(parsed.out), "a file name ending in .yaml")
    joints, frames = name_value_pairs("--joint", parsed.joint), name_value_pairs("--frame", parsed.frame)
    converted = convert(parsed.scene, parsed.request, load_robot(parsed.robot), joints, frames)
    converted.problem.save(parsed.out)
    for note in converted.notes:
        print(f"apex-ompl: note: {note}", file=sys.stderr)
    print(parsed.out)
    return 0
