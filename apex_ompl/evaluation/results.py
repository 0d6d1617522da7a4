"""Results of a benchmark in a folder, OMPL's log of it, and the database for Planner Arena that is made of that."""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

from ompl import tools as ot

from apex_ompl.api import load_problem
from apex_ompl.errors import FileFormatError, MissingFileError, ParameterError
from apex_ompl.evaluation.runs import MEMORY, NO_PROBLEM, Run, ompl_status
from apex_ompl.ompl.process import quiet_ompl
from apex_ompl.ompl.setup import assemble
from apex_ompl.result import INSIDE
from apex_ompl.util.files import check_writable, read_text, write_atomically
from apex_ompl.util.schema import check_version, read_json
from apex_ompl.util.validation import check_integer, check_number

SCHEMA = "apex-ompl/benchmark/1"
RUNS, ABOUT, PLANS = "runs.jsonl", "about.json", "plans"
ROLE = "folder of benchmark results"
ABOUT_KINDS = {"settings": dict, "sessions": list, "rows": dict}
TEXTS = ("key", "experiment", "problem", "label", "planner", "status", "reason", "by")
NUMBERS = ("first", "total", "setup", "length", "raw_length", "jerk", "raw_jerk", "clearance", "load")
MAPPINGS = ("times", "counts", "properties", "common")


@dataclass(frozen=True)
class Results:
    """A folder of results.

    Attributes:
        folder: The folder.
        about: Provenance: schema, settings, sessions (command, hardware, versions), rows, warm-up times.
        runs: The runs, in no order; ``session`` is the index of a run's session.
    """

    folder: Path
    about: dict[str, Any]
    runs: list[Run] = field(default_factory=list)

    def plan_file(self, run: Run) -> Path:
        """Return the file in which ``bench`` stores the result of a run with ``keep``."""
        return self.folder / PLANS / f"{hashlib.sha256(run['key'].encode()).hexdigest()[:16]}.npz"

    @classmethod
    def load(cls, folder: str | os.PathLike[str]) -> Results:
        """Read a folder.

        Raises:
            MissingFileError: There are no results there.
            FileFormatError: They are not of this version, or damaged.
        """
        folder = Path(folder)
        try:
            about = read_json(folder / ABOUT, ROLE)
            lines = read_text(folder / RUNS, ROLE).splitlines() if (folder / RUNS).exists() else []
        except MissingFileError as error:
            why = f"expected {ABOUT} and {RUNS} there, as apex-ompl bench writes them"
            raise MissingFileError(str(folder), ROLE, why) from error
        check_version(about, SCHEMA, folder / ABOUT)
        for name, kind in ABOUT_KINDS.items():
            if not isinstance(about.get(name), kind):
                expected = "expected a list" if kind is list else "expected a mapping"
                raise FileFormatError(str(folder / ABOUT), name, about.get(name), expected)
        runs: dict[str, Run] = {}
        for number, line in enumerate(lines):
            try:
                run = json.loads(line)
            except (ValueError, RecursionError) as error:
                if number == len(lines) - 1:  # a process that was killed may have left it incomplete
                    break
                raise FileFormatError(str(folder / RUNS), f"line {number + 1}", line, "expected a run") from error
            try:
                check_run(run)
            except ParameterError as error:
                field_name = f"line {number + 1}: {error.name}"
                raise FileFormatError(
                    str(folder / RUNS), field_name, error.value, f"expected {error.expected}"
                ) from error
            runs[run["key"]] = run
        return cls(folder, about, list(runs.values()))

    def sessions(self) -> list[dict[str, Any]]:
        """Return the sessions of the runs, in their order; all sessions where a run does not name its own."""
        found = {run.get("session") for run in self.runs} or {None}
        return [one for k, one in enumerate(self.about["sessions"]) if k in found or None in found]

    def save_about(self) -> None:
        """Write the provenance.

        Raises:
            MissingFileError: The file cannot be written.
        """
        write_atomically(self.folder / ABOUT, (json.dumps(self.about, indent=1) + "\n").encode())


def check_run(run: Any) -> None:
    """Check the columns of a run from a file.

    Raises:
        ParameterError: One is missing or of another kind.
    """
    if not isinstance(run, dict):
        raise ParameterError("run", run, "a mapping of columns to values")
    missing = [name for name in (*TEXTS, "solved", "seed", "timeout", *NUMBERS, *MAPPINGS) if name not in run]
    if missing:
        raise ParameterError(missing[0], "nothing", "this column")
    for name in TEXTS:
        if not isinstance(run[name], str):
            raise ParameterError(name, run[name], "text")
    if not isinstance(run["solved"], bool):
        raise ParameterError("solved", run["solved"], "true or false")
    check_integer(run["seed"], "seed")
    check_number(run["timeout"], "timeout", 0.0)
    for name in NUMBERS:
        if run[name] is not None:
            check_number(run[name], name)
    for name in MAPPINGS:
        if not isinstance(run[name], dict):
            raise ParameterError(name, run[name], "a mapping")
    for name, seconds in run["times"].items():
        check_number(seconds, f"times.{name}")
    if run["properties"]:
        try:
            ompl_status(run["properties"])
        except (KeyError, TypeError, ValueError) as error:
            found = run["properties"].get("status ENUM")
            raise ParameterError("properties.status ENUM", found, "the number of a status of OMPL's") from error


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
