"""The paper's figures (scripts/reproduce.py): rows, intervals, examples by rule, the page, small runs that resume."""

from __future__ import annotations

import json
import sys
from argparse import Namespace
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binomtest
from support import ROOT

sys.path += [str(ROOT / "scripts"), str(ROOT)]  # as the script has them; the workers of the benchmark inherit them

import reproduce  # noqa: E402
from paper import examples, figure, motions, moving, page, published, realism, rows, static, table  # noqa: E402

from apex_ompl import planners, problems, run  # noqa: E402
from apex_ompl.errors import ParameterError  # noqa: E402
from apex_ompl.evaluation import Results, Row  # noqa: E402
from apex_ompl.evaluation.rows import Job, load_runner  # noqa: E402
from apex_ompl.loop.replan import methods  # noqa: E402
from apex_ompl.loop.result import Outcome  # noqa: E402
from apex_ompl.problems.alignment import SIZES  # noqa: E402
from apex_ompl.robot import Robot  # noqa: E402
from apex_ompl.timing import Trajectory  # noqa: E402
from benchmarks.lib import pack  # noqa: E402

RATIO = {"N": 40, "R_f": 12.5, "interval": [5.5, 26.1]}


@given(solved=st.lists(st.booleans(), min_size=1, max_size=300))
def test_failure_ratios_have_the_intervals_of_scipy(solved: list[bool]) -> None:
    cell = figure.ratio(solved)
    failed = len(solved) - sum(solved)
    wanted = binomtest(failed, len(solved)).proportion_ci(method="wilson")
    assert cell["N"] == len(solved) and cell["R_f"] == pytest.approx(100 * failed / len(solved))
    assert cell["interval"] == pytest.approx([100 * wanted.low, 100 * wanted.high], abs=1e-6)


def test_rows_are_those_of_the_registries_and_others_are_left_out_with_a_line(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rows, "checkpoint", lambda model: ROOT)  # as if it were trained
    brought = [row for size in SIZES for row in rows.brought(size, 1, rows.BROUGHT_IN)]
    loops = (*rows.METHODS, *rows.SWEEPS, *brought)
    for some, known in ((rows.PLANNERS, planners.names()), (loops, methods.names())):
        assert len({row.label for row in some}) == len(some)
        there = rows.installed(some, known)
        told = {line.partition(": left out, ")[0] for line in capsys.readouterr().out.splitlines()}
        assert told == {row.label for row in some if row.planner not in known}
        assert there == tuple(row for row in some if row.planner in known)
        for row in there:
            assert load_runner(row.runner) in (moving.loop_run, motions.one_sample, motions.timed)
            if row.runner == rows.TIMED:
                planners.parameters(row.planner, **row.params)  # they are known, and their values
    assert rows.PLANNERS[0].label == "apex" and all(row.planner == "apex" for row in rows.PLANNERS[: rows.OVER_SIZE])
    monkeypatch.setattr(rows, "checkpoint", lambda model: None)
    sizes = [row for row in rows.PLANNERS if row.params.get("model") == rows.SIZED]
    assert len(sizes) == 2 and rows.installed(sizes, planners.names()) == ()
    assert capsys.readouterr().out.count("is not trained") == 2
    known = {f"{suite}/{level}" for suite, levels in problems.suites().items() for level in levels}
    assert set(rows.STATIC) | set(rows.MOVING) <= known


RUN = st.builds(
    dict, seed=st.integers(0, 3), experiment=st.sampled_from(list(rows.MOVING)),
    label=st.sampled_from(["drrt", "rrtconnect", "il"]), outcome=st.sampled_from([str(o) for o in Outcome]),
)  # fmt: skip


