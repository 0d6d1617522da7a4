"""Benchmark scripts: what they import, what their results record, and the freshness of results."""

from __future__ import annotations

import ast
import json
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest
from support import ROOT, benchmark_script

SCRIPTS = sorted((ROOT / "benchmarks").glob("*/*.py"))
RESULTS = sorted((ROOT / "benchmarks" / "results").glob("*.json"))


@pytest.fixture(scope="module")
def freshness() -> ModuleType:
    return benchmark_script("lib.freshness")


def names_in(script: Path) -> set[str]:
    """Names that a module defines or imports."""
    found = set[str]()
    for node in ast.parse(script.read_text()).body:
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            found.add(node.name)
        elif isinstance(node, (ast.Assign, ast.AnnAssign)):
            found |= {n.id for n in ast.walk(node) if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)}
        elif isinstance(node, (ast.Import, ast.ImportFrom)):
            found |= {alias.asname or alias.name for alias in node.names}
    return found


@pytest.fixture(scope="module")
def siblings() -> dict[str, set[str]]:
    """Names of each benchmark's module."""
    return {".".join(path.relative_to(ROOT).with_suffix("").parts): names_in(path) for path in SCRIPTS}


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.stem)
def test_what_benchmarks_take_from_each_other_is_there(script: Path, siblings: dict[str, set[str]]) -> None:
    tree = ast.parse(script.read_text())
    imported = names_in(script)
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and str(node.module).startswith("benchmarks."):
            if node.module not in siblings:  # a room, of which modules are imported
                assert {f"{node.module}.{alias.name}" for alias in node.names} <= set(siblings), node.module
                continue
            assert {alias.name for alias in node.names} <= siblings[node.module], node.module
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "record":
            assert "record" in imported and node.attr in siblings["benchmarks.lib.record"], node.attr
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            runner = re.fullmatch(r"(benchmarks\.[\w.]+):(\w+)", node.value)
            if runner:
                assert runner[2] in siblings[runner[1]], node.value


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.stem)
def test_benchmarks_that_write_results_declare_their_dependencies(script: Path, freshness: ModuleType) -> None:
    if "record.write(" in script.read_text():
        for path in freshness.record.dependencies(script):
            left_out = path.startswith(("data/", "benchmarks/baselines/")) and not (ROOT / "data").exists()
            assert left_out or (ROOT / path).exists(), path


@pytest.mark.parametrize("result", RESULTS, ids=lambda result: result.stem)
def test_results_record_how_they_were_made(result: Path, freshness: ModuleType) -> None:
    about = json.loads(result.read_text())["about"]
    assert set(freshness.FIELDS) <= set(about) and result.with_suffix(".md").is_file()
    assert freshness.script_of(ROOT, result, about["command"]) is not None


Commit = Callable[..., str]


@pytest.fixture
def commit(tmp_path: Path) -> Commit:
    """A function that writes files into a repository at ``tmp_path``, and returns the commit of them."""
    if shutil.which("git") is None:
        pytest.skip("there is no git")

    def git(*arguments: str) -> str:
        identity = ["-c", "user.name=x", "-c", "user.email=x@example.org", "-c", "commit.gpgsign=false"]
        done = subprocess.run(["git", *identity, *arguments], cwd=tmp_path, check=True, capture_output=True, text=True)
        return done.stdout.strip()

    git("init", "-q")

    def made(**files: str) -> str:
        for name, text in files.items():
            (tmp_path / f"{name}.py").write_text(text)
        git("add", "-A")
        git("commit", "-q", "--allow-empty", "-m", "x")
        return git("rev-parse", "--short", "HEAD")

    return made


def test_results_are_stale_when_code_that_they_depend_on_changed(
    tmp_path: Path, freshness: ModuleType, commit: Commit
) -> None:
    first = commit(planner='"""Plan."""\n\nSTEP = 1\n', other="A = 1\n")
    result = tmp_path / "speed.json"

    def state(**about: object) -> tuple[str, str]:
        entries = {"command": "python planner.py", "commit": first, "depends": ["planner.py"], **about}
        result.write_text(json.dumps({"about": {key: value for key, value in entries.items() if value is not None}}))
        found = freshness.freshness(tmp_path, result)
        return found.state, found.reason

    assert state() == ("fresh", "")
    commit(planner='"""Plan a path."""\n\nDEPENDS = ("other.py",)\nSTEP = 1  # m\n', other="A = 2\n")
    assert state() == ("fresh", ""), "docstrings, comments and DEPENDS do not count"
    assert state(depends=None)[0] == "stale", "the script says what it depends on: other.py has changed"
    (tmp_path / "planner.py").write_text("STEP = 2\n")
    assert state() == ("stale", f"changed since {first}: planner.py"), "not committed, but it counts"
    second = commit()
    assert state(commit=second)[0] == "fresh"
    assert state(commit=second, run_commits=f"{first}; {second}")[0] == "stale", "some runs are older"
    assert state(commit=f"{second}+changes")[0] == "stale" and state(commit="unknown")[0] == "stale"
    assert state(commit="0123456")[0] == "unknown", "as in a shallow clone"
    assert state(command="python gone.py", depends=None)[0] == "stale"
    (tmp_path / "planner.py").unlink()
    assert state(commit=second)[0] == "stale"


def test_the_command_fails_where_a_quoted_result_is_stale(
    tmp_path: Path, freshness: ModuleType, commit: Commit, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    made = commit(planner="STEP = 1\n")
    for name, about in (("new", made), ("old", "unknown")):
        data = {"about": {"command": "python planner.py", "commit": about, "depends": ["planner.py"]}}
        (tmp_path / f"{name}.json").write_text(json.dumps(data))
    monkeypatch.setattr(freshness.record, "ROOT", tmp_path)
    monkeypatch.setattr(freshness.record, "RESULTS", tmp_path)
    page = tmp_path / "README.md"
    for links, fault in (((), ""), (("new",), ""), (("new", "old"), "old"), (("gone",), "gone")):
        page.write_text("".join(f"[x](benchmarks/results/{name}.md)\n" for name in links))
        monkeypatch.setattr(sys, "argv", ["freshness.py", "--quoted", str(page)])
        if fault:
            with pytest.raises(SystemExit, match=f"not fresh: {fault}$"):
                freshness.main()
        else:
            freshness.main()
        shown = capsys.readouterr().out
        assert "fresh   new" in shown and "stale   old: the commit" in shown


@pytest.mark.parametrize("name", ["closed_loop", "guarded_runs"])
def test_runs_of_the_closed_loop_are_made_and_make_a_row(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    module, loop = benchmark_script(f"loop.{name}"), benchmark_script("loop.closed_loop")
    monkeypatch.setattr(loop.record, "script", lambda: ROOT / "benchmarks" / "loop" / f"{name}.py")
    loop.made_with.cache_clear()
    method = "blind" if name == "closed_loop" else "no-network"
    made = module.made(loop.Job("vertical/moving-small-0.1/900000", method, 1.0))
    assert json.loads(json.dumps(made)) and made["costs"] == loop.cost_table()["version"]
    summary = loop.summary([made])
    assert summary["n"] == 1 and summary["over_limits"] == 0 and sum(summary["causes"].values()) == summary["failed"]
    assert loop.made_by([made])["run_hardware"] == made["hardware"]
    assert name in loop.table({name: summary})
