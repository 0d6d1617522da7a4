"""Frames by name and in the kernel's joints, against placements by Pinocchio."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from scipy.spatial.transform import Rotation

from apex_ompl.collision import CollisionChecker
from apex_ompl.constraints.frames import frame_of
from apex_ompl.constraints.links import Links
from apex_ompl.errors import UnknownNameError
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import AttachedObject, ContactFace, pose_fields

TURN = Rotation.from_rotvec([0.4, -0.9, 0.3])


def held(axis: tuple[float, float, float] | None) -> AttachedObject:
    contact = None if axis is None else ContactFace(point=(0.01, 0.02, 0.05), axis=axis)
    return AttachedObject(
        name="cup", link="left_hand_palm", cylinder={"radius": 0.03, "length": 0.1}, position=(0.0, 0.02, -0.08),
        orientation=tuple(TURN.as_quat().tolist()), contact=contact,
    )  # fmt: skip


def test_the_frame_of_a_face_is_that_of_the_object_after_the_shortest_turn(robot: Robot) -> None:
    own = held(None).pose
    np.testing.assert_array_equal(frame_of(robot, "cup", {"cup": held(None)}).pose, own)
    for axis in ((0.0, 0.0, 2.0), (0.0, 1.0, 1.0), (-3.0, 0.5, 0.1), (0.0, 0.0, -1.0)):
        found = frame_of(robot, "cup", {"cup": held(axis)})
        assert found.link == "left_hand_palm" and found.axial
        outward = own[:3, :3] @ axis / np.linalg.norm(axis)
        turned = Rotation.from_matrix(found.pose[:3, :3])
        np.testing.assert_allclose(turned.as_matrix()[:, 2], outward, atol=1e-12)
        np.testing.assert_allclose(found.pose[:3, 3], own[:3, :3] @ [0.01, 0.02, 0.05] + own[:3, 3], atol=1e-12)
        shortest = np.arccos(np.clip(outward @ own[:3, 2], -1.0, 1.0))
        assert (turned * Rotation.from_matrix(own[:3, :3]).inv()).magnitude() == pytest.approx(shortest, abs=1e-7)
    upside_down = frame_of(robot, "cup", {"cup": held((0.0, 0.0, -1.0))}).pose
    np.testing.assert_allclose(upside_down[:3, 0], own[:3, 0], atol=1e-12)


def test_hands_and_links_have_frames(robot: Robot) -> None:
    hand = frame_of(robot, "right_hand", {})
    assert hand.link == robot.hands["right_hand"].palm and not hand.axial
    np.testing.assert_array_equal(hand.pose[:3, 3], robot.hands["right_hand"].point)
    np.testing.assert_array_equal(frame_of(robot, "left_link4", {}).pose, np.eye(4))
    with pytest.raises(UnknownNameError, match="^unknown tool 'cup'"):
        frame_of(robot, "cup", {}, "tool")


@pytest.mark.parametrize("name", ["left_link5", "right_hand_index_distal", "world"])
def test_a_frame_moves_with_the_joint_that_it_is_given_in(robot: Robot, name: str) -> None:
    local = pin.SE3(TURN.as_matrix(), np.array([0.1, -0.2, 0.3]))
    links = Links.of(robot)
    joint, pose = links.frame(name, local)
    for axis in range(3):  # what is known of the kernel's joints are points and directions
        same = links.direction(name, local.rotation[:, axis])
        assert same.joint == joint
        np.testing.assert_allclose(pose.rotation[:, axis], same.vector, atol=1e-12)
    np.testing.assert_allclose(pose.translation, links.point(name, local.translation).vector, atol=1e-12)
    if name == "world":
        assert joint == 0
        np.testing.assert_allclose(pose.homogeneous, robot.link_pose(robot.home, name) @ local.homogeneous, atol=1e-12)


def test_the_joints_that_move_frames_against_each_other_are_those_that_change_them(robot: Robot) -> None:
    links, names = Links.of(robot), ("left_hand_palm", "left_link3", "right_hand_index_distal", "world")
    joints = [links.frame(name, pin.SE3.Identity())[0] for name in names]
    for i, first in enumerate(names):
        for j, second in enumerate(names):
            moved = []
            rest = np.linalg.inv(robot.link_pose(robot.home, first)) @ robot.link_pose(robot.home, second)
            for k in range(robot.dof):
                q = robot.home + 0.1 * (np.arange(robot.dof) == k)
                there = np.linalg.inv(robot.link_pose(q, first)) @ robot.link_pose(q, second)
                moved += [k] if np.abs(there - rest).max() > 1e-9 else []
            assert links.moved(joints[i], joints[j]) == tuple(moved)


def test_what_two_hands_hold_may_touch_both(robot: Robot) -> None:
    palms = ("left_hand_palm", "right_hand_palm")
    inside = np.linalg.inv(robot.link_pose(robot.home, palms[0])) @ robot.link_pose(robot.home, palms[1])
    fields = {"name": "tray", "sphere": {"radius": 0.03}, **pose_fields(inside)}
    for held, free in ((AttachedObject(link=palms[0], **fields), False), (AttachedObject(links=palms, **fields), True)):
        assert CollisionChecker(robot, [], [held]).is_free(robot.home) == free
    with pytest.raises(UnknownNameError, match="'no_palm'"):
        CollisionChecker(robot, [], [AttachedObject(links=(palms[0], "no_palm"), **fields)])