@given(runs=st.lists(RUN, max_size=30))
def test_an_example_is_the_first_failure_of_the_first_method_that_has_one(runs: list[dict[str, Any]]) -> None:
    kind = examples.KINDS["stuck"]
    picked = examples.first_failure(runs, kind)
    failed = [run for run in runs if run["outcome"] in ("stuck", "timeout")]
    so = {label: [run for run in failed if run["label"] == label] for label in kind.labels}
    having = [label for label in kind.labels if so[label]]
    if not having:
        assert picked is None
        return
    assert picked in so[having[0]]
    for other in so[having[0]]:  # none is earlier: an earlier seed, or the same of an earlier level
        assert other["seed"] >= picked["seed"]
        if other["seed"] == picked["seed"]:
            order = list(rows.MOVING).index
            assert order(other["experiment"]) >= order(picked["experiment"])


@given(
    guided=st.lists(st.sampled_from(["reached", "hit-moving", "stuck"]), min_size=1, max_size=6),
    unguided=st.lists(st.sampled_from(["reached", "hit-at-rest", "stuck"]), min_size=6, max_size=6),
    contact=st.booleans(),
)  # fmt: skip
def test_a_strip_is_the_first_world_that_shows_what_guidance_does(
    guided: list[str], unguided: list[str], contact: bool
) -> None:
    of = {
        label: {k: {"outcome": one, "solved": one == "reached"} for k, one in enumerate(some[: len(guided)])}
        for label, some in ((rows.FAITHFUL, guided), (rows.UNGUIDED, unguided))
    }
    wanted = "hit-at-rest" if contact else "reached"
    so = [k for k in range(len(guided)) if guided[k] == "reached" and unguided[k] == wanted]
    assert examples.telling(of, contact=contact) == (so[0] if so else 0, len(so))


def test_cells_have_the_numbers_of_runs_that_decide() -> None:
    """The numbers of the issue: 100 a cell of one sample, 200 of apex, 60 moving, 300 in the central claim."""
    known = {row.label: row for row in rows.PLANNERS}
    tasks, speeds = len(rows.TASKS), 3
    for label in (rows.FAITHFUL + rows.ONE, rows.UNGUIDED + rows.ONE):
        claimed = next(row for row in rows.CLAIMED if row.label == label)
        assert known[label].runs == 100 and tasks * claimed.runs >= 300
        assert claimed.params == known[label].params and len(rows.LARGEST) == tasks
    assert all(tasks * known[label].runs >= 200 for label in (rows.OURS, rows.NO_NETWORK))
    assert all(tasks * speeds * row.runs >= 60 for row in rows.METHODS)
    assert len(rows.LARGEST_MOVING) == tasks * speeds
    assert all(len(rows.LARGEST_MOVING) * row.runs >= 300 for row in rows.CLAIMED_MOVING)
    assert {rows.FAITHFUL, rows.UNGUIDED, rows.OURS} < {row.label for row in rows.CLAIMED_MOVING}
    assert tasks * 0.42 * rows.CENTRAL_IMPOSED >= 300, "the share of the largest worlds with room for a cube"


def test_levels_weigh_alike_whatever_their_numbers_of_runs() -> None:
    few = [{"experiment": "a", "seed": k, "solved": False} for k in (2, 0, 1)]
    many = [{"experiment": "b", "seed": k, "solved": True} for k in range(9)]
    found = static.evenly([*many, *few])
    assert sorted((run["experiment"], run["seed"]) for run in found) == [(x, k) for x in "ab" for k in range(3)]
    assert static.evenly([]) == []


def test_the_time_of_a_figure_is_that_of_all_its_runs() -> None:
    runs = [{"label": "a", "cpu": 2.0}, {"label": "a", "cpu": 4.0}, {"label": "b"}]
    results = Results(ROOT, {figure.ASKED: {"a": 1200, "b": 5, "c": 7}}, runs)
    assert figure.cost_of(results) == {"runs": 3, "of": 1212, "timed": 2, "rated": 1200, "core_hours": 1.0}


