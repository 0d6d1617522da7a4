"""How far a robot may be from its motion: before one starts, and while it is followed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from apex_ompl.errors import ParameterError
from apex_ompl.robot.model import Limits, Robot
from apex_ompl.types import Array
from apex_ompl.util.validation import check_positive

STILL = 0.05
"""Speed below which a measured joint counts as at rest [rad/s]."""


class Bounds(NamedTuple):
    """Largest distances from the measured positions by joint, each of shape (dof,) [rad; synergies 0..1].

    Attributes:
        start: Of the start of a motion.
        tracking: Of the commanded position.
    """

    start: Array
    tracking: Array


@dataclass(frozen=True)
class Guard:
    """How far a robot may be from its motion; None for any distance.

    A hand that holds an object is where the object lets it be, so that hands are not guarded by default.

    Attributes:
        start: Largest distance of the start of a motion from the measured position of a robot at rest; one that moves,
            or did in the last 0.1 s, may be off as in ``tracking`` [rad].
        tracking: Largest distance of the measured from the commanded position [rad].
        hand_start: As ``start``, of hands [synergies 0..1].
        hand_tracking: As ``tracking``, of hands.
    """

    start: float | None = 0.01
    tracking: float | None = 0.05
    hand_start: float | None = None
    hand_tracking: float | None = None

    def __post_init__(self) -> None:
        """Check the distances.

        Raises:
            ParameterError: One is not a positive number.
        """
        for name, value in vars(self).items():
            if value is not None:
                check_positive(value, f"guard: {name}")

    def bounds(self, robot: Robot) -> Bounds:
        """Return the distances for a robot, whose hands are the joints of its group ``hands``."""
        hands = np.isin(np.arange(robot.dof), robot.groups.get("hands", []))
        rows = (self.start, self.hand_start), (self.tracking, self.hand_tracking)
        return Bounds(*(np.where(hands, _any(hand), _any(joint)) for joint, hand in rows))


class Part(NamedTuple):
    """Some joints of a robot, which a driver drives.

    Attributes:
        names: Their names.
        limits: Their limits.
        columns: Where they are in a state of the robot.
        bounds: How far they may be from their motion.
    """

    names: tuple[str, ...]
    limits: Limits
    columns: list[int]
    bounds: Bounds


def part_of(robot: Robot, joints: Sequence[str] | None, guard: Guard | None) -> Part:
    """Return some joints of a robot, or all.

    Raises:
        ParameterError: No joint, an unknown one, or one given twice.
    """
    known = list(robot.joint_names)
    names = tuple(known if joints is None else joints)
    if isinstance(joints, str) or not names or len(set(names)) < len(names) or not set(names) <= set(known):
        raise ParameterError("joints", joints, f"some of the joints {', '.join(known)}, each once")
    columns = [known.index(name) for name in names]
    limits = robot.limits if joints is None else Limits(*(row[columns] for row in vars(robot.limits).values()))
    return Part(names, limits, columns, Bounds(*(row[columns] for row in (guard or Guard()).bounds(robot))))


def _any(value: float | None) -> float:
    return np.inf if value is None else float(value)
