"""README, CONTRIBUTING, the pages of docs/ and the examples: their code runs, their links and names exist."""

from __future__ import annotations

import ast
import importlib
import re
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from support import ROOT, needs

from apex_ompl.cli import parser

README = (ROOT / "README.md").read_text()
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
CODE = {page: re.findall(r"```python\n(.*?)```", page.read_text(), re.S) for page in PAGES}
LEFT_OUT = {"data"}  # folders that the source distribution leaves out


def name_of(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


def commands(page: Path) -> list[str]:
    return [line for block in re.findall(r"```sh\n(.*?)```", page.read_text(), re.S) for line in block.splitlines()]


def is_there(name: str) -> bool:
    """Whether a dotted name can be imported, or is an attribute of what can be."""
    module, attributes = name, list[str]()
    while True:
        try:
            found = importlib.import_module(module)
            break
        except ModuleNotFoundError:
            module, _, last = module.rpartition(".")
            attributes.insert(0, last)
    for attribute in attributes:
        if not hasattr(found, attribute):
            return False
        found = getattr(found, attribute)
    return True


def test_readme_is_short_and_its_example_runs_as_printed(tmp_path: Path) -> None:
    code, script = CODE[ROOT / "README.md"]
    assert (ROOT / "examples" / "01_own_checker.py").read_text().endswith(script), "which another test runs"
    assert len(code.strip().splitlines()) <= 12
    assert len(README.split()) < 800
    done = subprocess.run(
        [sys.executable, "-c", code], check=False, capture_output=True, text=True, cwd=tmp_path, timeout=120
    )
    assert done.returncode == 0, done.stderr
    assert "EXACT_SOLUTION" in done.stdout


@pytest.mark.parametrize("page", [p for p in PAGES[1:] if CODE[p]], ids=name_of)
def test_code_of_a_page_runs_from_top_to_bottom(page: Path, tmp_path: Path) -> None:
    (tmp_path / "tests").symlink_to(ROOT / "tests")  # where docs/data.md reads
    code = "\n".join(CODE[page])
    done = subprocess.run(
        [sys.executable, "-c", code], check=False, capture_output=True, text=True, cwd=tmp_path, timeout=120
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_links_and_pictures_exist(page: Path) -> None:
    for target in re.findall(r"\]\(([^)]+)\)", page.read_text()):
        if target.startswith("http"):
            continue
        path, _, anchor = target.partition("#")
        file = (page.parent / path).resolve() if path else page
        top = file.relative_to(ROOT).parts[0]
        if top in LEFT_OUT and not (ROOT / top).exists():
            continue
        assert file.exists(), target
        if anchor:
            headings = re.findall(r"^#+ (.*)$", file.read_text(), re.M)
            assert anchor in {re.sub(r"[^\w\- ]", "", text).lower().replace(" ", "-") for text in headings}, target


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_names_of_the_package_exist(page: Path) -> None:
    for name in sorted(set(re.findall(r"\bapex_ompl(?:\.\w+)+", page.read_text()))):
        assert is_there(name), name


@pytest.mark.parametrize("page", [*PAGES, *sorted((ROOT / "examples").glob("*.py"))], ids=name_of)
def test_code_imports_public_names_only(page: Path) -> None:
    """They are those of ``apex_ompl`` and of the packages that docs/README.md lists."""
    listed = set(re.findall(r"`(apex_ompl\.\w+)`", (ROOT / "docs" / "README.md").read_text()))
    for code in CODE.get(page) or [page.read_text()] * (page.suffix == ".py"):
        for node in ast.walk(ast.parse(code)):
            if isinstance(node, ast.Import):
                assert not [one.name for one in node.names if one.name.startswith("apex_ompl.")]
            elif isinstance(node, ast.ImportFrom) and str(node.module).split(".")[0] == "apex_ompl":
                assert node.module in {"apex_ompl", *listed}, node.module
                module = importlib.import_module(node.module)
                for name in (one.name for one in node.names if one.name not in module.__all__):
                    importlib.import_module(f"{node.module}.{name}")  # a package or a module of functions


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_commands_are_understood(page: Path) -> None:
    for line in commands(page):
        for command in line.split("&&"):
            words = shlex.split(command)
            if words[:1] == ["apex-ompl"]:
                parser._parser().parse_args(words[1:])  # noqa: SLF001
            elif words[:2] == ["python", "-m"]:
                assert (ROOT / f"{words[2].replace('.', '/')}.py").is_file(), command
            elif words[:1] == ["python"]:
                assert (ROOT / words[1]).is_file(), command
    for script in re.findall(r"`python3? ((?:scripts|examples)/(?!NAME)\w+\.py)", page.read_text()):
        assert (ROOT / script).is_file(), script
    for module in re.findall(r"python -m (benchmarks(?:\.\w+)+)", page.read_text()):
        assert module.endswith(".NAME") or (ROOT / f"{module.replace('.', '/')}.py").is_file(), module


def test_every_page_is_listed() -> None:
    listed = (ROOT / "docs" / "README.md").read_text()
    for page in (ROOT / "docs").glob("*.md"):
        assert page.name == "README.md" or f"({page.name})" in listed and f"(docs/{page.name})" in README, page.name


@needs(".ci")
def test_readme_and_ci_give_the_same_test_command() -> None:
    command = 'pip install -q -c constraints.txt -e ".[test]" && pytest'
    assert command in README
    assert command in (ROOT / ".ci" / "run").read_text().splitlines()


@pytest.mark.parametrize("file", [name_of(p) for p in PAGES] + [pytest.param(".ci/run", marks=needs(".ci"))])
def test_every_install_command_uses_the_constraints(file: str) -> None:
    for line in re.findall(r"pip install .*", (ROOT / file).read_text()):
        assert "-c constraints.txt" in line or "torch==" in line, line


@pytest.mark.parametrize("script", sorted(p.name for p in (ROOT / "scripts").glob("*.py")))
def test_scripts_say_how_they_are_used(script: str, script_here: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(ROOT / "scripts")
    done = script_here(script, "--help")
    assert done.returncode == 0 and "usage" in done.stdout


@pytest.mark.parametrize("file", sorted((ROOT / "benchmarks").glob("*/*.py")), ids=lambda file: file.stem)
def test_benchmarks_take_what_there_is_of_the_package(file: Path) -> None:
    for node in ast.walk(ast.parse(file.read_text())):  # they are not run: some need packages that tests do without
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "apex_ompl":
            module = importlib.import_module(str(node.module))
            for name in node.names:
                if not hasattr(module, name.name):
                    importlib.import_module(f"{node.module}.{name.name}")
