"""Cameras of color and depth: pinhole with distortion, placed in the world or on a link, and their errors.

The camera's optical frame has x to the right, y down and z forward. The center of the first pixel is at (0, 0), as in
OpenCV and in ``sensor_msgs/CameraInfo``; distortion is the model ``plumb_bob`` of both.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Annotated, Literal, Self

import numpy as np
import pinocchio as pin
import yaml
from numpy.typing import ArrayLike
from pydantic import Field, PositiveFloat, PositiveInt, model_validator

from apex_ompl.errors import ParameterError
from apex_ompl.kernel.products import product
from apex_ompl.robot.model import Robot
from apex_ompl.scene.bodies import Name, Quaternion, Vector, pose_matrix
from apex_ompl.scene.points import depth_in_meters
from apex_ompl.types import Array
from apex_ompl.util.files import path_text, write_atomically
from apex_ompl.util.schema import StrictModel, check_version, read_yaml, validate
from apex_ompl.util.validation import check_array, check_number, check_states, finite_array, number_array, rigid_pose

SCHEMA = "apex-ompl/camera/1"
ROLE = "camera file"
LARGEST_IMAGE = 8192  # width and height [pixels]
UNDISTORTIONS = 12  # steps of Newton's method at most
PRECISION = 1e-10  # of points of the plane z = 1 m [m]
UNDONE = 0.01  # by which pixels may differ after distortion was undone and done again [pixels]
DEEPEST = 100.0  # [m]

Side = Annotated[PositiveInt, Field(le=LARGEST_IMAGE)]
Coefficient = Annotated[float, Field(ge=-10.0, le=10.0)]
Distortion = tuple[Coefficient, Coefficient, Coefficient, Coefficient, Coefficient]
Share = Annotated[float, Field(gt=0.5, lt=2.0)]
Spread = Annotated[float, Field(ge=0.0, le=1.0)]


class DepthErrors(StrictModel):
    """Range and errors of measured depths.

    Attributes:
        nearest: Smallest depth that is measured [m].
        farthest: Largest depth that is used [m].
        scale: Factor by which measured depths become true ones.
        scale_spread: Standard deviation of that factor.
        noise: Standard deviation of a depth z is ``noise`` z^2 [1/m]: for a stereo camera the standard deviation of
            the disparity over focal length and baseline.
        correlation: Width of the patches of pixels that share most of their noise [pixels].
    """

    nearest: PositiveFloat = 0.2
    farthest: Annotated[PositiveFloat, Field(le=DEEPEST)] = 4.0
    scale: Share = 1.0
    scale_spread: Spread = 0.0
    noise: Spread = 0.0038
    correlation: Annotated[PositiveInt, Field(le=64)] = 4

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        if not self.nearest < self.farthest:
            raise ValueError("expected a nearest depth below the farthest")
        return self


class Camera(StrictModel):
    """A camera whose depth image is aligned to its color image.

    Attributes:
        name: Name of the camera.
        width: Columns of images [pixels].
        height: Rows of images [pixels].
        focal: Focal lengths fx and fy [pixels].
        center: Principal point cx and cy [pixels].
        distortion: k1, k2, p1, p2 and k3 of the model ``plumb_bob``.
        link: Link that carries the camera, by default none: it stands still in the world.
        position: Position of the optical frame in the frame of the link, or in the world [m].
        orientation: Its orientation there, as a quaternion xyzw.
        position_spread: Standard deviation of the position in each direction, as calibration knows it [m].
        angle_spread: Standard deviation of the orientation about each axis [rad].
        depth: Range and errors of measured depths.
    """

    schema_id: Literal["apex-ompl/camera/1"] = Field(default="apex-ompl/camera/1", alias="schema")
    name: Name = "camera"
    width: Side
    height: Side
    focal: tuple[PositiveFloat, PositiveFloat]
    center: tuple[float, float]
    distortion: Distortion = (0.0, 0.0, 0.0, 0.0, 0.0)
    link: Name | None = None
    position: Vector = (0.0, 0.0, 0.0)
    orientation: Quaternion = (0.0, 0.0, 0.0, 1.0)
    position_spread: Spread = 0.002
    angle_spread: Spread = 0.0035
    depth: DepthErrors = DepthErrors()

    @model_validator(mode="after")
    def _sees_its_image(self) -> Self:
        if not (-self.width < self.center[0] < 2 * self.width and -self.height < self.center[1] < 2 * self.height):
            raise ValueError("expected a principal point, in pixels, at or near the image")
        if any(self.distortion):
            columns, rows = np.meshgrid(np.linspace(0.0, self.width - 1.0, 9), np.linspace(0.0, self.height - 1.0, 9))
            pixels = np.stack([columns, rows], axis=-1)
            flat = self.rays(pixels)
            again = self.project(np.concatenate([flat, np.ones((9, 9, 1))], axis=-1))
            slopes = np.linalg.det(_slopes(self.distortion, flat)[1])
            if not (np.abs(again - pixels) < UNDONE).all() or not (slopes > 0.0).all():
                raise ValueError("expected a distortion that can be undone in the whole image")
        return self

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a camera file (YAML, ``schema: apex-ompl/camera/1``).

        Raises:
            MissingFileError: The file cannot be read.
            FileFormatError: It is not YAML, of another version, or does not follow the schema.
        """
        file = Path(path_text(path))
        data = read_yaml(file, ROLE)
        check_version(data, SCHEMA, file)
        return validate(cls, data, str(file))

    def save(self, path: str | Path) -> None:
        """Write a camera file.

        Raises:
            MissingFileError: The file cannot be written.
        """
        data = {"schema": SCHEMA, **self.model_dump(mode="json", exclude={"schema_id"}, exclude_defaults=True)}
        text = yaml.safe_dump(data, sort_keys=False, default_flow_style=None)
        write_atomically(Path(path_text(path)), text.encode())

    @property
    def pose(self) -> Array:
        """Pose of the optical frame in the frame of the link, or in the world, shape (4, 4) [m]."""
        return pose_matrix(self.position, self.orientation)

    def placed(self, pose: ArrayLike) -> Self:
        """Return the camera with another pose of its optical frame, shape (4, 4) [m].

        Raises:
            ParameterError: The pose is not rigid.
        """
        return self.model_copy(update=placement(rigid_pose(pose, "pose")))

    def pose_at(self, robot: Robot, state: ArrayLike) -> Array:
        """Return the pose of the optical frame in the world in a state, shape (dof,); of shape (4, 4) [m].

        Raises:
            ApexError: The state has another shape, or the robot has no such link.
        """
        q = finite_array(state, "state")
        check_states(q[None] if q.ndim == 1 else q, len(robot.joint_names), "state")
        return self.pose if self.link is None else robot.link_pose(q, self.link) @ self.pose

    def project(self, points: ArrayLike) -> Array:
        """Return the pixels (column, row) at which points of the optical frame are seen.

        Args:
            points: Shape (..., 3) [m].

        Returns:
            Shape (..., 2) [pixels]; NaN for points that are not in front of the camera, or so far aside that the
            distortion turns back.

        Raises:
            ParameterError: The points have another shape.
        """
        given = _last(points, 3, "points")
        with np.errstate(divide="ignore", invalid="ignore"):
            flat = np.where(given[..., 2:] > 0.0, given[..., :2] / given[..., 2:], np.nan)
            flat[(flat * flat).sum(axis=-1) > _reach(self.distortion)] = np.nan
        return np.asarray(_slopes(self.distortion, flat)[0] * self.focal + self.center)

    def projection_jacobian(self, points: ArrayLike) -> Array:
        """Return the derivatives of :meth:`project` by the points, shape (..., 2, 3) [pixels/m].

        Args:
            points: Points in front of the camera, shape (..., 3) [m].

        Raises:
            ParameterError: The points have another shape.
        """
        given = _last(points, 3, "points")
        z = given[..., 2:]
        x, flat = given[..., :2] / z, _slopes(self.distortion, given[..., :2] / z)[1]
        flat = flat * np.asarray(self.focal)[:, None]
        depth = -(flat * x[..., None, :]).sum(axis=-1, keepdims=True)
        return np.asarray(np.concatenate([flat, depth], axis=-1) / z[..., None])

    def rays(self, pixels: ArrayLike) -> Array:
        """Return the points of the plane z = 1 m of the optical frame that are seen at pixels.

        Args:
            pixels: Columns and rows, shape (..., 2) [pixels].

        Returns:
            Shape (..., 2) [m].

        Raises:
            ParameterError: The pixels have another shape.
        """
        seen = np.asarray((_last(pixels, 2, "pixels") - self.center) / self.focal)
        if not any(self.distortion):
            return seen
        flat = seen.copy()
        for _ in range(UNDISTORTIONS):
            found, slopes = _slopes(self.distortion, flat)
            step = _solved(slopes, seen - found)
            flat += step
            if not np.nanmax(np.abs(step), initial=0.0) > PRECISION:
                break
        return flat

    @property
    def grid(self) -> Array:
        """Rays of all pixels, shape (height, width, 2) [m]; not writable."""
        return _grid(self.width, self.height, self.focal, self.center, self.distortion)

    def points(self, depth: ArrayLike) -> Array:
        """Return the points of the optical frame that a depth image saw.

        Args:
            depth: Depths, shape (height, width), as floats [m] or whole numbers [mm]; 0 or NaN where there is none.

        Returns:
            Shape (height, width, 3) [m]; NaN where there is no depth, or one out of range.

        Raises:
            ParameterError: The image has another shape, or is of another unit.
        """
        image = depth_in_meters(depth)
        check_array(image, (self.height, self.width), "depth")
        true = image * self.depth.scale
        with np.errstate(invalid="ignore"):
            kept = (true >= self.depth.nearest) & (true <= self.depth.farthest)
        z = np.where(kept, true, np.nan)
        return np.concatenate([self.grid * z[..., None], z[..., None]], axis=-1)


