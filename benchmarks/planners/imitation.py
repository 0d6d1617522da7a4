"""Imitation policies on validation problems: what they solve, where they fail, and how smooth their paths are.

Each policy is rolled out on problems of the validation split, to the nearest goal and by the planner, which tries each
goal in turn; beside it are the straight line to each goal, which is what a policy that has learned nothing does, and
the control whose paths are repaired. ``--tune`` compares how much of a chunk is followed, and blending, instead, on
problems that come after those of the table.

Usage: python -m benchmarks.planners.imitation [-n 20] [--tune] [--models NAME|FOLDER ...] [-o FOLDER]
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from ompl import base as ob

from apex_ompl import planners, problems
from apex_ompl.apex.models import make_query
from apex_ompl.baselines.imitation.planner import Imitation
from apex_ompl.baselines.imitation.policy import shared_policy
from apex_ompl.goals.alignment import AlignmentGoal
from apex_ompl.ompl.process import quiet_ompl
from apex_ompl.ompl.setup import PlanningSetup, assemble
from apex_ompl.ompl.space import path_to_array
from apex_ompl.paths.path import path_length
from apex_ompl.problems.catalogue import SPLITS
from apex_ompl.problems.suite_robot import robot
from apex_ompl.scene.problem import Alignment
from apex_ompl.timing.smoothness import jerk
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.files import make_folder
from apex_ompl.util.statistics import share_interval
from benchmarks.lib import record

DEPENDS = ("@benchmark", "apex_ompl/baselines/imitation", "benchmarks/baselines/il", "benchmarks/baselines/il-paper")
LEVELS = (*(f"{task}/{size}" for task in ("vertical", "horizontal") for size in ("free", "small", "medium", "large")),
          "shelf/easy")  # fmt: skip
KINDS: dict[tuple[str, ...], Literal["vertical", "horizontal"]] = {
    ("lower", "upper"): "vertical", ("cup", "ball"): "horizontal", ("block", "peg"): "horizontal",
}  # fmt: skip
LINE, REPAIR = "straight line", "+ repair"
SECONDS = 60.0  # of a planner, which ends by itself
VARIANTS = tuple({"executed": executed, "blend": blend} for executed in (4, 8, 16) for blend in (True, False))
Run = dict[str, Any]


def of_line(setup: PlanningSetup) -> Run:
    """Return what the straight line to the nearest goal is, and whether one to any goal is a solution."""
    goals = nearest_first(setup)
    lines = [np.stack([setup.start, goal]) for goal in goals]
    free = [bool(setup.checker.prove(line, tolerance=0.0)) for line in lines]
    return {"solved": any(free), "free": free[0], "off": 0.0, "aligned": aligned(setup, goals[0]), **numbers(lines[0])}


def of_policy(setup: PlanningSetup, name: str, params: Mapping[str, Any]) -> Run:
    """Return what a policy's path to the nearest goal is, and whether the planner has a solution.

    With repair the numbers are those of the solution, and missing without one.
    """
    checker, goal = setup.checker, nearest_first(setup)[0]
    solution = planned(setup, name, params)
    if params.get("repair"):
        return {"solved": solution is not None, **({} if solution is None else numbers(solution))}
    policy, record_of = shared_policy(name, robot=setup.robot.name), Imitation().changed(**params)
    assert isinstance(record_of, Imitation)
    query = make_query(checker, setup.start, goal, point=policy.sees_point)
    found = policy.roll_out([query], checker.kernel, executed=record_of.executed, blend=record_of.blend)
    assert found is not None
    path = found[0]
    return {
        "solved": solution is not None, "free": bool(checker.prove(path, tolerance=0.0)),
        "off": float(np.abs(path[-1] - goal).max()), "aligned": aligned(setup, path[-1]), **numbers(path),
    }  # fmt: skip


def numbers(path: np.ndarray) -> dict[str, float]:
    """Return the length of a path, that of the line between its ends, and its jerk over a second by its length."""
    length, line = path_length(path), float(np.linalg.norm(path[-1] - path[0]))
    return {"length": length, "ratio": length / line, "jerk": jerk(path) / length}


def planned(setup: PlanningSetup, name: str, params: Mapping[str, Any]) -> np.ndarray | None:
    """Return the planner's exact solution, shape (N, dof), or None."""
    simple_setup = setup.simple_setup
    simple_setup.clear()
    simple_setup.setPlanner(planners.make("il", simple_setup.getSpaceInformation(), model=name, **params))
    status = simple_setup.solve(ob.timedPlannerTerminationCondition(SECONDS))
    setup.raise_faults()
    if status.getStatus() != ob.PlannerStatus.EXACT_SOLUTION:
        return None
    return path_to_array(simple_setup.getSolutionPath(), setup.robot.dof)


