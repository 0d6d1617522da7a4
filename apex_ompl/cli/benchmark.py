"""The commands ``apex-ompl bench`` and ``apex-ompl report``."""

from __future__ import annotations

import argparse
import re
from pathlib import Path

from apex_ompl.cli.options import import_extra


def add_bench_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command ``bench`` and its options."""
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
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="at a time (default: one, as they are timed)")
    parser.add_argument("--address", metavar="HOST:PORT", help="of a Ray cluster to run on")
    parser.add_argument("-o", "--out", type=Path, required=True, metavar="DIR", help="goes on where it was stopped")
    parser.add_argument(
        "--keep", action="store_true", help="store each run's path, for apex-ompl render and PlanResult.load"
    )
    parser.add_argument("--quiet", action="store_true", help="show no progress")
    parser.set_defaults(run=bench)


def add_report_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command ``report`` and its options."""
    parser = commands.add_parser("report", help="write an HTML page and Markdown of results of bench")
    parser.add_argument("results", type=Path, metavar="RESULTS", help="folder that bench wrote")
    parser.add_argument("-o", "--out", type=Path, required=True, metavar="DIR", help="gets report.html and report.md")
    parser.set_defaults(run=report)


def bench(parsed: argparse.Namespace) -> int:
    """Run a benchmark."""
    benchmark = import_extra("apex_ompl.benchmark", "benchmarks", "bench")
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
    for file in import_extra("apex_ompl.benchmark", "benchmarks", "bench").report(parsed.results, parsed.out):
        print(file)
    return 0


def _split_planners(planners: str) -> list[str]:
    """Return the names of a list with commas; commas inside brackets do not separate names."""
    return [name for name in re.split(r",(?![^\[]*\])", planners) if name.strip()]
