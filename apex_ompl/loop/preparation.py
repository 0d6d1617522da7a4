"""What a run needs before it starts: the robot among static obstacles, and the work of a planner process."""

from __future__ import annotations

import pickle
from dataclasses import replace

from apex_ompl.errors import ParameterError
from apex_ompl.loop.replan.methods import replanner_of
from apex_ompl.loop.replanning import Work
from apex_ompl.moving.context import RunContext
from apex_ompl.moving.replanner import Replanner
from apex_ompl.moving.settings import LoopSettings
from apex_ompl.ompl.setup import assemble
from apex_ompl.robot.model import Limits
from apex_ompl.scene.problem import Problem
from apex_ompl.timing import Timing

SHARE = 1.0 - 1e-6  # of the limits that is used: pieces of motions are rounded where they are joined


def context_of(problem: Problem, settings: LoopSettings, speed: float, seed: int) -> RunContext:
    """Return the context of a run.

    Args:
        problem: The problem; its dynamic obstacles are left out.
        settings: The settings, with ``error`` and ``fastest``.
        speed: Share of the velocity limits that is used.
        seed: Seed of goals that are sampled.

    Raises:
        ApexError: The problem or a number is faulty, or there is a constraint along the path, which replanned motions
            would not keep.
    """
    assert settings.assumed  # or it raises
    setup = assemble(problem.still, seed=seed)
    if setup.constraints is not None:
        kept = f"the {setup.constraints.names[0]} along the path"
        raise ParameterError("problem", kept, "no constraint: replanned motions would not keep it")
    limits = Timing(velocity_scale=speed).limits(setup.robot.limits, setup.robot.joint_names)
    found = RunContext(setup, _within(limits), _within(setup.robot.limits), settings)
    _ = found.torques  # it raises where torques are limited and no link has a mass
    return found


def work_of(context: RunContext, method: str | Replanner, seed: int) -> Work:
    """Return the work of a process that replans by a method.

    Raises:
        ParameterError: The method cannot be pickled.
    """
    _check_pickles(method)
    return Work(
        context.setup.problem, context.limits, context.stopping, context.settings, replanner_of, (method,), seed,
        rehearses=True,
    )  # fmt: skip


def _check_pickles(method: str | Replanner) -> None:
    try:
        pickle.dumps(method)
    except Exception as error:
        raise ParameterError(
            "method", method, f"a replanner that can be pickled to another process: {type(error).__name__}: {error}"
        ) from error


def _within(limits: Limits) -> Limits:
    """Return limits that leave room for rounding."""
    some = {name: SHARE * getattr(limits, name) for name in ("velocity", "acceleration", "jerk")}
    return replace(limits, **some)
