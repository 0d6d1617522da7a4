"""Sampling of free states that reach a goal given in the workspace, by inverse kinematics from random states."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from apex_ompl.collision import CollisionChecker
from apex_ompl.goals.alignment import within
from apex_ompl.types import Array


class WorkspaceGoal(Protocol):
    """A goal that is reached where some errors are within their bounds."""

    @property
    def bounds(self) -> Mapping[str, float]:
        """Tolerance of each error term: lengths [m] and angles [rad]."""

    def errors(self, q: Array) -> Mapping[str, float]:
        """Return the error terms at a state, shape (dof,), all 0 or more."""

    def attempt(self, rng: np.random.Generator) -> Array:
        """Return the result of inverse kinematics from a random state, shape (dof,)."""


@dataclass(frozen=True)
class GoalSamples:
    """States sampled for a goal.

    Attributes:
        states: Free states that reach the goal, shape (found, dof).
        attempts: Number of attempts of inverse kinematics.
        converged: Number of attempts that reached the goal, free or in collision.
        best: Error terms of the best attempt.
        blocked: A collision of the last state that reached the goal; empty if one was free or none reached it.
    """

    states: Array
    attempts: int
    converged: int
    best: Mapping[str, float]
    blocked: str

    @property
    def fault(self) -> str:
        """Reason for which there is no state, in one sentence; empty when there is one."""
        if len(self.states):
            return ""
        if self.converged:
            return f"all {self.converged} states found at the goal in {self.attempts} attempts collide, {self.blocked}"
        best = ", ".join(f"{name} {value:.3g} {unit_of(name)} off" for name, value in self.best.items())
        return f"not reached in {self.attempts} attempts; the best has {best}"


def sample(
    goal: WorkspaceGoal, checker: CollisionChecker, rng: np.random.Generator, count: int = 8, max_attempts: int = 200
) -> GoalSamples:
    """Sample free states that reach a goal.

    Args:
        goal: The goal.
        checker: Checks the states for collision.
        rng: Source of the initial states.
        count: Number of states to find.
        max_attempts: Largest number of attempts.
    """
    states: list[Array] = []
    best: Mapping[str, float] = {}
    converged = attempts = 0
    colliding: Array | None = None
    while attempts < max_attempts and len(states) < count:
        attempts += 1
        q = goal.attempt(rng)
        errors = goal.errors(q)
        if not best or relative_error(errors, goal.bounds) < relative_error(best, goal.bounds):
            best = errors
        if not within(errors, goal.bounds):
            continue
        converged += 1
        if checker.is_free(q):
            states.append(q)
        else:
            colliding = q
    found = np.array(states).reshape(-1, checker.robot.dof)
    blocked = ""
    if colliding is not None and not states:
        blocked = str(next(iter(checker.contacts(colliding)), "in collision"))
    return GoalSamples(found, attempts, converged, best, blocked)


def unit_of(name: str) -> str:
    """Return the unit of an error term."""
    return "m" if name in ("lateral", "axial") or name.startswith("position") else "rad"


def relative_error(errors: Mapping[str, float], bounds: Mapping[str, float]) -> float:
    """Return the largest ratio of an error to its bound, where a bound of zero counts as 0.01."""
    return max(value / max(bounds[name], 0.01) for name, value in errors.items())
