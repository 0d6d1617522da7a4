"""Planners that ``plan`` keeps between calls."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from apex_ompl.session.planner import MotionPlanner

_idle: dict[str, list[MotionPlanner]] = {}
_idle_lock = threading.Lock()
MOST_IDLE = 4  # planners of a robot that are kept


@contextmanager
def kept_planner(robot: str) -> Iterator[MotionPlanner]:
    """Lend a planner of a robot, by name or file, that no other thread uses; it is made where there is none.

    Raises:
        ApexError: The robot is unknown, or one of its files is faulty.
    """
    key = _key(robot)
    with _idle_lock:
        planner = _idle[key].pop() if _idle.get(key) else None
    planner = planner or MotionPlanner(robot)
    try:
        yield planner
    finally:
        with _idle_lock:
            mine = _idle.setdefault(key, [])
            if len(mine) < MOST_IDLE:
                mine.append(planner)


def _key(robot: str) -> str:
    """Return a text that differs for robot files of another content."""
    path = Path(robot)
    if path.suffix in (".yaml", ".yml") and path.exists():
        return f"{path.resolve()} {path.stat().st_mtime_ns}"
    return robot
