"""The loop by steps, for sensors and robots of others: observations in, commands out.

A command says what the robot follows from the next step on, and the proved stop after it, as one motion that ends
at rest: a robot that gets no further command comes to rest along it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from types import TracebackType
from typing import Self

import numpy as np

from apex_ompl.errors import ParameterError
from apex_ompl.loop.clocks import cores, warm_up
from apex_ompl.loop.control import Control, Decided, RunRecord, undo
from apex_ompl.loop.environment import Observation
from apex_ompl.loop.preparation import context_of, work_of
from apex_ompl.loop.replan.methods import method_of
from apex_ompl.loop.replanning import ImmediateReplanning, PlannerProcess, Replanning
from apex_ompl.loop.result import Event, Outcome
from apex_ompl.moving.context import SAME_TIME, Following
from apex_ompl.moving.replanner import Replanner
from apex_ompl.moving.settings import LoopSettings
from apex_ompl.ompl.process import quiet_ompl, seed_ompl
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.scene.problem import Problem
from apex_ompl.timing import Trajectory
from apex_ompl.types import Array
from apex_ompl.util.display import fields_line, one_line
from apex_ompl.util.validation import check_number, check_seed, number_array

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
        check_number(tolerance, "tolerance", 0.0, math.pi)
        if not isinstance(problem, Problem):
            raise ParameterError("problem", problem, "a Problem, as apex_ompl.load_problem returns it")
        if not isinstance(settings, LoopSettings):
            raise ParameterError("settings", settings, "a LoopSettings")
        replanning = method_of(method)
        used = replace(settings, **replanning.settings)
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
        self.settings, self.joint_names, self._tolerance = context.settings, context.names, tolerance
        self._control = Control(context, answers, seed, awaited=awaited, lead=used.period)
        self._before = Decided.of(self._control.executor)
        self._waiting: list[Observation] = []
        self._zero: float | None = None
        self._now, self._next, self._known, self._measured = -math.inf, 0, 0.0, False
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

    def observe(self, stamp: float, objects: Iterable[Obstacle]) -> None:
        """Take an observation of obstacles that move, or may.

        One that cannot be true (a place that is not finite, a stamp in the future) is refused as a whole at the next
        step, and an event says so; the robot stops where no observation was usable for ``settings.silence``.

        Args:
            stamp: When they were where they were seen, on the caller's clock [s].
            objects: The obstacles with their shapes where they were seen, by name, without velocities. A known obstacle
                that is missing here was not seen, which tells nothing about where it is.

        Raises:
            ParameterError: The stamp is no number, or an object is no Obstacle.
        """
        seen = tuple(objects)
        for one in seen:
            if not isinstance(one, Obstacle):
                raise ParameterError("objects", one, "obstacles")
        at = float(number_array(stamp, "stamp", "a number"))
        self._waiting.append(Observation(at, at, seen))

    def abort(self, why: str) -> None:
        """Let the robot come to rest and end the run for a reason; may be called from any thread."""
        self._control.abort(why)

    def step(self, now: float, state: Array | None = None) -> Command | None:
        """Decide what the robot does, and return it; None where nothing new was decided.

        That is so in a period that was decided before, when the run is over, and where the clock went back, which ends
        the run: the robot then comes to rest along the last command.

        Args:
            now: Time on the caller's clock [s]; it starts at the first step.
            state: The measured positions of the joints, shape (dof,), or None where they are not known now. Where a
                joint is further than the tolerance from where it should be, and, once there was a state, where none was
                usable for ``settings.silence``, the robot stops and the run ends.

        Raises:
            ParameterError: The time is not finite.
        """
        check_number(now, "now")
        if self._record is not None:
            return None
        self._zero = now if self._zero is None else self._zero
        elapsed = now - self._zero
        if elapsed < self._now - SAME_TIME:
            self._end(f"the clock went back by {self._now - elapsed:.3g} s")
            return None
        self._now = elapsed
        period, executor = self.settings.period, self._control.executor
        k = math.floor(elapsed / period + 1e-6)
        if k < self._next:
            return None
        if k > self._next:  # periods passed without a step, in which the robot follows the proved stop
            undo(executor, (self._next + 1) * period, Decided.of(executor))
        self._compare(elapsed, state)
        for observation in self._waiting:
            since = observation.stamp - self._zero
            self._control.take(replace(observation, stamp=since, received=since), elapsed)
        self._waiting.clear()
        self._before, self._next, then = Decided.of(executor), k + 1, (k + 1) * period
        with quiet_ompl():
            self._record = self._control.decide(then, self._control.predicted(then))
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

    def _compare(self, now: float, state: Array | None) -> None:
        """Stop where the robot is not where it should be, or where that was not known for too long."""
        wanted = self._control.executor.state(now)
        if state is not None and np.shape(state) == wanted.shape and np.isfinite(state).all():
            self._known, self._measured = now, True
            off = np.abs(np.asarray(state) - wanted)
            k = int(off.argmax())
            if off[k] > self._tolerance:
                self.abort(f"{self.joint_names[k]} is {off[k]:.3g} rad from where it should be")
        elif (state is not None or self._measured) and now - self._known > self.settings.silence:
            self.abort(f"no state of the robot was usable for {self.settings.silence:g} s")

    def _end(self, why: str) -> None:
        """End the run at once: the robot follows the last command to its end."""
        control, then = self._control, (self._next + 1) * self.settings.period
        control.abort(why)
        undo(control.executor, then, Decided.of(control.executor))
        self._record = control.ended(max(control.executor.following.end, then), False, "aborted")
