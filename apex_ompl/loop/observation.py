"""What a sensor tells of the obstacles that move."""

from __future__ import annotations

from dataclasses import dataclass

from apex_ompl.scene.bodies import Obstacle
from apex_ompl.util.display import fields_line


@dataclass(frozen=True)
class Observation:
    """Obstacles that were seen at one moment.

    Attributes:
        stamp: When they were where they were seen [s].
        received: When the loop gets to know it [s], not before the stamp.
        seen: The obstacles with their shapes where they were seen, by name, without velocities. One that is known and
            not among them was not seen, which says nothing about where it is.
    """

    stamp: float
    received: float
    seen: tuple[Obstacle, ...]

    __repr__ = fields_line
