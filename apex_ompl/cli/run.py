"""The command ``apex-ompl run``."""

from __future__ import annotations

import argparse
import json

from apex_ompl.loop.result import INTERRUPTED, SUFFIXES, Outcome, RunResult
from apex_ompl.loop.run import load_world
from apex_ompl.loop.run import run as run_loop
from apex_ompl.loop.sensor import Sensor
from apex_ompl.loop.settings import LoopSettings
from apex_ompl.util.files import check_writable, suffix_of

SHOWN = {
    "time_to_goal": ("s", 1.0), "rest_time": ("s", 1.0), "clearance": ("mm", 1e3), "reaction_p95": ("ms", 1e3),
    "tick_p99": ("ms", 1e3), "deadline_misses": ("", 1.0),
}  # fmt: skip


def run(parsed: argparse.Namespace) -> int:
    """Run the loop, write the run, print it, and return the exit code."""
    if parsed.out is not None:
        suffix_of(parsed.out, SUFFIXES)
        check_writable(parsed.out)
    world, sensor = load_world(parsed.world), Sensor(seed=parsed.seed)
    latency = -1.0 if parsed.latency is None else parsed.latency
    settings = LoopSettings(budget=parsed.budget, latency=latency, timeout=parsed.timeout, evade=parsed.evade)
    result = run_loop(
        world, parsed.planner, clock=parsed.clock, prediction=parsed.prediction, seed=parsed.seed, speed=parsed.speed,
        settings=settings, sensor=sensor,
    )  # fmt: skip
    if parsed.out is not None:
        result.save(parsed.out)
    told = {"outcome": str(result.outcome), "reason": result.reason, "metrics": dict(result.metrics)}
    print(json.dumps(told) if parsed.json else _summary(result))
    if result.outcome is Outcome.START_INVALID:
        return 3
    if result.outcome is Outcome.ABORTED and result.reason.endswith(INTERRUPTED):
        return 130
    return 0 if result else 1


def _summary(result: RunResult) -> str:
    """Return the lines printed about a run."""
    metrics = result.metrics
    lines = [f"{result.problem.name}: {result.outcome}"]
    if result.reason:
        lines.append(f"  reason     {result.reason}")
    lines.append(f"  motion     {result.trajectory.duration:.2f} s")
    some = [
        f"{name.replace('_', ' ')} {factor * metrics[name]:.3g} {unit}"
        for name, (unit, factor) in SHOWN.items()
        if name in metrics
    ]
    lines.append(f"  measured   {', '.join(some)}")
    counts = ("replans_asked", "replans_accepted", "conflicts", "stops", "unguarded_steps", "broken_steps")
    lines.append("  events     " + ", ".join(f"{metrics[name]:.0f} {name.replace('_', ' ')}" for name in counts))
    lines.append(
        f"  method     {result.method}, prediction {result.prediction}, clock {result.clock}, seed {result.seed}"
    )
    return "\n".join(lines)
