"""Parts of an image that have a color and connected depths.

The color is looked for in every second row and column first, and exactly around what was found there only.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from apex_ompl.perception.library import opencv
from apex_ompl.types import Array, Indices

Mask = NDArray[np.bool_]

APART = 0.04  # second difference of neighboring depths of different surfaces [m]
BEFORE = 0.03  # by which an occluder is before an obstacle [m]
JUST_BEFORE = 0.01  # the same of an occluder between two parts of one [m]
PAD = 8  # around an obstacle's pixels [pixels]
NEIGHBOR = 40  # pixels from a measured one within which pixels of the color belong to it
FLYING = 3  # pixels from a measured one within which depths may be between both sides of an edge
EDGE, SHADOW = 2.0, 16.0  # width of what has no depth at an edge, and beside it [pixels]
SPECKS = 3  # width of the median filter of the color [pixels]


@dataclass(frozen=True)
class Color:
    """A range of colors.

    Attributes:
        hue: Hue: 0 red, 120 green, 240 blue [degrees].
        width: Largest difference from that hue [degrees].
        saturation: Least saturation.
        value: Least brightness.
    """

    hue: float
    width: float
    saturation: float
    value: float

    def pixels(self, image: NDArray[np.uint8]) -> Mask:
        """Return the pixels of an image, shape (height, width, 3), that have the color."""
        cv = opencv()
        hsv = cv.cvtColor(np.ascontiguousarray(image), cv.COLOR_RGB2HSV_FULL)
        low, high = ((self.hue + side * self.width) * 256.0 / 360.0 for side in (-1.0, 1.0))
        least, dark = int(255.0 * self.saturation), int(255.0 * self.value)
        found = np.zeros(image.shape[:2], np.uint8)
        for turn in (-256.0, 0.0, 256.0):
            a, b = max(0, round(low + turn)), min(255, round(high + turn))
            if a <= b:
                found |= cv.inRange(hsv, (a, least, dark), (b, 255, 255))
        return np.asarray(found > 0)


class ColorPart(NamedTuple):
    """Connected pixels of the color in a window of the image.

    Attributes:
        left: First column of the window [pixels].
        top: First row [pixels].
        own: Its pixels, shape (h, w).
        maybe: Pixels of the color beside them whose depths are others', shape (h, w).
        filled: Depths, those of the nearest pixel that has one where it has none of its own, shape (h, w) [m].
        depth: Its mean depth [m].
        size: Number of pixels with depths that are sure.
        pieces: Parts that an occluder may divide, of which it was put together; none for most.
    """

    left: int
    top: int
    own: Mask
    maybe: Mask
    filled: Array
    depth: float
    size: int
    pieces: tuple[ColorPart, ...] = ()


def color_parts(
    image: NDArray[np.uint8], depth: Array, color: Color, *, noise: float, least: float, largest: float
) -> list[ColorPart]:  # fmt: skip
    """Return the parts of a color.

    Args:
        image: Red, green and blue, shape (height, width, 3).
        depth: Depths, 0 where there is none, shape (height, width) [m].
        color: The color.
        noise: Standard deviation of depth z is ``noise`` z^2 [1/m].
        least: Least number of pixels.
        largest: Largest length of an obstacle, whose parts an occluder may divide [m].
    """
    cv = opencv()
    half = image.shape[1] // 2, image.shape[0] // 2
    coarse = color.pixels(cv.resize(image[: 2 * half[1], : 2 * half[0]], half, interpolation=cv.INTER_NEAREST)).astype(
        np.uint8
    )
    contours, _ = cv.findContours(coarse, cv.RETR_EXTERNAL, cv.CHAIN_APPROX_NONE)
    parts = []
    for contour in contours:
        x, y, width, height = cv.boundingRect(contour)
        if 4 * width * height < least or 4 * (cv.contourArea(contour) + len(contour) / 2.0 + 1.0) < least:
            continue
        left, top = 2 * max(0, x - PAD // 2), 2 * max(0, y - PAD // 2)
        right, bottom = 2 * (x + width + PAD // 2), 2 * (y + height + PAD // 2)
        crop = slice(top, bottom), slice(left, right)
        shape = depth[crop].shape
        filled = np.zeros(((shape[0] + 1) // 2, (shape[1] + 1) // 2), np.uint8)
        cv.drawContours(filled, [contour], 0, 1, cv.FILLED, offset=(-(left // 2), -(top // 2)))
        near = cv.dilate(filled, np.ones((3, 3), np.uint8)).repeat(2, axis=0).repeat(2, axis=1) > 0
        colored = color.pixels(image[crop])
        own = _without_specks(colored) & near[: shape[0], : shape[1]]
        parts += _connected(own, colored, depth[crop], (left, top), noise=noise, least=least)
    return _merged(parts, depth, largest)


def _without_specks(colored: Mask) -> Mask:
    """Return pixels of the color beside which most are of the color, with the corners between those."""
    cv = opencv()
    most = cv.medianBlur(colored.astype(np.uint8), SPECKS)
    return np.asarray(colored & (cv.dilate(most, np.ones((3, 3), np.uint8)) > 0))


def _connected(
    own: Mask, colored: Mask, depth: Array, corner: tuple[int, int], *, noise: float, least: float
) -> list[ColorPart]:  # fmt: skip
    """Return the parts of the color in a window from a corner on (left, top) whose depths are connected.

    Pixels ``own`` belong to one of them; others of the ``colored`` ones only may.
    """
    cv = opencv()
    jump = _steps(depth, np.maximum(APART, 9.0 * noise * depth * depth))
    core = cv.morphologyEx((own & (depth > 0.0) & ~jump).astype(np.uint8), cv.MORPH_OPEN, np.ones((3, 3), np.uint8))
    count, labels, stats, _ = cv.connectedComponentsWithStats(core, connectivity=4)
    chosen = stats[:, cv.CC_STAT_AREA] >= least / 2
    chosen[0] = False
    if not chosen.any():
        return []
    kept = chosen[labels]
    away, nearest = cv.distanceTransformWithLabels(
        (~kept).astype(np.uint8), cv.DIST_L2, 5, labelType=cv.DIST_LABEL_PIXEL
    )
    owner, known = np.zeros(int(nearest.max()) + 1, np.int64), np.zeros(int(nearest.max()) + 1)
    owner[nearest[kept]], known[nearest[kept]] = labels[kept], depth[kept]
    filled = np.where(kept, depth, known[nearest])
    other = (depth > 0.0) & (np.abs(depth - filled) > APART)
    near, owners, blind = own & (away <= NEIGHBOR), owner[nearest], depth <= 0.0
    mine = near & ~other
    beside = near & other & ((away <= FLYING) | (depth > filled))  # depths of steep sides are few and far between
    beside |= colored & blind & ~near  # of what an occluder divides
    found, steep = [], own & ~blind & ~kept
    for k in np.flatnonzero(chosen):
        part = mine & (owners == k)
        if (part & blind & (away > EDGE)).any():
            rivals, behind = kept & (labels != k), filled + APART
            empty = cv.distanceTransform((~(part & kept | steep)).astype(np.uint8), cv.DIST_L2, 5) > EDGE
            shadow = (away > EDGE) & _shadowed(rivals, depth, behind)
            shadow |= empty & _shadowed(rivals | ~(blind | own), depth, behind)
            part &= ~(blind & shadow)
        found.append(
            ColorPart(
                *corner, part, beside & (owners == k), filled, float(depth[labels == k].mean()),
                int(stats[k, cv.CC_STAT_AREA]),
            )
        )  # fmt: skip
    return found


def _shadowed(others: Mask, depth: Array, behind: Array) -> Mask:
    """Return the pixels that are near others whose depths are larger than some.

    A part hides farther surfaces from one eye of a stereo camera: pixels without a depth there are no part of it, be
    they of its color. Beside an occluder, the part itself is hidden.
    """
    if not others.any():
        return others
    away, nearest = opencv().distanceTransformWithLabels(
        (~others).astype(np.uint8), opencv().DIST_L2, 5, labelType=opencv().DIST_LABEL_PIXEL
    )
    known = np.zeros(int(nearest.max()) + 1)
    known[nearest[others]] = depth[others]
    return np.asarray((away <= SHADOW) & (known[nearest] > behind))


def _steps(depth: Array, limit: Array) -> Mask:
    """Return where depths have a step: second differences above a limit in a row or a column.

    First differences would take surfaces seen from the side for steps.
    """
    found = np.zeros(depth.shape, bool)
    found[:, 1:-1] = np.abs(depth[:, 2:] - 2.0 * depth[:, 1:-1] + depth[:, :-2]) > limit[:, 1:-1]
    found[1:-1] |= np.abs(depth[2:] - 2.0 * depth[1:-1] + depth[:-2]) > limit[1:-1]
    return found


def _merged(parts: list[ColorPart], depth: Array, largest: float) -> list[ColorPart]:
    """Return the parts, those of like depth with an occluder between them as one."""
    found, k = list(parts), 0
    borders = {id(one): _border(one) for one in found} if len(found) > 1 else {}
    while k < len(found):
        for m in range(k + 1, len(found)):
            near = abs(found[k].depth - found[m].depth) < largest / 2.0
            if near and _occluded_between(found[k], found[m], [borders[id(found[n])] for n in (k, m)], depth):
                found[k] = _together(found[k], found.pop(m))
                borders[id(found[k])] = _border(found[k])
                break
        else:
            k += 1
    return found


def _together(first: ColorPart, second: ColorPart) -> ColorPart:
    """Return two parts as one."""
    left, top = min(first.left, second.left), min(first.top, second.top)
    right = max(one.left + one.own.shape[1] for one in (first, second))
    bottom = max(one.top + one.own.shape[0] for one in (first, second))
    own, maybe = np.zeros((2, bottom - top, right - left), bool)
    filled = np.zeros(own.shape)
    size = first.size + second.size
    for one in (first, second):
        rows = slice(one.top - top, one.top - top + one.own.shape[0])
        columns = slice(one.left - left, one.left - left + one.own.shape[1])
        filled[rows, columns] = np.where(own[rows, columns] & ~one.own, filled[rows, columns], one.filled)
        own[rows, columns] |= one.own
        maybe[rows, columns] |= one.maybe
    depth = (first.depth * first.size + second.depth * second.size) / size
    filled = np.where(filled > 0.0, filled, depth)
    pieces = (*(first.pieces or (first,)), *(second.pieces or (second,)))
    return ColorPart(left, top, own, maybe, filled, depth, size, pieces)


def _occluded_between(first: ColorPart, second: ColorPart, borders: Sequence[Indices], depth: Array) -> bool:
    """Return whether an occluder is at most pixels between the nearest pixels of two parts."""
    a, b = borders
    apart = ((a[:, None, :] - b[None, :, :]) ** 2).sum(axis=-1)
    i, j = np.unravel_index(int(np.argmin(apart)), apart.shape)
    count = max(2, int(np.sqrt(apart[i, j])))
    line = np.round(np.linspace(a[i], b[j], count + 1)).astype(np.int64)[1:-1]
    line = line[~(_has(first, line) | _has(second, line))]
    if not len(line):
        return False
    between = depth[line[:, 0], line[:, 1]]
    ends = _depth_at(first, a[i]), _depth_at(second, b[j])
    share = np.linalg.norm(line - a[i], axis=1) / np.linalg.norm(b[j] - a[i])
    before = ends[0] + (ends[1] - ends[0]) * share - JUST_BEFORE
    return bool(np.mean((between > 0.0) & (between < before)) > 0.6)


def _depth_at(part: ColorPart, pixel: Indices) -> float:
    """Return the depth of a part at a pixel of the image [m]."""
    return float(part.filled[pixel[0] - part.top, pixel[1] - part.left])


def _border(part: ColorPart) -> Indices:
    """Return some pixels of the border of a part, rows and columns of the image, shape (N, 2)."""
    contours, _ = opencv().findContours(part.own.astype(np.uint8), opencv().RETR_EXTERNAL, opencv().CHAIN_APPROX_NONE)
    found = np.concatenate([one[:, 0, ::-1] for one in contours]).astype(np.int64) + (part.top, part.left)
    return found[:: max(1, len(found) // 60)]


def _has(part: ColorPart, pixels: Indices) -> Mask:
    """Return which pixels of the image are a part's."""
    row, column = (pixels - (part.top, part.left)).T
    inside = (row >= 0) & (column >= 0) & (row < part.own.shape[0]) & (column < part.own.shape[1])
    return np.asarray(inside & part.own[np.where(inside, row, 0), np.where(inside, column, 0)])
