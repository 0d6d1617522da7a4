"""The command line ``apex-ompl``: its options, and the exit codes of errors.

Results go to standard output, logs and errors to standard error. Exit codes: 0 exact, 1 no plan or no timed motion, 2
wrong usage or an invalid file, 3 invalid start or goal, 4 approximate, 130 interrupted, 141 nobody reads the output.

Commands are named as MODULE:FUNCTION and imported when they run, so that ``--help`` needs none of what they need.
"""

from __future__ import annotations

import argparse
import gc
import io
import os
import re
import signal
import sys
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, NoReturn

from apex_ompl import __version__
from apex_ompl.cli.options import LIMITS
from apex_ompl.errors import ApexError
from apex_ompl.util.process import end_quickly

PROBLEM_HELP = "name of a problem, an id as shelf/hard/900012, or a YAML file"
AT_ONCE_HELP = "start each arm's steps as soon as what they need is done"
RESULT_HELP = "a saved plan or run (.npz, .json, .yaml)"
GARBAGE = 200_000  # objects between collections of the youngest


class _Output(io.FileIO):
    """Standard output, whose errors name it as those of files name the file."""

    def write(self, data: Any) -> int:
        """Write bytes."""
        try:
            return super().write(data)
        except OSError as error:
            error.filename = "output"
            raise


def open_streams() -> None:
    """Open standard streams that were closed, as daemons do, and give the output its name.

    Closed streams must be opened, in the order of their numbers: the next file that is opened would get the number, and
    the output of libraries would go there.
    """
    before: Any = sys.stdout
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, mode))
    if before is not None:
        sys.stdout = io.TextIOWrapper(
            io.BufferedWriter(_Output(before.fileno(), "w", closefd=False)), encoding=before.encoding,
            errors=before.errors, line_buffering=before.line_buffering, write_through=before.write_through,
        )  # fmt: skip


Commands = argparse._SubParsersAction  # of argparse, which has no public name for it


