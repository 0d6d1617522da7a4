"""Ask the model for paths, repair them, and see which are solutions.

Usage: python examples/07_propose.py [PROBLEM] [--count 8]
"""

from __future__ import annotations

import argparse
import sys
import time

import apex_ompl
from apex_ompl.apex import make_query
from apex_ompl.ompl import assemble, full_check
from apex_ompl.paths import Optimizer, first_valid, path_length


def main() -> None:
    """Propose, check, repair, and check again."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("problem", nargs="?", default="shelf/hard/900012")
    parser.add_argument("--count", type=int, default=8, help="paths to propose (default: %(default)s)")
    args = parser.parse_args()
    try:
        model = apex_ompl.load_model("apex")
        ready = assemble(apex_ompl.load_problem(args.problem))
        start, goal, kernel = ready.start, ready.goals[0], ready.checker.kernel
        query = make_query(ready.checker, start, goal)
        begin = time.perf_counter()
        proposed = model.propose(query, kernel, args.count).control
    except apex_ompl.ApexError as error:
        print(f"propose: error: {error}", file=sys.stderr)
        sys.exit(2)
    took = time.perf_counter() - begin
    valid = [bool(full_check(ready.checker, model.spline.path(c), start, [goal])) for c in proposed]
    print(f"{args.count} paths in {1e3 * took:.0f} ms, {sum(valid)} of them valid as they are")
    begin = time.perf_counter()
    found = first_valid(
        Optimizer(model.spline), kernel, proposed, lambda path: bool(full_check(ready.checker, path, start, [goal]))
    )
    took = time.perf_counter() - begin
    if found is None:
        print(f"none valid after {1e3 * took:.0f} ms of repair")
        return
    print(f"a valid one after {1e3 * took:.0f} ms of repair, {path_length(model.spline.path(found)):.1f} rad long")


if __name__ == "__main__":
    main()
