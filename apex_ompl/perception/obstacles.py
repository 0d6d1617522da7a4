"""Obstacles of a color, found by color and depth: boxes and cylinders of unknown pose and size.

Pixels of the color whose depths are connected are one obstacle. Normals of its points tell how a box or a cylinder may
be turned, and their extents its size; the fit of surfaces (:mod:`apex_ompl.kernel.perception`) finds pose and size, and
the shape whose cost is lower is the answer. Pixels at the border have the color but often no depth: they have to be
inside the outline.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Literal, NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from apex_ompl.errors import ParameterError
from apex_ompl.kernel.perception import AXIS, FitSettings, SurfaceFit, Window, fit_surface
from apex_ompl.perception.library import opencv
from apex_ompl.perception.registration import CorrectedFrame
from apex_ompl.perception.rendering import lens_of, resampled, undistorted
from apex_ompl.perception.surfaces import Surface, body_surface
from apex_ompl.scene.bodies import Body, Obstacle, pose_fields
from apex_ompl.types import Array, Indices
from apex_ompl.util.validation import check_number, check_positive

Mask = NDArray[np.bool_]
Kind = Literal["box", "cylinder"]

APART = 0.04  # second difference of neighboring depths of different surfaces [m]
BEFORE = 0.03  # by which an occluder is before an obstacle [m]
PAD = 8  # around an obstacle's pixels [pixels]
NEIGHBOR = 12  # pixels from a measured one within which pixels of the color belong to it
LARGEST_WINDOW = 110  # of which every pixel is used [pixels]
NORMALS = 400  # that are compared at most
SAME_WAY = np.cos(np.radians(22.0))  # of normals of a plane
SQUARE = 0.5  # cosine between normals of different sides
THICK = 0.012  # distance from a plane of its points [m]
PAIRS = 80  # of normals whose common perpendicular may be an axis
FLAT = 0.2  # share of the largest extent below which an extent is of one side only
KNOWN = 1e8  # information of what is no unknown
MISFIT = 1.5  # mean squared error of points over that of noise above which covariances grow
MOST_GUESSED = 1000  # points at the border that are used at most
POOR = 2.0  # mean squared error of points over that of noise above which other starts are tried
PLACE, TURN, SIZE = 0.1, 0.4, 0.6  # standard deviations before the fit: [m], [rad], of logarithms of sizes
SLICES = 32


@dataclass(frozen=True)
class ObstacleSettings:
    """What an obstacle looks like, and how much measurements say.

    Attributes:
        hue: Hue of its color: 0 red, 120 green, 240 blue [degrees].
        hue_width: Largest difference from that hue [degrees].
        saturation: Least saturation.
        value: Least brightness.
        low: Lower corner of the space where obstacles are looked for [m].
        high: Upper corner.
        smallest: Smallest length of an obstacle [m].
        largest: Largest length; what is longer is a wall or a floor [m].
        least_points: Pixels with depth without which nothing is an obstacle.
        floor: Standard deviation of the surface at a point [m].
        edge: Standard deviation of the contour [pixels].
        point_share: Independent measurements for each patch of pixels that share their noise.
        contour_share: Independent measurements for each pixel of the contour.
        inflation: Factor of the variances of measurements.
        most_points: Points that are used at most.
    """

    hue: float = 0.0
    hue_width: float = 18.0
    saturation: float = 0.55
    value: float = 0.08
    low: tuple[float, float, float] = (-0.3, -1.0, -0.05)
    high: tuple[float, float, float] = (1.3, 1.0, 1.5)
    smallest: float = 0.03
    largest: float = 0.6
    least_points: int = 60
    floor: float = 0.0005
    edge: float = 0.5
    point_share: float = 1.4
    contour_share: float = 0.3
    inflation: float = 3.2
    most_points: int = 300

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ParameterError: A number is out of its range.
        """
        check_number(self.hue, "hue", 0.0, 360.0)
        check_number(self.hue_width, "hue_width", 1.0, 60.0)
        check_number(self.saturation, "saturation", 0.0, 1.0)
        check_number(self.value, "value", 0.0, 1.0)
        for name in ("smallest", "largest", "least_points", "floor", "edge", "point_share", "contour_share"):
            check_positive(getattr(self, name), name)
        for name in ("inflation", "most_points"):
            check_positive(getattr(self, name), name)
        if not all(a < b for a, b in zip(self.low, self.high, strict=True)):
            raise ParameterError("high", self.high, f"numbers above those of low, {self.low}")


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


