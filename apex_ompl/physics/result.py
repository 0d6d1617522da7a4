"""What executing a task in physics returns."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from apex_ompl.drivers.grasps import GraspFound
from apex_ompl.physics.judges import Check
from apex_ompl.types import Array
from apex_ompl.util.display import Summary, one_line
from apex_ompl.util.files import pack_archive, path_text, suffix_of, write_atomically

SUFFIXES = (".npz", ".json")
DONE, FAILED, UNPLANNED, DROPPED, UNSEEN = "DONE", "FAILED", "NOT_PLANNED", "NOT_HELD", "NOT_SEEN"

SHOWN = {"duration": ("s", 1.0), "tracking_error": ("mrad", 1e3)}  # metrics in words, with their units and factors


@dataclass(frozen=True, eq=False)
class TaskRun:
    """A task that was executed in physics; true where it ended as it should.

    Attributes:
        problem: Name of the problem.
        seed: Seed of the start, or None for that of the problem.
        outcome: ``DONE``, ``FAILED``, ``NOT_HELD`` where a hand got hold of nothing, ``NOT_PLANNED``, or
            ``NOT_SEEN`` where cameras did not find what the task needs.
        reason: Why it is not done; empty where it is.
        grasps: How objects were held, in the order in which hands closed.
        checks: The conditions at the end.
        steps: Title, start and end of each step [s].
        times: Times of the rows below, shape (N,) [s].
        commanded: Commanded joints, shape (N, dof) [rad].
        measured: Measured joints, shape (N, dof) [rad].
        poses: Name of an object -> position [m] and quaternion wxyz, shape (N, 7).
        contacts: Pairs of bodies that touched against the plan, and how deep at most [m].
        metrics: Numbers.
    """

    problem: str
    seed: int | None
    outcome: str
    reason: str
    grasps: tuple[GraspFound, ...]
    checks: tuple[Check, ...]
    steps: tuple[tuple[str, float, float], ...]
    times: Array
    commanded: Array
    measured: Array
    poses: Mapping[str, Array]
    contacts: Mapping[tuple[str, str], float]
    metrics: Mapping[str, float]

    def __bool__(self) -> bool:
        """Whether the task ended as it should."""
        return self.outcome == DONE

    def __repr__(self) -> str:
        """Return the outcome, how objects are held, and the reason, in one line."""
        held = ", ".join(f"{one.object} by {one.kind}" for one in self.grasps)
        return one_line("TaskRun", self.outcome, repr(self.problem), held, self.reason)

    def __str__(self) -> str:
        """Return the lines that ``apex-ompl run`` prints."""
        return str(_summary(self))

    def _repr_html_(self) -> str:
        """Return these lines as a table for notebooks."""
        return _summary(self).html

    def as_dict(self) -> dict[str, Any]:
        """Return the fields as plain data, without arrays."""
        return {
            "problem": self.problem, "seed": self.seed, "outcome": self.outcome, "reason": self.reason,
            "grasps": [asdict(one) for one in self.grasps], "checks": [asdict(one) for one in self.checks],
            "steps": [list(step) for step in self.steps],
            "contacts": [[a, b, depth] for (a, b), depth in self.contacts.items()], "metrics": dict(self.metrics),
        }  # fmt: skip

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the log: all fields, compact as ``.npz`` or as text ``.json``.

        Raises:
            ParameterError: Another suffix.
            MissingFileError: The folder is missing or cannot be written.
        """
        path = Path(path_text(path))
        suffix = suffix_of(path, SUFFIXES)
        arrays = {"times": self.times, "commanded": self.commanded, "measured": self.measured}
        arrays |= {f"pose {name}": rows for name, rows in self.poses.items()}
        if suffix == ".npz":
            write_atomically(path, pack_archive("task", self.as_dict(), arrays, compressed=True))
            return
        rows = {name: np.round(values, 6).tolist() for name, values in arrays.items()}
        write_atomically(path, (json.dumps(self.as_dict() | rows) + "\n").encode())


def _summary(result: TaskRun) -> Summary:
    """Return the lines about a task."""
    measured = [
        f"{name.replace('_', ' ')} {factor * result.metrics[name]:.3g} {unit}"
        for name, (unit, factor) in SHOWN.items()
        if name in result.metrics
    ]
    rows = [
        ("reason", result.reason),
        ("held", ", ".join(f"{one.object} by {one.kind}" for one in result.grasps)),
        ("steps", ", ".join(title for title, _, _ in result.steps)),
        ("measured", ", ".join(measured)),
        *(("yes" if check.passed else "NO", f"{check.name}: {check.found}") for check in result.checks),
    ]
    return Summary(f"{result.problem}: {result.outcome}", [row for row in rows if row[1]])
