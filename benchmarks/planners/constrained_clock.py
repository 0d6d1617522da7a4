"""CPU time in place of time on the clock, for benchmarks on a busy machine: their processes import this module first.

Its import makes ``time.perf_counter`` the CPU time of the process, so that the time limits and times of what plans in
one thread are those of a quiet machine.
"""

from __future__ import annotations

import time

from ompl import base as ob

from apex_ompl.planning import steps


def ends_after(seconds: float) -> ob.PlannerTerminationCondition:
    """Return a condition that holds after some CPU time [s], in place of OMPL's own."""
    at = time.process_time() + seconds
    return ob.PlannerTerminationCondition(lambda: time.process_time() > at)


time.perf_counter = time.process_time
steps.ends_after = ends_after  # type: ignore[attr-defined]
