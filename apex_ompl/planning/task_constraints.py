"""Constraints of a problem along the steps after its goal.

They hold until the first further goal or turn, which may be what ends them, as where a cup that was carried upright is
poured. A constraint ends earlier where a frame that it names is an object that a hand releases or takes over.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from apex_ompl.planning.task_world import TaskWorld
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import AttachedObject
from apex_ompl.scene.constraints import Constraint
from apex_ompl.scene.problem import MoveStep, Problem
from apex_ompl.scene.steps import Step, TurnStep
from apex_ompl.timing import Trajectory
from apex_ompl.types import Array

if TYPE_CHECKING:  # they load compiled code that most tasks do without
    from apex_ompl.constraints.constraint_set import ConstraintSet
    from apex_ompl.constraints.proof import ConstraintCertificate


@dataclass(eq=False)
class StepConstraints:
    """The constraints that hold in each world of a task.

    Attributes:
        robot: The robot.
        problem: The problem.
    """

    robot: Robot
    problem: Problem
    _known: dict[frozenset[str], ConstraintSet | None] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Find out up to which step they hold."""
        steps: Sequence[Step] = self.problem.after
        ends = (k for k, step in enumerate(steps) if isinstance(step, MoveStep | TurnStep))
        self._steps = {id(step) for step in steps[: next(ends, len(steps))]}

    def proved(
        self, step: Step, world: TaskWorld, states: Array, motion: Trajectory | None
    ) -> ConstraintCertificate | None:
        """Return bounds on the violation along a step, or None where no constraint holds then.

        Args:
            step: The step, one of the problem's.
            world: The world during it.
            states: States of its path, shape (N, dof).
            motion: Its motion, or None where it is not timed.
        """
        if id(step) not in self._steps:
            return None
        held = self._of(world)
        if held is None:
            return None
        from apex_ompl.constraints.proof import prove_motion, prove_path

        return prove_path(held, states) if motion is None else prove_motion(held, motion)

    def _of(self, world: TaskWorld) -> ConstraintSet | None:
        kept = [one for one in self.problem.attached if world.held.get(one.name) is one]
        key = frozenset(one.name for one in kept)
        if key not in self._known:
            gone = {one.name for one in self.problem.attached} - key
            self._known[key] = self._made([one for one in self.problem.constraints if not gone & frames_of(one)], kept)
        return self._known[key]

    def _made(self, constraints: Sequence[Constraint], kept: Sequence[AttachedObject]) -> ConstraintSet | None:
        if not constraints and not any(one.links for one in kept):
            return None
        from apex_ompl.constraints.constraint_set import ConstraintSet

        start = self.problem.start_state(self.robot.joint_names)
        return ConstraintSet.of(self.robot, constraints, kept, start)


def frames_of(constraint: Constraint) -> set[str]:
    """Return the names of the frames of a constraint."""
    return {str(getattr(constraint, name)) for name in ("frame", "first", "second") if hasattr(constraint, name)}
