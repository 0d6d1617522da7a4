"""Check all frozen problems: hashes, start, goal and witness; and whether they are drawn the same again.

Usage: python scripts/check_frozen.py [--redraw 0] [SUITE[/LEVEL] ...]
"""

from __future__ import annotations

import argparse

import numpy as np

from apex_ompl import problems
from apex_ompl.errors import ApexError
from apex_ompl.moving.timed_proof import check_timed_path
from apex_ompl.ompl.setup import assemble
from apex_ompl.ompl.validity import full_check
from apex_ompl.problems import frozen
from apex_ompl.problems.catalogue import ProblemId, first_draw
from apex_ompl.problems.suite_robot import robot
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.validation import whole_number


def fault(name: str) -> str:
    """Return the fault of a frozen problem or its witness, or an empty text."""
    try:
        problem, witness = problems.load(name), problems.witness(name)
    except ApexError as error:
        return str(error)
    if witness.times is not None:
        names = robot().joint_names
        ends = [problem.start_state(names), problem.goal_states(names)[0]]
        if not np.array_equal(witness.path[[0, -1]], ends):
            return "the witness does not go from start to goal"
        return check_timed_path(robot(), problem, witness.path, witness.times).reason
    ready = assemble(problem)  # held by two hands, objects close a chain, which is a constraint, too
    path = witness.path if ready.constraints is None else frozen.on_constraints(problem, witness.path)
    if path is None:
        return "the witness cannot be moved onto the constraints"
    checked = full_check(ready.checker, path, ready.start, ready.goals, constraints=ready.constraints)
    return "".join((ready.start_fault, *ready.goal_faults)) or checked.reason


def main() -> None:
    """Check the levels named, or all."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("levels", nargs="*", metavar="SUITE[/LEVEL]")
    parser.add_argument(
        "--redraw", type=whole_number, default=0, metavar="N", help="draw N of each level again, and compare"
    )
    args = parser.parse_args()
    every = [f"{suite}/{level}" for suite, level in frozen.suite_levels()]
    for name in args.levels:
        if name not in every and name not in {suite for suite, _ in frozen.suite_levels()}:
            raise SystemExit(f"unknown suite or level {name!r}; known: {', '.join(every)}")
    faults = count = same = redrawn = 0
    for suite, level in frozen.suite_levels():
        if args.levels and suite not in args.levels and f"{suite}/{level}" not in args.levels:
            continue
        names = [name for split in frozen.COUNTS for name in problems.frozen_names(suite, level, split)]
        found = [(name, reason) for name in names if (reason := fault(name))]
        for name, reason in found:
            print(f"{name}: {reason}", flush=True)
        for name in names[: args.redraw]:
            which = ProblemId(suite, level, int(name.rsplit("/", 1)[1]))
            kept = frozen.load(which)
            redrawn += 1
            same += frozen.digest(first_draw(which, kept.draw_number - 1)[1]) == kept.digest
        faults, count = faults + len(found), count + len(names)
        print(f"{suite}/{level}: {len(names) - len(found)} of {len(names)} sound", flush=True)
    print(f"{count - faults} of {count} frozen problems sound; {same} of {redrawn} redrawn the same")
    raise SystemExit(1 if faults or same < redrawn else 0)


if __name__ == "__main__":
    run_script(main)
