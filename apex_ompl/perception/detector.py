"""Objects of known kinds in a frame, found by a small network, wherever they are.

The frame is resampled to a pinhole of a standard focal length. The network sees colors and depths; each cell of 4 x 4
pixels that shows an object votes for the center of the object relative to the cell's measured point, for its axis, its
size and its kind. Votes are in the frame of the cell's ray, so that they do not depend on where in the image the
object is. Votes that agree are an object. :class:`apex_ompl.perception.detection_fit.DetectionFit`
fits surfaces to depth from there.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple, Self

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from apex_ompl.errors import FileFormatError, MissingFileError, ParameterError
from apex_ompl.model.checkpoint import CONFIG, WEIGHTS, check_shapes, read_weights
from apex_ompl.perception.camera import Camera
from apex_ompl.perception.frames import Frame
from apex_ompl.types import Array, Indices
from apex_ompl.util.files import is_file, path_text
from apex_ompl.util.schema import StrictModel, read_record
from apex_ompl.util.validation import check_number, check_positive, rigid_pose

if TYPE_CHECKING:
    from apex_ompl.perception.detector_network import DetectorNetwork

SCHEMA = "apex-ompl/detector/1"
ROLE = "file of a detector"
SHIPPED = Path(__file__).parent / "checkpoints" / "detector"
FOCAL = 232.5  # of the images that the network sees [pixels]
CELL = 4  # side of a cell [pixels]
MULTIPLE = 16  # of which width and height are
KINDS = ("box", "can", "cup", "ball", "block", "peg")
SIZES = ((0.035, 0.07), (0.033, 0.06), (0.04, 0.065), (0.032, 0.032), (0.04, 0.035), (0.016, 0.09))
"""Nominal half edge or radius, and half length, of each kind [m]."""
OPEN = ("cup", "block")  # whose two ends differ
UNIT, SIZE_UNIT = 0.1, 0.1  # of the network's places [m] and logarithms of sizes
UPPERMOST = 800  # votes that are looked at
KNOWN_TURN = np.pi / np.sqrt(3.0)  # standard deviation of an angle of which nothing is known [rad]


class Cells(NamedTuple):
    """What cells of an image measure.

    Attributes:
        depth: Median of their depths, 0 where there is none, shape (h, w) [m].
        pixel: Which of the 16 pixels has it, shape (h, w).
    """

    depth: Array
    pixel: Indices


def cells_of(depth: Array) -> Cells:
    """Return the cells of a depth image, shape (height, width) [m], whose sides are multiples of 4."""
    blocks = _blocks(depth)
    order = np.argsort(np.where(blocks > 0.0, blocks, np.inf), axis=-1, kind="stable")
    count = (blocks > 0.0).sum(axis=-1)
    pixel = np.take_along_axis(order, np.maximum(count - 1, 0)[..., None] // 2, axis=-1)
    return Cells(np.take_along_axis(blocks, pixel, axis=-1)[..., 0], pixel[..., 0])


def in_cells(image: NDArray[Any], pixel: Indices) -> NDArray[Any]:
    """Return the values of an image, shape (height, width), at the pixels of its cells, shape (h, w)."""
    return np.take_along_axis(_blocks(image), pixel[..., None], axis=-1)[..., 0]


def _blocks(image: NDArray[Any]) -> NDArray[Any]:
    h, w = image.shape[0] // CELL, image.shape[1] // CELL
    return image.reshape(h, CELL, w, CELL).swapaxes(1, 2).reshape(h, w, CELL * CELL)


def cell_rays(lens: Array, shape: tuple[int, int], corner: tuple[int, int] = (0, 0)) -> Array:
    """Return the points of the plane z = 1 m that the middles of cells see, shape (h, w, 3) [m].

    Args:
        lens: Focal lengths and principal point of the image, shape (4,) [pixels].
        shape: Rows and columns of cells.
        corner: First row and column [pixels].
    """
    middle = (CELL - 1) / 2.0
    rows = (corner[0] + CELL * np.arange(shape[0]) + middle - lens[3]) / lens[1]
    columns = (corner[1] + CELL * np.arange(shape[1]) + middle - lens[2]) / lens[0]
    return np.stack([*np.meshgrid(columns, rows), np.ones(shape)], axis=-1)


def ray_frames(rays: Array) -> Array:
    """Return the smallest rotations that take the optical axis to rays, shape (..., 3); of shape (..., 3, 3)."""
    x, y, w = np.moveaxis(rays / np.linalg.norm(rays, axis=-1, keepdims=True), -1, 0)
    k = 1.0 / (1.0 + w)
    rows = [[1.0 - k * x * x, -k * x * y, x], [-k * x * y, 1.0 - k * y * y, y], [-x, -y, w]]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))


class StandardView(NamedTuple):
    """How a camera's images become those that the network sees.

    Attributes:
        pixels: Flat pixel of the camera's image for each of the standard one, -1 for none, shape (H, W).
        rays: Rays of the cells, shape (H / 4, W / 4, 3) [m].
        frames: Frames of these rays, shape (H / 4, W / 4, 3, 3).
    """

    pixels: Indices
    rays: Array
    frames: Array


def standard_view(camera: Camera) -> StandardView:
    """Return how a camera's images become those that the network sees: a pinhole's of the focal length ``FOCAL``."""
    return _standard_view(camera.width, camera.height, camera.focal, camera.center, camera.distortion)


@lru_cache(maxsize=4)
def _standard_view(width: int, height: int, focal: Any, center: Any, distortion: Any) -> StandardView:
    camera = Camera(width=width, height=height, focal=focal, center=center, distortion=distortion)
    scale = FOCAL / np.array(focal)
    lens = np.array([FOCAL, FOCAL, *(scale * center)])
    columns, rows = (int(np.ceil(n * s / MULTIPLE) * MULTIPLE) for n, s in zip((width, height), scale, strict=True))
    v, u = np.mgrid[0:rows, 0:columns]
    seen = camera.project(np.stack([(u - lens[2]) / FOCAL, (v - lens[3]) / FOCAL, np.ones(u.shape)], axis=-1))
    nearest = np.floor(np.where(np.isfinite(seen), seen, -9.0) + 0.5).astype(np.int64)
    inside = ((nearest >= 0) & (nearest < (width, height))).all(axis=-1)
    pixels = np.where(inside, nearest[..., 1] * width + nearest[..., 0], -1)
    rays = cell_rays(lens, (rows // CELL, columns // CELL))
    return StandardView(pixels, rays, ray_frames(rays))


class KindSpread(StrictModel):
    """Errors of one kind on validation frames.

    Attributes:
        across: Standard deviation of the center across the ray, over the spread that its votes name.
        along: The same along the ray.
        turn: Standard deviation of the axis in each direction, over the root of one minus the largest eigenvalue of the
            mean of its votes.
        size: Standard deviations of the logarithms of radius and half length.
    """

    across: Annotated[float, Field(gt=0.0)]
    along: Annotated[float, Field(gt=0.0)]
    turn: Annotated[float, Field(gt=0.0)]
    size: tuple[Annotated[float, Field(gt=0.0)], Annotated[float, Field(gt=0.0)]]


class DetectorConfig(StrictModel):
    """Content of ``config.json``.

    Attributes:
        schema_: Version of the format.
        kinds: Kinds of objects.
        widths: Channels of the network's layers.
        spreads: Errors by kind.
        least_score: Score with the best mean of precision and recall on validation frames (F1).
        digest: SHA-256 of the file of weights.
        trained: Record of the training.
    """

    schema_: Literal["apex-ompl/detector/1"] = Field(alias="schema")
    kinds: tuple[Literal["box", "can", "cup", "ball", "block", "peg"], ...]
    widths: Annotated[tuple[Annotated[int, Field(gt=0, le=256)], ...], Field(min_length=5, max_length=5)]
    spreads: dict[str, KindSpread]
    least_score: Annotated[float, Field(ge=0.0, le=1.0)]
    digest: str
    trained: dict[str, Any] = {}


@dataclass(frozen=True)
class DetectorSettings:
    """When votes are an object.

    Attributes:
        least_object: Probability that a cell shows an object from which it votes.
        reach: Distance from the center within which votes belong to it [m].
        few: Votes of an object that is half hidden; the score of fewer is lower.
        least_score: Score below which there is no object, or None for that of the checkpoint.
    """

    least_object: float = 0.3
    reach: float = 0.045
    few: float = 2.0
    least_score: float | None = None

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ParameterError: A number is out of its range.
        """
        check_number(self.least_object, "least_object", 0.0, 1.0)
        if self.least_score is not None:
            check_number(self.least_score, "least_score", 0.0, 1.0)
        check_positive(self.reach, "reach")
        check_positive(self.few, "few")


