"""RRTConnect from rest, among obstacles where they are seen."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np
from ompl import base as ob

from apex_ompl.loop.replan.resuming import timed
from apex_ompl.moving.charges import Charges
from apex_ompl.moving.placing import fresh_checker, place
from apex_ompl.moving.ready import Ready
from apex_ompl.moving.request import Answer, Request
from apex_ompl.moving.search import Search
from apex_ompl.ompl.process import seed_ompl
from apex_ompl.ompl.setup import PlanningSetup, assemble, set_goals
from apex_ompl.ompl.simplify import simplify
from apex_ompl.ompl.space import path_to_array, to_state
from apex_ompl.ompl.tuned import TUNED
from apex_ompl.ompl.validity import MotionValidator
from apex_ompl.planners.registry import parameters
from apex_ompl.types import Array

RRTCONNECT = "rrtconnect"


@contextmanager
def charged(validator: MotionValidator, ready: Ready, charges: Charges, proved: bool) -> Iterator[None]:
    """While the block runs, charge every motion that is checked, and prove it clear of what stands still if asked."""
    check = validator.check

    def counted(first: Array, second: Array) -> bool:
        charges.charge("motion of a tree")
        return check(first, second) and (not proved or ready.line_is_clear(first, second, charges))

    validator.check = counted
    try:
        yield
    finally:
        validator.check = check


@dataclass(eq=False)
class Snapshot:
    """OMPL's RRTConnect, with the range that is tuned on validation, among obstacles where they are seen now.

    What it finds is followed if it is proved among obstacles as they are predicted. As if they stood is no better: of
    24 worlds ``moving`` of the validation split, at a quarter of the velocity limits, 12 are solved as it is, 11 so.
    Where a motion is not proved clear of what stands still, a path is looked for whose straight motions are.
    """

    _setup: PlanningSetup | None = field(default=None, repr=False)

    def prepare(self, ready: Ready) -> None:
        """Set OMPL up with a checker of its own, whose obstacles are placed anew by each replan."""
        self._setup = assemble(ready.setup.problem, ready.setup.robot, checker=fresh_checker(ready))

    def replan(self, ready: Ready, request: Request, charges: Charges) -> Answer:
        """Return a motion from rest that is proved among what is expected, or none."""
        search = Search(ready, request, charges)
        for proved in (False, True) if request.following.at_rest(request.join) else ():
            states = self.path(search, proved)
            motion = None if states is None else timed(search, states)
            if motion is not None and search.accepts(motion):
                search.take(motion, RRTCONNECT)
            if states is None or search.best is not None or (motion is not None and ready.clear_of_still(motion)):
                break
        return Answer(search.best, search.part, charges)

    def path(self, search: Search, proved: bool) -> Array | None:
        """Return a path among obstacles where they are seen now, shape (N, dof), or None.

        Args:
            search: The replan.
            proved: Whether each straight motion is proved clear of what stands still; else it is looked at in steps.
        """
        assert self._setup is not None
        setup = self._setup
        for obstacle in search.request.obstacles:
            place(setup.checker, obstacle, obstacle.position)
        goals = [goal for goal in search.goals if setup.checker.is_free(goal)]
        if not goals or not setup.checker.is_free(search.start.position):
            return None
        simple_setup = setup.simple_setup
        si = simple_setup.getSpaceInformation()

        simple_setup.clear()
        simple_setup.setStartState(to_state(si, search.start.position))
        set_goals(simple_setup, goals)
        simple_setup.setPlanner(parameters(RRTCONNECT, **TUNED[RRTCONNECT]).build(si))
        seed_ompl(int(search.rng.integers(1, 2**31)))
        path = None
        with charged(setup.motion_validator, search.ready, search.charges, proved):
            status = simple_setup.solve(ob.PlannerTerminationCondition(search.charges.over))
            if status.getStatus() == ob.PlannerStatus.EXACT_SOLUTION:
                found = path_to_array(simple_setup.getSolutionPath(), setup.robot.dof)
                path = simplify(si, found, search.charges.over)
        setup.raise_faults()
        if path is None:
            return None
        goal = min(goals, key=lambda goal: float(np.linalg.norm(goal - path[-1])))
        return np.concatenate([search.start.position[None], path[1:-1], goal[None]])
