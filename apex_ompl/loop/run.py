"""A run of the closed loop: a world, a sensor, a robot that replans, and a referee."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from apex_ompl.collision import CollisionChecker
from apex_ompl.errors import ParameterError
from apex_ompl.loop.cycle import RunRecord
from apex_ompl.loop.metrics import run_metrics
from apex_ompl.loop.planner_process import PlannerProcess, Work
from apex_ompl.loop.real_time import cores, run_in_real_time
from apex_ompl.loop.referee import judge
from apex_ompl.loop.replan.methods import adapted, method, replanner_of
from apex_ompl.loop.result import Event, Outcome, RunResult
from apex_ompl.loop.sensor import Sensor, SensorStream
from apex_ompl.loop.simulation import simulate
from apex_ompl.moving.charges import cost_table
from apex_ompl.moving.ready import Ready
from apex_ompl.moving.settings import LoopSettings
from apex_ompl.ompl.process import quiet_ompl, seed_ompl
from apex_ompl.ompl.setup import assemble
from apex_ompl.problems import worlds
from apex_ompl.problems.world_scripts import moving_world
from apex_ompl.problems.worlds import World
from apex_ompl.robot.model import Limits, digest
from apex_ompl.scene.problem import Problem
from apex_ompl.scene.scripts import obstacle_at
from apex_ompl.timing import Timing, Trajectory
from apex_ompl.util.files import path_text
from apex_ompl.util.validation import check_name, check_seed

CLOCKS = ("sim", "real")
SHARE = 1.0 - 1e-6  # of the limits that is used: pieces of motions are rounded where they are joined


def run(
    problem: Problem | World | str | os.PathLike[str], planner: str = "apex", *, clock: str = "sim",
    prediction: str = "cv", seed: int = 0, speed: float = 1.0, settings: LoopSettings | None = None,
    sensor: Sensor | None = None,
) -> RunResult:  # fmt: skip
    """Let a robot go to a goal while obstacles move, and say what came of it.

    The robot sees obstacles by a sensor, tracks them, follows a motion only as long as a stop behind its next step is
    proved clear of all that obstacles can reach, and plans anew where its motion meets what is predicted.

    Args:
        problem: A world, its name (:func:`apex_ompl.problems.worlds.load`), a problem among whose obstacles some move,
            its name, or its file.
        planner: Name of a way of replanning, see :func:`apex_ompl.loop.replan.methods.names`.
        clock: ``sim``, on which work is charged by counts, so that the same seed gives the same run; or ``real``, the
            clock on the wall, with the planner in a process of its own.
        prediction: ``still``, ``cv`` or ``truth``, see :class:`apex_ompl.moving.settings.LoopSettings`.
        seed: Of random choices, and of the sensor where none is given.
        speed: Share of the velocity limits that motions use, 0.001 to 1.
        settings: Parameters of the loop; ``prediction`` counts instead of theirs. Their largest error and speed are by
            default those of the sensor and the world.
        sensor: How obstacles are seen.

    Raises:
        ApexError: The world, the problem, a name or a number is unknown or faulty.
    """
    check_name(clock, "clock", CLOCKS)
    check_seed(seed)
    if settings is not None and not isinstance(settings, LoopSettings):
        raise ParameterError("settings", settings, "a LoopSettings")
    one = method(planner)
    sensor = sensor or Sensor(seed=seed)
    world = load_world(problem)
    settings = (settings or LoopSettings()).completed(sensor.largest_error, world.fastest)
    used = adapted(replace(settings, prediction=prediction), one)
    world.ran = True
    with quiet_ompl():
        seed_ompl(seed)
        setup = assemble(world.problem.still, seed=seed)
        timing = Timing(velocity_scale=speed)
        limits = timing.limits(setup.robot.limits, setup.robot.joint_names)
        ready = Ready(setup, _within(limits), _within(setup.robot.limits), used)
        noted = {"loop": asdict(used), "sensor": asdict(sensor), "speed": speed, "costs": cost_table()["version"]}
        made = _Made(world, ready, planner, clock, seed, noted)
        fault = setup.start_fault
        if fault or not len(ready.goals):
            still = np.zeros((1, len(setup.start)))
            motion = Trajectory(np.zeros(1), setup.start[None], still, still, ready.names)
            outcome = Outcome.START_INVALID if fault else Outcome.STUCK
            done = RunRecord(motion, (), False, fault or "; ".join(setup.goal_faults), 0)
            return made.result(done, outcome, done.ended)
        eyes = SensorStream(sensor, world, used.watched)
        if clock == "real":
            work = Work(
                world.problem.still, ready.limits, ready.stopping, used, replanner_of, (planner,), seed, rehearses=True
            )
            with PlannerProcess(work, cores()[1]) as process:
                done = run_in_real_time(world, ready, process, eyes, seed)
        else:
            replanner = one.make()
            replanner.prepare(ready)
            done = simulate(world, ready, replanner, eyes, seed)
    return made.judged(done)


def _within(limits: Limits) -> Limits:
    """Return limits that leave room for rounding."""
    some = {name: SHARE * getattr(limits, name) for name in ("velocity", "acceleration", "jerk")}
    return replace(limits, **some)


def load_world(problem: Problem | World | str | os.PathLike[str]) -> World:
    """Return a world, or that of its name, a problem, its name, or its file.

    Raises:
        ApexError: It is unknown or faulty.
    """
    if isinstance(problem, World):
        if problem.ran:
            raise ParameterError("problem", problem.name, "a world in which nothing ran yet: load it anew")
        return problem
    return moving_world(problem) if isinstance(problem, Problem) else worlds.load(path_text(problem, "problem"))


@dataclass(frozen=True, eq=False)
class _Made:
    """What a result says besides what happened."""

    world: World
    ready: Ready
    planner: str
    clock: str
    seed: int
    settings: Mapping[str, Any]

    def result(self, done: RunRecord, outcome: Outcome, reason: str, clearance: float = float("inf")) -> RunResult:
        """Return the result."""
        robot = self.ready.setup.robot
        metrics = run_metrics(done.trajectory, done.events, robot.limits, clearance=clearance)
        metrics |= {**done.measured, **done.counts}
        return RunResult(
            outcome=outcome, reason=reason, problem=self.problem(), robot=robot.name, method=self.planner,
            prediction=self.ready.settings.prediction, clock=self.clock, seed=self.seed, trajectory=done.trajectory,
            events=done.events, metrics=metrics, settings=self.settings,
            robot_digest=digest(robot),
        )  # fmt: skip

    def judged(self, done: RunRecord) -> RunResult:
        """Return the result with what the referee says."""
        dynamic = [o.name for o in self.world.script()]
        report = judge(
            self.ready.setup.robot, self.problem(), done.trajectory, goals=self.ready.goals, dynamic=dynamic
        )  # fmt: skip
        outcome, reason = report.outcome, "; ".join(report.faults)
        if outcome is None:
            ended = {"stuck": Outcome.STUCK, "timeout": Outcome.TIMEOUT, "aborted": Outcome.ABORTED}
            outcome = Outcome.MISALIGNED if done.reached else ended[done.ended]
            if not done.reached:
                time = done.trajectory.duration
                said = [done.reason] if done.reason else []
                reason = "; ".join([f"no goal was reached in {time:.3g} s{self.blocked(time)}", *said])
        told = [
            Event(one.time, "contact", {"first": one.first, "second": one.second, "moved": one.moved})
            for one in {report.contact, report.moving_contact}
            if one is not None
        ]
        done = replace(done, events=tuple(sorted((*done.events, *told), key=lambda event: event.time)))
        return self.result(done, outcome, reason, report.clearance)

    def blocked(self, time: float) -> str:
        """Return which obstacles that move are where the robot would be at every goal at a time [s], or nothing."""
        held = self.world.problem.still.attached
        there = [obstacle_at(o, time) for o in self.world.script() if o.appears <= time]
        checker, names = CollisionChecker(self.ready.setup.robot, there, held), {o.name for o in there}
        met = [names & {name for c in checker.contacts(q) for name in (c.first, c.second)} for q in self.ready.goals]
        if not all(met):
            return ""
        return f"; {', '.join(sorted(set().union(*met)))} stood where the robot would be at the goal"

    def problem(self) -> Problem:
        """Return the problem with what obstacles did."""
        still = self.world.problem.still
        return still.model_copy(update={"name": self.world.name, "scene": (*still.scene, *self.world.script())})
