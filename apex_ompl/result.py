"""What planning returns, and its files."""

from __future__ import annotations

import json
import os
import pathlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

import numpy as np
from ompl import base as ob

from apex_ompl.errors import FileFormatError, ParameterError
from apex_ompl.paths.path import Path
from apex_ompl.paths.spline import Spline
from apex_ompl.scene.problem import Problem
from apex_ompl.timing import Trajectory
from apex_ompl.timing.checks import check_plan
from apex_ompl.timing.files import KNOTS, MESSAGES
from apex_ompl.types import Array
from apex_ompl.util.display import Summary, one_line
from apex_ompl.util.files import BROKEN, pack_archive, path_text, read_archive, suffix_of, write_atomically
from apex_ompl.util.schema import check_version, dump_yaml, read_json, read_yaml
from apex_ompl.util.validation import finite_array, finite_numbers

SCHEMA = "apex-ompl/result/2"
SUFFIXES = (*MESSAGES, ".npz", ".csv", ".json", ".yaml")
PROOF = ("clearance", "clearance_bound", "proved_by_spheres", "motion_clearance")
NUMBERS = ("length", "deviation", *PROOF)


INSIDE = "solve: "
"""Prefix of the names of a planner's own stages in ``PlanResult.times``."""
FIRST = INSIDE + "first"
"""Name of the time from the start of ``solve`` to the first valid path, for planners that report it."""


class PlanStatus(StrEnum):
    """OMPL's planner status names, and four more.

    TIMING_FAILED is for a proven path that could not be timed, START_OFF_CONSTRAINT and GOAL_OFF_CONSTRAINT for a start
    or goals that violate a constraint along the path, STEP_FAILED for a task whose steps after the goal cannot be done
    from any goal that was found.
    """

    UNKNOWN = "UNKNOWN"
    INVALID_START = "INVALID_START"
    INVALID_GOAL = "INVALID_GOAL"
    UNRECOGNIZED_GOAL_TYPE = "UNRECOGNIZED_GOAL_TYPE"
    TIMEOUT = "TIMEOUT"
    APPROXIMATE_SOLUTION = "APPROXIMATE_SOLUTION"
    EXACT_SOLUTION = "EXACT_SOLUTION"
    CRASH = "CRASH"
    ABORT = "ABORT"
    INFEASIBLE = "INFEASIBLE"
    TIMING_FAILED = "TIMING_FAILED"
    START_OFF_CONSTRAINT = "START_OFF_CONSTRAINT"
    GOAL_OFF_CONSTRAINT = "GOAL_OFF_CONSTRAINT"
    STEP_FAILED = "STEP_FAILED"

    @classmethod
    def of(cls, status: ob.PlannerStatus) -> PlanStatus:
        """Return the name of an OMPL status; ``asString`` does not know all of them."""
        return cls(status.getStatus().name)


