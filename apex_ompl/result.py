"""What planning returns, and its files."""

from __future__ import annotations

import io
import json
import os
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from ompl import base as ob

from apex_ompl.errors import FileFormatError, MissingFileError, ParameterError
from apex_ompl.files import write_atomically
from apex_ompl.problem import Problem
from apex_ompl.schema import dump_yaml, read_yaml, validate

SCHEMA = "apex-ompl/result/1"
SUFFIXES = (".npz", ".csv", ".json", ".yaml")


INSIDE = "solve: "
"""Stands before the names of a planner's own stages in ``PlanResult.times``."""
FIRST = INSIDE + "first"
"""Names the time from the beginning of ``solve`` to the first valid path there, of planners that tell it."""


class PlanStatus(StrEnum):
    """OMPL's planner status names."""

    UNKNOWN = "UNKNOWN"
    INVALID_START = "INVALID_START"
    INVALID_GOAL = "INVALID_GOAL"
    UNRECOGNIZED_GOAL_TYPE = "UNRECOGNIZED_GOAL_TYPE"
    TIMEOUT = "TIMEOUT"
    APPROXIMATE_SOLUTION = "APPROXIMATE_SOLUTION"
    EXACT_SOLUTION = "EXACT_SOLUTION"
    CRASH = "CRASH"
    ABORT = "ABORT"
    INFEASIBLE = "INFEASIBLE"

    @classmethod
    def of(cls, status: ob.PlannerStatus) -> PlanStatus:
        """Return the name of an OMPL status; ``asString`` does not know all of them."""
        return cls(status.getStatus().name)


@dataclass(frozen=True, eq=False)
class PlanResult:
    """Outcome of one call of ``plan``; true only when ``status`` is EXACT_SOLUTION.

    Attributes:
        status: OMPL's name; EXACT_SOLUTION only for a path that passed the full check.
        reason: One sentence that explains a status other than EXACT_SOLUTION.
        problem: The problem.
        robot: Name of the robot.
        joint_names: Order of the columns of ``path``.
        planner: Name of the planner.
        seed: The seed used.
        path: States to be joined by straight lines, shape (N, dof) [rad; synergies 0..1], or None.
        times: Seconds per stage, and ``total``; those of a planner's own stages, as ``solve: repair``, are part of
            ``solve``.
        length: Sum of Euclidean joint-space steps [rad], NaN without a path.
        clearance: Least distance of any checked pair at 32 states spread over the path [m], NaN without a path.
        checks: How many states were judged one by one; those inside proved stretches of motions do not count.
        solved_by: What found the path: the planner's name, or the stage of apex that did (see
            ``apex_ompl.report.Report``), with ``+repair`` when a stretch of it failed the full check and was planned
            anew; ``straight line`` when that was a solution, so that no planner ran; empty without a path.
        notes: What a user should know about this run, such as a snapshot of moving obstacles.
    """

    status: PlanStatus
    reason: str
    problem: Problem
    robot: str
    joint_names: tuple[str, ...]
    planner: str
    seed: int
    path: NDArray[np.float64] | None = None
    times: Mapping[str, float] = field(default_factory=dict)
    length: float = float("nan")
    clearance: float = float("nan")
    checks: int = 0
    solved_by: str = ""
    notes: tuple[str, ...] = ()

    def __bool__(self) -> bool:
        """Whether there is an exact path that passed the full check."""
        return self.status is PlanStatus.EXACT_SOLUTION

    def as_dict(self) -> dict[str, Any]:
        """Return the fields as plain data, ready for JSON; numbers that do not exist are None."""
        return {
            "schema": SCHEMA,
            "status": str(self.status),
            "reason": self.reason,
            "problem": self.problem.name,
            "robot": self.robot,
            "planner": self.planner,
            "seed": self.seed,
            "solved_by": self.solved_by,
            "length": None if np.isnan(self.length) else self.length,
            "clearance": None if not np.isfinite(self.clearance) else self.clearance,
            "checks": self.checks,
            "times": dict(self.times),
            "notes": list(self.notes),
            "joint_names": list(self.joint_names),
            "path": None if self.path is None else self.path.tolist(),
            "problem_file": self.problem.as_dict(),
        }

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the result by the suffix of ``path``: .npz, .json, .yaml (all fields) or .csv (the path).

        Raises:
            ParameterError: Another suffix, or a CSV without a path.
            MissingFileError: The folder is missing or cannot be written.
        """
        path = Path(path)
        write_atomically(path, self._encoded(check_suffix(path)))

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> PlanResult:
        """Read a result that was saved as .npz, .json or .yaml.

        Raises:
            MissingFileError: The file cannot be read.
            FileFormatError: It is not a saved result.
            ParameterError: It has another suffix; a .csv holds no problem.
        """
        path = Path(path)
        suffixes = tuple(s for s in SUFFIXES if s != ".csv")
        if path.suffix not in suffixes:
            raise ParameterError("result file", str(path), f"a file name ending in {', '.join(suffixes)}")
        data = read_yaml(path, "result file") if path.suffix != ".npz" else _read_npz(path)
        if data.get("schema") != SCHEMA:
            raise FileFormatError(str(path), "schema", data.get("schema"), f"expected {SCHEMA!r}")
        try:
            states = None if data["path"] is None else np.array(data["path"], dtype=float)
            number = {k: float("nan") if data[k] is None else float(data[k]) for k in ("length", "clearance")}
            return cls(
                status=PlanStatus(data["status"]), reason=data["reason"], robot=data["robot"], path=states,
                problem=validate(Problem, data["problem_file"], str(path)), planner=data["planner"],
                joint_names=tuple(data["joint_names"]), seed=int(data["seed"]), times=data["times"],
                checks=int(data["checks"]), solved_by=data["solved_by"], notes=tuple(data["notes"]), **number,
            )  # fmt: skip
        except (KeyError, TypeError, ValueError) as error:
            raise FileFormatError(str(path), "", str(error), "expected a complete saved result") from error

    def _encoded(self, suffix: str) -> bytes:
        data = self.as_dict()
        if suffix == ".json":
            return (json.dumps(data, indent=1) + "\n").encode()
        if suffix == ".yaml":
            return dump_yaml(data).encode()
        if suffix == ".csv":
            if self.path is None:
                raise ParameterError("output", suffix, "a result with a path")
            rows = [",".join(self.joint_names)]
            rows += [",".join(repr(float(v)) for v in q) for q in self.path]
            return ("\n".join(rows) + "\n").encode()
        buffer = io.BytesIO()
        states = np.empty((0, len(self.joint_names))) if self.path is None else self.path
        del data["path"]
        np.savez(buffer, path=states, joint_names=np.array(self.joint_names), result=np.array(json.dumps(data)))
        return buffer.getvalue()


def _read_npz(path: Path) -> dict[str, Any]:
    try:
        with np.load(path, allow_pickle=False) as archive:
            data = json.loads(str(archive["result"]))
            if not isinstance(data, dict):
                raise ValueError("no mapping")
            return data | {"path": archive["path"] if len(archive["path"]) else None}
    except FileNotFoundError as error:
        raise MissingFileError(str(path), "result file") from error
    except (OSError, KeyError, ValueError, zipfile.BadZipFile) as error:
        raise FileFormatError(str(path), "", str(error), "expected a saved result") from error


def check_suffix(path: Path) -> str:
    """Return the suffix of an output file.

    Raises:
        ParameterError: It is none of ``SUFFIXES``.
    """
    if path.suffix not in SUFFIXES:
        raise ParameterError("output", path.name, f"a file name ending in {', '.join(SUFFIXES)}")
    return path.suffix
