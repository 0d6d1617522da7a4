"""A run of the closed loop: an environment, a sensor, a robot that replans, and a referee."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from apex_ompl.collision import CollisionChecker
from apex_ompl.errors import ParameterError
from apex_ompl.loop.clocks import cores, run_in_real_time, simulate
from apex_ompl.loop.control import RunRecord
from apex_ompl.loop.environment import Environment
from apex_ompl.loop.metrics import run_metrics
from apex_ompl.loop.preparation import context_of, work_of
from apex_ompl.loop.referee import judge
from apex_ompl.loop.replan.methods import method_of
from apex_ompl.loop.replanning import PlannerProcess
from apex_ompl.loop.result import Event, Outcome, RunResult
from apex_ompl.loop.sensor import Sensor, SensorStream
from apex_ompl.moving.compute_costs import cost_table
from apex_ompl.moving.context import RunContext
from apex_ompl.moving.replanner import Replanner
from apex_ompl.moving.settings import LoopSettings
from apex_ompl.ompl.process import quiet_ompl, seed_ompl
from apex_ompl.robot.model import digest
from apex_ompl.scene.problem import Problem
from apex_ompl.scene.scripts import obstacle_at
from apex_ompl.timing import Trajectory
from apex_ompl.util.validation import check_name, check_seed

CLOCKS = ("sim", "real")


def run_in(
    environment: Environment, method: str | Replanner = "apex", *, clock: str = "sim", prediction: str = "cv",
    seed: int = 0, speed: float = 1.0, settings: LoopSettings | None = None, sensor: Sensor | None = None,
) -> RunResult:  # fmt: skip
    """Let a robot go to a goal in an environment whose obstacles move; see :func:`apex_ompl.run` for the arguments.

    Raises:
        ApexError: The environment was used before, or the problem, a name or a number is unknown or faulty.
    """
    check_name(clock, "clock", CLOCKS)
    check_seed(seed)
    if settings is not None and not isinstance(settings, LoopSettings):
        raise ParameterError("settings", settings, "a LoopSettings")
    replanning = method_of(method)
    if environment.ran:
        raise ParameterError("problem", environment.name, "an environment without a run so far: load it again")
    sensor = sensor or Sensor(seed=seed)
    settings = (settings or LoopSettings()).completed(sensor.largest_error, environment.fastest)
    used = replace(replace(settings, prediction=prediction), **replanning.settings)
    environment.ran = True
    with quiet_ompl():
        seed_ompl(seed)
        context = context_of(environment.problem, used, speed, seed)
        setup = context.setup
        noted = {"loop": asdict(used), "sensor": asdict(sensor), "speed": speed, "costs": cost_table()["version"]}
        run = _Run(environment, context, replanning.name, clock, seed, noted)
        fault = setup.start_fault
        if fault or not len(context.goals):
            still = np.zeros((1, len(setup.start)))
            motion = Trajectory(np.zeros(1), setup.start[None], still, still, context.names)
            outcome = Outcome.START_INVALID if fault else Outcome.STUCK
            done = RunRecord(motion, (), False, fault or "; ".join(setup.goal_faults), 0)
            return run.result(done, outcome, done.ended)
        stream = SensorStream(sensor, environment, used.watched)
        if clock == "real":
            with PlannerProcess(work_of(context, method, seed), cores()[1]) as process:
                done = run_in_real_time(environment, context, process, stream, seed)
        else:
            replanner = replanning.make()
            replanner.prepare(context)
            done = simulate(environment, context, replanner, stream, seed)
    return run.judged(done)


@dataclass(frozen=True, eq=False)
class _Run:
    """What a result says besides what happened."""

    environment: Environment
    context: RunContext
    method: str
    clock: str
    seed: int
    settings: Mapping[str, Any]

    def result(self, done: RunRecord, outcome: Outcome, reason: str, clearance: float = float("inf")) -> RunResult:
        """Return the result."""
        robot = self.context.setup.robot
        metrics = run_metrics(done.trajectory, done.events, robot.limits, clearance=clearance)
        metrics |= {**done.measured, **done.counts}
        return RunResult(
            outcome=outcome, reason=reason, problem=self.problem(), robot=robot.name, method=self.method,
            prediction=self.context.settings.prediction, clock=self.clock, seed=self.seed, trajectory=done.trajectory,
            events=done.events, metrics=metrics, settings=self.settings,
            robot_digest=digest(robot),
        )  # fmt: skip

    def judged(self, done: RunRecord) -> RunResult:
        """Return the result with the referee's report."""
        dynamic = [o.name for o in self.environment.script()]
        report = judge(
            self.context.setup.robot, self.problem(), done.trajectory, goals=self.context.goals, dynamic=dynamic
        )  # fmt: skip
        outcome, reason = report.outcome, "; ".join(report.faults)
        if outcome is None:
            ended = {"stuck": Outcome.STUCK, "timeout": Outcome.TIMEOUT, "aborted": Outcome.ABORTED}
            outcome = Outcome.MISALIGNED if done.reached else ended[done.ended]
            if not done.reached:
                time = done.trajectory.duration
                missed = f"no goal was reached in {time:.3g} s{self.blocked(time)}"
                reason = "; ".join(filter(None, (missed, done.reason)))
        contacts = [
            Event(one.time, "contact", {"first": one.first, "second": one.second, "moved": one.moved})
            for one in {report.contact, report.moving_contact}
            if one is not None
        ]
        done = replace(done, events=tuple(sorted((*done.events, *contacts), key=lambda event: event.time)))
        return self.result(done, outcome, reason, report.clearance)

    def blocked(self, time: float) -> str:
        """Return which moving obstacles are where the robot would be at every goal at a time [s], or nothing."""
        held = self.environment.problem.still.attached
        there = [obstacle_at(o, time) for o in self.environment.script() if o.appears <= time]
        checker, names = CollisionChecker(self.context.setup.robot, there, held), {o.name for o in there}
        met = [names & {name for c in checker.contacts(q) for name in (c.first, c.second)} for q in self.context.goals]
        if not all(met):
            return ""
        return f"; {', '.join(sorted(set().union(*met)))} stood where the robot would be at the goal"

    def problem(self) -> Problem:
        """Return the problem with the motions of its obstacles."""
        still: Problem = self.environment.problem.still
        return still.model_copy(
            update={"name": self.environment.name, "scene": (*still.scene, *self.environment.script())}
        )
