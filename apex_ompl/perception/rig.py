"""Cameras around a robot in simulation: where they stand, and what is wrong with what they report."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Protocol

import numpy as np
import pinocchio as pin

from apex_ompl.errors import ParameterError
from apex_ompl.perception.camera import Camera, DepthErrors, look_at
from apex_ompl.perception.frames import Frame
from apex_ompl.perception.rendering import DepthSensor, View
from apex_ompl.types import Array

RED = (0.8, 0.1, 0.08, 1.0)  # color of obstacles that are seen and not told
SIZE, FOCAL = (640, 480), 465.0  # of the default cameras [pixels]
PLACES = {"front": (1.6, 0.0, 1.0), "above": (1.0, 0.0, 1.7)}  # of their lenses [m]
TARGET = (0.4, 0.0, 0.45)  # at which they look [m]
POSITION_SPREAD, ANGLE_SPREAD, SCALE_SPREAD = 0.0012, 0.002, 0.003  # of their calibration [m, rad, 1]


class Eye(Protocol):
    """A camera that draws frames."""

    camera: Camera

    def frame(self) -> Frame:
        """Return what it sees now."""


def default_cameras(width: int = SIZE[0]) -> tuple[Camera, ...]:
    """Return two cameras of 69 degrees, before the robot and above, with errors as after a calibration.

    Args:
        width: Width of their images, whose sides are as 4 to 3 [pixels].
    """
    scale = width / SIZE[0]
    height = round(SIZE[1] * scale)
    return tuple(
        Camera(
            name=name, width=width, height=height, focal=(FOCAL * scale, FOCAL * scale),
            center=((width - 1.0) / 2.0, (height - 1.0) / 2.0), position_spread=POSITION_SPREAD,
            angle_spread=ANGLE_SPREAD,
            depth=DepthErrors(scale_spread=SCALE_SPREAD, noise=0.0038, correlation=max(1, round(4 * scale))),
        ).placed(look_at(place, TARGET))
        for name, place in PLACES.items()
    )  # fmt: skip


def load_cameras(files: Sequence[str | Path]) -> tuple[Camera, ...]:
    """Read camera files, whose cameras have names of their own.

    Raises:
        ApexError: A file cannot be read, or two cameras have the same name.
    """
    cameras = tuple(Camera.load(file) for file in files)
    names = [camera.name for camera in cameras]
    for name in names:
        if names.count(name) > 1:
            raise ParameterError("cameras", name, "a name for each camera")
    return cameras


def misplaced(camera: Camera, rng: np.random.Generator) -> Camera:
    """Return the camera as it may truly be: its pose is off by its spreads, its scale of depths too."""
    off = np.eye(4)
    off[:3, :3] = pin.exp3(camera.angle_spread * rng.standard_normal(3))
    off[:3, 3] = camera.position_spread * rng.standard_normal(3)
    scale = camera.depth.scale * (1.0 + camera.depth.scale_spread * rng.standard_normal())
    depth = camera.depth.model_copy(update={"scale": float(np.clip(scale, 0.6, 1.9))})
    return camera.placed(camera.pose @ off).model_copy(update={"depth": depth})


def noisy(camera: Camera, rng: np.random.Generator, sensor: DepthSensor | None = None) -> Callable[[Array], Array]:
    """Return a function from exact depths to those that a stereo camera measures."""
    model = sensor or DepthSensor()

    def measured(depth: Array) -> Array:
        nothing = np.zeros((*depth.shape, 3))
        return model.measure(View(depth, np.zeros(depth.shape, np.int64), nothing), camera, rng)[0]

    return measured


def repeated(frame: Frame, count: int, measured: Callable[[Array], Array], period: float = 0.1) -> list[Frame]:
    """Return frames of a robot at rest from one with exact depths, each with noise of its own.

    Args:
        frame: The frame with exact depths; the last one has its stamp.
        count: Number of frames.
        measured: Function from exact depths to measured ones.
        period: Time between frames [s].
    """
    stamps = [frame.stamp - period * (count - 1 - k) for k in range(count)]
    return [replace(frame, depth=measured(frame.depth), stamp=stamp) for stamp in stamps]


def check_cameras(cameras: Iterable[Camera]) -> tuple[Camera, ...]:
    """Return cameras as a tuple.

    Raises:
        ParameterError: There is none, or one of another kind.
    """
    found = tuple(cameras)
    if not found:
        raise ParameterError("cameras", "none", "one camera or more")
    for one in found:
        if not isinstance(one, Camera):
            raise ParameterError("cameras", one, "cameras")
    return found
