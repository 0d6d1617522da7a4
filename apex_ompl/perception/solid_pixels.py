"""The pixels of an obstacle of a color at two resolutions, as fits take them."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from apex_ompl.kernel.perception import FitSettings, Window
from apex_ompl.perception.color_parts import APART, BEFORE, PAD, ColorPart
from apex_ompl.perception.library import opencv
from apex_ompl.perception.obstacle_settings import ObstacleSettings
from apex_ompl.perception.registration import CorrectedFrame
from apex_ompl.perception.rendering import lens_of
from apex_ompl.perception.solid_starts import crosses
from apex_ompl.types import Array, Indices

Mask = NDArray[np.bool_]

COARSE, FINE = 45, 90  # width or height of windows [pixels]
COARSE_POINTS = 80
COARSE_GUESSED, FINE_GUESSED = 250, 800  # points at the border that are used at most
FINE_STEPS = 5  # of a fit at most
FIRST, LAST = 0.04, 0.02  # residual from which points do not count at the first step of a search, and later [m]
COARSE_SETTLED, FINE_SETTLED = 2e-3, 4e-4  # shift of a step of a fit that is the last [m]
NORMALS = 100  # that are compared at most
HIDDEN = 0.03  # share of the border beside an occluder from which on an end may be hidden


class Level(NamedTuple):
    """The pixels of an obstacle at a resolution.

    Attributes:
        window: The window.
        points: Measured points in the optical frame, then points at the border, or whose depths are their neighbors',
            shape (N, 3) [m].
        measured: Number of measured points.
        beyond: Distances of pixels from those that it may cover, shape (h, w) [pixels of the window].
        lens: Lens of the window.
        settings: Weights of a fit.
    """

    window: Window
    points: Array
    measured: int
    beyond: Array
    lens: Array
    settings: FitSettings


class Patch(NamedTuple):
    """The pixels of an obstacle.

    Attributes:
        coarse: For the search.
        fine: For the answer.
        extent: Points, those at the border with guessed depths, shape (M, 3) [m].
        places: Smoothed points of its surface, shape (K, 3) [m].
        normals: Normals there, shape (K, 3).
        cut: Whether the image cuts it.
        hidden: Whether an occluder is beside it.
        pixels: Number of pixels with depth.
    """

    coarse: Level
    fine: Level
    extent: Array
    places: Array
    normals: Array
    cut: bool
    hidden: bool
    pixels: int


def patch_of(part: ColorPart, seen: CorrectedFrame, settings: ObstacleSettings) -> Patch | None:
    """Return the pixels of a part; None where fewer than ``least_points`` have a depth."""
    cv, camera = opencv(), seen.camera
    rows, columns = np.flatnonzero(part.own.any(axis=1)), np.flatnonzero(part.own.any(axis=0))
    if not len(rows):
        return None
    bottom, right = rows[-1] + part.top, columns[-1] + part.left
    top, left = rows[0] + part.top, columns[0] + part.left
    cut = top < 2 or left < 2 or bottom > camera.height - 3 or right > camera.width - 3
    crop = slice(max(0, rows[0] - PAD), rows[-1] + PAD + 1), slice(max(0, columns[0] - PAD), columns[-1] + PAD + 1)
    own, guess = part.own[crop], part.filled[crop]
    corner = part.top + crop[0].start, part.left + crop[1].start
    depth = seen.depth[corner[0] : corner[0] + own.shape[0], corner[1] : corner[1] + own.shape[1]]
    measured = own & (depth > 0.0) & (np.abs(depth - guess) < APART)
    pixels = int(np.count_nonzero(measured))
    if pixels < settings.least_points:
        return None
    inner = cv.erode(own.astype(np.uint8), np.ones((5, 5), np.uint8), borderValue=1) > 0
    sure = measured & inner  # depths at the border are often wrong
    if np.count_nonzero(sure) < settings.least_points:
        sure = measured
    occluder = (depth > 0.0) & (depth < guess - BEFORE) & ~own
    covered = own | occluder | part.maybe[crop]
    border = (cv.dilate(own.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0) & ~own
    hidden = np.count_nonzero(border & occluder) > HIDDEN * np.count_nonzero(border)
    lens = lens_of(camera)

    def level(size: int, most: int, most_guessed: int, first: float, settled: float) -> tuple[Level, Array]:
        stride = -(-max(own.shape) // size)
        height, width = own.shape[0] // stride, own.shape[1] // stride
        window = Window(int(corner[1]), int(corner[0]), width, height, stride)
        cells = slice(0, height * stride, stride), slice(0, width * stride, stride)
        own_lens = window.lens(lens)
        beyond = cv.distanceTransform((~covered[cells]).astype(np.uint8), cv.DIST_L2, 5).astype(float)
        good, all_good = sure[cells], own[cells]
        points, guessed = _points(guess[cells], good, own_lens), _points(guess[cells], all_good & ~good, own_lens)
        kept = points[_spaced(len(points), most)]
        own_settings = _fit_settings(settings, stride, len(points) / max(len(kept), 1), seen)
        own_settings = replace(own_settings, first=first, settled=settled)
        every = np.concatenate([kept, guessed[_spaced(len(guessed), most_guessed)]])
        return Level(window, every, len(kept), beyond, own_lens, own_settings), np.concatenate([points, guessed])

    fine, _ = level(FINE, settings.most_points, FINE_GUESSED, LAST, FINE_SETTLED)
    coarse, extent = level(COARSE, COARSE_POINTS, COARSE_GUESSED, FIRST, COARSE_SETTLED)
    stride = coarse.window.stride
    grid = _grid(guess[::stride, ::stride], Window(corner[1], corner[0], 0, 0, stride).lens(lens))
    places, normals = _normals(grid, measured[::stride, ::stride])
    return Patch(coarse, fine, extent, places, normals, bool(cut), bool(hidden), pixels)


def _fit_settings(settings: ObstacleSettings, stride: int, thinning: float, seen: CorrectedFrame) -> FitSettings:
    shared = max(1.0, (seen.camera.depth.correlation / stride) ** 2)
    return FitSettings(
        noise=seen.noise, floor=settings.floor, edge=settings.edge,
        point_share=settings.point_share * thinning / shared / settings.tempering,
        contour_share=settings.contour_share * stride / settings.tempering, first=FIRST, last=LAST, reach=0.02,
        steps=FINE_STEPS,
    )  # fmt: skip


def _spaced(count: int, most: int) -> Indices:
    """Return up to ``most`` numbers below ``count``, equally spaced."""
    return np.linspace(0, count - 1, min(count, most)).astype(np.int64)


def _points(depth: Array, chosen: Mask, lens: Array) -> Array:
    """Return the points of chosen pixels of a depth image in the optical frame, shape (N, 3) [m]."""
    rows, columns = np.nonzero(chosen)
    z = depth[rows, columns]
    return np.stack([(columns - lens[2]) / lens[0] * z, (rows - lens[3]) / lens[1] * z, z], axis=-1)


def _grid(depth: Array, lens: Array) -> Array:
    """Return the points of a depth image in the optical frame, shape (h, w, 3) [m]."""
    rows, columns = np.ogrid[0 : depth.shape[0], 0 : depth.shape[1]]
    return np.stack([(columns - lens[2]) / lens[0] * depth, (rows - lens[3]) / lens[1] * depth, depth], axis=-1)


def _normals(grid: Array, measured: Mask) -> tuple[Array, Array]:
    """Return smoothed points and normals there by differences over a distance of pixels, both of shape (K, 3)."""
    cv, r = opencv(), max(2, round(np.sqrt(np.count_nonzero(measured)) / 6.0))
    weight = measured.astype(float)
    share = cv.blur(weight, (r, r), borderType=cv.BORDER_CONSTANT)
    smooth = cv.blur(grid * weight[..., None], (r, r), borderType=cv.BORDER_CONSTANT)
    smooth /= np.maximum(share, 1e-9)[..., None]
    good = share > 0.6
    if min(good.shape) <= 2 * r:
        return np.empty((0, 3)), np.empty((0, 3))
    inner = good[2 * r :, r:-r] & good[: -2 * r, r:-r] & good[r:-r, 2 * r :] & good[r:-r, : -2 * r]
    rows, columns = np.nonzero(inner)
    step = max(1, len(rows) // NORMALS)
    rows, columns = rows[::step] + r, columns[::step] + r
    down = smooth[rows + r, columns] - smooth[rows - r, columns]
    across = smooth[rows, columns + r] - smooth[rows, columns - r]
    normals = crosses(down, across)
    normals /= np.maximum(np.sqrt((normals * normals).sum(axis=1, keepdims=True)), 1e-12)
    return smooth[rows, columns], np.asarray(normals)
