"""The two clocks of a run: the simulated one, on which work takes modeled costs, and the wall clock.

On the wall clock a step is decided while the one before is executed; one that is late is a proved stop.
"""

from __future__ import annotations

import gc
import math
import os
import pickle
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import count

import numpy as np

from apex_ompl.loop.control import Decided, RunRecord, undo
from apex_ompl.loop.cycle import Cycle
from apex_ompl.loop.environment import Environment, Observation, ObservationSource
from apex_ompl.loop.replanning import ImmediateReplanning, PlannerProcess
from apex_ompl.loop.tracking import Tracker
from apex_ompl.moving.context import Following, RunContext
from apex_ompl.moving.replanner import Replanner, Request
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.scene.scripts import standing
from apex_ompl.timing import time_path
from apex_ompl.util.process import running, usable_cores


def simulate(
    environment: Environment, context: RunContext, replanner: Replanner, sensor: ObservationSource, seed: int
) -> RunRecord:
    """Run the loop on the simulated clock until the robot is at rest at a goal, or the time is up.

    Args:
        environment: What truly happens.
        context: The robot among static obstacles, and the settings of the run.
        replanner: Plans motions.
        sensor: Observes the environment.
        seed: Seed of random choices.
    """
    loop = Cycle(environment, context, ImmediateReplanning(context, replanner), sensor, seed)
    with running(loop.abort):
        for k in count():
            now, before = k * context.settings.period, Decided.of(loop.executor)
            try:
                loop.advance(now)
                loop.observe(now)
                ended = loop.step(now)
                if ended is not None:
                    return ended
                loop.announce_start(now)
            except KeyboardInterrupt:
                loop.interrupt(now, before)
    raise AssertionError("unreachable")


def cores() -> tuple[int | None, int | None]:
    """Return the processor cores of the executor and of the planner, None where there is no choice."""
    some = usable_cores()
    return (some[0], some[-1]) if len(some) > 1 and hasattr(os, "sched_setaffinity") else (None, None)


@contextmanager
def undisturbed(core: int | None) -> Iterator[None]:
    """While the block runs, pin this thread to a core, and disable garbage collection."""
    enabled, before = gc.isenabled(), os.sched_getaffinity(0) if core is not None else None
    gc.collect()
    gc.freeze()
    gc.disable()
    if core is not None:
        os.sched_setaffinity(0, {core})
    try:
        yield
    finally:
        if before is not None:
            os.sched_setaffinity(0, before)
        gc.unfreeze()
        if enabled:
            gc.enable()


def warm_up(context: RunContext, seen: tuple[Obstacle, ...], seed: int) -> None:
    """Call once what a step calls among obstacles, so that compiled functions are loaded before the clock runs."""
    present = seen or (Obstacle(name="warm-up", box=(0.1, 0.1, 0.1), position=(9.0, 9.0, 9.0)),)
    tracker = Tracker(context.kernel)
    tracker.take(Observation(0.0, 0.0, tuple(standing(o) for o in present)))
    motion = time_path(np.stack([context.setup.start, context.goals[0]]), context.limits, context.names).trajectory
    line = Following(motion, 0.0, to_goal=True)
    predicted, half = tracker.predicted(context.settings.margin), 0.5 * motion.duration
    tracker.ease_margins(predicted, context.setup.start, [0.0])
    context.first_conflict(predicted, line, 0.0, line.end)
    context.proved_stop(tracker.reachable(0.0, 0.0), line, half, half + context.settings.period)
    context.clear_of_static(motion)
    request = Request(1, 0.0, 0.05, line, line, predicted, 0.01, present, np.inf, seed)
    pickle.loads(pickle.dumps((request, line.piece(half, line.end))))


def run_in_real_time(
    environment: Environment, context: RunContext, planner: PlannerProcess, sensor: ObservationSource, seed: int
) -> RunRecord:
    """Run the loop by the wall clock until the robot is at rest at a goal, or the time is up.

    A step is decided in the period before it, by the observations before that period. A driver holds the motion until
    the next step and the proved stop after it. So where a step was not decided in time, the robot follows that stop,
    and the decision is undone. The clock is paused while the environment reacts to the first motion.

    Args:
        environment: What truly happens.
        context: The robot among static obstacles, and the settings of the run.
        planner: The planner process, which is ready.
        sensor: Observes the environment.
        seed: Seed of random choices.

    Returns:
        The record of the run. ``measured`` has ``tick_p50``, ``tick_p99`` and ``tick_worst``, computing times of a step
        [s] without the simulation of environment and sensor, and ``deadline_misses``, the number of steps that were not
        decided in time.
    """
    period = context.settings.period
    loop = Cycle(environment, context, planner, sensor, seed, lead=period)
    executor, ticks = loop.executor, list[float]()
    k, missed = 0, 0
    ended: RunRecord | None = None
    warm_up(context, tuple(environment.present(0.0)), seed)
    with undisturbed(cores()[0]), running(loop.abort):
        started = time.perf_counter()
        while ended is None:
            before, then = Decided.of(executor), (k + 1) * period
            try:
                wait = started + k * period - time.perf_counter()
                if wait > 0.0:
                    time.sleep(wait)
                seen = time.perf_counter() - started
                if math.floor(seen / period) > k:  # periods passed without a step
                    undo(executor, then, before)
                    missed += math.floor(seen / period) - k
                    k = math.floor(seen / period)
                    before, then = Decided.of(executor), (k + 1) * period
                loop.advance(k * period)
                observed = time.perf_counter()
                loop.observe(k * period)
                ended = loop.step(then)
                ticks.append(time.perf_counter() - observed)
                k += 1
                if ended is None and time.perf_counter() - started > then:
                    undo(executor, then, before)
                    missed += 1
                paused = time.perf_counter()
                loop.announce_start(then)
                started += time.perf_counter() - paused
            except KeyboardInterrupt:
                ended, k = None, round(then / period)
                loop.interrupt(then, before)
    environment.advance(k * period, executor.state(k * period))  # what the motion is judged by
    middle, high, worst = np.percentile(ticks, [50.0, 99.0, 100.0]).tolist()
    measured = {"tick_p50": middle, "tick_p99": high, "tick_worst": worst, "deadline_misses": float(missed)}
    return replace(ended, measured=measured)
