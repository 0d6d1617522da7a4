from __future__ import annotations

import argparse
import ast
import importlib.util
import re
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from support import ROOT

from apex_ompl.collision import CollisionChecker
from apex_ompl.errors import ParameterError, UnknownNameError
from apex_ompl.robot import load_robot
from apex_ompl.robot.config import read_disabled_pairs
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


MY_ROBOT = """schema: apex-ompl/robot/1
name: my
parts: [{name: arm, urdf: my.urdf}]
joints:
  one: {acceleration: 1, jerk: 9}
  two: {acceleration: 1, jerk: 9}
"""
BOX = '<collision><geometry><box size="0.05 0.05 0.2"/></geometry></collision>'
TURN = '<origin xyz="0 0 0.3"/><axis xyz="0 1 0"/><limit lower="-1" upper="1" velocity="1" effort="1"/></joint>'
MY_URDF = f"""<robot name="my"><link name="base">{BOX}</link><link name="on">{BOX}</link><link name="tip">{BOX}</link>
<joint name="one" type="revolute"><parent link="base"/><child link="on"/>{TURN}
<joint name="two" type="revolute"><parent link="on"/><child link="tip"/>{TURN}</robot>"""


@pytest.mark.parametrize("named", [False, True])
def test_files_of_a_robot_are_made_before_and_after_it_names_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], named: bool
) -> None:
    """As docs/robots.md tells: no hand is soft, and the robot's file may name what is not there yet."""
    pairs, covers = ("a.yaml", "b.json") if named else ("my.pairs.yaml", "my.spheres.json")
    names = f"disabled_pairs: {pairs}\ncovers: {covers}\n"
    (tmp_path / "my.robot.yaml").write_text(MY_ROBOT + names * named)
    (tmp_path / "my.urdf").write_text(MY_URDF)
    derive, make = (load_script(name, monkeypatch) for name in ("derive_disabled_pairs", "make_covers"))
    for _ in range(2):  # again, with the files there
        for script, more in ((derive, ["--samples", "600"]), (make, ["--effort", "1"])):
            monkeypatch.setattr(sys, "argv", [script.__name__, str(tmp_path / "my.robot.yaml"), *more])
            script.main()
        (tmp_path / "my.robot.yaml").write_text(MY_ROBOT + names)
        robot = load_robot(tmp_path / "my.robot.yaml")
        assert robot.covers == tmp_path / covers
        assert read_disabled_pairs(tmp_path / pairs) == [("base", "on"), ("base", "tip"), ("on", "tip")]
        assert not robot.geometry.collisionPairs and CollisionChecker(robot).is_free(robot.home)
    monkeypatch.setattr(sys, "argv", ["derive", str(tmp_path / "my.robot.yaml"), "--soft", "hand"])
    with pytest.raises(UnknownNameError, match="unknown part 'hand'"):
        derive.main()
