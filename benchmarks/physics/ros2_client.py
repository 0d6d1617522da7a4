"""A client of the node: publishes goals and obstacles, and takes what the node tells, over the real middleware."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Self

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseArray, PoseStamped
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import JointState, PointCloud2, PointField
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory
from visualization_msgs.msg import Marker, MarkerArray

TYPES = {
    "goal/joints": JointState, "goal/left_hand": PoseStamped, "goal/poses": PoseArray, "world": MarkerArray,
    "obstacles": MarkerArray, "points": PointCloud2, "object/ball": PoseStamped,
}  # fmt: skip
TRIED = 20.0  # time for a first answer [s]


@contextmanager
def alone() -> Iterator[None]:
    """Keep messages on this machine, and apart from those of other processes that test."""
    wanted = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_DOMAIN_ID": str(1 + os.getpid() % 100)}
    before = {name: os.environ.get(name) for name in wanted}
    os.environ |= wanted
    yield
    for name, value in before.items():
        os.environ.pop(name) if value is None else os.environ.__setitem__(name, value)


class Client:
    """A client whose messages a thread takes.

    Attributes:
        outcomes: How goals ended, so far.
        diagnostics: The statuses that were told.
        markers: The last markers.
        clouds: Number of clouds that came, where they are counted.
        trajectories: Times of arrival on the monotonic clock [s], and trajectories, by controller.
    """

    def __init__(self, topics: Sequence[str] = (*TYPES,)) -> None:
        """Start publishers of some topics."""
        self.outcomes, self.diagnostics, self.markers = list[str](), list[Any](), list[Any]()
        self.trajectories, self.clouds = list[tuple[float, str, Any]](), 0
        self.context = rclpy.Context()
        rclpy.init(context=self.context)
        self.node = rclpy.create_node("client", context=self.context)
        sensor, deep = qos_profile_sensor_data, QoSProfile(depth=10)
        self.publishers = {
            name: self.node.create_publisher(
                TYPES[name],
                f"/apex_ompl/{name}",
                sensor if name in ("obstacles", "points") or "object" in name else deep,
            )
            for name in topics
        }
        kept = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.node.create_subscription(String, "/apex_ompl/outcome", lambda m: self.outcomes.append(m.data), 10)
        self.node.create_subscription(DiagnosticArray, "/diagnostics", lambda m: self.diagnostics.extend(m.status), 10)
        self.node.create_subscription(MarkerArray, "/apex_ompl/markers", self._draw, kept)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.closed = False
        self.thread = threading.Thread(target=self._spin, daemon=True)
        self.thread.start()

    def _draw(self, message: Any) -> None:
        self.markers[:] = message.markers

    def _followed(self, name: str) -> Callable[[Any], None]:
        return lambda message: self.trajectories.append((time.monotonic(), name, message))

    def _spin(self) -> None:
        while not self.closed:
            self.executor.spin_once(timeout_sec=0.05)

    def trajectories_of(self, controllers: Sequence[str]) -> None:
        """Take the trajectories of controllers from now on."""
        for name in controllers:
            topic = f"/{name}/joint_trajectory"
            self.node.create_subscription(JointTrajectory, topic, self._followed(name), 10)
            self.wait(lambda topic=topic: self.node.count_publishers(topic))
        time.sleep(0.3)

    def count_clouds(self) -> None:
        """Count the clouds that come through the middleware from now on."""

        def count(_: Any) -> None:
            self.clouds += 1

        self.node.create_subscription(PointCloud2, "/apex_ompl/points", count, qos_profile_sensor_data)
        time.sleep(0.3)

    @contextmanager
    def running(self) -> Iterator[Self]:
        """Close the client after the block."""
        try:
            yield self
        finally:
            self.close()

    def close(self) -> None:
        """End the client."""
        self.closed = True
        self.thread.join()
        self.executor.shutdown()
        self.node.destroy_node()
        self.context.try_shutdown()

    def wait(self, found: Callable[[], Any], timeout: float = 20.0) -> Any:
        """Wait until something is true, and return it."""
        end = time.monotonic() + timeout
        while not found():
            assert time.monotonic() < end, f"nothing in {timeout:g} s; outcomes so far: {self.outcomes}"
            time.sleep(0.002)
        return found()

    def matched(self) -> None:
        """Wait until the node listens to all publishers, and how goals ended comes here."""
        for publisher in self.publishers.values():
            self.wait(lambda publisher=publisher: publisher.get_subscription_count())
        end = time.monotonic() + TRIED
        while not self.outcomes:
            assert time.monotonic() < end, "the node does not answer"
            self.publishers["goal/joints"].publish(JointState())  # is refused
            time.sleep(0.3)
        time.sleep(0.3)
        self.outcomes.clear()

    def go(self, topic: str, message: Any) -> str:
        """Send a goal, and return how it ended."""
        count = len(self.outcomes)
        self.publishers[topic].publish(message)
        return str(self.wait(lambda: self.outcomes[count:])[0])


def cloud_of(points: np.ndarray, frame: str = "world") -> PointCloud2:
    """Return points, shape (N, 3) [m], as a message."""
    data = np.asarray(points, "<f4")
    fields = [PointField(name=name, offset=4 * k, datatype=PointField.FLOAT32, count=1) for k, name in enumerate("xyz")]
    message = PointCloud2(
        height=1, width=len(data), fields=fields, point_step=12, row_step=12 * len(data), is_dense=True
    )
    message.data.frombytes(data.tobytes())
    message.header.frame_id = frame
    return message


def marker_of(
    kind: int, size: Sequence[float], position: Sequence[float], *, space: str = "", frame: str = "world"
) -> Marker:
    """Return a marker that is turned by nothing."""
    marker = Marker(type=kind, ns=space)
    marker.header.frame_id = frame
    for message, values in ((marker.scale, size), (marker.pose.position, position)):
        message.x, message.y, message.z = map(float, values)
    return marker
