"""The full check of paths and motions that a user brings."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from apex_ompl.collision import CollisionChecker
from apex_ompl.constraints.user import UserConstraint
from apex_ompl.errors import ParameterError
from apex_ompl.ompl.setup import constraint_set
from apex_ompl.ompl.validity import FullCheck, full_check
from apex_ompl.paths.path import Path
from apex_ompl.planning.query import State, state_array
from apex_ompl.scene.constraints import Constraint
from apex_ompl.scene.problem import Problem
from apex_ompl.timing import Trajectory
from apex_ompl.timing.trajectory import ROUNDING
from apex_ompl.types import Array
from apex_ompl.util.validation import check_states, finite_array


def prove(
    checker: CollisionChecker, path: Sequence[State] | ArrayLike | Path | Trajectory,
    problem: Callable[[Array], Problem], constraints: Sequence[Constraint | UserConstraint],
) -> FullCheck:  # fmt: skip
    """Return the full check of a path or a motion, limits of a motion's derivatives included.

    Args:
        checker: Checker of the world.
        path: States, or a motion.
        problem: Returns the problem of the world with a start, for constraints that are relative to it.
        constraints: Constraints along the path.

    Raises:
        ParameterError: It has not the robot's joints, or a number that is not finite.
        ApexError: A constraint is faulty.
    """
    robot, checked = checker.robot, _checked(checker, path)
    start = checked.positions[0] if isinstance(checked, Trajectory) else checked[0]
    along = constraint_set(robot, problem(start), constraints, start, np.empty(0, np.intp))
    checker.prepare()
    check = full_check(checker, checked, constraints=along)
    if not check or not isinstance(checked, Trajectory):
        return check
    use = checked.use(robot.limits)
    over = [f"{name} {100.0 * share:.1f} %" for name, share in use.items() if share > 1.0 + ROUNDING]
    if over:
        return FullCheck(False, f"the motion uses more than 100 % of limits: {', '.join(over)}", None)
    return check


def _checked(checker: CollisionChecker, path: Any) -> Array | Trajectory:
    """Return a path as states, shape (N, dof), or a motion."""
    robot = checker.robot
    if isinstance(path, Trajectory):
        if tuple(path.joint_names) != robot.joint_names:
            names = ", ".join(path.joint_names)
            raise ParameterError("path", names, f"a motion of the {robot.dof} joints of {robot.name}, in their order")
        return path
    if isinstance(path, Path):
        path = path.states
    if isinstance(path, Sequence) and any(isinstance(one, str | Mapping) for one in path):
        path = [state_array(robot, one, "path") for one in path]
    states = finite_array(path, "path")
    check_states(states, robot.dof, "path", least=1)
    return states
