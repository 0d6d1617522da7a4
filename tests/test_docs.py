"""What README and examples print and promise is true."""

from __future__ import annotations

import ast
import importlib
import re
import subprocess
import sys
from pathlib import Path

import pytest
from support import ROOT

README = (ROOT / "README.md").read_text()


def test_readme_example_runs_as_printed(tmp_path: Path) -> None:
    code, script = re.findall(r"```python\n(.*?)```", README, re.S)
    assert (ROOT / "examples" / "own_checker.py").read_text().endswith(script), "which another test runs"
    assert len(code.strip().splitlines()) <= 12
    done = subprocess.run(
        [sys.executable, "-c", code], check=False, capture_output=True, text=True, cwd=tmp_path, timeout=120
    )
    assert done.returncode == 0, done.stderr
    assert "EXACT_SOLUTION" in done.stdout


def test_readme_and_ci_give_the_same_test_command() -> None:
    command = 'pip install -q -c constraints.txt -e ".[test]" && pytest'
    assert command in README
    assert command in (ROOT / ".ci" / "run").read_text().splitlines()


def test_readme_links_and_pictures_exist() -> None:
    for target in re.findall(r"\]\(([^)#]+)\)", README):
        assert target.startswith("http") or (ROOT / target).exists(), target


def test_every_install_command_uses_the_constraints() -> None:
    for text in (README, (ROOT / ".ci" / "run").read_text()):
        for line in re.findall(r"pip install .*", text):
            assert "-c constraints.txt" in line or "torch==" in line, line


@pytest.mark.parametrize("script", sorted(p.name for p in (ROOT / "scripts").glob("*.py")))
def test_scripts_say_how_they_are_used(script: str) -> None:
    done = subprocess.run(
        [sys.executable, ROOT / "scripts" / script, "--help"], check=False, capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 0 and "usage" in done.stdout


def test_the_ompl_example_runs(tmp_path: Path) -> None:
    example = ROOT / "examples" / "ompl_benchmark.py"
    command = [sys.executable, example, "reach_past_post", "--runs", "1", "--timeout", "8"]
    done = subprocess.run(command, check=False, capture_output=True, text=True, cwd=tmp_path, timeout=120)
    assert done.returncode == 0, done.stderr
    assert "RRTConnect: EXACT_SOLUTION" in done.stdout
    assert re.search(r"1/1 solved", done.stdout)
    assert (tmp_path / "ompl_benchmark.log").read_text().startswith("OMPL version")


@pytest.mark.parametrize("file", sorted((ROOT / "benchmarks").glob("*.py")), ids=lambda file: file.stem)
def test_benchmarks_take_what_there_is_of_the_package(file: Path) -> None:
    for node in ast.walk(ast.parse(file.read_text())):  # they are not run: some need packages that tests do without
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "apex_ompl":
            module = importlib.import_module(str(node.module))
            for name in node.names:
                if not hasattr(module, name.name):
                    importlib.import_module(f"{node.module}.{name.name}")
