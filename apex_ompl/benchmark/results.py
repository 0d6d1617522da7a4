"""Results of a benchmark in a folder."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from apex_ompl.benchmark.runs import Run
from apex_ompl.errors import FileFormatError, MissingFileError
from apex_ompl.util.files import write_atomically

SCHEMA = "apex-ompl/benchmark/1"
RUNS, ABOUT = "runs.jsonl", "about.json"


@dataclass(frozen=True)
class Results:
    """A folder of results.

    Attributes:
        folder: The folder.
        about: Provenance: schema, settings, sessions (command, hardware, versions), rows, warm-up times.
        runs: The runs, in no order; ``session`` is the index of the session in which one was made.
    """

    folder: Path
    about: dict[str, Any]
    runs: list[Run] = field(default_factory=list)

    @classmethod
    def load(cls, folder: str | os.PathLike[str]) -> Results:
        """Read a folder.

        Raises:
            MissingFileError: There are no results there.
            FileFormatError: They are not of this version, or damaged.
        """
        folder = Path(folder)
        try:
            about = json.loads((folder / ABOUT).read_text(encoding="utf-8"))
            lines = (folder / RUNS).read_text(encoding="utf-8").splitlines() if (folder / RUNS).is_file() else []
        except (OSError, ValueError) as error:
            why = f"expected {ABOUT} and {RUNS} there, as apex-ompl bench writes them"
            raise MissingFileError(str(folder), "folder of benchmark results", why) from error
        if not isinstance(about, dict) or about.get("schema") != SCHEMA:
            found = about.get("schema") if isinstance(about, dict) else about
            raise FileFormatError(str(folder / ABOUT), "schema", found, f"expected {SCHEMA!r}")
        runs: dict[str, Run] = {}
        for number, line in enumerate(lines):
            try:
                run = json.loads(line)
                runs[run["key"]] = run
            except (ValueError, KeyError, TypeError) as error:
                if number < len(lines) - 1:  # a process that was killed may have left the last one incomplete
                    raise FileFormatError(str(folder / RUNS), f"line {number + 1}", line, "expected a run") from error
        return cls(folder, about, list(runs.values()))

    def sessions(self) -> list[dict[str, Any]]:
        """Return the sessions in which the runs were made, in their order; all where a run does not name its own."""
        found = {run.get("session") for run in self.runs} or {None}
        return [one for k, one in enumerate(self.about["sessions"]) if k in found or None in found]

    def save_about(self) -> None:
        """Write the provenance.

        Raises:
            MissingFileError: The file cannot be written.
        """
        write_atomically(self.folder / ABOUT, (json.dumps(self.about, indent=1) + "\n").encode())
