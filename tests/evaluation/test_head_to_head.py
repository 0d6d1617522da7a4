"""The comparison of planners: motions of stored paths, and the table of all levels together."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from planning import cached_problem
from support import benchmark_script

from apex_ompl import plan
from apex_ompl.errors import MissingFileError
from apex_ompl.evaluation import Results, Row
from apex_ompl.evaluation.summary import Statistics
from apex_ompl.result import PlanResult

NAME = "shelf/hard/800020"


@pytest.fixture(scope="module")
def script() -> ModuleType:
    return benchmark_script("planners.head_to_head")


@pytest.fixture(scope="module")
def path() -> PlanResult:
    return plan(cached_problem(NAME), "rrtconnect+polish", seed=1, timeout=20.0, timing=False)


def run_of(key: str, **columns: object) -> dict:
    about = {"key": key, "problem": NAME, "experiment": "shelf/hard", "label": "a", "seed": 1, "timeout": 20.0}
    return {**about, "solved": True, "total": 0.5, "first": 0.4, "length": 4.0, **columns}


def test_stored_paths_become_motions_once(script: ModuleType, path: PlanResult, tmp_path: Path) -> None:
    runs = [run_of("known"), run_of("lost", solved=False, total=20.0), run_of("new", total=1.0), run_of("late")]
    runs[3]["total"] = runs[3]["timeout"]
    results = Results(tmp_path, {}, runs)
    known = {"key": "known", "duration": 7.0, "reason": "", "computed": 0.25, "commit": "before"}
    kept = tmp_path / script.MOTIONS
    kept.write_text(json.dumps(known) + '\n{"key": "new", "dura')
    with pytest.raises(MissingFileError):
        script.motions_of(results, 1, "now", quiet=True)
    for run in (runs[2], runs[3]):
        results.plan_file(run).parent.mkdir(exist_ok=True)
        path.save(results.plan_file(run))
    made = script.motions_of(results, 2, "now", quiet=True)
    assert [motion["key"] for motion in made] == ["known", "new", "late"] and made[0] == known
    whole = plan(cached_problem(NAME), "rrtconnect+polish", seed=1, timeout=20.0)
    assert whole.trajectory is not None and made[1]["duration"] == pytest.approx(whole.trajectory.duration, rel=1e-9)
    assert made[2]["duration"] is None and "in time" in made[2]["reason"]
    assert {m["key"]: m for m in map(json.loads, kept.read_text().splitlines())} == {m["key"]: m for m in made}
    assert script.motions_of(Results(tmp_path, {}, runs[:3]), 1, "now", quiet=True) == made[:2], "nothing is made again"

    waits = {run["key"]: run.get("wait") for run in script.with_motions(results, made).runs}
    assert waits["known"] == 0.5 + 0.25 + 7.0 and waits["lost"] is None and waits["late"] == np.inf
    assert waits["new"] == 1.0 + made[1]["computed"] + made[1]["duration"]
    assert [run for run in results.runs if "wait" in run] == []


def test_planning_and_motion_have_columns(script: ModuleType) -> None:
    waits = [1.0, 2.0, np.inf, 4.0]
    runs = [run_of(str(k), label="apex", wait=wait) for k, wait in enumerate(waits)]
    runs += [run_of("5", label="apex", solved=False, total=20.0, length=None)]
    found, rows = Statistics("shelf/hard", "apex", runs), (Row("apex", "apex"),)
    table = script.together([found], rows, {"hard": ("hard",)})
    assert list(table.head[-3:]) == ["planning + motion p50 s", "p95", "motions that failed"]
    assert list(table.rows[0][-3:]) == ["4.00", "-", "1"], "two of five have no motion"
    plain = replace(found, runs=[{k: v for k, v in run.items() if k != "wait"} for run in runs])
    other = script.together([plain], rows, {"hard": ("hard",)})
    assert list(other.head) == list(table.head[:-3]) and other.rows[0] == table.rows[0][:-3]
