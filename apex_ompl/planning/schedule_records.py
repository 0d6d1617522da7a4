"""Steps of arms that are scheduled, and schedules."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from apex_ompl.errors import ParameterError
from apex_ompl.planning.query import Target
from apex_ompl.result import PlanResult
from apex_ompl.timing import Trajectory
from apex_ompl.util.display import one_line
from apex_ompl.util.validation import check_name, check_number

Mode = Literal["asynchronous", "synchronous", "sequential"]
MODES: tuple[Mode, ...] = ("asynchronous", "synchronous", "sequential")
"""When a motion starts: as soon as what it needs is done; with those of the other arms; when all others have ended."""


@dataclass(frozen=True)
class ArmStep:
    """One motion of an arm.

    Attributes:
        name: Its name, which no other step has.
        group: The group of joints that it moves.
        goal: Where to: a goal of :meth:`apex_ompl.MotionPlanner.plan` for that group.
        after: Names of steps of other arms that have to be done before it starts, or one name.
        hold: Time for which the arm stays there then [s].
    """

    name: str
    group: str
    goal: Target
    after: Sequence[str] = ()
    hold: float = 0.0

    def __post_init__(self) -> None:
        """Check the names and the time.

        Raises:
            ParameterError: One is no name, or the time is negative.
        """
        for name, value in (("name", self.name), ("group", self.group)):
            if not isinstance(value, str) or not value:
                raise ParameterError(f"step.{name}", value, "a name")
        after = [self.after] if isinstance(self.after, str) else self.after
        if not isinstance(after, Sequence) or not all(isinstance(one, str) for one in after):
            raise ParameterError(f"steps.{self.name}.after", self.after, "names of steps")
        object.__setattr__(self, "after", tuple(after))
        check_number(self.hold, f"steps.{self.name}.hold", 0.0)


@dataclass(frozen=True)
class ScheduledStep:
    """When a step is done.

    Attributes:
        name: Its name.
        group: Its group.
        start: Time at which it may start [s]; the arm may wait then.
        end: Time at which the arm rests at its goal, and has held it [s].
        after: Names of the steps that it waits for.
    """

    name: str
    group: str
    start: float
    end: float
    after: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Schedule:
    """A schedule; true where all steps are planned and the motion of all joints is proved.

    Attributes:
        result: The whole as the result of a plan: status, reason, and the proved motion of all joints.
        steps: The steps by their start.
        motions: Motion of each group from time 0 to its last step's end.
        mode: When motions start.
        orders: Number of complete orders that were examined.
        plans: Number of motions that were planned.
    """

    result: PlanResult
    steps: tuple[ScheduledStep, ...]
    motions: Mapping[str, Trajectory]
    mode: Mode
    orders: int
    plans: int

    def __bool__(self) -> bool:
        """Whether all steps are planned and proved."""
        return bool(self.result)

    def __repr__(self) -> str:
        """Return the status, the steps and the makespan."""
        names = ", ".join(step.name for step in self.steps)
        return one_line("Schedule", self.mode, str(self.result.status), names, f"{self.makespan:.3f} s", self.reason)

    @property
    def reason(self) -> str:
        """Why there is no schedule, in one sentence."""
        return self.result.reason

    @property
    def trajectory(self) -> Trajectory | None:
        """The motion of all joints, or None."""
        return self.result.trajectory

    @property
    def makespan(self) -> float:
        """Time at which the last step ends [s]; NaN without steps."""
        return max((step.end for step in self.steps), default=float("nan"))


def check_are_steps(steps: Sequence[ArmStep]) -> None:
    """Check the type of steps.

    Raises:
        ParameterError: No step, or something else.
    """
    if not isinstance(steps, Sequence) or not steps or not all(isinstance(step, ArmStep) for step in steps):
        raise ParameterError("steps", steps, "one ArmStep or more")


def check_steps(steps: Sequence[ArmStep], known: Sequence[ScheduledStep]) -> None:
    """Check names and order of steps.

    Raises:
        ParameterError: No step, a name given twice, or steps that wait for each other.
        UnknownNameError: A step waits for one that there is not.
    """
    check_are_steps(steps)
    names = [*(step.name for step in known), *(step.name for step in steps)]
    for name in names:
        if names.count(name) > 1:
            raise ParameterError("steps", f"two steps {name!r}", "names that differ")
    for step in steps:
        for other in step.after:
            check_name(other, f"step in steps.{step.name}.after", names)
    done = {step.name for step in known}
    left = {group: [s for s in steps if s.group == group] for group in dict.fromkeys(s.group for s in steps)}
    while any(left.values()):
        ready = [some for some in left.values() if some and set(some[0].after) <= done]
        if not ready:
            stuck = ", ".join(some[0].name for some in left.values() if some)
            raise ParameterError("steps", stuck, "steps that do not wait for each other in a circle")
        for some in ready:
            done.add(some.pop(0).name)


def check_disjoint(joints: Mapping[str, Sequence[str]]) -> None:
    """Check that no joint is in two groups.

    Raises:
        ParameterError: One is.
    """
    owners = dict[str, str]()
    for group, names in joints.items():
        for name in names:
            if owners.setdefault(name, group) != group:
                raise ParameterError("steps", f"{owners[name]} and {group}", f"groups that do not share {name}")
