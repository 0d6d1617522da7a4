"""Frames from messages of ROS 2: images, intrinsics and joint states that belong together by their stamps."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apex_ompl.errors import ParameterError
from apex_ompl.perception.camera import Camera
from apex_ompl.perception.frames import Frame, check_camera
from apex_ompl.perception.messages import camera_of, color_image, depth_image
from apex_ompl.timing.files import NANOSECONDS
from apex_ompl.util.display import one_line
from apex_ompl.util.validation import check_positive

TOLERANCE = 0.02  # between stamps of what belongs together [s]
PATIENCE = 0.5  # for which an image waits for what comes after it [s]


class Synchronizer:
    """Puts messages together to frames, which have the stamps of depth images, or of color images where there are none.

    A frame has the color image with the nearest stamp, and positions of joints between those before and after it.

    Attributes:
        camera: The camera that frames name, or None as long as there are no intrinsics.
        dropped: How many images were left out, by the reason.
    """

    def __init__(
        self, camera: Camera | None = None, *, color: bool = True, depth: bool = True, states: bool = True,
        renamed: Mapping[str, str] | None = None, tolerance: float = TOLERANCE, rectified: bool = False,
    ) -> None:  # fmt: skip
        """Wait for messages.

        Args:
            camera: The camera, by default that of ``CameraInfo`` messages, without a pose.
            color: Whether frames have colors.
            depth: Whether they have depths; else these are 0, which is enough to calibrate.
            states: Whether they have positions of joints.
            renamed: Names of joints in ROS where they are others, by ours.
            tolerance: Largest time between what belongs together [s].
            rectified: Whether images are rectified, for intrinsics (:func:`apex_ompl.perception.messages.camera_of`).

        Raises:
            ParameterError: The tolerance is not positive, there are neither colors nor depths, or another argument is
                faulty.
        """
        check_positive(tolerance, "tolerance", "a positive number of seconds")
        if camera is not None:
            check_camera(camera)
        given = {} if renamed is None else renamed
        if not isinstance(given, Mapping) or len({*given.values()}) < len(given):
            raise ParameterError("renamed", renamed, "names of joints in ROS by ours, each once")
        if not (color or depth):
            raise ParameterError("color", color, "colors, depths, or both")
        self.camera, self.dropped = camera, Counter[str]()
        self._rectified, self._tolerance = rectified, round(tolerance * NANOSECONDS)
        self._ours = {theirs: name for name, theirs in given.items()}
        self._mains, self._colors = deque[tuple[int, NDArray[Any]]](), deque[tuple[int, NDArray[Any]]]()
        self._with_depth, self._paired, self._with_states = depth, depth and color, states
        self._states = dict[str, deque[tuple[int, float]]]()
        self._last = -1

    def __repr__(self) -> str:
        """Return the camera, and how many images were left out."""
        name = "no camera yet" if self.camera is None else self.camera.name
        return one_line("Synchronizer", name, *(f"{reason}: {count}" for reason, count in self.dropped.items()))

    def info(self, message: Any) -> None:
        """Take a ``sensor_msgs/CameraInfo``, unless there is a camera.

        Raises:
            ApexError: As :func:`apex_ompl.perception.messages.camera_of`.
        """
        if self.camera is None:
            self.camera = camera_of(message, rectified=self._rectified)

    def color(self, message: Any) -> None:
        """Take a color image, a ``sensor_msgs/Image`` or ``CompressedImage``.

        Raises:
            ParameterError: As :func:`apex_ompl.perception.messages.color_image`.
        """
        (self._colors if self._paired else self._mains).append((_stamp(message), color_image(message)))

    def depth(self, message: Any) -> None:
        """Take a depth image that is aligned to the color image, a ``sensor_msgs/Image`` or ``CompressedImage``.

        Raises:
            ParameterError: As :func:`apex_ompl.perception.messages.depth_image`.
        """
        self._mains.append((_stamp(message), depth_image(message)))

    def states(self, message: Any) -> None:
        """Take a ``sensor_msgs/JointState`` of some joints or all; one older than the last of a joint is left out."""
        stamp = _stamp(message)
        for name, position in zip(message.name, message.position, strict=False):
            known = self._states.setdefault(self._ours.get(name, name), deque())
            if np.isfinite(position) and (not known or stamp > known[-1][0]):
                known.append((stamp, float(position)))

    def ready(self, *, end: bool = False) -> list[Frame]:
        """Return the frames that are complete, in order.

        Args:
            end: Whether no more messages come: then images do not wait for any.

        Raises:
            ParameterError: The images have another size than the camera's, or depths are of another unit.
        """
        found = []
        while self._mains and self.camera is not None:
            stamp, image = self._mains[0]
            waited = self._mains[-1][0] - stamp > PATIENCE * NANOSECONDS
            if not (end or waited or self._complete(stamp)):
                break
            self._mains.popleft()
            frame = self._frame(stamp, image, self.camera)
            if frame is not None:
                found.append(frame)
                self._last = stamp
        return found

    def _complete(self, stamp: int) -> bool:
        """Whether there are messages of each kind after a stamp [ns]."""
        color = not self._paired or bool(self._colors and self._colors[-1][0] >= stamp)
        newest = [known[-1][0] for known in self._states.values() if known]
        return color and (not self._with_states or bool(newest) and min(newest) >= stamp)

    def _frame(self, stamp: int, image: NDArray[Any], camera: Camera) -> Frame | None:
        """Return the frame of an image, or None where something lacks, which is counted."""
        if stamp <= self._last:
            self.dropped["not later than the image before"] += 1
            return None
        color = None if self._with_depth else image
        if self._paired:
            while len(self._colors) > 1 and abs(self._colors[1][0] - stamp) <= abs(self._colors[0][0] - stamp):
                self._colors.popleft()
            if not self._colors or abs(self._colors[0][0] - stamp) > self._tolerance:
                self.dropped["no color image of that time"] += 1
                return None
            color = self._colors[0][1]
        joints = self._positions(stamp) if self._with_states else {}
        if joints is None:
            self.dropped["no joint states of that time"] += 1
            return None
        depth = image if self._with_depth else np.zeros((camera.height, camera.width))
        return Frame(camera, depth, color, stamp / NANOSECONDS, joints)

    def _positions(self, stamp: int) -> dict[str, float] | None:
        """Return the positions of joints at a stamp [ns]; None where there are none, or one has none near it."""
        found = {}
        for name, known in self._states.items():
            while len(known) > 1 and known[1][0] <= stamp:
                known.popleft()
            if not known:
                continue
            (before, q), (after, p) = known[0], known[1] if len(known) > 1 else known[0]
            if min(abs(before - stamp), abs(after - stamp)) > self._tolerance:
                return None
            found[name] = float(np.interp(stamp, (before, after), (q, p))) if after > before else q
        return found or None


def _stamp(message: Any) -> int:
    """Return the stamp of the header [ns]."""
    return int(message.header.stamp.sec) * NANOSECONDS + int(message.header.stamp.nanosec)
