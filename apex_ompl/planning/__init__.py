"""Steps of ``plan``: query, straight line, solve, verify, repair, time; the benchmark composes the same steps."""

from __future__ import annotations

from typing import TYPE_CHECKING

from apex_ompl.planning.run import PlanRun
from apex_ompl.planning.solving import (
    NOT_PROVED,
    STRAIGHT_LINE,
    find_path,
    query_fault,
    solve,
    straight_line,
    verify,
    with_exact_ends,
)
from apex_ompl.planning.timing import finish, parameterize
from apex_ompl.util.lazy import lazy_names

if TYPE_CHECKING:
    from apex_ompl.planning.among_movers import plan_among_movers

__all__ = [
    "NOT_PROVED",
    "STRAIGHT_LINE",
    "PlanRun",
    "find_path",
    "finish",
    "parameterize",
    "plan_among_movers",
    "query_fault",
    "solve",
    "straight_line",
    "verify",
    "with_exact_ends",
]

__getattr__, __dir__ = lazy_names(__name__, {"plan_among_movers": "among_movers"})
