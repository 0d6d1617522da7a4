"""Main parameters of the planners, tuned on hard and large validation problems with the same budget for each planner.

Each planner has eight candidates, the first its default; OMPL's and RoboPlan's are theirs. Successive halving: all run
on the first problem of each level, the best four and the default on the first two, the best two of them and the
default on the first four; 2 s a run. Problems and seeds are the same for all. The score is the mean over the problems
of the time to the first path that passed the full check, where an unsolved one counts as 4 s (PAR2); for planners that
go on improving or shorten their path, times the mean of the length at the end over the shortest of the planner's
candidates, where an unsolved one counts as 2. Paths are not simplified. The candidate of the lowest score on the last
problems is chosen; apex_ompl/ompl/tuned.py keeps it.
Each run is stored in benchmarks/runs/tune when it ends; the command resumes where it was stopped.

Levels are the hard and large ones of the suites and every second validation kind of ``unseen``. Where planners are
named only these are tuned, and the rest of the result stays: beside its scores each planner has the number of levels,
and how its runs were made.

With --baselines the paper's baselines are tuned in the same way on the easy and medium levels instead, since local
methods fail on hard ones whatever their parameters are (results tune_baselines, and runs in a folder of that name).

Usage: python -m benchmarks.planners.tune [PLANNER ...] [--baselines] [--jobs 1]    (RoboPlan needs the extra "peers")
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from apex_ompl import planners
from apex_ompl.evaluation import Results, Row, Workers, bench
from apex_ompl.evaluation.runs import NO_PROBLEM, Run
from apex_ompl.evaluation.summary import Statistics
from apex_ompl.problems.catalogue import VALIDATION
from apex_ompl.util.entry_point import run_script
from benchmarks.lib import record

DEPENDS = (
    "@checking", "apex_ompl/apex", "apex_ompl/api.py", "apex_ompl/evaluation", "apex_ompl/model",
    "apex_ompl/ompl/own_planner.py", "apex_ompl/ompl/parameters.py", "apex_ompl/ompl/repair.py",
    "apex_ompl/ompl/setup.py", "apex_ompl/ompl/space.py", "apex_ompl/ompl/validity.py",
    "apex_ompl/planning", "apex_ompl/result.py", "apex_ompl/baselines", "apex_ompl/goals", "apex_ompl/paths",
    "benchmarks/baselines", "benchmarks/planners/peers.py", "planners", "problems",
)  # fmt: skip
# All that plans but apex_ompl/ompl/tuned.py, which follows from the result: candidates name all tuned parameters.
FOLDER = Path(__file__).parents[1] / "runs" / "tune"
BASELINES_FOLDER = FOLDER.with_name("tune_baselines")
ROBOPLAN = "roboplan"
TIMEOUT = 2.0  # [s]
UNSOLVED_TIME, UNSOLVED_LENGTH = 2.0 * TIMEOUT, 2.0  # [s], times the shortest
RUNGS = ((8, 1), (4, 2), (2, 4))
"""Candidates that are left besides the default, and problems of a level."""
TUNED_ON = RUNGS[-1][1]  # first problems of a level that planners are tuned on


def ranges(*steps: float, **others: Any) -> list[dict[str, Any]]:
    """Return a candidate for each longest step of a tree [rad]; 0 lets OMPL choose."""
    return [{"range": step, **others} for step in steps]


def batches(*sizes: int, **others: Any) -> list[dict[str, Any]]:
    """Return a candidate for each number of samples in a batch of BIT*."""
    return [{"samples_per_batch": size, "rewire_factor": 1.1, "use_k_nearest": True} | others for size in sizes]


def supports(safety_distance: float, obstacle_sigma: float, intervals: int, power: float) -> dict[str, Any]:
    """Return a candidate for GPMP or GPMP2."""
    return {
        "safety_distance": safety_distance, "obstacle_sigma": obstacle_sigma, "intervals": intervals, "power": power
    }  # fmt: skip


CANDIDATES: dict[str, list[dict[str, Any]]] = {
    "rrtconnect": [
        *ranges(0.0, 0.3, 0.5, 0.7, 1.0, 1.4, 2.0, intermediate_states=False),
        *ranges(0.7, intermediate_states=True),
    ],
    "rrtconnect+polish": ranges(0.0, 0.3, 0.5, 0.7, 0.85, 1.0, 1.4, 2.0),
    "apex": [
        *ranges(0.7, 0.0, 0.85, 1.0, 1.4, sprint=2000, first=4),
        *(row for sprint in (800, 5000) for row in ranges(1.0, sprint=sprint, first=4)),
        *ranges(1.0, sprint=2000, first=2),
    ],
    ROBOPLAN: [
        *({"max_connection_distance": step} for step in (3.0, 0.3, 0.5, 0.7, 1.0, 1.4, 2.0)),
        {"max_connection_distance": 1.0, "collision_check_use_bisection": False},
    ],
    "aorrtc": ranges(0.0, 0.3, 0.5, 0.7, 1.0, 1.4, 2.0, 3.0),
    "lbkpiece1": [
        *ranges(0.0, 0.3, 0.5, 0.7, 1.0, 1.4, 2.0, border_fraction=0.9),
        *ranges(0.7, border_fraction=0.5),
    ],
    "kpiece1": [
        *ranges(0.0, 0.3, 0.7, 1.4, goal_bias=0.05, border_fraction=0.9),
        *ranges(0.7, 1.4, goal_bias=0.2, border_fraction=0.9),
        *ranges(0.7, 1.4, goal_bias=0.05, border_fraction=0.5),
    ],
    "informedrrtstar": [
        *ranges(0.0, 0.5, 1.0, 2.0, goal_bias=0.05, delay_cc=True),
        *ranges(0.5, 1.0, 2.0, goal_bias=0.2, delay_cc=True),
        *ranges(1.0, goal_bias=0.2, delay_cc=False),
    ],
    "bitstar": [
        *batches(100, 10, 30, 300, 1000),
        *batches(100, rewire_factor=1.5),
        *batches(100, rewire_factor=2.0),
        *batches(100, use_k_nearest=False),
    ],
}
"""Candidates of each planner, the default first."""

GAUSSIAN_PROCESS = [
    supports(0.2, 0.02, 10, 8.0),  # of the size of the authors' examples for arms
    supports(0.08, 0.004, 12, 1.0),
    supports(0.12, 0.006, 12, 1.0),
    supports(0.12, 0.0024, 12, 1.0),
    supports(0.08, 0.0016, 12, 1.0),
    supports(0.12, 0.006, 8, 1.0),
    supports(0.12, 0.006, 20, 1.0),
    supports(0.12, 0.006, 12, 10.0),
]

BASELINES: dict[str, list[dict[str, Any]]] = {
    "gpmp": GAUSSIAN_PROCESS,
    "gpmp2": GAUSSIAN_PROCESS,
    "rrt": [  # steps up to the longest distance in the space, 17 rad; 0 lets OMPL choose a fifth of it
        *ranges(0.0, 0.7, 2.5, 7.0, 17.0, goal_bias=0.05),
        *ranges(2.5, 17.0, goal_bias=0.2),
        *ranges(7.0, goal_bias=0.1),
    ],
    "drrt": [
        *ranges(0.7, 1.4, 3.0, 4.5, 6.5, goal_bias=0.1),  # the last is the widest of a joint
        *ranges(4.5, 6.5, goal_bias=0.05),
        *ranges(4.5, goal_bias=0.3),
    ],
    "damon": [  # with nodes that are decoded, as the paper has it
        *({"model": "damon-8", "connections": count} for count in (100, 300, 1000, 3000, 10_000)),
        *({"model": f"damon-{dimensions}", "connections": 1000} for dimensions in (4, 2)),
        {"model": "damon-4", "connections": 3000},
    ],
}
"""Candidates of the baselines of the paper: values of the size of the authors' examples, or usual ones, first."""


