"""A run of the closed loop as data, and its files."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np

from apex_ompl.errors import FileFormatError, ParameterError
from apex_ompl.scene.problem import Problem
from apex_ompl.timing import Trajectory
from apex_ompl.timing.checks import START_TOLERANCE
from apex_ompl.timing.files import KNOTS
from apex_ompl.types import Array
from apex_ompl.util.display import Summary, fields_line, one_line
from apex_ompl.util.files import BROKEN, pack_archive, path_text, read_archive, suffix_of, write_atomically
from apex_ompl.util.schema import check_version, read_json
from apex_ompl.util.validation import check_number, check_seed, finite_array, finite_numbers

SCHEMA = "apex-ompl/run/1"
SUFFIXES = (".npz", ".json")
ARCHIVE, ROLE = "run", "run file"  # name of the text in a NumPy archive, and what errors call the file
TEXTS = ("reason", "robot", "method", "prediction", "clock")
GOING, BRAKING, STANDING = "going", "braking", "standing"  # what a robot does when a conflict is predicted
INTERRUPTED = "interrupted"  # reason of a run that the user ended
JSON_NAMES = {"str": "text", "list": "list", "dict": "mapping"}
SHOWN = {
    "time_to_goal": ("s", 1.0), "rest_time": ("s", 1.0), "clearance": ("mm", 1e3), "reaction_p95": ("ms", 1e3),
    "tick_p99": ("ms", 1e3), "deadline_misses": ("", 1.0), "tracking_error": ("mrad", 1e3), "late_commands": ("", 1.0),
}  # fmt: skip
COUNTS = ("replans_asked", "replans_accepted", "conflicts", "stops", "unguarded_steps", "broken_steps")


class Outcome(StrEnum):
    """How a run ended.

    The paper counts failed tasks (R_f); all but ``REACHED`` are failures.
    """

    REACHED = "reached"
    HIT_MOVING = "hit-moving"  # a contact while the robot moved
    HIT_AT_REST = "hit-at-rest"  # an obstacle touched the robot at rest
    HIT_STILL = "hit-still"  # a contact with a static obstacle, or of the robot with itself
    STUCK = "stuck"  # no motion for longer than allowed
    TIMEOUT = "timeout"
    ABORTED = "aborted"  # the sensor failed, or the user interrupted it
    LIMITS = "limits"  # of position, velocity, acceleration or jerk
    MISALIGNED = "misaligned"  # rest outside the tolerances of the goal
    START_INVALID = "start-invalid"


@dataclass(frozen=True)
class Event:
    """Something that happened in a run.

    Attributes:
        time: When [s].
        kind: ``observation refused``, ``place doubted``, ``blind``, ``conflict``, ``stop``, ``request``, ``accepted``,
            ``rejected``, ``reaction``, ``goal``, ``broken assumption``, ``driver fault`` or ``contact``.
        data: Details, as JSON: texts and numbers.
    """

    time: float
    kind: str
    data: Mapping[str, Any] = field(default_factory=dict)

    __repr__ = fields_line


@dataclass(frozen=True, eq=False)
class RunResult:
    """A run of the closed loop.

    Attributes:
        outcome: How it ended.
        reason: One sentence: which bodies touched, when, how deep; empty where the goal was reached.
        problem: The problem; moving obstacles have the ``trajectory`` that they took, and ``appears``.
        robot: Name of the robot.
        method: Name of the replanner.
        prediction: How obstacles were predicted.
        clock: ``sim`` or ``real``.
        seed: The seed used.
        trajectory: The executed motion, from time 0 on.
        events: What happened, by time.
        metrics: Numbers by name: ``time_to_goal`` [s], ``rest_time`` [s], ``stops``, ``replans_asked``,
            ``replans_accepted``, ``clearance`` [m], ``reaction_p95`` [s], ``broken_steps``, ``unguarded_steps``, ...
        settings: Settings of the loop and of the sensor, and the version of the compute-cost table, as JSON.
        robot_digest: Digest of the robot, see :func:`apex_ompl.robot.identity.digest`; empty where it is unknown.
    """

    outcome: Outcome
    reason: str
    problem: Problem
    robot: str
    method: str
    prediction: str
    clock: str
    seed: int
    trajectory: Trajectory
    events: tuple[Event, ...] = ()
    metrics: Mapping[str, float] = field(default_factory=dict)
    settings: Mapping[str, Any] = field(default_factory=dict)
    robot_digest: str = ""

    def __bool__(self) -> bool:
        """Whether the goal was reached."""
        return self.outcome is Outcome.REACHED

    def __repr__(self) -> str:
        """Return the outcome, the method and the problem, in one line."""
        motion, clock = f"motion {self.trajectory.duration:.2f} s", f"{self.clock} clock"
        head = f"{self.outcome} by {self.method}"
        return one_line("RunResult", head, repr(self.problem.name), motion, clock, self.reason)

    def __str__(self) -> str:
        """Return the lines that ``apex-ompl run`` prints."""
        return str(_summary(self))

    def _repr_html_(self) -> str:
        """Return these lines as a table for notebooks."""
        return _summary(self).html

    def as_dict(self) -> dict[str, Any]:
        """Return the fields as plain data, ready for JSON."""
        motion = self.trajectory
        return {
            "schema": SCHEMA,
            "outcome": str(self.outcome),
            **{name: getattr(self, name) for name in TEXTS},
            "robot_digest": self.robot_digest,
            "seed": self.seed,
            "metrics": dict(self.metrics),
            "settings": dict(self.settings),
            "events": [{"time": e.time, "kind": e.kind, "data": dict(e.data)} for e in self.events],
            "joint_names": list(motion.joint_names),
            "trajectory": {key: getattr(motion, key).tolist() for key in KNOTS},
            "problem_file": self.problem.as_dict(),
        }

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write all fields, for :meth:`load`: compact as ``.npz``, as text ``.json``.

        Raises:
            ParameterError: Another suffix; or events, metrics or settings that are not JSON's, or not finite.
            MissingFileError: The folder is missing or cannot be written.
        """
        path = Path(path_text(path))
        suffix, data = suffix_of(path, SUFFIXES), self.as_dict()
        _check_plain(data)
        if suffix == ".json":
            write_atomically(path, (json.dumps(data, indent=1) + "\n").encode())
            return
        del data["trajectory"]
        knots = {key: getattr(self.trajectory, key) for key in KNOTS}
        write_atomically(path, pack_archive(ARCHIVE, data, knots, compressed=True))

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> RunResult:
        """Read a run that was saved.

        Raises:
            MissingFileError: The file cannot be read.
            FileFormatError: It is not a saved run, or contradicts itself.
            ParameterError: It has another suffix.
        """
        path = Path(path_text(path))
        if path.suffix not in SUFFIXES or path.name == path.suffix:
            raise ParameterError(ROLE, str(path), f"a file name ending in {', '.join(SUFFIXES)}")
        if path.suffix == ".json":
            data = read_json(path, ROLE)
        else:
            data, arrays = read_archive(path, ARCHIVE, ROLE)
            data["trajectory"] = arrays
        check_version(data, SCHEMA, path)
        try:
            return _parsed(data, str(path))
        except ParameterError as error:
            raise FileFormatError(str(path), error.name, error.value, f"expected {error.expected}") from error
        except KeyError as error:
            raise FileFormatError(str(path), str(error.args[0]), None, "required field is missing") from error
        except (*BROKEN, AttributeError) as error:
            raise FileFormatError(str(path), "", str(error), "expected a complete saved run") from error


