from __future__ import annotations

import numpy as np
import pytest

from apex_ompl.collision import CollisionChecker
from apex_ompl.errors import SceneError, UnknownNameError
from apex_ompl.goals.grasp import grasp
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import AttachedObject

ALONG_X = (0.0, np.sqrt(0.5), 0.0, np.sqrt(0.5))


def bar(radius: float, **changes: object) -> AttachedObject:
    """A bar across the fingers that lies on the palm."""
    fields = {"position": (0.0, 0.02, -0.009 - radius), "orientation": ALONG_X, **changes}
    return AttachedObject(name="bar", link="any", cylinder={"radius": radius, "length": 0.11}, **fields)


def strict_contacts(robot: Robot, held: AttachedObject, hand: str, synergy: float) -> list[str]:
    """Finger links that touch the object when only the palm may, by the checker."""
    palm = robot.hands[hand].palm
    checker = CollisionChecker(robot, (), [held.model_copy(update={"link": palm, "touch_links": (palm,)})])
    q = robot.home.copy()
    q[robot.joint_names.index(robot.hands[hand].synergy)] = synergy
    return [c.first for c in checker.contacts(q) if c.second == "bar" and "hand" in c.first]


@pytest.mark.parametrize("hand", ["left_hand", "right_hand"])
@pytest.mark.parametrize("radius", [0.02, 0.03, 0.04, 0.05])
def test_the_synergy_is_that_of_first_contact(robot: Robot, hand: str, radius: float) -> None:
    closed = grasp(robot, hand, bar(radius))
    assert closed.synergy_joint == f"{hand}_synergy" and 0.05 < closed.synergy < 0.6
    assert strict_contacts(robot, bar(radius), hand, closed.synergy) == []
    assert closed.touched in strict_contacts(robot, bar(radius), hand, closed.synergy + 2e-3)
    q = robot.home.copy()
    q[robot.joint_names.index(closed.synergy_joint)] = closed.synergy
    assert CollisionChecker(robot, (), [closed.held]).is_free(q)
    assert set(closed.held.touch_links or ()) == set(robot.hand_of(robot.hands[hand].palm))


def test_thicker_objects_are_touched_earlier_and_both_hands_alike(robot: Robot) -> None:
    radii = (0.02, 0.03, 0.04, 0.05)
    right, left = ([grasp(robot, hand, bar(r)).synergy for r in radii] for hand in ("right_hand", "left_hand"))
    assert right == sorted(right, reverse=True) and len(set(right)) == 4
    np.testing.assert_allclose(right, left, atol=1e-4)


def test_what_is_out_of_reach_closes_the_hand_fully(robot: Robot) -> None:
    closed = grasp(robot, "right_hand", bar(0.01, position=(0.0, 0.0, -0.5)))
    assert closed.synergy == 1.0 and closed.touched == ""


def test_faults_are_named(robot: Robot, baxter: Robot) -> None:
    with pytest.raises(UnknownNameError, match="hand 'rihgt_hand', did you mean 'right_hand'"):
        grasp(robot, "rihgt_hand", bar(0.02))
    with pytest.raises(SceneError, match="open right_hand does not clear 'bar'"):
        grasp(robot, "right_hand", bar(0.03, position=(0.0, 0.06, 0.02)))
    stiff = grasp(baxter, "left", bar(0.02))
    assert stiff.synergy_joint is None and stiff.held.link == "left_gripper"
