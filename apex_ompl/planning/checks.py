"""Checks of what a user brings: a state, and a path or a motion, which has to pass the full check of plans."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import nan
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from apex_ompl.collision import CollisionChecker, Contact
from apex_ompl.constraints.user import UserConstraint
from apex_ompl.errors import ParameterError
from apex_ompl.ompl.setup import constraint_set, state_fault
from apex_ompl.ompl.validity import FullCheck, full_check
from apex_ompl.paths.path import Path
from apex_ompl.planning.query import State, state_array
from apex_ompl.planning.task_result import TaskResult
from apex_ompl.result import PlanResult
from apex_ompl.scene.constraints import Constraint
from apex_ompl.scene.problem import Problem
from apex_ompl.timing import Trajectory
from apex_ompl.timing.trajectory import ROUNDING
from apex_ompl.types import Array
from apex_ompl.util.display import one_line
from apex_ompl.util.validation import check_states, finite_array


@dataclass(frozen=True)
class StateCheck:
    """Outcome of :meth:`apex_ompl.MotionPlanner.check`; true for a state that is inside the limits and free.

    Attributes:
        reason: Why it is neither, in one sentence; empty for a valid state.
        clearance: Distance of the nearest pair of bodies that is checked [m], the negative depth where they overlap.
        contacts: Pairs that overlap, the deepest first.
    """

    reason: str
    clearance: float
    contacts: tuple[Contact, ...]

    def __bool__(self) -> bool:
        """Whether the state is valid."""
        return not self.reason

    def __repr__(self) -> str:
        """Return whether the state is valid, why it is not, and the clearance."""
        found = "valid" if self else f"invalid: {self.reason}"
        return one_line("StateCheck", found, f"clearance {1e3 * self.clearance:.2f} mm")


@dataclass(frozen=True, eq=False)
class ProofResult:
    """Outcome of :meth:`apex_ompl.MotionPlanner.prove`; true for a path or a motion that is proved.

    Attributes:
        reason: Why it is not, in one sentence with the place; empty for one that is proved.
        segment: Number k of the segment between the states k and k + 1 of a path that fails, or None.
        time: When a motion fails [s], NaN for a path.
        state: The state that collides, shape (dof,), or None where another fault was found first.
        clearance: Least distance of a pair of bodies along it [m]; the negative depth of the deepest pair where the
            state collides; NaN where it was not determined.
        clearance_bound: Proved lower bound of it [m]; 0 without a proof.
        clearance_pair: The two bodies of that pair; empty where there are none.
    """

    reason: str
    segment: int | None
    time: float
    state: Array | None
    clearance: float
    clearance_bound: float
    clearance_pair: tuple[str, str]

    def __bool__(self) -> bool:
        """Whether it is proved."""
        return not self.reason

    def __repr__(self) -> str:
        """Return whether it is proved, why it is not, and the clearance."""
        found = "proved" if self else f"not proved: {self.reason}"
        return one_line("ProofResult", found, f"clearance {1e3 * self.clearance:.2f} mm")


def check_state(checker: CollisionChecker, q: Array) -> StateCheck:
    """Return the outcome of the check of a state, shape (dof,)."""
    return StateCheck(state_fault(checker, q), checker.clearance(q), tuple(checker.contacts(q)))


def prove(
    checker: CollisionChecker, path: Sequence[State] | ArrayLike | Path | Trajectory | PlanResult,
    problem: Callable[[Array], Problem], constraints: Sequence[Constraint | UserConstraint],
) -> ProofResult:  # fmt: skip
    """Return the outcome of the full check of a path or a motion, limits of a motion's derivatives included.

    Args:
        checker: Checker of the world.
        path: States, a motion, or the result of a plan: its motion, or its path where it has none.
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
    if check and isinstance(checked, Trajectory):
        use = checked.use(robot.limits)
        over = [f"{name} {100.0 * share:.1f} %" for name, share in use.items() if share > 1.0 + ROUNDING]
        if over:
            check = FullCheck(False, f"the motion uses more than 100 % of limits: {', '.join(over)}", None)
    proof = check.proof
    if proof is None:
        return ProofResult(check.reason, check.segment, nan, None, nan, 0.0, ("", ""))
    time = proof.parameter if not check and check.segment is None else nan
    return ProofResult(
        check.reason, check.segment, time, None if check else proof.state, proof.clearance, proof.clearance_bound,
        proof.pair,
    )  # fmt: skip


def _checked(checker: CollisionChecker, path: Any) -> Array | Trajectory:
    """Return a path as states, shape (N, dof), or a motion."""
    robot = checker.robot
    if isinstance(path, TaskResult):
        wanted = "a path or a motion, as the trajectory of this task, whose steps may change the world"
        raise ParameterError("path", path, wanted)
    if isinstance(path, PlanResult):
        made = path.path if path.trajectory is None else path.trajectory
        if made is None:
            raise ParameterError("path", path, "a result with a path or a motion")
        path = made
    if isinstance(path, Trajectory):
        if tuple(path.joint_names) != robot.joint_names:
            names = ", ".join(path.joint_names)
            raise ParameterError("path", names, f"a motion of the {robot.dof} joints of {robot.name}, in their order")
        return path
    if isinstance(path, Path):
        path = path.states
    if isinstance(path, str | Mapping):
        raise ParameterError("path", path, "several states, a Path, a Trajectory or a PlanResult")
    if isinstance(path, Sequence) and any(isinstance(one, str | Mapping) for one in path):
        path = [state_array(robot, one, "path") for one in path]
    states = finite_array(path, "path")
    check_states(states, robot.dof, "path", least=1)
    return states
