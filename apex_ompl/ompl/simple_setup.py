"""OMPL's SimpleSetup for a robot, with what OMPL's Python bindings lack, for OMPL's own planners too."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from typing import TYPE_CHECKING, Any

from ompl import base as ob
from ompl import geometric as og

from apex_ompl.ompl.constrained_space import constraint_of, projected_space
from apex_ompl.ompl.process import ends_after
from apex_ompl.ompl.space import Bounds, await_goal, state_space
from apex_ompl.robot import Robot
from apex_ompl.util.process import running

if TYPE_CHECKING:
    from apex_ompl.constraints.constraint_set import ConstraintSet


class SpaceInformation(ob.SpaceInformation):
    """OMPL's space information of a robot, whose Python object lives as long as OMPL's own.

    Attributes:
        robot: The robot, for planners that another checker does not tell.
    """

    def __init__(self, space: ob.StateSpace, robot: Robot) -> None:
        """Describe a space of a robot."""
        super().__init__(space)
        self.robot = robot

    def setStateValidityChecker(self, svc: ob.StateValidityChecker | Callable[[Any], Any]) -> None:  # noqa: N802 - OMPL's name
        """Set the checker that decides from now on; a function may return anything that is true or false."""
        super().setStateValidityChecker(_of_truth(svc))


class ConstrainedSpaceInformation(ob.ConstrainedSpaceInformation):
    """As :class:`SpaceInformation`, of a state space under constraints along the path.

    Attributes:
        robot: The robot.
        constraint: The constraints, as the state space has them.
    """

    def __init__(self, space: ob.ProjectedStateSpace, robot: Robot) -> None:
        """Describe a space of a robot, see :func:`apex_ompl.ompl.constrained_space.projected_space`."""
        super().__init__(space)
        self.robot, self.constraint = robot, constraint_of(space)

    def setStateValidityChecker(self, svc: ob.StateValidityChecker | Callable[[Any], Any]) -> None:  # noqa: N802 - OMPL's name
        """Set the checker that decides from now on; a function may return anything that is true or false."""
        super().setStateValidityChecker(_of_truth(svc))


RobotSpaceInformation = SpaceInformation | ConstrainedSpaceInformation


class SimpleSetup(og.SimpleSetup):
    """OMPL's SimpleSetup in the state space of a robot, under constraints along the path where there are some.

    Beyond OMPL's own, checkers may return ``numpy.bool_``; ``solve`` lets goals be sampled by Python in another thread;
    ``getPlannerData`` knows this package's planners; and a daemon thread inside of ``solve`` when the interpreter ends
    is ended in order.
    """

    def __init__(self, robot: Robot, bounds: Bounds | None = None, constraints: ConstraintSet | None = None) -> None:
        """Make a setup without checker, start and goal.

        Args:
            robot: The robot.
            bounds: Bounds of the state space, by default those of :func:`apex_ompl.ompl.space.state_space`.
            constraints: Constraints along the path, or None for none.

        Raises:
            ConstraintError: They leave no joint free.
        """
        space = state_space(robot, bounds=bounds)
        if constraints is None:
            super().__init__(SpaceInformation(space, robot))
        else:
            super().__init__(ConstrainedSpaceInformation(projected_space(space, constraints), robot))

    def setStateValidityChecker(self, svc: ob.StateValidityChecker | Callable[[Any], Any]) -> None:  # noqa: N802 - OMPL's name
        """Set the checker that decides from now on; a function may return anything that is true or false."""
        super().setStateValidityChecker(_of_truth(svc))

    def solve(self, time: float | ob.PlannerTerminationCondition = 1.0, *, ptc: Any = None) -> ob.PlannerStatus:
        """Solve within a time [s], or until a condition holds."""
        given = time if ptc is None else ptc
        ptc = given if isinstance(given, ob.PlannerTerminationCondition) else ends_after(given)
        constraint = constraint_of(self.getStateSpace())
        ending = nullcontext() if constraint is None else constraint.ends_on_fault(ptc)
        with running(ptc.terminate), ending:
            self.setup()  # sampling begins after it
            await_goal(self.getGoal(), ptc)
            return super().solve(ptc)

    def simplifySolution(self, duration: float | ob.PlannerTerminationCondition = 0.0, *, ptc: Any = None) -> None:  # noqa: N802
        """Shorten the solution, within a time [s] where one is given, or until a condition holds."""
        with running():
            super().simplifySolution(duration if ptc is None else ptc)

    def getPlannerData(self, data: ob.PlannerData) -> None:  # noqa: N802 - OMPL's name
        """Fill in the states and motions that the planner knows."""
        planner = self.getPlanner()
        fill_data = getattr(planner, "fill_data", None)  # of this package's planners
        if fill_data is not None:
            fill_data(data)
        else:
            super().getPlannerData(data)


def _of_truth(svc: Any) -> Any:
    """Return a checker whose answers are ``bool``: OMPL's bindings take nothing else of a function."""
    if isinstance(svc, ob.StateValidityChecker) or not callable(svc):
        return svc
    return lambda state: bool(svc(state))