def _slopes(distortion: Distortion, flat: Array) -> tuple[Array, Array]:
    """Return where points of the plane z = 1 m appear there, and the derivatives, shapes (..., 2) and (..., 2, 2)."""
    k1, k2, p1, p2, k3 = distortion
    x, y = flat[..., 0], flat[..., 1]
    squared = x * x + y * y
    radial = 1.0 + squared * (k1 + squared * (k2 + squared * k3))
    slope = 2.0 * (k1 + squared * (2.0 * k2 + 3.0 * squared * k3))  # of the radial factor by the square, twice
    across = slope * x * y + 2.0 * (p1 * x + p2 * y)
    found, slopes = np.empty(flat.shape), np.empty((*flat.shape, 2))
    found[..., 0] = x * radial + 2.0 * p1 * x * y + p2 * (squared + 2.0 * x * x)
    found[..., 1] = y * radial + p1 * (squared + 2.0 * y * y) + 2.0 * p2 * x * y
    slopes[..., 0, 0] = radial + slope * x * x + 2.0 * p1 * y + 6.0 * p2 * x
    slopes[..., 0, 1] = slopes[..., 1, 0] = across
    slopes[..., 1, 1] = radial + slope * y * y + 6.0 * p1 * y + 2.0 * p2 * x
    return found, slopes