class _Parser(argparse.ArgumentParser):
    """A parser whose errors are one sentence, without the usage."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: error: {message}\n")


def command() -> int:
    """Run the command line as its own process, and return the exit code with which it must end."""
    return end_quickly(main())


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code; ``arguments`` default to ``sys.argv[1:]``."""
    if arguments is None:
        gc.set_threshold(GARBAGE, 50, 50)  # imports make many objects that stay: a tenth of the time of a short plan
        open_streams()
    parsed = _parser().parse_args(arguments)
    module, _, function = parsed.run.partition(":")
    try:
        code = int(getattr(import_module(f"apex_ompl.cli.{module}"), function)(parsed))
        sys.stdout.flush()
        return code
    except ApexError as error:
        print(f"apex-ompl: error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("apex-ompl: interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:
        sys.stdout = open(os.devnull, "w")  # the reader has closed the pipe; nothing may be flushed at exit
        return 128 + signal.SIGPIPE
    except OSError as error:
        sys.stdout = open(os.devnull, "w")
        print(f"apex-ompl: error: {_place(error)}{error.strerror or error}", file=sys.stderr)
        return 2


def _place(error: OSError) -> str:
    """Return the file that an error names, if any, and a colon."""
    return "" if error.filename is None else f"{os.fsdecode(error.filename)}: "


def _parser() -> argparse.ArgumentParser:
    parser: argparse.ArgumentParser = _Parser(
        prog="apex-ompl", description="Plan motions of two arms and hands through OMPL."
    )
    parser.add_argument("--version", action="version", version=f"apex-ompl {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    _add_plan(commands, "plan", "plan a path for a problem, to its goal")  # in the order of the help text
    _add_plan(commands, "sequence", "plan a problem to its goal and all steps after it, as one motion")
    _add_run(commands)
    _add_ros2(commands)
    _add_pictures(commands)
    _add_view(commands)
    _add_convert(commands)
    _add_calibrate(commands)
    _add_see(commands)
    _add_benchmark(commands)
    _add_check(commands)
    _add_robot(commands)
    for name, text in (
        ("problems", "list the ready-made problems and the suites"),
        ("planners", "list the planners and their parameters"),
        ("info", "print versions and robots"),
        ("schema", "print the JSON schema of problem files"),
    ):
        commands.add_parser(name, help=text).set_defaults(run=f"commands:{name}")
    return parser


def _add_plan(commands: Commands[argparse.ArgumentParser], name: str, text: str) -> None:
    parser = commands.add_parser(name, help=text)
    parser.add_argument("problem", help=PROBLEM_HELP)
    parser.add_argument("--planner", help="see 'apex-ompl planners' (default: apex)")
    parser.add_argument("--timeout", type=float, default=5.0, metavar="SECONDS", help="default: %(default)s")
    parser.add_argument("--seed", type=int, default=0, help="default: %(default)s")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help="a planner parameter")
    parser.add_argument("--model", metavar="FOLDER", help="checkpoint of the proposals of apex (default: the robot's)")
    parser.add_argument(
        "--params", type=Path, metavar="FILE", help="planner parameters in YAML; --set goes before them"
    )
    parser.add_argument("--no-simplify", action="store_true", help="keep the path as the planner found it")
    parser.add_argument(
        "--snapshot", action="store_true", help="treat moving obstacles as static at their positions at time 0"
    )
    parser.add_argument(
        "--leave-contact", type=float, default=0.0, metavar="METERS",
        help="depth of contacts at the start that the path may leave, up to 0.001 (default: 0)",
    )  # fmt: skip
    parser.add_argument(
        "--objective", default="time", metavar="NAME",
        help="what the motion is to be: time, length or calm (default: %(default)s)",
    )  # fmt: skip
    parser.add_argument(
        "--calm-factor", type=float, default=1.1, metavar="FACTOR",
        help="duration of a calm motion as a multiple of the fastest one's (default: %(default)s)",
    )  # fmt: skip
    parser.add_argument("--no-timing", action="store_true", help="leave the path without times")
    if name == "sequence":
        parser.add_argument("--asynchronous", action="store_true", help=AT_ONCE_HELP)
    parser.add_argument(
        "--timing-method", default="ruckig", metavar="NAME",
        help="of time parameterization: ruckig or spline (default: %(default)s)",
    )  # fmt: skip
    for limit in LIMITS:
        parser.add_argument(
            f"--{limit}-scale", type=float, default=1.0, metavar="SHARE", help="of the limits (default: %(default)s)"
        )
        parser.add_argument(
            f"--max-{limit}", action="append", default=[], metavar="JOINT=VALUE",
            help=f"a lower limit of {limit} for a joint",
        )  # fmt: skip
    parser.add_argument(
        "--max-tool-speed", action="append", default=[], metavar="SPEED or NAME=SPEED",
        help="largest speed of all hands and held objects, or of single ones [m/s]",
    )  # fmt: skip
    parser.add_argument(
        "--payload", action="append", default=[], metavar="HAND=MASS", help="mass in a hand or at a link [kg]"
    )
    parser.add_argument(
        "--torque-scale", type=float, default=1.0, metavar="SHARE", help="of the limits (default: %(default)s)"
    )
    parser.add_argument(
        "--max-torque", action="append", default=[], metavar="JOINT=VALUE", help="a lower limit of torque for a joint"
    )
    parser.add_argument("--no-torque-limits", action="store_true", help="leave torques out of account")
    parser.add_argument("--minimum-duration", type=float, default=0.0, metavar="SECONDS", help="of the motion")
    parser.add_argument(
        "--out", type=Path, metavar="FILE",
        help="write the result: .npz, .json, .yaml; or the timed motion: .traj.yaml, .traj.json, .csv",
    )  # fmt: skip
    parser.add_argument(
        "--controllers", action="store_true", help="one ROS 2 message for each group of joints in .traj files"
    )
    parser.add_argument(
        "--rate", type=float, metavar="HZ",
        help="points a second in .traj files and .csv (default: the motion's own, at most 60 or so)",
    )  # fmt: skip
    parser.add_argument(
        "--joints", metavar="A,B,...", help="joints or groups of joints in .traj files and .csv (default: all)"
    )
    parser.add_argument("--json", action="store_true", help="print the whole result as JSON")
    parser.set_defaults(run="plan:run")


def _add_run(commands: Commands[argparse.ArgumentParser]) -> None:
    parser = commands.add_parser(
        "run", help="go to a goal in closed loop while obstacles move, or execute a task in physics"
    )
    parser.add_argument("world", help=f"a world such as popup/vertical/large/12, or {PROBLEM_HELP}")
    parser.add_argument(
        "--method", default="apex", help="apex, or a replanner of docs/closed_loop.md such as no-network, "
        "stop-and-wait, rrtconnect, apex-paper, blind (default: %(default)s)",
    )  # fmt: skip
    parser.add_argument(
        "--clock", default="sim", help="sim (simulated, repeatable) or real, with the planner in its own process "
        "(default: %(default)s)",
    )  # fmt: skip
    parser.add_argument(
        "--prediction", default="cv", help="of obstacles: still, cv (constant velocity) or truth (default: %(default)s)"
    )
    parser.add_argument("--speed", type=float, default=1.0, metavar="SHARE", help="of the velocity limits")
    parser.add_argument("--budget", type=float, default=0.05, metavar="SECONDS", help="of a replan")
    parser.add_argument(
        "--evade", default="proved", help="how a robot at rest that is about to be touched steps aside: proved (clear "
        "of all that obstacles can reach), risk (as predicted) or never (default: %(default)s)",
    )  # fmt: skip
    parser.add_argument("--latency", type=float, metavar="SECONDS", help="of a replan (default: what its work costs)")
    parser.add_argument("--timeout", type=float, default=30.0, metavar="SECONDS", help="default: %(default)s")
    parser.add_argument(
        "--seed", type=int, help="of the loop (default: 0); in physics of the start, which without it is that of the "
        "problem",
    )  # fmt: skip
    parser.add_argument(
        "--driver", metavar="NAME", help="the robot that is driven: mujoco, in physics, or kinematic, an exact one. "
        "With mujoco a problem whose obstacles stand still is executed to the end of its task, to which of these "
        "options --seed, --timeout, --asynchronous, --out, --film and --json apply",
    )  # fmt: skip
    parser.add_argument("--asynchronous", action="store_true", help=AT_ONCE_HELP)
    parser.add_argument(
        "--camera", action="store_true", help="objects in the hands and obstacles are seen by simulated cameras and "
        "not told; in physics, unless obstacles move",
    )  # fmt: skip
    parser.add_argument(
        "--cameras", nargs="+", type=Path, default=[], metavar="FILE", help="camera files for --camera (default: two, "
        "before the robot and above)",
    )  # fmt: skip
    parser.add_argument(
        "--cubes", type=int, default=0, metavar="N", help="red cubes in the way of a task with --camera (default: 0)"
    )
    parser.add_argument("--film", type=Path, metavar="FILE", help="write a film of a task in physics: .mp4")
    parser.add_argument("--out", type=Path, metavar="FILE", help="write the run: .npz or .json")
    parser.add_argument("--json", action="store_true", help="print the outcome and the metrics as JSON")
    parser.set_defaults(run="run:run")


def _add_ros2(commands: Commands[argparse.ArgumentParser]) -> None:
    parser = commands.add_parser("ros2", help="a node of ROS 2 that moves a robot to goals, beside its controllers")
    parser.add_argument(
        "source", nargs="?", default="dual_panda_softhand", metavar="ROBOT or PROBLEM",
        help="a robot or its file, or a problem with obstacles and held objects (default: %(default)s)",
    )  # fmt: skip
    parser.add_argument(
        "--ros-args", nargs=argparse.REMAINDER, default=[], metavar="...",
        help="all that follows is for ROS: -p NAME:=VALUE, --params-file FILE, -r NAME:=OTHER, ...",
    )  # fmt: skip
    parser.set_defaults(run="ros2:run")


def _add_pictures(commands: Commands[argparse.ArgumentParser]) -> None:
    parser = commands.add_parser("render", help="draw a problem or a saved result, without a display")
    parser.add_argument("source", help=f"a problem as for plan, or {RESULT_HELP}")
    parser.add_argument("-o", "--out", type=Path, required=True, metavar="FILE", help=".png, .gif or .mp4")
    parser.add_argument("--azimuth", type=float, default=26.0, help="degrees from the front (default: %(default)s)")
    parser.set_defaults(run="pictures:render")
    parser = commands.add_parser("plot", help="draw a timed motion against its limits, and its clearance; or a run")
    parser.add_argument("result", type=Path, help=RESULT_HELP)
    parser.add_argument("-o", "--out", type=Path, required=True, metavar="FILE", help=".png, .pdf or .svg")
    parser.set_defaults(run="pictures:plot")


def _add_view(commands: Commands[argparse.ArgumentParser]) -> None:
    parser = commands.add_parser("view", help="show problems and results in a browser, or write them as a page")
    parser.add_argument(
        "sources", nargs="+", metavar="SOURCE", help=f"a problem as for plan, {RESULT_HELP}, or a folder of results"
    )
    parser.add_argument("--port", type=int, metavar="N", help="on this machine (default: the first free one from 8080)")
    parser.add_argument("--no-browser", action="store_true", help="open no browser, only print the address")
    parser.add_argument("-o", "--out", type=Path, metavar="FILE", help="write a page that plays offline: .html")
    parser.add_argument("--cover", action="store_true", help="with --out: the sphere cover as a layer of the page")
    parser.set_defaults(run="pictures:view")


def _add_convert(commands: Commands[argparse.ArgumentParser]) -> None:
    parser = commands.add_parser("convert", help="make a problem of a MoveIt or MotionBenchMaker scene and request")
    parser.add_argument("scene", type=Path, help="YAML of a moveit_msgs/PlanningScene")
    parser.add_argument("request", type=Path, help="YAML of a moveit_msgs/MotionPlanRequest")
    parser.add_argument("-o", "--out", type=Path, required=True, metavar="FILE", help="problem file to write (.yaml)")
    parser.add_argument("--robot", default="dual_panda_softhand", help="robot name or file (default: %(default)s)")
    parser.add_argument("--joint", action="append", default=[], metavar="THEIRS=OURS", help="a joint by another name")
    parser.add_argument("--frame", action="append", default=[], metavar="THEIRS=OURS", help="a frame by another name")
    parser.set_defaults(run="commands:convert")


def _add_calibrate(commands: Commands[argparse.ArgumentParser]) -> None:
    parser = commands.add_parser("calibrate", help="find where a camera is, by frames of a board in many states")
    parser.add_argument("frames", type=Path, help="folder of frames with color and joint positions")
    parser.add_argument("-o", "--out", type=Path, required=True, metavar="FILE", help="camera file to write (.yaml)")
    parser.add_argument(
        "--board", default="charuco:9x6:0.025", metavar="BOARD", help="KIND:COLUMNSxROWS:SQUARE by inner corners and "
        "meters, KIND charuco or chessboard, or tag:SIDE (default: %(default)s)",
    )  # fmt: skip
    parser.add_argument("--board-link", metavar="LINK", help="that carries the board (default: it stands still)")
    parser.add_argument("--camera-link", metavar="LINK", help="that carries the camera (default: it stands still)")
    parser.add_argument("--camera", type=Path, metavar="FILE", help="camera file (default: the frames' own)")
    parser.add_argument("--offsets", default="", metavar="J1,J2,...", help="joints whose readings may be off")
    parser.add_argument("--robot", default="dual_panda_softhand", help="robot name or file (default: %(default)s)")
    parser.set_defaults(run="perception:calibrate")


def _add_see(commands: Commands[argparse.ArgumentParser]) -> None:
    parser = commands.add_parser("see", help="find held objects and obstacles in frames of a camera")
    parser.add_argument(
        "frames", type=Path, nargs="+", metavar="FRAMES", help="a frame (.npz) or a folder of frames of each camera"
    )
    parser.add_argument("--problem", metavar="PROBLEM", help="whose robot holds the objects (default: none are held)")
    parser.add_argument(
        "--robot", default="dual_panda_softhand", help="without --problem: robot name or file (default: %(default)s)"
    )
    parser.add_argument("-o", "--out", type=Path, metavar="FILE", help="draw what was found into the picture: .png")
    parser.add_argument("--json", action="store_true", help="print what was found, with covariances, as JSON")
    parser.set_defaults(run="perception:see")


def _add_benchmark(commands: Commands[argparse.ArgumentParser]) -> None:
    parser = commands.add_parser("bench", help="run planners on suites through OMPL's Benchmark")
    parser.add_argument(
        "suites", nargs="+", metavar="SUITE", help="a suite, a level as shelf/hard, a problem or a file"
    )
    parser.add_argument(
        "--planners", default="apex,rrtconnect", metavar="A,B,...",
        help="names, with parameters as apex[fallback=false;bridge=false] (default: %(default)s)",
    )  # fmt: skip
    parser.add_argument("--runs", type=int, default=100, metavar="N", help="on a level (default: %(default)s)")
    parser.add_argument("--timeout", type=float, default=5.0, metavar="SECONDS", help="default: %(default)s")
    parser.add_argument("--seed", type=int, default=0, help="of the first run (default: %(default)s)")
    parser.add_argument("--split", default="test", help="train, validation or test (default: %(default)s)")
    parser.add_argument("--no-simplify", action="store_true", help="keep paths as planners found them")
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="at a time (default: one, for timing)")
    parser.add_argument("--address", metavar="HOST:PORT", help="of a Ray cluster to run on")
    parser.add_argument("-o", "--out", type=Path, required=True, metavar="DIR", help="resumes where it was stopped")
    parser.add_argument(
        "--keep", action="store_true", help="store each run's path, for apex-ompl render and PlanResult.load"
    )
    parser.add_argument("--quiet", action="store_true", help="show no progress")
    parser.set_defaults(run="commands:bench")
    parser = commands.add_parser("report", help="write an HTML page and Markdown of results of bench")
    parser.add_argument("results", type=Path, metavar="RESULTS", help="folder that bench wrote")
    parser.add_argument("-o", "--out", type=Path, required=True, metavar="DIR", help="gets report.html and report.md")
    parser.set_defaults(run="commands:report")


