"""Frames of a camera: color, depth, time and the state of the robot, in files and folders."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from apex_ompl.errors import FileFormatError, MissingFileError, ParameterError
from apex_ompl.perception.camera import Camera
from apex_ompl.scene.points import depth_in_meters
from apex_ompl.types import Array
from apex_ompl.util.display import fields_line
from apex_ompl.util.files import make_folder, pack_archive, path_text, read_archive, write_atomically
from apex_ompl.util.schema import check_version, validate
from apex_ompl.util.validation import check_array, check_number, finite_numbers

SCHEMA = "apex-ompl/frame/1"
ROLE = "frame"
KEY = "frame"  # of the JSON text in the archive
SUFFIX = ".npz"
DEEPEST = 65.0  # what whole millimeters of 16 bits hold [m]
STILL = 2e-3  # difference of joints of a robot that stands still [rad; synergies 0..1]
NEAR = 0.03  # distance from the median within which depths are of the same surface [m]
LEAST_SHARE = 0.25  # of frames with a depth of a pixel


@dataclass(frozen=True, eq=False)
class Frame:
    """What a camera saw at one time.

    Attributes:
        camera: The camera.
        depth: Depths along the optical axis, shape (height, width) [m]; 0 where there is none. Given as whole numbers
            it is in millimeters.
        color: Red, green and blue, shape (height, width, 3), of type uint8, or None.
        stamp: Time [s].
        joints: Name of a joint -> its position at that time [rad; synergies 0..1].
    """

    camera: Camera
    depth: Array
    color: NDArray[np.uint8] | None = None
    stamp: float = 0.0
    joints: Mapping[str, float] = field(default_factory=dict)

    __repr__ = fields_line

    def __post_init__(self) -> None:
        """Check the parts.

        Raises:
            ApexError: An image has another size than the camera's, depths are negative or of another unit, or a number
                is not finite.
        """
        check_camera(self.camera)
        if not isinstance(self.joints, Mapping):
            raise ParameterError("joints", self.joints, "positions by the names of joints")
        shape = (self.camera.height, self.camera.width)
        depth = depth_in_meters(self.depth)
        check_array(depth, shape, "depth")
        depth = np.where(np.isfinite(depth), depth, 0.0)
        if depth.size and depth.min() < 0.0:
            raise ParameterError("depth", float(depth.min()), "depths of 0 or more")
        object.__setattr__(self, "depth", depth)
        if self.color is not None:
            color = np.asarray(self.color)
            if color.dtype != np.uint8 or color.shape != (*shape, 3):
                found = f"{color.dtype} of shape {color.shape}"
                raise ParameterError("color", found, f"uint8 of shape {(*shape, 3)}")
        check_number(self.stamp, "stamp")
        object.__setattr__(self, "joints", finite_numbers(self.joints, "joints"))

    def state(self, names: tuple[str, ...]) -> Array:
        """Return the state of a robot's joints, shape (dof,).

        Raises:
            ParameterError: The frame does not have a joint.
        """
        missing = [name for name in names if name not in self.joints]
        if missing:
            raise ParameterError("joints", f"no {missing[0]!r}", f"the positions of {len(names)} joints in the frame")
        return np.array([self.joints[name] for name in names])

    def save(self, path: str | Path) -> None:
        """Write a frame file (``.npz``), with depths in whole millimeters of 16 bits.

        Raises:
            MissingFileError: The file cannot be written.
            ParameterError: A depth is above 65 m.
        """
        if self.depth.size and self.depth.max() > DEEPEST:
            raise ParameterError("depth", float(self.depth.max()), f"at most {DEEPEST:g} m in a file")
        about = {
            "schema": SCHEMA, "stamp": self.stamp, "joints": dict(self.joints),
            "camera": self.camera.model_dump(mode="json", by_alias=True),
        }  # fmt: skip
        arrays: dict[str, NDArray[Any]] = {"depth": np.round(self.depth * 1e3).astype(np.uint16)}
        if self.color is not None:
            arrays["color"] = self.color
        write_atomically(Path(path_text(path)), pack_archive(KEY, about, arrays, compressed=True))

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a frame file.

        Raises:
            MissingFileError: The file cannot be read.
            FileFormatError: It is no frame, or its parts do not fit together.
        """
        file = Path(path_text(path))
        about, arrays = read_archive(file, KEY, ROLE)
        check_version(about, SCHEMA, file)
        unknown = sorted({*about} - {"schema", "stamp", "joints", "camera"} | {*arrays} - {"depth", "color"})
        if unknown:
            raise FileFormatError(str(file), unknown[0], "", "expected no other parts than those of a frame")
        for name, kind in (("camera", dict), ("joints", dict)):
            if not isinstance(about.get(name), kind):
                raise FileFormatError(str(file), name, about.get(name), "expected a mapping")
        if "depth" not in arrays:
            raise FileFormatError(str(file), "depth", None, "expected a depth image")
        camera = validate(Camera, about["camera"], str(file))
        stamp = about.get("stamp", math.nan)
        try:
            return cls(camera, arrays["depth"], arrays.get("color"), stamp, about["joints"])
        except ParameterError as error:
            raise FileFormatError(str(file), error.name, error.value, f"expected {error.expected}") from error


