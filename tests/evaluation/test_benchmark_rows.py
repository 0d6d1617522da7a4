"""Rows, experiments and jobs of a benchmark, rows with a runner of their own, and faulty commands."""

from __future__ import annotations

from pathlib import Path

import pytest

from apex_ompl import evaluation, planners
from apex_ompl.cli.parser import main
from apex_ompl.errors import ApexError, ParameterError, UnknownNameError
from apex_ompl.evaluation import Row, bench
from apex_ompl.evaluation.rows import PAPER, experiments, jobs
from apex_ompl.model.guidance import EQUATION_7, Guidance
from apex_ompl.model.proposals import Sampling

LEVEL = "swap/easy"


def test_rows_are_read_and_checked() -> None:
    row = Row.parse(" apex[fallback=false; lambda-obs=0.1] ")
    assert row.planner == "apex" and dict(row.params) == {"fallback": "false", "lambda_obs": "0.1"}
    assert row.parameters().fallback is False and row.settings()["lambda_obs"] == 0.1
    assert Row.parse("rrtconnect+polish").planner == "rrtconnect+polish"
    for text in ("", "apex[", "apex[gamma]", "apex[=1]", "a[b=1]c"):
        with pytest.raises(ParameterError, match="planner"):
            Row.parse(text)
    for arguments in ({"timeout": 0.0}, {"runs": -1}):
        with pytest.raises(ParameterError):
            Row("a", "apex", **arguments)
    assert Row("a", "apex", levels=("/hard", "cage", "wall/easy")).levels


def test_suites_stand_for_their_static_levels() -> None:
    levels = ("free", "small", "medium", "large", "xlarge", "huge", "extreme")
    assert list(experiments(["vertical"])) == [f"vertical/{v}" for v in levels]
    assert experiments(["shelf/hard", "shelf_swap", "cage/easy/800001"]) == {
        "shelf/hard": True, "shelf_swap": False, "cage/easy/800001": False,
    }  # fmt: skip
    assert experiments(["vertical/moving-small-0.1"]) == {"vertical/moving-small-0.1": True}
    for names in ([], ["no_such"], ["shelf/none"]):
        with pytest.raises(ApexError):
            experiments(names)


def test_runs_take_problems_and_seeds_in_turn() -> None:
    rows = [Row("a", "rrtconnect"), Row("b", "rrt", runs=2, timeout=1.0, levels=("/hard",))]
    options: dict = {"runs": 3, "timeout": 5.0, "seed": 7, "split": "test", "simplify": True}
    found = jobs(["wall/hard", "wall/easy"], rows, **options)
    assert [(j.problem, j.label, j.seed, j.timeout) for j in found[:3]] == [
        ("wall/hard/900000", "a", 7, 5.0), ("wall/hard/900000", "b", 7, 1.0), ("wall/easy/900000", "a", 7, 5.0),
    ]  # fmt: skip
    assert len(found) == 3 + 2 + 3 and len({j.key for j in found}) == len(found)
    assert [(j.problem, j.seed) for j in jobs(["shelf_swap"], rows[:1], **options)] == [
        ("shelf_swap", 7), ("shelf_swap", 8), ("shelf_swap", 9),
    ]  # fmt: skip
    later = jobs(["wall/hard"], rows[:1], first=4, **options)
    assert [(j.problem, j.seed) for j in later] == [(f"wall/hard/{900_000 + k}", 7 + k) for k in (4, 5, 6)]
    with pytest.raises(ParameterError, match="each once"):
        jobs(["wall/hard"], [rows[0], rows[0]], **options)
    for more in ({"runs": 100_001}, {"seed": 2**31 - 2}, {"first": 100_000}):
        with pytest.raises(ParameterError, match="runs: expected at most"):
            jobs(["wall/hard"], rows, **{**options, **more})
    with pytest.raises(UnknownNameError, match="split"):
        jobs(["wall/hard"], rows, **{**options, "split": "none"})
    with pytest.raises(UnknownNameError, match="planner"):
        jobs(["wall/hard"], [Row("c", "no_such")], **options)


