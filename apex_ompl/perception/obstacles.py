"""Obstacles of a color, found by color and depth: boxes and cylinders of unknown pose and size.

Pixels of the color whose depths are connected are one obstacle. Normals of its points tell how a box or a cylinder may
be turned, and their extents its size; the fit of surfaces (:mod:`apex_ompl.kernel.perception`) finds pose and size, and
the shape whose cost is lower is the answer. Pixels at the border have the color but often no depth: they have to be
inside the outline.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apex_ompl.perception.color_parts import Color, ColorPart, Mask, color_parts
from apex_ompl.perception.library import opencv
from apex_ompl.perception.obstacle_settings import ObstacleSettings
from apex_ompl.perception.registration import CorrectedFrame
from apex_ompl.perception.rendering import resampled, undistorted
from apex_ompl.perception.solid_fit import Estimate, KnownSize, fitted
from apex_ompl.perception.solid_pixels import Patch, patch_of
from apex_ompl.perception.solid_starts import Kind
from apex_ompl.scene.bodies import Obstacle, pose_fields
from apex_ompl.types import Array


@dataclass(frozen=True, eq=False)
class SeenObstacle:
    """An obstacle that was seen.

    Attributes:
        kind: ``box`` or ``cylinder`` along z.
        pose: Pose in the world, shape (4, 4) [m].
        size: Lengths along its axes, of a cylinder diameter, diameter and length, shape (3,) [m].
        covariance: Of a turn about its center and a shift, both in the axes of the world, and of the lengths,
            [rad, m, m], shape (9, 9).
        cut: Whether the image cuts it.
        points: Number of pixels with depth.
    """

    kind: Kind
    pose: Array
    size: Array
    covariance: Array
    cut: bool
    points: int

    @property
    def place_spread(self) -> float:
        """Standard deviation of the center, root of the sum over the axes [m]."""
        return float(np.sqrt(np.trace(self.covariance[3:6, 3:6])))

    def obstacle(self, name: str, deviations: float = 0.0) -> Obstacle:
        """Return the obstacle of a scene, larger by some standard deviations of each of its ends.

        Args:
            name: Its name.
            deviations: Number of standard deviations.
        """
        return solid_obstacle(name, self.kind, self.pose, self.size, self.covariance, deviations=deviations)


def solid_obstacle(
    name: str, kind: Kind, pose: Array, size: Array, covariance: Array, *, deviations: float = 0.0
) -> Obstacle:  # fmt: skip
    """Return the obstacle of a scene, larger by some standard deviations of each of its ends.

    The ends along an axis are c - s / 2 and c + s / 2 for a center c and a length s, whose errors may be correlated:
    the front of an obstacle is known better than its back. Turns move its corners, at most as far as those reach.

    Args:
        name: Its name.
        kind: Its kind.
        pose: Pose in the world, shape (4, 4) [m].
        size: Lengths along its axes, shape (3,) [m].
        covariance: Of turn, shift and lengths as in :class:`SeenObstacle`, shape (9, 9).
        deviations: Number of standard deviations.
    """
    rotation, half = pose[:3, :3], size / 2.0
    shift = np.diag(rotation.T @ covariance[3:6, 3:6] @ rotation) + np.diag(covariance[6:, 6:]) / 4.0
    both = np.diag(rotation.T @ covariance[3:6, 6:])
    turns = np.diag(rotation.T @ covariance[:3, :3] @ rotation) * (1.0, 1.0, 0.0 if kind == "cylinder" else 1.0)
    tilt = turns[[1, 2, 0]] * half[[2, 0, 1]] ** 2 + turns[[2, 0, 1]] * half[[1, 2, 0]] ** 2
    tilt = np.minimum(deviations * np.sqrt(tilt), np.linalg.norm(half) - half)
    low, high = (deviations * np.sqrt(np.maximum(shift + side * both, 0.0)) + tilt for side in (-1.0, 1.0))
    placed, (x, y, z) = pose.copy(), size + low + high
    placed[:3, 3] += rotation @ (high - low) / 2.0
    shape: dict[str, object] = {"box": (float(x), float(y), float(z))}
    if kind == "cylinder":
        radius = float(max(half[0] + max(low[0], high[0]), half[1] + max(low[1], high[1])))
        placed[:3, 3] = pose[:3, 3] + rotation[:, 2] * (high[2] - low[2]) / 2.0
        shape = {"cylinder": {"radius": radius, "length": float(z)}}
    return Obstacle.model_validate({"name": name, **shape, **pose_fields(placed)})


class ObstacleFinder:
    """Finds obstacles of a color in corrected frames.

    Attributes:
        settings: The settings.
    """

    def __init__(self, settings: ObstacleSettings | None = None) -> None:
        """Take the settings, and load OpenCV.

        Raises:
            MissingFileError: The extra ``perception`` is not installed.
        """
        self.settings = settings or ObstacleSettings()
        opencv()
        s = self.settings
        self._color = Color(s.hue, s.hue_width, s.saturation, s.value)

    def find(
        self, seen: CorrectedFrame, color: NDArray[np.uint8], others: Sequence[tuple[Array, Array]] = (),
        known: Sequence[KnownSize] = (),
    ) -> tuple[SeenObstacle, ...]:  # fmt: skip
        """Return the obstacles of a frame, the one with the most pixels first.

        Args:
            seen: Corrected depths.
            color: Color image of the frame, shape (height, width, 3).
            others: Poses in the world, shape (4, 4), and boxes in their frames, shape (2, 3) [m], such as those of
                objects in hands: what has its center in one is no obstacle.
            known: Sizes that obstacles may have, by the user or by earlier observations. What fits none of them has a
                size of its own.
        """
        s = self.settings
        image = resampled(color, undistorted(seen.camera))
        found, parts = [], self._parts(image, seen)
        while parts:
            part = parts.pop()
            patch = patch_of(part, seen, s)
            if patch is None or not self._wanted(patch, seen):
                continue
            estimate = fitted(patch, seen, s, known)
            if part.pieces and (estimate is None or estimate.misfit > s.most_misfit):
                parts += part.pieces  # they are no single obstacle
                continue
            answer = None if estimate is None else _answer(estimate, patch, seen)
            if answer is not None and self._sized(answer) and not _is_in(answer.pose[:3, 3], others):
                found.append(answer)
        return tuple(sorted(found, key=lambda one: -one.points))

    def _parts(self, image: NDArray[np.uint8], seen: CorrectedFrame) -> list[ColorPart]:
        s = self.settings
        return color_parts(
            image, seen.depth, self._color, noise=seen.noise, least=s.least_points, largest=s.largest
        )  # fmt: skip

    def colored(self, image: NDArray[np.uint8]) -> Mask:
        """Return the pixels of an image, shape (height, width, 3), that have the color."""
        return self._color.pixels(image)

    def _wanted(self, patch: Patch, seen: CorrectedFrame) -> bool:
        pose, s = seen.registration.pose, self.settings
        if not patch.coarse.measured:
            return False
        center = pose[:3, :3] @ patch.coarse.points[: patch.coarse.measured].mean(axis=0) + pose[:3, 3]
        return bool(((center > s.low) & (center < s.high)).all())

    def _sized(self, found: SeenObstacle) -> bool:
        """Return whether the lengths of what was found are those of an obstacle."""
        s = self.settings
        return bool(found.size.min() > 0.5 * s.smallest and s.smallest < found.size.max() < s.largest)


def _is_in(center: Array, boxes: Sequence[tuple[Array, Array]]) -> bool:
    """Return whether a center in the world is in a box at a pose."""
    places = [(pose[:3, :3].T @ (center - pose[:3, 3]), box) for pose, box in boxes]
    return any(((low <= place) & (place <= high)).all() for place, (low, high) in places)


def _answer(estimate: Estimate, patch: Patch, seen: CorrectedFrame) -> SeenObstacle:
    """Return the answer in the world, with covariances of lengths for those of their logarithms."""
    (kind, size, pose), covariance = estimate.solid, estimate.covariance.copy()
    if kind == "cylinder":  # one unknown for both diameters
        covariance[7, :] = covariance[6, :]
        covariance[:, 7] = covariance[:, 6]
    jacobian = np.zeros((9, 9))
    jacobian[:3, :3] = jacobian[3:6, 3:6] = seen.registration.pose[:3, :3]
    jacobian[6:, 6:] = np.diag(size)
    world = seen.registration.pose @ pose
    return SeenObstacle(kind, world, size, jacobian @ covariance @ jacobian.T, patch.cut, patch.pixels)
