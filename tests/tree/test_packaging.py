"""Wheel and sdist, installed for real and used from a foreign folder."""

from __future__ import annotations

import os
import subprocess
import sys
import tarfile
import venv
import zipfile
from pathlib import Path

import pydantic
import pytest
from support import ROOT

USE = """
import apex_ompl, apex_ompl.planners, apex_ompl.problems, sys
assert 'site-packages' in apex_ompl.__file__, apex_ompl.__file__
for foreign in ('planners', 'problems'):
    try:
        __import__(foreign)
    except ImportError:
        pass
    else:
        raise SystemExit(foreign + ' must not exist after an install')
result = apex_ompl.plan('shelf_swap', timeout=30)
assert len(apex_ompl.problems.witness('shelf/hard/900012').path) > 2
print(result.status, apex_ompl.problems.names(), len(apex_ompl.planners.names()))
"""


def run(*command: object, cwd: Path) -> str:
    done = subprocess.run([str(c) for c in command], check=False, capture_output=True, text=True, cwd=cwd, timeout=600)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An sdist, and a wheel built from the sdist, with the build tools of this environment."""
    out = tmp_path_factory.mktemp("dist")
    run(sys.executable, "-m", "build", "--no-isolation", "--outdir", out, ROOT, cwd=out)
    return out


def files_of(folder: Path, name: str) -> list[str]:
    """All files of a folder of the tree, code and data alike, with the names that they have in the package."""
    files = (path.relative_to(folder) for path in folder.rglob("*") if path.is_file())
    return [f"{name}/{file}" for file in files if file.suffix != ".pyc" and not file.name.startswith(".")]


def test_the_wheel_holds_every_file_of_the_package_and_no_other(built: Path) -> None:
    """What the package reads beside its code must not be missing, such as a table: tests in the tree would not tell."""
    (wheel,) = built.glob("*.whl")
    packed = [name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name]
    parts = ((ROOT / part, f"apex_ompl/{part}") for part in ("planners", "problems"))
    wanted = [file for folder, name in ((ROOT / "apex_ompl", "apex_ompl"), *parts) for file in files_of(folder, name)]
    assert "apex_ompl/moving/costs.json" in wanted and "apex_ompl/problems/frozen/SHA256SUMS" in wanted
    assert sorted(packed) == sorted(wanted)


def test_the_sdist_holds_what_is_needed(built: Path) -> None:
    (sdist,) = built.glob("*.tar.gz")
    packed = {name.partition("/")[2] for name in tarfile.open(sdist).getnames()}
    for wanted in (
        "constraints.txt", "README.md", "CONTRIBUTING.md", "LICENSE", "docs/planning.md", "planners/registry.py",
        "tests/tree/test_packaging.py", "tests/data/dual_panda_softhand/paths.zip",
    ):  # fmt: skip
        assert wanted in packed, wanted
    assert not any(name.startswith(("data/", "benchmarks/runs/")) for name in packed)
    assert sdist.stat().st_size < 48 * 2**20


def test_the_wheel_works_from_a_foreign_folder(built: Path, tmp_path: Path) -> None:
    """A new environment that sees this one's libraries, with the wheel installed on its own."""
    (wheel,) = built.glob("*.whl")
    venv.create(tmp_path / "venv", with_pip=False, symlinks=True)
    python = tmp_path / "venv" / "bin" / "python"
    site = Path(run(python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))", cwd=tmp_path).strip())
    run(sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--target", site, wheel, cwd=tmp_path)
    libraries = Path(pydantic.__file__).parent.parent
    (site / "libraries.pth").write_text(f"import site; site.addsitedir({str(libraries)!r})\n")
    printed = run(python, "-c", USE, cwd=tmp_path)
    assert printed.startswith("EXACT_SOLUTION") and "shelf_swap" in printed


def test_this_tree_works_from_a_foreign_folder(tmp_path: Path) -> None:
    code = "import apex_ompl.planners, apex_ompl.problems; print(apex_ompl.problems.names())"
    assert "shelf_swap" in run(sys.executable, "-c", code, cwd=tmp_path)


def test_the_calls_of_an_installed_package_are_not_made_of_a_clone(tmp_path: Path) -> None:
    """Where nothing would be missing; .ci/run makes them of the wheel."""
    done = subprocess.run(
        [sys.executable, ROOT / "tests" / "installed"], check=False, capture_output=True, text=True, cwd=tmp_path,
        timeout=60, env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert done.returncode == 1 and "is the clone, expected an installed package" in done.stderr