@dataclass(frozen=True, eq=False)
class PlanResult:
    """Outcome of one call of ``plan``; true only when ``status`` is EXACT_SOLUTION.

    Attributes:
        status: OMPL's name; EXACT_SOLUTION only for a path that passed the full check and, unless timing is off, is
            timed; TIMING_FAILED for one that could not be timed.
        reason: One sentence that explains a status other than EXACT_SOLUTION.
        problem: The problem.
        robot: Name of the robot; its file is that of the problem.
        robot_digest: Digest of the robot, see :func:`apex_ompl.robot.identity.digest`.
        joint_names: Order of the columns of ``path``.
        held_joints: Names of the joints that were not planned and stayed as at the start.
        planner: Name of the planner.
        seed: The seed used.
        path: Path whose states, joined by straight lines, passed the full check, with its spline if any; or None.
        trajectory: The timed motion, which passed the full check along its own samples and keeps all limits, or None.
        limit_use: Largest share of each limit that ``trajectory`` uses, by ``position``, ``velocity``,
            ``acceleration`` and ``jerk``; empty without one.
        timing_method: Method that made ``trajectory``, see ``apex_ompl.timing.Timing``; empty without one.
        deviation: Largest distance of ``trajectory`` from ``path`` [rad], NaN without one.
        motion_clearance: Least distance of a checked pair along ``trajectory`` [m], NaN without one.
        times: Seconds per stage, and ``total``; those of a planner's own stages, as ``solve: repair``, are part of
            ``solve``.
        length: Sum of Euclidean joint-space steps [rad], NaN without a path.
        clearance: Least distance of any checked pair along the whole path, by the exact shapes [m]; infinite without
            any pair, NaN without a proved path. Links that are apart as in a bearing, by a table, do not count.
        clearance_bound: What of ``clearance`` is proved: no state of the path is nearer to contact [m]. It is less by
            5 % at most, or by 10 um where that is more, but not by more than half.
        clearance_pair: Names of the two bodies that have it.
        proved_by_spheres: Share of the path's length that sphere covers, and tables, proved for all pairs at once.
        checks: Number of states checked one by one; those inside proved stretches of motions do not count.
        solved_by: What found the path: the planner's name, or the stage of apex that did (see
            ``apex_ompl.ompl.own_planner.SolveReport``), with ``+repair`` where a stretch of it failed the full check
            and was planned anew; ``straight line`` where that is a solution, so that no planner ran; empty without a
            path.
        notes: Notes for the user, such as on a snapshot of dynamic obstacles.
        dynamic_obstacles: Names of the dynamic obstacles that ``trajectory``, started at time 0, was proved clear of;
            ``path`` and the clearances are those among the static obstacles.
        constraint_violation: Constraint along the path -> its largest violation at states of ``trajectory`` that were
            examined, or without a motion of ``path`` [m or rad].
        constraint_bound: The same -> a proved bound on its violation anywhere on it.
        nearest_state: For a start or a goal that violates a constraint, a state near it that does not, shape (dof,), or
            None.
    """

    status: PlanStatus
    reason: str
    problem: Problem
    robot: str
    joint_names: tuple[str, ...]
    planner: str
    seed: int
    path: Path | None = None
    trajectory: Trajectory | None = None
    limit_use: Mapping[str, float] = field(default_factory=dict)
    timing_method: str = ""
    deviation: float = float("nan")
    motion_clearance: float = float("nan")
    times: Mapping[str, float] = field(default_factory=dict)
    length: float = float("nan")
    clearance: float = float("nan")
    clearance_bound: float = float("nan")
    clearance_pair: tuple[str, str] = ("", "")
    proved_by_spheres: float = float("nan")
    checks: int = 0
    solved_by: str = ""
    notes: tuple[str, ...] = ()
    held_joints: tuple[str, ...] = ()
    robot_digest: str = ""
    dynamic_obstacles: tuple[str, ...] = ()
    constraint_violation: Mapping[str, float] = field(default_factory=dict)
    constraint_bound: Mapping[str, float] = field(default_factory=dict)
    nearest_state: Array | None = None

    def __bool__(self) -> bool:
        """Whether there is an exact path that passed the full check and, unless timing is off, is timed."""
        return self.status is PlanStatus.EXACT_SOLUTION

    def __repr__(self) -> str:
        """Return the status, the problem and what was found, in one line."""
        by = f" by {self.solved_by}" if self.solved_by else ""
        path = "" if self.path is None else f"{self.length:.3f} rad over {len(self.path)} states"
        motion = "" if self.trajectory is None else f"motion {self.trajectory.duration:.3f} s"
        return one_line("PlanResult", f"{self.status}{by}", repr(self.problem.name), path, motion, self.reason)

    def __str__(self) -> str:
        """Return the lines that ``apex-ompl plan`` prints."""
        return str(_summary(self))

    def _repr_html_(self) -> str:
        """Return these lines as a table for notebooks."""
        return _summary(self).html

    def _step_rows(self) -> list[tuple[str, str]]:
        """Return lines on steps after the goal; a plan to a goal has none."""
        return []

    def as_dict(self) -> dict[str, Any]:
        """Return the fields as plain data, ready for JSON; numbers that do not exist are None."""
        motion = self.trajectory
        return {
            "schema": SCHEMA,
            "status": str(self.status),
            "reason": self.reason,
            "problem": self.problem.name,
            "robot": self.robot,
            "robot_digest": self.robot_digest,
            "planner": self.planner,
            "seed": self.seed,
            "solved_by": self.solved_by,
            "length": None if np.isnan(self.length) else self.length,
            **{name: _finite(getattr(self, name)) for name in PROOF},
            "clearance_pair": list(self.clearance_pair),
            "checks": self.checks,
            "times": dict(self.times),
            "notes": list(self.notes),
            "dynamic_obstacles": list(self.dynamic_obstacles),
            "constraint_violation": dict(self.constraint_violation),
            "constraint_bound": dict(self.constraint_bound),
            "nearest_state": None if self.nearest_state is None else self.nearest_state.tolist(),
            "joint_names": list(self.joint_names),
            "held_joints": list(self.held_joints),
            "path": None if self.path is None else self.path.states.tolist(),
            "spline": None if self.path is None else _spline_fields(self.path),
            "duration": None if motion is None else motion.duration,
            "timing_method": self.timing_method,
            "limit_use": dict(self.limit_use),
            "deviation": None if np.isnan(self.deviation) else self.deviation,
            "jerk": None if motion is None else motion.jerk,
            "spectral_arc_length": None if motion is None else motion.spectral_arc_length,
            "trajectory": None if motion is None else {key: getattr(motion, key).tolist() for key in KNOTS},
            "problem_file": self.problem.as_dict(),
        }

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the result by the suffix of ``path``.

        ``.npz``, ``.json`` and ``.yaml`` hold all fields, for :meth:`load`. ``.traj.yaml``, ``.traj.json`` and ``.csv``
        hold the timed motion, see :meth:`apex_ompl.timing.Trajectory.save`; a ``.csv`` of a result without one
        holds the path.

        Raises:
            ParameterError: Another suffix, or nothing of the kind in the result.
            MissingFileError: The folder is missing or cannot be written.
        """
        path = pathlib.Path(path_text(path))
        suffix = suffix_of(path, SUFFIXES)
        if self.trajectory is not None and suffix in (*MESSAGES, ".csv"):
            self.trajectory.save(path)
        else:
            write_atomically(path, self._encoded(suffix))

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> PlanResult:
        """Read a result that was saved as .npz, .json or .yaml; of a task the plan to its goal.

        Raises:
            MissingFileError: The file cannot be read.
            FileFormatError: It is not a saved result.
            ParameterError: It has another suffix; a .csv holds no problem.
        """
        path = pathlib.Path(path_text(path))
        suffixes = tuple(s for s in SUFFIXES if s not in (*MESSAGES, ".csv"))
        if path.suffix not in suffixes or path.name.endswith(MESSAGES):
            raise ParameterError("result file", str(path), f"a file name ending in {', '.join(suffixes)}")
        if path.suffix == ".npz":
            data = _read_npz(path)
        else:
            data = (read_json if path.suffix == ".json" else read_yaml)(path, "result file")
        check_version(data, SCHEMA, path)
        older: dict[str, Any] = {
            "clearance_pair": ["", ""],
            "timing_method": "",
            "held_joints": [],
            "robot_digest": "",
            "dynamic_obstacles": [],
            "constraint_violation": {},
            "constraint_bound": {},
            "nearest_state": None,
            "goal_time": None,
        }
        data = dict.fromkeys(PROOF) | older | data  # older files lack some
        try:
            states = None if data["path"] is None else finite_array(data["path"], "path")
            number = {k: float("nan") if data[k] is None else float(finite_array(data[k], k)) for k in NUMBERS}
            nearest = data["nearest_state"]
            knots, names = data["trajectory"], tuple(data["joint_names"])
            arrays = {} if knots is None else {key: np.array(knots[key], dtype=float) for key in KNOTS}
            whole = to_goal = Trajectory(**arrays, joint_names=names) if arrays else None
            if whole is not None and data["goal_time"] is not None:  # a task, which goes on after the goal
                to_goal = whole.before(float(finite_array(data["goal_time"], "goal_time")))
            found = cls(
                status=_status(data["status"]), reason=data["reason"], robot=data["robot"],
                path=None if states is None else _path(states, data.get("spline")),
                problem=Problem.parse(data["problem_file"], str(path)), planner=data["planner"],
                joint_names=names, trajectory=to_goal if cls is PlanResult else whole,
                limit_use=finite_numbers(data["limit_use"], "limit_use"), seed=int(data["seed"]),
                times=finite_numbers(data["times"], "times"),
                timing_method=str(data["timing_method"]), checks=int(data["checks"]), solved_by=data["solved_by"],
                notes=tuple(data["notes"]), held_joints=tuple(data["held_joints"]),
                robot_digest=str(data["robot_digest"]), dynamic_obstacles=tuple(map(str, data["dynamic_obstacles"])),
                clearance_pair=tuple(data["clearance_pair"]),
                constraint_violation=finite_numbers(data["constraint_violation"], "constraint_violation"),
                constraint_bound=finite_numbers(data["constraint_bound"], "constraint_bound"),
                nearest_state=None if nearest is None else finite_array(nearest, "nearest_state"), **number,
            )  # fmt: skip
            check_plan(
                found.problem, robot=found.robot, joint_names=names, status=str(found.status), path=states,
                motion=to_goal,
            )  # fmt: skip
        except ParameterError as error:
            raise FileFormatError(str(path), error.name, error.value, f"expected {error.expected}") from error
        except (*BROKEN, AttributeError) as error:
            raise FileFormatError(str(path), "", str(error), "expected a complete saved result") from error
        return found

    def _encoded(self, suffix: str) -> bytes:
        data = self.as_dict()
        if suffix == ".json":
            return (json.dumps(data, indent=1) + "\n").encode()
        if suffix == ".yaml":
            return dump_yaml(data).encode()
        if suffix in MESSAGES:
            raise ParameterError("output", suffix, "a result with a timed motion")
        if suffix == ".csv":
            if self.path is None:
                raise ParameterError("output", suffix, "a result with a path")
            rows = [",".join(self.joint_names)]
            rows += [",".join(repr(float(v)) for v in q) for q in self.path.states]
            return ("\n".join(rows) + "\n").encode()
        states = np.empty((0, len(self.joint_names))) if self.path is None else self.path.states
        del data["path"], data["trajectory"]
        knots = {} if self.trajectory is None else {key: getattr(self.trajectory, key) for key in KNOTS}
        return pack_archive("result", data, {"path": states, "joint_names": np.array(self.joint_names), **knots})


def _summary(result: PlanResult) -> Summary:
    """Return the lines about a result."""
    times = [(name, f"{seconds:.3f}") for name, seconds in result.times.items() if name != "total"]
    stages = ", ".join(f"{name} {text}" for name, text in times if not name.startswith(INSIDE))
    inside = ", ".join(f"{name.removeprefix(INSIDE)} {text}" for name, text in times if name.startswith(INSIDE))
    rows = [("reason", result.reason)] if result.reason else []
    if "total" in result.times:
        rows.append(("time", f"{result.times['total']:.3f} s ({stages})"))
    if inside:
        rows.append(("solve", inside))
    if result.path is not None:
        rows.append(("length", f"{result.length:.3f} rad over {len(result.path)} states"))
        rows.append(("clearance", _clearance(result)))
    if result.trajectory is not None:
        motion = (
            f"{result.trajectory.duration:.3f} s by {result.timing_method}, at most {result.deviation:.4f} rad off the "
            f"path, {result.motion_clearance * 1e3:.2f} mm clear"
        )
        uses = ", ".join(f"{name} {share:.3f}" for name, share in result.limit_use.items() if name != "position")
        rows += [("motion", motion), ("limits", f"{uses} used")]
    rows += result._step_rows()
    for name, bound in result.constraint_bound.items():
        rows.append(("constraint", f"{name}, violated by at most {bound:.3g}"))
    if result.dynamic_obstacles:
        rows.append(("obstacles", f"proved apart from {', '.join(result.dynamic_obstacles)} in time"))
    rows.append(("checks", f"{result.checks} states checked, planner {result.planner}, seed {result.seed}"))
    rows += [("note", note) for note in result.notes]
    by = f" by {result.solved_by}" if result.solved_by else ""
    return Summary(f"{result.problem.name}: {result.status}{by}", rows)


def _clearance(result: PlanResult) -> str:
    """Return the words for the clearance of a path."""
    if np.isnan(result.clearance):
        return "not proved"
    pair = " <-> ".join(name for name in result.clearance_pair if name)
    spheres = f"{100.0 * result.proved_by_spheres:.0f} % of the path proved by spheres, the rest by exact shapes"
    return f"{result.clearance * 1e3:.2f} mm" + (f" ({pair})" if pair else "") + f"; {spheres}"


def _finite(value: float) -> float | None:
    """Return a number, or None for one that is not finite."""
    return value if np.isfinite(value) else None


def _status(name: object) -> PlanStatus:
    if name not in list(PlanStatus):
        raise ParameterError("status", name, f"one of {', '.join(PlanStatus)}")
    return PlanStatus(str(name))


def _spline_fields(path: Path) -> dict[str, Any] | None:
    """Return the spline of a path as plain data, or None for a polyline."""
    if path.spline is None or path.control is None:
        return None
    return {"control": path.control.tolist(), "degree": path.spline.degree, "pinned": path.spline.pinned}


def _path(states: Array, spline: dict[str, Any] | None) -> Path:
    """Return a path as it was saved."""
    if spline is None:
        return Path(states)
    control = finite_array(spline["control"], "spline.control")
    basis = Spline(len(control), int(spline["pinned"]), len(states), int(spline["degree"]))
    return Path(states, basis, control)


def _read_npz(path: pathlib.Path) -> dict[str, Any]:
    data, arrays = read_archive(path, "result", "result file")
    if "path" not in arrays:
        raise FileFormatError(str(path), "path", sorted(arrays), "expected an array")
    knots = {key: arrays.get(key) for key in KNOTS} if KNOTS[0] in arrays else None
    return data | {"path": arrays["path"] if len(arrays["path"]) else None, "trajectory": knots}
