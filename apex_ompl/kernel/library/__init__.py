"""The kernel's compiled functions, built ahead of time into one library for each architecture, and checked when loaded.

``scripts/build_kernel.py`` builds the library from the code that numba makes of :mod:`apex_ompl.kernel.compiled`, for
processors of level x86-64-v3 (AVX2 and FMA, since 2013) and for 64-bit ARM, and a description beside it names their
sources. Where it does not fit, because the sources were edited, or the processor or the system is another one, or the
file is damaged, numba compiles the functions when they are needed. ``$APEX_OMPL_KERNEL`` may ask for ``numba``.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import platform
import sys
import sysconfig
from collections.abc import Callable, Mapping
from functools import cache
from importlib.machinery import ExtensionFileLoader, ModuleSpec
from pathlib import Path
from typing import Any

from apex_ompl.kernel.compiled.entry_points import CONSTRAINED, PLANS, RUNS, Group

LOG = logging.getLogger("apex_ompl")

FOLDER = Path(__file__).parent
SOURCES = FOLDER.parent / "compiled"
PACKAGE = "apex_ompl.kernel.compiled"
CHOICE = "APEX_OMPL_KERNEL"


class LibraryError(Exception):
    """The library does not fit this machine; the message says why, as the end of a sentence."""


class BrokenLibraryError(LibraryError):
    """The library is for this machine, and cannot be used all the same."""


def sources_digest() -> str:
    """Return a digest of all files of the kernel's compiled functions."""
    digest = hashlib.sha256()
    for path in sorted(SOURCES.rglob("*.py")):
        name = path.relative_to(SOURCES).as_posix()
        digest.update(f"{name} {path.stat().st_size}\n".encode() + path.read_bytes())
    return digest.hexdigest()


def library_file(machine: str) -> Path:
    """Return the library of an architecture, as :func:`platform.machine` calls it; its description ends in .json.

    Tools that import all modules of a package would take it for one if its name ended in .so.
    """
    return FOLDER / f"kernel-{machine}.elf"


def built_function(function: Callable[..., Any]) -> Callable[..., Any] | None:
    """Return a function of :mod:`apex_ompl.kernel.compiled` as the library has it, or None where it does not fit."""
    if not function.__module__.startswith(f"{PACKAGE}."):
        return None
    functions, _ = _found()
    return functions.get(f"{function.__module__.removeprefix(f'{PACKAGE}.')}.{function.__name__}")


def is_used() -> bool:
    """Whether the functions are those of the library."""
    return not why_not_used()


def why_not_used() -> str:
    """Return why the library is not used, as the end of a sentence, or nothing if it is."""
    return _found()[1]


@cache
def _found() -> tuple[Mapping[str, Callable[..., Any]], str]:
    try:
        return _load(), ""
    except LibraryError as error:
        level = logging.WARNING if isinstance(error, BrokenLibraryError) else logging.INFO
        LOG.log(level, "apex_ompl compiles its kernel by numba where its cache has no code, since %s", error)
        return {}, str(error)


def _load() -> Mapping[str, Callable[..., Any]]:
    """Return the library's functions, by module and name; raise LibraryError where it does not fit."""
    choice = os.environ.get(CHOICE, "library")
    if choice == "numba":
        raise LibraryError(f"${CHOICE} is {choice}")
    if choice != "library":
        LOG.warning("$%s is %r, expected library or numba: it is ignored", CHOICE, choice)
    machine = platform.machine()
    file = library_file(machine)
    try:
        description = json.loads(file.with_suffix(".json").read_text())
    except (OSError, ValueError):
        raise LibraryError(f"it was not built for {sys.platform} on {machine}") from None
    if sys.platform != "linux" or sysconfig.get_config_var("Py_GIL_DISABLED"):
        raise LibraryError(f"it was not built for this Python on {sys.platform}")
    if description["sources"] != sources_digest():
        raise LibraryError(f"it was built from other sources than those in {SOURCES}")
    try:
        is_whole = hashlib.sha256(file.read_bytes()).hexdigest() == description["library"]
    except OSError as error:
        raise BrokenLibraryError(f"{file} cannot be read ({error.strerror})") from None
    if not is_whole:
        raise BrokenLibraryError(f"{file} is damaged")
    loader = ExtensionFileLoader("_kernel", str(file))
    try:
        module = loader.create_module(ModuleSpec("_kernel", loader, origin=str(file)))
        loader.exec_module(module)
    except ImportError as error:
        raise BrokenLibraryError(f"{file} cannot be loaded ({error})") from None
    if not module.supported:
        raise LibraryError(f"this processor is not of level {description['processor']}")
    functions: Mapping[str, Callable[..., Any]] = module.functions
    return functions


_ready: set[str] = set()  # groups


def compile_for_plans() -> None:
    """Compile what plans need and neither the library nor the cache has, once in a process."""
    _compile(PLANS)


def compile_for_runs() -> None:
    """Compile what runs among dynamic obstacles need and neither the library nor the cache has, once in a process."""
    _compile(RUNS)


def compile_for_constraints() -> None:
    """Compile what plans under constraints need and neither the library nor the cache has, once in a process."""
    _compile(CONSTRAINED)


def _compile(group: Group) -> None:
    if is_used() or group.what in _ready:
        return
    from apex_ompl.kernel.group_compilation import compile_group

    compile_group(group)
    _ready.add(group.what)
