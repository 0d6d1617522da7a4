"""A camera whose images come over ROS 2."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Mapping
from typing import Any

from apex_ompl.errors import ApexError, DriverError, ParameterError
from apex_ompl.perception.bags import ALIGNED, COLOR, INFO, STATES
from apex_ompl.perception.camera import Camera
from apex_ompl.perception.frames import Frame
from apex_ompl.perception.synchronizer import TOLERANCE, Synchronizer
from apex_ompl.util.display import one_line
from apex_ompl.util.extras import names_of
from apex_ompl.util.validation import check_integer, check_positive

NEEDED = {
    "sensor_msgs.msg": ("CameraInfo", "CompressedImage", "Image", "JointState"),
    "rclpy.qos": ("qos_profile_sensor_data",),
}
COMPRESSED = ("/compressed", "/compressedDepth")  # ends of topics of the transports of these names
KEPT = 30  # frames that wait to be taken


class Ros2Camera:
    """Takes images, intrinsics and joint states of topics, and keeps the frames that they make.

    Stamps of frames are those of the images, since 1970 or since the start of the simulation [s]
    (:meth:`apex_ompl.drivers.Ros2Driver.times_of` has them on a driver's clock).
    """

    def __init__(
        self, node: Any, camera: Camera | None = None, *, color: str | None = COLOR, depth: str | None = ALIGNED,
        info: str | None = INFO, states: str | None = STATES, renamed: Mapping[str, str] | None = None,
        tolerance: float = TOLERANCE, rectified: bool = False, kept: int = KEPT,
    ) -> None:  # fmt: skip
        """Subscribe; the topics are by default those of a RealSense camera with depths aligned to colors.

        Topics that end in ``/compressed`` or ``/compressedDepth`` have ``CompressedImage`` messages.

        Args:
            node: A node of the caller's (``rclpy.node.Node``), which the caller spins in another thread.
            camera: The camera; by default the intrinsics are those of the topic, and there is no pose.
            color: Topic of color images, or None.
            depth: Topic of depth images, or None.
            info: Topic of the intrinsics, which is not read with a camera.
            states: Topic of joint states, or None.
            renamed: Names of joints in ROS where they are others, by ours.
            tolerance: Largest time between what belongs together [s].
            rectified: Whether images are rectified.
            kept: Number of frames that wait to be taken; older ones are dropped.

        Raises:
            MissingFileError: The extra ``ros2`` is not installed, nor a ROS 2 of the system sourced.
            ParameterError: There are neither topics of images, nor intrinsics, or a number is out of range.
        """
        if camera is None and info is None:
            raise ParameterError("info", info, "the topic of the intrinsics, or a camera")
        ros = names_of(NEEDED, "sensor_msgs", "ROS 2", "ros2")
        self._node, self._arrived = node, threading.Condition()
        self._frames = deque[Frame](maxlen=check_integer(kept, "kept", 1))
        self._error: ApexError | None = None
        self._together = together = Synchronizer(
            camera, color=color is not None, depth=depth is not None, states=states is not None, renamed=renamed,
            tolerance=tolerance, rectified=rectified,
        )  # fmt: skip
        wanted = [
            (color, ros.CompressedImage if (color or "").endswith(COMPRESSED) else ros.Image, together.color),
            (depth, ros.CompressedImage if (depth or "").endswith(COMPRESSED) else ros.Image, together.depth),
            (states, ros.JointState, together.states),
            (info if camera is None else None, ros.CameraInfo, together.info),
        ]  # fmt: skip
        self._subscriptions = [
            node.create_subscription(kind, topic, lambda message, take=take: self._take(take, message),
                                     ros.qos_profile_sensor_data)
            for topic, kind, take in wanted if topic is not None
        ]  # fmt: skip

    def __repr__(self) -> str:
        """Return the camera, and how many images were left out."""
        return one_line("Ros2Camera", repr(self._together))

    @property
    def dropped(self) -> dict[str, int]:
        """How many images were left out, by the reason."""
        with self._arrived:
            return dict(self._together.dropped)

    def frames(self) -> list[Frame]:
        """Return the frames that came since the last call.

        Raises:
            ParameterError: A message was faulty (:class:`apex_ompl.perception.Synchronizer`).
        """
        with self._arrived:
            error, self._error = self._error, None
            if error is not None:
                raise error
            found = [*self._frames]
            self._frames.clear()
            return found

    def next(self, timeout: float = 1.0) -> Frame:
        """Return the next frame that comes, and forget those before it.

        Raises:
            DriverError: None came within a time [s].
            ParameterError: As :meth:`frames`.
        """
        check_positive(timeout, "timeout", "a positive number of seconds")
        self.frames()
        end = time.monotonic() + timeout
        with self._arrived:
            self._arrived.wait_for(lambda: self._frames or self._error is not None, end - time.monotonic())
        found = self.frames()
        if not found:
            lacks = "no intrinsics" if self._together.camera is None else "no images"
            why = ", ".join(f"{reason}: {count}" for reason, count in self.dropped.items()) or lacks
            raise DriverError(f"no frame came in {timeout:g} s ({why})")
        return found[-1]

    def close(self) -> None:
        """End the subscriptions."""
        for one in self._subscriptions:
            self._node.destroy_subscription(one)
        self._subscriptions = []

    def _take(self, take: Any, message: Any) -> None:
        with self._arrived:
            try:
                take(message)
                self._frames.extend(self._together.ready())
            except ApexError as error:
                self._error = error
            self._arrived.notify_all()
