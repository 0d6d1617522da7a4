"""Shortening of paths, and repair of those that pass the search resolution and fail the full check."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import nullcontext
from typing import TYPE_CHECKING

import numpy as np
from ompl import base as ob
from ompl import geometric as og

from apex_ompl.collision import CollisionChecker
from apex_ompl.collision.path_proof import PathProof
from apex_ompl.ompl.process import Interrupt, ends_after
from apex_ompl.ompl.setup import PlanningSetup
from apex_ompl.ompl.simple_setup import SimpleSetup
from apex_ompl.ompl.space import array_to_path, path_to_array, to_state
from apex_ompl.ompl.validity import (
    ConstrainedMotionCheck,
    FullCheck,
    MotionProof,
    MotionValidator,
    StateValidityChecker,
    forwarding,
    full_check,
    motions_until,
)
from apex_ompl.paths.optimizer import Optimizer
from apex_ompl.paths.path import Path, path_length
from apex_ompl.types import Array

if TYPE_CHECKING:
    from apex_ompl.constraints.constraint_set import ConstraintSet

ROUNDS = 6
MIN_GAIN = 0.01  # a round that shortens by less than this share is the last


def simplify(si: ob.SpaceInformation, path: Array, stop: Callable[[], bool] = lambda: False) -> Array:
    """Return a shorter path with the same ends, by OMPL's vertex reduction and partial shortcuts.

    Rounds are counted, never timed, so that the same seed gives the same path.

    Motions are checked by the motion validator of ``si``.

    Args:
        si: OMPL's space information of the problem.
        path: States, shape (N, dof).
        stop: Asked whether to end before every round, and before every motion that is checked.
    """
    if len(path) < 3:
        return path
    validator = si.getMotionValidator()
    watched = si if isinstance(validator, MotionValidator) else forwarding(si, stop=stop)
    simplifier, work, best = og.PathSimplifier(watched), array_to_path(watched, path), path
    with motions_until(validator, stop) if isinstance(validator, MotionValidator) else nullcontext():
        for _ in range(ROUNDS):
            if stop():
                break
            simplifier.reduceVertices(work)
            simplifier.partialShortcutPath(work)
            states = path_to_array(work, path.shape[1])
            gain = 1.0 - path_length(states) / max(path_length(best), 1e-12)
            if gain > 0.0:
                best = states
            if gain < MIN_GAIN:
                break
    return np.concatenate([path[:1], best[1:-1], path[-1:]])


DRAWS = 40  # of shortcuts on constraints


def exact_paths(
    checker: CollisionChecker, constraints: ConstraintSet, nodes: Array, *,
    rng: np.random.Generator | None = None, stop: Callable[[], bool] = lambda: False,
) -> list[Array]:  # fmt: skip
    """Return paths that are proved to keep constraints, shape (N, dof) each, of one in a projected state space.

    They are not checked for collisions.

    Args:
        checker: Collision checker, for shortcuts.
        constraints: The constraints.
        nodes: States whose motions were found valid, shape (N, dof).
        rng: Source of shortcuts, whose path comes first; None for no shortcuts.
        stop: Asked whether to end shortcuts.
    """
    from apex_ompl.constraints.paths import ConstrainedPaths

    paths = ConstrainedPaths(checker.kernel, constraints, Optimizer(), lambda states: True, stop)
    several = [nodes]
    if rng is not None and not constraints.user:
        several.insert(0, paths.shortcut(nodes, DRAWS, rng))
    found = []
    for some in several:
        states = ConstrainedMotionCheck(checker, constraints).along(some)
        exact = None if states is None else paths.along(states)
        if exact is not None:
            found.append(exact)
    return found


MAX_BRIDGES = 20
RANGE = 1.0  # of the trees, as tuned for rrtconnect [rad]


def repair(
    problem: PlanningSetup, path: Array, fault: FullCheck, deadline: float, interrupt: Interrupt | None = None
) -> tuple[Path, PathProof] | None:
    """Plan stretches that fail the full check anew; the motions there are proved one by one.

    Args:
        problem: Planning setup of the problem.
        path: States, shape (N, dof), the first and the last of them free.
        fault: Outcome of the full check of ``path``.
        deadline: Value of ``time.perf_counter`` at which to give up [s].
        interrupt: Ends the work in good order when it was pressed.

    Returns:
        A path that passes the full check with its proof, or None.
    """
    interrupt = interrupt or Interrupt()
    for _ in range(MAX_BRIDGES):
        if time.perf_counter() >= deadline or fault.segment is None or interrupt.pressed:
            return None
        first, last = _free_ends(problem, path, fault.segment)
        bridge = _bridge(problem, path[first], path[last], deadline, interrupt)
        if bridge is None:
            return None
        path = np.concatenate([path[:first], bridge, path[last + 1 :]])
        fault = full_check(problem.checker, path, problem.start, problem.goals, deadline=deadline)
        if fault.proof is not None and fault:
            return Path(path), fault.proof
    return None


def _free_ends(problem: PlanningSetup, path: Array, segment: int) -> tuple[int, int]:
    """Return the states nearest to a segment, before and after it, that are proved free.

    Shortcuts may put a state between those that were checked, so that a state of the path itself collides.
    """
    first, last = segment, segment + 1
    while first > 0 and not problem.checker.prove(path[first, None], tolerance=0.0):
        first -= 1
    while last < len(path) - 1 and not problem.checker.prove(path[last, None], tolerance=0.0):
        last += 1
    return first, last


def _bridge(problem: PlanningSetup, a: Array, b: Array, deadline: float, interrupt: Interrupt) -> Array | None:
    """Return a path between two free states whose motions are proved, or None."""
    setup = SimpleSetup(problem.robot, problem.bounds)
    si = setup.getSpaceInformation()
    validity_checker = StateValidityChecker(si, problem.checker)
    motions = MotionValidator(si, MotionProof(problem.checker), validity_checker)
    setup.setStateValidityChecker(validity_checker)
    si.setMotionValidator(motions)
    setup.setStartAndGoalStates(to_state(si, a), to_state(si, b))
    planner = og.RRTConnect(si)
    planner.setRange(RANGE)
    setup.setPlanner(planner)
    condition = ends_after(deadline - time.perf_counter())
    with interrupt.ends(condition) as ptc, motions_until(motions, lambda: time.perf_counter() >= deadline):
        status = setup.solve(ptc)
    fault = validity_checker.fault or motions.fault
    if fault is not None:
        raise fault
    if status.getStatus() != ob.PlannerStatus.EXACT_SOLUTION:
        return None
    bridge = path_to_array(setup.getSolutionPath(), problem.robot.dof)
    return np.stack([a, b]) if len(bridge) < 2 else np.concatenate([a[None], bridge[1:-1], b[None]])
