"""Compilation of the functions that plans and runs need before the first of them, where the library is not used."""

from __future__ import annotations

from apex_ompl.kernel.compiled.entry_points import Group
from apex_ompl.kernel.library import is_used

_ready: set[str] = set()  # groups


def compile_ahead(group: Group) -> None:
    """Compile what is neither in the library nor in the cache, once in a process."""
    if is_used() or group.what in _ready:
        return
    from apex_ompl.kernel.group_compilation import compile_group

    compile_group(group)
    _ready.add(group.what)
