"""The library of compiled functions: it fits, it is checked before it is used, and numba is not needed where it is."""

from __future__ import annotations

import ast
import hashlib
import json
import os
import platform
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support import ROOT

from apex_ompl.kernel import library
from apex_ompl.kernel.compiled.check import motion_proof
from apex_ompl.kernel.compiled.entry_points import ALL
from apex_ompl.kernel.compiled.jit import CompiledFunction
from apex_ompl.kernel.compiled.network import dense_layer
from apex_ompl.kernel.compiled.timing import cubic_pieces, time_parameterization

MACHINES = sorted(file.stem.removeprefix("kernel-") for file in library.FOLDER.glob("*.json"))
IS_BUILT_HERE = pytest.mark.skipif(not library.is_used(), reason=library.why_not_used())


def run(code: str, root: Path = ROOT, **environment: str) -> subprocess.CompletedProcess[str]:
    env = os.environ | {"PYTHONPATH": str(root)} | environment
    env.pop(library.CHOICE, None)
    return subprocess.run(
        [sys.executable, "-c", code],
        check=False,
        cwd=root,
        env=env | environment,
        capture_output=True,
        text=True,
        timeout=300,
    )


@pytest.mark.parametrize("machine", MACHINES)
def test_the_library_is_built_from_the_sources(machine: str) -> None:
    file = library.library_file(machine)
    description = json.loads(file.with_suffix(".json").read_text())
    assert description["sources"] == library.sources_digest(), "run scripts/build_kernel.py"
    assert description["library"] == hashlib.sha256(file.read_bytes()).hexdigest()
    assert sorted(description["code"]) == sorted(ALL)


def test_all_functions_that_python_calls_are_listed_with_types_that_fit_their_annotations() -> None:
    kinds = {
        "Integers": "i8[",
        "Floats": "f8[",
        "Singles": "f4[",
        "Bytes": "i1[",
        "float": "f8",
        "int": "i8",
        "bool": "b1",
    }
    found = {}
    for path in library.SOURCES.rglob("*.py"):
        module = ".".join(path.relative_to(library.SOURCES).with_suffix("").parts)
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef) and any("entry_point" in ast.unparse(d) for d in node.decorator_list):
                found[f"{module}.{node.name}"] = [ast.unparse(a.annotation) for a in node.args.args if a.annotation]
    assert found.keys() == ALL.keys()
    for name, hints in found.items():
        text = re.sub(r"Tuple\(\((?:f8, )+i8\)\)", "Numbers", ALL[name][0]).replace("[:, ", "[")
        text = re.sub(r"Tuple\(\((f8(?:, f8)*)\)\)", lambda found: f"tuple[{found[1].count('f8')}", text)
        types = [one.strip() for one in text.replace(":, ", "").split(",") if one.strip()]
        for hint, one in zip(hints, types, strict=True):
            wanted = f"tuple[{hint.count('float')}" if hint.startswith("tuple[float") else kinds.get(hint, hint)
            assert one.startswith(wanted) if wanted.endswith("[") else one == wanted, (name, hint, one)


BLOCKED = """
import sys
sys.modules |= {"numba": None, "llvmlite": None}
import numpy as np
import apex_ompl
from apex_ompl.moving.settings import LoopSettings

robot = apex_ompl.load_robot("dual_panda_softhand")
assert apex_ompl.plan("shelf/hard/800000", timeout=30.0)
assert apex_ompl.plan("ball_in_cup", "rrtconnect+polish", timeout=30.0)
assert apex_ompl.plan("vertical/large/800000", timeout=30.0, params={"line": False})
apex_ompl.run("turning/vertical/large/800000", settings=LoopSettings(timeout=1.5))
points = np.random.default_rng(0).uniform(-1.0, 1.0, (1000, 3))
assert len(apex_ompl.filter_points(points, robot, robot.home)) < 1000
print("planned")
"""


@IS_BUILT_HERE
def test_nothing_needs_numba() -> None:
    done = run(BLOCKED)
    assert done.stdout == "planned\n", done.stderr


@IS_BUILT_HERE
def test_both_back_ends_give_the_same_bits() -> None:
    rng = np.random.default_rng(0)
    for rows in (1, 3, 5):
        given = rng.integers(-99, 99, (7, 21)).astype(np.int8), *rng.normal(size=(2, 7)).astype(np.float32)
        x = rng.normal(size=(rows, 21)).astype(np.float32)
        mine, other = np.empty((2, rows, 7), np.float32)
        dense_layer.dense_layer(*given, x, mine)
        compiled(dense_layer.dense_layer)(*given, x, other)
        assert np.array_equal(mine, other) and np.isfinite(mine).all()
    path, grids = rng.normal(size=(5, 16)), np.zeros((2, 4), np.int64)
    found = [f(path, 0.1, g) for f, g in zip(both(motion_proof.lay_grid), grids, strict=True)]
    assert found[0] == found[1] > 0 and type(found[0]) is type(found[1]) is int
    assert np.array_equal(*grids)
    times = np.linspace(0.0, 1.0, 5)
    knots = times, *rng.normal(size=(3, 5, 16))
    gaps = [f(*knots) for f in both(cubic_pieces.relative_gap)]
    assert gaps[0] == gaps[1] and type(gaps[0]) is type(gaps[1])


def both(function: Any) -> tuple[Any, Any]:
    return function, compiled(function)


def compiled(function: Any) -> Any:
    """Let numba compile what a function of the library was built from."""
    module, _, name = function.__name__.rpartition(".")
    source = sys.modules[f"{library.PACKAGE}.{module}"].__file__
    assert source is not None
    space: dict[str, Any] = {"__name__": f"copy_of_{module}"}
    exec(compile(Path(source).read_text(), source, "exec"), space)
    found: CompiledFunction = space[name]
    assert isinstance(found, CompiledFunction)
    return found