class _Start(NamedTuple):
    """A solid to start from: its kind, lengths, shape (3,) [m], and pose in the optical frame, shape (4, 4) [m]."""

    kind: Kind
    size: Array
    pose: Array


class _Patch(NamedTuple):
    """The pixels of an obstacle in a window of the image.

    Attributes:
        window: The window.
        points: Measured points in the optical frame, shape (N, 3) [m].
        guessed: Points at the border, or whose depths are their neighbors', shape (M, 3) [m].
        beyond: Distances of pixels from those that it may cover, shape (h, w) [pixels of the window].
        places: Smoothed points of its surface, shape (K, 3) [m].
        normals: Normals there, shape (K, 3).
        cut: Whether the image cuts it.
        pixels: Number of pixels with depth.
    """

    window: Window
    points: Array
    guessed: Array
    beyond: Array
    places: Array
    normals: Array
    cut: bool
    pixels: int


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
        self._cv = opencv()

    def find(
        self, seen: CorrectedFrame, color: NDArray[np.uint8], others: Sequence[tuple[Array, float]] = ()
    ) -> tuple[SeenObstacle, ...]:
        """Return the obstacles of a frame, the one with the most pixels first.

        Args:
            seen: Corrected depths.
            color: Color image of the frame, shape (height, width, 3).
            others: Centers [m] and radii [m] of balls in the world whose contents are no obstacles, such as objects in
                hands.
        """
        camera = seen.camera
        image = resampled(color, undistorted(camera))
        found = []
        for own, depth in self._parts(image, seen):
            patch = self._patch(own, depth, seen)
            if patch is None or not self._wanted(patch, seen, others):
                continue
            answer = self._fitted(patch, seen)
            if answer is not None and self._sized(answer):
                found.append(answer)
        return tuple(sorted(found, key=lambda one: -one.points))

    def colored(self, image: NDArray[np.uint8]) -> Mask:
        """Return the pixels of an image, shape (height, width, 3), that have the color."""
        s, cv = self.settings, self._cv
        hsv = cv.cvtColor(np.ascontiguousarray(image), cv.COLOR_RGB2HSV_FULL)
        low, high = ((s.hue + side * s.hue_width) * 256.0 / 360.0 for side in (-1.0, 1.0))
        least, dark = int(255.0 * s.saturation), int(255.0 * s.value)
        found = np.zeros(image.shape[:2], np.uint8)
        for turn in (-256.0, 0.0, 256.0):
            a, b = max(0, round(low + turn)), min(255, round(high + turn))
            if a <= b:
                found |= cv.inRange(hsv, (a, least, dark), (b, 255, 255))
        return found > 0

    def _parts(self, image: NDArray[np.uint8], seen: CorrectedFrame) -> list[tuple[Mask, Array]]:
        """Return the pixels of each connected part of the color, and depths in which its neighbors' fill its gaps."""
        cv, s = self._cv, self.settings
        red = self.colored(image)
        rows, columns = np.flatnonzero(red.any(axis=1)), np.flatnonzero(red.any(axis=0))
        if np.count_nonzero(red) < s.least_points:
            return []
        part = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
        depth, red, whole = seen.depth[part], red[part], red
        there = red & (depth > 0.0)
        jump = _steps(depth, np.maximum(APART, 9.0 * seen.noise * depth * depth))
        core = cv.morphologyEx((there & ~jump).astype(np.uint8), cv.MORPH_OPEN, np.ones((3, 3), np.uint8))
        count, labels, stats, _ = cv.connectedComponentsWithStats(core, connectivity=4)
        sure = [k for k in range(1, count) if stats[k, cv.CC_STAT_AREA] >= s.least_points / 2]
        if not sure:
            return []
        chosen = np.zeros(count, bool)
        chosen[sure] = True
        kept = chosen[labels]
        away, nearest = cv.distanceTransformWithLabels(
            (~kept).astype(np.uint8), cv.DIST_L2, 5, labelType=cv.DIST_LABEL_PIXEL
        )
        owner, sure_depth = np.zeros(int(nearest.max()) + 1, np.int64), np.zeros(int(nearest.max()) + 1)
        owner[nearest[kept]], sure_depth[nearest[kept]] = labels[kept], depth[kept]
        mine = red & (away <= NEIGHBOR)
        filled = sure_depth[nearest]
        groups = self._merged(sure, labels, depth, red)
        owners, found = owner[nearest], []
        for group in groups:
            own, value = np.zeros_like(whole), np.zeros(whole.shape)
            chosen[:] = False
            chosen[group] = True
            own[part], value[part] = mine & chosen[owners], np.where(kept, depth, filled)
            found.append((own, value))
        return found

    def _merged(self, sure: list[int], labels: Indices, depth: Array, red: Mask) -> list[list[int]]:
        """Return groups of parts: parts of like depth with an occluder between them are the same obstacle."""
        places = {k: np.argwhere(labels == k) for k in sure}
        depths = {k: float(np.median(depth[labels == k])) for k in sure}
        groups = [[k] for k in sure]
        for i, a in enumerate(sure):
            for b in sure[i + 1 :]:
                if abs(depths[a] - depths[b]) < self.settings.largest / 2.0 and _occluded_between(
                    places[a], places[b], depth, red, min(depths[a], depths[b])
                ):
                    first = next(group for group in groups if a in group)
                    second = next(group for group in groups if b in group)
                    if first is not second:
                        first += second
                        groups.remove(second)
        return groups

    def _patch(self, own: Mask, filled: Array, seen: CorrectedFrame) -> _Patch | None:
        """Return the pixels of an obstacle, every second one where it is large; None where they are too few."""
        s, camera = self.settings, seen.camera
        rows, columns = np.nonzero(own)
        left, top = max(0, columns.min() - PAD), max(0, rows.min() - PAD)
        right, bottom = min(camera.width, columns.max() + PAD + 1), min(camera.height, rows.max() + PAD + 1)
        stride = -(-max(right - left, bottom - top) // LARGEST_WINDOW)
        window = Window(int(left), int(top), int((right - left) // stride), int((bottom - top) // stride), int(stride))
        cells = (
            slice(window.top, window.top + window.height * stride, stride),
            slice(window.left, window.left + window.width * stride, stride),
        )
        mine, depth, guess = own[cells], seen.depth[cells], filled[cells]
        measured = mine & (depth > 0.0) & (np.abs(depth - guess) < APART)
        pixels = int(np.count_nonzero(measured)) * stride * stride
        if pixels < s.least_points:
            return None
        lens = window.lens(lens_of(camera))
        front = float(np.percentile(depth[measured], 5))
        covered = mine | ((depth > 0.0) & (depth < front - BEFORE))
        beyond = self._cv.distanceTransform((~covered).astype(np.uint8), self._cv.DIST_L2, 5).astype(float)
        cut = rows.min() < 2 or columns.min() < 2 or rows.max() > camera.height - 3 or columns.max() > camera.width - 3
        grid = _points(guess, lens)
        inner = self._cv.erode(mine.astype(np.uint8), np.ones((5, 5), np.uint8), borderValue=1) > 0
        sure = measured & inner  # depths at the border are often wrong
        points = grid[sure if np.count_nonzero(sure) * stride * stride >= s.least_points else measured]
        places, normals = self._normals(grid, measured, max(2, round(np.sqrt(len(points)) / 6.0)))
        return _Patch(window, points, grid[mine & ~sure], beyond, places, normals, bool(cut), pixels)

    def _normals(self, grid: Array, measured: Mask, reach: int) -> tuple[Array, Array]:
        """Return smoothed points and normals there by differences over a distance of pixels, both of shape (K, 3)."""
        cv = self._cv
        weight = measured.astype(float)
        share = cv.blur(weight, (reach, reach), borderType=cv.BORDER_CONSTANT)
        smooth = cv.blur(grid * weight[..., None], (reach, reach), borderType=cv.BORDER_CONSTANT)
        smooth /= np.maximum(share, 1e-9)[..., None]
        good = share > 0.6
        r = reach
        inner = good[2 * r :, r:-r] & good[: -2 * r, r:-r] & good[r:-r, 2 * r :] & good[r:-r, : -2 * r]
        down = (smooth[2 * r :, r:-r] - smooth[: -2 * r, r:-r])[inner]
        across = (smooth[r:-r, 2 * r :] - smooth[r:-r, : -2 * r])[inner]
        normals = np.cross(down, across)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        step = max(1, len(normals) // NORMALS)
        return smooth[r:-r, r:-r][inner][::step], np.asarray(normals[::step])

    def _wanted(self, patch: _Patch, seen: CorrectedFrame, others: Sequence[tuple[Array, float]]) -> bool:
        pose, s = seen.registration.pose, self.settings
        center = pose[:3, :3] @ np.median(patch.points, axis=0) + pose[:3, 3]
        if not ((center > s.low) & (center < s.high)).all():
            return False
        return all(np.linalg.norm(center - place) > radius for place, radius in others)

    def _sized(self, found: SeenObstacle) -> bool:
        """Return whether the lengths of what was found are those of an obstacle."""
        s = self.settings
        return bool(found.size.min() > 0.5 * s.smallest and s.smallest < found.size.max() < s.largest)

    def _fitted(self, patch: _Patch, seen: CorrectedFrame) -> SeenObstacle | None:
        """Return the solid of the lowest cost among all starts; None where no fit found any."""
        s = self.settings
        kept = patch.points[_spaced(len(patch.points), s.most_points)]
        guessed = patch.guessed[_spaced(len(patch.guessed), MOST_GUESSED)]
        points = np.concatenate([kept, guessed])
        settings = self._fit_settings(patch, len(patch.points) / max(len(kept), 1), seen)
        lens = patch.window.lens(lens_of(seen.camera))
        fits: list[tuple[_Start, SurfaceFit]] = []

        def run(start: _Start) -> None:
            surface = _unit(start.kind)
            ties, symmetry = (np.arange(3), 0) if start.kind == "box" else (np.array([0, 0, 2]), AXIS)
            prior = _prior(start.kind)
            fit = fit_surface(
                points, patch.beyond, lens, surface.vertices * start.size, surface.faces, ties, symmetry, start.pose,
                start.pose, prior, settings, len(kept),
            )  # fmt: skip
            if np.isfinite(fit.cost):
                fits.append((start, fit))

        for one in _starts(patch):
            run(one)
        if not fits:
            return None
        start, best = min(fits, key=lambda one: one[1].cost)
        if best.cost > POOR * settings.point_share * len(kept):  # from the points' extents along the axes found
            for kind in ("box", "cylinder"):
                rest = [one for one in fits if one[0].kind == kind]
                if rest:
                    turn = min(rest, key=lambda one: one[1].cost)[1].rotation
                    run(_box(turn, patch) if kind == "box" else _cylinder(turn[:, 2], patch))
            start, best = min(fits, key=lambda one: one[1].cost)
        misfit = best.cost / (settings.point_share * len(kept))
        return _answer(start, best, max(1.0, misfit / MISFIT), patch, seen)

    def _fit_settings(self, patch: _Patch, thinning: float, seen: CorrectedFrame) -> FitSettings:
        s = self.settings
        shared = max(1.0, (seen.camera.depth.correlation / patch.window.stride) ** 2)
        return FitSettings(
            noise=seen.noise, floor=s.floor, edge=s.edge,
            point_share=s.point_share * thinning / shared / s.inflation,
            contour_share=s.contour_share * patch.window.stride / s.inflation, first=0.04, last=0.02, reach=0.02,
            steps=12,
        )  # fmt: skip


def _spaced(count: int, most: int) -> Indices:
    """Return up to ``most`` numbers below ``count``, equally spaced."""
    return np.linspace(0, count - 1, min(count, most)).astype(np.int64)


def _points(depth: Array, lens: Array) -> Array:
    """Return the points of a depth image in the optical frame, shape (h, w, 3) [m]."""
    rows, columns = np.mgrid[0 : depth.shape[0], 0 : depth.shape[1]]
    return np.stack([(columns - lens[2]) / lens[0] * depth, (rows - lens[3]) / lens[1] * depth, depth], axis=-1)


def _steps(depth: Array, limit: Array) -> Mask:
    """Return where depths have a step: second differences above a limit in a row or a column.

    First differences would take surfaces seen from the side for steps.
    """
    found = np.zeros(depth.shape, bool)
    found[:, 1:-1] = np.abs(depth[:, 2:] - 2.0 * depth[:, 1:-1] + depth[:, :-2]) > limit[:, 1:-1]
    found[1:-1] |= np.abs(depth[2:] - 2.0 * depth[1:-1] + depth[:-2]) > limit[1:-1]
    return found


def _occluded_between(first: Indices, second: Indices, depth: Array, red: Mask, before: float) -> bool:
    """Return whether an occluder is at most pixels between the nearest pixels of two parts."""
    a, b = first[:: max(1, len(first) // 200)], second[:: max(1, len(second) // 200)]
    apart = np.linalg.norm(a[:, None, :] - b[None, :, :], axis=-1)
    i, j = np.unravel_index(int(np.argmin(apart)), apart.shape)
    count = max(2, int(apart[i, j]))
    line = np.round(np.linspace(a[i], b[j], count + 1)).astype(np.int64)
    between = depth[line[:, 0], line[:, 1]]
    gap = ~red[line[:, 0], line[:, 1]]
    if not gap.any():
        return False
    return bool(np.mean((between[gap] > 0.0) & (between[gap] < before - BEFORE)) > 0.6)


def _plane(places: Array, normals: Array) -> Array | None:
    """Return the normal of the plane through the places of the largest group of like normals; None without normals."""
    if not len(normals):
        return None
    alike = normals @ normals.T > SAME_WAY
    group = alike[int(np.argmax(alike.sum(axis=1)))]
    mean = normals[group].mean(axis=0)
    mean /= np.linalg.norm(mean)
    for _ in range(2):
        height = places @ mean
        near = group & (np.abs(height - np.median(height[group])) < THICK)
        if np.count_nonzero(near) < 6:
            break
        own = places[near] - places[near].mean(axis=0)
        found = np.linalg.eigh(own.T @ own)[1][:, 0]
        mean = found * np.sign(found @ mean)
    return np.asarray(mean)


def _round_axis(normals: Array) -> Array | None:
    """Return the axis to which most normals are perpendicular or, those of a cap, parallel (RANSAC); None for few."""
    if len(normals) < 8:
        return None
    rng = np.random.default_rng(0)
    pairs = rng.integers(len(normals), size=(PAIRS, 2))
    axes = np.cross(normals[pairs[:, 0]], normals[pairs[:, 1]])
    lengths = np.linalg.norm(axes, axis=1)
    if not (lengths > 0.3).any():
        return None
    axes = axes[lengths > 0.3] / lengths[lengths > 0.3, None]
    along = np.abs(normals @ axes.T)
    best = int(np.argmax((along < 0.2).sum(axis=0) + (along > 0.95).sum(axis=0)))
    side = normals[along[:, best] < 0.25]
    return np.asarray(np.linalg.eigh(side.T @ side)[1][:, 0])


def _starts(patch: _Patch) -> list[_Start]:
    """Return boxes and cylinders from which fits start, in the optical frame."""
    first = _plane(patch.places, patch.normals)
    if first is None:
        first = -np.median(patch.points, axis=0)
        first /= np.linalg.norm(first)
    rest = np.abs(patch.normals @ first) < SQUARE
    enough = np.count_nonzero(rest) > max(3.0, 0.06 * len(patch.normals))
    second = _plane(patch.places[rest], patch.normals[rest]) if enough else None
    frames = [_frame(first, second if second is not None else _longest(patch.points, first))]
    if second is None:  # one side is seen, or a round one
        frames.append(_turned(frames[0], np.pi / 4.0))
    starts = [_box(frame, patch) for frame in frames]
    axes = [first] if second is None else [first, second]
    round_one = _round_axis(patch.normals)
    if round_one is not None:
        axes.append(round_one)
    return starts + [_cylinder(axis, patch) for axis in axes]


def _frame(first: Array, second: Array) -> Array:
    """Return a rotation whose x is the first vector and whose y is in the plane of both."""
    y = second - (second @ first) * first
    y /= np.linalg.norm(y)
    return np.stack([first, y, np.cross(first, y)], axis=1)


def _turned(frame: Array, angle: float) -> Array:
    """Return a rotation turned about its x [rad]."""
    return np.asarray(frame @ pin.exp3(np.array([angle, 0.0, 0.0])))


def _longest(points: Array, normal: Array) -> Array:
    """Return the direction across a normal in which points extend most."""
    flat = points - points.mean(axis=0)
    flat = flat - (flat @ normal)[:, None] * normal
    return np.asarray(np.linalg.eigh(flat.T @ flat)[1][:, 2])


def _box(frame: Array, patch: _Patch) -> _Start:
    """Return the box of the points' extents; one of which only the front is seen is as deep as it is wide."""
    along = patch.points @ frame
    low, high = np.percentile(along, [2.0, 98.0], axis=0)
    size, middle = high - low, (high + low) / 2.0
    flat = size < FLAT * size.max()
    sight = frame.T @ patch.points.mean(axis=0)
    deep = float(np.mean(np.sort(size)[1:])) * 0.7
    for k in np.flatnonzero(flat):
        side = low[k] if sight[k] > 0.0 else high[k]
        size[k] = deep
        middle[k] = side + np.sign(sight[k]) * deep / 2.0
    return _start("box", size, frame, middle)


def _cylinder(axis: Array, patch: _Patch) -> _Start:
    """Return the cylinder along an axis whose outline and front are those of the points."""
    sight = patch.points.mean(axis=0)
    across = np.cross(axis, sight)
    if np.linalg.norm(across) < 0.02 * np.linalg.norm(sight):  # along the line of sight
        across = _longest(patch.points, axis)
    across /= np.linalg.norm(across)
    frame = np.stack([across, np.cross(axis, across), axis], axis=1)
    along = patch.points @ frame
    low, high = np.percentile(along, [2.0, 98.0], axis=0)
    size, middle = high - low, (high + low) / 2.0
    away = frame.T @ sight
    length, radius = float(size[2]), float(size[0]) / 2.0
    middle[1] = low[1] + radius if away[1] > 0.0 else high[1] - radius
    if length < FLAT * 2.0 * radius:  # the cap alone
        length, middle[1] = 2.0 * radius, (low[1] + high[1]) / 2.0
        middle[2] = low[2] + length / 2.0 if away[2] > 0.0 else high[2] - length / 2.0
    return _start("cylinder", np.array([2.0 * radius, 2.0 * radius, length]), frame, middle)


def _start(kind: Kind, size: Array, frame: Array, middle: Array) -> _Start:
    pose = np.eye(4)
    pose[:3, :3] = frame if np.linalg.det(frame) > 0.0 else frame * (1.0, 1.0, -1.0)
    pose[:3, 3] = frame @ middle
    return _Start(kind, np.maximum(size, 0.01), pose)


def _prior(kind: Kind) -> Array:
    """Return the information before a fit, shape (9, 9)."""
    prior = np.diag([TURN**-2] * 3 + [PLACE**-2] * 3 + [SIZE**-2] * 3)
    if kind == "cylinder":  # both diameters are one unknown
        prior[7, 7] = KNOWN
    return prior


@cache
def _unit(kind: Kind) -> Surface:
    """Return the surface of a solid whose lengths are 1 m."""
    shape: dict[str, object] = {"box": (1.0, 1.0, 1.0)}
    if kind == "cylinder":
        shape = {"cylinder": {"radius": 0.5, "length": 1.0}}
    return body_surface(Body.model_validate({"name": "obstacle", **shape}), SLICES)


def _answer(start: _Start, fit: SurfaceFit, factor: float, patch: _Patch, seen: CorrectedFrame) -> SeenObstacle:
    """Return the answer in the world, with covariances of lengths for those of their logarithms.

    Variances of measurements grow by a factor.
    """
    registration, prior = seen.registration, _prior(start.kind)
    own = np.linalg.inv(prior + (fit.information - prior) / factor)
    lever = own @ fit.cross / factor
    covariance = own + lever @ registration.covariance @ lever.T
    size = start.size * fit.scale
    if start.kind == "cylinder":  # one unknown for both diameters
        covariance[7, :] = covariance[6, :]
        covariance[:, 7] = covariance[:, 6]
    jacobian = np.zeros((9, 9))
    jacobian[:3, :3] = jacobian[3:6, 3:6] = registration.pose[:3, :3]
    jacobian[6:, 6:] = np.diag(size)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = fit.rotation, fit.position
    return SeenObstacle(
        start.kind, registration.pose @ pose, size, jacobian @ covariance @ jacobian.T, patch.cut, patch.pixels
    )
