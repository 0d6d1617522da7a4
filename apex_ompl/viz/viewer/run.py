"""Runs among dynamic obstacles in a page: layers with time stamps, fed live, and saved runs that are played."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from apex_ompl.errors import ParameterError
from apex_ompl.loop.result import RunResult
from apex_ompl.ompl.setup import assemble
from apex_ompl.result import PlanResult
from apex_ompl.scene.bodies import MOTION, Obstacle
from apex_ompl.scene.problem import Problem
from apex_ompl.scene.scripts import is_there, obstacle_at
from apex_ompl.timing import Trajectory
from apex_ompl.types import Array
from apex_ompl.util.validation import check_array, check_nonnegative
from apex_ompl.viz.appearance import RUN_COLORS, RUN_OPACITIES, SILENT_EVENTS, body_item
from apex_ompl.viz.sources import robot_of
from apex_ompl.viz.viewer.scene import BrowserScene, add_item, turn_of
from apex_ompl.viz.viewer.shown import Shown

BODIES, MOTIONS = ("true", "observed", "predicted"), ("committed", "stop")
EVENTS = "events"
EVENT_HEIGHT = 1.35  # of the label of the last event [m]
EVENT_TIME = 1.0  # how long it is shown [s]


@dataclass(eq=False)
class ShownRun(Shown):
    """A run: the robot's states, and layers of obstacles, motions and events, each with a time.

    Layers of obstacles are ``true``, ``observed`` and ``predicted``; of motions ``committed``, the motion that the
    robot will execute, and ``stop``, its fail-safe stop; ``events`` are texts. A layer shows the last entry fed before
    the shown time. One thread may feed it while another shows it.

    Attributes:
        has_ended: Whether the run has ended, so that it is played from its start.
    """

    has_ended: bool = False
    _times: dict[str, list[float]] = field(default_factory=dict)
    _values: dict[str, list[Any]] = field(default_factory=dict)
    _nodes: LayerNodes | None = None

    @property
    def grows(self) -> bool:
        """Whether the run is still fed; set ``has_ended`` when it is not."""
        return not self.has_ended

    @property
    def is_editable(self) -> bool:
        """Whether its problem can be edited: never for a run."""
        return False

    def feed_state(self, time: float, q: Array) -> None:
        """Feed the robot's state at a time [s], shape (dof,).

        Raises:
            ParameterError: Another shape, or a time before the last one.
        """
        check_array(np.asarray(q, float), (self.setup.robot.dof,), "state", finite=True)
        self._feed("robot", time, np.array(q, float))

    def feed_bodies(self, layer: str, time: float, bodies: Sequence[Obstacle]) -> None:
        """Feed the obstacles of a layer from a time [s] on.

        Raises:
            ParameterError: There is no such layer, or a time before the last one.
        """
        _check_layer(layer, BODIES)
        self._feed(layer, time, {body.name: body for body in bodies})

    def feed_motion(self, layer: str, time: float, states: Array) -> None:
        """Feed the motion of a layer from a time [s] on: states of shape (N, dof), none for no motion.

        Raises:
            ParameterError: There is no such layer, another shape, or a time before the last one.
        """
        _check_layer(layer, MOTIONS)
        check_array(np.asarray(states, float), ("N", self.setup.robot.dof), "states", finite=True)
        self._feed(layer, time, np.array(states, float))

    def feed_event(self, time: float, text: str) -> None:
        """Feed an event at a time [s].

        Raises:
            ParameterError: A time before the last one.
        """
        self._feed(EVENTS, time, (time, text))

    def _feed(self, layer: str, time: float, value: Any) -> None:
        check_nonnegative(time, "time")
        times = self._times.setdefault(layer, [])
        if times and time < times[-1]:
            raise ParameterError("time", time, f"at least {times[-1]}, that of the last {layer}")
        self._values.setdefault(layer, []).append(value)
        times.append(float(time))  # last: a page may be reading in another thread, by the times

    @property
    def duration(self) -> float:
        """Time of the last entry that was fed [s]."""
        return max((times[-1] for times in self._times.values()), default=0.0)

    def state(self, time: float) -> Array:
        """Return the state at a time, between those that were fed; shape (dof,)."""
        times, values = self._times.get("robot", []), self._values.get("robot", [])
        k = bisect_right(times, time)
        if k == 0 or k == len(times):
            return np.asarray(values[min(k, len(values) - 1)] if values else self.setup.start)
        share = (time - times[k - 1]) / (times[k] - times[k - 1])
        return np.asarray(values[k - 1] + share * (values[k] - values[k - 1]))

    def latest(self, layer: str, time: float) -> tuple[int, Any]:
        """Return number and content of a layer's entry at a time; -1 and None before the first."""
        k = bisect_right(self._times.get(layer, []), time) - 1
        return k, None if k < 0 else self._values[layer][k]

    def draw(self, scene: BrowserScene, time: float) -> None:
        """Show the run at a time in its scene."""
        scene.show(self.state(time))
        if self._nodes is None or self._nodes.scene is not scene:
            self._nodes = LayerNodes(scene)
        self._nodes.show(self, time)


