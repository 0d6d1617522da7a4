"""A saved run of the closed loop, played in a browser."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from apex_ompl.loop.result import RunResult
from apex_ompl.ompl.setup import assemble
from apex_ompl.result import PlanResult
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.scene.problem import Problem
from apex_ompl.scene.scripts import is_there, obstacle_at
from apex_ompl.timing import Trajectory
from apex_ompl.types import Array
from apex_ompl.viz.appearance import SILENT_EVENTS
from apex_ompl.viz.sources import robot_of
from apex_ompl.viz.viewer.run import ShownRun
from apex_ompl.viz.viewer.scene import BrowserScene
from apex_ompl.viz.viewer.shown import Shown


@dataclass(eq=False)
class SavedRun(ShownRun):
    """A run from a file: the robot along what it executed, obstacles along their scripts, and events as labels.

    Attributes:
        run: The run.
    """

    run: RunResult | None = None
    has_ended: bool = True

    @classmethod
    def of_run(cls, run: RunResult, name: str = "") -> SavedRun:
        """Make a run ready.

        Raises:
            ApexError: The robot or a body cannot be loaded, or the robot is not the one of the run.
        """
        shown = cls(name or run.problem.name, assemble(run.problem, robot_of(run)), run=run)
        for event in run.events:
            if event.kind not in SILENT_EVENTS:
                shown.feed_event(event.time, event.kind)
        return shown

    @property
    def motion(self) -> Trajectory:
        """What the robot did."""
        assert self.run is not None
        return self.run.trajectory

    @property
    def dynamic(self) -> tuple[Obstacle, ...]:
        """The obstacles that moved, with their scripts."""
        return tuple(o for o in self.setup.problem.scene if o.moving)

    @property
    def duration(self) -> float:
        """Duration of the run [s]."""
        return max(self.motion.duration, super().duration)

    def state(self, time: float) -> Array:
        """Return the state at a time, shape (dof,)."""
        return np.asarray(self.motion(time))

    def draw(self, scene: BrowserScene, time: float) -> None:
        """Show the run at a time [s] in its scene."""
        super().draw(scene, time)
        for obstacle in self.dynamic:
            pose = obstacle_at(obstacle, time).pose if is_there(obstacle, time) else None
            scene.show_obstacle(obstacle.name, pose)

    @property
    def ends(self) -> tuple[tuple[str, Array | None, str], ...]:
        """Name, state and fault of start and goal: where the run ended if it reached the goal, else a goal state."""
        reached, goals = bool(self.run), self.setup.goals
        goal = self.motion.positions[-1] if reached or not len(goals) else goals[0]
        return ("start", self.motion.positions[0], ""), ("goal", goal, "")

    @property
    def facts(self) -> list[str]:
        """Facts, a sentence each; the first is its name."""
        run = self.run
        assert run is not None
        rows = [self.name, f"{run.method}, prediction {run.prediction}: {run.outcome} after {self.duration:.2f} s"]
        return [*rows, *filter(None, [run.reason, summary(run)])]

    @cached_property
    def curves(self) -> dict[str, Array]:
        """Curves over ``time`` [s]: ``clearance`` [mm] and the use of limits, by name."""
        return self.curves_of(self.motion, self.dynamic)


def summary(run: RunResult) -> str:
    """Return the main metrics of a run in one line; those that it lacks are left out."""
    words = (
        ("replans_accepted", "{:.0f} replans", 1.0), ("stops", "{:.0f} stops", 1.0),
        ("rest_time", "{:.2f} s at rest", 1.0), ("clearance", "at least {:.0f} mm from dynamic obstacles", 1e3),
        ("reaction_p95", "reaction p95 {:.0f} ms", 1e3),
    )  # fmt: skip
    return ", ".join(text.format(unit * run.metrics[name]) for name, text, unit in words if name in run.metrics)


def shown_of(source: Problem | PlanResult | RunResult, name: str = "") -> Shown:
    """Make a problem, a plan or a run ready to be shown.

    Raises:
        ApexError: The robot or a body cannot be loaded, or the robot is not the one of the result.
    """
    return SavedRun.of_run(source, name) if isinstance(source, RunResult) else Shown.of(source, name)
