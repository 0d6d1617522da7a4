"""Tuned parameters: where they are used, that they are what the tuning chose, and how it chooses."""

from __future__ import annotations

import importlib
import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from support import ROOT

from apex_ompl import planners
from apex_ompl.evaluation import Results, Row
from apex_ompl.evaluation.rows import Job

RESULTS = [
    json.loads((ROOT / "benchmarks" / "results" / f"{name}.json").read_text()) for name in ("tune", "tune_baselines")
]
TUNED = {name: result for one in RESULTS for name, result in one["planners"].items()}
OWN = ("apex", "rrtconnect+polish", "gpmp", "gpmp2", "drrt", "damon")
PLANNER, FIRST_PROBLEM = "lbkpiece1", 800_000


@pytest.fixture(scope="module")
def tune() -> Iterator[ModuleType]:
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(ROOT))
        yield importlib.import_module("benchmarks.planners.tune")


def test_tuned_parameters_are_those_that_the_tuning_chose() -> None:
    """Those chosen have the least score of the last problems; what TUNED leaves out is as by default."""
    assert all(one["about"]["split"] == "validation" for one in RESULTS) and set(planners.TUNED) == set(TUNED)
    for name, result in TUNED.items():
        last = result["rungs"][-1]
        best = Row.of(name, result["chosen"]).label
        assert last[best]["score"] == min(one["score"] for one in last.values()), name
        assert result["default"] in last and len({one["n"] for one in last.values()}) == 1, name
        if name == "roboplan":
            assert dict(planners.TUNED[name]) == result["chosen"]
        else:
            settings = asdict(planners.parameters(name, **planners.TUNED[name]))
            assert {key: settings[key] for key in result["chosen"]} == result["chosen"], name


def test_tuned_parameters_are_the_defaults_of_this_packages_planners_alone() -> None:
    for name in OWN:
        assert planners.parameters(name) == planners.parameters(name, **planners.TUNED[name])
    assert planners.parameters("rrtconnect").range == 0.0, "OMPL's default"


def test_labels_name_parameters() -> None:
    row = Row.of("rrt", {"range": 0.7, "intermediate_states": False}, timeout=5.0)
    assert row.label == "rrt[range=0.7;intermediate_states=false]" and row.timeout == 5.0
    assert Row.parse(row.label).parameters() == row.parameters()
    assert Row.of("rrt") == Row("rrt", "rrt") and Row.of("rrt", {}).label == "rrt"


def outcome(job: Job, first: float | None, length: float = 1.0) -> dict[str, Any]:
    about = {"key": job.key, "experiment": job.experiment, "problem": job.problem, "label": job.label}
    return about | {
        "seed": job.seed, "status": "", "solved": first is not None, "first": first, "total": first,
        "length": length if first is not None else None, "timeout": job.timeout,
    }  # fmt: skip


class Bench:
    """Stands for ``bench``: the k-th candidate of a planner takes ``seconds[k]`` on all problems but the first."""

    def __init__(self, labels: Sequence[str], seconds: Sequence[float | None], folder: Path) -> None:
        self.seconds, self.results = dict(zip(labels, seconds, strict=True)), Results(folder, {})
        self.calls: list[tuple[list[str], int]] = []

    def __call__(self, levels: Sequence[str], rows: Sequence[Row], folder: Path, **options: Any) -> Results:
        assert options["split"] == "validation"
        self.calls.append(([row.label for row in rows], options["runs"]))
        runs = {run["key"]: run for run in self.results.runs}
        for level in levels:
            for row in rows:
                for k in range(options["runs"]):
                    about = (level, f"{level}/{FIRST_PROBLEM + k}", row.label, row.planner, row.params)
                    job = Job(*about, seed=k, timeout=2.0, simplify=False)
                    runs[job.key] = outcome(job, self.seconds[row.label])
        self.results.runs[:] = runs.values()
        return self.results


def test_the_best_candidates_and_the_default_go_on(
    tune: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The default is the slowest; of the others the best ones stay, in the end on the most problems."""
    labels = [row.label for row in tune.rows_of(PLANNER)]
    seconds = [None, 0.7, 0.2, 0.6, 0.1, 0.5, 0.3, 0.4]
    bench = Bench(labels, seconds, tmp_path)
    monkeypatch.setattr(tune, "bench", bench)
    monkeypatch.setattr(tune.record, "session", dict)  # it reads the script that this process runs
    rungs = tune.rungs_of(PLANNER, 1)
    assert [count for _, count in bench.calls] == [problems for _, problems in tune.RUNGS]
    by_score = sorted(labels[1:], key=lambda label: bench.seconds[label])
    for (ran, problems), (keep, _), rung in zip(bench.calls, tune.RUNGS, rungs, strict=True):
        assert set(ran) == {labels[0], *by_score[:keep]}
        assert {len(score.runs) for score in rung} == {problems * len(tune.levels())}
        assert [score.label for score in rung] == [label for label in (*by_score, labels[0]) if label in ran]
    assert tune.chosen(PLANNER, rungs[-1]) == tune.CANDIDATES[PLANNER][4]
    assert [score.score for score in rungs[-1]] == pytest.approx([0.1, 0.2, 4.0])


def test_scores_are_means(tune: ModuleType) -> None:
    """Of times, and of lengths over the shortest known, where a problem that nobody solved has none."""
    made = [("a", 0.1, 6.0), ("b", 0.4, 5.0), ("c", None, 0.0), ("d", None, 0.0)]
    runs = [
        outcome(Job("level", problem, "x", PLANNER, {}, seed=0, timeout=2.0, simplify=False), first, length)
        for problem, first, length in made
    ]
    score = tune.Score("x", runs, {"a": 4.0, "b": 5.0, "c": 7.0})
    assert score.time == pytest.approx((0.1 + 0.4 + 4.0 + 4.0) / 4)
    assert score.length == pytest.approx((1.5 + 1.0 + 2.0) / 3)
    assert score.score == pytest.approx(score.time * score.length)
    plain = tune.Score("x", runs, None)
    assert plain.length == 1.0 and plain.score == pytest.approx(score.time)
    found = score.figures()
    assert (found["n"], found["solved"]) == (4, 0.5) and found["first_s"] == [0.4, None]
    assert found["first_s_geometric_mean"] == pytest.approx((0.1 * 0.4 * 4.0 * 4.0) ** 0.25)


def test_every_planner_has_as_many_candidates_the_default_first(tune: ModuleType) -> None:
    for name, candidates in (tune.CANDIDATES | tune.BASELINES).items():
        if name == tune.ROBOPLAN:
            pytest.importorskip("roboplan.core")
        labels = [row.label for row in tune.rows_of(name)]
        assert len(set(labels)) == len(candidates) == tune.RUNGS[0][0], name
        if name not in (*OWN, tune.ROBOPLAN):
            assert planners.parameters(name, **candidates[0]) == planners.parameters(name)
