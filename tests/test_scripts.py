from __future__ import annotations

import sys
from collections.abc import Callable

import pytest

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
