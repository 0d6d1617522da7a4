"""A camera in the physics of MuJoCo: frames of the robot, of obstacles and of held objects as they are simulated.

Surfaces are those of the collision checker. OpenGL draws a pinhole image, in which the principal point may be anywhere;
where the camera has distortion, that image is larger, and is sampled at the rays of the pixels.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apex_ompl.collision.shapes import coal_geometry
from apex_ompl.drivers.geoms import geom_shapes
from apex_ompl.drivers.library import mujoco
from apex_ompl.drivers.mujoco import MujocoDriver
from apex_ompl.errors import MissingFileError, ParameterError
from apex_ompl.perception.camera import LARGEST_IMAGE, Camera
from apex_ompl.perception.frames import Frame, check_camera
from apex_ompl.perception.rig import RED
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.types import Array, Indices
from apex_ompl.util.display import one_line
from apex_ompl.util.validation import check_number, check_positive

BACKGROUND = 0.999  # share of the distance of the far plane from which on nothing is seen
HINT = "install libegl1 or libosmesa6, and set MUJOCO_GL to egl or osmesa"


class TwinCamera:
    """A camera that sees what a driver simulates.

    Attributes:
        driver: The driver.
        camera: The camera as it is.
        reported: The camera that frames name.
    """

    def __init__(
        self, driver: MujocoDriver, camera: Camera, *, reported: Camera | None = None,
        measured: Callable[[Array], Array] | None = None,
        others: Callable[[float], Iterable[Obstacle]] | None = None,
    ) -> None:  # fmt: skip
        """Set up the images; they are drawn by :meth:`frame`.

        Args:
            driver: The driver.
            camera: The camera as it is; its link is one of the robot's.
            reported: The camera that frames name, of the same size, by default the same one: with another pose it is
                one that was moved since its calibration.
            measured: Function from exact depths, shape (height, width) [m], 0 where there is none, to measured ones, as
                floats [m] or whole numbers [mm]; by default they are exact.
            others: Returns obstacles that are seen, in red, and not simulated, by the time [s], of primitives.

        Raises:
            ApexError: The robot has no such link, the other camera has another size, the distortion needs an image that
                is too large, or an argument is of another kind.
        """
        if not isinstance(driver, MujocoDriver):
            raise ParameterError("driver", driver, "a MujocoDriver")
        check_camera(camera)
        self.driver, self.camera, self.reported = driver, camera, camera if reported is None else reported
        check_camera(self.reported, "reported")
        if not (measured is None or callable(measured)):
            raise ParameterError("measured", measured, "a function of depths")
        if (self.reported.width, self.reported.height) != (camera.width, camera.height):
            size = f"{self.reported.width} x {self.reported.height}"
            raise ParameterError("reported", size, f"a camera of {camera.width} x {camera.height} pixels")
        if camera.link is not None:
            driver.robot.link_frame(camera.link)
        self._measured, self._others = measured, others
        self._sampling = _Sampling.of(camera)
        self._renderers: list[Any] = []

    def __repr__(self) -> str:
        """Return the camera and the robot."""
        return one_line("TwinCamera", self.camera.name, self.driver.robot.name)

    def frame(self) -> Frame:
        """Return what the camera sees now, with the time on the driver's clock and the measured positions of joints.

        Depths out of the camera's range are 0, as where nothing is seen.

        Raises:
            MissingFileError: There is no OpenGL.
            ParameterError: The driver was closed, or measured depths have another shape or unit.
        """
        driver, state = self.driver, self.driver.state()
        twin = driver.twin
        twin.move_obstacles(driver.data, state.stamp)
        mujoco().mj_kinematics(twin.model, driver.data)  # a step leaves the poses from before it
        pose = self.camera.pose if self.camera.link is None else driver.pose(self.camera.link) @ self.camera.pose
        others = () if self._others is None else tuple(self._others(state.stamp))
        drawing, measuring = self._opened()
        depth = self._drawn(measuring, pose, others)
        far = BACKGROUND * twin.model.vis.map.zfar * twin.model.stat.extent
        true = self._sampling.depths(np.where(depth < far, depth, 0.0), lambda: self._shapes(measuring))
        errors = self.camera.depth
        true[(true < errors.nearest) | (true > errors.farthest)] = 0.0
        seen = true / errors.scale
        if self._measured is not None:
            seen = self._measured(seen)
        colors = self._sampling.colors(self._drawn(drawing, pose, others))
        joints = dict(zip(driver.names, state.positions.tolist(), strict=True))
        return Frame(self.reported, seen, colors, state.stamp, joints)

    def frames(self, until: float, rate: float) -> Iterator[Frame]:
        """Let the driver go on up to a time on its clock [s], and yield a frame now and at a rate [Hz].

        Raises:
            ApexError: A number is out of range, or as :meth:`frame`.
        """
        check_positive(rate, "rate", "a positive number of frames a second")
        start = self.driver.time
        check_number(until, "until", start)
        for k in range(math.floor((until - start) * rate + 1e-9) + 1):
            self.driver.advance(start + k / rate)
            yield self.frame()
        self.driver.advance(until)

    def close(self) -> None:
        """Release what draws the images; the driver stays open."""
        for renderer in self._renderers:
            renderer.close()
        self._renderers = []

    def _opened(self) -> list[Any]:
        """Return the renderers of colors and of depths, which have one sample a pixel, in its center."""
        if not self._renderers:
            twin, (width, height) = self.driver.twin, self._sampling.size
            samples = int(twin.model.vis.quality.offsamples)
            try:
                self._renderers.append(twin.renderer(width, height))
                twin.model.vis.quality.offsamples = 0
                self._renderers.append(twin.renderer(width, height))
            except Exception as error:  # of several kinds, by what is missing
                self.close()
                why = f"{' '.join(str(error).split())}; {HINT}"
                raise MissingFileError("OpenGL", "library for pictures", why) from error
            finally:
                twin.model.vis.quality.offsamples = samples
            self._renderers[1].enable_depth_rendering()
        return self._renderers

    def _drawn(self, renderer: Any, pose: Array, others: Iterable[Obstacle]) -> NDArray[Any]:
        """Return the image of a renderer for a pose of the optical frame, shape (4, 4), with other obstacles."""
        twin, sampling = self.driver.twin, self._sampling
        renderer.update_scene(self.driver.data, twin.camera(0.0, 0.0, 1.0, (0.0, 0.0, 0.0)))
        near = twin.model.vis.map.znear * twin.model.stat.extent
        far = twin.model.vis.map.zfar * twin.model.stat.extent
        left, top = (-0.5 - np.asarray(sampling.center)) / self.camera.focal * near
        right, bottom = (np.asarray(sampling.size) - 0.5 - sampling.center) / self.camera.focal * near
        for eye in renderer.scene.camera:  # of both, whose mean is drawn
            eye.pos, eye.forward, eye.up = pose[:3, 3], pose[:3, 2], -pose[:3, 1]
            eye.frustum_center, eye.frustum_width = 0.5 * (left + right), 0.5 * (right - left)
            eye.frustum_top, eye.frustum_bottom = -top, -bottom
            eye.frustum_near, eye.frustum_far = near, far
        for one in others:
            _add(renderer.scene, one)
        return np.array(renderer.render())

    def _shapes(self, renderer: Any) -> NDArray[Any]:
        """Return the number of the geom at each pixel of the image that was drawn last, shape (height, width)."""
        renderer.enable_segmentation_rendering()
        found = np.array(renderer.render())[..., 0]
        renderer.enable_depth_rendering()
        return found


def _add(scene: Any, obstacle: Obstacle) -> None:
    """Add an obstacle to what is drawn.

    Raises:
        ParameterError: It is no primitive, or there are too many.
    """
    library = mujoco()
    for shape in geom_shapes(coal_geometry(obstacle), obstacle.pose, obstacle.name):
        if shape.vertices is not None or scene.ngeom >= scene.maxgeom:
            raise ParameterError("obstacle", obstacle.name, "a box, ball, cylinder or capsule that can be drawn")
        kind, (first, *_, last) = getattr(library.mjtGeom, f"mjGEOM_{shape.kind}"), (*shape.size, shape.size[-1])
        size = np.array(shape.size if len(shape.size) == 3 else (first, first, last))  # radius twice, then half length
        turn = np.ascontiguousarray(shape.pose[:3, :3]).ravel()
        rgba = np.array(RED, np.float32)
        library.mjv_initGeom(scene.geoms[scene.ngeom], kind, size, shape.pose[:3, 3].copy(), turn, rgba)
        scene.ngeom += 1


@dataclass(frozen=True, eq=False)
class _Sampling:
    """Where the pixels of a camera are in a pinhole image with its focal lengths.

    Attributes:
        size: Width and height of the pinhole image [pixels].
        center: Its principal point [pixels].
        corner: The upper left neighbor of each pixel, rows and columns, shape (2, height, width); None where the images
            are the same.
        share: Distance from there, down and to the right, shape (2, height, width).
    """

    size: tuple[int, int]
    center: tuple[float, float]
    corner: Indices | None = None
    share: Array | None = None

    @classmethod
    def of(cls, camera: Camera) -> _Sampling:
        """Return the sampling of a camera.

        Raises:
            ParameterError: Its distortion needs an image that is too large.
        """
        if not any(camera.distortion):
            return cls((camera.width, camera.height), camera.center)
        at = camera.grid * camera.focal
        first = np.floor(at.min(axis=(0, 1))) - 1.0
        width, height = (np.ceil(at.max(axis=(0, 1))) - first + 2.0).astype(int).tolist()
        if max(width, height) > LARGEST_IMAGE:
            what = f"one that needs images of {LARGEST_IMAGE} pixels at most before distortion"
            raise ParameterError("distortion", f"one that needs {width} x {height}", what)
        place = np.moveaxis(at - first, -1, 0)[::-1]
        corner = np.floor(place).astype(np.intp)
        return cls((width, height), (-float(first[0]), -float(first[1])), corner, place - corner)

    def _neighbors(self, image: NDArray[Any]) -> tuple[NDArray[Any], Array]:
        """Return the four neighbors of each pixel and their weights, shapes (4, height, width, ...) and (4, ...)."""
        assert self.corner is not None and self.share is not None
        (row, column), (down, right) = self.corner, self.share
        near = np.stack([image[row + i, column + j] for i in (0, 1) for j in (0, 1)])
        across, along = (1.0 - down, down), (1.0 - right, right)
        return near, np.stack([across[i] * along[j] for i in (0, 1) for j in (0, 1)])

    def colors(self, image: NDArray[Any]) -> NDArray[np.uint8]:
        """Return colors, shape (height, width, 3)."""
        if self.corner is None:
            return np.asarray(image, np.uint8)
        near, weights = self._neighbors(image)
        mixed: NDArray[np.uint8] = np.round((near * weights[..., None]).sum(axis=0)).astype(np.uint8)
        return mixed

    def depths(self, image: Array, shapes: Callable[[], NDArray[Any]]) -> Array:
        """Return depths, shape (height, width) [m].

        Those of one shape are interpolated by 1/z, which is linear on planes; between two shapes the next pixel counts.

        Args:
            image: Depths of the pinhole image [m].
            shapes: Returns the numbers of the shapes in it.
        """
        if self.corner is None:
            return np.asarray(image, float)
        near, weights = self._neighbors(np.asarray(image, float))
        parts, _ = self._neighbors(shapes())
        nearest = np.take_along_axis(near, weights.argmax(axis=0)[None], axis=0)[0]
        same = (parts == parts[0]).all(axis=0) & (near > 0.0).all(axis=0)
        inverse = (weights / np.where(same, near, 1.0)).sum(axis=0)
        return np.asarray(np.where(same, 1.0 / inverse, nearest))
