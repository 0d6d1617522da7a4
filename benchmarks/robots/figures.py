"""Figures of robots: their preparation, the share proved, and apex without a model beside rrtconnect+polish.

Figures are kept in a file beside the robot's after each step, so that a benchmark resumes where it was stopped.
"""

from __future__ import annotations

import json
import time
from argparse import ArgumentParser
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from resource import RUSAGE_CHILDREN, RUSAGE_SELF, getrusage
from typing import Any

import numpy as np

from apex_ompl import MotionPlanner
from apex_ompl.collision.cover.preparation import Preparation, prepare
from apex_ompl.collision.cover.survey import survey
from apex_ompl.robot import load_robot
from apex_ompl.scene.problem import Problem
from apex_ompl.util.files import write_atomically
from apex_ompl.util.schema import read_json
from benchmarks.lib import record

Rows = Mapping[str, tuple[str, Mapping[str, Any]]]
"""Label -> planner and its parameters."""
PLANNERS: Rows = {"apex": ("apex", {"model": "none"}), "rrtconnect+polish": ("rrtconnect+polish", {})}
TIMEOUT = 10.0  # of a call, by the wall clock of a machine that does other things too [s]
SOON = 1.0  # [s]
SAMPLES, SEED = 2000, 7  # states of the shares
BUDGET, JOBS = 300.0, 2  # of a preparation
SETTINGS = {"seed": SEED, "states": SAMPLES, "limit": f"{TIMEOUT:g} s"}  # of results


def cpu() -> float:
    """Return the CPU time of this process and of those that it has waited for [s]."""
    return sum(sum(getrusage(who)[:2]) for who in (RUSAGE_SELF, RUSAGE_CHILDREN))


class Figures:
    """Figures of one robot, in a file."""

    def __init__(self, robot: Path, rows: Rows = PLANNERS, timeout: float = TIMEOUT) -> None:
        """Read what there is beside a robot file; ``rows`` are planned with a time limit [s]."""
        self.robot, self.file, self.rows, self.timeout = robot, robot.parent / "figures.json", rows, timeout
        self.data: dict[str, Any] = read_json(self.file, "figures of a robot") if self.file.exists() else {"runs": {}}

    def write(self, **figures: Any) -> None:
        """Add figures."""
        self.data |= figures
        write_atomically(self.file, (json.dumps(self.data, indent=1) + "\n").encode())

    def note_commit(self) -> None:
        """Note the commit of the runs that follow."""
        self.write(commits=sorted({*self.data.get("commits", ()), record.session()["commit"]}))

    def prepare(self, budget: float, jobs: int) -> None:
        """Prepare the robot unless that was done to the end or for the whole budget, and measure the share proved."""
        if not self.data.get("prepared"):
            began, started = cpu(), time.perf_counter()
            done = prepare(self.robot, Preparation(budget=budget, jobs=jobs))
            used = self.data.get("prepare_cpu_s", 0.0) + cpu() - began
            lasted = self.data.get("prepare_wall_s", 0.0) + time.perf_counter() - started
            self.data.pop("proved", None)
            self.write(prepare_cpu_s=used, prepare_wall_s=lasted, prepared=done.thorough or lasted >= budget)
        if "proved" not in self.data:
            robot = load_robot(self.robot)
            found = survey(robot, SAMPLES, SEED)
            spoilers = {" and ".join(links): share for links, share in list(found.spoilers.items())[:3]}
            pairs = len(robot.geometry.collisionPairs)
            self.write(dof=robot.dof, pairs=pairs, free=found.free, proved=found.proved, spoilers=spoilers)

    def run(self, names: Iterable[str], problem: Callable[[str], Problem]) -> None:
        """Plan for the problems that are missing.

        Args:
            names: Names of the problems.
            problem: Returns one by its name.
        """
        missing = [name for name in names if name not in self.data["runs"]]
        if not missing:
            return
        self.note_commit()
        planner = MotionPlanner(str(self.robot))
        for one, params in self.rows.values():  # what a process does once
            planner.plan_problem(problem(missing[0]), one, params=params, timeout=self.timeout, timing=False, seed=1)
        for k, name in enumerate(missing):
            given, row = problem(name), {}
            for label, (one, params) in self.rows.items():
                planner.world.clear()
                began = cpu()
                found = planner.plan_problem(given, one, params=params, timeout=self.timeout, timing=False, seed=k)
                used, length = cpu() - began, found.length if found else None
                row[label] = {"solved": bool(found), "cpu_s": used, "length": length, "by": found.solved_by}
            self.data["runs"][name] = row
            self.write()
            print(name, *(f"{one} {r['cpu_s']:.2f} s by {r['by'] or '-'}" for one, r in row.items()), flush=True)

    def outcomes(self, names: Iterable[str]) -> tuple[int, int, dict[str, dict[str, float | None]]]:
        """Return the number of problems that any row solves, that of the others, and the figures of each row."""
        all_runs = [self.data["runs"][name] for name in names if name in self.data["runs"]]
        runs = [run for run in all_runs if any(one["solved"] for one in run.values())]
        both = [run for run in runs if all(one["solved"] for one in run.values())]
        found = dict[str, dict[str, float | None]]()
        for label in self.rows:
            mine = [run[label] for run in runs]
            soon = float(np.mean([run["solved"] and run["cpu_s"] <= SOON for run in mine])) if mine else None
            p50, p95 = (_percentile(mine, p) for p in (50, 95))
            length = float(np.median([run[label]["length"] for run in both])) if both else None
            found[label] = {"soon": soon, "p50_s": p50, "p95_s": p95, "length_rad": length}
        return len(runs), len(all_runs) - len(runs), found

    def row(self, label: str, names: Iterable[str]) -> tuple[dict[str, Any], list[Any]]:
        """Return the figures of the problems of some names, and a row of the table."""
        data, (count, unsolved, outcomes) = self.data, self.outcomes(names)
        figures = {key: data[key] for key in ("dof", "pairs", "free", "proved", "spoilers", "prepare_cpu_s")}
        cells: list[Any] = [label, data["dof"], data["pairs"], f"{data['free']:.0%}", f"**{data['proved']:.0%}**"]
        cells += [f"{data['prepare_cpu_s']:.0f}", count, unsolved]
        figures |= {"robot": label, "n": count, "unsolved": unsolved} | outcomes
        for one in outcomes.values():
            cells += ["-" if value is None else f"{value:.2f}" for value in one.values()]
        cells.append(", ".join(f"{pair} {share:.0%}" for pair, share in data["spoilers"].items()))
        return figures, cells


