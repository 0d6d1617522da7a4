"""What the commands of ``apex-ompl`` do, from parsed arguments to an exit code."""

from __future__ import annotations

import argparse
import json
import platform
import re
import sys
from collections.abc import Sequence
from dataclasses import fields
from importlib import import_module
from pathlib import Path
from types import ModuleType

from apex_ompl import __version__
from apex_ompl.errors import MissingFileError, ParameterError
from apex_ompl.result import INSIDE, SUFFIXES, PlanResult, PlanStatus
from apex_ompl.result import SCHEMA as RESULT
from apex_ompl.trajectory import Timing
from apex_ompl.trajectory.files import MESSAGES
from apex_ompl.util.files import check_writable, suffix_of
from apex_ompl.util.provenance import LIBRARIES, versions
from apex_ompl.util.schema import read_yaml

EXIT_CODES = {
    PlanStatus.EXACT_SOLUTION: 0,
    PlanStatus.INVALID_START: 3,
    PlanStatus.INVALID_GOAL: 3,
    PlanStatus.APPROXIMATE_SOLUTION: 4,
}


def plan(parsed: argparse.Namespace) -> int:
    """Plan, and print and write what came of it."""
    from apex_ompl.api import plan as make_plan

    if parsed.out is not None:
        suffix_of(parsed.out, SUFFIXES)
        check_writable(parsed.out)
    params = {} if parsed.params is None else read_yaml(parsed.params, "file of planner parameters")
    params |= {name.replace("-", "_"): value for name, value in _pairs("--set", parsed.set).items()}
    if parsed.controllers and (parsed.out is None or not parsed.out.name.endswith(MESSAGES)):
        raise ParameterError("--controllers", str(parsed.out), f"--out with a name ending in {' or '.join(MESSAGES)}")
    if parsed.no_timing and parsed.out is not None and parsed.out.name.endswith(MESSAGES):
        raise ParameterError("--no-timing", str(parsed.out), "timing, without which there is no motion to write")
    scales = {f"{limit}_scale": getattr(parsed, f"{limit}_scale") for limit in ("velocity", "acceleration", "jerk")}
    timing = Timing(**scales, minimum_duration=parsed.minimum_duration)
    result = make_plan(
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
    """Write what there is of a result, or say that there is nothing."""
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


def _pairs(option: str, pairs: Sequence[str]) -> dict[str, str]:
    """Read repeated NAME=VALUE options."""
    found = {}
    for pair in pairs:
        name, equals, value = pair.partition("=")
        if not equals or not name or not value:
            raise ParameterError(option, pair, "NAME=VALUE")
        found[name.strip()] = value.strip()
    return found


def _summary(result: PlanResult) -> str:
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
        lines.append(f"  clearance  {result.clearance * 1e3:.1f} mm")
    if result.trajectory is not None:
        uses = ", ".join(f"{name} {share:.3f}" for name, share in result.limit_use.items() if name != "position")
        lines.append(
            f"  motion     {result.trajectory.duration:.3f} s, at most {result.deviation:.4f} rad off the path, "
            f"checked every {result.timing_resolution:.2g} rad"
        )
        lines.append(f"  limits     {uses} used")
    lines.append(f"  checks     {result.checks} states judged, planner {result.planner}, seed {result.seed}")
    lines += [f"  note       {note}" for note in result.notes]
    return "\n".join(lines)


def plot(parsed: argparse.Namespace) -> int:
    """Draw a timed motion."""
    plots = _needing("apex_ompl.viz.plots", "pictures", "viz")
    check_writable(parsed.out)
    plots.plot_motion(PlanResult.load(parsed.result), parsed.out)
    print(parsed.out)
    return 0


def convert(parsed: argparse.Namespace) -> int:
    """Make a problem of a MoveIt scene and request."""
    from apex_ompl.robot import load_robot
    from apex_ompl.tasks.moveit import convert as make_problem

    if parsed.out.suffix not in (".yaml", ".yml"):
        raise ParameterError("output", str(parsed.out), "a file name ending in .yaml")
    joints, frames = _pairs("--joint", parsed.joint), _pairs("--frame", parsed.frame)
    done = make_problem(parsed.scene, parsed.request, load_robot(parsed.robot), joints, frames)
    done.problem.save(parsed.out)
    for note in done.notes:
        print(f"apex-ompl: note: {note}", file=sys.stderr)
    print(parsed.out)
    return 0


def render(parsed: argparse.Namespace) -> int:
    """Draw a problem or a result."""
    from apex_ompl.api import load_problem
    from apex_ompl.viz.render import render as draw

    source = PlanResult.load(parsed.source) if _is_result(parsed.source) else load_problem(parsed.source)
    draw(source, parsed.out, azimuth=parsed.azimuth)
    print(parsed.out)
    return 0


def bench(parsed: argparse.Namespace) -> int:
    """Run a benchmark."""
    benchmark = _needing("apex_ompl.benchmark", "benchmarks", "bench")
    _needing("scipy", "benchmarks", "bench")  # which is not asked before the runs are made
    results = benchmark.bench(
        parsed.suites, _split(parsed.planners), parsed.out, runs=parsed.runs, timeout=parsed.timeout, seed=parsed.seed,
        split=parsed.split, simplify=not parsed.no_simplify, quiet=parsed.quiet,
        workers=benchmark.Workers(parsed.jobs, parsed.address),
    )  # fmt: skip
    logs = benchmark.write_logs(results)
    database = benchmark.write_database(results, logs)
    print(benchmark.markdown(results))
    print(f"{database}: {len(results.runs)} runs, for Planner Arena; OMPL's logs are in {results.folder / 'logs'}")
    return 0


def _split(planners: str) -> list[str]:
    """Split a list at its commas, those inside of brackets left alone."""
    return [name for name in re.split(r",(?![^\[]*\])", planners) if name.strip()]


def report(parsed: argparse.Namespace) -> int:
    """Write the report of a benchmark."""
    for file in _needing("apex_ompl.benchmark", "benchmarks", "bench").report(parsed.results, parsed.out):
        print(file)
    return 0


def _needing(module: str, what: str, extra: str) -> ModuleType:
    """Import a module that needs an extra.

    Raises:
        MissingFileError: A package is not installed.
    """
    try:
        return import_module(module)
    except ImportError as error:
        name = error.name or "a package"
        raise MissingFileError(name, f"package for {what}", f"install the extra: apex-ompl[{extra}]") from error


def _is_result(source: str) -> bool:
    """Whether a file is a saved result rather than a problem."""
    path = Path(source)
    if path.suffix in (".npz", ".json"):
        return True
    return path.suffix in (".yaml", ".yml") and path.is_file() and read_yaml(path, "file").get("schema") == RESULT


def check(parsed: argparse.Namespace) -> int:
    """Validate a problem, and print whether start and goal are free."""
    from apex_ompl.api import load_problem
    from apex_ompl.ompl_adapter.setup import assemble

    ready = assemble(load_problem(parsed.problem))
    problem = ready.problem
    print(f"{problem.name}: robot {ready.robot.name}, {ready.robot.dof} joints")
    moving = f", moving: {', '.join(problem.moving)}" if problem.moving else ""
    print(f"  scene      {len(problem.scene)} obstacles{moving}")
    if problem.attached:
        print("  held       " + ", ".join(f"{held.name} by {held.link}" for held in problem.attached))
    print(f"  start      {ready.start_fault or 'free'}")
    goal_faults, note = ready.goal_faults, ""
    if problem.moving:  # what moves may have left a goal when the robot gets there
        still = tuple(obstacle for obstacle in problem.scene if not obstacle.moving)
        goal_faults = assemble(problem.model_copy(update={"scene": still}), ready.robot).goal_faults
        note = f" (without {', '.join(problem.moving)})"
    for k, fault in enumerate(goal_faults):
        label = "goal" if len(goal_faults) == 1 else f"goal {k}"
        print(f"  {label:<10} {fault or 'free'}{note}")
    return 3 if ready.start_fault or all(goal_faults) else 0


def problems(_: argparse.Namespace) -> int:
    """List problems and suites."""
    from apex_ompl import problems as known

    for name in known.names():
        problem = known.load(name)
        print(f"{name:<20} {problem.robot}, {len(problem.scene)} obstacles")
    print("suites, as SUITE/LEVEL/SEED; seeds 0 to 799999 train, from 800000 validate, from 900000 test")
    for suite, levels in known.suites().items():
        print(f"{suite:<20} {', '.join(levels)}")
    return 0


def planners(_: argparse.Namespace) -> int:
    """List planners and their parameters."""
    from apex_ompl import planners as known

    for name in known.names():
        record = known.parameters(name)
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
    there = versions(LIBRARIES)
    for library in LIBRARIES[1:]:
        print(f"  {library:<20} {there.get(library, 'not installed')}")
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
