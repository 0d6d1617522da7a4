"""Rows (planners with parameters), experiments (levels of problems) and jobs (single runs) of a benchmark."""

from __future__ import annotations

import hashlib
import importlib
import json
import os
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from apex_ompl import planners, problems
from apex_ompl.api import load_problem
from apex_ompl.errors import ParameterError
from apex_ompl.problems.catalogue import SPLITS, VALIDATION, levels_of
from apex_ompl.util.validation import check_integer, check_name, check_positive

RUNNER = re.compile(r"[\w.]+:\w+")
ROW = re.compile(r"(?P<planner>[^\[\]]+?)(\[(?P<params>[^\[\]]*)\])?")

PAPER = {
    "model": "apex-paper", "line": False, "repair": False, "bridge": False, "fallback": False, "polish": False,
    "first": 1, "second": 1, "third": 1, "resample": 2, "scaling": "noise",
}  # fmt: skip
"""Parameters of apex that leave only the paper's algorithm: ancestral sampling with all steps, one path after the
other, and collision-triggered resampling; ``guidance`` adds the guidance of equation 7."""

RunnerFunction = Callable[["Job"], Mapping[str, Any]]


@dataclass(frozen=True)
class Row:
    """A planner with parameters, as it is benchmarked.

    Attributes:
        label: Name in tables.
        planner: Name of the planner.
        params: Parameters that differ from the defaults.
        timeout: Time limit of a run [s]; None takes the benchmark's.
        runs: Largest number of runs on a level; None takes the benchmark's.
        levels: Suites, levels as ``shelf/hard``, or suffixes of their names as ``/hard``; all by default.
        runner: Function that makes a run instead of OMPL's Benchmark, as ``module:function``. It takes a :class:`Job`
            and returns columns of the run, among them ``solved``, and further columns. The function
            then defines the names of planners and parameters.
    """

    label: str
    planner: str
    params: Mapping[str, Any] = field(default_factory=dict)
    timeout: float | None = None
    runs: int | None = None
    levels: tuple[str, ...] = ()
    runner: str = ""

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
        if self.runner and not RUNNER.fullmatch(self.runner):
            raise ParameterError(f"runner of {self.label}", self.runner, "MODULE:FUNCTION")

    @classmethod
    def parse(cls, text: str) -> Row:
        """Read ``apex`` or ``apex[fallback=false;bridge=false]``.

        Raises:
            ParameterError: The text has another form.
        """
        match = ROW.fullmatch(text.strip())
        pairs = [pair.partition("=") for pair in ((match and match["params"]) or "").split(";") if pair.strip()]
        if match is None or not all(equals and name.strip() and value.strip() for name, equals, value in pairs):
            raise ParameterError("planner", text, "NAME or NAME[PARAMETER=VALUE;...]")
        params = {name.strip().replace("-", "_"): value.strip() for name, _, value in pairs}
        return cls(text.strip(), match["planner"].strip(), params)

    @classmethod
    def of(cls, planner: str, params: Mapping[str, Any] | None = None, **more: Any) -> Row:
        """Return the row that ``parse`` reads from its label, as ``rrtconnect[range=0.7]``.

        Args:
            planner: Name of the planner.
            params: Parameters that differ from the defaults.
            **more: Further attributes of the row.
        """
        given = dict(params or {})
        pairs = (f"{name}={str(v).lower() if isinstance(v, bool) else v}" for name, v in given.items())
        return cls(f"{planner}[{';'.join(pairs)}]" if given else planner, planner, given, **more)

    def parameters(self) -> planners.Parameters:
        """Return the planner's parameters.

        Raises:
            UnknownNameError: No such planner or parameter.
            ParameterError: A value of the wrong type or out of range.
        """
        return planners.parameters(self.planner, **self.params)

    def settings(self) -> dict[str, Any]:
        """Return all parameters by name, as plain values.

        Raises:
            UnknownNameError: No such planner or parameter.
            ParameterError: A value of the wrong type or out of range.
        """
        return dict(self.params) if self.runner else asdict(self.parameters())

    def runs_on(self, experiment: str) -> bool:
        """Whether the row runs on an experiment."""
        named = any(experiment == level or experiment.startswith(f"{level}/") for level in self.levels)
        ends = tuple(level for level in self.levels if level.startswith("/"))
        return not self.levels or named or experiment.endswith(ends)


