"""Accounting of first-path times, the same for every benchmark."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence

from apex_ompl.collision import CollisionChecker
from apex_ompl.ompl.validity import full_check
from apex_ompl.types import Array

PROOF = ("verify", "repair")
"""Stages behind a planner that make its path an exact solution."""


def first_path_proof(
    checker: CollisionChecker, raw: Array | None, start: Array, goals: Sequence[Array] | Array,
    times: Mapping[str, float],
) -> float:  # fmt: skip
    """Return the time of the proof by which a first path counts as found [s].

    A first path counts when it has passed the full check. Where the returned path needed a repair, the path as the
    planner found it may pass without one: then its own full check counts, which is made and timed here. Otherwise the
    check and repair of the returned path count. The first-path time of a run is the time until the planner has a path,
    plus this.

    Args:
        checker: Collision checker.
        raw: Path as the planner found it, with the exact start and goal, shape (N, dof); None where it is not known.
        start: Start, shape (dof,).
        goals: Goals, each of shape (dof,).
        times: Times of the stages of the run [s], with ``verify``, and ``repair`` where there was one.
    """
    verify = times.get("verify", 0.0)
    if "repair" not in times or raw is None:
        return verify
    started = time.perf_counter()
    passes = full_check(checker, raw, start, goals)
    return time.perf_counter() - started if passes else verify + times["repair"]