def _summary(result: RunResult) -> Summary:
    """Return the lines about a run."""
    metrics = result.metrics
    measured = [
        f"{name.replace('_', ' ')} {factor * metrics[name]:.3g} {unit}".rstrip()
        for name, (unit, factor) in SHOWN.items()
        if name in metrics
    ]
    counts = [f"{metrics[name]:.0f} {name.replace('_', ' ')}" for name in COUNTS if name in metrics]
    made = f"{result.method}, prediction {result.prediction}, clock {result.clock}, seed {result.seed}"
    rows = [
        ("reason", result.reason), ("motion", f"{result.trajectory.duration:.2f} s"),
        ("measured", ", ".join(measured)), ("events", ", ".join(counts)), ("method", made),
    ]  # fmt: skip
    return Summary(f"{result.problem.name}: {result.outcome}", [row for row in rows if row[1]])


def _check_plain(data: Mapping[str, Any]) -> None:
    """Check that metrics, settings and events are JSON with finite numbers."""
    for name in ("metrics", "settings", "events"):
        try:
            json.dumps(data[name], allow_nan=False)
        except (TypeError, ValueError) as error:
            raise ParameterError(name, str(error), "texts, finite numbers, lists and mappings") from error


def _parsed(data: Mapping[str, Any], source: str) -> RunResult:
    """Return the run in the content of a file; an error names what does not fit."""
    _check_plain(data)
    knots = {key: finite_array(data["trajectory"][key], f"trajectory.{key}") for key in KNOTS}
    texts = {name: _typed(data[name], str, name) for name in (*TEXTS, "robot_digest")}
    outcome, rows = data["outcome"], enumerate(_typed(data["events"], list, "events"))
    if outcome not in list(Outcome):
        raise ParameterError("outcome", outcome, f"one of {', '.join(Outcome)}")
    found = RunResult(
        outcome=Outcome(outcome), problem=Problem.parse(data["problem_file"], source), **texts,
        seed=check_seed(data["seed"]), trajectory=Trajectory(**knots, joint_names=tuple(data["joint_names"])),
        events=tuple(_event(row, f"events.{k}") for k, row in rows),
        metrics=finite_numbers(_typed(data["metrics"], dict, "metrics"), "metrics"),
        settings=_typed(data["settings"], dict, "settings"),
    )  # fmt: skip
    times = [event.time for event in found.events]
    if times != sorted(times):
        raise ParameterError("events", "times that go back", "events by time")
    start: Array = found.problem.start_state(found.trajectory.joint_names)
    off = float(np.abs(found.trajectory.positions[0] - start).max())
    if off > START_TOLERANCE:
        raise ParameterError("trajectory", f"a start {off:.3g} rad away from it", "a motion from the problem's start")
    return found


def _event(row: Mapping[str, Any], name: str) -> Event:
    check_number(row["time"], f"{name}.time", 0.0)
    data = _typed(row["data"], dict, f"{name}.data")
    return Event(float(row["time"]), _typed(row["kind"], str, f"{name}.kind"), data)


def _typed(value: Any, kind: type, name: str) -> Any:
    """Return a value, which must be of a JSON type."""
    if not isinstance(value, kind):
        raise ParameterError(name, value, f"a {JSON_NAMES[kind.__name__]}")
    return value
