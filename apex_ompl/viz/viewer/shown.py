"""The sources of a page: problems and results, prepared with their motions."""

from __future__ import annotations

import html
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from apex_ompl.ompl.setup import PlanningSetup, assemble
from apex_ompl.paths.path import resample
from apex_ompl.planning.task_result import TaskResult
from apex_ompl.result import PlanResult
from apex_ompl.robot.identity import load_same_robot
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.scene.problem import Problem
from apex_ompl.scene.scripts import is_there, obstacle_at
from apex_ompl.timing import Trajectory
from apex_ompl.types import Array
from apex_ompl.viz.sources import ORDERS, clearances, clearances_of, shares_of_limits
from apex_ompl.viz.viewer.scene import BrowserScene

UNTIMED, STATES = 4.0, 120  # how long a path without times plays [s], and its states
CURVE_SAMPLES = 160
APART = 3.0  # distance of scenes side by side [m]
MARKS = re.compile(r"([\\`*_\[\]#|~])")  # that mean something in Markdown


@dataclass(eq=False)
class Shown:
    """A problem or a result that is shown.

    Attributes:
        name: Its title.
        setup: The prepared problem.
        result: The result, or None.
    """

    name: str
    setup: PlanningSetup
    result: PlanResult | None = None

    @property
    def grows(self) -> bool:
        """Whether its motion becomes longer while it is shown."""
        return False

    @property
    def is_editable(self) -> bool:
        """Whether its problem can be edited and planned."""
        return True

    @classmethod
    def of(cls, source: Problem | PlanResult, name: str = "") -> Shown:
        """Prepare a problem or a result.

        Raises:
            ApexError: The robot or a body cannot be loaded, or the robot has changed since the result.
        """
        if isinstance(source, Problem):
            return cls(name or source.name, assemble(source))
        robot = load_same_robot(source.problem.robot, source.robot_digest)
        return cls(name or source.problem.name, assemble(source.problem, robot), source)

    @property
    def duration(self) -> float:
        """How long its motion plays, 0 without one [s]."""
        if self.result is None or self.result.path is None:
            return 0.0
        motion = self.result.trajectory
        return UNTIMED if motion is None else float(motion.duration)

    @cached_property
    def _untimed(self) -> Array:
        assert self.result is not None and self.result.path is not None
        return resample(self.result.path.states, STATES)

    def state(self, time: float) -> Array:
        """Return the state at a time, shape (dof,); the start without a motion."""
        duration = self.duration
        if duration <= 0.0 or self.result is None:
            return self.setup.start
        time = min(max(time, 0.0), duration)
        if self.result.trajectory is not None:
            return np.asarray(self.result.trajectory(time))
        return np.asarray(self._untimed[min(STATES - 1, round(time / duration * (STATES - 1)))])

    def draw(self, scene: BrowserScene, time: float) -> None:
        """Show it at a time [s] in its scene, with the dynamic obstacles that its motion was proved among."""
        scene.show(self.state(time))
        at = min(max(time, 0.0), self.duration)
        for obstacle in self._dynamic:
            scene.show_obstacle(obstacle.name, obstacle_at(obstacle, at).pose if is_there(obstacle, at) else None)
        if isinstance(self.result, TaskResult) and self.result.trajectory is not None:
            for name, pose in self.result.object_poses(self.setup.robot, at).items():
                scene.show_object(name, pose)

    @cached_property
    def _dynamic(self) -> tuple[Obstacle, ...]:
        names = () if self.result is None else self.result.dynamic_obstacles
        return tuple(o for o in self.setup.problem.scene if o.name in names)

    def states(self, count: int) -> list[Array]:
        """Return states at an even pace of time."""
        return [self.state(t) for t in np.linspace(0.0, self.duration, count)]

    @cached_property
    def curves(self) -> dict[str, Array]:
        """Curves of a timed motion over ``time`` [s]: ``clearance`` [mm] and the use of limits, by name."""
        if self.result is None or self.result.trajectory is None:
            return {}
        found = self.curves_of(self.result.trajectory, self._dynamic)
        if isinstance(self.result, TaskResult):
            found["clearance"] = 1e3 * clearances_of(self.result, self.setup.checker, found["time"])
        return found

    def curves_of(self, motion: Trajectory, dynamic: Sequence[Obstacle]) -> dict[str, Array]:
        """Return the curves of a motion among dynamic obstacles."""
        times = np.linspace(0.0, motion.duration, CURVE_SAMPLES)
        shares = np.abs(shares_of_limits(motion, self.setup.robot, times)).max(axis=2)
        found = {"time": times, "clearance": 1e3 * clearances(self.setup.checker, motion, times, dynamic)}
        return {**found, **dict(zip(ORDERS, shares, strict=True))}

    @property
    def ends(self) -> tuple[tuple[str, Array | None, str], ...]:
        """Name, state and fault of start and goal; faults are empty where they are valid.

        The goal of a result is where its path ends; of a problem, the first valid one. A goal in the workspace that was
        not reached has a fault and no state.
        """
        ready = self.setup
        start = "start", ready.start, ready.start_fault
        if self.result is not None and self.result.path is not None:
            return start, ("goal", self.result.path.states[-1], "")
        if not len(ready.goals):
            return start, *(("goal", None, fault) for fault in ready.goal_faults[:1])
        k = next((k for k in range(len(ready.goals)) if not ready.goal_faults[k]), 0)
        return start, ("goal", ready.goals[k], ready.goal_faults[k])

    @property
    def facts(self) -> list[str]:
        """Facts, a sentence each; the first is its name."""
        result = self.result
        if result is None:
            held = len(self.setup.problem.attached)
            rows = [self.name, f"{len(self.setup.problem.scene)} obstacles, {held} held objects"]
        else:
            said = f"{result.planner}: {result.status.value}" + (f", by {result.solved_by}" if result else "")
            if result.path is not None:
                said += f"; {result.length:.2f} rad, clearance {1e3 * result.clearance:.1f} mm"
            if result.trajectory is not None:
                said += f"; {result.trajectory.duration:.2f} s by {result.timing_method}"
            rows = [self.name, said, *filter(None, [result.reason])]
        return rows + [f"{name}: {fault}" for name, _, fault in self.ends if fault]


def markdown(rows: Sequence[str]) -> str:
    """Return sentences as Markdown that shows them literally."""
    return "\n\n".join(html.escape(MARKS.sub(r"\\\1", row)) for row in rows)


def ordered(sources: Sequence[Shown]) -> list[tuple[Shown, tuple[float, float, float]]]:
    """Return the sources with their positions: side by side from the robot's left to its right [m]."""
    return [(one, (0.0, -APART * k, 0.0)) for k, one in enumerate(sources)]
