"""What is imported when: the package, the help of the command line and ``MotionPlanner`` need no large library."""

from __future__ import annotations

import ast
import importlib
import subprocess
import sys
from pathlib import Path

import pytest

import apex_ompl
from apex_ompl.util.lazy import lazy_names

LARGE = (
    "coal",
    "llvmlite",
    "matplotlib",
    "numba",
    "ompl",
    "pinocchio",
    "pydantic",
    "scipy",
    "torch",
    "trimesh",
    "yaml",
)
PACKAGES = ("apex", "loop", "model", "moving", "ompl", "paths", "planning", "scene", "training", "viz")
HELP = "import sys; from apex_ompl.cli import main\ntry: main(['{}'])\nexcept SystemExit: pass\n"


def loaded(code: str, names: tuple[str, ...]) -> list[str]:
    """Return which modules a process has loaded after some code."""
    code += f"\nimport sys; print([name for name in {names} if name in sys.modules], file=sys.stderr)"
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True, timeout=120)
    found: list[str] = eval(done.stderr.splitlines()[-1])
    return found


@pytest.mark.parametrize(
    ("code", "more"),
    [
        ("import apex_ompl", ("numpy",)),
        ("import apex_ompl; dir(apex_ompl)", ("numpy",)),
        (HELP.format("--help"), ("numpy", "importlib.metadata", "multiprocessing")),
        (HELP.format("--version"), ("numpy", "importlib.metadata", "multiprocessing")),
        ("from apex_ompl import MotionPlanner", ("asyncio", "importlib.metadata", "multiprocessing", "numpy.ma")),
    ],
    ids=["package", "dir", "help", "version", "planner"],
)
def test_no_large_library_is_imported_before_it_is_needed(code: str, more: tuple[str, ...]) -> None:
    assert loaded(code, (*LARGE, *more)) == []


def test_a_plan_imports_neither_torch_nor_other_planners() -> None:
    code = "import apex_ompl; assert apex_ompl.plan('ball_in_cup', timeout=30.0)"
    others = (
        "apex_ompl.planners.sampling",
        "apex_ompl.problems.catalogue",
        "apex_ompl.planning.among_dynamic_obstacles",
    )
    assert loaded(code, ("matplotlib", "torch", "trimesh", *others)) == []


@pytest.mark.parametrize("package", ["apex_ompl", *(f"apex_ompl.{name}" for name in PACKAGES)])
def test_public_names_are_those_of_their_modules(package: str) -> None:
    module = importlib.import_module(package)
    assert set(module.__all__) <= set(dir(module))
    given: dict[str, object] = {}
    exec(f"from {package} import *", given)
    for name in module.__all__:
        assert given[name] is getattr(module, name)
    with pytest.raises(AttributeError, match=f"module '{package}' has no attribute 'plans'"):
        module.plans  # noqa: B018


@pytest.mark.parametrize("package", ["apex_ompl", *(f"apex_ompl.{name}" for name in PACKAGES)])
def test_type_checkers_see_the_public_names(package: str) -> None:
    module = importlib.import_module(package)
    body = ast.parse(Path(str(module.__file__)).read_text()).body
    imports = [
        line for block in body if isinstance(block, ast.If) for line in block.body if isinstance(line, ast.ImportFrom)
    ]
    seen = [(str(line.module), name.name, name.asname) for line in imports for name in line.names]
    assert sorted(name for _, name, _ in seen) == module.__all__
    for home, name, alias in seen:
        assert alias == name and getattr(importlib.import_module(home), name) is getattr(module, name)


@pytest.mark.parametrize("package", PACKAGES)
def test_packages_cost_nothing_before_a_name_of_theirs_is_used(package: str) -> None:
    assert loaded(f"import apex_ompl.{package}; dir(apex_ompl.{package})", (*LARGE, "numpy")) == []


def test_the_planner_says_what_its_types_are() -> None:
    """Its methods name types of modules that are imported later."""
    from apex_ompl.planning import planner, pool

    assert apex_ompl.MotionPlanner is planner.MotionPlanner and callable(pool.kept_planner)
    _, get, _ = lazy_names("apex_ompl.planning", {"world": "World"})
    assert get("World").__module__ == "apex_ompl.planning.world"