@dataclass(frozen=True)
class Score:
    """How a candidate did on the problems of a rung.

    Attributes:
        label: Label of the candidate.
        runs: Its runs.
        shortest: Length of the shortest path of the planner's candidates by problem, for planners that go on improving
            or shorten it [rad].
    """

    label: str
    runs: Sequence[Run]
    shortest: dict[str, float] | None

    @property
    def time(self) -> float:
        """Mean of the times to the first path [s]."""
        return float(np.mean(self.times))

    @property
    def times(self) -> list[float]:
        """Times to the first path [s]."""
        return [run["first"] if run["solved"] else UNSOLVED_TIME for run in self.runs]

    @property
    def length(self) -> float:
        """Mean of the lengths over the shortest; 1 for planners that neither improve nor shorten their first path."""
        if self.shortest is None:
            return 1.0
        known = [(run, self.shortest[run["problem"]]) for run in self.runs if run["problem"] in self.shortest]
        ratios = [run["length"] / best if run["solved"] else UNSOLVED_LENGTH for run, best in known]
        return float(np.mean(ratios or [1.0]))

    @property
    def score(self) -> float:
        """What is least for the best candidate [s]."""
        return self.time * self.length

    def figures(self) -> dict[str, Any]:
        """Return the values of the result."""
        found = Statistics("", self.label, self.runs)
        return {
            "n": len(self.runs), "solved": len(found.solved) / len(self.runs), "score": self.score,
            "first_s_mean": self.time, "first_s_geometric_mean": float(np.exp(np.mean(np.log(self.times)))),
            "length_mean": None if self.shortest is None else self.length,
            "first_s": [record.reached(found.times("first"), p) for p in (50, 95)],
        }  # fmt: skip