@dataclass(frozen=True, eq=False)
class DetectedObject:
    """An object that a detector found.

    Attributes:
        kind: Its kind.
        score: From 0 to 1.
        center: Its center in the world, shape (3,) [m].
        axis: Its axis in the world, a unit vector, shape (3,); towards the opening of a cup or block, either way of
            boxes, cans and pegs, and anything of a ball.
        covariance: Of a turn about the center and a shift, both in the axes of the world, shape (6, 6) [rad, m];
            nothing is known of turns about the axis.
        size: Half edge or radius, and half length, shape (2,) [m].
        size_spread: Standard deviations of their logarithms, shape (2,).
        box: First and last column and row of its votes in the image, (left, top, right, bottom) [pixels].
        votes: Number of cells that voted.
    """

    kind: str
    score: float
    center: Array
    axis: Array
    covariance: Array
    size: Array
    size_spread: Array
    box: tuple[int, int, int, int]
    votes: int

    @property
    def pose(self) -> Array:
        """A pose with the center and, as z, the axis, shape (4, 4) [m]."""
        found = np.eye(4)
        found[:3, :3] = pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), self.axis).toRotationMatrix()
        found[:3, 3] = self.center
        return found


class CellVotes(NamedTuple):
    """Votes of N cells in the optical frame.

    Attributes:
        cells: Row and column, shape (N, 2).
        object: Probability that the cell shows an object, shape (N,).
        kinds: Probabilities of the kinds, shape (N, K).
        center: Shape (N, 3) [m].
        spread: Mean absolute error of the center that the network expects, shape (N,) [m].
        tensor: Products of the components of the axis, shape (N, 3, 3).
        sign: Axis of kinds whose ends differ, shape (N, 3).
        size: Logarithms of radius and half length over the nominal ones, shape (N, 2).
    """

    cells: Indices
    object: Array
    kinds: Array
    center: Array
    spread: Array
    tensor: Array
    sign: Array
    size: Array

    def of(self, chosen: Any) -> CellVotes:
        """Return some of the votes."""
        return CellVotes(*(values[chosen] for values in self))


