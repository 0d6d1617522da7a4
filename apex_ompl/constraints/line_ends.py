"""Why tools cannot follow a path of poses any further."""

from __future__ import annotations

from enum import StrEnum
from typing import NamedTuple

import numpy as np

from apex_ompl.constraints.line_tracking import LARGEST_STEP, LineTracker, Track
from apex_ompl.types import Array

AHEAD = (1e-3, 3e-3, 1e-2)  # of the end, where the cause is looked for [m]
SEEDS, STEPS = 128, 30  # random states from which inverse kinematics looks for a state in another branch


class LineEnd(StrEnum):
    """Why a motion along a line ends where it does."""

    REACHED = "reached"
    JOINT_LIMIT = "joint limit"
    COLLISION = "collision"
    SINGULARITY = "singularity"
    UNREACHABLE = "unreachable"
    TIMEOUT = "timeout"


class DeadEnd(NamedTuple):
    """Why a track ends.

    Attributes:
        end: The kind of reason.
        names: Joints at their limits, or two bodies.
        reason: The reason as part of a sentence.
    """

    end: LineEnd
    names: tuple[str, ...]
    reason: str


def dead_end(tracker: LineTracker, track: Track) -> DeadEnd:
    """Return why a track of :class:`apex_ompl.constraints.line_tracking.LineTracker` does not go on."""
    q, robot = track.states[-1], tracker.checker.robot
    for ahead in AHEAD:
        u = np.array([min(float(track.u[-1]) + ahead, tracker.path.length)])
        found, ok = tracker.tools.close(q[None], *tracker.path.poses(u))
        state = found[0]
        if not ok[0] or float(np.abs(state - q).max()) > LARGEST_STEP:
            return _beyond(tracker, u)
        limits = robot.limits
        outside = np.flatnonzero((state < limits.lower) | (state > limits.upper))
        if len(outside):
            names = tuple(robot.joint_names[k] for k in outside)
            return DeadEnd(LineEnd.JOINT_LIMIT, names, f"{robot.limit_fault(state)} on the way on")
        if not tracker.checker.is_free(state):
            return collision(tracker, state)
    return DeadEnd(LineEnd.SINGULARITY, (), "the arm goes on through another branch only")


def collision(tracker: LineTracker, state: Array) -> DeadEnd:
    """Return the reason for a state that is not free, shape (dof,)."""
    contacts = tracker.checker.contacts(state)
    if contacts:
        return DeadEnd(LineEnd.COLLISION, (contacts[0].first, contacts[0].second), str(contacts[0]))
    pair = tracker.checker.prove(state[None]).pair
    return DeadEnd(LineEnd.COLLISION, pair, f"{pair[0]} <-> {pair[1]} touch")


def _beyond(tracker: LineTracker, u: Array) -> DeadEnd:
    """Return the reason where Newton's method finds no near state for the pose at a parameter, shape (1,)."""
    robot, rng = tracker.checker.robot, np.random.default_rng(0)
    seeds = robot.random_state(rng, SEEDS)
    rotation, point = tracker.path.poses(u)
    found, ok = tracker.tools.close(seeds, np.repeat(rotation, SEEDS, axis=0), np.repeat(point, SEEDS, axis=0), STEPS)
    inside = ((found >= robot.limits.lower) & (found <= robot.limits.upper))[:, tracker.moving].all(axis=1)
    if (ok & inside).any():
        return DeadEnd(LineEnd.SINGULARITY, (), "the arm is singular, and goes on in another branch only")
    names = " and ".join(tool.name for tool in tracker.tools.tools)
    return DeadEnd(LineEnd.UNREACHABLE, (), f"{names} cannot reach the poses that follow")