class LayerNodes:
    """Nodes of the layers of a run; only what changes is sent.

    Attributes:
        scene: The scene that they are drawn in.
    """

    def __init__(self, scene: BrowserScene) -> None:
        """Draw below the root of a scene."""
        self.scene = scene
        self._shown: dict[str, int] = {}
        self._bodies: dict[str, dict[str, tuple[Obstacle, Any]]] = {layer: {} for layer in BODIES}
        self._motions: dict[str, Any] = {}
        self._event: tuple[int, Any] | None = None

    def show(self, run: ShownRun, time: float) -> None:
        """Show all layers as they are at a time."""
        for layer in (*BODIES, *MOTIONS):
            number, value = run.latest(layer, time)
            if self._shown.get(layer, -1) == number:
                continue
            self._shown[layer] = number
            if layer in BODIES:
                self._show_bodies(layer, value or {})
            else:
                self._show_motion(layer, value)
        self._show_event(*run.latest(EVENTS, time), time)

    def _show_bodies(self, layer: str, bodies: Mapping[str, Obstacle]) -> None:
        known = self._bodies[layer]
        for name in [name for name in known if name not in bodies]:
            known.pop(name)[1].remove()
        for name, body in bodies.items():
            before = known.get(name)
            if before is not None and _same_shape(before[0], body):
                before[1].wxyz, before[1].position = turn_of(body.pose), body.pose[:3, 3]
                known[name] = body, before[1]
                continue
            if before is not None:
                before[1].remove()
            item = replace(body_item(body, layer), color=RUN_COLORS[layer], opacity=RUN_OPACITIES[layer])
            handle = add_item(self.scene.api, self.scene.root, item)
            known[name] = body, handle

    def _show_motion(self, layer: str, states: Array | None) -> None:
        old = self._motions.pop(layer, None)
        if old is not None:
            old.remove()
        if states is not None and len(states) > 1:
            self._motions[layer] = self.scene.show_lines(layer, [states], RUN_COLORS[layer], 0.008)

    def _show_event(self, number: int, event: tuple[float, str] | None, time: float) -> None:
        late = event is None or time - event[0] > EVENT_TIME
        if self._event is not None and (late or self._event[0] != number):
            self._event[1].remove()
            self._event = None
        if event is not None and not late and self._event is None:
            path, at = f"{self.scene.root}/event", (0.0, 0.0, EVENT_HEIGHT)
            self._event = number, self.scene.api.add_label(path, event[1], position=at)


def _same_shape(first: Obstacle, second: Obstacle) -> bool:
    left = {"position", "orientation", *MOTION}
    return first.model_dump(exclude=left) == second.model_dump(exclude=left)


def _check_layer(layer: str, known: Sequence[str]) -> None:
    if layer not in known:
        raise ParameterError("layer", layer, f"one of {', '.join(known)}")


@dataclass(eq=False)
class SavedRun(ShownRun):
    """A run from a file: the robot along its executed motion, obstacles along their scripts, and events as labels.

    Attributes:
        run: The run.
    """

    run: RunResult | None = None
    has_ended: bool = True

    @classmethod
    def of_run(cls, run: RunResult, name: str = "") -> SavedRun:
        """Prepare a run.

        Raises:
            ApexError: The robot or a body cannot be loaded, or the robot has changed since the run.
        """
        shown = cls(name or run.problem.name, assemble(run.problem, robot_of(run)), run=run)
        for event in run.events:
            if event.kind not in SILENT_EVENTS:
                shown.feed_event(event.time, event.kind)
        return shown

    @property
    def motion(self) -> Trajectory:
        """The executed motion."""
        assert self.run is not None
        return self.run.trajectory

    @property
    def dynamic(self) -> tuple[Obstacle, ...]:
        """The dynamic obstacles, with their scripts."""
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
    """Prepare a problem, a plan or a run to be shown.

    Raises:
        ApexError: The robot or a body cannot be loaded, or the robot has changed since the result.
    """
    return SavedRun.of_run(source, name) if isinstance(source, RunResult) else Shown.of(source, name)