def test_a_row_may_make_its_runs_itself(tmp_path: Path) -> None:
    row = Row("own", "guesser", {"luck": [0, 2]}, runner="bad_planners:guess")
    options: dict = {"timeout": 1.0, "split": "validation", "quiet": True}
    bench([LEVEL], [row], tmp_path, runs=2, provenance={"commit": "a"}, **options)
    found = bench([LEVEL], [row], tmp_path, runs=3, provenance={"commit": "b"}, **options)
    by_seed = {run["seed"]: run for run in found.runs}
    assert [by_seed[k]["solved"] for k in range(3)] == [True, False, True]
    assert [by_seed[k]["status"] for k in range(3)] == ["EXACT_SOLUTION", "TIMEOUT", "EXACT_SOLUTION"]
    assert [by_seed[k]["guess"] for k in range(3)] == ["swap/easy/800000 1", "swap/easy/800001 1", "swap/easy/800002 1"]
    assert [by_seed[k]["session"] for k in range(3)] == [0, 0, 1] and by_seed[0]["first"] == 0.25
    assert [session["commit"] for session in found.sessions()] == ["a", "b"]
    assert found.about["rows"]["own"]["all"] == {"luck": [0, 2]}
    assert "guesser" not in evaluation.markdown(found) and "| own | 3 |" in evaluation.markdown(found)
    with pytest.raises(ParameterError, match="the parameters that it has in"):
        bench([LEVEL], [Row("own", "guesser", {"luck": []}, runner=row.runner)], tmp_path, **options)


def test_faulty_runners_are_named(tmp_path: Path) -> None:
    with pytest.raises(ParameterError, match="runner of own: expected MODULE:FUNCTION"):
        Row("own", "guesser", runner="guess")
    for name in ("no_such:guess", "bad_planners:no_such"):
        with pytest.raises(ParameterError, match="runner: expected MODULE:FUNCTION that can be imported"):
            bench([LEVEL], [Row("own", "guesser", runner=name)], tmp_path, quiet=True)


def test_a_faulty_checkpoint_ends_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["bench", LEVEL, "--planners", "apex[model=no_such]", "--runs", "1", "-o", str(tmp_path / "x")]
    assert main([*arguments, "--quiet"]) == 2
    assert "no_such" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["bench", "no_such", "-o", "x"], "no_such"),
        (["bench", "shelf/hard", "-o", "x", "--planners", "apex,none"], "unknown planner 'none'"),
        (["bench", "shelf/hard", "-o", "x", "--planners", "apex[gama=1]"], "did you mean 'gamma'"),
        (["bench", "shelf/hard", "-o", "x", "--runs", "0"], "runs"),
        (["bench", "shelf/hard", "-o", "x", "--jobs", "0"], "jobs"),
        (["bench", "shelf/hard", "-o", "x", "--timeout", "nan"], "timeout"),
        (["bench", "shelf/hard", "-o", "x", "--split", "none"], "split"),
        (["bench", "shelf/hard", "-o", "x", "--planners", ","], "planners"),
        (["report", "nowhere", "-o", "x"], "nowhere"),
    ],
)
def test_faulty_commands_get_a_sentence(
    arguments: list[str], words: str, capsys: pytest.CaptureFixture[str], tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    said = capsys.readouterr().err
    assert words in said and said.count("\n") == 1 and not list(tmp_path.iterdir())


def test_the_papers_rows_are_guided_by_equation_7() -> None:
    """And the planner's own model by what is best for it."""
    own = Sampling("ddpm", 256)
    faithful = planners.parameters("apex", **PAPER, guidance=True).sampling(own)
    assert faithful.guidance == EQUATION_7 and EQUATION_7.scaling == "noise"
    assert planners.parameters("apex", **PAPER).sampling(own).guidance.gamma == 0.0
    half = planners.parameters("apex", **PAPER, guidance=True, gamma=0.5).sampling(own)
    assert half.guidance.gamma == 0.5 * EQUATION_7.gamma > 0.0
    assert planners.parameters("apex", guidance=True).sampling(own).guidance == Guidance(scaling="clean")
