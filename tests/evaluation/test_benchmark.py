"""Results of a benchmark: runs, logs, resumption, reports."""

from __future__ import annotations

import json
import os
import pickle
import re
import signal
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ompl import base as ob
from ompl import tools as ot

from apex_ompl import evaluation, problems
from apex_ompl.errors import FileFormatError, MissingFileError, ParameterError
from apex_ompl.evaluation import Results, Row, Workers, bench, driver
from apex_ompl.evaluation.runs import Run
from apex_ompl.evaluation.summary import Statistics, statistics

LEVEL, RUNS = "swap/easy", 3
ROWS = ("apex[seed=1]", "rrtconnect")


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Results:
    folder = tmp_path_factory.mktemp("bench") / "results"
    return bench([LEVEL], ROWS, folder, runs=RUNS, timeout=10.0, split="validation", quiet=True)


def test_runs_record_their_outcome(results: Results) -> None:
    assert len(results.runs) == len(ROWS) * RUNS and {run["label"] for run in results.runs} == set(ROWS)
    for run in results.runs:
        assert run["solved"] and run["status"] == "EXACT_SOLUTION" and run["problem"] in problems.frozen_names(
            "swap", "easy", "validation"
        )  # fmt: skip
        assert 0.0 < run["first"] <= run["total"] and run["properties"]["solved BOOLEAN"] == "1"
        assert run["length"] <= run["raw_length"] + 1e-6 and run["clearance"] > 0.0 and run["checks"] > 0
        assert run["times"]["solve"] == pytest.approx(float(run["properties"]["time REAL"]))
    apex = [run for run in results.runs if run["label"] == ROWS[0]]
    assert all(run["by"] and run["by"] != "apex[seed=1]" and run["counts"] for run in apex)
    assert any("solve: polish" in run["times"] for run in apex)
    assert set(results.about["warm_up"]) == set(ROWS)
    assert results.about["rows"][ROWS[0]]["all"]["seed"] == 1


def test_the_log_is_ompls_own(results: Results) -> None:
    logs = evaluation.write_logs(results)
    file = evaluation.write_database(results, logs)
    assert [log.name for log in logs] == ["swap_easy.log"]
    database = sqlite3.connect(file)
    names = dict(database.execute("SELECT id, name FROM plannerConfigs").fetchall())
    assert set(names.values()) == set(ROWS)
    settings = dict(database.execute("SELECT name, settings FROM plannerConfigs").fetchall())
    assert re.search(r"^;?fallback = True$", settings[ROWS[0]], re.M)
    assert "range = 3.69" in settings[ROWS[1]], "what OMPL took, not the 0 that lets it choose"
    rows = database.execute(
        "SELECT plannerid, problem, seed, solved, path_length, solved_by, time FROM runs"
    ).fetchall()
    stored = {(run["label"], run["problem"]): run for run in results.runs}
    assert len(rows) == len(stored)
    for planner, problem, seed, solved, length, by, took in rows:
        run = stored[names[planner], problem]
        assert (seed, bool(solved), by) == (run["seed"], run["solved"], run["by"])
        assert length == pytest.approx(run["length"], rel=1e-6) and took == pytest.approx(run["times"]["solve"])
    experiment = database.execute("SELECT name, timelimit, runcount, split FROM experiments").fetchall()
    assert experiment == [("swap/easy".replace("/", "_"), 10.0, RUNS, "validation")]
    assert database.execute("SELECT count(*) FROM bestPlannerConfigsPerExperiment").fetchone()[0] >= 1
    again = results.folder / "again.db"
    command = [str(Path(sys.executable).with_name("ompl_benchmark_statistics")), "-d", str(again), str(logs[0])]
    subprocess.run(command, check=True, capture_output=True)
    assert sqlite3.connect(again).execute("SELECT count(*) FROM runs").fetchone() == (len(rows),)
    ot.readBenchmarkLog(str(results.folder / "third.db"), [str(logs[0])], False)


def outcome(results: Results) -> list[tuple]:
    """Columns of runs that do not depend on time."""
    found = [(r["problem"], r["label"], r["solved"], r["by"], r["length"], r["raw_length"]) for r in results.runs]
    return sorted(found)


@pytest.mark.usefixtures("shared_process")
def test_what_is_there_is_not_run_again_and_broken_lines_are(results: Results, tmp_path: Path) -> None:
    folder = tmp_path / "copy"
    folder.mkdir()
    lines = (results.folder / "runs.jsonl").read_text().splitlines(keepends=True)
    (folder / "runs.jsonl").write_text("".join(lines[:2]) + lines[2][:40])
    (folder / "about.json").write_text((results.folder / "about.json").read_text())
    options: dict = {"runs": RUNS, "timeout": 10.0, "split": "validation", "quiet": True}
    again = bench([LEVEL], ROWS, folder, **options)
    assert outcome(again) == outcome(results)
    assert (folder / "runs.jsonl").read_text().startswith("".join(lines[:2]))
    assert len(again.about["sessions"]) == 2
    begin = time.perf_counter()
    assert outcome(bench([LEVEL], ROWS, folder, **options)) == outcome(results)
    assert time.perf_counter() - begin < 2.0, "nothing was left to run, and no process started"


