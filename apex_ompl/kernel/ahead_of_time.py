"""Compilation of the functions that plans and runs need before the first of them, where the library is not used."""

from __future__ import annotations

from apex_ompl.kernel.compiled.entry_points import PLANS, RUNS, Group
from apex_ompl.kernel.library import is_used

_ready: set[str] = set()  # groups


def compile_for_plans() -> None:
    """Compile what plans need and neither the library nor the cache has, once in a process."""
    _compile(PLANS)


def compile_for_runs() -> None:
    """Compile what runs among dynamic obstacles need and neither the library nor the cache has, once in a process."""
    _compile(RUNS)


def _compile(group: Group) -> None:
    if is_used() or group.what in _ready:
        return
    from apex_ompl.kernel.group_compilation import compile_group

    compile_group(group)
    _ready.add(group.what)
