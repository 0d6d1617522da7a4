"""Compilation of the functions that every plan needs, once for an installation, in two processes with a progress bar.

What they are compiled for is said here, as numba writes types: ``f8[:, ::1]`` is an array of shape (N, M).
"""

from __future__ import annotations

import logging
import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from importlib import import_module
from typing import Any

from tqdm import tqdm

from apex_ompl.kernel.compiled.compilation import CompiledFunction, cache_folder, names_in_cache
from apex_ompl.util.files import locked

LOG = logging.getLogger("apex_ompl")
TYPICAL_SECONDS = 60

ROBOT = "i8[::1], f8[::1], "
WORKSPACE = BUFFERS = ROBOT
SCENE = ROBOT + "f4[::1], "
TREES = "f8[:, ::1], f8, f8, f8[:, :, ::1], i8[:, ::1], i8[::1], i8[::1], f8[::1], f8[::1], "
PROOF = "f8[:, ::1], i8[::1], i8[:, ::1], i8[::1], f8[::1], i8[:, ::1], i8[::1]"
CURVE = "f8[::1], f8[:, ::1], f8[:, ::1], f8, f8, f8, i8"
KNOTS = "f8[::1], f8[:, ::1], f8[:, ::1], f8[:, ::1]"
SETTINGS = "Tuple((f8, f8, f8, f8, f8, f8, i8))"

HERE: dict[str, tuple[str, int]] = {
    "motion_proof.prove_path": (ROBOT + SCENE + WORKSPACE + PROOF, 8),
    "tree_search.grow_trees": (ROBOT + SCENE + WORKSPACE + TREES + PROOF, 6),
    "shortcutting.shortcut_path": (ROBOT + SCENE + WORKSPACE + "f8[:, ::1], f8, f8[:, ::1], i8[::1], " + PROOF, 6),
    "queries.check_states": (ROBOT + SCENE + WORKSPACE + "f8[:, ::1], i8[:, :, ::1], i8[::1]", 2),
    "queries.clearances": (ROBOT + SCENE + WORKSPACE + "f8[:, ::1], f8, f8[:, ::1], f8[:, :, ::1]", 6),
    "path_optimization.optimize_path": (
        ROBOT + SCENE + WORKSPACE + f"f8[:, ::1], i8[::1], f8[:, ::1], i8, f8[:, ::1], {SETTINGS}, i8[::1], f8[::1]",
        8,
    ),
}
"""Functions that this process compiles: module and name -> types of the arguments, and typical time [s]."""

BESIDE: dict[str, tuple[str, int]] = {
    "curve_proof.prove_curve": (ROBOT + SCENE + ROBOT + "i8[::1], " + 3 * ROBOT + CURVE, 18),
    "queries.joint_frames": (ROBOT + WORKSPACE + "f8[:, ::1], f8[:, :, :, ::1], f8[:, :, ::1]", 2),
    "ball_tree.median_order": ("f8[:, ::1], i8[::1], i8[:, ::1]", 1),
    "ball_tree.node_balls": ("f8[:, :, ::1], i8[::1], i8[::1], f8[:, ::1], f8[:, ::1]", 1),
    "motion_proof.lay_grid": ("f8[:, ::1], f8, i8[::1]", 1),
    "jerk_profiles.join_profiles": (
        "f8[:, :, ::1], f8[:, :, ::1], i8[::1], f8[:, :, ::1], i8[:, :, ::1], f8[:, :, :, ::1], i8[::1], f8[::1], "
        "f8[:, :, ::1]",
        2,
    ),
    "cubic_pieces.sample_motion": (KNOTS + ", f8[::1], i8, f8[:, :, ::1]", 1),
    "cubic_pieces.motion_extremes": (KNOTS + ", f8[:, ::1]", 1),
    "cubic_pieces.relative_gap": (KNOTS, 1),
    "cubic_pieces.cubic_rates": (KNOTS + ", f8[:, ::1]", 1),
    "polyline_distance.max_distance": ("f8[:, ::1], f8[::1], f8[:, ::1], f8[::1], f8", 1),
    "time_parameterization.max_path_speeds": ("f8[:, ::1], f8[:, ::1], f8[::1], f8[::1], f8, f8[::1]", 1),
    "time_parameterization.sample_times": ("f8[::1], f8, f8, f8[::1]", 1),
    "point_distance.nearest_points": (SCENE + "i8[::1], f8[:, ::1], f8, f8[::1], f8[:, ::1]", 2),
    "point_distance.group_clearances": (SCENE + "i8[::1], f8[:, :, :, ::1], f8, f8[::1]", 1),
    "joint_push.joint_pushes": (
        ROBOT + "f8[:, :, :, ::1], f8[:, :, ::1], i8[::1], f8[:, :, ::1], f8[:, ::1], f8[:, :, ::1], f8, f8[:, ::1]",
        1,
    ),
    "dense_layer.dense_layer": ("i1[:, ::1], f4[::1], f4[::1], f4[:, ::1], f4[:, ::1]", 1),
}
"""Functions that a second process compiles at the same time."""

CHILD = "import sys; from apex_ompl.kernel.ahead_of_time import compile_named; compile_named(sys.argv[1:])"

_lock, _ready = threading.Lock(), threading.Event()


def compile_ahead() -> None:
    """Compile what is not in the cache yet, once in a process; other processes and threads wait meanwhile.

    Where no cache can be written, each function is compiled when it is first called.
    """
    if not _ready.is_set():
        _compile_missing()
        _ready.set()


def _compile_missing() -> None:
    with _lock:
        folder = cache_folder()
        if folder is None or not _missing(HERE | BESIDE):
            return
        with locked(folder, wait=True):
            here, beside = map(_missing, (HERE, BESIDE))
            if here or beside:
                LOG.warning("apex_ompl compiles its collision kernel (about %d s, kept in %s)", TYPICAL_SECONDS, folder)
                started = time.perf_counter()
                _compile(here, beside)
                LOG.warning("apex_ompl compiled its collision kernel in %.1f s", time.perf_counter() - started)


def compile_named(names: Iterable[str]) -> None:
    """Compile functions into the cache, and print each one's name when it is there."""
    for name in names:
        _function(name).compile((HERE | BESIDE)[name][0])
        print(name, flush=True)


def _compile(here: list[str], beside: list[str]) -> None:
    """Compile functions in this process, and others in one beside it; what that one fails to is compiled here."""
    seconds = {name: typical for name, (_, typical) in (HERE | BESIDE).items()}
    total = sum(seconds[name] for name in (*here, *beside))
    style = "{desc} {percentage:3.0f} %|{bar}| {elapsed}"
    with tqdm(total=total, desc="compiling", bar_format=style, disable=None) as bar:
        with _beside(beside, bar, seconds):
            for name in here:
                _function(name).compile(HERE[name][0])
                bar.update(seconds[name])
        for name in _missing(beside):
            _function(name).compile(BESIDE[name][0])


@contextmanager
def _beside(names: list[str], bar: Any, seconds: Mapping[str, int]) -> Iterator[None]:
    """Let a process compile functions during a block, and wait for it behind; it ends with the block's exception."""
    command = [sys.executable, "-c", CHILD, *names]
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
    module, function = name.split(".")
    found: CompiledFunction = getattr(import_module(f"apex_ompl.kernel.compiled.{module}"), function)
    return found


def _missing(names: Iterable[str]) -> list[str]:
    """Return those of some functions that are not in the cache."""
    there = names_in_cache()
    return [name for name in names if name.split(".")[1] not in there]