@pytest.mark.usefixtures("shared_process")
def test_a_last_line_that_is_whole_is_kept(results: Results, tmp_path: Path) -> None:
    lines = (results.folder / "runs.jsonl").read_text().splitlines()
    (tmp_path / "runs.jsonl").write_text("\n".join(lines[:-1]))
    (tmp_path / "about.json").write_text((results.folder / "about.json").read_text())
    again = bench([LEVEL], ROWS, tmp_path, runs=RUNS, timeout=10.0, split="validation", quiet=True)
    assert outcome(again) == outcome(results)
    kept = (tmp_path / "runs.jsonl").read_text().splitlines()
    assert kept[:-1] == lines[:-1] and len(kept) == len(lines)


@pytest.mark.usefixtures("shared_process")
def test_processes_are_renewed(results: Results, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    begun = []
    monkeypatch.setattr(driver, "RUNS_PER_PROCESS", 2)
    pool = Workers._pool
    monkeypatch.setattr(Workers, "_pool", lambda self, *given: (begun.append(given[1]), pool(self, *given))[1])
    found = bench([LEVEL], ROWS[1:], tmp_path, runs=RUNS, timeout=10.0, split="validation", quiet=True)
    assert begun == [1, 1] and outcome(found) == [one for one in outcome(results) if one[1] == ROWS[1]]


@pytest.mark.usefixtures("shared_process")
@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL])
def test_a_stopped_command_goes_on(results: Results, tmp_path: Path, how: signal.Signals) -> None:
    folder, file = tmp_path / "stopped", tmp_path / "stopped" / "runs.jsonl"
    command = [sys.executable, "-m", "apex_ompl.cli", "bench", LEVEL, "--planners", ROWS[1], "--runs", str(RUNS)]
    command += ["--timeout", "10", "--split", "validation", "-o", str(folder)]
    before = signal.signal(
        signal.SIGINT, signal.default_int_handler
    )  # what a shell starts in the background ignores Ctrl-C
    try:
        process = subprocess.Popen(
            command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True, start_new_session=True
        )
    finally:
        signal.signal(signal.SIGINT, before)
    for _ in range(1200):
        if file.is_file() and file.read_text().count("\n") >= 1:
            break
        time.sleep(0.05)
    if how is signal.SIGINT:  # a terminal sends it to all
        os.killpg(process.pid, how)
    else:
        process.send_signal(how)
    _, said = process.communicate(timeout=60)
    assert process.returncode == (130 if how is signal.SIGINT else -9) and "Traceback" not in said, said
    assert 1 <= len(Results.load(folder).runs) < RUNS
    if how is signal.SIGKILL:
        options: dict = {"runs": RUNS, "timeout": 10.0, "split": "validation", "quiet": True}
        found = bench([LEVEL], ROWS[1:], folder, **options)
        assert outcome(found) == [one for one in outcome(results) if one[1] == ROWS[1]]


def made_up(firsts: list[float | None], timeout: float = 2.0) -> Statistics:
    made = [
        {"solved": t is not None, "first": t, "total": None if t is None else t + 0.1, "by": "apex", "timeout": timeout,
         "length": 3.0 if t is not None else None}
        for t in firsts
    ]  # fmt: skip
    return Statistics("a/b", "apex", made)


def test_figures_count_what_is_not_solved_as_endless() -> None:
    f = made_up([0.3, None, 0.1, 0.2])
    assert f.share_within(0.2) == 0.5 and f.percentile("first", 50) == 0.2 and f.percentile("total", 75) == 0.4
    assert np.isinf(f.percentile("first", 95)) and f.median("length") == 3.0 and f.by == {"apex": 3}


def test_the_report_opens_without_a_network(results: Results, tmp_path: Path) -> None:
    page, text = evaluation.report(results.folder, tmp_path / "report")
    html, found = page.read_text(), text.read_text()
    assert not re.findall(r"""(?:src|href)=["'](?!data:)""", html) and html.count("data:image/png;base64") >= 3
    for f in statistics(results):
        length = f"{f.median('length'):.3g}"
        assert f.label in html and f"<td>{length}</td>" in html and f" {length} " in found
    assert "EPYC" in html or "cores" in html
    assert "at the same time" not in found


def test_load_beyond_the_runs_is_reported(results: Results) -> None:
    assert all(run["load"] >= 0.0 for run in results.runs)
    for load, said in ((1.4, False), (1.6, True)):
        loaded = Results(results.folder, results.about, [{**run, "load": load} for run in results.runs])
        assert ("The load was over 1.5 in 6 of 6 runs" in evaluation.markdown(loaded)) is said