def test_duration_and_jerk_are_those_of_the_motion() -> None:
    times = np.array([0.0, 1.0, 3.0])  # two joints; jerks (3, 4) for 1 s, then 0 for 2 s
    a = np.array([[0.0, 0.0], [3.0, 4.0], [3.0, 4.0]])
    v = np.array([[0.0, 0.0], [1.5, 2.0], [7.5, 10.0]])
    q = np.array([[0.0, 0.0], [0.5, 2 / 3], [9.5, 38 / 3]])
    found = motions.smoothness(Trajectory(times, q, v, a, ("one", "two")))
    assert found == pytest.approx({"duration": 3.0, "rms_jerk": np.sqrt(25.0 / 3.0)})


def test_a_cube_is_brought_in_where_the_row_says_so_and_its_run_tells(robot: Robot) -> None:
    (row,) = rows.brought("huge", 7, ["blind"])
    assert row.runs == 7 and row.label == "blind, huge" and set(rows.FREE) == {"vertical/free", "horizontal/free"}
    for seed, times in ((3, 1), (4, 0)):  # the second has no room for a cube
        problem = f"vertical/free/{900000 + seed}"
        job = Job("vertical/free", problem, row.label, row.planner, row.params, seed, 30.0, True, row.runner)
        found = moving.loop_run(job)
        direct = run(f"imposed/vertical/huge/{900000 + seed}", "blind", speed=rows.PACE, seed=seed)
        assert found["brought"] == times == len(direct.problem.moving)
        assert found["outcome"] == direct.outcome and found["duration"] == direct.trajectory.duration


def result(folder: Path, where: published.Where, entry: dict[str, Any]) -> None:
    """Write a result, or another entry of it."""
    file = folder / f"paper_{where[0]}.json"
    data = json.loads(file.read_text()) if file.is_file() else {"about": {
        "command": "python scripts/reproduce.py x", "date": "2026-11-24", "commit": "abc1234", "hardware": "2 cores",
        "python": "3.11", "versions": {"ompl": "2.0.1"},
    }}  # fmt: skip
    inner = data
    for key in where[1:-1]:
        inner = inner.setdefault(key, {})
    inner[where[-1]] = entry
    file.write_text(json.dumps(data))


@pytest.mark.parametrize("k", range(len(published.ENTRIES)))
def test_numbers_of_the_page_come_from_the_results(tmp_path: Path, k: int) -> None:
    one = published.ENTRIES[k]

    def written() -> str:
        page.write(tmp_path, tmp_path / "paper.md")
        return (tmp_path / "paper.md").read_text()

    before = page.entries(table.Results(tmp_path)).splitlines()
    assert table.MISSING in before[k + 2] and one.paper in before[k + 2] and table.MISSING in written()
    for where, value in ((one.faithful, 12.34), (one.ours, 56.78)):
        if where:
            extra = {"fid": {"floor": 0.5, "kid": 0.1, "dimension": 8, "made": 77}}.get(where[0], {"N": 77})
            result(tmp_path, where, {**extra, one.number: value, "interval": [value - 1, value + 1]})
    digits = 1 if one.number == "R_f" else 2
    line = page.entries(table.Results(tmp_path)).splitlines()[k + 2]
    assert line in written() and table.MISSING not in line and " 77 " in line
    assert f"{12.34:.{digits}f}" in line and (not one.ours or f"{56.78:.{digits}f}" in line)
    if one.number not in {"S_r", "time_s"}:
        assert f"({11.34:.{digits}f} to {13.34:.{digits}f})" in line
    result(tmp_path, one.faithful, {"N": 77, "floor": 0.5, "kid": 0.1, "dimension": 8, "made": 77, one.number: 43.21})
    assert f"{43.21:.{digits}f}" in page.entries(table.Results(tmp_path)).splitlines()[k + 2]
    assert "abc1234" in written() and "2 cores" in written()


