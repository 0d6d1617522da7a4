"""How the kernel is compiled: where its code is kept, and what one compiled function takes from another."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from support import ROOT

from apex_ompl.kernel.compiled import compilation
from apex_ompl.kernel.compiled.layout import Floats

CALL = """
import numpy as np
from apex_ompl.kernel.compiled import compilation

def plus(a):
    return a[0] + 1.0

f = compilation.entry_point(plus)
assert f(np.ones(1)) == f(np.ones(1)) == 2.0
print(compilation.cache_folder())
"""


def called(script: Path, cache: Path) -> subprocess.CompletedProcess[str]:
    env = {"PATH": "", "NUMBA_CACHE_DIR": str(cache), "XDG_CACHE_HOME": str(cache), "PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, script], check=False, env=env, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return done


@pytest.mark.parametrize("writable", [True, False])
def test_code_is_kept_where_it_can_be(tmp_path: Path, writable: bool) -> None:
    (tmp_path / "file").write_text("not a folder")
    home = tmp_path / "cache" if writable else tmp_path / "file"
    script = tmp_path / "call.py"
    script.write_text(CALL)
    first, second = called(script, home), called(script, home)
    assert "compiles" in first.stderr
    if writable:
        assert str(home) in first.stdout and "compiles" not in second.stderr
    else:
        assert first.stdout.strip() == "None" and "no cache folder" in first.stderr and "compiles" in second.stderr


def test_the_same_code_at_another_place_is_not_compiled_again(tmp_path: Path) -> None:
    """Another environment of the same version shares the cache; an edited file does not."""
    scripts = [tmp_path / place / "call.py" for place in ("here", "there", "edited")]
    for script in scripts:
        script.parent.mkdir()
        script.write_text(CALL if script.parent.name != "edited" else CALL.replace("2.0", "3.0").replace("1.0", "2.0"))
    here, there, edited = (called(script, tmp_path / "cache") for script in scripts)
    assert here.stdout == there.stdout == edited.stdout
    assert "compiles" in here.stderr and "compiles" not in there.stderr


def test_compiled_functions_take_nothing_from_outside_their_folder() -> None:
    """Copies with the same files share compiled code, so that nothing else may be compiled into it."""
    folder = Path(compilation.__file__).parent
    for file in folder.glob("*.py"):
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("apex_ompl"):
                inside = node.module.startswith("apex_ompl.kernel.compiled")
                assert inside or (file.stem, node.module) == ("compilation", "apex_ompl.util.cache"), file.name
            elif isinstance(node, ast.Import):
                assert not any(alias.name.startswith("apex_ompl") for alias in node.names), file.name


def test_what_is_compiled_once_for_all_its_callers_is_not_inlined() -> None:
    """Not even where the function that calls it is: numba would hand that on, and how sums may be taken."""

    def inner(a: Floats) -> float:
        return float(a[0] * 2.0)

    outer: Any = compilation.outlined(inner)

    def between(a: Floats) -> float:
        return outer(a) + 1.0

    middle: Any = compilation.reassociating_inlined(between)

    middle.compile("f8(f8[::1])")
    assert [next(iter(f.overloads.values())).fndesc.inline for f in (outer, middle)] == [False, True]
    codes = [str(next(iter(f.overloads.values())).library._final_module) for f in (outer, middle)]
    assert "fmul double" in codes[0] and "fadd reassoc contract double" in codes[1]
