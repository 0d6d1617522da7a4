"""Tasks in physics: planned, executed by a simulated robot whose hands grasp, and judged by where the objects are."""

from __future__ import annotations

from typing import TYPE_CHECKING

from apex_ompl.util.lazy import lazy_names

if TYPE_CHECKING:
    from apex_ompl.physics.judges import Check as Check
    from apex_ompl.physics.result import TaskRun as TaskRun
    from apex_ompl.physics.runner import TaskRunner as TaskRunner
    from apex_ompl.physics.runner import execute as execute
    from apex_ompl.physics.trials import Spread as Spread

__all__, __getattr__, __dir__ = lazy_names(
    __name__,
    {"judges": "Check", "result": "TaskRun", "runner": "TaskRunner execute", "trials": "Spread"},
)
