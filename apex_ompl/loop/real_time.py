"""The clock on the wall: steps are decided while the one before is under way, and one that is late is a proved stop."""

from __future__ import annotations

import gc
import math
import os
import pickle
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np

from apex_ompl.loop.cycle import Eyes, Loop, RunRecord
from apex_ompl.loop.late_steps import Decided, undo
from apex_ompl.loop.observation import Observation
from apex_ompl.loop.planner_process import PlannerProcess
from apex_ompl.loop.tracking import Tracker
from apex_ompl.moving.following import Following
from apex_ompl.moving.ready import Ready
from apex_ompl.moving.request import Request
from apex_ompl.problems.worlds import World
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.scene.scripts import standing
from apex_ompl.timing import time_path
from apex_ompl.util.process import running, usable_cores


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


def warm_up(ready: Ready, world: World, seed: int) -> None:
    """Do once what a step does, so that compiled functions are loaded before the clock runs."""
    present = tuple(world.present(0.0)) or (Obstacle(name="warm-up", box=(0.1, 0.1, 0.1), position=(9.0, 9.0, 9.0)),)
    tracker = Tracker(ready.kernel)
    tracker.take(Observation(0.0, 0.0, tuple(standing(o) for o in present)))
    motion = time_path(np.stack([ready.setup.start, ready.goals[0]]), ready.limits, ready.names).trajectory
    line = Following(motion, 0.0, to_goal=True)
    predicted, half = tracker.predicted(ready.settings.margin), 0.5 * motion.duration
    tracker.eased(predicted, ready.setup.start, [0.0])
    ready.first_conflict(predicted, line, 0.0, line.end)
    ready.proved_stop(tracker.reachable(0.0, 0.0), line, half, half + ready.settings.period)
    ready.clear_of_still(motion)
    request = Request(1, 0.0, 0.05, line, line, predicted, 0.01, present, np.inf, seed)
    pickle.loads(pickle.dumps((request, line.piece(half, line.end))))


def run_in_real_time(world: World, ready: Ready, planner: PlannerProcess, eyes: Eyes, seed: int) -> RunRecord:
    """Run the loop by the clock on the wall until the robot stands at a goal, or time is up.

    The step at a time is decided in the period before it, by what was seen until that began. What a driver has is the
    motion until the next step and a proved stop behind it; so where a step was not decided in time, the robot follows
    that stop, and what the step had decided is undone. The clock stands while the world answers to the first motion.

    Args:
        world: What truly happens.
        ready: The robot among what stands still.
        planner: The process that makes replans, which is ready.
        eyes: What observes the world.
        seed: Of random choices.

    Returns:
        What came of it; ``measured`` has ``tick_p50``, ``tick_p99`` and ``tick_worst``, times that a step took to be
        decided [s], without those for which the world and its sensor were simulated, and ``deadline_misses``, the
        number of steps that were not decided in time.
    """
    period = ready.settings.period
    loop = Loop(world, ready, planner, eyes, seed, lead=period)
    executor, ticks = loop.executor, list[float]()
    k, missed = 0, 0
    ended: RunRecord | None = None
    warm_up(ready, world, seed)
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
                loop.set_out(then)
                began += time.perf_counter() - paused
            except KeyboardInterrupt:
                ended, k = None, round(then / period)
                loop.interrupt(then, before)
    world.advance(k * period, executor.state(k * period))  # what the motion is judged by
    middle, high, worst = np.percentile(ticks, [50.0, 99.0, 100.0]).tolist()
    measured = {"tick_p50": middle, "tick_p99": high, "tick_worst": worst, "deadline_misses": float(missed)}
    return replace(ended, measured=measured)
