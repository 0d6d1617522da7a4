from __future__ import annotations

import argparse
import ast
import importlib.util
import re
import sys
from collections.abc import Callable
from types import ModuleType
from typing import Any

import pytest
from support import ROOT

from apex_ompl.errors import ParameterError
from apex_ompl.util.entry_point import run_script


def raises(error: BaseException) -> Callable[[], None]:
    def main() -> None:
        raise error

    return main


@pytest.mark.parametrize(
    "error, code, message",
    [
        (ParameterError("-n", 0, "1 or more"), 2, "error: -n"),
        (ModuleNotFoundError("No module named 'ray'", name="ray"), 2, "error: no ray, expected: pip install"),
        (KeyboardInterrupt(), 130, "stopped"),
    ],
)
def test_faults_end_a_script_with_one_sentence(
    error: BaseException, code: int, message: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", ["folder/some_script.py", "-n", "0"])
    with pytest.raises(SystemExit) as ended:
        run_script(raises(error), "bench")
    shown = capsys.readouterr()
    assert ended.value.code == code and shown.out == ""
    assert shown.err.startswith(f"some_script: {message}") and shown.err.count("\n") == 1


def test_faults_of_the_code_are_not_hidden() -> None:
    for error in (ValueError("a defect"), ImportError("a defect")):
        with pytest.raises(type(error), match="a defect"):
            run_script(raises(error))
    run_script(lambda: None)


SCRIPTS = ROOT / "scripts"
PLACES = {
    "SUITE[/LEVEL]": "shelf/easy",
    "all|FIGURE|page": "all",
    "N": "2",
    "M": "3",
    "HOST:PORT": "host:1",
    "KEY=VALUE": "a=1",
}


def load_script(name: str, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """Import a script, which is skipped where a library that it needs is missing."""
    monkeypatch.syspath_prepend(SCRIPTS)
    spec = importlib.util.spec_from_file_location(f"script_{name}", SCRIPTS / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, spec.name, module)
    try:
        spec.loader.exec_module(module)
    except ModuleNotFoundError as error:
        pytest.skip(f"no {error.name}")
    return module


def usages() -> list[tuple[str, str]]:
    """Each line of each script's usage: the script and the arguments."""
    found = []
    for path in sorted(SCRIPTS.glob("*.py")):
        text = (ast.get_docstring(ast.parse(path.read_text())) or "").partition("Usage:")[2]
        found += [
            (path.stem, line.partition("(")[0]) for line in re.findall(rf"python scripts/{path.stem}\.py(.*)", text)
        ]
    return found


@pytest.mark.skipif(not SCRIPTS.is_dir(), reason="needs a clone")
@pytest.mark.parametrize(("name", "arguments"), usages(), ids=lambda text: text.strip())
def test_scripts_take_what_their_usage_says(name: str, arguments: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for place, value in PLACES.items():
        arguments = re.sub(rf"(?<![\w.]){re.escape(place)}(?![\w.])", value, arguments)
    arguments = arguments.replace(" ...", "").replace("[", "").replace("]", "")
    module = load_script(name, monkeypatch)
    monkeypatch.setattr(sys, "argv", [name, *arguments.split()])
    for way in ("parse_args", "parse_intermixed_args"):
        original = getattr(argparse.ArgumentParser, way)

        def parsed(parser: argparse.ArgumentParser, *given: Any, original: Any = original) -> None:
            original(parser, *given)
            raise EOFError  # it would begin its work now

        monkeypatch.setattr(argparse.ArgumentParser, way, parsed)
    with pytest.raises(EOFError):
        module.main()
