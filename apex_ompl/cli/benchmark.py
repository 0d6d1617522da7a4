"""The commands ``apex-ompl bench`` and ``apex-ompl report``."""

from __future__ import annotations

import argparse
import re

from apex_ompl.cli.options import import_extra


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