def doubles(*shape: int) -> np.ndarray:
    return np.zeros(shape)


WRONG = {
    "type": ((np.zeros(3, np.float32), 0.0, 1.0, doubles(4)), "argument 1 of .* contiguous, writable array of float64"),
    "axes": ((doubles(3, 1), 0.0, 1.0, doubles(4)), "argument 1 of .* with 1 axes"),
    "layout": ((doubles(6)[::2], 0.0, 1.0, doubles(4)), "argument 1 of "),
    "no array": (([0.0], 0.0, 1.0, doubles(4)), "argument 1 of "),
    "no number": ((doubles(3), "0", 1.0, doubles(4)), "must be real number, not str"),
    "few": ((doubles(3), 0.0, 1.0), "another number of arguments than 3"),
    "many": ((doubles(3), 0.0, 1.0, doubles(4), 0), "another number of arguments than 5"),
}


@IS_BUILT_HERE
@pytest.mark.parametrize("case", WRONG)
def test_other_arguments_are_refused(case: str) -> None:
    arguments, message = WRONG[case]
    with pytest.raises(TypeError, match=message):
        time_parameterization.sample_times(*arguments)


@IS_BUILT_HERE
def test_read_only_arrays_are_refused() -> None:
    out = doubles(4)
    out.flags.writeable = False
    with pytest.raises(TypeError, match="argument 4 of "):
        time_parameterization.sample_times(doubles(3), 0.0, 1.0, out)


@pytest.fixture
def copy(tmp_path: Path) -> Iterator[Path]:
    """A folder with a copy of the package."""
    shutil.copytree(ROOT / "apex_ompl", tmp_path / "apex_ompl", ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("planners", "problems"):
        if not (tmp_path / "apex_ompl" / name).exists():
            shutil.copytree(ROOT / name, tmp_path / "apex_ompl" / name)
    yield tmp_path


def cut_off(file: Path) -> None:
    file.write_bytes(file.read_bytes()[:4096])


def flip(file: Path) -> None:
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 1
    file.write_bytes(data)


def edit(file: Path) -> None:
    source = file.parents[1] / "compiled" / "check" / "motion_proof.py"
    source.write_text(source.read_text() + "\n# edited\n")


FAULTS = {
    "cut off": (cut_off, "is damaged"),
    "one bit": (flip, "is damaged"),
    "missing": (Path.unlink, "cannot be read (No such file or directory)"),
    "no description": (lambda file: file.with_suffix(".json").unlink(), "it was not built for linux on"),
    "edited source": (edit, "it was built from other sources than those in"),
}
SMALL = """
import numpy as np
from apex_ompl.kernel.library import why_not_used
from apex_ompl.kernel.compiled.check.motion_proof import lay_grid
print(lay_grid(np.ones((2, 3)), 0.1, np.zeros(1, np.int64)), why_not_used())
"""


@pytest.mark.skipif(platform.machine() not in MACHINES, reason="no library for this architecture")
@pytest.mark.parametrize("fault", FAULTS)
def test_a_library_that_does_not_fit_is_replaced_by_numba(copy: Path, fault: str) -> None:
    spoil, reason = FAULTS[fault]
    spoil(copy / library.library_file(platform.machine()).relative_to(ROOT))
    done = run(SMALL, copy, NUMBA_CACHE_DIR=str(copy))
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("1 ") and reason in done.stdout
    assert "apex_ompl compiles functions of its collision kernel" in done.stderr and reason in done.stderr


@pytest.mark.skipif(platform.machine() not in MACHINES, reason="no library for this architecture")
def test_a_broken_library_is_told_even_where_all_is_compiled_already(copy: Path) -> None:
    flip(copy / library.library_file(platform.machine()).relative_to(ROOT))
    run(SMALL, copy, NUMBA_CACHE_DIR=str(copy))
    again = run(SMALL, copy, NUMBA_CACHE_DIR=str(copy))
    assert again.stderr.count("\n") == 1 and "is damaged" in again.stderr


@IS_BUILT_HERE
def test_an_unknown_choice_is_named_and_ignored() -> None:
    done = run(SMALL, **{library.CHOICE: "nubma"})
    assert done.stdout == "1 \n" and "'nubma', expected library or numba" in done.stderr


def test_other_architectures_and_choices_are_compiled_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(library.CHOICE, "numba")
    with pytest.raises(library.LibraryError, match=r"^\$APEX_OMPL_KERNEL is numba$"):
        library._load()
    monkeypatch.delenv(library.CHOICE)
    monkeypatch.setattr(platform, "machine", lambda: "riscv64")
    with pytest.raises(library.LibraryError, match="^it was not built for linux on riscv64$"):
        library._load()


@pytest.mark.skipif(shutil.which("qemu-x86_64") is None, reason="needs qemu-user")
@pytest.mark.skipif(platform.machine() != "x86_64", reason="for x86-64")
def test_older_processors_are_recognized() -> None:
    """Those of level x86-64-v2, emulated."""
    code = "from apex_ompl.kernel.library import why_not_used; print(why_not_used())"
    env = os.environ | {"PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "1"}
    env.pop(library.CHOICE, None)
    command = ["qemu-x86_64", "-cpu", "Nehalem", sys.executable, "-S", "-c", code]
    env["PYTHONPATH"] = os.pathsep.join([str(ROOT), str(Path(np.__file__).parents[1])])
    done = subprocess.run(command, check=False, env=env, capture_output=True, text=True, timeout=300)
    assert "this processor is not of level x86-64-v3" in done.stdout, done.stderr
