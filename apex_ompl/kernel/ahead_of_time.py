"""Compilation of the functions that plans and runs need, once for an installation, in several processes.

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
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from importlib import import_module
from typing import Any

from tqdm import tqdm

from apex_ompl.kernel.compiled.compilation import CompiledFunction, cache_folder, names_in_cache
from apex_ompl.util.files import locked

LOG = logging.getLogger("apex_ompl")

ROBOT = "i8[::1], f8[::1], "
WORKSPACE = BUFFERS = ROBOT
SCENE = MOVERS = ROBOT + "f4[::1], "
TREES = "f8[:, ::1], f8, f8, f8[:, :, ::1], i8[:, ::1], i8[::1], i8[::1], f8[::1], f8[::1], "
PROOF = "f8[:, ::1], i8[::1], i8[:, ::1], i8[::1], f8[::1], i8[:, ::1], i8[::1]"
CURVE = "f8[::1], f8[:, ::1], f8[:, ::1], f8, f8, f8, i8"
KNOTS = "f8[::1], f8[:, ::1], f8[:, ::1], f8[:, ::1]"
SETTINGS = "Tuple((f8, f8, f8, f8, f8, f8, i8))"

Functions = Mapping[str, tuple[str, int]]
"""Functions: module and name -> types of the arguments, and typical time to compile [s]."""


@dataclass(frozen=True, eq=False)
class Group:
    """Functions that are needed together.

    Attributes:
        what: What they are.
        seconds: Typical time to compile them by two processes [s].
        parts: Those that one process compiles, as what they call is the same: as many processes as there are parts, or
            fewer that take several parts in turn.
    """

    what: str
    seconds: int
    parts: tuple[Functions, ...]

    @property
    def functions(self) -> Functions:
        """All of them."""
        return {name: one for part in self.parts for name, one in part.items()}

    def shares(self, count: int) -> list[list[str]]:
        """Return names of functions for at most ``count`` processes, the parts in their order."""
        many = min(count, len(self.parts))
        found: list[list[str]] = [[] for _ in range(many)]
        for k, part in enumerate(self.parts):
            found[k * many // len(self.parts)] += part
        return found


PLANS = Group(
    "its collision kernel",
    60,
    (
        {
            "motion_proof.prove_path": (ROBOT + SCENE + WORKSPACE + PROOF, 8),
            "tree_search.grow_trees": (ROBOT + SCENE + WORKSPACE + TREES + PROOF, 6),
            "shortcutting.shortcut_path": (
                ROBOT + SCENE + WORKSPACE + "f8[:, ::1], f8, f8[:, ::1], i8[::1], " + PROOF,
                6,
            ),
        },
        {
            "queries.check_states": (ROBOT + SCENE + WORKSPACE + "f8[:, ::1], i8[:, :, ::1], i8[::1]", 2),
            "queries.clearances": (ROBOT + SCENE + WORKSPACE + "f8[:, ::1], f8, f8[:, ::1], f8[:, :, ::1]", 6),
            "path_optimization.optimize_path": (
                ROBOT
                + SCENE
                + WORKSPACE
                + f"f8[:, ::1], i8[::1], f8[:, ::1], i8, f8[:, ::1], {SETTINGS}, i8[::1], f8[::1]",
                8,
            ),
        },
        {
            "curve_proof.prove_curve": (ROBOT + SCENE + ROBOT + "i8[::1], " + 3 * ROBOT + CURVE, 18),
        },
        {
            "queries.joint_frames": (ROBOT + WORKSPACE + "f8[:, ::1], f8[:, :, :, ::1], f8[:, :, ::1]", 2),
            "ball_tree.median_order": ("f8[:, ::1], i8[::1], i8[:, ::1]", 1),
            "ball_tree.node_balls": ("f8[:, :, ::1], i8[::1], i8[::1], f8[:, ::1], f8[:, ::1]", 1),
            "motion_proof.lay_grid": ("f8[:, ::1], f8, i8[::1]", 1),
            "jerk_profiles.join_profiles": (
                "f8[:, :, ::1], f8[:, :, ::1], i8[::1], f8[:, :, ::1], i8[:, :, ::1], f8[:, :, :, ::1], i8[::1], "
                "f8[::1], f8[:, :, ::1]",
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
            "ball_groups.group_clearances": (
                SCENE + "i8[::1], f8[:, :, ::1], f8[:, :, :, ::1], f8, f8[:, ::1], f8[::1]",
                2,
            ),
            "joint_push.joint_pushes": (
                ROBOT
                + "f8[:, :, :, ::1], f8[:, :, ::1], i8[::1], f8[:, :, ::1], f8[:, ::1], f8[:, :, ::1], f8, f8[:, ::1]",
                1,
            ),
            "dense_layer.dense_layer": ("i1[:, ::1], f4[::1], f4[::1], f4[:, ::1], f4[:, ::1]", 1),
        },
    ),
)
"""What every plan needs."""

RUNS = Group(
    "what runs among moving obstacles need",
    50,
    (
        {
            "motion_optimization.optimize_motion": (
                ROBOT
                + SCENE
                + MOVERS
                + WORKSPACE
                + f"f8[:, ::1], f8[:, ::1], i8[::1], f8[:, ::1], f8[::1], f8[:, ::1], f8, i8, f8[:, ::1], {SETTINGS}, "
                "i8[::1], f8[::1], f8[::1]",
                28,
            ),
        },
        {
            "movers.clearances_in_time": (
                ROBOT + MOVERS + WORKSPACE + "f8[:, ::1], f8[::1], f8, f8[:, ::1], f8[::1], f8[:, ::1]",
                6,
            ),
            "movers.first_conflict": (
                ROBOT
                + MOVERS
                + WORKSPACE
                + "f8[::1], f8[:, ::1], f8[:, ::1], f8, f8, f8, f8, f8, f8[:, ::1], f8[::1], "
                "i8[::1]",
                10,
            ),
        },
        {
            "blocked_intervals.blocked_intervals": (
                ROBOT + MOVERS + WORKSPACE + "f8[::1], f8[:, ::1], f8[:, ::1], f8, f8[:, ::1], f8, f8, f8[::1], "
                "f8[:, :, ::1], i8[::1]",
                12,
            ),
            "stops_among_movers.first_unproved_stop": (
                ROBOT
                + MOVERS
                + WORKSPACE
                + "f8[:, ::1], f8[:, ::1], f8[::1], f8, f8[::1], f8[:, ::1], f8[:, ::1], f8, "
                "f8[:, :, ::1], " + 5 * "f8[::1], " + "f8, f8[::1], i8[::1], f8, f8, f8, f8[:, ::1], f8[::1], i8[::1], "
                "f8[:, ::1], f8[:, ::1], f8[::1], f8[::1], f8[:, :, ::1], f8[::1], f8[:, :, ::1], f8[:, ::1], "
                "f8[:, ::1]",
                10,
            ),
        },
        {
            "speed_search.earliest_arrivals": (
                "f8[:, :, ::1], i8[::1], f8[:, :, ::1], i8[::1], f8[:, ::1], f8[:, ::1], f8[::1], f8, i8, b1, i8, f8, "
                "f8, f8, f8[:, :, :, ::1], i8[:, ::1], f8[:, :, ::1], i8[::1], f8[:, ::1], f8[::1], i8[::1], "
                "f8[:, ::1]",
                4,
            ),
            "speed_profile.push_bounds": (
                "f8[:, :, ::1], f8[::1], f8[::1], f8[::1], f8, f8, f8[::1], f8[:, ::1], f8[:, ::1]",
                1,
            ),
            "speed_profile.profile_places": ("f8[::1], f8, f8, i8[::1], f8[:, ::1], f8, f8, f8[::1]", 1),
            "speed_profile.follow_profile": (
                "f8[::1], f8[:, :, ::1], f8, f8[::1], f8, "
                + 5 * "f8[::1], "
                + "f8[:, ::1], f8[:, ::1], f8[::1], f8[::1], "
                "f8[:, :, ::1]",
                3,
            ),
            "speed_profile.first_blocked": (
                "f8[:, ::1], f8[:, :, ::1], i8[::1], f8[::1], f8[:, :, ::1], i8[::1], f8[::1], f8, f8",
                1,
            ),
            "path_stop.stop_on_path": (
                "f8[::1], f8[:, :, ::1], f8, f8[:, ::1], "
                + 5 * "f8[::1], "
                + "f8, f8[:, ::1], f8[::1], f8[::1], f8[::1], "
                "f8[:, :, ::1]",
                4,
            ),
            "stop_profiles.stop_joints": (
                7 * "f8[::1], " + "f8[:, ::1], f8[:, ::1], f8[::1], f8[:, :, ::1], f8[::1]",
                3,
            ),
        },
    ),
)
"""What a run of the closed loop needs besides."""

CHILD = "import sys; from apex_ompl.kernel.ahead_of_time import compile_named; compile_named(sys.argv[1:])"

_lock = threading.Lock()
_ready: set[str] = set()  # groups


def compile_ahead(group: Group) -> None:
    """Compile what is not in the cache yet, once in a process; other processes and threads wait meanwhile.

    Where no cache can be written, each function is compiled when it is first called.
    """
    if group.what not in _ready:
        _compile_missing(group)
        _ready.add(group.what)


def _compile_missing(group: Group) -> None:
    with _lock:
        folder = cache_folder()
        if folder is None or not _missing(group.functions):
            return
        with locked(folder, wait=True):
            shares = [left for share in group.shares(_cores()) if (left := _missing(share))]
            if shares:
                LOG.warning("apex_ompl compiles %s (about %d s, kept in %s)", group.what, group.seconds, folder)
                started = time.perf_counter()
                _compile(group, shares)
                LOG.warning("apex_ompl compiled %s in %.1f s", group.what, time.perf_counter() - started)


def _cores() -> int:
    """Return how many processes may compile: one for each core that there is for this one, and two at least."""
    affinity = getattr(os, "sched_getaffinity", None)
    return max(2, len(affinity(0)) if affinity else os.cpu_count() or 1)


def compile_named(names: Iterable[str]) -> None:
    """Compile functions into the cache, and print each one's name when it is there."""
    functions = {**PLANS.functions, **RUNS.functions}
    for name in names:
        _function(name).compile(functions[name][0])
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
