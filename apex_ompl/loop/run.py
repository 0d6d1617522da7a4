"""A run of the closed loop: an environment, a sensor, a robot that replans, and a referee."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack, closing
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from apex_ompl.collision import CollisionChecker
from apex_ompl.drivers.driver import Driver
from apex_ompl.drivers.kinematic import KinematicDriver
from apex_ompl.drivers.mujoco import MujocoDriver
from apex_ompl.errors import ParameterError
from apex_ompl.loop.clocks import cores, run_in_real_time, simulate, undisturbed, warm_up
from apex_ompl.loop.control import RunRecord
from apex_ompl.loop.cycle import Cycle
from apex_ompl.loop.driven import DrivenRun, LiveStream, check_driver
from apex_ompl.loop.environment import Environment, LiveSensor, ObservationSource
from apex_ompl.loop.loop import TOLERANCE
from apex_ompl.loop.metrics import run_metrics
from apex_ompl.loop.preparation import context_of, work_of
from apex_ompl.loop.referee import judge
from apex_ompl.loop.replan.methods import method_of
from apex_ompl.loop.replanning import ImmediateReplanning, PlannerProcess, Replanning
from apex_ompl.loop.result import Event, Outcome, RunResult
from apex_ompl.loop.sensor import Sensor, SensorStream
from apex_ompl.moving.compute_costs import cost_table
from apex_ompl.moving.context import RunContext
from apex_ompl.moving.replanner import Replanner
from apex_ompl.moving.settings import FOLLOWED, LoopSettings
from apex_ompl.ompl.process import quiet_ompl, seed_ompl
from apex_ompl.robot.identity import digest
from apex_ompl.robot.model import Robot
from apex_ompl.scene.problem import Problem
from apex_ompl.scene.scripts import obstacle_at
from apex_ompl.timing import Trajectory
from apex_ompl.util.validation import check_name, check_number, check_seed

DRIVERS = ("kinematic", "mujoco")
"""Names of drivers that can be made for a problem."""
SensorFactory = Callable[[Driver, Environment], LiveSensor]
"""Makes a sensor that needs the driver and the environment, such as :class:`apex_ompl.loop.Cameras`."""
CLOCKS = SIMULATED, REAL = "sim", "real"


def run_in(
    environment: Environment, method: str | Replanner = "apex", *, clock: str = "sim", prediction: str = "cv",
    seed: int = 0, speed: float = 1.0, settings: LoopSettings | None = None,
    sensor: Sensor | LiveSensor | SensorFactory | None = None, driver: Driver | str | None = None,
    tolerance: float = TOLERANCE,
) -> RunResult:  # fmt: skip
    """Let a robot go to a goal in an environment whose obstacles move; see :func:`apex_ompl.run` for the arguments.

    Raises:
        ApexError: The environment was used before, or the problem, a name or a number is unknown or faulty.
    """
    check_name(clock, "clock", CLOCKS)
    if isinstance(driver, str):
        check_name(driver, "driver", DRIVERS)
    check_seed(seed)
    if settings is not None and not isinstance(settings, LoopSettings):
        raise ParameterError("settings", settings, "a LoopSettings")
    replanning = method_of(method)
    if environment.ran:
        raise ParameterError("problem", environment.name, "an environment without a run so far: load it again")
    sensor = sensor or Sensor(seed=seed)
    if is_factory(sensor) and driver is None:
        raise ParameterError("driver", None, "a driver, whose robot the sensor sees")
    settings = _completed(settings or LoopSettings(), sensor, environment)
    settings = settings if driver is None else settings.completed(still_margin=FOLLOWED)
    check_number(tolerance, "tolerance", 0.0, np.pi)
    used = replace(replace(settings, prediction=prediction), **replanning.settings)
    environment.ran = True
    with quiet_ompl():
        seed_ompl(seed)
        context = context_of(environment.problem, used, speed, seed)
        setup = context.setup
        if driver is not None and not isinstance(driver, str):
            check_driver(driver, setup.robot, simulated=clock == SIMULATED)
        noted = {"loop": asdict(used), "sensor": _noted(sensor), "speed": speed, "costs": cost_table()["version"]}
        noted |= {} if driver is None else {"driver": driver if isinstance(driver, str) else type(driver).__name__}
        run = _Run(environment, context, replanning.name, clock, seed, noted)
        fault = setup.start_fault
        if fault or not len(context.goals):
            still = np.zeros((1, len(setup.start)))
            motion = Trajectory(np.zeros(1), setup.start[None], still, still, context.names)
            outcome = Outcome.START_INVALID if fault else Outcome.STUCK
            done = RunRecord(motion, (), False, fault or "; ".join(setup.goal_faults), 0)
            return run.result(done, outcome, done.ended)
        with ExitStack() as stack:
            if clock == SIMULATED:
                replanner = replanning.make()
                replanner.prepare(context)
            else:
                process = stack.enter_context(PlannerProcess(work_of(context, method, seed), cores()[1]))
            if driver is not None:
                if isinstance(driver, str):
                    driver = stack.enter_context(closing(named_driver(driver, environment.problem, setup.robot, clock)))
                answers = ImmediateReplanning(context, replanner) if clock == SIMULATED else process
                return run.driven(driver, answers, sensor, tolerance)
            stream = stream_of(_made(sensor, None, environment), environment, used.watched)
            if clock == SIMULATED:
                done = simulate(environment, context, replanner, stream, seed)
            else:
                done = run_in_real_time(environment, context, process, stream, seed)
    return run.judged(done)


def is_factory(sensor: object) -> bool:
    """Whether a sensor is a function of driver and environment that makes one."""
    return callable(sensor) and not isinstance(sensor, Sensor) and not callable(getattr(sensor, "read", None))


def _made(
    sensor: Sensor | LiveSensor | SensorFactory, driver: Driver | None, environment: Environment
) -> Sensor | LiveSensor:
    """Return a sensor, made by the function that makes it of a driver and the environment.

    Raises:
        ParameterError: What a function made is no sensor.
    """
    found: Any = sensor
    if is_factory(sensor):
        found = found(driver, environment)
    if not isinstance(found, Sensor) and not callable(getattr(found, "read", None)):
        raise ParameterError("sensor", found, "a function that makes an object with read(now)")
    made: Sensor | LiveSensor = found
    return made


def _completed(
    settings: LoopSettings, sensor: Sensor | LiveSensor | SensorFactory, environment: Environment
) -> LoopSettings:
    """Return the settings with a largest error and a largest speed of obstacles.

    Raises:
        ParameterError: They have none, and the sensor is the caller's.
    """
    largest = getattr(sensor, "largest_error", None)
    if largest is not None:  # of a simulated sensor
        return settings.completed(error=largest, fastest=environment.fastest)
    if not callable(getattr(sensor, "read", None)) and not is_factory(sensor):
        raise ParameterError("sensor", sensor, "a Sensor, an object with read(now), or a function that makes one")
    missing = [name for name in ("error", "fastest") if getattr(settings, name) is None]
    if missing:
        raise ParameterError("settings", f"no {' and no '.join(missing)}", "both, for a sensor of one's own")
    return settings


def named_driver(name: str, problem: Problem, robot: Robot, clock: str) -> Driver:
    """Return a driver at the start of a problem: ``kinematic`` or ``mujoco``.

    Obstacles that move are not in its physics: the referee finds what the robot touches.

    Raises:
        UnknownNameError: There is none of that name.
        ParameterError: Physics on the wall clock.
        MissingFileError: The extra ``twin`` is not installed.
    """
    start = problem.start_state(robot.joint_names)
    if check_name(name, "driver", DRIVERS) == "kinematic":
        return KinematicDriver(robot, start, clock=None if clock == SIMULATED else time.monotonic)
    if clock != SIMULATED:
        raise ParameterError("driver", name, "the simulated clock, on which physics is")
    return MujocoDriver(robot, problem.still, state=start)


def _noted(sensor: Sensor | LiveSensor | SensorFactory) -> dict[str, Any]:
    """Return what a result says of a sensor."""
    if isinstance(sensor, Sensor):
        return asdict(sensor)
    described: dict[str, Any] = getattr(sensor, "as_dict", dict)()
    return {"name": type(sensor).__name__} | described


def stream_of(
    sensor: Sensor | LiveSensor, environment: Environment, watched: float, zero: float = 0.0
) -> ObservationSource:
    """Return a sensor at work.

    Args:
        sensor: The sensor.
        environment: What a modeled one observes.
        watched: How long it observed before the run [s].
        zero: Time at which the run starts on the clock of a sensor of the caller [s].
    """
    return SensorStream(sensor, environment, watched) if isinstance(sensor, Sensor) else LiveStream(sensor, zero)


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

    def driven(
        self, driver: Driver, answers: Replanning, sensor: Sensor | LiveSensor | SensorFactory, tolerance: float
    ) -> RunResult:
        """Run on a driver's clock, and return the result.

        Raises:
            ParameterError: What a function made is no sensor.
        """
        context, simulated = self.context, self.clock == SIMULATED
        with ExitStack() as stack:
            if not simulated:
                stack.enter_context(undisturbed(cores()[0]))
                warm_up(context, tuple(self.environment.present(0.0)), self.seed)
            zero = driver.time
            used = _made(sensor, driver, self.environment)
            if is_factory(sensor):
                stack.callback(getattr(used, "close", tuple))
            stream = stream_of(used, self.environment, context.settings.watched, zero)
            cycle = Cycle(
                self.environment, context, answers, stream, self.seed, lead=context.settings.period,
                named=getattr(used, "named", True),
            )  # fmt: skip
            run = DrivenRun(cycle, driver, zero, simulated, tolerance)
            done = run.run()
        return self.judged(done, run.executed())

    def judged(self, done: RunRecord, measured: Trajectory | None = None) -> RunResult:
        """Return the result with the referee's report, on the measured motion where there is one."""
        dynamic = [o.name for o in self.environment.script()]
        report = judge(
            self.context.setup.robot, self.problem(), done.trajectory if measured is None else measured,
            goals=self.context.goals, dynamic=dynamic, commanded=None if measured is None else done.trajectory,
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
