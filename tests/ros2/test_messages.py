"""Conversion of messages and parameters, without the middleware."""

from __future__ import annotations

import struct
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from support import CUBE_OBJ, benchmark_script

from apex_ompl import Obstacle
from apex_ompl.errors import ApexError, ParameterError, UnknownNameError
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import pose_matrix

pytest.importorskip("rclpy")

from geometry_msgs.msg import Point, Quaternion, TransformStamped  # noqa: E402 - without rclpy there are no messages
from sensor_msgs.msg import PointCloud2, PointField  # noqa: E402
from visualization_msgs.msg import Marker  # noqa: E402

from apex_ompl.ros2.frames import Frames  # noqa: E402
from apex_ompl.ros2.library import ros2  # noqa: E402
from apex_ompl.ros2.messages import Drawing, cloud_points, marker_name, obstacles_of, thinned  # noqa: E402
from apex_ompl.ros2.parameters import NodeSettings, joints_by_controller  # noqa: E402
from apex_ompl.ros2.scene import Inbox  # noqa: E402

client_of = benchmark_script("physics.ros2_client")
TURN = pose_matrix((1.0, 2.0, 3.0), (0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)))  # by a right angle about z


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("size", ["f", "d"])
def test_clouds_of_any_layout_are_read(order: str, size: str) -> None:
    """An organized cloud with a color before the coordinates and rows that are padded."""
    wide = struct.calcsize(size)
    points = np.random.default_rng(0).random((2, 3, 3)).round(3)
    points[1, 1, 2] = np.nan
    rows = [
        b"".join(b"rgb_" + struct.pack(f"{order}3{size}", *point) for point in row.tolist()) + b"padding"
        for row in points
    ]
    kind = PointField.FLOAT32 if size == "f" else PointField.FLOAT64
    fields = [PointField(name="rgb", offset=0, datatype=PointField.UINT32, count=1)]
    fields += [PointField(name=name, offset=4 + k * wide, datatype=kind, count=1) for k, name in enumerate("xyz")]
    cloud = PointCloud2(
        height=2, width=3, fields=fields, is_bigendian=order == ">", point_step=4 + 3 * wide, row_step=len(rows[0])
    )
    cloud.data.frombytes(b"".join(rows))
    wanted = points.reshape(-1, 3)[np.isfinite(points.reshape(-1, 3)).all(axis=1)]
    assert np.allclose(cloud_points(cloud), wanted, atol=1e-7)


def test_faulty_clouds_are_refused() -> None:
    cloud = client_of.cloud_of(np.ones((4, 3)))
    assert not len(cloud_points(client_of.cloud_of(np.zeros((0, 3)))))
    for change, why in (
        (lambda c: c.fields.pop(), "fields x, y and z"), (lambda c: setattr(c, "width", 5), "steps that hold"),
        (lambda c: setattr(c, "height", 2), "cloud: expected 96, got '48 bytes'"),
        (lambda c: setattr(c, "point_step", 8), "steps that hold"),
        (lambda c: setattr(c.fields[0], "datatype", PointField.INT32), "fields x, y and z"),
    ):  # fmt: skip
        cloud = client_of.cloud_of(np.ones((4, 3)))
        change(cloud)
        with pytest.raises(ParameterError, match=why):
            cloud_points(cloud)


def test_a_camera_is_at_work_where_two_clouds_came() -> None:
    inbox = Inbox()
    for received, message, works in ((10, "first", False), (20, "second", True), (40, "third", False)):
        inbox.put(partial(inbox.add_cloud, received, message))
        assert inbox.clouds_come(since=received - 15) is works
    inbox.wait_for_cloud(0.0)
    assert inbox.take_cloud() == (40, "third") and inbox.take_cloud() is None and not inbox.waits()


def test_each_point_is_in_a_cell() -> None:
    points = np.random.default_rng(0).normal(0.0, 0.1, (3000, 3))
    cells = thinned(points, 0.05)
    off = np.abs(points[:, None] - cells[None]).max(axis=2).min(axis=1)
    assert len(cells) < len(points) and off.max() <= 0.025 + 1e-12


def test_markers_are_obstacles_where_they_are_shown(tmp_path: Path) -> None:
    mesh = tmp_path / "a cube.obj"
    mesh.write_text(CUBE_OBJ)
    for kind, size, fields in (
        (Marker.CUBE, (0.1, 0.2, 0.3), {"box": (0.1, 0.2, 0.3)}),
        (Marker.SPHERE, (0.1, 0.2, 0.1), {"sphere": {"radius": 0.1}}),
        (Marker.CYLINDER, (0.2, 0.1, 0.3), {"cylinder": {"radius": 0.1, "length": 0.3}}),
        (Marker.MESH_RESOURCE, (0.1, 0.1, 0.2), {"mesh": {"file": str(mesh), "scale": (0.1, 0.1, 0.2)}}),
    ):
        marker = client_of.marker_of(kind, size, (0.5, 0.0, 0.0))
        marker.mesh_resource = mesh.as_uri()
        (found,) = obstacles_of(marker, "one", TURN)
        wanted = Obstacle(name="one", position=(1.0, 2.5, 3.0), orientation=found.orientation, **fields)
        assert found.model_copy(update={"position": wanted.position}) == wanted
        assert np.allclose(found.position, wanted.position) and np.allclose(found.pose[:3, :3], TURN[:3, :3])
    listed = client_of.marker_of(Marker.SPHERE_LIST, (0.1, 0.1, 0.1), (0.0, 0.0, 1.0))
    listed.points = [Point(x=0.1), Point(y=0.2)]
    found = obstacles_of(listed, "two", TURN)
    assert [one.name for one in found] == ["two/0", "two/1"]
    assert np.allclose([one.position for one in found], [(1.0, 2.1, 4.0), (0.8, 2.0, 4.0)])
    marker = client_of.marker_of(Marker.CUBE, (0.1, 0.1, 0.1), (0.0, 0.0, 0.0), space="my box!")
    assert marker_name(marker, "world") == "world/my_box_/0"


