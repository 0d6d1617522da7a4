"""Solutions of Ruckig's state-to-state problems (Berscheid and Kroeger 2021) as trajectories."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Self

import numpy as np
import ruckig

from apex_ompl.kernel.timing import TICK, join_profiles
from apex_ompl.timing.trajectory import Trajectory
from apex_ompl.types import Array

SHORTEST_PIECE = 1e-9  # [s]


def calculate(solver: ruckig.Ruckig, query: ruckig.InputParameter, solution: ruckig.Trajectory) -> None:
    """Solve a query of Ruckig's and put the motion into ``solution``.

    Raises:
        RuckigError: It has no solution.
    """
    try:
        result = solver.calculate(query, solution)
    except ValueError as error:  # a result that the bindings have no name for
        raise ruckig.RuckigError(str(error)) from error
    if result not in (ruckig.Result.Working, ruckig.Result.Finished):
        raise ruckig.RuckigError(str(result))


def knots(solution: ruckig.Trajectory) -> tuple[Array, Array, Array, Array]:
    """Return the times at which the jerk of any joint changes, both ends included, and the states at them.

    Returns:
        Times of shape (K,) [s]; positions, velocities and accelerations of shape (K, dof).
    """
    changes = [0.0, solution.duration]
    for profile in solution.profiles[0]:
        changes += [*np.cumsum(profile.brake.t), *(profile.brake.duration + np.cumsum(profile.t))]
    times = np.unique(np.clip(changes, 0.0, solution.duration))
    times = times[np.append(True, np.diff(times) > SHORTEST_PIECE)]
    if len(times) > 1:
        times[-1] = solution.duration
    states = (solution.at_time(float(time)) for time in times)
    q, v, a = (np.array(values) for values in zip(*states, strict=True))
    return times, q, v, a


class Profiles(NamedTuple):
    """Motions of joints from state to state in phases of constant jerk.

    Attributes:
        phases: Durations of the phases of each motion and joint, shape (K, dof, phases) [s].
        jerks: Jerks in them, likewise [rad/s^3].
        durations: Durations of the motions, shape (K,) [s].
        brakes: Whether any begins by braking, which it does from a state over a limit.
    """

    phases: Array
    jerks: Array
    durations: Array
    brakes: bool

    @classmethod
    def of(cls, solutions: Sequence[ruckig.Trajectory]) -> Self:
        """Return those of Ruckig's solutions."""
        rows = [solution.profiles[0] for solution in solutions]
        phases = np.array([[profile.t for profile in row] for row in rows])
        jerks = np.array([[profile.j for profile in row] for row in rows])
        durations = np.array([solution.duration for solution in solutions])
        brakes = bool(np.abs(phases.sum(axis=2) - durations[:, None]).max() > TICK)
        if brakes:
            before = [[profile.brake for profile in row] for row in rows]
            phases = np.concatenate([np.array([[brake.t for brake in row] for row in before]), phases], axis=2)
            jerks = np.concatenate([np.array([[brake.j for brake in row] for row in before]), jerks], axis=2)
        return cls(phases, jerks, durations, brakes)


def joined(profiles: Profiles, states: Array, joint_names: tuple[str, ...]) -> Trajectory:
    """Return motions one after the other as one trajectory that goes through states exactly.

    Its knots are where the jerk of any joint changes.

    Args:
        profiles: The motions.
        states: Positions, velocities and accelerations between which they go, shape (3, K + 1, dof).
        joint_names: Names of the joints.
    """
    starts = np.round(np.cumsum([0.0, *profiles.durations]) / TICK).astype(np.int64)
    return Trajectory.unchecked(*join_profiles(profiles.phases, profiles.jerks, starts, states), joint_names)
