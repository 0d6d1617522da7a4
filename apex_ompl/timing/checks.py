"""Checks of planned paths and motions from files: whether they fit each other, the problem and the robot."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from apex_ompl.errors import ApexError, ParameterError
from apex_ompl.robot import Robot, load_robot
from apex_ompl.scene.problem import Problem
from apex_ompl.timing.trajectory import Trajectory
from apex_ompl.types import Array
from apex_ompl.util.validation import check_array

EXACT, APPROXIMATE = "EXACT_SOLUTION", "APPROXIMATE_SOLUTION"
WITH_PATH = (EXACT, APPROXIMATE, "TIMING_FAILED")
SAME_STATE = 1e-6  # files of motions and of goals may be rounded [rad]
START_TOLERANCE = 2e-3  # from the start, and from the goal of an unknown robot, whose joints may be clipped [rad]
LIMIT_TOLERANCE = 1e-6  # share by which a motion in a file may exceed a limit, as times are rounded


def check_plan(
    problem: Problem,
    *,
    robot: str,
    joint_names: Sequence[str],
    status: str,
    path: Array | None,
    motion: Trajectory | None,
) -> None:
    """Check that the parts of a planning result fit each other, its problem and the limits of its robot.

    The limits are checked where the robot of the problem can be loaded.

    Args:
        problem: The problem.
        robot: Name of the robot.
        joint_names: Order of the columns of ``path``.
        status: Name of the status.
        path: States, shape (N, dof), or None.
        motion: The timed motion, or None.

    Raises:
        ParameterError: They do not fit.
        FileFormatError: The problem is one of other joints.
    """
    if path is None:
        if status in WITH_PATH:
            raise ParameterError("path", None, f"a path, as the status is {status}")
        if motion is not None:
            raise ParameterError("trajectory", f"{len(motion.times)} knots", "none without a path")
        return
    check_array(path, ("N", len(joint_names)), "path", finite=True, least=1)
    if motion is not None and status != EXACT:
        raise ParameterError("trajectory", f"{len(motion.times)} knots", f"none, as the status is {status}")
    known = _load(problem.robot, robot)
    starts, goals = problem.start_state(joint_names)[None], problem.goal_states(joint_names)
    for name, states in (("path", path), *((("trajectory", motion.positions),) if motion is not None else ())):
        _check_end(name, states[0], starts, "start", START_TOLERANCE)
        if status != APPROXIMATE and len(goals):
            within = goals if known is None else known.turned_to(known.within_limits(goals), states[-1])
            wanted = np.where(goals == starts, states[0], within)  # joints at rest keep their clipped values
            _check_end(name, states[-1], wanted, "goal", START_TOLERANCE if known is None else SAME_STATE)
    if known is not None:
        _check_limits(known, joint_names, path, motion)


def _check_end(name: str, state: Array, wanted: Array, what: str, tolerance: float) -> None:
    """Check that a state is within a tolerance of one of the wanted ones, shape (n, dof) [rad]."""
    off = float(np.abs(wanted - state).max(axis=1).min())
    if off > tolerance:
        raise ParameterError(name, f"one {off:.3g} rad away from it", f"states that include the problem's {what}")


def _check_limits(robot: Robot, joint_names: Sequence[str], path: Array, motion: Trajectory | None) -> None:
    if robot.joint_names != tuple(joint_names):
        raise ParameterError("joint_names", ", ".join(joint_names), f"the joints of {robot.name}")
    for fault in map(robot.limit_fault, path):
        if fault is not None:
            raise ParameterError("path", fault, "states inside the limits")
    for name, share in (motion.use(robot.limits) if motion is not None else {}).items():
        if share > 1.0 + LIMIT_TOLERANCE:
            raise ParameterError("trajectory", f"{share:.4g} of it", f"a motion inside the {name} limit")


def _load(file: str, name: str) -> Robot | None:
    """Return a robot, or None where it cannot be loaded here or has another name."""
    try:
        robot = load_robot(file)
    except ApexError:
        return None
    return robot if robot.name == name else None
