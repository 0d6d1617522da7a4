"""The command ``apex-ompl run``."""

from __future__ import annotations

import argparse
import json

from apex_ompl import api
from apex_ompl.errors import ParameterError
from apex_ompl.loop.result import INTERRUPTED, SUFFIXES, Outcome
from apex_ompl.loop.run import DRIVERS
from apex_ompl.moving.settings import LoopSettings
from apex_ompl.problems.worlds import ScriptedEnvironment
from apex_ompl.util.files import check_writable, suffix_of
from apex_ompl.util.validation import check_name


def run(parsed: argparse.Namespace) -> int:
    """Run the loop, or a task in physics, write the run, print it, and return the exit code."""
    if parsed.driver is not None:
        check_name(parsed.driver, "driver", DRIVERS)
    environment = api.load_environment(parsed.world)
    if parsed.driver == "mujoco" and isinstance(environment, ScriptedEnvironment) and environment.still:
        from apex_ompl.cli.physics import execute

        return execute(environment.problem, parsed)
    if parsed.film is not None:
        expected = "a problem whose obstacles stand still, with --driver mujoco; films of runs: apex-ompl render"
        raise ParameterError("--film", str(parsed.film), expected)
    if parsed.out is not None:
        suffix_of(parsed.out, SUFFIXES)
        check_writable(parsed.out)
    latency = -1.0 if parsed.latency is None else parsed.latency
    settings = LoopSettings(budget=parsed.budget, latency=latency, timeout=parsed.timeout, evade=parsed.evade)
    result = api.run(
        environment, parsed.method, clock=parsed.clock, prediction=parsed.prediction, seed=parsed.seed or 0,
        speed=parsed.speed, settings=settings, driver=parsed.driver,
    )  # fmt: skip
    if parsed.out is not None:
        result.save(parsed.out)
    told = {"outcome": str(result.outcome), "reason": result.reason, "metrics": dict(result.metrics)}
    print(json.dumps(told) if parsed.json else result)
    if result.outcome is Outcome.START_INVALID:
        return 3
    if result.outcome is Outcome.ABORTED and result.reason.endswith(INTERRUPTED):
        return 130
    return 0 if result else 1
