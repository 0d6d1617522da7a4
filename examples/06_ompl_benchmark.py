"""Use OMPL itself on one of our problems: a planner of OMPL's own, then ``ot.Benchmark``.

``apex_ompl.setup`` gives a SimpleSetup with space, checkers, start and goal in place, so everything that OMPL's
documentation says of SimpleSetup works on it.

Usage: python examples/06_ompl_benchmark.py [PROBLEM] [--runs 3] [--timeout 5] [--log FILE]
"""

from __future__ import annotations

import argparse

from ompl import base as ob
from ompl import geometric as og
from ompl import tools as ot
from ompl import util as ou

import apex_ompl
from apex_ompl import planners


def main() -> None:
    """Plan once with a planner of OMPL's own, then compare three by OMPL's benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("problem", nargs="?", default="reach_past_post")
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--timeout", type=float, default=5.0)
    parser.add_argument("--log", default="ompl_benchmark.log", help="OMPL's log; ompl_benchmark_statistics reads it")
    args = parser.parse_args()
    ou.setLogLevel(ou.LogLevel.LOG_WARN)
    ou.RNG.setSeed(1)

    setup = apex_ompl.setup(args.problem)
    si = setup.getSpaceInformation()
    connect = og.RRTConnect(si)
    connect.setRange(2.0)
    setup.setPlanner(connect)
    status = setup.solve(ob.timedPlannerTerminationCondition(args.timeout))
    print(f"{connect.getName()}: {status.getStatus().name}, length {setup.getSolutionPath().length():.2f} rad")

    benchmark = ot.Benchmark(setup, args.problem)
    for name in ("rrtconnect", "kpiece1", "rrt"):
        benchmark.addPlanner(planners.make(name, si))
    request = ot.Request(args.timeout, 4096.0, args.runs)
    request.displayProgress = False
    benchmark.benchmark(request)
    benchmark.saveResultsToFile(args.log)
    for planner in benchmark.getRecordedExperimentData().planners:
        solved = [run["solved BOOLEAN"] == "1" for run in planner.runs]
        times = sorted(float(run["time REAL"]) for run in planner.runs)
        print(f"{planner.name}: {sum(solved)}/{len(solved)} solved, median {times[len(times) // 2]:.2f} s")
    print(f"log: {args.log}")


if __name__ == "__main__":
    main()
