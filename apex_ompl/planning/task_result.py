"""What planning a task returns: the plan to the goal, the steps after it, and one motion through all of them."""

from __future__ import annotations

import os
import pathlib
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from math import isnan, nan
from typing import Any, NamedTuple

from apex_ompl.errors import ApexError, FileFormatError, ParameterError
from apex_ompl.paths.path import Path
from apex_ompl.result import PlanResult
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import AttachedObject, Obstacle
from apex_ompl.scene.problem import Problem
from apex_ompl.types import Array
from apex_ompl.util.display import one_line
from apex_ompl.util.files import BROKEN, read_archive
from apex_ompl.util.schema import StrictModel, read_json, read_yaml, validate
from apex_ompl.util.validation import finite_array

GOAL = "goal"
"""Kind of the first step, the motion to the goal."""
AT_ONCE = "at once"
"""Kind of what several arms do."""


class _Bodies(StrictModel):
    """Bodies of a step in files."""

    scene: tuple[Obstacle, ...] = ()
    attached: tuple[AttachedObject, ...] = ()
    allowed: tuple[tuple[str, str], ...] = ()
    leaving: tuple[tuple[str, str], ...] = ()


class StepTimes(NamedTuple):
    """Times of a step that is done beside others.

    Attributes:
        start: When it starts [s].
        end: When it ends [s].
        done: When the world changes by it [s]: a retreating hand leaves an object before its end.
    """

    start: float
    end: float
    done: float


