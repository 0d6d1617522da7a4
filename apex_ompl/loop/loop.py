"""The loop by steps, for sensors and robots of others: observations in, commands out.

A command says what the robot follows from the next step on, and the proved stop after it, as one motion that ends
at rest: a robot that gets no further command comes to rest along it.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from types import TracebackType
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from apex_ompl.errors import ParameterError
from apex_ompl.loop.clocks import cores, warm_up
from apex_ompl.loop.control import Control, Decided, RunRecord, undo
from apex_ompl.loop.environment import Observation
from apex_ompl.loop.preparation import context_of, work_of
from apex_ompl.loop.replan.methods import method_of
from apex_ompl.loop.replanning import ImmediateReplanning, PlannerProcess, Replanning
from apex_ompl.loop.result import Event, Outcome
from apex_ompl.moving.context import SAME_TIME, Following
from apex_ompl.moving.dynamic_obstacles import DynamicObstacles
from apex_ompl.moving.replanner import Replanner
from apex_ompl.moving.settings import FOLLOWED, LoopSettings
from apex_ompl.ompl.process import quiet_ompl, seed_ompl
from apex_ompl.planning.cloud_files import CloudFiles
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.scene.problem import Problem
from apex_ompl.timing import Trajectory
from apex_ompl.types import Array
from apex_ompl.util.display import fields_line, one_line
from apex_ompl.util.schema import validate
from apex_ompl.util.validation import check_number, check_seed, number_array

POINT_RADIUS = 0.01  # of the balls around the points of a cloud [m]
TOLERANCE = 0.05  # largest distance of a joint from where it should be [rad]
OUTCOMES = {"stuck": Outcome.STUCK, "timeout": Outcome.TIMEOUT, "aborted": Outcome.ABORTED}


@dataclass(frozen=True, eq=False)
class Command:
    """What a robot is to do from a time on, until another command takes its place.

    Attributes:
        at: Time from which on it holds, on the caller's clock [s].
        motion: What the robot follows, and ends at rest: its motion until the step after that time, then
            the stop that is proved. At rest it has one knot.
        to_goal: Whether the robot is on its way to a goal, or at one.
    """

    at: float
    motion: Trajectory
    to_goal: bool

    __repr__ = fields_line

    @property
    def rests(self) -> bool:
        """Whether the robot stays where it is."""
        return len(self.motion.times) == 1


class Loop:
    """The closed loop by steps, on the caller's clock and in the caller's thread.

    ``observe`` takes what a sensor saw, ``step`` decides what the robot does, once in each period of the settings. What
    is decided in a period holds from the next one on. The guarantee is that of :func:`apex_ompl.run`: while no obstacle
    is faster than ``settings.fastest``, and each is seen within ``settings.error``, the robot is at rest when touched.

    Attributes:
        joint_names: Names of the joints, in the order of states.
        settings: The settings.
    """

    def __init__(
        self, problem: Problem, method: str | Replanner = "apex", *, settings: LoopSettings, speed: float = 1.0,
        seed: int = 0, process: bool = True, tolerance: float = TOLERANCE, awaited: Iterable[str] = (),
    ) -> None:  # fmt: skip
        """Set up the loop with the robot at rest at the start of a problem.

        Args:
            problem: Robot, static obstacles, held objects, start and goal; obstacles that move are left out.
            method: Name of a replanner, or one.
            settings: The settings, with ``error`` and ``fastest``.
            speed: Share of the velocity limits that is used, more than 0 to 1.
            seed: Seed of random choices.
            process: Whether replans are made in a process of their own, as a robot needs it. Otherwise they are made
                in ``step``, and their answers are available after modeled computing times.
            tolerance: Largest distance of a joint from where it should be, at which the robot is still followed [rad].
            awaited: Names of obstacles that must be seen before the robot moves.

        Raises:
            ApexError: The problem, a name or a number is unknown or faulty, or the start or all goals are invalid.
            PlannerProcessError: The planner process did not become ready.
        """
        check_seed(seed)
        if not isinstance(problem, Problem):
            raise ParameterError("problem", problem, "a Problem, as apex_ompl.load_problem returns it")
        if not isinstance(settings, LoopSettings):
            raise ParameterError("settings", settings, "a LoopSettings")
        replanning = method_of(method)
        used = replace(settings.completed(still_margin=FOLLOWED), **replanning.settings)
        with quiet_ompl():
            seed_ompl(seed)
            context = context_of(problem, used, speed, seed)
            fault = context.setup.start_fault or ("" if len(context.goals) else "; ".join(context.setup.goal_faults))
            if fault:
                raise ParameterError("problem", fault, "a valid start and a valid goal")
            warm_up(context, (), seed)
            self._process: PlannerProcess | None = None
            if process:
                self._process = PlannerProcess(work_of(context, method, seed), cores()[1])
                self._process.__enter__()
            else:
                replanner = replanning.make()
                replanner.prepare(context)
        answers: Replanning = self._process or ImmediateReplanning(context, replanner)
        self._begin(Control(context, answers, seed, awaited=awaited, lead=used.period), tolerance)

    @classmethod
    def around(cls, control: Control, tolerance: float, zero: float) -> Loop:
        """Return the loop by steps of a control whose lead is a period; its planner is the caller's to end.

        Args:
            control: The control.
            tolerance: Largest distance of a joint from where it should be, at which the robot is still followed [rad].
            zero: Time on the caller's clock at which the control's starts [s].
        """
        loop = cls.__new__(cls)
        loop._process = None
        loop._begin(control, tolerance)
        loop._zero = zero
        return loop

    def _begin(self, control: Control, tolerance: float) -> None:
        check_number(tolerance, "tolerance", 0.0, math.pi)
        self.settings, self.joint_names, self._tolerance = control.context.settings, control.context.names, tolerance
        self._control = control
        self._before = Decided.of(control.executor)
        self._waiting = deque[Observation]()
        self._clouds, self._observing = CloudFiles(), threading.Lock()
        self._zero: float | None = None
        self._now, self._next, self._known = -math.inf, 0, -math.inf
        self._record: RunRecord | None = None

    def __repr__(self) -> str:
        """Return what the robot does."""
        doing = "not started" if self._zero is None else f"{len(self.events)} events in {self._now:.2f} s"
        return one_line("Loop", repr(self._control.context.setup.problem.name), doing, self.outcome or "", self.reason)

    def __enter__(self) -> Self:
        """Return the loop."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End the planner process."""
        self.close()

    def close(self) -> None:
        """End the planner process."""
        if self._process is not None:
            self._process.close()

    @property
    def record(self) -> RunRecord | None:
        """What happened, once the run is over; None before."""
        return self._record

    @property
    def outcome(self) -> Outcome | None:
        """How the run ended, or None while it goes on."""
        if self._record is None:
            return None
        return Outcome.REACHED if self._record.reached else OUTCOMES[self._record.ended]

    @property
    def reason(self) -> str:
        """Why the run ended or is about to, where that is known."""
        return self._control.aborted if self._record is None else self._record.reason

    @property
    def events(self) -> tuple[Event, ...]:
        """What happened so far, with times on the caller's clock."""
        zero = self._zero or 0.0
        return tuple(replace(event, time=zero + event.time) for event in self._control.executor.events)

    def observe(
        self, stamp: float, objects: Iterable[Obstacle] = (), *, errors: Mapping[str, ArrayLike] | None = None,
        clouds: Mapping[str, ArrayLike] | None = None, radius: float = POINT_RADIUS, bounds: bool = False,
        velocities: Mapping[str, tuple[ArrayLike, float]] | None = None,
    ) -> None:  # fmt: skip
        """Take an observation of obstacles that move, or may; may be called from any thread.

        One that cannot be true (a place that is not finite, a stamp in the future) is refused as a whole at the next
        step, and an event says so; the robot stops where no observation was usable for ``settings.silence``.

        A cloud replaces the last one of its name, as a whole. Its points are not tracked: each may move at
        ``settings.fastest`` from where it was seen. So between two clouds the robot keeps clear of balls around all
        points, which grow, and which are never forgotten. A cloud of 50 000 points takes 60 ms: where that is much of a
        period, call this from a thread of its own.

        Args:
            stamp: When they were where they were seen, on the caller's clock [s].
            objects: The obstacles with their shapes where they were seen, by name, without velocities. A known obstacle
                that is missing here was not seen, which tells nothing about where it is.
            errors: Errors of their positions by name, in place of ``settings.error``: largest distances [m], or
                covariances, shape (3, 3) [m^2], of which three standard deviations along the longest axis count.
            clouds: Points that a depth camera saw, by the name of the camera, shape (N, 3) [m], as large as
                obstacles: each point of an obstacle that may touch the robot before the next cloud is within
                ``radius`` and ``settings.error`` of one. Without points, nothing is there.
            radius: Radius of the balls around the points of clouds [m].
            bounds: Whether shapes are bounds that contain the obstacles and change as more of them is seen
                (:class:`apex_ompl.loop.Observation`).
            velocities: Velocities, shape (3,), and their standard deviations on each axis [m/s] by name, as a sensor
                knows them that tracks obstacles itself. They count where they are known better than by the places.

        Raises:
            ParameterError: The stamp is no number, an object is no Obstacle, errors, clouds or velocities are not given
                by name, or a cloud has another shape.
            FileFormatError: The radius is not positive, or the name of a cloud is none for an obstacle.
        """
        for name, given in (("errors", errors), ("clouds", clouds), ("velocities", velocities)):
            if not isinstance(given, Mapping | None):
                raise ParameterError(name, given, "a mapping by names")
        seen = tuple(objects)
        for one in seen:
            if not isinstance(one, Obstacle):
                raise ParameterError("objects", one, "obstacles")
        at = float(number_array(stamp, "stamp", "a number"))
        with self._observing:
            found = {name: self._cloud(name, points, radius) for name, points in (clouds or {}).items()}
            bodies = tuple(body for body in found.values() if body is not None)
            gone = tuple(name for name, body in found.items() if body is None)
            self._waiting.append(
                Observation(at, at, (*seen, *bodies), dict(errors or {}), gone, bounds, dict(velocities or {}))
            )

    def _cloud(self, name: str, points: ArrayLike, radius: float) -> Obstacle | None:
        """Return the obstacle of a cloud, in the files that a planner process reads; None without points.

        Where a point is not finite its position is not either, so that the observation is refused.
        """
        cloud = number_array(points, "clouds", "points")
        if cloud.ndim != 2 or cloud.shape[1] != 3:
            raise ParameterError("clouds", cloud.shape, f"an array of shape (N, 3) for {name}")
        if not len(cloud):
            return None
        path = self._clouds.path(None)
        body = validate(Obstacle, {"name": name, "points": {"file": str(path), "radius": radius}}, "cloud")
        if not np.isfinite(cloud).all():
            return body.model_copy(update={"position": (math.nan,) * 3})
        self._clouds.write(cloud, path, self._cloud_files())
        DynamicObstacles([body])  # whose grid of distances is kept
        return body

    def _cloud_files(self) -> set[str]:
        """Return the files of clouds that are tracked or wait."""
        tracker = self._control.tracker
        known = [track.shape for track in (*tracker.tracks.values(), *tracker.doubted)]
        known += [one for observation in tuple(self._waiting) for one in observation.seen]
        return {one.points.file for one in known if one.points is not None}

    def abort(self, why: str) -> None:
        """Let the robot come to rest and end the run for a reason; may be called from any thread."""
        self._control.abort(why)

    def step(self, now: float, state: Array | None = None, stamp: float | None = None) -> Command | None:
        """Decide what the robot does, and return it; None where nothing new was decided.

        That is so in a period that was decided before, when the run is over, and where the clock went back, which ends
        the run: the robot then comes to rest along the last command.

        Args:
            now: Time on the caller's clock [s]; it starts at the first step.
            state: The measured positions of the joints, shape (dof,), or None where they are not known now. Where a
                joint is further than the tolerance from where it should be, and, once there was a state, where none was
                usable for ``settings.silence``, the robot stops and the run ends. Where states are given, it does not
                start before one is usable.
            stamp: When they were measured [s], by default now. One that does not increase is not usable.

        Raises:
            ParameterError: A time is not finite.
        """
        check_number(now, "now")
        if stamp is not None:
            check_number(stamp, "stamp")
        if self._record is not None:
            return None
        self._zero = now if self._zero is None else self._zero
        elapsed = now - self._zero
        if elapsed < self._now - SAME_TIME:
            self.end(f"the clock went back by {self._now - elapsed:.3g} s")
            return None
        self._now = elapsed
        period, executor = self.settings.period, self._control.executor
        k = math.floor(elapsed / period + 1e-6)
        if k < self._next:
            return None
        if k > self._next:  # periods passed without a step, in which the robot follows the proved stop
            undo(executor, (self._next + 1) * period, Decided.of(executor))
        self._compare(elapsed, state, elapsed if stamp is None else min(stamp - self._zero, elapsed))
        while self._waiting:
            observation = self._waiting.popleft()
            since = observation.stamp - self._zero
            self._control.take(replace(observation, stamp=since, received=since), elapsed)
        self._before, self._next, then = Decided.of(executor), k + 1, (k + 1) * period
        try:
            with quiet_ompl():
                self._record = self._control.step(then)
        except BaseException:  # Ctrl-C among them: the robot follows what it was sent before
            undo(executor, then, self._before)
            raise
        return self._command(then)

    def missed(self) -> Command | None:
        """Undo the last step, whose command did not reach the robot before its time, and return what it follows."""
        if self._record is not None or not self._next:
            return None
        then = self._next * self.settings.period
        undo(self._control.executor, then, self._before)
        return self._command(then)

    def _command(self, then: float) -> Command:
        """Return what the robot follows from a time of the loop on [s]."""
        executor = self._control.executor
        one, stop = executor.following, executor.stop
        if stop is not None and stop is not one and not one.at_rest(then):
            one = Following(stop.motion, stop.start_time, one.to_goal)
            if stop.start_time > then + SAME_TIME:
                one = one.after(executor.following.piece(then, stop.start_time), then)
        motion = one.piece(then, max(one.end, then))
        return Command((self._zero or 0.0) + then, motion, one.to_goal)

    def _compare(self, now: float, state: Array | None, stamp: float) -> None:
        """Stop where the robot is not where it should be, or where that was not known for too long.

        Args:
            now: Time of the loop [s].
            state: The measured positions, shape (dof,), or None.
            stamp: When they were measured [s].
        """
        wanted = self._control.executor.state_then(stamp)
        usable = state is not None and np.shape(state) == wanted.shape and bool(np.isfinite(state).all())
        if usable and stamp > self._known:
            self._known = stamp
            off = np.abs(np.asarray(state) - wanted)
            k = int(off.argmax())
            if off[k] > self._tolerance:
                self.abort(f"{self.joint_names[k]} is {off[k]:.3g} rad from where it should be")
        elif (state is not None or self._known > -math.inf) and now - max(self._known, 0.0) > self.settings.silence:
            self.abort(f"no state of the robot was usable for {self.settings.silence:g} s")
        executor = self._control.executor
        executor.unmeasured = self._known == -math.inf and (state is not None or executor.unmeasured)

    def end(self, why: str) -> None:
        """End the run at once for a reason: the robot follows the last command to its end."""
        control, then = self._control, (self._next + 1) * self.settings.period
        control.abort(why)
        undo(control.executor, then, Decided.of(control.executor))
        self._record = control.ended(max(control.executor.following.end, then), False, "aborted")