def levels() -> list[str]:
    """Return the hardest static levels of all suites, and every second kind of scenes that is not trained for."""
    hardest = [level for level in record.static_levels([]) if level.endswith(("/hard", "/large"))]
    return [*hardest, *(f"unseen/{kind}" for kind in VALIDATION["unseen"][::2])]


def easier_levels() -> list[str]:
    """Return the other static levels but the extreme ones."""
    return [level for level in record.static_levels([]) if level not in levels() and not level.endswith("/extreme")]


def rows_of(planner: str) -> list[Row]:
    """Return a row of each candidate."""
    runner = ""
    if planner == ROBOPLAN:
        from benchmarks.planners import peers  # which needs RoboPlan

        runner = peers.RUNNER
    return [Row.of(planner, params, runner=runner) for params in (CANDIDATES | BASELINES)[planner]]


def scores(planner: str, results: Results, rows: Sequence[Row], problems: int) -> list[Score]:
    """Return how candidates did on the first problems of each level, the best first."""
    labels = {row.label for row in rows}
    runs = [run for run in results.runs if run["label"] in labels and run["seed"] < problems]
    runs = [run for run in runs if run["status"] != NO_PROBLEM]
    shortest: dict[str, float] | None = None
    if planner != ROBOPLAN and (planners.parameters(planner).optimizing or planners.parameters(planner).smooth):
        shortest = {}
        for run in runs:
            if run["solved"]:
                shortest[run["problem"]] = min(run["length"], shortest.get(run["problem"], math.inf))
    found = [Score(row.label, [run for run in runs if run["label"] == row.label], shortest) for row in rows]
    return sorted(found, key=lambda one: one.score)


def rungs_of(planner: str, jobs: int) -> list[list[Score]]:
    """Run the candidates of a planner that are missing, and return their scores in each rung, the best first."""
    rows, found = rows_of(planner), list[list[Score]]()
    where, folder = (easier_levels(), BASELINES_FOLDER) if planner in BASELINES else (levels(), FOLDER)
    best = [row.label for row in rows]
    for keep, problems in RUNGS:
        left = [row for row in rows if row == rows[0] or row.label in best[:keep]]
        results = bench(
            where, left, folder, runs=problems, timeout=TIMEOUT, split="validation", simplify=False,
            workers=Workers(jobs), provenance=record.session(),
        )  # fmt: skip
        found.append(scores(planner, results, left, problems))
        best = [one.label for one in found[-1]]
    return found


