"""What the steps of a plan return to each other: a query, the path that was found, the path that was proved."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

from apex_ompl.collision.path_proof import PathProof
from apex_ompl.ompl.own_planner import SolveReport
from apex_ompl.ompl.process import Interrupt
from apex_ompl.ompl.setup import PlanningSetup
from apex_ompl.paths.path import Path
from apex_ompl.planners import Parameters
from apex_ompl.result import PlanResult, PlanStatus
from apex_ompl.robot.identity import digest
from apex_ompl.timing.duration import CALM_FACTOR, DEFAULT_OBJECTIVE
from apex_ompl.types import Array
from apex_ompl.util.clocks import Deadline
from apex_ompl.util.display import one_line

if TYPE_CHECKING:
    from apex_ompl.constraints.constraint_set import ConstraintSet
    from apex_ompl.constraints.proof import ConstraintCertificate


@dataclass(eq=False)
class PlanQuery:
    """What ``check`` returns: a problem that is set up, a planner, and the time that it has.

    True where the start and at least one goal are valid.

    Attributes:
        setup: The problem.
        planner: Name of the planner.
        parameters: Its parameters.
        deadline: When the plan is to be ready.
        objective: What the motion is to be, one of :data:`apex_ompl.timing.duration.OBJECTIVES`.
        calm_factor: Duration of a calm motion as a multiple of the fastest one's.
        improves_motion: Whether faster motions are sought until the time is up.
        status: INVALID_START or INVALID_GOAL, or None.
        reason: Why it is one of these, in one sentence.
        started: Value of ``time.perf_counter`` when the call of ``plan`` started [s].
        times: Seconds by stage so far.
        notes: What a user should know about this plan.
        interrupt: Holds Ctrl-C back.
        rejected_lines: Straight lines to goals that failed the full check, each of shape (2, dof).
        nearest_state: State on the constraints near a start or a goal that violates them, shape (dof,), or None.
        first_path: First path that the planner found, or None.
        report: Report of the planner, of planners that make one.
    """

    setup: PlanningSetup
    planner: str
    parameters: Parameters
    deadline: Deadline
    objective: str = DEFAULT_OBJECTIVE
    calm_factor: float = CALM_FACTOR
    improves_motion: bool = False
    status: PlanStatus | None = None
    reason: str = ""
    started: float = 0.0
    times: dict[str, float] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    interrupt: Interrupt = field(default_factory=Interrupt)
    rejected_lines: list[Array] = field(default_factory=list)
    nearest_state: Array | None = None
    first_path: Path | None = None
    report: SolveReport | None = None

    def __bool__(self) -> bool:
        """Whether the start and at least one goal are valid."""
        return self.status is None

    def __repr__(self) -> str:
        """Return the problem, the planner and what is wrong."""
        return one_line("PlanQuery", repr(self.setup.problem.name), self.planner, self.reason or "valid")

    def ends_search(self) -> bool:
        """Whether only the reserve for the proof is left, or Ctrl-C was pressed."""
        return self.interrupt.pressed or self.deadline.for_search <= 0.0

    def ends(self) -> bool:
        """Whether no time is left, or Ctrl-C was pressed."""
        return self.interrupt.pressed or self.deadline.expired


@dataclass(frozen=True, eq=False)
class FoundPath:
    """What ``solve`` returns: a path at the search resolution, or why there is none.

    True where the path leads from the start to a goal.

    Attributes:
        query: The query.
        status: OMPL's name of the outcome.
        reason: Why it is no exact solution, in one sentence.
        path: The path, with the planner's spline where it has one, or None.
        solved_by: What found the path, see :class:`apex_ompl.PlanResult`.
        proof: Certificate of the path; the straight line has one before the planner runs.
        constraints: Bounds on the violation of constraints along it, or None without constraints.
    """

    query: PlanQuery
    status: PlanStatus
    reason: str = ""
    path: Path | None = None
    solved_by: str = ""
    proof: PathProof | None = None
    constraints: ConstraintCertificate | None = None

    def __bool__(self) -> bool:
        """Whether there is a path from the start to a goal."""
        return self.status is PlanStatus.EXACT_SOLUTION

    def __repr__(self) -> str:
        """Return the status and what was found."""
        path = "" if self.path is None else f"{self.path.length:.3f} rad over {len(self.path)} states"
        return one_line(type(self).__name__, str(self.status), self.solved_by, path, self.reason)

    def result(self) -> PlanResult:
        """Return a result without motion, and without what :func:`finish` adds."""
        query, robot, proof = self.query, self.query.setup.robot, self.proof
        result = PlanResult(
            status=self.status, reason=self.reason, problem=query.setup.problem, robot=robot.name,
            joint_names=robot.joint_names, planner=query.planner, seed=query.setup.seed, path=self.path,
            solved_by=self.solved_by, notes=tuple(query.notes),
            held_joints=tuple(robot.joint_names[k] for k in query.setup.held),
            robot_digest=digest(robot), nearest_state=query.nearest_state,
        )  # fmt: skip
        if self.constraints is not None and query.setup.constraints is not None:
            result = replace(result, **constraint_fields(query.setup.constraints, self.constraints))
        return result if proof is None else replace(result, **certificate(proof))


def certificate(proof: PathProof) -> dict[str, Any]:
    """Return what a result says of the certificate of its path."""
    return {
        "clearance": proof.clearance, "clearance_bound": proof.clearance_bound, "clearance_pair": proof.pair,
        "proved_by_spheres": proof.by_spheres,
    }  # fmt: skip


def constraint_fields(constraints: ConstraintSet, kept: ConstraintCertificate) -> dict[str, Any]:
    """Return what a result says of the constraints along its path and its motion."""
    return {
        "constraint_violation": dict(zip(constraints.names, kept.violations.tolist(), strict=True)),
        "constraint_bound": dict(zip(constraints.names, kept.bounds.tolist(), strict=True)),
    }


class ProvedPath(FoundPath):
    """What ``prove`` returns: a path that passed the full check, or why there is none."""
