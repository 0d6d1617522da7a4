"""The simulated clock: steps at its period, whatever they take, with work that is charged by counts."""

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

from apex_ompl.loop.cycle import Decided, Loop, RunRecord, undo
from apex_ompl.loop.environment import Environment, Observation, ObservationSource
from apex_ompl.loop.replanning import ImmediateReplanning, PlannerProcess
from apex_ompl.loop.tracking import Tracker
from apex_ompl.moving.context import Following, RunContext
from apex_ompl.moving.replanner import Replanner, Request
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.scene.scripts import standing
from apex_ompl.timing import time_path
from apex_ompl.util.cores import usable_cores
from apex_ompl.util.exiting import running


def simulate(
    environment: Environment, context: RunContext, replanner: Replanner, sensor: ObservationSource, seed: int
) -> RunRecord:
    """Run the loop in a world until the robot stands at a goal, or time is up.

    Args:
        world: What truly happens.
        context: The robot among what stands still.
        replanner: How motions are planned anew.
        eyes: What observes the world.
        seed: Of random choices.
    """
    loop = Loop(environment, context, ImmediateReplanning(context, replanner), sensor, seed)
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
    """While the block runs, keep this thread to a core, and let no garbage be collected."""
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


def warm_up(context: RunContext, environment: Environment, seed: int) -> None:
    """Do once what a step does, so that compiled functions are loaded before the clock runs."""
    present = tuple(environment.present(0.0)) or (
        Obstacle(name="warm-up", box=(0.1, 0.1, 0.1), position=(9.0, 9.0, 9.0)),
    )
    tracker = Tracker(context.kernel)
    tracker.take(Observation(0.0, 0.0, tuple(standing(o) for o in present)))
    motion = time_path(np.stack([context.setup.start, context.goals[0]]), context.limits, context.names).trajectory
    line = Following(motion, 0.0, to_goal=True)
    predicted, half = tracker.predicted(context.settings.margin), 0.5 * motion.duration
    tracker.eased(predicted, context.setup.start, [0.0])
    context.first_conflict(predicted, line, 0.0, line.end)
    context.proved_stop(tracker.reachable(0.0, 0.0), line, half, half + context.settings.period)
    context.clear_of_static(motion)
    request = Request(1, 0.0, 0.05, line, line, predicted, 0.01, present, np.inf, seed)
    pickle.loads(pickle.dumps((request, line.piece(half, line.end))))


def run_in_real_time(
    environment: Environment, context: RunContext, planner: PlannerProcess, sensor: ObservationSource, seed: int
) -> RunRecord:
    """Run the loop by the clock on the wall until the robot stands at a goal, or time is up.

    The step at a time is decided in the period before it, by what was seen until that began. What a driver has is the
    motion until the next step and a proved stop behind it; so where a step was not decided in time, the robot follows
    that stop, and what the step had decided is undone. The clock stands while the world answers to the first motion.

    Args:
        world: What truly happens.
        context: The robot among what stands still.
        planner: The process that makes replans, which is ready.
        eyes: What observes the world.
        seed: Of random choices.

    Returns:
        What came of it; ``measured`` has ``tick_p50``, ``tick_p99`` and ``tick_worst``, times that a step took to be
        decided [s], without those for which the world and its sensor were simulated, and ``deadline_misses``, the
        number of steps that were not decided in time.
    """
    period = context.settings.period
    loop = Loop(environment, context, planner, sensor, seed, lead=period)
    executor, ticks = loop.executor, list[float]()
    k, missed = 0, 0
    ended: RunRecord | None = None
    warm_up(context, environment, seed)
    with undisturbed(cores()[0]), running(loop.abort):
        began = time.perf_counter()
        while ended is None:
            before, then = Decided.of(executor), (k + 1) * period
            try:
                wait = began + k * period - time.perf_counter()
                if wait > 0.0:
                    time.sleep(wait)
                seen = time.perf_counter() - began
                if math.floor(seen / period) > k:  # periods went by without a step
                    undo(executor, then, before)
                    missed += math.floor(seen / period) - k
                    k = math.floor(seen / period)
                    before, then = Decided.of(executor), (k + 1) * period
                loop.advance(k * period)
                looked = time.perf_counter()
                loop.observe(k * period)
                ended = loop.step(then)
                ticks.append(time.perf_counter() - looked)
                k += 1
                if ended is None and time.perf_counter() - began > then:
                    undo(executor, then, before)
                    missed += 1
                paused = time.perf_counter()
                loop.announce_start(then)
                began += time.perf_counter() - paused
            except KeyboardInterrupt:
                ended, k = None, round(then / period)
                loop.interrupt(then, before)
    environment.advance(k * period, executor.state(k * period))  # what the motion is judged by
    middle, high, worst = np.percentile(ticks, [50.0, 99.0, 100.0]).tolist()
    measured = {"tick_p50": middle, "tick_p99": high, "tick_worst": worst, "deadline_misses": float(missed)}
    return replace(ended, measured=measured)
