"""The share of a robot's free states that its sphere covers prove: planners choose by it what they try first."""

from __future__ import annotations

import numpy as np

from apex_ompl.collision.checker import CollisionChecker
from apex_ompl.robot import Robot
from apex_ompl.util.cache import weakly_cached

STATES = 200  # random states by which the share is measured
ENOUGH = 0.5  # share from which searches that go only where spheres prove are the fastest


@weakly_cached
def proved_share(robot: Robot) -> float:
    """Return the share of random free states that covers and tables of clearances prove free, without obstacles.

    It is measured once for a robot. Where ENOUGH of all random states are proved, this share of them is returned,
    which is a lower bound; then no meshes are checked. 1 where no state is free.

    Raises:
        MissingFileError: The robot names a file of covers that cannot be read.
        FileFormatError: That file, or that of clearance tables, does not follow its schema.
        RobotError: The kernel does not support the motion of a joint.
    """
    checker, states = CollisionChecker(robot), robot.random_state(np.random.default_rng(0), STATES)
    proved = int((checker.kernel.unproved(states)[1] == 0).sum())
    if proved >= ENOUGH * STATES:
        return proved / STATES
    free = int(checker.are_free(states).sum())
    return proved / free if free else 1.0


def share_note(robot: Robot) -> str:
    """Return a sentence for users of a robot of which little is proved, or an empty string."""
    share = proved_share(robot)
    if share >= ENOUGH:
        return ""
    return (
        f"sphere covers prove only {share:.0%} of the free states of {robot.name}, so that trees checked by meshes come"
        " first and planning is slow; `apex-ompl robot check` names the links, `apex-ompl robot prepare` makes covers"
    )
