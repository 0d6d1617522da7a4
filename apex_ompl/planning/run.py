"""One call of ``plan`` on a problem that is set up."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from apex_ompl.collision.path_proof import PathProof
from apex_ompl.ompl.interrupt import Interrupt
from apex_ompl.ompl.own_planner import SolveReport
from apex_ompl.ompl.setup import PlanningSetup
from apex_ompl.paths.path import Path
from apex_ompl.result import PlanResult, PlanStatus
from apex_ompl.robot.identity import digest
from apex_ompl.types import Array
from apex_ompl.util.deadline import Deadline

if TYPE_CHECKING:
    from apex_ompl.planners import Parameters


@dataclass(eq=False)
class PlanRun:
    """One call of ``plan`` on a problem that is set up.

    Attributes:
        setup: The problem.
        planner: Name of the planner.
        parameters: Its parameters.
        seed: The seed used.
        deadline: When the plan is to be ready.
        times: Seconds by stage so far.
        notes: What a user should know about this run.
        interrupt: Holds Ctrl-C back.
        rejected_lines: Straight lines to goals that failed the full check, each of shape (2, dof).
        first_path: First path that the planner found, or None.
        report: Report of the planner, of planners that make one.
    """

    setup: PlanningSetup
    planner: str
    parameters: Parameters
    seed: int
    deadline: Deadline
    times: dict[str, float] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    interrupt: Interrupt = field(default_factory=Interrupt)
    rejected_lines: list[Array] = field(default_factory=list)
    first_path: Path | None = None
    report: SolveReport | None = None

    def ends_search(self) -> bool:
        """Whether only the reserve for the proof is left, or Ctrl-C was pressed."""
        return self.interrupt.pressed or self.deadline.for_search <= 0.0

    def result(
        self, status: PlanStatus, reason: str = "", path: Path | None = None, solved_by: str = "",
        proof: PathProof | None = None,
    ) -> PlanResult:  # fmt: skip
        """Return a result without what :func:`finish` adds; ``proof`` is that of ``path``."""
        robot = self.setup.robot
        result = PlanResult(
            status=status, reason=reason, problem=self.setup.problem, robot=robot.name, joint_names=robot.joint_names,
            planner=self.planner, seed=self.seed, path=path, solved_by=solved_by, notes=tuple(self.notes),
            held_joints=tuple(robot.joint_names[k] for k in self.setup.held),
            robot_digest=digest(robot),
        )  # fmt: skip
        if proof is None:
            return result
        return replace(
            result, clearance=proof.clearance, clearance_bound=proof.clearance_bound, clearance_pair=proof.pair,
            proved_by_spheres=proof.by_spheres,
        )  # fmt: skip
