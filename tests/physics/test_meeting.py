"""Whether objects as they lie in the hands can be brought together."""

from __future__ import annotations

import pytest
from planning import cached_problem

from apex_ompl.physics.camera import CameraRunner
from apex_ompl.physics.meeting import can_meet
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import AttachedObject


def pushed(peg: AttachedObject, by: float) -> AttachedObject:
    """Return the peg, by some way further out of the hand along its axis, which is x of the palm."""
    x, y, z = peg.position
    return peg.model_copy(update={"position": (x + by, y, z)})


@pytest.mark.parametrize(("by", "meets"), [(0.0, True), (0.02, True), (-0.03, False)])
def test_a_peg_reaches_as_deep_as_it_stands_out_of_the_hand(robot: Robot, by: float, meets: bool) -> None:
    """The palm ends at x = 0.05 m, the peg at 0.11 m, and goes 0.05 m into the block: 0.01 m are left."""
    problem = cached_problem("peg_in_hole")
    block, peg = problem.attached
    start = problem.start_state(robot.joint_names)
    assert can_meet(robot, start, (block, pushed(peg, by)), problem.after) is meets
    assert can_meet(robot, start, (block, pushed(peg, by)), ())  # nothing brings them together


def test_grasps_are_drawn_that_can_meet(robot: Robot) -> None:
    problem = cached_problem("peg_in_hole")
    trial = CameraRunner(problem, friction=()).drawn(5).trial
    start = trial.known.start_state(robot.joint_names)
    assert trial.real.attached[1].position != problem.attached[1].position
    assert can_meet(robot, start, trial.real.attached, problem.after)
