"""Depth images, labels and colors of surfaces as a camera sees them, by two renderers, and the noise of depth cameras.

``ZBuffer`` is compiled code of the kernel, ``Mujoco`` draws by MuJoCo and OpenGL (the extra ``twin``); they share
nothing but the triangles of meshes. Both draw the camera as a pinhole; its distortion is applied to the images.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple, Protocol

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from apex_ompl.collision.shapes import cloud_of
from apex_ompl.drivers.geoms import geom_shapes
from apex_ompl.drivers.library import mujoco
from apex_ompl.kernel.perception import draw_triangles
from apex_ompl.perception.camera import Camera
from apex_ompl.perception.surfaces import Surface, joined
from apex_ompl.types import Array, Indices
from apex_ompl.util.validation import check_number

FARTHEST = 20.0  # that MuJoCo draws [m]
NEAREST = 0.05
SIDES = 64  # of MuJoCo's round bodies; 28 are 1 mm off
JUMP = 0.03  # difference of neighboring depths at an edge [m]
MISSING, FLYING = 0.5, 0.2  # shares of pixels at edges without depth, and with one between both sides
COMMON = 0.8  # part of the noise that neighboring pixels share, as a standard deviation
QUANTUM = 0.001  # steps of measured depths [m]


class Part(NamedTuple):
    """A surface in the world with a label.

    Attributes:
        surface: The surface, in the world.
        label: Its number, from 1 on.
        color: Red, green and blue, 0 to 1.
        solid: The solid whose surface it is, or None.
        pose: Pose of the solid in the world, shape (4, 4) [m].
    """

    surface: Surface
    label: int
    color: tuple[float, float, float] = (0.6, 0.6, 0.6)
    solid: coal.CollisionGeometry | None = None
    pose: Array = np.eye(4)


class View(NamedTuple):
    """What a camera sees without noise.

    Attributes:
        depth: Depths, 0 where there is nothing, shape (height, width) [m].
        labels: Labels of the parts, 0 for none, of that shape.
        normals: Unit normals of the surfaces in the optical frame, shape (height, width, 3); zeros for none.
    """

    depth: Array
    labels: Indices
    normals: Array


class Renderer(Protocol):
    """Draws parts as a camera at a pose, shape (4, 4), sees them."""

    def draw(self, parts: Sequence[Part], camera: Camera, pose: Array) -> View:
        """Return the view."""


def lens_of(camera: Camera) -> Array:
    """Return focal lengths and principal point, shape (4,) [pixels]."""
    return np.array([*camera.focal, *camera.center], float)


def undistorted(camera: Camera) -> Indices | None:
    """Return for each pixel of a pinhole camera the flat pixel of the distorted image that sees its ray, or None.

    Shape (height, width); -1 where the image does not see it. None where there is no distortion.
    """
    if not any(camera.distortion):
        return None
    return _undistorted(camera.width, camera.height, camera.focal, camera.center, camera.distortion)


@lru_cache(maxsize=4)
def _undistorted(width: int, height: int, focal: Any, center: Any, distortion: Any) -> Indices:
    camera = Camera(width=width, height=height, focal=focal, center=center, distortion=distortion)
    rows, columns = np.mgrid[0:height, 0:width]
    lens = lens_of(camera)
    rays = np.stack([(columns - lens[2]) / lens[0], (rows - lens[3]) / lens[1], np.ones(rows.shape)], axis=-1)
    return _flat(camera.project(rays), camera)


def _distorting(camera: Camera) -> Indices:
    """Return for each pixel of the distorted image the flat pixel of the pinhole that sees its ray, or -1."""
    return _flat(camera.grid * camera.focal + camera.center, camera)


def _flat(pixels: Array, camera: Camera) -> Indices:
    nearest = np.round(pixels).astype(np.int64)
    inside = ((nearest >= 0) & (nearest < (camera.width, camera.height))).all(axis=-1)
    return np.where(inside, nearest[..., 1] * camera.width + nearest[..., 0], -1)


def resampled(image: NDArray[Any], flat: Indices | None) -> NDArray[Any]:
    """Return an image with the pixels at given places, 0 at -1; the image itself for None."""
    if flat is None:
        return image
    values = image.reshape(-1, *image.shape[2:])[flat]
    values[flat < 0] = 0
    return np.ascontiguousarray(values)


class ZBuffer:
    """The kernel's own renderer."""

    def draw(self, parts: Sequence[Part], camera: Camera, pose: Array) -> View:
        """Return what a camera at a pose sees."""
        together = joined([part.surface for part in parts])
        labels = np.repeat([part.label for part in parts], [len(part.surface.faces) for part in parts])
        seen = Surface(together.vertices @ pose[:3, :3] - pose[:3, 3] @ pose[:3, :3], together.faces)
        depth, index = draw_triangles(*seen, lens_of(camera), camera.height, camera.width)
        normals = seen.face_normals()
        there = index >= 0
        view = View(
            np.where(there, depth, 0.0),
            np.where(there, labels[index], 0),
            np.where(there[..., None], normals[index], 0.0),
        )
        return _seen_through(camera, view)


