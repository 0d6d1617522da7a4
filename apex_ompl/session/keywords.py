"""Options of a plan as keywords, for editors and type checkers; ``PlanOptions`` has their defaults and checks them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, TypedDict

if TYPE_CHECKING:
    from apex_ompl.planning.query import Group
    from apex_ompl.trajectory import Timing


class PlanKeywords(TypedDict, total=False):
    """Options of :meth:`apex_ompl.MotionPlanner.plan`, see :func:`apex_ompl.plan`."""

    timeout: float
    seed: int
    simplify: bool
    params: Mapping[str, Any] | None
    snapshot: bool
    timing: bool | Timing
    leave_contact: float


class ProblemKeywords(PlanKeywords, total=False):
    """Options of :meth:`apex_ompl.MotionPlanner.plan_problem`."""

    group: Group | None
