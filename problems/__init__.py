"""Ready-made problems, by name."""

from __future__ import annotations

from pathlib import Path

if not __name__.startswith("apex_ompl."):  # the folder also lies at the top of the source tree
    raise ImportError("import apex_ompl.problems, not problems")

from apex_ompl.errors import UnknownNameError
from apex_ompl.problem import Problem

DATA = Path(__file__).parent / "data"


def names() -> tuple[str, ...]:
    """Names of the ready-made problems."""
    return tuple(sorted(path.stem for path in DATA.glob("*.yaml")))


def load(name: str) -> Problem:
    """Return a ready-made problem.

    Raises:
        UnknownNameError: No such problem; the message lists the known ones.
    """
    if name not in names():
        raise UnknownNameError("problem", name, names())
    return Problem.load(DATA / f"{name}.yaml")


__all__ = ["load", "names"]
