"""Which committed results were made by code older than what they measure.

A result is fresh when the commits that it names are clean and none of the paths that it depends on has changed since,
up to this work tree. Changes of Python files that leave the syntax tree as it was, but for docstrings, do not count.
The paths are those in the result, or else ``DEPENDS`` of the script that makes it. With ``--quoted README.md`` the
command fails where a result that the file links to is not fresh; that takes a clone with its history.

Usage: python -m benchmarks.lib.freshness [--quoted README.md]
"""

from __future__ import annotations

import ast
import json
import re
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from apex_ompl.util.entry_point import run_script
from benchmarks.lib import record

CHANGES = "+changes"
FIELDS = ("command", "date", "commit", "hardware", "python", "versions")
FRESH, STALE, UNKNOWN = "fresh", "stale", "unknown"
SHOWN = 4  # changed files that are named


@dataclass(frozen=True)
class Freshness:
    """Freshness of a result.

    Attributes:
        name: Name of the result.
        state: ``fresh``, ``stale``, or ``unknown`` where this clone has not the commit.
        reason: Reason where it is not fresh.
    """

    name: str
    state: str
    reason: str = ""


def normalized(source: str) -> str:
    """Return the syntax tree of a module as text, without docstrings and ``DEPENDS``.

    Raises:
        SyntaxError: It is no Python.
    """
    tree = ast.parse(source)
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if isinstance(body, list):
            node.body = [line for line in body if not _is_text(line)]  # type: ignore[attr-defined]
    return ast.dump(tree)


def _is_text(line: ast.AST) -> bool:
    if isinstance(line, ast.Expr):
        return isinstance(line.value, ast.Constant) and isinstance(line.value.value, str)
    return isinstance(line, ast.Assign) and [ast.unparse(target) for target in line.targets] == ["DEPENDS"]


def git(root: Path, *arguments: str) -> str:
    """Return what a git command prints.

    Raises:
        CalledProcessError: It fails.
    """
    return subprocess.run(["git", *arguments], cwd=root, capture_output=True, text=True, check=True).stdout


def changed(root: Path, commit: str, paths: Sequence[str]) -> list[str]:
    """Return the files under some paths whose content, or code, differs between a commit and the work tree.

    Raises:
        CalledProcessError: The repository has not the commit.
    """
    differing = git(root, "diff", "--name-only", "--no-renames", "-z", commit, "--", *paths).split("\0")
    added = git(root, "ls-files", "--others", "--exclude-standard", "-z", "--", *paths).split("\0")
    return [file for file in sorted({*differing, *added}) if file and not _same_code(root, commit, file)]


def _same_code(root: Path, commit: str, file: str) -> bool:
    if not file.endswith(".py") or not (root / file).is_file():
        return False
    try:
        return normalized(git(root, "show", f"{commit}:{file}")) == normalized((root / file).read_text())
    except (subprocess.CalledProcessError, SyntaxError):  # a new file, for one
        return False


def script_of(root: Path, result: Path, command: str) -> Path | None:
    """Return the script that makes a result: that of its name, or of its command."""
    named, module = re.search(r"\S+\.py", command), re.search(r"-m (\S+)", command)
    names = [f"{result.stem}.py", *([Path(named[0]).name] if named else [])]
    found = [script for name in names for script in sorted((root / "benchmarks").glob(f"*/{name}"))]
    found += [root / named[0]] if named else []
    found += [root / f"{module[1].replace('.', '/')}.py"] if module else []
    return next((script for script in found if script.is_file()), None)


def freshness(root: Path, result: Path) -> Freshness:
    """Return whether a result is fresh."""
    about = json.loads(result.read_text(encoding="utf-8"))["about"]
    depends = about.get("depends")
    if depends is None:
        script = script_of(root, result, about["command"])
        if script is None:
            return Freshness(result.stem, STALE, f"no script makes it any more; it was: {about['command']}")
        depends = record.dependencies(script, root)
    commits = dict.fromkeys([about["commit"], *about.get("run_commits", about["commit"]).split("; ")])
    for commit in commits:
        if commit == "unknown":
            return Freshness(result.stem, STALE, "the commit of some runs was not recorded")
        if commit.endswith(CHANGES):
            return Freshness(result.stem, STALE, f"made with uncommitted changes, {commit}")
        try:
            files = changed(root, commit, depends)
        except subprocess.CalledProcessError:
            return Freshness(result.stem, UNKNOWN, f"commit {commit} is not in this clone")
        if files:
            more = f" and {len(files) - SHOWN} more" if len(files) > SHOWN else ""
            return Freshness(result.stem, STALE, f"changed since {commit}: {', '.join(files[:SHOWN])}{more}")
    return Freshness(result.stem, FRESH)


def quoted(text: str) -> set[str]:
    """Return the names of results that a text links to."""
    return set(re.findall(r"benchmarks/results/(\w+)\.(?:md|json|png)", text))


def main() -> None:
    """Print the freshness of all results."""
    parser = record.parser(__doc__)
    parser.add_argument("--quoted", type=Path, metavar="FILE", help="fail where a result that it links to is not fresh")
    args = parser.parse_args()
    found = [freshness(record.ROOT, result) for result in sorted(record.RESULTS.glob("*.json"))]
    for one in found:
        print(f"{one.state:8}{one.name}{': ' if one.reason else ''}{one.reason}")
    if args.quoted is not None:
        names = quoted(args.quoted.read_text(encoding="utf-8"))
        missing = names - {one.name for one in found}
        failing = sorted(missing | {one.name for one in found if one.state != FRESH and one.name in names})
        if failing:
            sys.exit(f"{args.quoted} quotes results that are not fresh: {', '.join(failing)}")


if __name__ == "__main__":
    run_script(main)
