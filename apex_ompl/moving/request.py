"""What a replan is asked for, and what it answers."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from apex_ompl.moving.charges import Charges
from apex_ompl.moving.dynamic_obstacles import DynamicObstacles
from apex_ompl.moving.following import Following
from apex_ompl.moving.ready import Ready
from apex_ompl.scene.bodies import Obstacle


@dataclass(frozen=True, eq=False)
class Request:
    """What a replan is asked for.

    Attributes:
        number: Which request of the run it is; seeds random choices.
        asked: Time of the clock [s].
        join: Time of the clock at which the new motion is to begin [s].
        following: What the robot follows until then.
        route: The last motion to a goal, or None.
        predicted: The obstacles as they are expected to move; what motions are proved against.
        berth: By how much they are larger where motions are optimized [m].
        obstacles: Their records, where they are expected to be when it is asked, with velocities.
        conflict: Time of the clock of the first conflict of what the robot follows [s], infinite without one.
        contact: The same by the predictions as they are, without margins for what is uncertain, where the robot will be
            at rest soon; else infinite.
        seed: The run's.
        reachable: The obstacles as large as all that they can reach, where a fail-safe stop is asked for, else None.
        leaving: Whether the robot will be leaving a place that an obstacle comes to: another motion is of use only
            where the guard will hardly stop it, since that would be there.
    """

    number: int
    asked: float
    join: float
    following: Following
    route: Following | None
    predicted: DynamicObstacles
    berth: float
    obstacles: tuple[Obstacle, ...]
    conflict: float
    seed: int
    contact: float = math.inf
    reachable: DynamicObstacles | None = None
    leaving: bool = False

    @property
    def hastens(self) -> bool:
        """Whether what the robot follows leads to a goal without a conflict, so that only a faster motion is of use."""
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
    """What a replan found.

    Attributes:
        found: The motion from the time of joining on, or None.
        part: Name of the part that found it, or why nothing was found where there is something to say.
        charges: What it cost.
    """

    found: Following | None
    part: str
    charges: Charges


class Replanner(Protocol):
    """A way of replanning."""

    def prepare(self, ready: Ready) -> None:
        """Load, or compile, what it needs, before a run."""

    def replan(self, ready: Ready, request: Request, charges: Charges) -> Answer:
        """Return a motion from the time of joining on that is proved among what is expected, or none."""
