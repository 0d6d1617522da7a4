"""Single runs of a benchmark: what counts as solved, when the first path counts, processes that die."""

from __future__ import annotations

import sqlite3
from pathlib import Path

import numpy as np
import pytest
from support import ROOT

from apex_ompl import evaluation, load_problem, problems
from apex_ompl.errors import ParameterError
from apex_ompl.evaluation import Row, Workers, bench, runs
from apex_ompl.evaluation.rows import Job
from apex_ompl.evaluation.runs import first_path_proof
from apex_ompl.ompl.setup import assemble
from apex_ompl.ompl.validity import full_check
from apex_ompl.result import PlanResult
from apex_ompl.robot import Robot


def test_the_first_path_counts_where_the_shortened_one_is_repaired(robot: Robot) -> None:
    problem = problems.load("wall/easy/800000")
    ready = assemble(problem, robot)
    witness = problems.witness("wall/easy/800000").path
    line = np.stack([ready.start, ready.goals[0]])

    def proof(raw: np.ndarray | None) -> float:
        return first_path_proof(ready.checker, raw, ready.start, ready.goals, times)

    times = {"verify": 0.25}
    assert proof(witness) == 0.25
    times["repair"] = 30.0
    assert proof(None) == 0.25, "the first path is not known"
    assert 0.0 < proof(witness) < 30.0
    assert not full_check(ready.checker, line, ready.start, ready.goals)
    assert proof(line) == 30.25


def test_another_robot_warms_up_on_its_own_problem(tmp_path: Path) -> None:
    table = str(ROOT / "examples" / "baxter_table.yaml")
    found = bench([table], ["rrtconnect"], tmp_path, runs=1, keep=True, quiet=True)
    kept = PlanResult.load(found.plan_file(found.runs[0]))
    assert kept.length == found.runs[0]["length"] and kept.problem.name == load_problem(table).name
    assert "result" not in found.runs[0]
    assert [run["solved"] for run in found.runs] == [True] and found.about["warm_up"]["rrtconnect"] > 0.0
    assert runs._robot_of(str(ROOT / "examples" / "baxter_table.yaml")) == "baxter"


def test_success_is_the_full_check_and_a_dead_process_is_a_crash(tmp_path: Path) -> None:
    able = Workers(modules=("bad_planners",))
    rows = [Row("cheat", "cheat", runs=1), Row("dies", "dies", {"on": 1}, runs=1), Row("shaky", "dies", {"on": 2})]
    rows.append(Row("rrtconnect", "rrtconnect", runs=1))
    found = bench(["wall/hard"], rows, tmp_path, runs=2, timeout=0.3, split="validation", workers=able, quiet=True)
    by = {
        label: [run for run in found.runs if run["label"] == label]
        for label in ("cheat", "dies", "shaky", "rrtconnect")
    }
    for run in by["cheat"]:
        assert not run["solved"] and run["properties"]["solved BOOLEAN"] == "1" and "full check" in run["reason"]
    assert [run["reason"] for run in by["dies"]] == ["the process died"] and len(by["rrtconnect"]) == 1
    assert [run["status"] for run in by["dies"]] == ["CRASH"]
    assert [run["status"] for run in by["shaky"]] == ["TIMEOUT"] * 2, "it is tried again in a process of its own"
    database = sqlite3.connect(evaluation.write_database(found, evaluation.write_logs(found)))
    solved = "SELECT sum(solved) FROM runs JOIN plannerConfigs p ON p.id = plannerid WHERE p.name = 'cheat'"
    assert database.execute(solved).fetchone() == (0,)
    assert "Crashed: 1 x dies: the process died." in evaluation.markdown(found)
    with pytest.raises(ParameterError, match="planners that do not end the process"):
        bench(["wall/hard"], [Row("dies", "dies", {"on": 0})], tmp_path / "x", workers=able, quiet=True)


def test_first_paths_of_planners_that_use_all_their_time_are_noticed() -> None:
    for name in ("aorrtc", "informedrrtstar"):
        found = runs.run(Job("x", "wall/easy/800000", name, name, {}, 0, 1.5, True))
        assert found["solved"] and found["raw_length"] is None
        assert 0.0 < found["first"] < 0.5 * found["total"], name
