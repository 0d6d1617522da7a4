"""Stop and wait: the rest of the first plan, as soon as that is proved."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from apex_ompl.errors import ApexError
from apex_ompl.loop.replan.portfolio import Portfolio
from apex_ompl.moving.charges import Charges
from apex_ompl.moving.ready import Ready
from apex_ompl.moving.request import Answer, Request
from apex_ompl.moving.retime import retime
from apex_ompl.moving.search import Search
from apex_ompl.moving.sources import rest_of_route
from apex_ompl.timing import Trajectory, time_path
from apex_ompl.types import Array


def timed(search: Search, states: Array) -> Trajectory | None:
    """Return a motion from rest to rest along states, shape (N, dof), or None where none is found."""
    search.charges.charge("straight motion" if len(states) == 2 else "path in time")
    try:
        return time_path(states, search.ready.limits, search.ready.names).trajectory
    except ApexError:
        return None


@dataclass(eq=False)
class Resume:
    """The rest of the first plan, from where the robot stopped, as soon as that is proved: stop and wait.

    Attributes:
        first: Makes the first plan.
        retimes: Whether its speed is chosen anew among what comes (path-velocity decomposition, Kant and Zucker 1986),
            while the robot moves and from rest.
    """

    first: Portfolio
    retimes: bool = False

    def prepare(self, ready: Ready) -> None:
        """Prepare what makes the first plan."""
        self.first.prepare(ready)

    def replan(self, ready: Ready, request: Request, charges: Charges) -> Answer:
        """Return a motion along what is left of the first plan, or none."""
        if request.route is None:
            return self.first.replan(ready, request, charges)
        search = Search(ready, request, charges)
        if not request.following.at_rest(request.join):
            return Portfolio([], self.retimes, evades=False).replan(ready, request, charges)
        rest = rest_of_route(search)
        if rest is None:
            return Answer(None, "resume", charges)
        states = np.concatenate([search.start.position[None], rest[1:-1], request.route.motion.positions[-1:]])
        motion = timed(search, states)
        if motion is not None and search.accepts(motion):
            search.take(motion, "resume")
        elif motion is not None and self.retimes:
            made = retime(
                ready.kernel, request.predicted, motion, ready.limits, clock=request.join, hold=ready.settings.hold
            )
            charges.charge("retiming")
            if made.trajectory is not None and search.accepts(made.trajectory):
                search.take(made.trajectory, "retime")
        return Answer(search.best, search.part, charges)
