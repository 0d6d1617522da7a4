"""The pixels of a held object: its window, the points that a fit uses, and why there are none."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from apex_ompl.kernel.perception import SurfaceFit, Window, select_points
from apex_ompl.perception.camera import Camera
from apex_ompl.perception.rendering import lens_of
from apex_ompl.types import Array

NOT_THERE = "no surface is seen where the hand holds it"
SAME = 0.02  # difference from the measured depth within which a surface was measured [m]
FARTHER = 0.04  # by which a depth lies behind a surface that is not there [m]
SPREAD_PIXELS = 4  # around a drawing to which its depths are extended
FAR_AWAY = 100.0  # depth behind everything [m]


class Pixels(NamedTuple):
    """What a fit is made to.

    Attributes:
        points: Points of the object in the optical frame, shape (N, 3) [m].
        beyond: Distances of pixels from those that it may cover, shape (h, w) [pixels].
        stands_for: Number of points that each of them stands for.
    """

    points: Array
    beyond: Array
    stands_for: float = 1.0

    def at_most(self, count: int) -> Pixels:
        """Return the same with this number of points at most."""
        n = len(self.points)
        kept = self.points[np.linspace(0, n - 1, min(n, count)).astype(np.int64)]
        return Pixels(kept, self.beyond, n / max(1, len(kept)))


class Surroundings(NamedTuple):
    """Depths around an object.

    Attributes:
        window: Part of the image.
        lens: Lens of the window.
        measured: Measured depths, 0 where there is none, shape (h, w) [m].
        robot: Expected depths of the robot, infinite where there is none, shape (h, w) [m].
        near_robot: The same of a robot that is thicker all around.
        noise: Largest error of depth z over z^2 [1/m].
        slack: Difference of depths that may be an error beside it [m].
    """

    window: Window
    lens: Array
    measured: Array
    robot: Array
    near_robot: Array
    noise: float
    slack: float

    def pixels_of(self, fit: SurfaceFit, center: Array, radius: float) -> Pixels:
        """Return the pixels of an object without those that it would hide, and so cannot cover.

        Args:
            fit: Where the object is.
            center: Center of a ball in the optical frame, shape (3,) [m].
            radius: Its radius [m].
        """
        local = Window(0, 0, self.window.width, self.window.height, 1)
        return Pixels(*select_points(*self._blocked(fit), local, self.lens, center, radius, self.noise, self.slack))

    def _blocked(self, fit: SurfaceFit) -> tuple[Array, Array, Array]:
        """Return the depths of which those that an object would hide are far away and no robot's."""
        measured, robot, near_robot = self.measured, self.robot, self.near_robot
        allowed = self.slack + self.noise * measured**2
        own = (measured > near_robot - allowed) & (measured < robot + allowed)
        own |= np.abs(measured - near_robot) < allowed
        if not own.any():
            return measured, robot, near_robot
        blocked = own & (measured > _extended(fit) + allowed)
        return (
            np.where(blocked, FAR_AWAY, measured), np.where(blocked, np.inf, robot),
            np.where(blocked, np.inf, near_robot),
        )  # fmt: skip

    def measured_shares(self, fit: SurfaceFit) -> tuple[float, float]:
        """Return the shares of the drawn object at whose pixels its surface was measured, and was seen through."""
        there = fit.triangle >= 0
        depth = self.measured[there]
        if not depth.size:
            return 0.0, 0.0
        farther = depth - fit.depth[there]
        return float((np.abs(farther) < SAME).mean()), float((farther > FARTHER).mean())

    def nothing_seen(self, name: str, front: float) -> str:
        """Return why there are no points of an object, as a sentence.

        Args:
            name: Its name.
            front: Depth where it begins [m].
        """
        depth = self.measured
        if np.mean(depth > 0.0) < 0.3:
            return f"{name!r}: {100 * np.mean(depth == 0.0):.0f} % of the image around it have no depth"
        if np.mean(depth[depth > 0.0] < front) > 0.3 or np.mean(np.isfinite(self.robot)) > 0.5:
            return f"{name!r} is hidden: the camera sees other surfaces before it"
        return f"{name!r}: {NOT_THERE}"


def _extended(fit: SurfaceFit) -> Array:
    """Return the depths of a drawn object, extended by some pixels, infinite where it is not, shape (h, w) [m]."""
    depth = np.where(fit.triangle >= 0, fit.depth, np.inf)
    for _ in range(SPREAD_PIXELS):
        wider = np.full((depth.shape[0] + 2, depth.shape[1] + 2), np.inf)
        wider[1:-1, 1:-1] = depth
        around = np.minimum(
            np.minimum(wider[:-2, 1:-1], wider[2:, 1:-1]), np.minimum(wider[1:-1, :-2], wider[1:-1, 2:])
        )
        depth = np.where(np.isfinite(depth), depth, around)
    return depth


def window_around(center: Array, radius: float, camera: Camera) -> Window | None:
    """Return the part of the image around a ball in the optical frame, of every second pixel where it is large.

    None where less than 12 pixels of it are in the image.
    """
    if center[2] < 2.0 * radius:
        return None
    lens = lens_of(camera)
    column, row = lens[:2] * center[:2] / center[2] + lens[2:]
    reach = radius / center[2] * lens[:2] * 1.1 + 2.0
    left, top = max(0, int(column - reach[0])), max(0, int(row - reach[1]))
    right, bottom = min(camera.width, int(column + reach[0]) + 1), min(camera.height, int(row + reach[1]) + 1)
    if right - left < 12 or bottom - top < 12:
        return None
    stride = 1 if max(right - left, bottom - top) <= 128 else 2
    return Window(left, top, (right - left) // stride, (bottom - top) // stride, stride)


def cells_of(window: Window) -> tuple[slice, slice]:
    """Return the rows and columns of a window."""
    height, width = window.height * window.stride, window.width * window.stride
    return (
        slice(window.top, window.top + height, window.stride), slice(window.left, window.left + width, window.stride)
    )  # fmt: skip
