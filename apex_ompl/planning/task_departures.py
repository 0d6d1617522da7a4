"""How hands leave what they released: around it where they touch nothing, else out of contact in their next motion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from apex_ompl.ompl.validity import full_check
from apex_ompl.planning.task_waypoints import LATE, StepFailed
from apex_ompl.planning.task_world import TaskWorld, joints_above
from apex_ompl.scene.problem import AnyStep
from apex_ompl.scene.steps import GraspStep, ReleaseStep, RetreatStep, parts
from apex_ompl.types import Array

if TYPE_CHECKING:
    from apex_ompl.planning.task_steps import StepPlan, StepPlanner

DEEPER = 2e-3  # by which contact of a hand with what it leaves may become deeper on the way [m]
EXAMINED = 50  # states at which that is examined


class Departures:
    """What hands may still touch, for the planner of a task's steps."""

    def __init__(self, planner: StepPlanner) -> None:
        """Use the checker of a planner."""
        self._planner = planner

    def parted(self, world: TaskWorld, step: AnyStep, q: Array) -> TaskWorld:
        """Return the world of a step in which hands that touch nothing at a state have left what they released.

        Hands that retreat later are left as they are: they may brush along it on their way.
        """
        if not world.leaving:
            return world
        steps = list(self._planner.problem.after)
        here = (k for k, one in enumerate(steps) if any(part is step for part in (one, *parts([one]))))
        later = steps[next(here, 0) :]
        retreating = {one.hand for one in parts(later) if isinstance(one, RetreatStep)}
        for hand in sorted(world.leaving.keys() - retreating):
            self._planner.become(world, world.pairs - world.leaving_pairs(hand))
            if self._planner.checker.is_free(q):
                world = world.left((hand,))
        return world

    def kept(self, world: TaskWorld, plan: StepPlan) -> StepPlan:
        """Return a step in which hands that move leave what they released, and touch it on the first part of it only.

        While a hand takes or lets go of something else, contact does not become deeper.

        Args:
            world: The world before it.
            plan: The step, in the world of :meth:`parted`.

        Raises:
            StepFailed: One touches it later, or deeper.
        """
        plan = replace(plan, parted=frozenset(world.leaving.keys() - plan.world.leaving.keys()))
        moving = [hand for hand in sorted(plan.world.leaving) if self._moves(hand, plan.path.states)]
        if isinstance(plan.step, GraspStep | ReleaseStep):  # after which the hand goes on leaving
            end = float(len(plan.path.states) - 1) if plan.motion is None else plan.motion.duration
            for hand in moving:
                self._check_depths(plan, hand, end)
            return plan
        if not moving:
            return plan
        found = [self.left(plan, hand) for hand in moving]
        left, clearance = max(one for one, _ in found), min(plan.clearance, *(free for _, free in found))
        return replace(plan, left=left, clearance=clearance, after=plan.after.left(moving))

    def _moves(self, hand: str, states: Array) -> bool:
        """Whether a hand moves along a path, shape (N, dof)."""
        moved = {*np.flatnonzero((states != states[0]).any(axis=0)).tolist()}
        one = self._planner.robot.hands[hand]
        closing = set() if one.synergy is None else {self._planner.robot.joint_names.index(one.synergy)}
        return bool(moved & (joints_above(self._planner.robot, one.palm) | closing))

    def left(self, plan: StepPlan, hand: str) -> tuple[float, float]:
        """Return from where on a hand has left what it released for good, and the clearance after that [m].

        Raises:
            StepFailed: It has not at the end, or touches it deeper before.
        """
        self._planner.become(plan.world, plan.world.pairs - plan.world.leaving_pairs(hand))
        left, clearance = self._free_from(plan, hand)
        self._check_depths(plan, hand, left)
        return left, clearance

    def _free_from(self, found: StepPlan, hand: str) -> tuple[float, float]:
        """Return from where on a step is proved without contact, by bisection, and the clearance from there [m].

        Raises:
            StepFailed: It ends in contact.
        """
        states, motion = found.path.states, found.motion
        places: Sequence[float] = range(len(states)) if motion is None else motion.times.tolist()

        def clearance_from(k: int) -> float | None:
            rest = states[k:] if motion is None else motion.after(places[k]) if places[k] > 0.0 else motion
            check = full_check(self._planner.checker, rest, deadline=self._planner.deadline.at)
            if check.timed_out:
                raise StepFailed(LATE)
            return None if not check or check.proof is None else check.proof.clearance

        low, high = -1, len(places) - 2 if len(places) > 1 else 0  # from ``high`` on it is proved
        clearance = clearance_from(high)
        if clearance is None:
            names = " and ".join(found.world.leaving[hand])
            needed = "a longer retreat" if isinstance(found.step, RetreatStep) else f"a retreat of {hand} before it"
            raise StepFailed(f"it ends in contact with {names}, so {needed} is needed")
        while high - low > 1:
            middle = (low + high) // 2
            better = clearance_from(middle)
            if better is None:
                low = middle
            else:
                high, clearance = middle, better
        return float(places[high]), clearance

    def _check_depths(self, plan: StepPlan, hand: str, left: float) -> None:
        """Check that contact with what a hand leaves does not become deeper until it has left it.

        Args:
            plan: The step.
            hand: The hand.
            left: Where it has left it, a time or a number of states.

        Raises:
            StepFailed: It does.
        """
        pairs = plan.world.leaving_pairs(hand)
        self._planner.become(plan.world, plan.world.pairs - pairs)
        known, first, states = {frozenset(pair) for pair in pairs}, 0.0, plan.path.states
        for k, place in enumerate(np.linspace(0.0, left, EXAMINED if left > 0.0 else 1).tolist()):
            i = min(int(place), len(states) - 1)
            q = states[i] + (place - i) * (states[min(i + 1, len(states) - 1)] - states[i])
            q = q if plan.motion is None else plan.motion(place)
            found = [] if self._planner.checker.is_free(q) else self._planner.checker.contacts(q)
            found = [c for c in found if frozenset((c.first, c.second)) in known]
            depth = max((c.depth for c in found), default=0.0)
            first = depth if k == 0 else first
            if depth > first + DEEPER:
                worst = max(found, key=lambda c: c.depth)
                bodies = f"{worst.first} and {worst.second}"
                raise StepFailed(f"{bodies} would overlap by {1e3 * depth:.1f} mm on the way", f"overlap {bodies}")