def check_camera(given: object, name: str = "camera") -> None:
    """Check that an object is a camera.

    Raises:
        ParameterError: It is none.
    """
    if not isinstance(given, Camera):
        raise ParameterError(name, given, "a Camera")


def save_sequence(frames: Iterable[Frame], folder: str | Path) -> int:
    """Write frames as files of a folder, in order, and return how many.

    Raises:
        ApexError: A file cannot be written, or a frame is not later than the one before.
    """
    at, count, last = make_folder(folder, "folder of frames"), 0, -math.inf
    for frame in frames:
        if not isinstance(frame, Frame):
            raise ParameterError("frames", frame, "frames")
        if frame.stamp <= last:
            raise ParameterError("stamp", frame.stamp, f"a time after that of the frame before, {last:g} s")
        frame.save(at / f"{count:06d}{SUFFIX}")
        count, last = count + 1, frame.stamp
    return count


def load_frames(path: str | Path) -> list[Frame]:
    """Read a frame, or all frames of a folder in order.

    Raises:
        MissingFileError: The path cannot be read, or the folder holds no frames.
        FileFormatError: A file is no frame, or a frame is not later than the one before.
    """
    place = Path(path_text(path))
    if not place.is_dir():
        return [Frame.load(place)]
    files = sorted(place.glob(f"*{SUFFIX}"))
    if not files:
        raise MissingFileError(str(place), "folder of frames", f"expected files that end in {SUFFIX}")
    frames = [Frame.load(file) for file in files]
    for file, before, frame in zip(files[1:], frames, frames[1:], strict=False):
        if frame.stamp <= before.stamp:
            raise FileFormatError(str(file), "stamp", frame.stamp, f"expected a time after {before.stamp:g} s")
    return frames


def looks_of(frames: Sequence[Frame]) -> list[list[Frame]]:
    """Return frames by look: those of a camera at one place, with a robot at rest in one state; the last look last.

    Raises:
        ParameterError: There is no frame, something else is among them, or they have different joints.
    """
    if not frames:
        raise ParameterError("frames", 0, "one frame or more")
    looks: list[list[Frame]] = []
    for frame in frames:
        if not isinstance(frame, Frame):
            raise ParameterError("frames", frame, "frames")
        if frame.joints.keys() != frames[0].joints.keys():
            raise ParameterError("frames", sorted(frame.joints), "the same joints in all frames")
        own = next((look for look in looks if look[0].camera == frame.camera and _moved(look[0], frame) <= STILL), None)
        if own is not None:
            looks.remove(own)
        looks.append([*(own or ()), frame])
    return looks


def _moved(first: Frame, second: Frame) -> float:
    """Return the largest difference of a joint of two frames."""
    return max((abs(first.joints[name] - value) for name, value in second.joints.items()), default=0.0)


def mean_frame(frames: Sequence[Frame]) -> Frame:
    """Return the last of some frames with the mean depths of all.

    Depths further than 3 cm from a pixel's median do not count, and pixels with a depth in less than a quarter of the
    frames have none.

    Raises:
        ParameterError: There is no frame, or the camera or the robot has moved.
    """
    if not frames:
        raise ParameterError("frames", 0, "one frame or more")
    last = frames[-1]
    for frame in frames[:-1]:
        if frame.camera != last.camera:
            raise ParameterError("frames", frame.camera.name, f"frames of {last.camera.name!r} at one place")
        if frame.joints.keys() != last.joints.keys():
            raise ParameterError("frames", sorted(frame.joints), "the same joints in all frames")
        moved = _moved(frame, last)
        if moved > STILL:
            raise ParameterError("frames", f"a joint that moved by {moved:.3g}", "frames of a robot that stands still")
    if len(frames) == 1:
        return last
    depths = np.stack([frame.depth for frame in frames])
    there = depths > 0.0
    count = there.sum(axis=0)
    ordered = np.sort(np.where(there, depths, np.inf), axis=0)
    median = np.take_along_axis(ordered, np.maximum(count - 1, 0)[None] // 2, axis=0)[0]
    used = there & (np.abs(depths - np.where(np.isfinite(median), median, 0.0)) < NEAR)
    kept = used.sum(axis=0)
    mean = np.where(used, depths, 0.0).sum(axis=0) / np.maximum(kept, 1)
    return replace(last, depth=np.where(kept >= LEAST_SHARE * len(frames), mean, 0.0))
