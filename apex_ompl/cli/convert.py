"""The command ``apex-ompl convert``."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from apex_ompl.cli.options import name_value_pairs
from apex_ompl.errors import ParameterError
from apex_ompl.robot import load_robot
from apex_ompl.robot.moveit import convert


def run(parsed: argparse.Namespace) -> int:
    """Convert a MoveIt scene and request to a problem file."""
    if parsed.out.suffix not in (".yaml", ".yml"):
        raise ParameterError("output", str(parsed.out), "a file name ending in .yaml")
    joints, frames = name_value_pairs("--joint", parsed.joint), name_value_pairs("--frame", parsed.frame)
    converted = convert(parsed.scene, parsed.request, load_robot(parsed.robot), joints, frames)
    is_file = parsed.robot.endswith((".yaml", ".yml"))
    robot = str(Path(parsed.robot).resolve()) if is_file else parsed.robot
    converted.problem.model_copy(update={"robot": robot}).save(parsed.out)
    for note in converted.notes:
        print(f"apex-ompl: note: {note}", file=sys.stderr)
    print(parsed.out)
    return 0