def test_the_page_has_every_algorithm_and_the_choices_of_the_loop(tmp_path: Path) -> None:
    for label in ("apex-paper", "apex-paper, trigger 0.02 m"):
        result(tmp_path, ("dynamic", "sweeps", label), {**RATIO, "causes": {"hit-moving": 5}})
    for one in published.RIVALS:
        result(tmp_path, ("failure", f"both, {one.static}"), {**RATIO, "S_r": 3.21})
    text = page.text(table.Results(tmp_path), "results")
    for one in published.RIVALS:
        assert f"| {one.name} | {one.ratio} | {one.smoothness} | `{one.static}` | 12.5 (5.5 to 26.1) | 40 " in text
    assert "| apex-paper, trigger 0.02 m | 12.5 (5.5 to 26.1) | 40 | 5 hit-moving |" in text
    assert {one.static for one in published.RIVALS} <= {row.label for row in rows.PLANNERS}
    assert {one.moving for one in published.RIVALS if one.moving} <= {row.label for row in rows.METHODS}
    assert not any(mark in text for mark in "{}")


def test_the_page_in_docs_is_that_of_the_results() -> None:
    results = ROOT / "benchmarks" / "results"
    there = (ROOT / "docs" / "paper.md").read_text()
    assert there == page.text(table.Results(results), "../benchmarks/results"), "python scripts/reproduce.py page"


@pytest.fixture
def args(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, shared_process: None) -> Namespace:
    """Arguments of the script, with folders of their own and few rows and levels."""
    monkeypatch.setattr(sys, "argv", [str(ROOT / "scripts" / "reproduce.py"), "failure"])
    few = {f"{task}/{size}": SIZES.get(size, 0.0) for task in rows.TASKS for size in ("free", "small")}
    monkeypatch.setattr(static, "STATIC", few)
    monkeypatch.setattr(static, "PLANNERS", (rows.planner("rrtconnect", "rrtconnect"), Row("later", "no_such_planner")))
    monkeypatch.setattr(static, "OVER_SIZE", 1)
    monkeypatch.setattr(static, "CLAIMED", ())
    monkeypatch.setattr(static, "TIMED", "small")
    return Namespace(
        n=1,
        jobs=1,
        parts=None,
        report=False,
        keep=tmp_path / "runs",
        out=tmp_path / "results",
        page=tmp_path / "paper.md",
    )


def test_static_figures_are_made_and_resume(args: Namespace, capsys: pytest.CaptureFixture[str]) -> None:
    made = static.failure(args)
    made.write("failure", args)
    assert "later: left out, this installation has no no_such_planner" in capsys.readouterr().out
    stored = args.keep / static.FOLDER / "runs.jsonl"
    lines = stored.read_text().splitlines()
    assert len(lines) == 4, "two tasks, two levels, one row"
    found = json.loads((args.out / "paper_failure.json").read_text())
    assert found["vertical, rrtconnect"]["N"] == 1 and found["both, rrtconnect"]["N"] == 2
    assert found["about"]["run_commits"] and (args.out / "paper_failure.png").stat().st_size > 1000
    stored.write_text(lines[0] + "\n" + lines[1][:40])  # killed while it wrote the second run
    again = static.failure(args)
    resumed = stored.read_text().splitlines()
    assert resumed[0] == lines[0], "runs that had ended are not made again"
    assert {json.loads(line)["key"] for line in resumed} == {json.loads(line)["key"] for line in lines}
    assert again.data["both, rrtconnect"]["R_f"] == made.data["both, rrtconnect"]["R_f"]
    cell = made.data["vertical, rrtconnect"]
    assert cell["duration_s"] > 0.5 and cell["rms_jerk"] > 1.0
    for cost in (made.data["cost"], again.data["cost"]):
        assert cost["runs"] == cost["of"] == cost["timed"] == 4 and cost["core_hours"] > 0.0
    cells = static.size(args).data  # of the same runs
    assert stored.read_text().splitlines() == resumed and cells["both/small, rrtconnect"]["N"] == 2