@dataclass(frozen=True)
class Job:
    """A run to execute.

    Attributes:
        experiment: Name of the level or problem.
        problem: Name or file of the problem.
        label: Label of the row.
        planner: Name of the planner.
        params: Parameters of the planner that differ from the defaults.
        seed: Seed of all random numbers.
        timeout: Time limit [s].
        simplify: Whether the path is simplified, unless the planner's paths are smooth.
        runner: Function that makes the run, as in :class:`Row`.
    """

    experiment: str
    problem: str
    label: str
    planner: str
    params: Mapping[str, Any]
    seed: int
    timeout: float
    simplify: bool
    runner: str = ""

    @property
    def key(self) -> str:
        """Unique name of the run: problem, seed, label and a digest of its settings."""
        settings = dict(self.params) if self.runner else asdict(planners.parameters(self.planner, **self.params))
        made_of = [self.planner, settings, float(self.timeout), self.simplify]
        made_of += [self.runner] if self.runner else []
        digest = hashlib.sha256(json.dumps(made_of, sort_keys=True).encode()).hexdigest()[:12]
        return f"{self.experiment} {self.problem} {self.seed} {self.label} {digest}"


def load_runner(name: str) -> RunnerFunction:
    """Return the function that makes the runs of a row, by its name ``module:function``.

    Raises:
        ParameterError: There is no such module or function.
    """
    module, _, function = name.partition(":")
    try:
        found: RunnerFunction = getattr(importlib.import_module(module), function)
    except (ImportError, AttributeError) as error:
        raise ParameterError("runner", name, f"MODULE:FUNCTION that can be imported ({error})") from error
    return found


def experiments(suites: Sequence[str]) -> dict[str, bool]:
    """Return the experiments that names stand for; True for a level of problems, False for a single problem.

    Args:
        suites: Suites, levels as ``shelf/hard``, problems by name or id, or files. A suite stands for its levels
            without moving obstacles.

    Raises:
        ApexError: No such suite, level or problem; or none is given.
    """
    if not suites:
        raise ParameterError("suites", "nothing", "a suite, a level as shelf/hard, or a problem")
    known = {**problems.suites(), **VALIDATION}
    found: dict[str, bool] = {}
    for name in suites:
        suite, _, level = name.partition("/")
        if name in known:
            static = [v for v in known[name] if not v.startswith("moving-")]
            found |= {f"{name}/{v}": True for v in static}
        elif suite in known and level in levels_of(suite):
            found[name] = True
        else:
            load_problem(name)
            found[os.fspath(Path(name).resolve()) if name.endswith((".yaml", ".yml")) else name] = False
    return found


def jobs(
    suites: Sequence[str], rows: Sequence[Row], *, runs: int, timeout: float, seed: int, split: str, simplify: bool,
    first: int = 0,
) -> list[Job]:  # fmt: skip
    """Return the runs of a benchmark in their order: all rows on a problem, the first problems of all levels first.

    Runs on a level are on the k-th problems of the split with the seeds ``seed + k``, k from ``first`` on; a single
    problem is that of all its runs.

    Raises:
        ApexError: A suite, planner, parameter or split is unknown, a suite has no such split, or two rows have the same
            label.
    """
    check_name(split, "split", SPLITS)
    check_integer(first, "first", 0)
    most = min(len(SPLITS[split]), 2**31 - seed) - first
    if runs > most:
        raise ParameterError("runs", runs, f"at most {most}, for there are no more problems of the split, or seeds")
    labels = [row.label for row in rows]
    if len(set(labels)) < len(labels) or not labels:
        raise ParameterError("planners", ", ".join(labels) or "none", "one or more, each once")
    for row in rows:
        row.settings()
        if row.runner:
            load_runner(row.runner)
    found = []
    for experiment, is_level in experiments(suites).items():
        suite = experiment.partition("/")[0]
        if is_level and suite in VALIDATION and split != "validation":
            raise ParameterError("split", split, f"validation, the only one of {suite}")
        for row in rows:
            for k in range(first, first + (min(runs, row.runs or runs) if row.runs_on(experiment) else 0)):
                problem = f"{experiment}/{SPLITS[split].start + k}" if is_level else experiment
                limit = row.timeout or timeout
                about = (experiment, problem, row.label, row.planner, row.params, seed + k, limit, simplify)
                job = Job(*about, row.runner)
                found.append((k, job))
    return [job for _, job in sorted(found, key=lambda pair: pair[0])]