class Mujoco:
    """MuJoCo's renderer, without a display; needs the extra ``twin``.

    Round bodies are MuJoCo's own, with 64 sides; of other shapes it draws the triangles.
    """

    def __init__(self) -> None:
        """Load MuJoCo.

        Raises:
            MissingFileError: The extra ``twin`` is not installed.
        """
        self._mujoco: Any = mujoco()

    def draw(self, parts: Sequence[Part], camera: Camera, pose: Array) -> View:
        """Return what a camera at a pose sees, with normals of differences of depth."""
        return self._drawn(parts, camera, pose)[0]

    def draw_lit(
        self, parts: Sequence[Part], camera: Camera, pose: Array, dress: Callable[[Any, Any], None]
    ) -> tuple[View, NDArray[np.uint8]]:  # fmt: skip
        """Return what a camera at a pose sees, and its color image with MuJoCo's lights, shadows and textures.

        Args:
            parts: The parts, each of which is a geom; their own colors are not used.
            camera: The camera.
            pose: Pose of its optical frame, shape (4, 4) [m].
            dress: Gets MuJoCo and the ``MjSpec``, to add lights and materials.
        """
        view, color = self._drawn(parts, camera, pose, dress)
        return view, resampled(color, _distorting(camera) if any(camera.distortion) else None)

    def _drawn(
        self, parts: Sequence[Part], camera: Camera, pose: Array, dress: Callable[[Any, Any], None] | None = None
    ) -> tuple[View, NDArray[np.uint8]]:  # fmt: skip
        library = self._mujoco
        spec = library.MjSpec()
        spec.stat.extent = 1.0  # in which the next two are measured
        spec.visual.map.znear, spec.visual.map.zfar = NEAREST, FARTHEST
        quality = spec.visual.quality
        quality.numslices, quality.numstacks, quality.offsamples = SIDES, SIDES, 0
        getattr(spec.visual, "global").offwidth = camera.width
        getattr(spec.visual, "global").offheight = camera.height
        for k, part in enumerate(parts):
            self._add(spec, part, k)
        self._place(spec, camera, pose)
        if dress is not None:
            dress(library, spec)
        model = spec.compile()
        data = library.MjData(model)
        library.mj_forward(model, data)
        with library.Renderer(model, camera.height, camera.width, len(parts) + 100) as renderer:
            renderer.enable_depth_rendering()
            renderer.update_scene(data, "camera")
            depth = np.asarray(renderer.render(), float)
            renderer.disable_depth_rendering()
            renderer.enable_segmentation_rendering()
            renderer.update_scene(data, "camera")
            number = renderer.render()[..., 0]
            color = np.zeros((*depth.shape, 3), np.uint8)
            if dress is not None:
                renderer.disable_segmentation_rendering()
                renderer.update_scene(data, "camera")
                color = np.array(renderer.render())
        there = number >= 0
        depth = np.where(there, depth, 0.0)
        labels = np.where(there, np.array([part.label for part in parts])[number], 0)
        return _seen_through(camera, View(depth, labels, depth_normals(depth, camera))), color

    def _add(self, spec: Any, part: Part, k: int) -> None:
        """Add a part as one geom."""
        geom = spec.worldbody.add_geom(type=self._mujoco.mjtGeom.mjGEOM_MESH)
        if part.solid is not None and round_or_box(part.solid):
            shape = next(geom_shapes(part.solid, part.pose, str(k)))
            geom.type = getattr(self._mujoco.mjtGeom, f"mjGEOM_{shape.kind}")
            geom.size[: len(shape.size)] = shape.size
            geom.pos, geom.quat = part.pose[:3, 3], pin.Quaternion(part.pose[:3, :3]).coeffs()[[3, 0, 1, 2]]
            return
        geom.meshname = str(k)
        vertices, faces = part.surface
        spec.add_mesh(
            name=str(k),
            uservert=vertices.ravel(),
            userface=faces.ravel(),
            inertia=self._mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
        )

    def _place(self, spec: Any, camera: Camera, pose: Array) -> None:
        """Add the camera; MuJoCo's looks along -z, with y up."""
        own = spec.worldbody.add_camera(name="camera", pos=pose[:3, 3])
        flipped = pose[:3, :3] * (1.0, -1.0, -1.0)
        own.quat = pin.Quaternion(flipped).coeffs()[[3, 0, 1, 2]]
        own.resolution = [camera.width, camera.height]
        own.sensor_size = [camera.width, camera.height]
        own.focal_pixel = camera.focal
        shift = np.array(camera.center) - (np.array([camera.width, camera.height]) - 1.0) / 2.0
        own.principal_pixel = [-shift[0], -shift[1]]  # of the image's center from the principal point