def test_markers_that_are_no_obstacles_are_refused() -> None:
    bad = client_of.marker_of(Marker.CUBE, (0.1, 0.1, 0.1), (0.0, 0.0, 0.0))
    bad.pose.orientation = Quaternion(w=3.0)
    for marker, why in (
        (client_of.marker_of(Marker.ARROW, (1.0, 1.0, 1.0), (0.0, 0.0, 0.0)), "expected a cube, ball.*got 'an arrow'"),
        (client_of.marker_of(Marker.CUBE, (0.1, 0.0, 0.1), (0.0, 0.0, 0.0)), "greater than 0"),
        (client_of.marker_of(Marker.CUBE, (0.1, 0.1, 0.1), (np.nan, 0.0, 0.0)), "finite numbers"),
        (client_of.marker_of(Marker.MESH_RESOURCE, (1.0, 1.0, 1.0), (0.0, 0.0, 0.0)), "mesh file"),
        (bad, "unit quaternion"),
    ):
        with pytest.raises(ApexError, match=why) as raised:
            obstacles_of(marker, "one", np.eye(4))
        assert "\n" not in str(raised.value)


def test_drawn_obstacles_are_the_same_when_they_are_read() -> None:
    drawing = Drawing(ros2(), "world", Marker().header.stamp)
    given = [
        Obstacle(name="a", box=(0.1, 0.2, 0.3), position=(1.0, 2.0, 3.0), orientation=(0.6, 0.0, 0.0, 0.8)),
        Obstacle(name="b", sphere={"radius": 0.1}, position=(1.0, 0.0, 0.0)),
        Obstacle(name="c", cylinder={"radius": 0.1, "length": 0.4}),
    ]
    for one in given:
        drawing.add_obstacle("world", one, (1.0, 0.0, 0.0, 1.0))
    assert drawing.message.markers[0].action == Marker.DELETEALL
    found = [
        obstacles_of(marker, one.name, np.eye(4))
        for one, marker in zip(given, drawing.message.markers[1:], strict=True)
    ]
    for one, (read,) in zip(given, found, strict=True):
        assert (
            np.allclose(read.pose, one.pose)
            and read.model_copy(update={"position": one.position, "orientation": one.orientation}) == one
        )


def test_frames_are_looked_up_in_turn(robot: Robot) -> None:
    q, given = robot.home, pose_matrix((0.0, 0.0, 1.0), (0.0, 0.0, 0.0, 1.0))
    frames = Frames(robot, "map", {"camera": given})
    chain = []
    for parent, child in (
        ("left_hand_palm", "wrist_camera"),
        ("map", "camera"),
        ("nowhere", "lost"),
        ("b", "a"),
        ("a", "b"),
    ):
        one = TransformStamped(child_frame_id=f"/{child}")
        one.header.frame_id = parent
        one.transform.translation.x, one.transform.rotation.w = 0.1, 1.0
        chain.append(one)
    frames.take(chain)
    assert np.array_equal(frames.pose("", q), np.eye(4)) and np.array_equal(frames.pose("/map", q), np.eye(4))
    assert np.array_equal(frames.pose("camera", q), given)  # the parameter goes before /tf
    palm = robot.link_pose(q, "left_hand_palm")
    assert np.allclose(frames.pose("wrist_camera", q), palm @ pose_matrix((0.1, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)))
    for name, why in (("kitchen", "got 'kitchen'"), ("lost", "got 'lost below nowhere'"), ("a", "frame_id")):
        with pytest.raises(ParameterError, match=why):
            frames.pose(name, q)


def test_controllers_are_given_by_joints_and_groups(robot: Robot) -> None:
    assert joints_by_controller(["arms"], robot) == "arms"
    found = joints_by_controller(["left=left_arm", "rest=right_arm,left_hand_synergy,right_hand_synergy"], robot)
    assert isinstance(found, dict) and sorted(found["left"] + found["rest"]) == sorted(robot.joint_names)
    with pytest.raises(UnknownNameError, match="elbow"):
        joints_by_controller(["left=elbow"], robot)
    for given in (["left", "right"], [""], ["left="]):
        with pytest.raises(ParameterError, match="controllers: expected"):
            joints_by_controller(given, robot)


def test_the_budget_of_a_replan_is_a_multiple_of_the_period() -> None:
    for period in (0.005, 0.01, 0.025, 0.03, 0.07, 0.1):
        settings = NodeSettings(period=period).loop
        assert settings.period == period and abs(settings.budget - 0.05) <= 0.5 * period + 1e-12