@dataclass(frozen=True, eq=False)
class TaskStep:
    """One step of a task that was planned.

    Attributes:
        kind: ``goal`` for the motion to the goal, ``at once`` where several arms do something, else the kind of the
            step in the problem.
        title: The kind and what it is about, in one line.
        start: Time at which it starts [s]; NaN without a motion.
        end: Time at which it ends, at rest [s].
        path: Its path.
        clearance: Least distance of a checked pair along its motion, or else along its path [m].
        scene: Obstacles during it, released objects among them.
        attached: Objects held during it.
        allowed: Pairs of bodies that may touch during it.
        left: Time from which on hands are proved clear of what they released, or without a motion the number of the
            state of ``path``; NaN where they do not leave anything.
        leaving: Pairs among ``allowed`` that may touch until then only.
        released: Objects that its hand lets go of.
        grasped: Objects that its hand takes.
        gone: Released objects that planning no longer knows of from its end on, since they fall.
        blended: Whether the next step starts without a rest in between; ``end`` is in the middle of the blend then.
    """

    kind: str
    title: str
    start: float
    end: float
    path: Path
    clearance: float
    scene: tuple[Obstacle, ...]
    attached: tuple[AttachedObject, ...]
    allowed: tuple[tuple[str, str], ...]
    left: float = nan
    leaving: tuple[tuple[str, str], ...] = ()
    released: tuple[str, ...] = ()
    grasped: tuple[str, ...] = ()
    gone: tuple[str, ...] = ()
    blended: bool = False

    def __repr__(self) -> str:
        """Return the title, the times, and what changes at the end."""
        return one_line("TaskStep", repr(self.title), self.interval, self.change)

    @property
    def interval(self) -> str:
        """The interval of time, in words."""
        return "not timed" if isnan(self.start) else f"{self.start:.3f} s to {self.end:.3f} s"

    @property
    def change(self) -> str:
        """What changes at its end, in words."""
        stay = [name for name in self.released if name not in self.gone]
        said = (("grasps", self.grasped), ("releases", stay), ("drops", self.gone))
        return ", ".join(f"{verb} {' and '.join(names)}" for verb, names in said if names)

    def as_dict(self, problem: Problem) -> dict[str, Any]:
        """Return the fields as plain data; of obstacles those that are not as in the problem."""
        known = {one.name: one for one in problem.scene}
        changed = [one for one in self.scene if known.get(one.name) != one]
        removed = [name for name in known if name not in {one.name for one in self.scene}]
        return {
            "kind": self.kind, "title": self.title, "start": _number(self.start), "end": _number(self.end),
            "clearance": _number(self.clearance), "left": _number(self.left), "released": list(self.released),
            "grasped": list(self.grasped), "gone": list(self.gone), "blended": self.blended,
            "path": self.path.states.tolist(),
            "scene": [_plain(one) for one in changed], "removed": removed,
            "attached": [_plain(one) for one in self.attached], "allowed": [list(pair) for pair in self.allowed],
            "leaving": [list(pair) for pair in self.leaving],
        }  # fmt: skip

    @classmethod
    def of_dict(cls, data: Mapping[str, Any], problem: Problem, source: str) -> TaskStep:
        """Return the step of plain data.

        Raises:
            ApexError: A body is faulty.
            KeyError, TypeError, ValueError: A field is missing or faulty.
        """
        given = {name: data[name] for name in ("scene", "attached", "allowed", "leaving")}
        bodies = validate(_Bodies, given, source)
        changed, removed = {one.name: one for one in bodies.scene}, set(data["removed"])
        scene = {one.name: one for one in problem.scene if one.name not in removed} | changed
        return cls(
            kind=str(data["kind"]), title=str(data["title"]), path=Path(finite_array(data["path"], "path")),
            scene=tuple(scene.values()), attached=bodies.attached, allowed=bodies.allowed,
            leaving=bodies.leaving, blended=bool(data["blended"]),
            **{name: tuple(map(str, data[name])) for name in ("released", "grasped", "gone")},  # type: ignore[arg-type]
            **{n: nan if data[n] is None else float(data[n]) for n in ("start", "end", "clearance", "left")},  # type: ignore[arg-type]
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class TaskResult(PlanResult):
    """Outcome of one call of ``plan_task``; true only where the goal and all steps after it are planned and proved.

    ``path``, and what the result says of it, is that to the goal; ``trajectory`` is the one motion through all steps,
    at rest between them, and ``motion_clearance`` and ``limit_use`` are those of it.

    Attributes:
        steps: The motion to the goal and the steps after it; empty where the task was not planned.
        goals_examined: Goals from which the steps after them were tried.
        goals_rejected: Why steps after the goal could not be done -> number of goals.
        schedule: Times of the motion to the goal and of each step of the problem after it, where several arms do steps
            at once and ``steps`` are the times between events; else empty.
    """

    steps: tuple[TaskStep, ...] = ()
    goals_examined: int = 0
    goals_rejected: Mapping[str, int] = field(default_factory=dict)
    schedule: tuple[StepTimes, ...] = ()

    def __repr__(self) -> str:
        """Return the status, the steps and the motion, in one line."""
        motion = "" if self.trajectory is None else f"motion {self.trajectory.duration:.3f} s"
        titles = ", ".join(step.title for step in self.steps)
        return one_line("TaskResult", str(self.status), repr(self.problem.name), titles, motion, self.reason)

    def _step_rows(self) -> list[tuple[str, str]]:
        """Return a line on each step."""
        rows = []
        for step in self.steps:
            change = f", {step.change}" if step.change else ""
            rows.append(("step", f"{step.title}: {step.interval}, {1e3 * step.clearance:.2f} mm clear{change}"))
        if self.goals_examined:
            rejected = sum(self.goals_rejected.values())
            rows.append(("goals", f"{self.goals_examined} examined, {rejected} rejected"))
        return rows

    @classmethod
    def of(cls, result: PlanResult) -> TaskResult:
        """Return the result of a plan to a goal as that of a task without steps."""
        return cls(**{one.name: getattr(result, one.name) for one in fields(PlanResult)})

    @classmethod
    def of_motion(cls, result: PlanResult) -> TaskResult:
        """Return the result of a plan with a motion as a task of one step; steps after its goal are left out."""
        problem, motion = result.problem, result.trajectory
        assert motion is not None
        bodies = problem.scene, problem.attached, problem.allowed
        step = TaskStep(
            GOAL, GOAL, float(motion.times[0]), float(motion.times[-1]), Path(motion.positions),
            result.motion_clearance, *bodies,
        )  # fmt: skip
        return replace(cls.of(result), problem=problem.model_copy(update={"after": ()}), steps=(step,))

    @property
    def goal_time(self) -> float:
        """Time at which the goal is reached [s]; NaN without a motion."""
        return self.steps[0].end if self.steps else nan

    def step_at(self, time: float) -> TaskStep:
        """Return the step at a time [s]: the first one before the start, the last one after the end.

        Raises:
            ParameterError: The task was not planned, or is not timed.
        """
        if not self.steps or isnan(self.goal_time):
            raise ParameterError("result", str(self.status), "a task with a timed motion")
        return next((step for step in self.steps if time < step.end), self.steps[-1])

    def object_poses(self, robot: Robot, time: float) -> dict[str, Array | None]:
        """Return the poses in the world of all objects that are held at some time, shape (4, 4); None of fallen ones.

        Args:
            robot: The robot of the problem.
            time: A time of the motion [s].

        Raises:
            ParameterError: The task was not planned, or is not timed.
        """
        step, motion = self.step_at(time), self.trajectory
        assert motion is not None
        over = step is self.steps[-1] and time >= step.end  # what falls at the end of the last step is gone then
        held, q = {one.name: one for one in step.attached}, motion(time)
        standing = {one.name: one.pose for one in step.scene}
        found: dict[str, Array | None] = {}
        for name in dict.fromkeys(one.name for some in self.steps for one in some.attached):
            if name in held and not (over and name in step.gone):
                found[name] = robot.link_pose(q, held[name].link) @ held[name].pose
            else:
                found[name] = standing.get(name)
        return found

    def as_dict(self) -> dict[str, Any]:
        """Return the fields as plain data, ready for JSON."""
        steps = [step.as_dict(self.problem) for step in self.steps]
        task = {
            "goals_examined": self.goals_examined, "goals_rejected": dict(self.goals_rejected), "steps": steps,
            "schedule": [list(one) for one in self.schedule],
        }  # fmt: skip
        return super().as_dict() | {"goal_time": _number(self.goal_time), "task": task}

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> TaskResult:
        """Read a result that was saved as .npz, .json or .yaml.

        Raises:
            ApexError: As :meth:`apex_ompl.PlanResult.load`, or the file holds no task.
        """
        found, file = super().load(path), os.fspath(path)
        assert isinstance(found, TaskResult)
        data = _data_of(file)
        try:
            task = data["task"]
            steps = tuple(TaskStep.of_dict(one, found.problem, file) for one in task["steps"])
            rejected = {str(reason): int(count) for reason, count in task["goals_rejected"].items()}
            schedule = tuple(StepTimes(*map(float, one)) for one in task["schedule"])
            examined = int(task["goals_examined"])
            return replace(found, steps=steps, goals_examined=examined, goals_rejected=rejected, schedule=schedule)
        except (*BROKEN, ApexError, AttributeError) as error:
            raise FileFormatError(file, "task", str(error), "expected the result of a task") from error


def load_result(path: str | os.PathLike[str]) -> PlanResult:
    """Read a saved result of a plan, or that of a task as a :class:`TaskResult`.

    Raises:
        ApexError: As :meth:`apex_ompl.PlanResult.load`.
    """
    found = PlanResult.load(path)
    return TaskResult.load(path) if "task" in _data_of(os.fspath(path)) else found


def _data_of(file: str) -> dict[str, Any]:
    """Return the record of a saved result."""
    if file.endswith(".npz"):
        return read_archive(pathlib.Path(file), "result", "result file")[0]
    data: dict[str, Any] = (read_json if file.endswith(".json") else read_yaml)(pathlib.Path(file), "result file")
    return data


def _number(value: float) -> float | None:
    """Return a number, or None for NaN or infinity."""
    return None if isnan(value) or value in (float("inf"), -float("inf")) else value


def _plain(body: Obstacle | AttachedObject) -> dict[str, Any]:
    """Return a body as plain data."""
    found: dict[str, Any] = body.model_dump(mode="json", by_alias=True, exclude_none=True, exclude_defaults=True)
    return found
