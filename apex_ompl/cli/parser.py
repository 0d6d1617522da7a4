"""The command line ``apex-ompl``: its parser, and the exit codes of errors.

Results go to standard output, logs and errors to standard error. Exit codes: 0 exact, 1 no plan or no timed motion, 2
wrong usage or an invalid file, 3 invalid start or goal, 4 approximate, 130 interrupted.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from typing import NoReturn

from apex_ompl import __version__
from apex_ompl.cli import benchmark, check, convert, listings, pictures, plan
from apex_ompl.errors import ApexError


class _Parser(argparse.ArgumentParser):
    """A parser whose errors are one sentence, without the usage."""

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
        sys.stdout = open(os.devnull, "w")  # the reader has closed the pipe; nothing may be flushed at exit
        return 1
    except OSError as error:
        sys.stdout = open(os.devnull, "w")
        print(f"apex-ompl: error: output: {error.strerror or error}", file=sys.stderr)
        return 2


def _parser() -> argparse.ArgumentParser:
    parser: argparse.ArgumentParser = _Parser(
        prog="apex-ompl", description="Plan motions of two arms and hands through OMPL."
    )
    parser.add_argument("--version", action="version", version=f"apex-ompl {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    plan.add_parser(commands)  # in the order of the help text
    pictures.add_render_parser(commands)
    pictures.add_plot_parser(commands)
    convert.add_parser(commands)
    benchmark.add_bench_parser(commands)
    benchmark.add_report_parser(commands)
    check.add_parser(commands)
    listings.add_parsers(commands)
    return parser
