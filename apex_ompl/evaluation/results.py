"""Results of a benchmark in a folder."""

from __future__ import annotations

import hashlib
import json
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from apex_ompl.errors import FileFormatError, MissingFileError, ParameterError
from apex_ompl.evaluation.runs import Run, ompl_status
from apex_ompl.util.files import read_text, write_atomically
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
            about = json.loads(read_text(folder / ABOUT, ROLE))
            lines = read_text(folder / RUNS, ROLE).splitlines() if (folder / RUNS).exists() else []
        except MissingFileError as error:
            why = f"expected {ABOUT} and {RUNS} there, as apex-ompl bench writes them"
            raise MissingFileError(str(folder), ROLE, why) from error
        except (ValueError, RecursionError) as error:
            raise FileFormatError(str(folder / ABOUT), "", str(error), "expected JSON") from error
        if not isinstance(about, dict) or about.get("schema") != SCHEMA:
            found = about.get("schema") if isinstance(about, dict) else about
            raise FileFormatError(str(folder / ABOUT), "schema", found, f"expected {SCHEMA!r}")
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