def _add_check(commands: Commands[argparse.ArgumentParser]) -> None:
    parser = commands.add_parser("check", help="validate a problem, and print whether start and goal are free")
    parser.add_argument("problem", help=PROBLEM_HELP)
    parser.set_defaults(run="commands:check")


def _add_robot(commands: Commands[argparse.ArgumentParser]) -> None:
    parser = commands.add_parser("robot", help="set up your own robot: new, check, prepare, train")
    steps = parser.add_subparsers(dest="step", required=True, metavar="STEP")
    new = steps.add_parser("new", help="write the robot file of a URDF, or of several in one cell")
    new._negative_number_matcher = re.compile(r"^-[\d.]")  # --at -0.5,0,0,0 is no option
    new.add_argument("urdf", nargs="+", metavar="URDF", help="a URDF or xacro file, or package://NAME/path")
    new.add_argument(
        "--srdf", action="append", default=[], metavar="FILE", help="with groups, states and disabled pairs; one for "
        "all URDFs, or one for each",
    )  # fmt: skip
    new.add_argument(
        "--at", action="append", default=[], metavar="X,Y,Z,YAW", help="where the root of a URDF stands [m, rad]; one "
        "for each of several URDFs (default: the origin)",
    )  # fmt: skip
    new.add_argument(
        "--package", action="append", default=[], metavar="NAME=FOLDER", help="the folder of package://NAME (default: "
        "by ROS_PACKAGE_PATH, or above the URDF)",
    )  # fmt: skip
    new.add_argument("-o", "--out", type=Path, metavar="FILE", help="a new robot file (default: NAME.robot.yaml)")
    new.set_defaults(run="robot:new")
    check = steps.add_parser("check", help="name the faults of a robot file, and say what sphere covers prove")
    check.add_argument("robot", help="robot file or name")
    check.add_argument("--samples", type=int, default=1000, metavar="N", help="random states (default: %(default)s)")
    check.add_argument("--json", action="store_true", help="print the numbers as JSON")
    check.set_defaults(run="robot:check")
    prepare = steps.add_parser("prepare", help="compute disabled pairs and sphere covers; resumes where it was stopped")
    prepare.add_argument("robot", type=Path, metavar="FILE", help="robot file, which is made to name what is computed")
    prepare.add_argument(
        "--budget", type=float, default=300.0, metavar="SECONDS", help="that it may take; inf for as long as it takes "
        "(default: %(default)s)",
    )  # fmt: skip
    prepare.add_argument("--jobs", type=int, default=1, metavar="N", help="processes (default: %(default)s)")
    prepare.add_argument(
        "--effort", type=int, default=3, metavar="1, 2 or 3", help="of the covers (default: %(default)s)"
    )
    prepare.add_argument(
        "--soft", action="append", default=[], metavar="PART", help="a part whose links may touch each other, as those "
        "of a hand with one synergy",
    )  # fmt: skip
    prepare.add_argument(
        "--samples", type=int, default=20_000, metavar="N", help="random states at which a pair that is disabled never "
        "touches (default: %(default)s)",
    )  # fmt: skip
    prepare.add_argument(
        "--margin", type=float, default=0.02, metavar="METERS", help="least distance of such a pair "
        "(default: %(default)s)",
    )  # fmt: skip
    prepare.add_argument(
        "--graze", type=float, default=1e-3, metavar="METERS", help="depth to which links with one joint between them "
        "may touch over its whole range, as bearings do, unchecked; 0 for not at all (default: %(default)s)",
    )  # fmt: skip
    prepare.add_argument("--seed", type=int, default=0, help="of the states (default: %(default)s)")
    prepare.set_defaults(run="robot:prepare")
    train = steps.add_parser("train", help="train a model for a robot; resumes where it was stopped")
    train.add_argument("robot", metavar="FILE", help="robot file, which is made to name the model; or a name")
    train.add_argument(
        "--hours", type=float, default=2.0, metavar="H", help="that data, training and validation may take together "
        "(default: %(default)s)",
    )  # fmt: skip
    train.add_argument(
        "--jobs", type=int, default=1, metavar="N", help="processes that generate data (default: %(default)s)"
    )
    train.add_argument("--seed", type=int, default=0, help="default: %(default)s")
    train.add_argument(
        "-o", "--out", type=Path, metavar="DIR", help="data and state of the training (default: NAME.training beside "
        "the robot file)",
    )  # fmt: skip
    train.set_defaults(run="robot_train:train")
