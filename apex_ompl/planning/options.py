"""Options of a plan, as a record and as keywords."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any, TypedDict

from apex_ompl.errors import ParameterError
from apex_ompl.util.validation import check_flag, check_number, check_positive, check_seed

if TYPE_CHECKING:
    from apex_ompl.constraints.user import UserConstraint
    from apex_ompl.planning.query import Group
    from apex_ompl.scene.constraints import Constraint
    from apex_ompl.timing import Timing


@dataclass(frozen=True)
class PlanOptions:
    """Options of a plan, see :func:`apex_ompl.plan` and :meth:`apex_ompl.MotionPlanner.plan`."""

    timeout: float = 5.0
    seed: int = 0
    simplify: bool = True
    params: Mapping[str, Any] | None = None
    snapshot: bool = False
    timing: bool | Timing = True
    objective: str = "time"
    calm_factor: float = 1.1
    group: Group | None = None
    leave_contact: float = 0.0
    constraints: Sequence[Constraint | UserConstraint] = ()

    def check(self) -> None:
        """Check the values that need no robot.

        Raises:
            ParameterError: One is faulty.
        """
        from apex_ompl.planning.departure import LARGEST_DEPTH
        from apex_ompl.timing import Timing
        from apex_ompl.timing.duration import check_objective

        check_objective(self.objective, self.calm_factor)
        check_arguments(self.timeout, self.seed)
        check_number(self.leave_contact, "leave_contact", 0.0, LARGEST_DEPTH)
        check_flag(self.simplify, "simplify")
        check_flag(self.snapshot, "snapshot")
        if not isinstance(self.timing, (bool, Timing)):
            raise ParameterError("timing", self.timing, "True, False or a Timing")

    def from_rest(self) -> PlanOptions:
        """Return the options of a later motion of a task: from rest, without contact to leave, and unconstrained."""
        timing = self.timing
        if not isinstance(timing, bool):
            timing = replace(timing, start_velocity=(), start_acceleration=(), minimum_duration=0.0)
        return replace(self, timing=timing, leave_contact=0.0, constraints=())


OPTIONS = tuple(field.name for field in fields(PlanOptions))


class PlanKeywords(TypedDict, total=False):
    """:class:`PlanOptions` as keywords of :meth:`apex_ompl.MotionPlanner.plan`, for editors and type checkers."""

    timeout: float
    seed: int
    simplify: bool
    params: Mapping[str, Any] | None
    snapshot: bool
    timing: bool | Timing
    objective: str
    calm_factor: float
    leave_contact: float
    constraints: Sequence[Constraint | UserConstraint]


class ProblemKeywords(PlanKeywords, total=False):
    """:class:`PlanOptions` as keywords of :meth:`apex_ompl.MotionPlanner.plan_problem`."""

    group: Group | None


def check_arguments(timeout: float, seed: int) -> None:
    """Check what every plan needs.

    Raises:
        ParameterError: ``timeout`` is not a positive number of seconds, or ``seed`` not a whole number from 0.
    """
    check_positive(timeout, "timeout", "a positive number of seconds")
    check_seed(seed)
