"""The pool of kept planners, which ``apex_ompl.plan`` borrows from."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

from apex_ompl.planning.planner import MotionPlanner
from apex_ompl.util.forking import ProcessLock

MOST_IDLE = 4  # planners of a robot that are kept
_Stamps = tuple[int, ...]

_idle: dict[str, list[tuple[MotionPlanner, _Stamps]]] = {}
_idle_lock = ProcessLock()


@contextmanager
def kept_planner(robot: str) -> Iterator[MotionPlanner]:
    """Lend a planner of a robot, by name or file, that no other thread uses; it is made where there is none.

    A planner is not lent again once a file of its robot has changed, meshes included.

    Raises:
        ApexError: The robot is unknown, or one of its files is faulty.
    """
    key = os.path.abspath(robot) if robot.endswith((".yaml", ".yml")) else robot
    with _idle_lock:
        idle = _idle.get(key, [])
        found = idle.pop() if idle else None
    if found is None or found[1] != _stamps(found[0]):
        planner = MotionPlanner(robot)
        found = planner, _stamps(planner)
    try:
        yield found[0]
    finally:
        with _idle_lock:
            mine = _idle.setdefault(key, [])
            if len(mine) < MOST_IDLE:
                mine.append(found)


def _stamps(planner: MotionPlanner) -> _Stamps:
    """Return when the files of a planner's robot were written, 0 for one that is gone [ns]."""
    return tuple(file.stat().st_mtime_ns if file.exists() else 0 for file in planner.robot.files)