class Candidate(NamedTuple):
    """Votes that agree, in the optical frame.

    Attributes:
        kind: Number of the kind.
        score: From 0 to 1.
        center: Shape (3,) [m].
        axis: Unit vector, shape (3,).
        size: Logarithms over the nominal size, shape (2,).
        spread: Mean error that votes of the center expect [m].
        doubt: One minus the largest eigenvalue of the mean of the votes of the axis.
        cells: Rows and columns of the cells, shape (M, 2).
    """

    kind: int
    score: float
    center: Array
    axis: Array
    size: Array
    spread: float
    doubt: float
    cells: Indices


class ObjectDetector:
    """Finds objects by a network of votes.

    Attributes:
        config: Configuration of the network.
        settings: The settings.
    """

    def __init__(
        self, network: DetectorNetwork, config: DetectorConfig, settings: DetectorSettings | None = None
    ) -> None:  # fmt: skip
        """Take a network without batch normalization, its configuration, and settings."""
        import torch

        self.config, self.settings = config, settings or DetectorSettings()
        ready: Any = network.eval().requires_grad_(False)
        self._network = ready.to(memory_format=torch.channels_last)

    @classmethod
    def load(cls, path: str | os.PathLike[str] | None = None, settings: DetectorSettings | None = None) -> Self:
        """Read a detector.

        Args:
            path: Folder of a checkpoint; by default the one that ships.
            settings: The settings.

        Raises:
            MissingFileError: A file of the checkpoint is missing.
            FileFormatError: The checkpoint is damaged, or of another version.
        """
        folder = SHIPPED if path is None else Path(path_text(path))
        for file in (CONFIG, WEIGHTS):
            if not is_file(folder / file):
                raise MissingFileError(str(folder / file), ROLE)
        config = read_record(folder / CONFIG, DetectorConfig, ROLE)
        missing = sorted(set(config.kinds) ^ set(config.spreads))
        if missing or len(set(config.kinds)) != len(config.kinds):
            raise FileFormatError(
                str(folder / CONFIG), "spreads", ", ".join(config.spreads), "expected those of all kinds"
            )
        weights = read_weights(folder / WEIGHTS, config.digest, ROLE)

        import torch

        from apex_ompl.perception.detector_network import DetectorNetwork

        def shapes() -> dict[str, tuple[int, ...]]:
            with torch.device("meta"):  # without memory for them
                made = DetectorNetwork(len(config.kinds), config.widths, normalized=False)
            return {key: tuple(value.shape) for key, value in made.state_dict().items()}

        check_shapes(weights, shapes, folder / WEIGHTS)
        with torch.random.fork_rng(devices=[]):
            network = DetectorNetwork(len(config.kinds), config.widths, normalized=False)
        network.load_state_dict({key: torch.from_numpy(values).float() for key, values in weights.items()})
        return cls(network, config, settings)

    def find(self, frame: Frame, pose: ArrayLike | None = None) -> tuple[DetectedObject, ...]:
        """Return the objects in a frame, the highest score first.

        Args:
            frame: The frame; without colors less is found.
            pose: Pose of the optical frame in the world, shape (4, 4) [m]; by default the camera's.

        Raises:
            ParameterError: The camera is on a link and no pose is given, or the pose is not rigid.
        """
        if not isinstance(frame, Frame):
            raise ParameterError("frame", frame, "a Frame")
        camera = frame.camera
        if pose is None and camera.link is not None:
            raise ParameterError("pose", None, f"the pose of {camera.name!r}, which is on {camera.link!r}")
        at = camera.pose if pose is None else rigid_pose(pose, "pose")
        view = standard_view(camera)
        least = self.config.least_score if self.settings.least_score is None else self.settings.least_score
        candidates = grouped(self.votes(frame, at), self.settings)
        return tuple(self._object(one, at, view, camera) for one in candidates if one.score >= least)

    def votes(self, frame: Frame, pose: Array) -> CellVotes:
        """Return the votes of the cells of a frame whose camera has a pose in the world, shape (4, 4) [m]."""
        import torch

        from apex_ompl.perception.detector_network import FAR, network_input

        view, camera = standard_view(frame.camera), frame.camera
        depth = np.where(view.pixels >= 0, frame.depth.ravel()[view.pixels], 0.0) * camera.depth.scale
        depth[(depth < camera.depth.nearest) | (depth > camera.depth.farthest)] = 0.0
        if frame.color is None:
            color = np.full((3, *depth.shape), 0.5, np.float32)
        else:
            color = frame.color.reshape(-1, 3)[view.pixels].transpose(2, 0, 1).astype(np.float32) / np.float32(255.0)
        near = cells_of(depth).depth
        fine = np.stack([*np.moveaxis(pose[2, :3] @ view.frames, -1, 0), near - FAR]).astype(np.float32)
        with torch.inference_mode():
            image = network_input(
                torch.from_numpy(np.ascontiguousarray(color))[None],
                torch.from_numpy(depth.astype(np.float32))[None, None],
            )
            found = self._network(image.contiguous(memory_format=torch.channels_last), torch.from_numpy(fine)[None])
            chances = found.kinds[0].softmax(dim=0).numpy().astype(float)
            answers = [part[0].numpy().astype(float) for part in found[1:]]
        there = np.argwhere((near > 0.0) & (1.0 - chances[0] > self.settings.least_object))
        i, j = there.T
        center, spread, axis, sign, size = (part[:, i, j].T for part in answers)
        frames = view.frames[i, j]
        xx, yy, zz, xy, xz, yz = axis.T
        tensor = np.stack([np.stack(row, axis=-1) for row in ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))], axis=-2)
        measured = view.rays[i, j] * near[i, j, None]
        shares = chances[1:, i, j].T
        return CellVotes(
            there, 1.0 - chances[0, i, j], shares / shares.sum(axis=1, keepdims=True),
            measured + UNIT * np.einsum("nij,nj->ni", frames, center), UNIT * np.exp(spread[:, 0].clip(-4.0, 1.0)),
            frames @ tensor @ frames.swapaxes(-1, -2), np.einsum("nij,nj->ni", frames, sign), SIZE_UNIT * size,
        )  # fmt: skip

    def _object(self, one: Candidate, pose: Array, view: StandardView, camera: Camera) -> DetectedObject:
        """Return a candidate in the world."""
        kind = self.config.kinds[one.kind]
        spreads, rotation = self.config.spreads[kind], pose[:3, :3]
        ray = rotation @ one.center / np.linalg.norm(one.center)
        axis = rotation @ one.axis
        shift = (spreads.across * one.spread) ** 2 * np.eye(3)
        shift += ((spreads.along**2 - spreads.across**2) * one.spread**2) * np.outer(ray, ray)
        turn = KNOWN_TURN**2 * np.eye(3)
        if kind != "ball":
            own = min(spreads.turn * np.sqrt(max(one.doubt, 1e-4)), KNOWN_TURN) ** 2
            turn = own * np.eye(3) + (KNOWN_TURN**2 - own) * np.outer(axis, axis)
        covariance = np.zeros((6, 6))
        covariance[:3, :3], covariance[3:, 3:] = turn, shift
        nominal = np.array(SIZES[KINDS.index(kind)])
        (top, left), (bottom, right) = one.cells.min(axis=0), one.cells.max(axis=0)
        corners = view.rays[[top, bottom], [left, right]] + (np.array([[-1.0], [1.0]]) * CELL / 2.0 / FOCAL) * (1, 1, 0)
        (u0, v0), (u1, v1) = np.nan_to_num(camera.project(corners)).clip(0, (camera.width - 1, camera.height - 1))
        return DetectedObject(
            kind, one.score, rotation @ one.center + pose[:3, 3], axis, covariance, nominal * np.exp(one.size),
            np.array(spreads.size), (int(u0), int(v0), int(u1), int(v1)), len(one.cells),
        )  # fmt: skip