def chosen(planner: str, last: Sequence[Score]) -> dict[str, Any]:
    """Return the parameters of the best candidate of the last rung."""
    return next(dict(row.params) for row in rows_of(planner) if row.label == last[0].label)


def table(found: dict[str, Any]) -> str:
    """Return the Markdown tables: the last rung of each planner, then all rungs of all candidates."""
    head = ["planner", "N", "solved", "first path p50 ms", "p95", "geometric mean ms", "mean ms", "length"]
    head += ["score ms"]
    lines = [record.row(head), record.row(["---", *["---:"] * (len(head) - 1)])]
    for one in found.values():
        for place, (label, figures) in enumerate(one["rungs"][-1].items()):
            name = label if place else f"**{label}**"
            lines.append(record.row([f"{name}{', default' if label == one['default'] else ''}", *_cells(figures)]))
    problems = [f"{count} of each level" for _, count in RUNGS]
    head = ["candidate, score in ms (rank) on", *problems, "levels", "jobs; hardware; commits"]
    lines += ["", record.row(head), record.row(["---", *["---:"] * (len(head) - 1)])]
    for one in found.values():
        for label in one["rungs"][0]:
            places = [list(rung).index(label) if label in rung else None for rung in one["rungs"]]
            both = zip(one["rungs"], places, strict=True)
            cells = ["" if k is None else f"{1e3 * rung[label]['score']:.0f} ({k + 1})" for rung, k in both]
            lines.append(record.row([label, *cells, one["levels"], "; ".join(one["made_with"].values())]))
    return "\n".join(lines)


def _cells(f: dict[str, Any]) -> list[Any]:
    times = [
        "-" if v is None else f"{1e3 * v:.0f}" for v in (*f["first_s"], f["first_s_geometric_mean"], f["first_s_mean"])
    ]
    length = "" if f["length_mean"] is None else f"{f['length_mean']:.2f}"
    return [f["n"], f"{f['solved']:.3f}", *times, length, f"{1e3 * f['score']:.0f}"]


def main() -> None:
    """Run what is missing, and write the results."""
    parser = record.parser(__doc__, jobs=1)
    parser.add_argument("--baselines", action="store_true", help="tune the baselines of the paper instead")
    parser.add_argument("planners", nargs="*", metavar="PLANNER", help="only these; the others' results stay")
    args = parser.parse_args()
    known, folder = (BASELINES, BASELINES_FOLDER) if args.baselines else (CANDIDATES, FOLDER)
    if not set(args.planners) <= set(known):
        parser.error(f"expected planners of {', '.join(known)}")
    tuned = {name: rungs_of(name, args.jobs) for name in args.planners or known}
    levels_of = len(easier_levels() if args.baselines else levels())
    made_with = record.made_with(Results.load(folder))
    kept = json.loads((record.RESULTS / f"{folder.name}.json").read_text())["planners"] if args.planners else {}
    data = {
        planner: kept[planner] if planner not in tuned else {
            "default": rows_of(planner)[0].label, "chosen": chosen(planner, tuned[planner][-1]), "levels": levels_of,
            "made_with": made_with,
            "rungs": [{one.label: one.figures() for one in rung} for rung in tuned[planner]],
        }
        for planner in known
    }  # fmt: skip
    most = [f"{keep + (k > 0)} candidates on {count} problems of a level" for k, (keep, count) in enumerate(RUNGS)]
    about = {} if args.baselines else {"roboplan": version(ROBOPLAN)}
    record.write(
        folder.name, {"planners": data}, table(data), split="validation", limit=f"{TIMEOUT:g} s",
        budget=f"at most {', '.join(most)}", seeds="number of the problem modulo 1000",
        **about, **made_with,
    )  # fmt: skip


if __name__ == "__main__":
    run_script(main)
