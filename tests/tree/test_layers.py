"""Packages of `apex_ompl` import downwards only, and nobody outside `kernel` imports `kernel.compiled`.

From the top, as CONTRIBUTING has it:

1. `cli` parses commands; `evaluation` runs OMPL's Benchmark and reports; `viz` draws: renderings, plots, the viewer;
   `ros2` is a node of ROS 2.
2. `api`: `load_problem`, `setup`, `plan`, `run`; `loop`: environment, sensor, executor and clocks; `loop.replan`:
   replanners; `physics`: tasks executed in physics, and judges.
3. `onboarding`: training of a new robot's model; `planning`: `MotionPlanner`, `World`, the steps of a plan; `result`:
   what a plan returns.
4. `planners/`, `problems/` (at the top of the tree): planners by name with their parameters; suites, worlds, frozen
   problems.
5. `baselines`: the rivals gpmp, damon, drrt, imitation and control; `training`: torch networks, data sets, their
   generation.
6. `apex`: the planner APEX, its parameters, the stages of `solve`, their context and report.
7. `moving`: dynamic obstacles in time and what replanners share; `ompl`: state space, validity checkers, set-up for
   OMPL; `drivers`: robots that follow motions; `perception`: cameras, and what they see.
8. `goals`: alignments, poses, grasps, inverse kinematics; `timing`: motions over time; `model`: inference without
   torch.
9. `constraints`: what holds along a path; `collision`: the checker, spheres before meshes; `paths`: splines, the
   optimizer; `robot`: Pinocchio models, MoveIt's files.
10. `kernel`: wrappers of compiled code over flat arrays; `scene`: problem files and bodies; `util`, `types`, `errors`.
"""

from __future__ import annotations

import ast
import re
from functools import cache
from pathlib import Path

import pytest
from support import ROOT

LAYERS = [
    {"errors", "types"},
    {"util"},
    {"scene"},
    {"kernel"},
    {"robot"},
    {"paths"},
    {"collision"},
    {"constraints"},
    {"goals", "timing", "model"},
    {"drivers"},
    {"perception"},
    {"ompl"},
    {"moving"},
    {"apex"},
    {"problems"},
    {"training"},
    {"baselines"},
    {"planners"},
    {"result"},
    {"planning"},
    {"onboarding"},
    {"loop", "physics"},
    {"api"},
    {"evaluation", "ros2", "viz"},
    {"cli"},
]
HEIGHT = {name: height for height, names in enumerate(LAYERS) for name in names}
FILES = sorted(p for p in (ROOT / "apex_ompl").rglob("*.py") if p.name != "__init__.py" or p.parent.name != "apex_ompl")


def package(path: Path) -> str:
    return path.relative_to(ROOT / "apex_ompl").parts[0].removesuffix(".py")


@cache
def statements(path: Path) -> tuple[ast.Import | ast.ImportFrom, ...]:
    """The import statements of a module, at the top or inside functions."""
    nodes = ast.walk(ast.parse(path.read_text()))
    return tuple(node for node in nodes if isinstance(node, ast.Import | ast.ImportFrom))


def imports(path: Path) -> set[str]:
    """Packages of apex_ompl that a module imports, at the top or inside functions."""
    found = set()
    for node in statements(path):
        if isinstance(node, ast.ImportFrom) and node.module:
            if node.module == "apex_ompl":
                found |= {alias.name for alias in node.names if alias.name in HEIGHT}
            elif node.module.startswith("apex_ompl."):
                found.add(node.module.split(".")[1])
        elif isinstance(node, ast.Import):
            found |= {a.name.split(".")[1] for a in node.names if a.name.startswith("apex_ompl.")}
    return found


def outside(path: Path) -> set[str]:
    found = set()
    for node in statements(path):
        if isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            found.add(node.module.split(".")[0])
        elif isinstance(node, ast.Import):
            found |= {a.name.split(".")[0] for a in node.names}
    return found


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(ROOT / "apex_ompl")))
def test_imports_go_down(path: Path) -> None:
    here = package(path)
    assert here in HEIGHT, f"{here} has no layer yet"
    for other in imports(path) - {here}:
        assert HEIGHT[other] < HEIGHT[here], f"{here} imports {other}"


def test_every_package_is_in_the_package_list() -> None:
    import tomllib

    listed = set(tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"])
    folders = {p.parent for p in (ROOT / "apex_ompl").rglob("__init__.py")}
    folders |= {ROOT / "apex_ompl" / name for name in ("planners", "problems")}
    assert listed == {".".join(f.relative_to(ROOT).parts) for f in folders}


def test_low_packages_know_no_ompl() -> None:
    for path in FILES:
        if HEIGHT[package(path)] < HEIGHT["ompl"]:
            assert "ompl" not in outside(path), path


def modules(path: Path) -> set[str]:
    """Modules that a file imports, at the top or inside functions, by their full names."""
    found = set()
    for node in statements(path):
        if isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
    return found


def test_nobody_outside_the_kernel_imports_compiled_code() -> None:
    """The wrappers in ``apex_ompl/kernel`` are the one hatch; the script that builds the library is beside it."""
    others = [
        path for folder in ("planners", "problems", "examples", "scripts") for path in (ROOT / folder).rglob("*.py")
    ]
    users = [path for path in FILES if package(path) != "kernel"] + [p for p in others if p.name != "build_kernel.py"]
    for path in users:
        inside = {name for name in modules(path) if f"{name}.".startswith("apex_ompl.kernel.compiled.")}
        assert not inside, f"{path.relative_to(ROOT)} imports {min(inside)}"


def test_contributing_has_the_same_ten_lines() -> None:
    text = (ROOT / "CONTRIBUTING.md").read_text().partition("## The house in ten lines")[2].partition("\n## ")[0]
    mine, theirs = (re.findall(r"^(\d+\. .*?)(?=^\d+\. |\n\n|\Z)", some, re.M | re.S) for some in (__doc__ or "", text))
    assert [one.split() for one in mine] == [one.split() for one in theirs] and len(mine) == 10