@lru_cache(maxsize=8)
def _reach(distortion: Distortion) -> float:
    """Return the squared distance from the axis, in the plane z = 1 m, from which on radial distortion turns back."""
    k1, k2, _, _, k3 = distortion
    roots = np.roots([7.0 * k3, 5.0 * k2, 3.0 * k1, 1.0])  # of the derivative of r (1 + k1 r^2 + k2 r^4 + k3 r^6)
    real = roots[np.abs(roots.imag) < 1e-9].real
    return float(real[real > 0.0].min(initial=np.inf))


def _solved(matrices: Array, vectors: Array) -> Array:
    """Return the solutions of symmetric systems of two equations, shape (..., 2)."""
    a, b, c = matrices[..., 0, 0], matrices[..., 0, 1], matrices[..., 1, 1]
    x, y = vectors[..., 0], vectors[..., 1]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.stack([c * x - b * y, a * y - b * x], axis=-1) / (a * c - b * b)[..., None]


def _last(given: ArrayLike, count: int, name: str) -> Array:
    """Return numbers as an array whose last axis has a length.

    Raises:
        ParameterError: They are none, or of another shape.
    """
    found = number_array(given, name)
    if found.ndim == 0 or found.shape[-1] != count:
        raise ParameterError(name, found.shape, f"shape (..., {count})")
    return found


@lru_cache(maxsize=8)
def _grid(
    width: int, height: int, focal: tuple[float, float], center: tuple[float, float], distortion: Distortion
) -> Array:
    """Return the rays of all pixels of a camera, shape (height, width, 2) [m]."""
    rows, columns = np.mgrid[0:height, 0:width]
    camera = Camera(width=width, height=height, focal=focal, center=center, distortion=distortion)
    found = camera.rays(np.stack([columns, rows], axis=-1))
    found.setflags(write=False)
    return found


def placement(pose: Array) -> dict[str, tuple[float, ...]]:
    """Return position and orientation (xyzw) of a pose, shape (4, 4), as files have them."""
    quaternion = pin.Quaternion(pose[:3, :3]).normalized().coeffs()
    return {"position": tuple(map(float, pose[:3, 3])), "orientation": tuple(map(float, quaternion))}


def look_at(eye: ArrayLike, target: ArrayLike, roll: float = 0.0) -> Array:
    """Return the pose of a camera at a point that looks at another, shape (4, 4) [m].

    Args:
        eye: Position of the camera, shape (3,) [m].
        target: The point, shape (3,) [m].
        roll: Turn about the line of sight from upright, clockwise in the image [rad].

    Raises:
        ParameterError: The points are the same, or numbers are not finite.
    """
    at, seen = finite_array(eye, "eye"), finite_array(target, "target")
    check_array(at, (3,), "eye")
    check_array(seen, (3,), "target")
    check_number(roll, "roll")
    forward = seen - at
    distance = float(np.linalg.norm(forward))
    if distance < 1e-6:
        raise ParameterError("target", seen.tolist(), "a point other than the camera's")
    z = forward / distance
    x = np.cross(z, (0.0, 0.0, 1.0)) if abs(z[2]) < 1.0 - 1e-9 else np.array([0.0, -1.0, 0.0])
    x /= np.linalg.norm(x)
    turn = np.array([[np.cos(roll), -np.sin(roll), 0.0], [np.sin(roll), np.cos(roll), 0.0], [0.0, 0.0, 1.0]])
    pose = np.eye(4)
    pose[:3, :3] = product(np.stack([x, np.cross(z, x), z], axis=1), turn)
    pose[:3, 3] = at
    return pose