def grouped(votes: CellVotes, settings: DetectorSettings) -> list[Candidate]:
    """Return the groups of votes that agree, the highest score first."""
    weights = votes.object / votes.spread
    if len(weights) > UPPERMOST:
        votes = votes.of(np.sort(np.argsort(-weights, kind="stable")[:UPPERMOST]))
        weights = votes.object / votes.spread
    left, found = np.ones(len(weights), bool), []
    gaps = votes.center[:, None] - votes.center[None]
    squared = (gaps * gaps).sum(axis=-1) / settings.reach**2
    near = np.exp(-2.0 * squared)
    while left.any():
        density = np.where(left, near @ (weights * left), -1.0)
        center = votes.center[int(np.argmax(density))]
        for _ in range(3):  # mean shift
            away = np.linalg.norm(votes.center - center, axis=1) / settings.reach
            inside = left & (away < 1.0)
            if not inside.any():
                break
            part = weights[inside] * (1.0 - away[inside] ** 2) ** 2
            center = part @ votes.center[inside] / part.sum()
        own = left & (np.linalg.norm(votes.center - center, axis=1) < settings.reach)
        own[int(np.argmax(density))] = True
        left &= ~own
        found.append(_candidate(votes.of(own), center, settings))
    return sorted(found, key=lambda one: -one.score)


def _candidate(own: CellVotes, center: Array, settings: DetectorSettings) -> Candidate:
    """Return what votes with a common center say."""
    weights = own.object / own.spread
    weights = weights / weights.sum()
    kinds = weights @ own.kinds
    kind = int(np.argmax(kinds))
    values, vectors = np.linalg.eigh(np.einsum("n,nij->ij", weights, own.tensor))
    axis = vectors[:, -1]
    if KINDS[kind] in OPEN and axis @ (weights @ own.sign) < 0.0:
        axis = -axis
    support = 1.0 - np.exp(-own.object.sum() / settings.few)
    score = float(kinds[kind] * (weights @ own.object) * support)
    return Candidate(
        kind, score, center, axis, weights @ own.size, float(weights @ own.spread),
        float(np.clip(1.0 - values[-1] / max(values.sum(), 1e-6), 0.0, 1.0)), own.cells,
    )  # fmt: skip
