"""Starts in contact: a short straight motion along increasing clearance, before the plan itself.

Real robots report states in which a hand rests on a table, or an object on a shelf, fractions of a millimeter inside of
the model. A plan may start there where the caller allows it (``leave_contact``): a short straight motion leaves the
contact, and the remaining motion is planned and proved as usual.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from apex_ompl.collision import CollisionChecker
from apex_ompl.errors import ParameterError
from apex_ompl.ompl.setup import PlanningSetup, assemble, state_fault
from apex_ompl.paths.path import Path
from apex_ompl.result import PlanResult
from apex_ompl.timing import Timing, time_path
from apex_ompl.timing.trajectory import joined
from apex_ompl.types import Array

LARGEST_DEPTH = 1e-3  # of contacts that the refusal of a start names ``leave_contact`` for [m]
FREE = 1e-4  # clearance at which this motion may end [m]
REACH = 0.15  # longest motion [rad, max-norm]
STEP = 1e-3  # spacing of the states that are checked on it [rad, max-norm]
ROUNDING = 1e-7  # by which distances of contacts are uncertain [m]
DIRECTIONS = 64  # random ones, tried where the gradient fails
DIFFERENCE = 1e-4  # of the finite differences [rad]


@dataclass(frozen=True, eq=False)
class Departure:
    """A straight motion out of a contact.

    Attributes:
        start: The start, shape (dof,).
        end: First state of the plan that follows, shape (dof,).
        depth: Depth of the deepest contact at the start [m].
        contact: Names of the two bodies of that contact.
        states: Number of states between them that were checked.
    """

    start: Array
    end: Array
    depth: float
    contact: tuple[str, str]
    states: int

    @property
    def note(self) -> str:
        """Note for the user."""
        first, second = self.contact
        length = float(np.abs(self.end - self.start).max())
        return (
            f"{first} and {second} touch at the start, {1e3 * self.depth:.2f} mm deep; the first {length:.4f} rad lead "
            f"out of it along growing clearance, which {self.states} states show, and only the rest is proved"
        )


def find_departure(setup: PlanningSetup, most: float, seed: int = 0) -> Departure | None:
    """Return a motion out of the contacts at the start, or None where one is deeper than ``most`` or none is found.

    The clearance of the nearest pair does not decrease along it by more than rounding, and its end is free. The
    direction is the gradient of the clearance, or one of a few random directions with a positive slope.

    Args:
        setup: A problem whose start is invalid.
        most: Largest depth of a contact [m].
        seed: Seed of the directions.
    """
    checker, start = setup.checker, setup.start
    if checker.robot.limit_fault(start):
        return None
    contacts, depth = checker.contacts(start), -checker.clearance(start)
    if depth > most + ROUNDING or any(contact.depth > most + ROUNDING for contact in contacts):
        return None
    names = (contacts[0].first, contacts[0].second) if contacts else _nearest_pair(checker, start)
    rng, free = np.random.default_rng(seed), np.delete(np.arange(len(start)), setup.held)
    drawn = np.zeros((DIRECTIONS, len(start)))
    drawn[:, free] = rng.normal(size=(DIRECTIONS, len(free)))
    uphill = _gradient(checker, start, free)
    drawn *= np.where(drawn @ uphill < 0.0, -1.0, 1.0)[:, None]
    for direction in (uphill, *drawn):
        size = np.abs(direction).max()
        if size > 0.0:
            found = _climbed(setup, direction / size)
            if found is not None:
                end, states = found
                return Departure(start, end, max(depth, 0.0), names, states)
    return None


def departed(setup: PlanningSetup, most: float, seed: int) -> tuple[Departure | None, PlanningSetup]:
    """Return a motion out of the contacts at an invalid start, and the problem from its end; else None and the problem.

    Args:
        setup: The problem.
        most: Largest depth of a contact [m].
        seed: Seed of the directions, and of the goals that are sampled again.

    Raises:
        ParameterError: There are constraints along the path, which such a motion would not keep.
    """
    if setup.constraints is not None:
        raise ParameterError("leave_contact", most, f"0, since there is a constraint: {setup.constraints.names[0]}")
    departure = find_departure(setup, most, seed) if setup.start_fault else None
    if departure is None:
        return None, setup
    names = setup.robot.joint_names
    start = dict(zip(names, departure.end.tolist(), strict=True))
    moving = [name for k, name in enumerate(names) if k not in setup.held]
    problem = setup.problem.model_copy(update={"start": start})
    return departure, assemble(problem, setup.robot, seed=seed, checker=setup.checker, moving=moving)


def remedy(setup: PlanningSetup) -> str:
    """Return advice on a start in slight contact, or an empty text."""
    checker, start = setup.checker, setup.start
    if checker.robot.limit_fault(start) or checker.clearance(start) < -LARGEST_DEPTH:
        return ""
    return f"; leave_contact={LARGEST_DEPTH:g} [m] lets a plan leave contacts up to that depth"


def with_departure(result: PlanResult, setup: PlanningSetup, departure: Departure, timing: Timing | None) -> PlanResult:
    """Return the result of a plan from the end of a departure as one from its start; both motions end at rest.

    Args:
        result: Result of the plan that follows.
        setup: The given problem.
        departure: The motion to the start of that plan.
        timing: How motions are timed.
    """
    notes = (*result.notes, departure.note)
    result = replace(result, problem=setup.problem, notes=notes)
    if result.path is None:
        return result
    path = Path(np.concatenate([departure.start[None], result.path.states]))
    if result.trajectory is None or timing is None:
        return replace(result, path=path)
    limits, names = setup.robot.limits, setup.robot.joint_names
    line = Path(np.stack([departure.start, departure.end]))
    first = time_path(line, limits, names, replace(timing, minimum_duration=0.0)).trajectory
    motion = joined([first, result.trajectory])
    return replace(result, path=path, trajectory=motion, limit_use=motion.use(limits))


def _nearest_pair(checker: CollisionChecker, q: Array) -> tuple[str, str]:
    """Return the names of the nearest pair of bodies at a state, shape (dof,)."""
    pair: tuple[str, str] = checker.prove(q[None], tolerance=0.0).pair
    return pair


def _gradient(checker: CollisionChecker, q: Array, free: NDArray[np.integer]) -> Array:
    """Return the gradient of the clearance by finite differences, shape (dof,) [m/rad]; 0 for other joints."""
    found, limits = np.zeros(len(q)), checker.robot.limits
    for k in free:
        low, high = q.copy(), q.copy()
        low[k], high[k] = max(q[k] - DIFFERENCE, limits.lower[k]), min(q[k] + DIFFERENCE, limits.upper[k])
        if high[k] > low[k]:
            found[k] = (checker.clearance(high) - checker.clearance(low)) / (high[k] - low[k])
    return found


def _climbed(setup: PlanningSetup, direction: Array) -> tuple[Array, int] | None:
    """Return the first free state along a direction and the number of states up to it, or None."""
    checker, limits = setup.checker, setup.robot.limits
    before = checker.clearance(setup.start)
    for k in range(1, int(REACH / STEP) + 1):
        q = np.clip(setup.start + k * STEP * direction, limits.lower, limits.upper)
        clearance = checker.clearance(q)
        if clearance < before - ROUNDING or (k > 1 and clearance <= before):
            return None
        if clearance >= FREE and not state_fault(checker, q):
            return q, k
        before = clearance
    return None