def nearest_first(setup: PlanningSetup) -> list[np.ndarray]:
    """Return the valid goals, the nearest first."""
    return sorted(setup.valid_goals, key=lambda goal: float(np.linalg.norm(goal - setup.start)))


def aligned(setup: PlanningSetup, q: np.ndarray) -> bool | None:
    """Return whether a state aligns what the hands hold within the tolerance of the paper's tasks, None without."""
    held = setup.problem.attached
    names = tuple(one.name for one in held)
    if names not in KINDS:
        return None
    alignment = Alignment(kind=KINDS[names], first=names[0], second=names[1])
    return AlignmentGoal(setup.robot, alignment, held, setup.start).is_satisfied(q)


def rows_of(models: Sequence[str], tune: bool) -> list[tuple[str, str, dict[str, Any]]]:
    """Return the rows: label, policy and parameters; the straight line has no policy."""
    if tune:
        name = models[0]
        return [(f"{name}, {v['executed']} of a chunk, {'blended' if v['blend'] else 'as they are'}", name, v)
                for v in VARIANTS]  # fmt: skip
    rows: list[tuple[str, str, dict[str, Any]]] = [(LINE, "", {})]
    for name in models:
        label = Path(name).name
        rows += [(label, name, {}), (f"{label} {REPAIR}", name, {"repair": True})]
    return rows


def measure(rows: Sequence[tuple[str, str, dict[str, Any]]], count: int, first: int) -> list[Run]:
    """Return the runs of all rows on the problems of all levels."""
    runs = []
    for level in LEVELS:
        for seed in range(first, first + count):
            setup = assemble(problems.load(f"{level}/{seed}"), robot())
            if setup.start_fault or not len(setup.valid_goals):
                continue
            for label, name, params in rows:
                found = of_policy(setup, name, params) if name else of_line(setup)
                runs.append({"level": level, "seed": seed, "row": label, **found})
    return runs


def cells(runs: Sequence[Run]) -> list[str]:
    """Return the numbers of some runs of a row: N, shares, and medians."""

    def share(key: str, holds: Callable[[Any], bool] = bool) -> str:
        known = [holds(r[key]) for r in runs if r.get(key) is not None]
        return f"{100 * np.mean(known):.0f} %" if known else "-"

    def median(key: str, digits: int) -> str:
        known = [r[key] for r in runs if key in r]
        return f"{np.median(known):.{digits}f}" if known else "-"

    low, high = share_interval(sum(r["solved"] for r in runs), len(runs))
    return [
        str(len(runs)), f"{share('solved')} ({100 * low:.0f}-{100 * high:.0f})",
        share("off", lambda off: off <= Imitation().reach), share("aligned"), share("free", lambda free: not free),
        median("off", 3), median("length", 2), median("ratio", 2), median("jerk", 0),
    ]  # fmt: skip


HEAD = (
    "level", "row", "N", "solved (95 %)", "ends at the goal", "aligned", "collides", "off rad", "S_r rad",
    "S_r / line", "jerk / S_r 1/s^3",
)  # fmt: skip


def table(runs: Sequence[Run], labels: Sequence[str]) -> str:
    """Return the table, Markdown: each row on each level, and on all."""
    lines = [HEAD, ("---", "---", *["---:"] * (len(HEAD) - 2))]
    for level in (*LEVELS, "all"):
        for label in labels:
            mine = [r for r in runs if r["row"] == label and level in (r["level"], "all")]
            if mine:
                lines.append((level, label, *cells(mine)))
    return "\n".join(record.row(list(line)) for line in lines)


def main() -> None:
    """Measure, and write the results."""
    parser = record.parser(__doc__, n=20, of="problems of each level")
    parser.add_argument("--tune", action="store_true", help="compare ways of following chunks instead")
    parser.add_argument("--models", nargs="+", default=["il", "il-paper"], metavar="NAME|FOLDER")
    parser.add_argument("-o", "--out", type=Path, default=record.RESULTS, help="folder of the results")
    args = parser.parse_args()
    rows = rows_of(args.models, args.tune)
    first = SPLITS["validation"][0] + (1000 if args.tune else 0)
    with quiet_ompl():
        runs = measure(rows, args.n, first)
    text = table(runs, [label for label, _, _ in rows])
    name = "imitation_tuning" if args.tune else "imitation"
    out = make_folder(args.out, "folder of results")
    record.write(name, {"runs": runs}, text, out, seed=first, n=args.n)


if __name__ == "__main__":
    run_script(main)