def test_the_central_claim_comes_first_and_packed_runs_resume(
    args: Namespace, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(static, "CLAIMED", (replace(static.PLANNERS[0], runs=2),))
    monkeypatch.setattr(static, "LARGEST", ("vertical/small",))
    args.n, args.parts = 9, 1
    monkeypatch.setattr(static, "PLANNERS", (replace(static.PLANNERS[0], runs=1),))
    found = static.size(args).data
    assert found["vertical/small, rrtconnect"]["N"] == found["both/small, rrtconnect"]["N"] == 2
    assert "horizontal/small, rrtconnect" not in found and "vertical/free, rrtconnect" not in found
    stored = args.keep / static.FOLDER / "runs.jsonl"
    before = stored.read_text()
    assert before.count("\n") == 2, "the runs of the first part alone"
    monkeypatch.setattr(pack, "RUNS", args.keep)
    monkeypatch.setattr(pack, "PACKED", tmp_path / "packed")
    packed = pack.pack(static.FOLDER)
    args.keep = tmp_path / "clone"  # of another machine
    monkeypatch.setattr(pack, "RUNS", args.keep)
    assert {file.name for file in pack.unpack(static.FOLDER)} == {"about.json", "runs.jsonl"}
    args.report = True
    assert static.size(args).data == found, "a report makes no run"
    args.report, args.parts = False, None
    static.size(args)
    resumed = (args.keep / static.FOLDER / "runs.jsonl").read_text()
    assert resumed.startswith(before) and resumed.count("\n") == 5, "one on each of the other three levels"
    assert pack.pack(static.FOLDER) == packed, "packed again with what was added"
    with pytest.raises(ParameterError, match="without other runs"):
        monkeypatch.setattr(pack, "RUNS", stored.parents[1])
        pack.unpack(static.FOLDER)


def test_times_are_those_of_runs_alone(args: Namespace) -> None:
    args.jobs = 2
    made = static.time(args)
    assert made.data["rrtconnect"]["N"] == 2 and made.data["rrtconnect"]["time_s"] > 0.0
    sessions = json.loads((args.keep / "paper_alone" / "about.json").read_text())["sessions"]
    assert [session["jobs"] for session in sessions] == [1]


def test_dynamic_figures_are_made_and_examples_take_their_runs(
    args: Namespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    blind = rows.in_loop("blind", "blind")
    sizes = {size: SIZES[size] for size in ("medium", "large")}
    levels = {f"vertical/moving-{size}-0.4": size for size in sizes} | {"horizontal/moving-large-0.4": "large"}
    monkeypatch.setattr(moving, "MOVING", levels)
    monkeypatch.setattr(moving, "SIZES", sizes)
    monkeypatch.setattr(moving, "METHODS", (blind, rows.in_loop("later", "no_such_method")))
    monkeypatch.setattr(moving, "SWEEPS", ())
    monkeypatch.setattr(moving, "CLAIMED_MOVING", ())
    made = moving.dynamic(args)
    made.write("dynamic", args)
    assert {name: cell["N"] for name, cell in made.data["tasks"].items()} == {
        "vertical, blind": 2, "horizontal, blind": 1, "both, blind": 3,
    }  # fmt: skip
    runs = [json.loads(line) for line in (args.keep / "paper_loops" / "runs.jsonl").read_text().splitlines()]
    failed = [run for run in runs if not run["solved"]]
    both = made.data["tasks"]["both, blind"]
    assert both["R_f"] == pytest.approx(100 * len(failed) / 3) and sum(both["causes"].values()) == len(failed) > 0
    outcome = Outcome(failed[0]["outcome"])
    monkeypatch.setattr(examples, "KINDS", {"one": examples.Kind((outcome,), ("blind",)),
                                            "none": examples.Kind((Outcome.LIMITS,), ("blind",))})  # fmt: skip
    drawn = examples.failures(args)
    assert len((args.keep / "paper_loops" / "runs.jsonl").read_text().splitlines()) == 3, "no run is made again"
    picked = examples.first_failure(runs, examples.KINDS["one"])
    assert drawn.data["one"]["world"] == picked["problem"] and drawn.data["none"] is None
    assert drawn.data["one"]["reason"] == picked["reason"], "the same run, bit for bit"
    assert drawn.picture is not None


def test_cubes_that_are_brought_in_count_where_there_was_room(args: Namespace, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(moving, "BROUGHT_IN", ("blind",))
    monkeypatch.setattr(moving, "CENTRAL_LABELS", ())
    monkeypatch.setattr(moving, "SIZES", {"huge": SIZES["huge"]})
    args.n = 4
    found = moving.imposed(args).data
    runs = [json.loads(line) for line in (args.keep / "paper_imposed" / "runs.jsonl").read_text().splitlines()]
    brought = [run for run in runs if run["brought"]]
    cell = found["sizes"]["huge, blind"]
    assert len(runs) == cell["worlds"] == found["cost"]["of"] == 8 and 0 < len(brought) == cell["N"] < 8
    assert cell["R_f"] == pytest.approx(100 * sum(not run["solved"] for run in brought) / len(brought)) != 0.0
    assert sum(found["tasks"][name]["N"] for name in found["tasks"]) == cell["N"]
    assert sum(found["again"][name]["N"] for name in found["again"]) == cell["N"]


def test_models_and_planners_make_paths_of_the_same_problem(robot: Robot) -> None:
    name = "vertical/small/800000"
    problem = problems.load(name)
    ends = problem.start_state(robot.joint_names), problem.goal_states(robot.joint_names)[0]
    some = [realism.proposing("apex", guided=True), realism.planning(Row("rrtconnect", "rrtconnect"))]
    paths = []
    for row in some:
        job = Job("vertical/small", name, row.label, row.planner, row.params, 0, 5.0, True, row.runner)
        run = load_runner(row.runner)(job)
        assert run["solved"] and run["total"] > 0.0
        paths.append(np.array(run["control"]))
        assert np.abs(paths[-1][[0, -1]] - ends).max() < 1e-4
    assert paths[0].shape == paths[1].shape and np.abs(paths[0] - paths[1]).max() > 1e-3
    for features in realism.feature_spaces().values():
        assert np.isfinite(features(paths)).all() and len(features(paths)) == 2


def test_all_goes_on_behind_a_figure_that_fails_and_says_which(
    args: Namespace, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def broken(_: Namespace) -> figure.Made:
        raise ValueError("no such thing")

    args.out.mkdir()
    args.n = None
    monkeypatch.setattr(static, "time", broken)
    monkeypatch.setattr(reproduce, "FIGURES", {"time": ("static", 1, "x"), "failure": ("static", 1, "x")})
    with pytest.raises(SystemExit, match="^failed: time; give the command again"):
        reproduce.everything(args)
    assert (args.out / "paper_failure.json").is_file() and "no such thing" in capsys.readouterr().err
    text = args.page.read_text()
    assert "results/paper_failure.md" in text and "`python scripts/reproduce.py time`" in text


def test_the_command_refuses_what_makes_no_sense(monkeypatch: pytest.MonkeyPatch) -> None:
    for words in (
        ["all", "-n", "3"],
        ["strips", "--report"],
        ["fid", "--parts", "1"],
        ["size", "--parts", "0"],
        ["fid", "-n", "2"],
        ["no_such_figure"],
    ):
        monkeypatch.setattr(sys, "argv", ["reproduce.py", *words])
        with pytest.raises(SystemExit) as stopped:
            reproduce.parsed()
        assert stopped.value.code == 2


def test_runs_in_folders_are_packed_too(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(pack, "RUNS", tmp_path / "runs")
    monkeypatch.setattr(pack, "PACKED", tmp_path / "packed")
    for name in ("tasks/one.json", "worlds/one.json", "worlds/picture.png"):
        (tmp_path / "runs" / "pairs" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "runs" / "pairs" / name).write_text(name)
    pack.pack("pairs")
    monkeypatch.setattr(pack, "RUNS", tmp_path / "clone")
    assert [file.read_text() for file in pack.unpack("pairs")] == ["tasks/one.json", "worlds/one.json"]
