"""A camera over ROS 2, whose messages a publisher in the same process sends."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from images import CAMERA, START, Ros, image, info, states
from support import benchmark_script

from apex_ompl.errors import DriverError, MissingFileError, ParameterError
from apex_ompl.perception import Ros2Camera
from apex_ompl.perception.bags import ALIGNED, COLOR, INFO, STATES


def test_what_is_missing_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ParameterError, match="intrinsics"):
        Ros2Camera(None, info=None)
    monkeypatch.setitem(__import__("sys").modules, "sensor_msgs.msg", None)
    with pytest.raises(MissingFileError, match=r"apex-ompl\[ros2\]"):
        Ros2Camera(None)


@pytest.fixture
def ros() -> Iterator[Any]:
    """A node that is spun, and publishers of the topics."""
    rclpy = pytest.importorskip("rclpy")
    from rclpy.executors import SingleThreadedExecutor
    from sensor_msgs.msg import CameraInfo, Image, JointState

    with benchmark_script("physics.ros2_client").alone():
        context = rclpy.Context()
        rclpy.init(context=context)
        node = rclpy.create_node("camera_test", context=context)
        executor = SingleThreadedExecutor(context=context)
        executor.add_node(node)
        thread = threading.Thread(target=executor.spin, daemon=True)
        kinds = {COLOR: Image, ALIGNED: Image, INFO: CameraInfo, STATES: JointState}
        publishers = {topic: node.create_publisher(kind, topic, 10) for topic, kind in kinds.items()}
        thread.start()
        yield SimpleNamespace(node=node, publishers=publishers)
        executor.shutdown()
        thread.join(5.0)
        node.destroy_node()
        context.try_shutdown()


def test_frames_come_over_ros(ros: Any) -> None:
    camera, source = Ros2Camera(ros.node), Ros()
    while any(not one.get_subscription_count() for one in ros.publishers.values()):
        time.sleep(0.01)
    sent = threading.Event()

    def publish() -> None:
        while not camera._together.camera:
            ros.publishers[INFO].publish(info(source))
            time.sleep(0.02)
        at = START
        while not sent.is_set():
            ros.publishers[STATES].publish(states(source, at, joint=0.25))
            ros.publishers[COLOR].publish(image(source, np.full((4, 6, 3), 7, np.uint8), "rgb8", at))
            ros.publishers[ALIGNED].publish(image(source, np.full((4, 6), 1.5, np.float32), "32FC1", at))
            at += 50_000_000
            time.sleep(0.02)

    thread = threading.Thread(target=publish)
    thread.start()
    try:
        first, second = camera.next(20.0), camera.next(20.0)
    finally:
        sent.set()
        thread.join()
    assert second.stamp > first.stamp >= START / 1e9 and first.camera == CAMERA
    assert (first.depth == 1.5).all() and first.color is not None and (first.color == 7).all()
    assert dict(first.joints) == {"joint": 0.25}
    camera.frames()
    ros.publishers[ALIGNED].publish(image(source, np.zeros((4, 6, 3), np.uint8), "rgb8"))
    with pytest.raises(ParameterError, match="16UC1"):
        for _ in range(1000):
            camera.frames()
            time.sleep(0.01)
    with pytest.raises(DriverError, match="no frame came"):
        camera.next(0.1)
    with pytest.raises(ParameterError, match="timeout"):
        camera.next(0.0)
    camera.close()
    end = time.monotonic() + 20.0
    while ros.publishers[COLOR].get_subscription_count() and time.monotonic() < end:
        time.sleep(0.01)
    assert not ros.publishers[COLOR].get_subscription_count()
