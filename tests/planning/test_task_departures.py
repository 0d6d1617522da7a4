"""Hands and what they released: around it, out of contact in the next motion, and never through it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from tasks import contacts

from apex_ompl import MotionPlanner, PoseTarget
from apex_ompl.planning import TaskSearch

SECONDS = 60.0
DOWN = (1.0, 0.0, 0.0, 0.0)


def entry(kind: str, **fields: Any) -> dict[str, Any]:
    return {"kind": kind, **fields}


def test_a_hand_that_is_open_goes_around_what_it_released() -> None:
    with MotionPlanner("panda") as planner:
        grasps = [{"position": (0, 0, 0.02), "orientation": DOWN}]
        planner.world.add(name="box", box=(0.04, 0.06, 0.1), position=(0.5, 0.0, 0.3), grasps=grasps)
        taken = [entry("move", goal={"grasp": {"object": "box", "hand": "hand", "approach": (0, 0, 0.08)}})]
        taken += [entry("grasp", hand="hand", object="box"), entry("release", hand="hand")]
        through = planner.sequence("home", [*taken, entry("line", frame="hand", by=(0, 0, -0.04))], timeout=SECONDS)
        assert not through and "panda_hand <-> box" in through.reason
        beside = PoseTarget(frame="hand", position=(0.5, 0.25, 0.3), orientation=DOWN)
        for search in (TaskSearch(), TaskSearch(asynchronous=True)):
            result = planner.sequence("home", [*taken, entry("move", goal=beside)], timeout=SECONDS, search=search)
            assert result and "box" in {one.name for one in result.steps[-1].scene}, result.reason
            assert not result.steps[-1].allowed  # the hand has left the box
            assert not [*contacts(planner.robot, result, 0.01)]


@pytest.mark.parametrize(
    ("way", "words"),
    [
        ((0.0, 0.0, 0.1), ""),
        ((0.0, 0.0, -0.03), "it ends in contact with box, so a retreat of left_hand before it is needed"),
        ((0.02, 0.0, 0.0), "it ends in contact with box, so a retreat of left_hand before it is needed"),
    ],
)
def test_a_hand_that_touches_what_it_released_leaves_it_at_once(way: tuple[float, ...], words: str) -> None:
    """The palm reaches 2 mm into a box that it lets go of; ways are along its axes."""
    with MotionPlanner() as planner:
        robot = planner.robot
        palm = robot.link_pose(robot.home, "left_hand_palm")
        planner.world.attach(
            {"name": "box", "link": "left_hand_palm", "box": (0.05, 0.05, 0.05), "position": (0.0, 0.0, -0.031)}
        )
        line = entry("line", frame="left_hand", by=tuple(palm[:3, :3] @ way))
        other = PoseTarget(frame="right_hand", position=tuple(planner.fk("home", "right_hand")[:3, 3] - (0, 0.1, 0)))
        rest = entry("move", goal=other, group="right_arm")  # the left hand still touches it
        result = planner.sequence("home", [entry("detach", object="box"), rest, line], timeout=SECONDS)
        assert bool(result) == (not words) and words in result.reason
        if not words:
            leaving = result.steps[-1]
            assert leaving.start < leaving.left < leaving.end and ("left_hand_palm", "box") in {
                tuple(sorted(pair, reverse=True)) for pair in leaving.leaving
            }
            assert result.trajectory is not None
            box = next(one for one in leaving.scene if one.name == "box")
            surface = [
                (np.linalg.inv(box.pose) @ robot.link_pose(result.trajectory(t), "left_hand_palm"))[2, 3]
                for t in (leaving.start, leaving.left, leaving.end)
            ]
            assert surface[0] == pytest.approx(0.031, abs=1e-6)
            assert 0.033 < surface[1] < surface[2] == pytest.approx(0.131, abs=1e-3)  # 2 mm at least


def test_a_hand_does_not_close_for_one_object_through_another_that_it_released() -> None:
    """The fingers are in front of a box that was let go of; what is taken lies beside it in the hand."""
    with MotionPlanner() as planner:
        fields = {"box": (0.02, 0.02, 0.02), "touch_links": planner.robot.hand_of("left_hand_palm")}
        planner.world.attach({"name": "box", "link": "left_hand_palm", "position": (0.0, 0.06, -0.05), **fields})
        planner.world.attach({"name": "cap", "link": "left_hand_palm", "position": (0.0, -0.02, -0.04), **fields})
        ways = [entry("hand", hand="left_hand", to=0.8)], [
            entry("detach", object="cap"), entry("grasp", hand="left_hand", object="cap", to=0.8)
        ]  # fmt: skip
        for steps in ways:
            result = planner.sequence("home", [entry("detach", object="box"), *steps], timeout=SECONDS)
            assert not result and "box" in result.reason, result.reason
