"""The commands that need little code: ``bench``, ``report``, ``check``, ``convert``, and the listings.

Each command imports what it needs when it runs.
"""

from __future__ import annotations

import argparse
import json
import platform
import re
import sys
from dataclasses import fields
from pathlib import Path

from apex_ompl import __version__
from apex_ompl.cli.options import name_value_pairs
from apex_ompl.errors import ParameterError
from apex_ompl.util.extras import import_extra


def bench(parsed: argparse.Namespace) -> int:
    """Run a benchmark."""
    benchmark = import_extra("apex_ompl.evaluation", "benchmarks", "bench")
    import_extra("scipy", "benchmarks", "bench")  # needed after the runs only; missing packages are reported before
    results = benchmark.bench(
        parsed.suites, _split_planners(parsed.planners), parsed.out, runs=parsed.runs, timeout=parsed.timeout,
        seed=parsed.seed, split=parsed.split, simplify=not parsed.no_simplify, keep=parsed.keep, quiet=parsed.quiet,
        workers=benchmark.Workers(parsed.jobs, parsed.address),
    )  # fmt: skip
    logs = benchmark.write_logs(results)
    database = benchmark.write_database(results, logs)
    print(benchmark.markdown(results))
    print(f"{database}: {len(results.runs)} runs, for Planner Arena; OMPL's logs are in {results.folder / 'logs'}")
    return 0


def report(parsed: argparse.Namespace) -> int:
    """Write the report of a benchmark."""
    for file in import_extra("apex_ompl.evaluation", "benchmarks", "bench").report(parsed.results, parsed.out):
        print(file)
    return 0


def _split_planners(planners: str) -> list[str]:
    """Return the names of a list with commas; commas inside brackets do not separate names."""
    return [name for name in re.split(r",(?![^\[]*\])", planners) if name.strip()]


def check(parsed: argparse.Namespace) -> int:
    """Validate a problem, and print whether start and goal are free."""
    from apex_ompl.api import load_problem
    from apex_ompl.ompl.setup import assemble
    from apex_ompl.planning.task_problem import with_lines
    from apex_ompl.planning.task_world import check_steps
    from apex_ompl.timing import Timing

    setup = assemble(load_problem(parsed.problem))
    problem = setup.problem
    check_steps(setup.robot, problem)
    with_lines(problem)  # of goals with approaches
    Timing().motion_limits(setup.robot, problem.attached, problem.payload)
    print(f"{problem.name}: robot {setup.robot.name}, {setup.robot.dof} joints")
    moving = f", moving: {', '.join(problem.moving)}" if problem.moving else ""
    print(f"  scene      {len(problem.scene)} obstacles{moving}")
    if problem.attached:
        print("  held       " + ", ".join(f"{held.name} by {' and '.join(held.holders)}" for held in problem.attached))
    print(f"  start      {setup.start_fault or 'free'}")
    goal_faults, note = setup.goal_faults, ""
    if problem.moving:  # an obstacle at the goal at time 0 may have left when the robot arrives
        static = tuple(obstacle for obstacle in problem.scene if not obstacle.moving)
        goal_faults = assemble(problem.model_copy(update={"scene": static}), setup.robot).goal_faults
        note = f" (without {', '.join(problem.moving)})"
    for k, fault in enumerate(goal_faults):
        label = "goal" if len(goal_faults) == 1 else f"goal {k}"
        print(f"  {label:<10} {fault or 'free'}{note}")
    for step in problem.after:
        print(f"  after      {step.title}")
    for text in setup.notes:
        print(f"  note       {text}")
    return 3 if setup.start_fault or all(goal_faults) else 0


def convert(parsed: argparse.Namespace) -> int:
    """Convert a MoveIt scene and request to a problem file."""
    from apex_ompl.robot import load_robot
    from apex_ompl.robot.moveit import convert as convert_messages

    if parsed.out.suffix not in (".yaml", ".yml"):
        raise ParameterError("output", str(parsed.out), "a file name ending in .yaml")
    joints, frames = name_value_pairs("--joint", parsed.joint), name_value_pairs("--frame", parsed.frame)
    converted = convert_messages(parsed.scene, parsed.request, load_robot(parsed.robot), joints, frames)
    is_file = parsed.robot.endswith((".yaml", ".yml"))
    robot = str(Path(parsed.robot).resolve()) if is_file else parsed.robot
    converted.problem.model_copy(update={"robot": robot}).save(parsed.out)
    for note in converted.notes:
        print(f"apex-ompl: note: {note}", file=sys.stderr)
    print(parsed.out)
    return 0


def problems(_: argparse.Namespace) -> int:
    """List problems and suites."""
    from apex_ompl import problems as package
    from apex_ompl.problems.catalogue import levels_of

    for name in package.names():
        problem = package.load(name)
        print(f"{name:<20} {problem.robot}, {len(problem.scene)} obstacles")
    print("suites, as SUITE/LEVEL/SEED; seeds 0 to 799999 train, from 800000 validate, from 900000 test")
    for suite in package.suites():
        print(f"{suite:<20} {', '.join(levels_of(suite))}")
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
    from apex_ompl.util.provenance import LIBRARIES, versions

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
