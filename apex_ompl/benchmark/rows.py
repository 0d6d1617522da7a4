"""What a benchmark runs: rows, which are planners with parameters, and experiments, which are levels of problems."""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from apex_ompl import planners, problems
from apex_ompl.api import load_problem
from apex_ompl.errors import ParameterError, UnknownNameError
from apex_ompl.problems.catalogue import SPLITS
from apex_ompl.util.validation import check_positive

WRITTEN = re.compile(r"(?P<planner>[^\[\]]+?)(\[(?P<params>[^\[\]]*)\])?")

PAPER = {
    "model": "apex-paper", "line": False, "repair": False, "bridge": False, "fallback": False, "polish": False,
    "first": 8, "second": 8, "third": 16, "resample": 2,
}  # fmt: skip
"""Parameters of apex that leave the paper's algorithm alone, without guidance: ancestral sampling in all steps, and
resampling of what collides."""


@dataclass(frozen=True)
class Row:
    """A planner as it is benchmarked.

    Attributes:
        label: Its name in tables.
        planner: Its name.
        params: Its parameters that are not the defaults.
        timeout: Of its runs [s]; None takes the benchmark's.
        runs: Most of them on a level; None takes the benchmark's.
        levels: Where it runs: suites, levels as ``shelf/hard``, or ends of their names as ``/hard``; all by default.
    """

    label: str
    planner: str
    params: Mapping[str, Any] = field(default_factory=dict)
    timeout: float | None = None
    runs: int | None = None
    levels: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            ParameterError: There is no label, or a number is not positive.
        """
        if not self.label.strip() or not self.label.isprintable():
            raise ParameterError("label of a planner", self.label, "one line of text")
        for name, value in (("timeout", self.timeout), ("runs", self.runs)):
            if value is not None:
                check_positive(value, f"{name} of {self.label}")

    @classmethod
    def parse(cls, text: str) -> Row:
        """Read ``apex`` or ``apex[fallback=false;bridge=false]``.

        Raises:
            ParameterError: The text has another form.
        """
        match = WRITTEN.fullmatch(text.strip())
        pairs = [pair.partition("=") for pair in ((match and match["params"]) or "").split(";") if pair.strip()]
        if match is None or not all(equals and name.strip() and value.strip() for name, equals, value in pairs):
            raise ParameterError("planner", text, "NAME or NAME[PARAMETER=VALUE;...]")
        params = {name.strip().replace("-", "_"): value.strip() for name, _, value in pairs}
        return cls(text.strip(), match["planner"].strip(), params)

    def parameters(self) -> planners.Parameters:
        """Return the planner's parameters.

        Raises:
            UnknownNameError: No such planner or parameter.
            ParameterError: A value of the wrong type or out of range.
        """
        return planners.parameters(self.planner, **self.params)

    def settings(self) -> dict[str, Any]:
        """Return all parameters by name, as plain values."""
        return asdict(self.parameters())

    def runs_on(self, experiment: str) -> bool:
        """Whether the row is for an experiment."""
        named = any(experiment == level or experiment.startswith(f"{level}/") for level in self.levels)
        ends = tuple(level for level in self.levels if level.startswith("/"))
        return not self.levels or named or experiment.endswith(ends)


@dataclass(frozen=True)
class Job:
    """One run to be made.

    Attributes:
        experiment: Name of the level or problem.
        problem: Name or file of the problem.
        label: Of the row.
        planner: Name of the planner.
        params: Its parameters.
        seed: Of all random numbers.
        timeout: Of the run [s].
        simplify: Whether the path is shortened, unless the planner's are smooth.
    """

    experiment: str
    problem: str
    label: str
    planner: str
    params: Mapping[str, Any]
    seed: int
    timeout: float
    simplify: bool

    @property
    def key(self) -> str:
        """What tells the run apart from all others."""
        settings = asdict(planners.parameters(self.planner, **self.params))
        made_of = json.dumps([self.planner, settings, float(self.timeout), self.simplify], sort_keys=True)
        digest = hashlib.sha256(made_of.encode()).hexdigest()[:12]
        return f"{self.experiment} {self.problem} {self.seed} {self.label} {digest}"


def experiments(suites: Sequence[str]) -> dict[str, bool]:
    """Return what some names stand for: experiments, and whether they are levels of problems, or single problems.

    Args:
        suites: Suites, levels as ``shelf/hard``, problems by name or id, or files. A suite stands for its levels
            without moving obstacles.

    Raises:
        ApexError: No such suite, level or problem; one with moving obstacles; or none is given.
    """
    if not suites:
        raise ParameterError("suites", "nothing", "a suite, a level as shelf/hard, or a problem")
    known = problems.suites()
    found: dict[str, bool] = {}
    for name in suites:
        suite, _, level = name.partition("/")
        if name in known:
            static = [v for v in known[name] if not v.startswith("moving-")]
            found |= {f"{name}/{v}": True for v in static}
        elif suite in known and level in known[suite]:
            if level.startswith("moving-"):
                raise ParameterError("suite", name, "a level without moving obstacles: plans hold for one moment only")
            found[name] = True
        else:
            if load_problem(name).moving:
                raise ParameterError("problem", name, "one without moving obstacles: plans hold for one moment only")
            found[os.fspath(Path(name).resolve()) if name.endswith((".yaml", ".yml")) else name] = False
    return found


def jobs(
    suites: Sequence[str], rows: Sequence[Row], *, runs: int, timeout: float, seed: int, split: str, simplify: bool
) -> list[Job]:
    """Return the runs of a benchmark: all rows on a problem in turn, and the first problems of all levels first.

    The k-th run on a level is on the k-th problem of the split; on a single problem all runs are. The k-th run has the
    seed ``seed + k``.

    Raises:
        ApexError: A suite, planner, parameter or split is unknown, or two rows have the same label.
    """
    if split not in SPLITS:
        raise UnknownNameError("split", split, SPLITS)
    if runs > len(SPLITS[split]) or seed + runs > 2**31:
        most = min(len(SPLITS[split]), 2**31 - seed)
        raise ParameterError("runs", runs, f"at most {most}, for there are no more problems of the split, or seeds")
    labels = [row.label for row in rows]
    if len(set(labels)) < len(labels) or not labels:
        raise ParameterError("planners", ", ".join(labels) or "none", "one or more, each once")
    for row in rows:
        row.parameters()
    found = []
    for experiment, is_level in experiments(suites).items():
        for row in rows:
            for k in range(min(runs, row.runs or runs) if row.runs_on(experiment) else 0):
                problem = f"{experiment}/{SPLITS[split].start + k}" if is_level else experiment
                limit = row.timeout or timeout
                job = Job(experiment, problem, row.label, row.planner, row.params, seed + k, limit, simplify)
                found.append((k, job))
    return [job for _, job in sorted(found, key=lambda pair: pair[0])]
