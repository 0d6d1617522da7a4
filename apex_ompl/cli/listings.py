"""The commands ``apex-ompl problems``, ``planners``, ``info`` and ``schema``, which take no options."""

from __future__ import annotations

import argparse
import json
import platform
from dataclasses import fields

from apex_ompl import __version__
from apex_ompl.util.provenance import LIBRARIES, versions


def problems(_: argparse.Namespace) -> int:
    """List problems and suites."""
    from apex_ompl import problems as package

    for name in package.names():
        problem = package.load(name)
        print(f"{name:<20} {problem.robot}, {len(problem.scene)} obstacles")
    print("suites, as SUITE/LEVEL/SEED; seeds 0 to 799999 train, from 800000 validate, from 900000 test")
    for suite, levels in package.suites().items():
        print(f"{suite:<20} {', '.join(levels)}")
    return 0


def planners(_: argparse.Namespace) -> int:
    """List planners and their parameters."""
    from apex_ompl import planners as package

    for name in package.names():
        record = package.parameters(name)
        doc = (type(record).__doc__ or "").splitlines()[0]
        print(f"{name:<16} {doc}")
        for field in fields(record):
            unit = field.metadata.get("unit", "")
            print(f"    {field.name} = {getattr(record, field.name)}" + f" {unit}" * bool(unit))
    return 0


def info(_: argparse.Namespace) -> int:
    """Print versions and robots."""
    from apex_ompl.robot import load_robot, robot_names

    print(f"apex-ompl {__version__}, Python {platform.python_version()}, {platform.machine()}")
    installed = versions(LIBRARIES)
    for library in LIBRARIES[1:]:
        print(f"  {library:<20} {installed.get(library, 'not installed')}")
    print("robots")
    for name in robot_names():
        robot = load_robot(name)
        print(f"  {name:<20} {robot.dof} joints: {', '.join(robot.joint_names)}")
    return 0


def schema(_: argparse.Namespace) -> int:
    """Print the JSON schema of problem files."""
    from apex_ompl.scene.problem import Problem

    print(json.dumps(Problem.model_json_schema(by_alias=True), indent=1))
    return 0
