"""The command ``apex-ompl ros2``."""

from __future__ import annotations

import argparse
import signal
from pathlib import Path

from apex_ompl import api
from apex_ompl.planning.planner import MotionPlanner
from apex_ompl.robot import robot_names
from apex_ompl.ros2.library import ros2
from apex_ompl.ros2.node import ApexNode
from apex_ompl.scene.problem import Problem
from apex_ompl.util.schema import read_yaml

ROBOT_SCHEMA = "apex-ompl/robot/"


def run(parsed: argparse.Namespace) -> int:
    """Run the node until SIGINT or SIGTERM, and return the exit code."""
    ros2()  # or it raises, before anything else takes time
    problem = _problem(parsed.source)
    node = ApexNode(MotionPlanner(parsed.source if problem is None else problem.robot), problem, parsed.ros_args)
    try:
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: node.end())
        node.run()
    finally:
        node.close()
    return 0


def _problem(source: str) -> Problem | None:
    """Return the problem that a source names, or None for a robot."""
    if source in robot_names():
        return None
    if source.endswith((".yaml", ".yml")):
        schema = read_yaml(Path(source), "robot or problem file").get("schema")
        if str(schema).startswith(ROBOT_SCHEMA):
            return None
    return api.load_problem(source)
