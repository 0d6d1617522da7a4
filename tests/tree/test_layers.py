"""The one way down: no module imports from a layer above its own."""

from __future__ import annotations

import ast
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
    {"goals", "timing", "model"},
    {"ompl"},
    {"moving"},
    {"apex"},
    {"problems"},
    {"training"},
    {"baselines"},
    {"planners"},
    {"result"},
    {"planning"},
    {"loop"},
    {"api"},
    {"evaluation", "viz"},
    {"cli"},
]
HEIGHT = {name: height for height, names in enumerate(LAYERS) for name in names}
FILES = sorted(p for p in (ROOT / "apex_ompl").rglob("*.py") if p.name != "__init__.py" or p.parent.name != "apex_ompl")


def package(path: Path) -> str:
    return path.relative_to(ROOT / "apex_ompl").parts[0].removesuffix(".py")


def imports(path: Path) -> set[str]:
    """Packages of apex_ompl that a module imports, at the top or inside functions."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
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
    for node in ast.walk(ast.parse(path.read_text())):
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
    folders |= {ROOT / "apex_ompl" / name for name in ("planners", "problems", "problems/broad")}
    assert listed == {".".join(f.relative_to(ROOT).parts) for f in folders}


def test_low_packages_know_no_ompl() -> None:
    for path in FILES:
        if HEIGHT[package(path)] < HEIGHT["ompl"]:
            assert "ompl" not in outside(path), path