def test_planners_that_end_early_are_reported(results: Results) -> None:
    refused = {"status ENUM": str(ob.PlannerStatus.PlannerStatusType.INVALID_GOAL.value)}
    made = [{**run, "solved": False, "properties": refused} for run in results.runs[:2]]
    text = evaluation.markdown(Results(results.folder, results.about, made))
    assert "Ended early, unsolved: " in text
    for label in {run["label"] for run in made}:
        assert f"{sum(run['label'] == label for run in made)} x {label}, INVALID_GOAL" in text
    assert "Ended early" not in evaluation.markdown(results)


def test_runs_at_the_same_time_are_reported(results: Results, tmp_path: Path) -> None:
    options: dict = {"runs": 2, "timeout": 10.0, "split": "validation", "quiet": True}
    found = bench([LEVEL], ROWS[1:], tmp_path, workers=Workers(2), **options)
    assert outcome(found) == [one for one in outcome(results) if one[1] == ROWS[1]][:2]
    assert "made at the same time" in evaluation.markdown(found)


def test_a_cluster_makes_the_same_runs(results: Results, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What Ray is given to do, done here; tests of training start Ray itself."""

    def spread(work: Callable[..., Run], jobs: dict[str, tuple[Any, ...]], **options: Any) -> Iterator[tuple[str, Run]]:
        assert (options["workers"], options["address"]) == (1, "auto")
        for k, (name, job) in enumerate(pickle.loads(pickle.dumps(jobs)).items()):
            yield name, options["lost"](name) if k == len(jobs) - 1 else pickle.loads(pickle.dumps(work))(*job)

    monkeypatch.setattr(driver, "spread", spread)
    options: dict = {"runs": 2, "timeout": 10.0, "split": "validation", "quiet": True}
    found = bench([LEVEL], ROWS, tmp_path, workers=Workers(1, "auto"), **options)
    (lost,) = (run for run in found.runs if run["status"] == "CRASH")
    assert lost["reason"] == "the process died" and not lost["solved"]
    made = [one for one in outcome(found) if one[:2] != (lost["problem"], lost["label"])]
    assert len(made) == 3 and set(made) <= set(outcome(results))
    assert "made on a cluster" in evaluation.markdown(found)


def test_faulty_results_are_named(results: Results, tmp_path: Path) -> None:
    with pytest.raises(MissingFileError, match=r"about\.json"):
        Results.load(tmp_path)
    (tmp_path / "about.json").write_text(json.dumps({**results.about, "schema": "other"}))
    with pytest.raises(FileFormatError, match="schema"):
        bench([LEVEL], ROWS, tmp_path, quiet=True)
    (tmp_path / "about.json").write_text(json.dumps(results.about))
    with pytest.raises(ParameterError, match=r"timeout: expected 10.0, as in .*; or another folder"):
        bench([LEVEL], ROWS, tmp_path, timeout=3.0, quiet=True)
    options: dict = {"timeout": 10.0, "split": "validation", "quiet": True}
    with pytest.raises(ParameterError, match="the parameters that it has in"):
        bench([LEVEL], [Row("rrtconnect", "rrtconnect", {"range": 1.0})], tmp_path, **options)
    with pytest.raises(ParameterError, match="the parameters that it has in"):
        bench([LEVEL], [Row("rrtconnect", "rrtconnect", timeout=1.0)], tmp_path, **options)
    with pytest.raises(FileFormatError, match="one run or more"):
        evaluation.report(tmp_path, tmp_path / "out")
    (tmp_path / "runs.jsonl").write_text("nonsense\n{}\n")
    with pytest.raises(FileFormatError, match="line 1: expected a run"):
        Results.load(tmp_path)
    first, *others = results.runs
    for name, value, words in (
        ("status", 5, "line 1: status: expected text, got 5"), ("seed", "x", "seed: expected a whole number"),
        ("length", [], "length: expected a number"), ("times", None, "times: expected a mapping, got None"),
        ("solved", "yes", "solved: expected true or false"), ("properties", {"status ENUM": "x"}, "status of OMPL's"),
    ):  # fmt: skip
        runs = [{**first, name: value}, *others]
        (tmp_path / "runs.jsonl").write_text("".join(json.dumps(run) + "\n" for run in runs))
        with pytest.raises(FileFormatError, match=words):
            Results.load(tmp_path)
    (tmp_path / "about.json").write_text(json.dumps(results.about | {"sessions": 3}))
    with pytest.raises(FileFormatError, match="sessions: expected a list, got 3"):
        Results.load(tmp_path)
    (tmp_path / "about.json").unlink()
    with pytest.raises(FileFormatError, match="expected results of bench"):
        bench([LEVEL], ROWS, tmp_path, quiet=True)
