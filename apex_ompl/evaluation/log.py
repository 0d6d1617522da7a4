"""OMPL's log of a benchmark, and the database for Planner Arena that is made of it."""

from __future__ import annotations

import contextlib
import io
import os
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from typing import Any

from ompl import tools as ot

from apex_ompl.api import load_problem
from apex_ompl.evaluation.results import Results
from apex_ompl.evaluation.runs import MEMORY, NO_PROBLEM, Run
from apex_ompl.ompl.process import quiet_ompl
from apex_ompl.ompl.setup import assemble
from apex_ompl.result import INSIDE
from apex_ompl.util.files import check_writable

DATABASE, LOGS = "benchmark.db", "logs"
PROPERTIES = {
    "first solution time REAL": "first", "total time REAL": "total", "path length REAL": "length",
    "raw path length REAL": "raw_length", "jerk REAL": "jerk", "raw jerk REAL": "raw_jerk",
    "clearance REAL": "clearance", "checker calls INTEGER": "checks",
}  # fmt: skip
"""Properties of the log that are columns of a run."""
AFTER_PLANNER = ("simplify", "verify", "repair")  # stages of a plan


def write_logs(results: Results) -> list[Path]:
    """Write OMPL's log of each experiment, and return the files: ``logs/SUITE_LEVEL.log`` in the results' folder.

    The runs of a planner on a level are runs of one experiment. ``solved`` is true where the path passed the full
    check.

    Raises:
        ApexError: A problem cannot be read any more, or a file cannot be written.
    """
    folder = results.folder / LOGS
    folder.mkdir(exist_ok=True)
    by_experiment: dict[str, list[Run]] = {}
    for one in results.runs:
        if one["status"] != NO_PROBLEM:
            by_experiment.setdefault(one["experiment"], []).append(one)
    names: dict[str, str] = {}
    for experiment in sorted(by_experiment):
        name = "_".join(
            short(experiment).replace("/", " ").split()
        )  # OMPL's reader takes a line's last word as the name
        again = sum(other == name or other.startswith(f"{name}-") for other in names.values())
        names[experiment] = f"{name}-{again + 1}" if again else name
    return [_write(results, name, by_experiment[experiment], folder) for experiment, name in names.items()]


def short(name: str) -> str:
    """Return the name of an experiment or a problem; of a file without its folder."""
    return Path(name).stem if name.endswith((".yaml", ".yml")) else name


def _write(results: Results, name: str, runs: list[Run], folder: Path) -> Path:
    experiment = short(runs[0]["experiment"])
    with quiet_ompl():
        setup = assemble(load_problem(min(one["problem"] for one in runs))).simple_setup
        log = ot.Benchmark(setup, name)
        session = results.about["sessions"][-1]
        for key in ("command", "hardware", "jobs", "split"):
            log.addExperimentParameter(key, "TEXT", _line(str(session[key]).replace(" = ", "=")))
        data = log.getRecordedExperimentData()
        data.maxTime, data.maxMem = max(one["timeout"] for one in runs), MEMORY
        data.startTime = datetime.fromisoformat(session["date"])
        data.seed = int(session["seed"])
        data.totalDuration = sum(one["total"] or 0.0 for one in runs)
        data.setupInfo = f"{experiment}\n{setup.getSpaceInformation().getStateSpace().getName()}\n"
        data.cpuInfo = session["hardware"] + "\n"
        labels = list(dict.fromkeys(one["label"] for one in runs))
        data.runCount = max(sum(one["label"] == label for one in runs) for label in labels)
        data.planners = [_planner(results, label, [one for one in runs if one["label"] == label]) for label in labels]
        file = folder / f"{name}.log"
        check_writable(file)
        temporary = folder / f".{name}.log"
        log.saveResultsToFile(str(temporary))
        os.replace(temporary, file)
    return file


def _planner(results: Results, label: str, runs: list[Run]) -> ot.PlannerExperiment:
    made = ot.PlannerExperiment()
    made.name = label
    settings = results.about["rows"].get(label, {}).get("all", {})
    from_ompl: dict[str, str] = next((one["common"] for one in runs if one["common"]), {})
    settings = settings | {"timeout": max(one["timeout"] for one in runs)}
    made.common = _properties({**{name: _line(str(value)) for name, value in settings.items()}, **from_ompl})
    made.runs = [_properties(properties(one)) for one in sorted(runs, key=lambda one: int(one["seed"]))]
    return made


def _properties(values: Mapping[str, str]) -> ot.RunProperties:
    made = ot.RunProperties()
    for name, value in values.items():
        made[name] = value
    return made


def properties(run: Run) -> dict[str, str]:
    """Return the properties of a run for OMPL's log: OMPL's own and this project's."""
    found = dict(run["properties"])
    found["solved BOOLEAN"] = found["passed full check BOOLEAN"] = str(int(run["solved"]))
    found["problem TEXT"] = _line(short(run["problem"]))
    found["seed INTEGER"] = str(run["seed"])
    found["solved by TEXT"] = run["by"]
    found |= {name: _text(run[key]) for name, key in PROPERTIES.items()}
    found |= {f"{name} INTEGER": str(value) for name, value in run["counts"].items()}
    # Planner Arena adds this to the planner's time.
    found["simplification time REAL"] = _text(sum(run["times"].get(stage, 0.0) for stage in AFTER_PLANNER))
    for stage, seconds in run["times"].items():
        words = stage.removeprefix(INSIDE) if stage.startswith(INSIDE) else f"plan {stage}"
        found[f"stage {words} REAL"] = _text(seconds)
    return found


def _line(text: str) -> str:
    """Return a text on one line, without the separator of OMPL's log."""
    return " ".join(text.split()).replace("; ", ", ")


def _text(value: Any) -> str:
    return "nan" if value is None else f"{value:.9g}"


def write_database(results: Results, logs: list[Path]) -> Path:
    """Write the SQLite database of some logs, as OMPL's ``ompl_benchmark_statistics`` does, and return its file."""
    file = results.folder / DATABASE
    check_writable(file)
    temporary = results.folder / f".{DATABASE}"
    temporary.unlink(missing_ok=True)
    with contextlib.redirect_stdout(io.StringIO()):
        ot.readBenchmarkLog(str(temporary), [str(log) for log in logs], False)
        ot.computeViews(str(temporary), False)
    os.replace(temporary, file)
    return file
