"""A run of the closed loop as data."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

from apex_ompl.scene.problem import Problem
from apex_ompl.trajectory import Trajectory


class Outcome(StrEnum):
    """How a run ended.

    The paper counts failed tasks (R_f); all but ``REACHED`` are failures.
    """

    REACHED = "reached"
    HIT_MOVING = "hit-moving"  # a contact while the robot moved
    HIT_AT_REST = "hit-at-rest"  # an obstacle came to the robot that stood
    HIT_STILL = "hit-still"  # a contact with what stands still, or with itself
    STUCK = "stuck"  # no motion for longer than is allowed
    TIMEOUT = "timeout"
    LIMITS = "limits"  # of position, velocity, acceleration or jerk
    MISALIGNED = "misaligned"  # rest outside the tolerances of the goal
    START_INVALID = "start-invalid"


@dataclass(frozen=True)
class Event:
    """Something that happened in a run.

    Attributes:
        time: When [s].
        kind: ``observation``, ``conflict``, ``stop``, ``request``, ``accepted``, ``rejected``, ``evasion``, ``goal``,
            ``broken assumption`` or ``contact``.
        data: What there is to say of it: texts and numbers, JSON's.
    """

    time: float
    kind: str
    data: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class RunResult:
    """A run of the closed loop.

    Attributes:
        outcome: How it ended.
        reason: One sentence: which bodies touched, when, how deep; empty where the goal was reached.
        problem: The problem; obstacles that moved have the ``trajectory`` that they took, and ``appears``.
        robot: Name of the robot.
        method: Name of the way of replanning.
        prediction: How obstacles were predicted.
        clock: ``sim`` or ``real``.
        seed: The seed used.
        trajectory: What the robot did, from time 0 on.
        events: What happened, by time.
        metrics: Numbers by name: ``time_to_goal`` [s], ``rest_time`` [s], ``stops``, ``replans_asked``,
            ``replans_accepted``, ``clearance`` [m], ``reaction_p95`` [s], ``broken_assumptions``, ...
        settings: Those of the loop and of the sensor, and the version of the table of costs; JSON's.
    """

    outcome: Outcome
    reason: str
    problem: Problem
    robot: str
    method: str
    prediction: str
    clock: str
    seed: int
    trajectory: Trajectory
    events: tuple[Event, ...] = ()
    metrics: Mapping[str, float] = field(default_factory=dict)
    settings: Mapping[str, Any] = field(default_factory=dict)

    def __bool__(self) -> bool:
        """Whether the goal was reached."""
        return self.outcome is Outcome.REACHED
