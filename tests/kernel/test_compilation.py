"""How numba compiles the kernel: where its code is kept, and what one compiled function takes from another."""

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
from apex_ompl.kernel.compiled.jit import cache_folder

def plus(a):
    return a[0] + 1.0

f = compilation.entry_point(plus)
found = f(np.ones(1)), f(np.ones(1))
if found != (2.0, 2.0):
    raise SystemExit(found)
print(cache_folder())
"""


def called(script: Path, cache: Path, *options: str, **environment: str) -> subprocess.CompletedProcess[str]:
    env = {"PATH": "", "NUMBA_CACHE_DIR": str(cache), "XDG_CACHE_HOME": str(cache), "PYTHONPATH": str(ROOT)}
    command = [sys.executable, *options, str(script)]
    env |= environment
    done = subprocess.run(command, check=False, env=env, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return done


@pytest.fixture
def script(tmp_path: Path) -> Path:
    (tmp_path / "call.py").write_text(CALL)
    return tmp_path / "call.py"


def test_without_a_folder_for_the_cache_code_is_not_kept(tmp_path: Path, script: Path) -> None:
    (tmp_path / "file").write_text("not a folder")
    done = called(script, tmp_path / "file")
    assert done.stdout.strip() == "None" and "no cache folder" in done.stderr and "compiles" in done.stderr


def test_the_same_code_at_another_place_is_not_compiled_again(tmp_path: Path) -> None:
    """Another environment of the same version shares the cache; an edited file does not."""
    scripts = [tmp_path / place / "call.py" for place in ("here", "there", "edited")]
    for script in scripts:
        script.parent.mkdir()
        script.write_text(
            CALL if script.parent.name != "edited" else CALL.replace("(2.0, 2.0)", "(3.0, 3.0)").replace("1.0", "2.0")
        )
    here, there, edited = (called(script, tmp_path / "cache") for script in scripts)
    assert here.stdout == there.stdout == edited.stdout and str(tmp_path / "cache") in here.stdout
    assert "compiles" in here.stderr and "compiles" not in there.stderr


DAMAGE = {"index_0": (".nbi", 0), "index_50": (".nbi", 50), "code_0": (".nbc", 0), "code_50": (".nbc", 50)}
FOUR = """
import numpy as np
from apex_ompl.kernel.compiled import compilation
""" + "".join(f"""
def {name}(a):
    return a[0] + 1.0

if compilation.entry_point({name})(np.ones(1)) != 2.0:
    raise SystemExit("{name}")
""" for name in DAMAGE)  # fmt: skip


def test_what_is_damaged_in_the_cache_is_compiled_anew(tmp_path: Path, script: Path) -> None:
    """Each file that was cut short is told in one line, and is whole after that run."""
    script.write_text(FOUR)
    called(script, tmp_path)
    whole = {}
    for name, (ending, size) in DAMAGE.items():
        (file,) = tmp_path.rglob(f"*{name}*{ending}")
        whole[file] = file.read_bytes()
        file.write_bytes(whole[file][:size])
    damaged, mended = called(script, tmp_path), called(script, tmp_path)
    lines = damaged.stderr.splitlines()
    assert len(lines) == len(DAMAGE) and mended.stderr == ""
    for name, line in zip(DAMAGE, lines, strict=True):
        assert line.startswith(f"apex_ompl compiles {name}: the file of its code in ") and str(tmp_path) in line
    assert all(len(file.read_bytes()) == len(content) for file, content in whole.items())


READ_ONLY = """
import builtins, errno, tempfile

def refuse(*_, **__):  # as a read-only file system does, for root as well
    raise OSError(errno.EROFS, "Read-only file system")

before = builtins.open
builtins.open = lambda file, mode="r", *more, **named: refuse() if "w" in mode else before(file, mode, *more, **named)
tempfile.TemporaryFile = refuse
"""
FULL = "import resource\nresource.setrlimit(resource.RLIMIT_FSIZE, (2048, 2048))\n"  # largest size of a file [bytes]


def under(prelude: str, script: Path) -> Path:
    """A script that does something before it runs another."""
    made = script.with_name(f"under_{script.name}")
    made.write_text(f"{prelude}\nimport runpy\nrunpy.run_path({str(script)!r})\n")
    return made


def test_a_complete_cache_that_cannot_be_written_is_read(tmp_path: Path, script: Path) -> None:
    first = called(script, tmp_path / "cache")
    second = called(under(READ_ONLY, script), tmp_path / "cache")
    assert second.stdout == first.stdout and second.stderr == ""
    script.write_text(CALL.replace("plus", "other"))
    missing = called(under(READ_ONLY, script), tmp_path / "cache")
    assert "in every process anew, since " in missing.stderr and "cannot be written, or is full" in missing.stderr


def test_where_there_is_no_room_code_is_compiled_and_not_kept(tmp_path: Path, script: Path) -> None:
    done = called(under(FULL, script), tmp_path / "cache")
    assert "in every process anew, since " in done.stderr and "cannot be written, or is full" in done.stderr
    assert "compiled plus in" in done.stderr
    left = [file for file in (tmp_path / "cache").rglob("*") if file.suffix == ".nbc" or ".tmp" in file.name]
    assert not left


def test_levels_of_optimization_have_caches_of_their_own(tmp_path: Path, script: Path) -> None:
    """Without docstrings the code is another one, which would be compiled without a word."""
    plain, optimized = called(script, tmp_path), called(script, tmp_path, "-OO")
    assert plain.stdout != optimized.stdout and "compiles" in optimized.stderr
    assert called(script, tmp_path, PYTHONOPTIMIZE="2").stderr == ""


def test_numba_can_be_disabled_for_other_code(tmp_path: Path, script: Path) -> None:
    script.write_text(CALL + "import numba\nassert not hasattr(numba.njit(plus), 'py_func')\n")
    assert "apex_ompl compiled plus" in called(script, tmp_path, NUMBA_DISABLE_JIT="1").stderr
    assert called(script, tmp_path, NUMBA_DISABLE_JIT="1").stderr == ""


OUTSIDE = {
    ("jit", "apex_ompl.util.cache"),
    ("jit", "apex_ompl.util.forking"),
    ("jit", "apex_ompl.kernel.library"),
    ("compilation", "apex_ompl.kernel.library"),
}


def test_compiled_functions_take_nothing_from_outside_their_folder() -> None:
    """Copies with the same files share compiled code, so that nothing else may be compiled into it."""
    folder = Path(compilation.__file__).parent
    for file in folder.rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("apex_ompl"):
                inside = node.module.startswith("apex_ompl.kernel.compiled")
                assert inside or (file.stem, node.module) in OUTSIDE, file.name
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
