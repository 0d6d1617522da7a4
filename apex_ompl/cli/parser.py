"""The command line ``apex-ompl``: argument parsing and printing only.

Results go to standard output, logs and faults to standard error. Exit codes: 0 exact, 1 no plan or no timed motion, 2
usage or a faulty file, 3 invalid start or goal, 4 approximate, 130 interrupted.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn

from apex_ompl import __version__
from apex_ompl.cli import commands
from apex_ompl.errors import ApexError


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
    added = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    _add_plan(added.add_parser("plan", help="plan a path for a problem"))

    render = added.add_parser("render", help="draw a problem or a saved result, without a display")
    render.add_argument("source", help="a problem as for plan, or a saved result (.npz, .json, .yaml)")
    render.add_argument("-o", "--out", type=Path, required=True, metavar="FILE", help=".png, .gif or .mp4")
    render.add_argument("--azimuth", type=float, default=26.0, help="degrees from the front (default: %(default)s)")
    render.set_defaults(run=commands.render)

    plot = added.add_parser("plot", help="draw a timed motion against its limits, and its clearance")
    plot.add_argument("result", type=Path, help="a saved result (.npz, .json, .yaml)")
    plot.add_argument("-o", "--out", type=Path, required=True, metavar="FILE", help=".png, .pdf or .svg")
    plot.set_defaults(run=commands.plot)

    convert = added.add_parser("convert", help="make a problem of a MoveIt or MotionBenchMaker scene and request")
    convert.add_argument("scene", type=Path, help="YAML of a moveit_msgs/PlanningScene")
    convert.add_argument("request", type=Path, help="YAML of a moveit_msgs/MotionPlanRequest")
    convert.add_argument("-o", "--out", type=Path, required=True, metavar="FILE", help="problem file to write (.yaml)")
    convert.add_argument("--robot", default="dual_panda_softhand", help="robot name or file (default: %(default)s)")
    convert.add_argument("--joint", action="append", default=[], metavar="THEIRS=OURS", help="a joint by another name")
    convert.add_argument("--frame", action="append", default=[], metavar="THEIRS=OURS", help="a frame by another name")
    convert.set_defaults(run=commands.convert)

    bench = added.add_parser("bench", help="run planners on suites through OMPL's Benchmark")
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
    bench.set_defaults(run=commands.bench)

    report = added.add_parser("report", help="write an HTML page and Markdown of results of bench")
    report.add_argument("results", type=Path, metavar="RESULTS", help="folder that bench wrote")
    report.add_argument("-o", "--out", type=Path, required=True, metavar="DIR", help="gets report.html and report.md")
    report.set_defaults(run=commands.report)

    check = added.add_parser("check", help="validate a problem, and say whether start and goal are free")
    check.add_argument("problem", help="name of a problem, an id as shelf/hard/900012, or a YAML file")
    check.set_defaults(run=commands.check)

    for name, run, text in (
        ("problems", commands.problems, "list the ready-made problems and the suites"),
        ("planners", commands.planners, "list the planners and their parameters"),
        ("info", commands.info, "print versions and robots"),
        ("schema", commands.schema, "print the JSON schema of problem files"),
    ):
        added.add_parser(name, help=text).set_defaults(run=run)
    return parser


def _add_plan(plan: argparse.ArgumentParser) -> None:
    plan.add_argument("problem", help="name of a problem, an id as shelf/hard/900012, or a YAML file")
    plan.add_argument("--planner", help="see 'apex-ompl planners' (default: apex)")
    plan.add_argument("--timeout", type=float, default=5.0, metavar="SECONDS", help="default: %(default)s")
    plan.add_argument("--seed", type=int, default=0, help="default: %(default)s")
    plan.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help="a planner parameter")
    plan.add_argument("--params", type=Path, metavar="FILE", help="planner parameters in YAML; --set goes before them")
    plan.add_argument("--no-simplify", action="store_true", help="keep the path as the planner found it")
    plan.add_argument("--snapshot", action="store_true", help="take moving obstacles to stand still")
    plan.add_argument("--no-timing", action="store_true", help="leave the path without times")
    for limit in ("velocity", "acceleration", "jerk"):
        plan.add_argument(
            f"--{limit}-scale", type=float, default=1.0, metavar="SHARE", help="of the limits (default: %(default)s)"
        )
    plan.add_argument("--minimum-duration", type=float, default=0.0, metavar="SECONDS", help="of the motion")
    plan.add_argument(
        "--out", type=Path, metavar="FILE",
        help="write the result: .npz, .json, .yaml; or the timed motion: .traj.yaml, .traj.json, .csv",
    )  # fmt: skip
    plan.add_argument(
        "--controllers", action="store_true", help="one ROS 2 message for each group of joints in .traj files"
    )
    plan.add_argument("--json", action="store_true", help="print the whole result as JSON")
    plan.set_defaults(run=commands.plan)


if __name__ == "__main__":
    sys.exit(main())
