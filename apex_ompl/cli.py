"""The command line ``apex-ompl``: argument parsing and printing only.

Results go to standard output, logs and faults to standard error. Exit codes: 0 exact, 1 no plan, 2 usage or a
faulty file, 3 invalid start or goal, 4 approximate, 130 interrupted.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import re
import sys
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from types import ModuleType
from typing import NoReturn

from apex_ompl import __version__
from apex_ompl.errors import ApexError, MissingFileError, ParameterError
from apex_ompl.files import check_writable
from apex_ompl.provenance import LIBRARIES, versions
from apex_ompl.result import INSIDE, PlanResult, PlanStatus, check_suffix
from apex_ompl.result import SCHEMA as RESULT
from apex_ompl.schema import read_yaml

EXIT_CODES = {
    PlanStatus.EXACT_SOLUTION: 0,
    PlanStatus.INVALID_START: 3,
    PlanStatus.INVALID_GOAL: 3,
    PlanStatus.APPROXIMATE_SOLUTION: 4,
}


class _Parser(argparse.ArgumentParser):
    """A parser whose faults are one sentence."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: error: {message}\n")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code; ``arguments`` default to ``sys.argv[1:]``."""
    parsed = _parser().parse_args(arguments)
    try:
        code = int(parsed.run(parsed))
        sys.stdout.flush()
        return code
    except ApexError as error:
        print(f"apex-ompl: error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("apex-ompl: interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:
        sys.stdout = open(os.devnull, "w")  # whoever read has enough; nothing is left to be flushed at exit
        return 1
    except OSError as error:
        sys.stdout = open(os.devnull, "w")
        print(f"apex-ompl: error: output: {error.strerror or error}", file=sys.stderr)
        return 2


def _parser() -> _Parser:
    parser = _Parser(prog="apex-ompl", description="Plan motions of two arms and hands through OMPL.")
    parser.add_argument("--version", action="version", version=f"apex-ompl {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    plan = commands.add_parser("plan", help="plan a path for a problem")
    plan.add_argument("problem", help="name of a problem, an id as shelf/hard/900012, or a YAML file")
    plan.add_argument("--planner", help="see 'apex-ompl planners' (default: apex)")
    plan.add_argument("--timeout", type=float, default=5.0, metavar="SECONDS", help="default: %(default)s")
    plan.add_argument("--seed", type=int, default=0, help="default: %(default)s")
    plan.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help="a planner parameter")
    plan.add_argument("--params", type=Path, metavar="FILE", help="planner parameters in YAML; --set goes before them")
    plan.add_argument("--no-simplify", action="store_true", help="keep the path as the planner found it")
    plan.add_argument("--snapshot", action="store_true", help="take moving obstacles to stand still")
    plan.add_argument("--out", type=Path, metavar="FILE", help="write the result: .npz, .csv, .json or .yaml")
    plan.add_argument("--json", action="store_true", help="print the whole result as JSON")
    plan.set_defaults(run=_plan)

    render = commands.add_parser("render", help="draw a problem or a saved result, without a display")
    render.add_argument("source", help="a problem as for plan, or a saved result (.npz, .json, .yaml)")
    render.add_argument("-o", "--out", type=Path, required=True, metavar="FILE", help=".png, .gif or .mp4")
    render.add_argument("--azimuth", type=float, default=26.0, help="degrees from the front (default: %(default)s)")
    render.set_defaults(run=_render)

    convert = commands.add_parser("convert", help="make a problem of a MoveIt or MotionBenchMaker scene and request")
    convert.add_argument("scene", type=Path, help="YAML of a moveit_msgs/PlanningScene")
    convert.add_argument("request", type=Path, help="YAML of a moveit_msgs/MotionPlanRequest")
    convert.add_argument("-o", "--out", type=Path, required=True, metavar="FILE", help="problem file to write (.yaml)")
    convert.add_argument("--robot", default="dual_panda_softhand", help="robot name or file (default: %(default)s)")
    convert.add_argument("--joint", action="append", default=[], metavar="THEIRS=OURS", help="a joint by another name")
    convert.add_argument("--frame", action="append", default=[], metavar="THEIRS=OURS", help="a frame by another name")
    convert.set_defaults(run=_convert)

    bench = commands.add_parser("bench", help="run planners on suites through OMPL's Benchmark")
    bench.add_argument("suites", nargs="+", metavar="SUITE", help="a suite, a level as shelf/hard, a problem or a file")
    bench.add_argument(
        "--planners", default="apex,rrtconnect", metavar="A,B,...",
        help="names, with parameters as apex[fallback=false;bridge=false] (default: %(default)s)",
    )  # fmt: skip
    bench.add_argument("--runs", type=int, default=100, metavar="N", help="on a level (default: %(default)s)")
    bench.add_argument("--timeout", type=float, default=5.0, metavar="SECONDS", help="default: %(default)s")
    bench.add_argument("--seed", type=int, default=0, help="of the first run (default: %(default)s)")
    bench.add_argument("--split", default="test", help="train, validation or test (default: %(default)s)")
    bench.add_argument("--no-simplify", action="store_true", help="keep paths as planners found them")
    bench.add_argument("--jobs", type=int, default=1, metavar="N", help="at a time (default: one, as they are timed)")
    bench.add_argument("--address", metavar="HOST:PORT", help="of a Ray cluster to run on")
    bench.add_argument("-o", "--out", type=Path, required=True, metavar="DIR", help="goes on where it was stopped")
    bench.add_argument("--quiet", action="store_true", help="show no progress")
    bench.set_defaults(run=_bench)

    report = commands.add_parser("report", help="write an HTML page and Markdown of results of bench")
    report.add_argument("results", type=Path, metavar="RESULTS", help="folder that bench wrote")
    report.add_argument("-o", "--out", type=Path, required=True, metavar="DIR", help="gets report.html and report.md")
    report.set_defaults(run=_report)

    check = commands.add_parser("check", help="validate a problem, and say whether start and goal are free")
    check.add_argument("problem", help="name of a problem, an id as shelf/hard/900012, or a YAML file")
    check.set_defaults(run=_check)

    for name, run, text in (
        ("problems", _problems, "list the ready-made problems and the suites"),
        ("planners", _planners, "list the planners and their parameters"),
        ("info", _info, "print versions and robots"),
        ("schema", _schema, "print the JSON schema of problem files"),
    ):
        commands.add_parser(name, help=text).set_defaults(run=run)
    return parser


def _plan(parsed: argparse.Namespace) -> int:
    from apex_ompl.api import plan

    if parsed.out is not None:
        check_suffix(parsed.out)
        check_writable(parsed.out)
    params = {} if parsed.params is None else read_yaml(parsed.params, "file of planner parameters")
    params |= {name.replace("-", "_"): value for name, value in _pairs("--set", parsed.set).items()}
    result = plan(
        parsed.problem,
        planner=parsed.planner,
        timeout=parsed.timeout,
        seed=parsed.seed,
        simplify=not parsed.no_simplify,
        params=params,
        snapshot=parsed.snapshot,
    )
    if parsed.out is not None and (result.path is not None or parsed.out.suffix != ".csv"):
        result.save(parsed.out)
    elif parsed.out is not None:
        print(f"apex-ompl: note: no path, so {parsed.out} is not written", file=sys.stderr)
    print(json.dumps(result.as_dict()) if parsed.json else _summary(result))
    return EXIT_CODES.get(result.status, 1)


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
    lines.append(f"  checks     {result.checks} states judged, planner {result.planner}, seed {result.seed}")
    lines += [f"  note       {note}" for note in result.notes]
    return "\n".join(lines)


def _convert(parsed: argparse.Namespace) -> int:
    from apex_ompl.moveit import convert
    from apex_ompl.robot import load_robot

    if parsed.out.suffix not in (".yaml", ".yml"):
        raise ParameterError("output", str(parsed.out), "a file name ending in .yaml")
    joints, frames = _pairs("--joint", parsed.joint), _pairs("--frame", parsed.frame)
    done = convert(parsed.scene, parsed.request, load_robot(parsed.robot), joints, frames)
    done.problem.save(parsed.out)
    for note in done.notes:
        print(f"apex-ompl: note: {note}", file=sys.stderr)
    print(parsed.out)
    return 0


def _render(parsed: argparse.Namespace) -> int:
    from apex_ompl.api import load_problem
    from apex_ompl.render import render

    source = PlanResult.load(parsed.source) if _is_result(parsed.source) else load_problem(parsed.source)
    render(source, parsed.out, azimuth=parsed.azimuth)
    print(parsed.out)
    return 0


def _bench(parsed: argparse.Namespace) -> int:
    benchmark = _benchmark()
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


def _report(parsed: argparse.Namespace) -> int:
    for file in _benchmark().report(parsed.results, parsed.out):
        print(file)
    return 0


def _benchmark() -> ModuleType:
    try:
        from apex_ompl import benchmark
    except ImportError as error:
        name = error.name or "a package"
        raise MissingFileError(name, "package for benchmarks", "install the extra: apex-ompl[bench]") from error
    return benchmark


def _is_result(source: str) -> bool:
    """Whether a file is a saved result rather than a problem."""
    path = Path(source)
    if path.suffix in (".npz", ".json"):
        return True
    return path.suffix in (".yaml", ".yml") and path.is_file() and read_yaml(path, "file").get("schema") == RESULT


def _check(parsed: argparse.Namespace) -> int:
    from apex_ompl.api import load_problem
    from apex_ompl.assembly import assemble

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


def _problems(_: argparse.Namespace) -> int:
    from apex_ompl import problems

    for name in problems.names():
        problem = problems.load(name)
        print(f"{name:<20} {problem.robot}, {len(problem.scene)} obstacles")
    print("suites, as SUITE/LEVEL/SEED; seeds 0 to 799999 train, from 800000 validate, from 900000 test")
    for suite, levels in problems.suites().items():
        print(f"{suite:<20} {', '.join(levels)}")
    return 0


def _planners(_: argparse.Namespace) -> int:
    from apex_ompl import planners

    for name in planners.names():
        record = planners.parameters(name)
        doc = (type(record).__doc__ or "").splitlines()[0]
        print(f"{name:<16} {doc}")
        for field in fields(record):
            unit = field.metadata.get("unit", "")
            print(f"    {field.name} = {getattr(record, field.name)}" + f" {unit}" * bool(unit))
    return 0


def _info(_: argparse.Namespace) -> int:
    from apex_ompl.robot import load_robot, robot_names

    print(f"apex-ompl {__version__}, Python {platform.python_version()}, {platform.machine()}")
    there = versions()
    for library in LIBRARIES[1:]:
        print(f"  {library:<20} {there.get(library, 'not installed')}")
    print("robots")
    for name in robot_names():
        robot = load_robot(name)
        print(f"  {name:<20} {robot.dof} joints: {', '.join(robot.joint_names)}")
    return 0


def _schema(_: argparse.Namespace) -> int:
    from apex_ompl.problem import Problem

    print(json.dumps(Problem.model_json_schema(by_alias=True), indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