def round_or_box(solid: coal.CollisionGeometry) -> bool:
    """Return whether a solid is a box, ball, cylinder or capsule."""
    return isinstance(solid, coal.Box | coal.Sphere | coal.Cylinder | coal.Capsule) and cloud_of(solid) is None


def depth_normals(depth: Array, camera: Camera) -> Array:
    """Return unit normals of a depth image by differences, shape (height, width, 3); zeros where there is no depth."""
    rows, columns = np.mgrid[0 : camera.height, 0 : camera.width]
    lens = lens_of(camera)
    points = np.stack([(columns - lens[2]) / lens[0] * depth, (rows - lens[3]) / lens[1] * depth, depth], axis=-1)
    normals = np.cross(np.gradient(points, axis=0), np.gradient(points, axis=1))
    lengths = np.linalg.norm(normals, axis=-1, keepdims=True)
    return np.asarray(np.where((lengths > 0.0) & (depth > 0.0)[..., None], normals / np.maximum(lengths, 1e-12), 0.0))


def _seen_through(camera: Camera, view: View) -> View:
    """Return the view of a pinhole as a camera with distortion has it."""
    if not any(camera.distortion):
        return view
    flat = _distorting(camera)
    return View(*(resampled(image, flat) for image in view))


@dataclass(frozen=True)
class DepthSensor:
    """Noise of a stereo camera's depths.

    Depths have correlated errors that grow with z^2, are missing or between both sides at edges, missing where the
    second imager does not see the surface, and whole millimeters.

    Attributes:
        baseline: Distance of the imagers [m].
        gain: Factor of the noise that the camera's file names.
        bias: Relative error of all depths.
        holes: Probability of a patch without depth on each of the labels that are named.
    """

    baseline: float = 0.05
    gain: float = 1.0
    bias: float = 0.0
    holes: float = 0.2

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ParameterError: A number is out of its range.
        """
        for name in ("baseline", "gain"):
            check_number(getattr(self, name), name, 0.0)
        check_number(self.bias, "bias", -0.5, 0.5)
        check_number(self.holes, "holes", 0.0, 1.0)

    def measure(
        self, view: View, camera: Camera, rng: np.random.Generator, labels: Sequence[int] = (), frames: int = 1
    ) -> list[Array]:  # fmt: skip
        """Return measured depths of some frames, each of shape (height, width) [m], 0 where there is none.

        Args:
            view: What the camera sees.
            camera: The camera.
            rng: Source of the noise.
            labels: Labels of surfaces that may have a patch without depth, the same in all frames.
            frames: Number of frames.
        """
        depth, errors = view.depth, camera.depth
        width = errors.correlation
        low, high = _least_and_largest(depth)
        edge = high - low > JUMP
        hidden = (depth <= 0.0) | self._hidden(depth, camera)
        for label in labels:
            hidden |= self._patch(view.labels == label, rng)
        found = []
        for _ in range(frames):
            own = rng.standard_normal(depth.shape)
            blocks = rng.standard_normal(tuple(-(-n // width) for n in depth.shape))
            common = blocks.repeat(width, axis=0).repeat(width, axis=1)[: depth.shape[0], : depth.shape[1]]
            noise = np.sqrt(1.0 - COMMON**2) * own + COMMON * common
            luck = rng.random(depth.shape)
            flying = edge & (luck >= MISSING) & (luck < MISSING + FLYING)
            seen = np.where(flying, low + (high - low) * (luck - MISSING) / FLYING, depth)
            seen = seen + self.gain * errors.noise * seen**2 * noise
            seen = np.round(seen * (1.0 + self.bias) / QUANTUM) * QUANTUM
            gone = hidden | (edge & (luck < MISSING)) | (seen < errors.nearest) | (seen > errors.farthest)
            found.append(np.where(gone, 0.0, seen))
        return found

    def _hidden(self, depth: Array, camera: Camera) -> NDArray[np.bool_]:
        """Return the pixels whose surface the second imager does not see."""
        height, width = depth.shape
        there = depth > 0.0
        disparity = np.where(there, camera.focal[0] * self.baseline / np.where(there, depth, 1.0), 0.0)
        column = (np.arange(width) - disparity).astype(np.int64) + width
        place = np.where(there, column.clip(0), 0) + 2 * width * np.arange(height)[:, None]
        best = np.zeros(2 * width * height)
        np.maximum.at(best, place[there], disparity[there])
        return np.asarray(there & (best[place] > disparity + 1.0))

    def _patch(self, where: NDArray[np.bool_], rng: np.random.Generator) -> NDArray[np.bool_]:
        rows, columns = np.nonzero(where)
        gone = np.zeros_like(where)
        if rng.random() < self.holes and len(rows):
            k, radius = rng.integers(len(rows)), rng.uniform(5.0, 20.0)
            near = (rows - rows[k]) ** 2 + (columns - columns[k]) ** 2 < radius**2
            gone[rows[near], columns[near]] = True
        return gone


def _least_and_largest(depth: Array) -> tuple[Array, Array]:
    """Return the least and the largest depth that is not 0 among the 3 x 3 neighbors of each pixel."""
    padded = np.pad(depth, 1)
    low, high = np.full(depth.shape, np.inf), np.zeros(depth.shape)
    for i in range(3):
        for j in range(3):
            near = padded[i : i + depth.shape[0], j : j + depth.shape[1]]
            low, high = np.minimum(low, np.where(near > 0.0, near, np.inf)), np.maximum(high, near)
    return np.where(np.isfinite(low), low, 0.0), high


@dataclass(frozen=True)
class Light:
    """A distant light.

    Attributes:
        direction: From the scene to the light in the optical frame, shape (3,).
        ambient: Share of light from all sides.
        warmth: Factors of red, green and blue.
        gain: Gain of the camera.
    """

    direction: tuple[float, float, float]
    ambient: float
    warmth: tuple[float, float, float]
    gain: float

    @classmethod
    def random(cls, rng: np.random.Generator) -> Light:
        """Return a random light from above or behind the camera."""
        x, y, z = rng.uniform((-1.0, -1.0, -1.0), (1.0, 0.2, -0.2))
        warmth = rng.uniform(0.85, 1.15, 3)
        return cls((x, y, z), rng.uniform(0.25, 0.6), (warmth[0], warmth[1], warmth[2]), rng.uniform(0.7, 1.2))


def lit(view: View, parts: Sequence[Part], light: Light) -> Array:
    """Return the colors of a view without noise: diffuse surfaces (Lambert), a distant light.

    Shape (height, width, 3); 1 is white, and more is possible.
    """
    table = np.zeros((1 + max((part.label for part in parts), default=0), 3))
    table[0] = 0.1
    for part in parts:
        table[part.label] = part.color
    direction = np.array(light.direction) / np.linalg.norm(light.direction)
    shade = light.ambient + (1.0 - light.ambient) * np.maximum(view.normals @ direction, 0.0)
    return np.asarray(table[view.labels] * shade[..., None] * light.warmth * light.gain)


def image_of(colors: Array) -> NDArray[np.uint8]:
    """Return an image of colors, shape (height, width, 3), of which 1 is white."""
    return np.asarray((255.0 * colors.clip(0.0, 1.0)).round().astype(np.uint8))


def colors(view: View, parts: Sequence[Part], light: Light, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Return the color image of a view with noise of the imager, shape (height, width, 3); see :func:`lit`."""
    image = lit(view, parts, light)
    return image_of(image + rng.normal(0.0, 0.01, image.shape))


def seen_share(label: int, view: View, alone: View) -> float:
    """Return the share of a body's outline that is seen, from its view among other bodies and from that of it alone."""
    whole = np.count_nonzero(alone.depth > 0.0)
    return float(np.count_nonzero(view.labels == label) / whole) if whole else 0.0
