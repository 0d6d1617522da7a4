"""Replanners of the closed loop: what they are asked for, what they answer, and which there are by name."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np

from apex_ompl.errors import ParameterError
from apex_ompl.moving.compute_costs import ComputeBudget
from apex_ompl.moving.context import SAME_TIME, Following, RunContext
from apex_ompl.moving.dynamic_obstacles import DynamicObstacles
from apex_ompl.scene.bodies import Obstacle

SAME_STATE = 1e-7  # largest jump of positions, velocities and accelerations where a motion joins another one


@dataclass(frozen=True, eq=False)
class Request:
    """A request for a replan.

    Attributes:
        number: Number of the request in its run; seeds random choices.
        asked: Clock time of the request [s].
        join: Clock time at which the new motion starts [s].
        following: The motion that the robot follows until then.
        route: The last motion to a goal, or None.
        predicted: The dynamic obstacles by their prediction, with margins; motions are proved against these.
        clearance_margin: By how much they are larger where motions are optimized [m].
        obstacles: Their records, at the predicted places at the time of the request, with velocities.
        conflict: Clock time of the first predicted conflict of the motion that the robot follows [s]; infinite without
            one.
        contact: The same by the prediction without margins, where the robot will be at rest soon; else infinite.
        seed: Seed of the run.
        reachable: The reachable sets of the obstacles where a fail-safe stop is required, else None.
        leaving: Whether the robot will be leaving a place that an obstacle comes to. Another motion is then useful only
            where the safety filter will not stop it, since it would stop there.
    """

    number: int
    asked: float
    join: float
    following: Following
    route: Following | None
    predicted: DynamicObstacles
    clearance_margin: float
    obstacles: tuple[Obstacle, ...]
    conflict: float
    seed: int
    contact: float = math.inf
    reachable: DynamicObstacles | None = None
    leaving: bool = False

    @property
    def hastens(self) -> bool:
        """Whether the motion leads to a goal without a conflict, so that only a faster one is useful."""
        return self.following.to_goal and not math.isfinite(self.conflict)

    @property
    def taken(self) -> str:
        """Kind of the event of an answer that is followed."""
        return "improved" if self.hastens else "accepted"

    @property
    def refused(self) -> str:
        """Kind of the event of an answer that is not."""
        return "kept" if self.hastens else "rejected"

    @property
    def rng(self) -> np.random.Generator:
        """Source of random choices, the same at each call."""
        return np.random.default_rng([self.seed, self.number])


@dataclass(frozen=True, eq=False)
class Answer:
    """The answer of a replanner.

    Attributes:
        found: The motion from the time of joining on, or None.
        part: Name of the part that found it; or why nothing was found, where known.
        budget: What it cost.
    """

    found: Following | None
    part: str
    budget: ComputeBudget


class Replanner(Protocol):
    """Plans the robot's next motion while it follows the last one."""

    def prepare(self, context: RunContext) -> None:
        """Load or compile what it needs, before a run; nothing by default."""
        return

    def replan(self, context: RunContext, request: Request, budget: ComputeBudget) -> Answer:
        """Return a motion from the state at the time of joining on, which ends at rest, or none."""


ONE_PLAN: Mapping[str, Any] = {"hastens": False}
"""Settings of a replanner that seeks no faster motion while the robot follows one without a conflict."""
FROM_REST: Mapping[str, Any] = {"from_rest": True, **ONE_PLAN}
"""Settings of a replanner that plans from rest only."""
UNGUARDED: Mapping[str, Any] = {"prediction": "still", "guarded": False, **ONE_PLAN}
"""Settings of a replanner that sees obstacles where they are, without a fail-safe stop."""


@dataclass(frozen=True)
class Method:
    """A replanner by name.

    Attributes:
        name: Its name.
        make: Makes the replanner, new for each run.
        about: One line about it.
        settings: Parameters of the loop that it changes.
    """

    name: str
    make: Callable[[], Replanner]
    about: str = ""
    settings: Mapping[str, Any] = field(default_factory=dict)


REGISTRY: dict[str, Method] = {}
"""Replanners that modules registered so far; :func:`apex_ompl.loop.replan.methods.names` loads all modules first."""


def register(name: str, make: Callable[[], Replanner], about: str, settings: Mapping[str, Any] | None = None) -> None:
    """Make a replanner known by a name.

    Args:
        name: Its name.
        make: Makes the replanner, new for each run.
        about: One line about it.
        settings: Parameters of the loop that it changes.
    """
    REGISTRY[name] = Method(name, make, about, dict(settings or {}))


def joining_fault(context: RunContext, found: Following, request: Request) -> str:
    """Return why a motion can never be followed as a request asks, or nothing.

    Args:
        context: The robot among static obstacles.
        found: The motion.
        request: The request.
    """
    motion = found.motion
    try:
        replace(motion)  # it may come from another process, and be none at all
    except ParameterError as error:
        return f"it is no motion: {error}"
    if motion.joint_names != context.names:
        return "it is a motion of other joints"
    joined = request.following.at(request.join)
    states = motion.positions[0], motion.velocities[0], motion.accelerations[0]
    off = max(float(np.abs(one - other).max()) for one, other in zip(states, joined, strict=True))
    if abs(found.start_time - request.join) > SAME_TIME or not off <= SAME_STATE:
        return "it does not start where the robot will be"
    if motion.velocities[-1].any() or motion.accelerations[-1].any():
        return "it does not end at rest"
    if found.to_goal and not context.is_goal(motion.positions[-1]):
        return "it does not end at a goal"
    verified = context.settings.verified
    if not (context.clear_of_static(motion) if verified else context.keeps_limits(motion)):
        return "it exceeds limits, or is not proved clear of static obstacles"
    return ""
