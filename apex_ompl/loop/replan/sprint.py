"""A short search by trees while the robot moves, with obstacles where they will be."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from apex_ompl.collision import CollisionChecker
from apex_ompl.kernel.search import TreePair
from apex_ompl.moving.placing import fresh_checker, place_nearest
from apex_ompl.moving.ready import Ready
from apex_ompl.moving.search import STATES, Guess, Search, least_duration
from apex_ompl.ompl.tuned import TUNED
from apex_ompl.paths.path import SEARCH_RESOLUTION, resample

AT_ONCE = 16  # random states between two looks at the charges
CHARGE = "state of a tree"


@dataclass(eq=False)
class Sprint:
    """RRT-Connect in compiled code, for a robot that stands, from the second replan of a run on.

    Its paths are longer than those that other sources begin from, so that they are no way to begin a run.
    Each obstacle that moves stands where it comes nearest to the straight line in time; where it will touch the robot
    at the start of the search, there is none.

    Attributes:
        longest: Longest step of the trees [rad].
        most: Random states, at most.
    """

    longest: float = float(TUNED["apex"]["range"])
    most: int = 1024
    name: str = "sprint"
    _checker: CollisionChecker | None = field(default=None, repr=False)

    def prepare(self, ready: Ready) -> None:
        """Set up a checker of its own."""
        self._checker = fresh_checker(ready)

    def guesses(self, search: Search) -> Iterator[Guess]:
        """Yield the path of the trees, where they meet in time."""
        assert self._checker is not None
        request = search.request
        if not len(search.goals) or request.number == 1 or not request.following.at_rest(request.join):
            return
        place_nearest(self._checker, search, search.goals[0])
        start = search.start.position
        free = self._checker.are_free(np.concatenate([start[None], search.goals]))
        search.charges.charge(CHARGE, len(free))
        goals = search.goals[free[1:]]
        if not free[0] or not len(goals):
            return
        trees = TreePair(self._checker.kernel, start[None], goals, self.longest, SEARCH_RESOLUTION, search.rng)
        for _ in range(0, self.most, AT_ONCE):
            path = trees.grow(AT_ONCE)
            looked = trees.take_counts()
            search.charges.charge(CHARGE, looked.proved + looked.blocked + looked.intervals)
            if path is not None:
                states = resample(path, STATES)
                yield Guess(states, path[-1], least_duration(states, search.ready.limits))
                return
            if search.charges.over():
                return
