"""OMPL's projected state space over constraints along the path.

Samples and steps of OMPL's interpolation are projected by Newton's method of :class:`ConstraintSet`. The straight line
between two states of the manifold leaves it, so motions are checked along its projection, see
:class:`apex_ompl.ompl.validity.ConstrainedMotionCheck`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import numpy as np
from ompl import base as ob

from apex_ompl.errors import ConstraintError, ParameterError
from apex_ompl.ompl.space import to_array
from apex_ompl.types import Array
from apex_ompl.util.arrays import length

if TYPE_CHECKING:
    from apex_ompl.constraints.constraint_set import ConstraintSet

RANGE = 0.5  # of trees on the manifold where none is given [rad]
DELTA = 0.2  # step of OMPL's interpolation on the manifold [rad]
LAMBDA = 2.0  # largest length of a projected step, and of a whole motion, as a multiple of the straight one
TOLERANCE = 1e-4  # of all rows together, where OMPL's own projection stops [m, rad]
CONSTRAINED = "one that plans under constraints along the path, such as apex, rrtconnect or prm"


class ManifoldConstraint(ob.Constraint):
    """Constraints along the path as OMPL's constrained state spaces take them.

    An equality has its own rows. A constraint with a dead zone has one row, which is 0 inside of it.

    No exception leaves it, since one would end the process inside OMPL's threads: it makes states invalid and is kept
    in ``fault``.

    Attributes:
        constraints: The constraints.
        stop: No state is projected once this holds.
        fault: First exception of a constraint of a user's own, or None.
    """

    def __init__(self, constraints: ConstraintSet) -> None:
        """Take constraints of a robot.

        Raises:
            ConstraintError: They have as many rows as the robot has joints, or more.
        """
        self.constraints = constraints
        self.stop: Callable[[], bool] = lambda: False
        self.fault: BaseException | None = None
        self._condition: ob.PlannerTerminationCondition | None = None
        dof, rows = constraints.robot.dof, len(self.rows(constraints.start)[0])
        if rows >= dof:
            raise ConstraintError(", ".join(constraints.names), f"{rows} rows, expected fewer than {dof} joints")
        super().__init__(dof, rows, TOLERANCE)

    def rows(self, q: Array) -> tuple[Array, Array]:
        """Return all rows at a state, shape (rows,), and their Jacobian, shape (rows, dof)."""
        kernel, residuals, jacobians = self.constraints.rows, list[Array](), list[Array]()
        if kernel is not None:
            r, jacobian = kernel.residual(q)
            ends = np.cumsum([group.rows for group in kernel.groups])[:-1]
            parts = zip(kernel.groups, np.split(r, ends), np.split(jacobian, ends), strict=True)
            for group, part, slope in parts:
                one = (part, slope) if group.slack == 0.0 else _outside(part, slope, group.slack)
                residuals.append(one[0])
                jacobians.append(one[1])
        for user in self.constraints.user:
            residuals.append(np.array(user.residual(q.copy()), float))
            jacobians.append(np.array(user.jacobian(q.copy()), float))
        jacobian = np.vstack(jacobians)
        jacobian[:, list(self.constraints.fixed)] = 0.0
        return np.concatenate(residuals), jacobian

    def function(self, x: Array, out: Array) -> None:
        """Put the rows at a state, shape (dof,), into ``out``, shape (rows,)."""
        try:
            out[:] = self.rows(np.array(x))[0]
        except BaseException as error:
            self._keep(error)
            out[:] = np.inf

    def jacobian(self, x: Array, out: Array) -> None:
        """Put the Jacobian of the rows at a state, shape (dof,), into ``out``, shape (rows, dof)."""
        try:
            out[:] = self.rows(np.array(x))[1]
        except BaseException as error:
            self._keep(error)
            out[:] = 0.0

    def isSatisfied(self, x: Array | ob.State) -> bool:  # noqa: N802 - OMPL's name
        """Whether a state, shape (dof,), satisfies the constraints, each with its own tolerance."""
        try:
            return self.constraints.is_satisfied(
                x if isinstance(x, np.ndarray) else to_array(x, self.constraints.robot.dof)
            )
        except BaseException as error:
            self._keep(error)
            return False

    def project(self, x: Array) -> bool:
        """Move a state, shape (dof,), onto the constraints inside the limits, in place; whether it arrived."""
        try:
            if self.fault is not None or self.stop():
                return False
            found = self.constraints.project(x[None])
            x[:] = found.states[0]
            return bool(found.ok[0])
        except BaseException as error:
            self._keep(error)
            return False

    @contextmanager
    def ends_on_fault(self, condition: ob.PlannerTerminationCondition) -> Iterator[None]:
        """While the block runs, let an exception of a constraint end the planner that watches ``condition``."""
        self._condition = condition
        try:
            yield
        finally:
            self._condition = None

    def _keep(self, error: BaseException) -> None:
        self.fault = self.fault or error
        if self._condition is not None:
            self._condition.terminate()


def _outside(r: Array, jacobian: Array, slack: float) -> tuple[Array, Array]:
    """Return |r| - slack, shape (1,), and its derivative, shape (1, dof), both 0 inside of the dead zone."""
    size = length(r)
    if size <= slack:
        return np.zeros(1), np.zeros((1, jacobian.shape[1]))
    return np.array([size - slack]), (r @ jacobian)[None] / size


def projected_space(space: ob.RealVectorStateSpace, constraints: ConstraintSet) -> ob.ProjectedStateSpace:
    """Return OMPL's projected state space over constraints.

    Args:
        space: State space of the robot, see :func:`apex_ompl.ompl.space.state_space`.
        constraints: The constraints.

    Raises:
        ConstraintError: The constraints leave no joint free.
    """
    made = ob.ProjectedStateSpace(space, ManifoldConstraint(constraints))
    made.setDelta(DELTA)
    made.setLambda(LAMBDA)
    space.setName(constraints.robot.name)  # OMPL has changed it; the bindings cannot set that of the projected one
    return made


def constraint_of(space: ob.StateSpace) -> ManifoldConstraint | None:
    """Return the constraint of a constrained state space, or None for a space that is not constrained.

    Raises:
        ParameterError: It is a constraint that is not made of a :class:`ConstraintSet`.
    """
    if not isinstance(space, ob.ConstrainedStateSpace):
        return None
    constraint = space.getConstraint()
    if not isinstance(constraint, ManifoldConstraint):
        expected = "apex_ompl.ompl.constrained_space.ManifoldConstraint"
        raise ParameterError("constraint of the state space", type(constraint).__name__, expected)
    return constraint


def refuse_constraints(si: ob.SpaceInformation, planner: str) -> None:
    """Refuse constraints along the path.

    Args:
        si: OMPL's space information.
        planner: Name of a planner that knows no constraints.

    Raises:
        ParameterError: The state space has constraints.
    """
    if isinstance(si.getStateSpace(), ob.ConstrainedStateSpace):
        raise ParameterError("planner", planner, CONSTRAINED)


class ManifoldLength(ob.OptimizationObjective):
    """Length of motions as the distance of their ends, with samples of the whole manifold.

    The informed samplers of OMPL's PathLengthOptimizationObjective draw from the ambient space.
    """

    def __init__(self, si: ob.SpaceInformation) -> None:
        """Measure motions of ``si``."""
        super().__init__(si)
        self._distance = si.getStateSpace().distance

    def stateCost(self, state: ob.State) -> ob.Cost:  # noqa: N802 - OMPL's name
        """Return 0."""
        return ob.Cost(0.0)

    def motionCost(self, first: ob.State, second: ob.State) -> ob.Cost:  # noqa: N802 - OMPL's name
        """Return the distance between two states."""
        return ob.Cost(self._distance(first, second))

    def motionCostHeuristic(self, first: ob.State, second: ob.State) -> ob.Cost:  # noqa: N802 - OMPL's name
        """Return the distance between two states."""
        return ob.Cost(self._distance(first, second))
