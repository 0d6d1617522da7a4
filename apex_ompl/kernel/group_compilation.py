"""Compilation by numba of the functions that plans and runs need, once for an installation, in several processes."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, nullcontext
from importlib import import_module
from typing import Any

from tqdm import tqdm

from apex_ompl.kernel.compiled.entry_points import ALL, Group
from apex_ompl.kernel.compiled.jit import CompiledFunction, cache_folder, can_keep_code, names_in_cache, whereabouts
from apex_ompl.kernel.library import why_not_used
from apex_ompl.util.cores import usable_cores
from apex_ompl.util.files import locked
from apex_ompl.util.interpreter import this_python

LOG = logging.getLogger("apex_ompl")

CHILD = "import sys; from apex_ompl.kernel.group_compilation import compile_named; compile_named(sys.argv[1:])"

_lock = threading.Lock()


def compile_group(group: Group) -> None:
    """Compile what is not in the cache yet; other processes and threads wait meanwhile.

    Where nothing can be kept in a cache, all of them are compiled in this process.
    """
    with _lock:
        folder, count = cache_folder(), max(2, len(usable_cores()))
        if not _missing(group.functions):
            return
        if folder is None or not can_keep_code():
            folder, count = None, 1
        with locked(folder, wait=True) if folder else nullcontext():
            shares = [left for share in group.shares(count) if (left := _missing(share))]
            if shares:
                seconds = group.seconds * (1 if folder else 2)
                LOG.warning(
                    "apex_ompl compiles %s (about %d s, %s), since the library that comes with it is not used: %s",
                    group.what, seconds, whereabouts(), why_not_used(),
                )  # fmt: skip
                started = time.perf_counter()
                _compile(group, shares)
                LOG.warning("apex_ompl compiled %s in %.1f s", group.what, time.perf_counter() - started)


def compile_named(names: Iterable[str]) -> None:
    """Compile functions into the cache, and print each one's name when it is there."""
    for name in names:
        _function(name).compile(ALL[name][0])
        print(name, flush=True)


def _compile(group: Group, shares: list[list[str]]) -> None:
    """Compile a share in this process, and the others in ones beside it; what these fail to is compiled here."""
    types = {name: one for name, (one, _) in group.functions.items()}
    seconds = {name: typical for name, (_, typical) in group.functions.items()}
    here, *others = shares
    style = "{desc} {percentage:3.0f} %|{bar}| {elapsed}"
    total = sum(seconds[name] for share in shares for name in share)
    with tqdm(total=total, desc="compiling", bar_format=style, disable=None) as bar:
        with ExitStack() as beside:
            for share in others:
                beside.enter_context(_beside(share, bar, seconds))
            for name in here:
                _function(name).compile(types[name])
                bar.update(seconds[name])
        for name in _missing(name for share in others for name in share):
            _function(name).compile(types[name])


@contextmanager
def _beside(names: list[str], bar: Any, seconds: Mapping[str, int]) -> Iterator[None]:
    """Let a process compile functions during a block, then wait for it; it ends with the block's exception."""
    command = [*this_python(), "-c", CHILD, *names]
    environment = {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    with subprocess.Popen(
        command, env=os.environ | environment, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    ) as child:

        def follow() -> None:
            for line in child.stdout or ():
                bar.update(seconds.get(line.strip(), 0))

        follower = threading.Thread(target=follow, daemon=True)
        follower.start()
        try:
            yield
            follower.join()
        finally:
            child.kill()


def _function(name: str) -> CompiledFunction:
    module, _, function = name.rpartition(".")
    found: CompiledFunction = getattr(import_module(f"apex_ompl.kernel.compiled.{module}"), function)
    return found


def _missing(names: Iterable[str]) -> list[str]:
    """Return those of some functions that are not in the cache."""
    there = names_in_cache()
    return [name for name in names if name.rpartition(".")[2] not in there]