def run_commits(rows: Mapping[str, tuple[Figures, list[str]]]) -> str:
    """Return the commits of all runs."""
    return "; ".join(sorted({one for mine, _ in rows.values() for one in mine.data.get("commits", ())}))


def _percentile(runs: list[dict[str, Any]], p: float) -> float | None:
    """Return a percentile of the times of runs, those without a path last [s]; None where it is one of them."""
    return record.reached([run["cpu_s"] if run["solved"] else np.inf for run in runs], p)


def add_options(parser: ArgumentParser, folder: Path) -> None:
    """Add the options of preparations and of the folder of figures."""
    parser.add_argument("--budget", type=float, default=BUDGET, help="of a preparation [s] (default: %(default)s)")
    parser.add_argument("--jobs", type=int, default=JOBS, help="processes of a preparation (default: %(default)s)")
    parser.add_argument("--folder", type=Path, default=folder, help="of robots and figures (default: %(default)s)")


def table(rows: Mapping[str, tuple[Figures, list[str]]]) -> tuple[dict[str, Any], str]:
    """Return the figures of some robots, and their table.

    Args:
        rows: Label -> figures, and the names of the problems that count.
    """
    made = [figures.row(label, names) for label, (figures, names) in rows.items()]
    both = [f"{planner}: {what}" for planner in PLANNERS for what in ("in 1 s", "CPU s p50", "p95", "length rad")]
    head = [
        "robot", "joints", "pairs", "free", "proved", "prepare CPU s", "N", "unsolved by both", *both, "unproved pairs",
    ]  # fmt: skip
    lines = [record.row(head), record.row(["---", *["---:"] * (len(head) - 2), "---"])]
    return {"robots": [one for one, _ in made]}, "\n".join([*lines, *(record.row(cells) for _, cells in made)])
